"""The sampling law of Welch bins: bias, spread, correlation."""

import functools
from collections import Counter
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float
from scipy.special import digamma, gammaincinv, ndtr, polygamma, stdtrit

from jaxmuscle._common.arrays import is_concrete

from ._decimation import LEAST_RATES
from ._settings import LONGEST, WINDOW, SpectrumSettings, samples_in, tapers_of

LEAST = 1e-3  # share of a bin that scatters, at least
ENOUGH = 3  # trials, for their scatter to say what the error of their mean is
NORMAL = 1.96  # standard errors to either side that hold 95 %


Bins = Float[np.ndarray, " bins"]
BinMatrix = Float[np.ndarray, "bins bins"]
BinRows = Float[np.ndarray, "*rows bins"]


class BinLaw(NamedTuple):
    """Sampling law of Welch powers: equivalent degrees of freedom ν of every bin, and the
    correlation of bins."""

    degrees: Bins
    correlation: BinMatrix


def welch_law(settings: SpectrumSettings, bins: np.ndarray, segments: tuple[int, ...]) -> BinLaw:
    """Law of Welch powers for a density that is flat within a segment's resolution, detrending and
    both signs of f included.

    `Cov(S_k, S_l) = Σ_j (1 - |j|/K)/K Σ_tu (|E X_kt X_lu*|² + |E X_kt X_lu|²)` over segments j
    apart and tapers t, u, X the tapered, detrended transform; ν_k = 2 E_k² / Var_k. Trials are
    averaged with weights proportional to their segments. Removing the mean and leakage from
    negative frequencies cost bin 1 a fifth of its degrees of freedom.
    """
    return _welch_law(settings, tuple(int(k) for k in bins), tuple(segments))


