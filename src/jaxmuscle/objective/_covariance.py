"""What the scatter of the data leaves undetermined: covariance of parameters, determined
directions, in words."""

import itertools
import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import block_diag

from jaxmuscle.data._target import Target
from jaxmuscle.spectra._bin_law import log_power_moments, welch_law
from jaxmuscle.spectra._settings import WINDOW

from ._moment_models import MonteCarlo
from ._residuals import PartResiduals

DETERMINED = 3.0
# of its prior variance is left of a direction that is just determined
REDUCED = 1 / (1 + DETERMINED**2)
FACTORS = 4
Vector = Float[np.ndarray, " parameters"]


class Identifiability(NamedTuple):
    """Directions (rows) of the parameters in prior standard deviations, and how steep the data are
    along each.

    `singular_values` are those of the data's Jacobian (residuals in standard deviations); of its
    prior variance `1 / (1 + σ²)` is left.
    """

    singular_values: Float[np.ndarray, " parameters"]
    directions: Float[np.ndarray, "parameters parameters"]

    @classmethod
    def of_covariance(
        cls, covariance: Float[np.ndarray, "parameters parameters"]
    ) -> "Identifiability":
        """From the covariance of the estimates in prior standard deviations: bins that correlate
        count for less."""
        left, vectors = np.linalg.eigh(covariance)
        return cls(np.sqrt(np.maximum(1 / np.maximum(left, 1e-300) - 1, 0.0)), vectors.T)

    @property
    def determined(self) -> Bool[np.ndarray, " parameters"]:
        """Which directions the data determine: singular values of at least 3."""
        return self.singular_values >= DETERMINED

    def left(self, slope: Vector) -> float:
        """Share of its prior variance that the data leave of a quantity with these slopes; 1 if it
        has none."""
        size = np.linalg.norm(slope)
        if not size > 0:
            return 1.0
        return float(
            np.sum((self.directions @ (slope / size)) ** 2 / (1 + self.singular_values**2))
        )

    def determines(self, slope: Vector) -> bool:
        """The one criterion, for parameters and for all that follows from them: at most a tenth of
        the variance is left."""
        return self.left(slope) <= REDUCED * (1 + 1e-9)

    @property
    def parameters(self) -> Bool[np.ndarray, " parameters"]:
        """Which parameters the data determine."""
        return np.array([self.determines(unit) for unit in np.eye(len(self.directions))])


def identifiability(jacobian: Float[np.ndarray, "residuals parameters"]) -> Identifiability:
    """Singular value decomposition of the data's Jacobian (residuals in standard deviations,
    parameters in prior ones)."""
    size = jacobian.shape[1]
    _, values, directions = np.linalg.svd(np.nan_to_num(jacobian), full_matrices=True)
    return Identifiability(np.concatenate([values, np.zeros(size - len(values))]), directions)


