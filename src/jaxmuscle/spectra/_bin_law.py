"""The sampling law of Welch bins: bias, spread, correlation."""

import functools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.special import digamma, polygamma

from ._settings import LONGEST, WINDOW, SpectrumSettings, samples_in


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


def standardised(
    target_power: Float[np.ndarray, " bins"], fitted: Float[np.ndarray, " bins"], statistics: BinStatistics
) -> Float[np.ndarray, " bins"]:
    """`(z_k - z̄) / sd_k` with `z_k = ln(target_k / fitted_k) - bias_k`."""
    z = np.log(target_power) - np.log(fitted) - statistics.bias
    return (z - z.mean()) / statistics.sd


def shares_map(p: Float[np.ndarray, " bins"]) -> Float[np.ndarray, "bins bins"]:
    """Derivative of proportional powers with respect to log powers, `diag(p) - p pᵀ`."""
    return np.diag(p) - np.outer(p, p)


class BinLaw(NamedTuple):
    """Sampling law of Welch powers: equivalent degrees of freedom ν of every bin, and the correlation of bins."""

    degrees: Float[np.ndarray, " bins"]
    correlation: Float[np.ndarray, "bins bins"]


def welch_law(settings: SpectrumSettings, bins: np.ndarray, segments: tuple[int, ...]) -> BinLaw:
    """Law of Welch powers for a density that is flat within a segment's resolution, detrending and both signs of f included.

    `Cov(S_k, S_l) = Σ_j (1 - |j|/K)/K (|E X_k X_l*|² + |E X_k X_l|²)` over segments j apart, X the tapered, detrended
    transform; ν_k = 2 E_k² / Var_k. Trials are averaged with weights proportional to their segments.
    Removing the mean and leakage from negative frequencies cost bin 1 a fifth of its degrees of freedom.
    """
    rows = bin_rows(settings)[np.asarray(bins) - settings.first_bin]
    n, step = settings.length, settings.step
    power = np.sum(np.abs(rows) ** 2, axis=1)
    covariance = np.zeros((len(rows), len(rows)))
    for count in segments:
        reach = min(count - 1, (n - 1) // step)
        for j in range(-reach, reach + 1):
            near, far = (rows[:, abs(j) * step :], rows[:, : n - abs(j) * step])[:: 1 if j >= 0 else -1]
            both = np.abs(near @ far.conj().T) ** 2 + np.abs(near @ far.T) ** 2
            covariance += count * (1 - abs(j) / count) / sum(segments) ** 2 * both
    sd = np.sqrt(np.diag(covariance))
    return BinLaw(2 * power**2 / sd**2, covariance / np.outer(sd, sd))


@functools.cache
def bin_rows(settings: SpectrumSettings) -> Complex[np.ndarray, "bins length"]:
    """Detrending, taper and transform of a segment as one matrix: X_k = Σ_m a_km x_m, scaled so that power is |X_k|²."""
    n, m = settings.length, np.arange(settings.length)
    k = np.arange(settings.first_bin, settings.last_bin + 1)
    sides = np.where((k == 0) | (2 * k == n), 1.0, 2.0)
    rows = settings.taper * np.exp(-2j * np.pi * np.outer(k, m) / n)
    rows = rows * np.sqrt(sides / (settings.rate * np.sum(settings.taper**2)))[:, None]
    if settings.detrend != "none":
        rows = rows - rows.mean(axis=1, keepdims=True)
    if settings.detrend == "linear":
        line = m - m.mean()
        rows = rows - np.outer(rows @ line, line) / (line @ line)
    return rows