@functools.lru_cache(maxsize=256)
def _welch_law(
    settings: SpectrumSettings, bins: tuple[int, ...], segments: tuple[int, ...]
) -> BinLaw:
    rows = bin_rows(settings)[np.asarray(bins) - settings.first_bin]
    n, step, shape = settings.length, settings.step, rows.shape[:2]
    power = np.sum(np.abs(rows) ** 2, axis=(1, 2))
    covariance, rows = np.zeros((len(rows), len(rows))), rows.reshape(-1, n)
    for count, trials in Counter(segments).items():
        reach = min(count - 1, (n - 1) // step)
        for j in range(reach + 1):
            later, earlier = rows[:, j * step :], rows[:, : n - j * step]
            both = np.abs(later @ earlier.conj().T) ** 2 + np.abs(later @ earlier.T) ** 2
            both = both.reshape(shape * 2).sum(axis=(1, 3))
            # segments j before are those j after, with the bins exchanged
            both = both + both.T if j else both
            covariance += trials * count * (1 - j / count) / sum(segments) ** 2 * both
    sd = np.sqrt(np.diag(covariance))
    return BinLaw(2 * power**2 / sd**2, covariance / np.outer(sd, sd))


def draw_powers(
    law: BinLaw, count: int, rng: np.random.Generator
) -> Float[np.ndarray, "count bins"]:
    """Random powers about 1 of that law: chi-squared, normal scores with the correlation of the
    bins."""
    half = law.degrees / 2
    scores = rng.standard_normal((count, len(half))) @ np.linalg.cholesky(law.correlation).T
    return gammaincinv(half, ndtr(scores)) / half


def target_law(target: Any) -> BinLaw:
    """`welch_law` of a target's bins; where its trials scatter more than their segments explain,
    with fewer degrees."""
    law = welch_law(target.settings, target.bins, target.segments)
    return law._replace(degrees=law.degrees / target.overdispersion**2)


def dispersion_of(
    power: Float[np.ndarray, "trials bins"],
    segments: tuple[int, ...],
    settings: SpectrumSettings,
    bins: np.ndarray,
) -> tuple[float, float]:
    """How many times more the mean of several trials' spectra scatters than their segments explain,
    and its standard error.

    The mean S is weighted with the segments K_i, so that trial i, whose power is a_i times the
    mean's, has the share `s_i = K_i a_i / Σ K a` in it. Two things make S scatter more than
    `welch_law` says:

        d² = Σ_i s_i² |D⁻¹ C r_i|² / Σ_i E_i  ·  ΣK Σ_i s_i² / K_i,      r_ik = P_ik / (a_i S_k) - 1

    The second factor is that of unequal power, since the strongest trials outweigh the others. The
    first is how the shapes differ: V is the law's covariance of the log powers of S, D its standard
    deviations, C = 1 - 1/n takes out what all bins have in common, and `E_i = ΣK s_i² ((1 - 2 s_i)
    / K_i + Σ_j s_j² / K_j) tr A`, A = D⁻¹ C V C D⁻¹, is what it expects. The standard error is the
    larger of the law's own and that by the scatter of the trials' contributions.
    """
    law = welch_law(settings, bins, segments)
    sd, counts = np.sqrt(2 / law.degrees), np.asarray(segments)
    ratio = power / np.average(power, axis=0, weights=counts)
    size = ratio.mean(axis=1)
    s = counts * size / np.sum(counts * size)
    centre = (np.eye(len(sd)) - 1 / len(sd)) / sd[:, None]
    a = centre @ (sd[:, None] * law.correlation * sd) @ centre.T
    each = s**2 * np.sum(((ratio / size[:, None] - 1) @ centre.T) ** 2, axis=1)
    if not np.any(each > 0):  # the same trial twice
        return 0.0, 0.0
    expected = (
        counts.sum() * np.trace(a) * np.sum(s**2 * ((1 - 2 * s) / counts + np.sum(s**2 / counts)))
    )
    value = np.sqrt(np.sum(each) / expected * counts.sum() * np.sum(s**2 / counts))
    effective = max(1 / np.sum(s**2) - 1, 0.5)
    by_law = np.sqrt(2 * np.sum(a**2) / effective) / np.trace(a)
    by_trials = np.sqrt(len(each)) * np.std(each, ddof=1) / np.sum(each)
    return float(value), float(value * max(by_law, by_trials) / 2)


def student(count: int) -> float:
    """How many standard errors, by the scatter of so many values, to either side of their mean hold
    95 % (Student's t)."""
    return float(stdtrit(count - 1, 0.975))


def mean_error(values: Float[Array | np.ndarray, " trials"], expected: Any) -> Any:
    """The error of a mean over trials: the `expected` one, or that by their scatter where this is
    larger.

    The scatter of a few values is uncertain itself. So of three trials or more it is multiplied by
    t / 1.96, with Student's t: then ± 1.96 of it hold 95 %. Of two it would be 6.5 times as much,
    so that the mean told nothing.
    """
    count = len(values)
    if count < 2:
        return expected
    concrete = is_concrete(values) and is_concrete(expected)
    scatter = (np if is_concrete(values) else jnp).std(values, ddof=1) / np.sqrt(count)
    stated = scatter * (student(count) / NORMAL if count >= ENOUGH else 1.0)
    return (np if concrete else jnp).where(scatter > expected, stated, expected)


class BinStatistics(NamedTuple):
    """Sampling law of a target's log powers: expected offset `bias`, standard deviation `sd`,
    `correlation` of bins.

    `half` is half the degrees of freedom of every bin, NaN where no segments are stated. All but
    `correlation` have leading axes where the line's share had.
    """

    bias: BinRows
    sd: BinRows
    correlation: BinMatrix
    half: BinRows
    known: bool

    @property
    def covariance(self) -> BinMatrix:
        """Covariance of the log powers."""
        return self.sd[:, None] * self.correlation * self.sd


def log_power_moments(degrees_of_freedom: Any) -> tuple[Any, Any]:
    """Bias `ψ(ν/2) - ln(ν/2)` and variance `ψ'(ν/2)` of the log of a chi-squared estimate with ν
    degrees of freedom."""
    half = np.asarray(degrees_of_freedom) / 2
    return digamma(half) - np.log(half), polygamma(1, half)


def bin_statistics(target: Any, line_share: BinRows | None = None) -> BinStatistics:
    """Statistics of a target's log powers: from its segments by `welch_law`, else from its sigma,
    else unknown (sd 1).

    A harmonic line that holds the share ρ of a bin does not scatter: it has 1 / (1 - ρ²) times the
    degrees of freedom.
    """
    n = len(target.bins)
    share = np.zeros(n) if line_share is None else np.asarray(line_share)
    bias, sd, correlation, known = np.zeros(share.shape), np.ones(share.shape), np.eye(n), n == 0
    half = np.full(share.shape, np.nan)
    if target.segments is not None:
        law, known = target_law(target), True
        degrees = law.degrees / np.maximum(1 - share**2, LEAST)
        bias, variance = log_power_moments(degrees)
        sd, correlation, half = np.sqrt(variance), law.correlation, degrees / 2
    elif target.sigma is not None:
        variance = np.log1p((target.sigma / target.proportional_power) ** 2)
        sd, known = np.broadcast_to(np.sqrt(variance), share.shape), True
    return BinStatistics(bias, sd, correlation, half, known)


def samples_of(segments: int, settings: SpectrumSettings) -> int:
    """Samples of a recording with so many Welch segments: half a step more than these take, on the
    average."""
    return min(settings.length - settings.step // 2 + segments * settings.step, LONGEST)


def samples_of_trials(target: Any) -> list[int]:
    """Samples of each trial of a target; of 10 s where it states no segments."""
    if target.segments is None:
        return [samples_in(WINDOW, target.settings)]
    return [samples_of(count, target.settings) for count in target.segments]


def trial_samples(target: Any) -> int:
    """Samples of a trial of a target, the average of several."""
    return round(np.mean(samples_of_trials(target)))


def recorded_interval(data: Any, settings: SpectrumSettings) -> float:
    """Interval [s] at which a target or recording was sampled first, whose aliases its spectrum
    has; 0 where it has none."""
    rate = data.recorded_at
    return 0.0 if rate is None or rate < LEAST_RATES * settings.rate else 1 / rate


def standardised(
    target_power: Bins,
    fitted: Bins,
    statistics: BinStatistics,
) -> Bins:
    """`(z_k - z̄) / sd_k` with `z_k = ln(target_k / fitted_k) - bias_k`."""
    z = np.log(target_power) - np.log(fitted) - statistics.bias
    if not z.size:
        return z
    return (z - z.mean()) / statistics.sd


def sides_of(settings: SpectrumSettings) -> Bins:
    """How often a bin counts, once or for both signs of its frequency, over the rate [1/Hz]."""
    k = np.arange(settings.first_bin, settings.last_bin + 1)
    return np.where((k == 0) | (2 * k == settings.length), 1.0, 2.0) / settings.rate


@functools.cache
def bin_rows(settings: SpectrumSettings) -> Complex[np.ndarray, "bins tapers length"]:
    """Detrending, tapers and transform of a segment as one matrix: X_kt = Σ_m a_ktm x_m, so that
    power is Σ_t |X_kt|²."""
    n, m = settings.length, np.arange(settings.length)
    k = np.arange(settings.first_bin, settings.last_bin + 1)
    turns = np.exp(-2j * np.pi * np.outer(k, m) / n) * np.sqrt(sides_of(settings))[:, None]
    rows = turns[:, None] * tapers_of(settings, n)
    if settings.detrend != "none":
        rows = rows - rows.mean(axis=-1, keepdims=True)
    if settings.detrend == "linear":
        line = m - m.mean()
        rows = rows - (rows @ line)[..., None] * line / (line @ line)
    return rows