def parameter_covariance(
    jacobian: Float[np.ndarray, "residuals parameters"],
    residual_covariance: Float[np.ndarray, "residuals residuals"],
    prior_precision: Float[np.ndarray, "parameters parameters"],
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance `G (Jᵀ Σ J + Λ) G`, G = (Jᵀ J + Λ)⁻¹, of a penalised least-squares estimate about
    the truth.

    Scatter of the data plus the pull of the prior, averaged over truths drawn from it. Where the
    data determine a direction it is `J⁺ Σ J⁺ᵀ`; where they say nothing it is the prior.
    """
    gain = np.linalg.pinv(jacobian.T @ jacobian + prior_precision, hermitian=True)
    return gain @ (jacobian.T @ residual_covariance @ jacobian + prior_precision) @ gain


def effective_parameters(
    information: Float[np.ndarray, "parameters parameters"],
    prior_precision: Float[np.ndarray, "parameters parameters"],
) -> float:
    """`p = tr(F (F + Λ)⁻¹)`, F the Fisher information of the data: how many parameters they
    determine.

    Murata, Yoshizawa & Amari 1994, doi:10.1109/72.329683.
    """
    return float(
        np.trace(information @ np.linalg.pinv(information + prior_precision, hermitian=True))
    )


SCALES = (
    (
        (
            "all amplitudes of noise and harmonic can be multiplied by one number, and the fit"
            " stays as good"
        ),
        (
            "noise_K_w",
            "noise_K_z",
            "noise_P_w",
            "harmonic_amplitude",
            "resonance_amplitude",
            "resonance_2_amplitude",
        ),
    ),
    (
        (
            "all stiffness and damping can be multiplied by one number, and the fit stays as good:"
            " at most their ratios are known"
        ),
        ("k_w", "k_z", "c_w", "c_z"),
    ),
)


def common_scales(names: tuple[str, ...], found: Identifiability) -> tuple[str, ...]:
    """Which groups of parameters can be scaled together without the data noticing, in sentences.

    Of a joint fit, where "name@target" belongs to one target, each target's own groups and those
    that are shared.
    """
    sentences = []
    split = [name.partition("@") for name in names]
    for target in dict.fromkeys(of for _, _, of in split):
        for sentence, members in SCALES:
            group = np.array(
                [base in members and of in ("", target) for base, _, of in split], dtype=float
            )
            size = np.linalg.norm(group)
            if (
                size > 1
                and np.linalg.norm(found.singular_values * (found.directions @ group))
                < DETERMINED * size
            ):
                sentences.append(sentence + (f" ({target})" if target else ""))
    return tuple(dict.fromkeys(sentences))


def known_products(
    names: tuple[str, ...],
    positive: Bool[np.ndarray, " parameters"],
    sd: Vector,
    found: Identifiability,
) -> dict[str, Vector]:
    """The simplest products and ratios of parameters that the data determine, as many as there are
    such directions.

    By name ("k_w / c_w"), with the slopes of their logarithms with respect to θ. Fewest factors
    first, then in the order of the parameters: so equal data give equal words, which the directions
    themselves, turned by rounding, do not. `sd` are the prior's, `positive` the parameters whose
    logarithm is meant.
    """
    wanted = int(found.determined.sum())
    chosen: dict[str, Vector] = {}
    taken: list[set[int]] = []
    inside = np.zeros((0, wanted))
    known = found.directions[found.determined]
    for factors in range(1, min(FACTORS, len(names)) + 1):
        for which in itertools.combinations(range(len(names)), factors):
            # A factor that is known already would only thin out what is not.
            if any(held <= set(which) for held in taken) or (
                factors > 1 and not np.all(positive[list(which)])
            ):
                continue
            for signs in itertools.product((-1.0, 1.0), repeat=factors - 1):
                if len(chosen) == wanted:
                    return chosen
                slope = np.zeros(len(names))
                slope[list(which)] = np.array([1.0, *signs]) * sd[list(which)]
                seen = known @ (slope / np.linalg.norm(slope))
                rest = seen - inside.T @ (inside @ seen) if len(inside) else seen
                if found.determines(slope) and rest @ rest > 0.1 * (seen @ seen):
                    chosen[_written([names[i] for i in which], signs)] = slope
                    taken.append(set(which))
                    inside = np.concatenate([inside, rest[None] / np.linalg.norm(rest)])
    return chosen


def _written(names: list[str], signs: tuple[float, ...]) -> str:
    above = [names[0], *(n for n, sign in zip(names[1:], signs, strict=True) if sign > 0)]
    below = [n for n, sign in zip(names[1:], signs, strict=True) if sign < 0]
    bottom = " ".join(below)
    return " ".join(above) + (f" / {f'({bottom})' if len(below) > 1 else bottom}" if below else "")


def spelt(product: str) -> str:
    """A product as it is printed: `k_w * noise_K_w`."""
    return re.sub(r"(?<=\w) (?=\w)", " * ", product)


def residual_covariance(target: Target, part: PartResiduals, share: np.ndarray) -> np.ndarray:
    """Covariance of one target's data residuals: scatter of the target and of the simulated
    mean."""
    variation, rows = part.data.variation, np.ones(part.data.further)
    if not len(target.bins):
        return np.diag(rows)
    start, stop = WINDOW
    per_seed = target.settings.segments(round((stop - start) * target.settings.rate))
    law = welch_law(target.settings, target.bins, (per_seed,))
    # A linear response has no sampling error, and a control variate leaves next to nothing of it.
    model = part.model
    plain = model if isinstance(model, MonteCarlo) and not model.control else None
    each = (
        np.zeros(len(share)) if plain is None else log_power_moments(law.degrees * plain.seeds)[1]
    )
    sd = np.sqrt(each * np.maximum(1 - share**2, 0.0))
    simulated = sd[:, None] * law.correlation * sd
    measured = part.statistics.covariance
    p = np.asarray(target.proportional_power)
    # how the residuals of the spectrum move with the log powers
    spread = (np.eye(len(p)) - 1 / len(p)) / part.statistics.sd[:, None]
    total = spread @ (measured + simulated) @ spread.T
    if variation is not None:
        rows[0] += 0.25 * float(p @ simulated @ p) / float(variation[1]) ** 2
    return np.asarray(block_diag(total, np.diag(rows)))
