"""How much a spectrum scatters, and what that leaves undetermined: bin statistics, standard errors, identifiability."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.special import digamma, polygamma

from ._expected import LONGEST, WINDOW, log_variation_sd, samples_in
from ._parameter import as_arrays, is_concrete
from ._spectrum import SpectrumSettings
from ._target import Target
from ._task import AbstractTask

DETERMINED = 3.0
SHARE_DETERMINED = 0.99


class BinStatistics(NamedTuple):
    """Sampling law of a target's log powers: expected offset `bias`, standard deviation `sd`, `correlation` of bins."""

    bias: Float[np.ndarray, " bins"]
    sd: Float[np.ndarray, " bins"]
    correlation: Float[np.ndarray, "bins bins"]
    known: bool

    @property
    def covariance(self) -> Float[np.ndarray, "bins bins"]:
        """Covariance of the log powers."""
        return self.sd[:, None] * self.correlation * self.sd


def log_power_moments(degrees_of_freedom: float) -> tuple[float, float]:
    """Bias `ψ(ν/2) - ln(ν/2)` and variance `ψ'(ν/2)` of the log of a chi-squared estimate with ν degrees of freedom."""
    half = degrees_of_freedom / 2
    return float(digamma(half) - np.log(half)), float(polygamma(1, half))


def bin_correlation(
    settings: SpectrumSettings, bins: np.ndarray, segments: tuple[int, ...]
) -> Float[np.ndarray, "bins bins"]:
    """Correlation of Welch powers of neighbouring bins of a locally flat spectrum.

    `Σ_j (1 - |j|/K) |ρ_j(δ)|²` over segment distances j, normalised at δ = 0, with
    `ρ_j(δ) = Σ_m w_m w_(m + jD) exp(-2πi δ m / n) / Σ w²`, D the step between segments. Hann, half overlap: 0.45, 0.04.
    """
    window = settings.taper
    n, step = settings.length, settings.step
    distance = np.abs(np.asarray(bins)[:, None] - np.asarray(bins)[None, :])
    lags = np.arange(distance.max() + 1)
    total = np.zeros(len(lags))
    for count in segments:
        for j in range(-min(count - 1, (n - 1) // step), min(count - 1, (n - 1) // step) + 1):
            shift = abs(j) * step
            product = window[: n - shift] * window[shift:]
            phase = np.exp(-2j * np.pi * np.outer(lags, np.arange(n - shift)) / n)
            total += count * (1 - abs(j) / count) * np.abs(phase @ product) ** 2
    return (total / total[0])[distance]


def bin_statistics(target: Any, line_share: Float[np.ndarray, " bins"] | None = None) -> BinStatistics:
    """Statistics of a target's log powers: from its segments, else from its sigma, else unknown (sd 1).

    A harmonic line that holds the share ρ of a bin does not scatter: bias and variance fall by 1 - ρ².
    """
    n = len(target.bins)
    nu = target.degrees_of_freedom
    if nu is not None:
        assert target.segments is not None
        bias, variance = log_power_moments(nu)
        keep = np.maximum(1 - (np.zeros(n) if line_share is None else line_share) ** 2, 1e-3)
        correlation = bin_correlation(target.settings, target.bins, target.segments)
        return BinStatistics(bias * keep, np.sqrt(variance * keep), correlation, True)
    if target.sigma is not None:
        sd = np.sqrt(np.log1p((target.sigma / target.proportional_power) ** 2))
        return BinStatistics(np.zeros(n), sd, np.eye(n), True)
    return BinStatistics(np.zeros(n), np.ones(n), np.eye(n), False)


def samples_of(segments: int, settings: SpectrumSettings) -> int:
    """Samples of a recording with so many Welch segments: half a step more than these take, on the average."""
    return min(settings.length - settings.step // 2 + segments * settings.step, LONGEST)


def trial_samples(target: Any) -> int:
    """Samples of a trial of a target, the average of several; of 10 s where it states no segments."""
    if target.segments is None:
        return samples_in(WINDOW, target.settings)
    return round(np.mean([samples_of(k, target.settings) for k in target.segments]))


def target_variation(target: Target, task: AbstractTask | None = None) -> tuple[Any, Any] | None:
    """Log coefficient of variation of a target and its standard deviation.

    With a task and where the target states its segments: `log_variation_sd` of recordings that give so many. Else half the
    relative error of the power in the bins, `½ √(pᵀ V p)` with V the covariance of the log powers, which is too much where
    power lies elsewhere or in a harmonic. The standard error over trials where there are several and it is larger.
    """
    values = target.coefficient_of_variation
    if values is None:
        return None
    logs = np.log(np.asarray(values))
    p = np.asarray(target.proportional_power)
    sd: Any = 0.5 * np.sqrt(p @ bin_statistics(target).covariance @ p)
    if task is not None and target.segments is not None:
        settings, counts, arrays = target.settings, target.segments, as_arrays(task)
        each = {k: log_variation_sd(arrays, settings, samples_of(k, settings)) for k in set(counts)}
        sd = sum(each[k] ** 2 for k in counts) ** 0.5 / len(counts)
    if len(logs) > 1:
        sd = jnp.maximum(sd, logs.std(ddof=1) / np.sqrt(len(logs)))
    return float(logs.mean()), float(sd) if is_concrete(sd) else sd


def standardised(
    target_power: Float[np.ndarray, " bins"], fitted: Float[np.ndarray, " bins"], statistics: BinStatistics
) -> Float[np.ndarray, " bins"]:
    """`(z_k - z̄) / sd_k` with `z_k = ln(target_k / fitted_k) - bias_k`."""
    z = np.log(target_power) - np.log(fitted) - statistics.bias
    return (z - z.mean()) / statistics.sd


def shares_map(p: Float[np.ndarray, " bins"]) -> Float[np.ndarray, "bins bins"]:
    """Derivative of proportional powers with respect to log powers, `diag(p) - p pᵀ`."""
    return np.diag(p) - np.outer(p, p)


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
