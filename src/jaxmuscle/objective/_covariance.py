"""What the scatter of the data leaves undetermined: covariance of parameters, determined directions, in words."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxmuscle.data._target import Target
from jaxmuscle.spectra._bin_law import log_power_moments, shares_map, welch_law
from jaxmuscle.spectra._settings import WINDOW

from ._moment_models import MonteCarlo
from ._residuals import PartResiduals

DETERMINED = 3.0
SHARE_DETERMINED = 0.99


class Identifiability(NamedTuple):
    """Singular values of the Jacobian, its directions (rows) and which of them the data determine."""

    singular_values: Float[np.ndarray, " parameters"]
    directions: Float[np.ndarray, "parameters parameters"]
    determined: Bool[np.ndarray, " parameters"]

    @property
    def parameters(self) -> Bool[np.ndarray, " parameters"]:
        """Which parameters have at least 99 % of their unit vector in determined directions."""
        return (self.directions[self.determined] ** 2).sum(0) >= SHARE_DETERMINED


def identifiability(jacobian: Float[np.ndarray, "residuals parameters"]) -> Identifiability:
    """Singular value decomposition of the data's Jacobian (residuals in standard deviations, parameters in prior ones)."""
    size = jacobian.shape[1]
    _, values, directions = np.linalg.svd(np.nan_to_num(jacobian), full_matrices=True)
    values = np.concatenate([values, np.zeros(size - len(values))])
    return Identifiability(values, directions, values >= DETERMINED)


def parameter_covariance(
    jacobian: Float[np.ndarray, "residuals parameters"],
    residual_covariance: Float[np.ndarray, "residuals residuals"],
    prior_precision: Float[np.ndarray, " parameters"],
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance `G (Jᵀ Σ J + Λ) G`, G = (Jᵀ J + Λ)⁻¹, of a penalised least-squares estimate about the truth.

    Scatter of the data plus the pull of the prior, averaged over truths drawn from it. Where the data determine a
    direction it is `J⁺ Σ J⁺ᵀ`; where they say nothing it is the prior.
    """
    prior = np.diag(prior_precision)
    gain = np.linalg.pinv(jacobian.T @ jacobian + prior, hermitian=True)
    return gain @ (jacobian.T @ residual_covariance @ jacobian + prior) @ gain


SCALES = (
    (
        "all noise amplitudes and the harmonic's can be scaled together",
        ("noise_K_w", "noise_K_z", "harmonic_amplitude"),
    ),
    ("stiffness and damping can be scaled together", ("k_w", "k_z", "c_w", "c_z")),
)


def undetermined_directions(names: tuple[str, ...], found: Identifiability) -> tuple[str, ...]:
    """Sentences that name the directions along which the parameters can move without being noticed.

    Of a joint fit, where "name@target" belongs to one target, each target's own scales and those that are shared.
    """
    basis = found.directions[~found.determined]
    sentences = []
    split = [name.partition("@") for name in names]
    for target in dict.fromkeys(of for _, _, of in split):
        for sentence, members in SCALES:
            pattern = np.array([base in members and of in ("", target) for base, _, of in split], dtype=float)
            if pattern.sum() < 2 or not len(basis):
                continue
            pattern /= np.linalg.norm(pattern)
            inside = basis.T @ (basis @ pattern)
            steepness = np.linalg.norm(found.singular_values * (found.directions @ pattern))
            if steepness < DETERMINED and inside @ inside >= 0.5:
                sentences.append(sentence + (f" ({target})" if target else ""))
                inside /= np.linalg.norm(inside)
                basis = basis - np.outer(basis @ inside, inside)
                _, size, rows = np.linalg.svd(basis, full_matrices=False)
                basis = rows[size > 0.5]
    return (*sentences, *(_in_words(names, direction) for direction in basis))


def _in_words(names: tuple[str, ...], direction: Float[np.ndarray, " parameters"]) -> str:
    direction = direction * np.sign(direction[np.argmax(np.abs(direction))])
    order = [i for i in np.argsort(-np.abs(direction)) if abs(direction[i]) > 0.25]
    up, down = [names[i] for i in order if direction[i] > 0], [names[i] for i in order if direction[i] < 0]
    if len(order) == 1:
        return f"{names[order[0]]} by itself"
    return f"{' and '.join(up)} up" + (f" against {' and '.join(down)} down" if down else " together")


def residual_covariance(target: Target, part: PartResiduals, share: np.ndarray) -> np.ndarray:
    """Covariance of one target's data residuals: scatter of the target and of the simulated mean."""
    start, stop = WINDOW
    per_seed = target.settings.segments(round((stop - start) * target.settings.rate))
    law = welch_law(target.settings, target.bins, (per_seed,))
    # A linear response has no sampling error, and a control variate leaves next to nothing of it.
    model = part.model
    plain = model if isinstance(model, MonteCarlo) and not model.control else None
    each = np.zeros(len(share)) if plain is None else log_power_moments(law.degrees * plain.seeds)[1]
    sd = np.sqrt(each * np.maximum(1 - share**2, 0.0))
    simulated = sd[:, None] * law.correlation * sd
    measured = part.statistics.covariance
    p = np.asarray(target.proportional_power)
    spread = _spread_map(part, p)
    total = spread @ (measured + simulated) @ spread.T
    variation, mean = part.data.variation, part.data.mean
    rows = [] if variation is None else [1.0 + 0.25 * float(p @ simulated @ p) / float(variation[1]) ** 2]
    rows += [] if mean is None else [1.0]
    return np.block([[total, np.zeros((len(total), len(rows)))], [np.zeros((len(rows), len(total))), np.diag(rows)]])


def _spread_map(part: PartResiduals, p: np.ndarray) -> np.ndarray:
    """How the spectrum's residuals move with the log powers."""
    n = len(p)
    if part.residual == "log":
        return (np.eye(n) - 1 / n) / part.statistics.sd[:, None]
    if part.residual == "linear":
        return shares_map(p) / part.data.sigma[:, None]
    return (np.tril(np.ones((n, n))) @ shares_map(p) / part.data.sigma[:, None])[:-1]
