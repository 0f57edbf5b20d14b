"""Numbers that describe a force record and its spectrum: variability, regularity, peaks."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int, Real

from jaxmuscle._common.arguments import require
from jaxmuscle._common.arrays import all_concrete, as_arrays
from jaxmuscle._common.programs import kept

from ._fluctuations import one_record
from ._welch import Spectrum, floating

Counts = Int[np.ndarray, " _"]


def coefficient_of_variation(
    signal: Real[Array | np.ndarray, "*batch times"],
) -> Float[Array, "*batch"]:
    """Coefficient of variation, CV = σ / |μ|, along the last axis; differentiable.

        jm.spectra.coefficient_of_variation(5 + np.sin(np.arange(1000.0)))

    **Arguments:** `signal` in any unit, time along the last axis. σ divides by the number of
    samples.

    **Returns:** a fraction without unit, not a percentage; 0 for a constant signal, infinite for a
    zero mean.

    **Raises:** `ValueError` for a signal without samples.
    """
    signal = floating(signal)
    variance = jnp.var(signal, axis=-1)
    # The root has no derivative at zero; a constant signal gets zero instead of NaN.
    positive = variance > 0
    deviation = jnp.where(positive, jnp.sqrt(jnp.where(positive, variance, 1.0)), 0.0)
    return deviation / jnp.abs(jnp.mean(signal, axis=-1))


def _counts(
    x: Float[np.ndarray, " times"], m: int, radius: float
) -> tuple[Counts, Counts, Bool[np.ndarray, " templates"]]:
    """How many templates of m, and of m + 1 samples, match each of their kind, and which of those
    of m match the last."""
    n, order = x.size, np.argsort(x, kind="stable")
    ranks = np.empty(n, np.int32)
    ranks[order] = np.arange(n)
    low = np.searchsorted(x[order], x - radius).astype(np.int32)
    width = (np.searchsorted(x[order], x + radius, side="right") - low).astype(np.uint32)
    counts, last = np.zeros((m + 1, n), int), [np.zeros(n - k, bool) for k in range(m + 1)]
    for i in range(n):
        # those below the lower bound wrap around to large numbers: one comparison for both bounds
        near = (ranks - low[i]).view(np.uint32) < width[i]
        # which templates of k + 1 samples match the one that ends with sample i
        last = [near, *(last[k - 1][:-1] & near[k:] for k in range(1, m + 1))]
        counts[:, i] = [np.count_nonzero(match) for match in last]
    return counts[m - 1, m - 1 :], counts[m, m:], last[m - 1]


def regularity(
    signal: Real[Array | np.ndarray, "..."], m: int = 2, tolerance: float = 0.2
) -> tuple[float, float]:
    """`approximate_entropy` and `sample_entropy`, for which the templates are compared only
    once."""
    require(m >= 1, "m", m, "give the template length, at least 1")
    remedy = "give a positive fraction of the deviation"
    require(0 < tolerance < np.inf, "tolerance", tolerance, remedy)
    x = one_record(signal, m + 2, "m + 2 = ")
    shorter, longer, last = _counts(x, m, tolerance * float(np.std(x)))
    phi, phi_longer = (float(np.mean(np.log(count / len(count)))) for count in (shorter, longer))
    # those that begin with the last m samples, which none of m + 1 do, and each with itself
    b, a = int(np.sum(shorter[:-1] - 1) - np.sum(last[:-1])), int(np.sum(longer - 1))
    none = float("nan") if b == 0 else float("inf")
    return phi - phi_longer, none if a == 0 else float(np.log(b / a))


def approximate_entropy(
    signal: Real[Array | np.ndarray, "..."], m: int = 2, tolerance: float = 0.2
) -> float:
    """Approximate entropy, ApEn = Φ_m - Φ_{m+1}, of one record: low is regular. Not traceable.

        jm.spectra.approximate_entropy(np.sin(np.arange(1000.0)))

    Φ_m is the mean of ln C_i over the N - m + 1 templates of m successive samples. C_i is the
    fraction of templates, i itself included, whose samples all lie within r = `tolerance` σ of
    those of template i.

    **Arguments:** `signal` (times,) in any unit; template length `m`; `tolerance` as a fraction of
    σ.

    **Raises:** `ValueError` if the signal is constant, not finite, or has fewer than m + 2 samples.

    **Source:** Pincus 1991, doi:10.1073/pnas.88.6.2297.
    """
    return regularity(signal, m, tolerance)[0]


def sample_entropy(
    signal: Real[Array | np.ndarray, "..."], m: int = 2, tolerance: float = 0.2
) -> float:
    """Sample entropy, SampEn = ln(B / A), of one record: low is regular. Not traceable.

        jm.spectra.sample_entropy(np.sin(np.arange(1000.0)))

    B and A count the pairs of different templates, of m and of m + 1 successive samples and both
    starting in the first N - m samples, whose samples all lie within r = `tolerance` σ of each
    other.

    **Arguments:** `signal` (times,) in any unit; template length `m`; `tolerance` as a fraction of
    σ.

    **Returns:** the entropy; infinite if no longer templates match, NaN if no shorter ones do
    either.

    **Raises:** `ValueError` if the signal is constant, not finite, or has fewer than m + 2 samples.

    **Source:** Richman & Moorman 2000, doi:10.1152/ajpheart.2000.278.6.H2039.
    """
    return regularity(signal, m, tolerance)[1]


class Peak(eqx.Module):
    """One maximum of a spectrum.

    `bin` number, `frequency` of that bin [Hz], `interpolated` frequency [Hz], proportional `power`,
    and `prominence`, the height in proportional power above the higher of the two valleys beside
    it.
    """

    bin: int
    frequency: float
    interpolated: float
    power: float
    prominence: float


class Peaks(eqx.Module):
    """The `maximum` of a spectrum, wherever it lies, and the interior `local_maxima` by rising
    frequency.

    A maximum inside the range is one of the local maxima as well.
    """

    maximum: Peak
    local_maxima: tuple[Peak, ...]


def peaks(spectrum: Spectrum, *, min_prominence: float = 0.01) -> Peaks:
    """Global and local maxima of proportional power. Not traceable.

        spectrum = jm.expected_spectrum(jm.Isometric())
        jm.spectra.peaks(spectrum).maximum.frequency

    The interpolated frequency is the vertex of the parabola through the log power l of a bin and of
    its two neighbours, f_k + Δf (l_{k-1} - l_{k+1}) / (2 (l_{k-1} - 2 l_k + l_{k+1})). The
    prominence of a maximum is its height in proportional power above the higher of the two valleys
    beside it (the lowest bins between it and a higher maximum, or the end of the spectrum). A
    maximum in the first or last bin is no local maximum and is not interpolated; its prominence is
    its height above the lowest bin.

    **Arguments:** `spectrum` without leading axes; `min_prominence` of local maxima, relative to
    the maximum (by default 1 %: smaller ones are mostly the scatter of the estimate).

    **Returns:** `maximum` and `local_maxima` (by rising frequency), each with its number `bin` (k
    of `SpectrumSettings`, not the place in the array), `frequency` and `interpolated` frequency
    [Hz], proportional `power` and `prominence`.

    **Raises:** `ValueError` for leading axes, fewer than 3 bins, and power that is not finite or
    all zero, and under `jit`, `grad` and `vmap`: there use `peak_frequency`.
    """
    if not all_concrete(spectrum):
        raise ValueError(
            "spectrum: JAX is tracing it (inside jit, grad or vmap), and how many peaks it has is"
            " not known there. Use jaxmuscle.spectra.peak_frequency, which can be traced, or call"
            " peaks outside"
        )
    p = np.asarray(spectrum.proportional, dtype=float)
    remedy = "give one spectrum of 3 bins or more, as spectrum.mean()"
    require(p.ndim == 1 and p.size >= 3, "spectrum.power shape", p.shape, remedy)
    finite = np.all(np.isfinite(p))
    require(finite, "spectrum.power", spectrum.power, "give finite power, not all zero")
    share = 0 <= min_prominence <= 1
    require(share, "min_prominence", min_prominence, "give a fraction of the maximum")
    indices, found = scipy.signal.find_peaks(p, prominence=min_prominence * p.max())
    pairs = zip(indices, found["prominences"], strict=True)
    top = int(np.argmax(p))
    inside = 0 < top < p.size - 1
    height = scipy.signal.peak_prominences(p, [top])[0][0] if inside else p[top] - p.min()
    return Peaks(_peak(spectrum, p, top, height), tuple(_peak(spectrum, p, k, h) for k, h in pairs))


def peak_frequency(
    spectrum: Spectrum | tuple[Any, Any], low: float | None = None, high: float | None = None
) -> Float[Array, "*batch"]:
    """Frequency [Hz] of the highest peak of a spectrum; differentiable, also in `jit` and `vmap`.

        spectrum = jm.expected_spectrum(jm.Isometric())
        jm.spectra.peak_frequency(spectrum, 3.0, 6.0)  # the harmonic

        f_k + Δf (l_{k-1} - l_{k+1}) / (2 (l_{k-1} - 2 l_k + l_{k+1}))

    is the vertex of the parabola through the log power l of the largest bin k and its neighbours,
    at most half a bin away. Where k is the first or the last bin, where a neighbour is larger (the
    largest bin between `low` and `high` then lies at one end, and its peak beyond), and where a
    power of the three is 0, it is f_k itself, whose derivative is 0: then look between closer ends.
    The choice of k is not differentiated: where two bins are equal the frequency jumps. So it is a
    number to state, and no target to train on: for that take the log powers.

    **Arguments:** `spectrum`, a `Spectrum`, or a pair of frequencies [Hz] (bins,) and power
    (..., bins) in any unit; `low` and `high` [Hz]: only bins between them are looked at, ends
    included.

    **Returns:** one frequency for each spectrum. NaN where a power is NaN.

    **Raises:** `ValueError` for fewer than 3 bins, unequal shapes, and no bin between `low` and
    `high`.
    """
    frequency, power = (
        (spectrum.bins, spectrum.power) if isinstance(spectrum, Spectrum) else spectrum
    )
    shapes = np.shape(frequency), np.shape(power)
    fit = len(shapes[0]) == 1 and shapes[1][-1:] == shapes[0] and shapes[0][0] >= 3
    remedy = "give equally many of both along the last axis, 3 or more"
    require(fit, "shapes of frequency, power", shapes, remedy)
    ends = (-np.inf if low is None else low), (np.inf if high is None else high)
    if all_concrete((frequency, ends)):
        f = np.asarray(frequency)
        inside = np.any((f >= ends[0]) & (f <= ends[1]))
        remedy = f"give a band that holds a bin; they reach from {f[0]:.4g} to {f[-1]:.4g} Hz"
        require(bool(inside), "low, high", ends, remedy)
    return _peak_frequency(*as_arrays((frequency, power, *ends)))


@kept
def _peak_frequency(
    frequency: Float[Array, " bins"], power: Float[Array, "*batch bins"], low: Array, high: Array
) -> Float[Array, "*batch"]:
    def one(p: Float[Array, " bins"]) -> Float[Array, ""]:
        seen = jnp.where((frequency >= low) & (frequency <= high), p, -jnp.inf)
        k = jnp.argmax(jax.lax.stop_gradient(seen))
        at = jnp.clip(k, 1, len(p) - 2) + jnp.arange(-1, 2)
        away = jnp.where(at[1] == k, _vertex(frequency[at], p[at]), 0.0)
        return jnp.where(jnp.isnan(p[k]), jnp.nan, frequency[k] + away)

    return jax.vmap(one)(power.reshape(-1, len(frequency))).reshape(power.shape[:-1])


def _vertex(f: Any, power: Any) -> Any:
    """How far from the middle one of three bins the parabola through their log powers has its
    vertex; 0 where a neighbour is larger, or a power is 0."""
    xp = np if isinstance(power, np.ndarray) else jnp
    positive = power > 0
    left, middle, right = xp.log(xp.where(positive, power, 1.0))
    curvature = left - 2 * middle + right
    top = (middle >= left) & (middle >= right) & (curvature < 0) & xp.all(positive)
    # divided by another number where there is none: else the derivative would be NaN there
    return xp.where(top, (f[2] - f[0]) / 4 * (left - right) / xp.where(top, curvature, -1.0), 0.0)


def _peak(
    spectrum: Spectrum, p: Float[np.ndarray, " bins"], k: int | np.integer, prominence: float
) -> Peak:
    f, about = np.asarray(spectrum.frequency, dtype=float), slice(k - 1, k + 2)
    away = _vertex(f[about], p[about]) if 0 < k < p.size - 1 else 0.0
    number = round(f[k] / spectrum.settings.resolution)
    return Peak(number, *map(float, (f[k], f[k] + away, p[k], prominence)))
