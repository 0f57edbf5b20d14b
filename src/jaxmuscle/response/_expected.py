"""The expected Welch spectrum of a task in linear response, in closed form."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._noise import ShapingFilter
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._bin_law import bin_rows
from jaxmuscle.spectra._settings import LONGEST, WINDOW, SpectrumSettings, samples_in
from jaxmuscle.spectra._welch import Spectrum

from ._harmonic_line import harmonic_line
from ._linearised import Linearisation, linearise

TAIL = 1e-13


class Moments(NamedTuple):
    """What a fit compares: Welch power per bin, that of the harmonic alone, mean and variance of a recording.

    The variance is that of the low-passed output, as a recording's: what lies above the low-pass is not in it. `rate` is
    the slowest of the operating point [1/s], where that was computed.
    """

    power: Float[Array | np.ndarray, " bins"]
    line: Float[Array | np.ndarray, " bins"]
    mean: Float[Array | np.ndarray, ""]
    variance: Float[Array | np.ndarray, ""]
    rate: Float[Array | np.ndarray, ""] | float = np.nan

    @property
    def proportional(self) -> Float[Array | np.ndarray, " bins"]:
        """Proportional power on the compared bins."""
        return self.power / self.power.sum()

    @property
    def variation(self) -> Scalar:
        """Coefficient of variation."""
        return self.variance**0.5 / abs(self.mean)


def _sylvester(A: Array, F: Array, Q: Array) -> Array:
    """X with `A X + X Fᵀ + Q = 0`; a leading axis of Q is a batch with the same matrices."""
    n, m = A.shape[0], F.shape[0]
    both = jnp.kron(A, jnp.eye(m, dtype=A.dtype)) + jnp.kron(jnp.eye(n, dtype=A.dtype), F)
    right = -Q.reshape(-1, n * m).T
    return jnp.linalg.solve(both, right).T.reshape(Q.shape)


class _Covariances(NamedTuple):
    """A linear system without input whose output from `start` is the autocovariance: `r(s) = row exp(matrix s) start`."""

    matrix: Float[Array, "all all"]
    row: Float[Array, " all"]
    start: Float[Array, " all"]


def _covariances(task: AbstractTask, system: Linearisation) -> _Covariances:
    """The stationary response to the noise, its filters as further states."""
    scale = task.noise_scale()
    b, d, e = (x * scale for x in (system.B, system.D, system.E))
    if task.noise.shared:
        b, d, e = b.sum(-1, keepdims=True), d.sum(keepdims=True), e.sum(keepdims=True)
    made: ShapingFilter = jax.tree.map(lambda x: x.astype(b.dtype), task.noise.shaping_filter())
    F, G, H, L = made.F, made.G, made.H, made.L
    A, C, n, size, k = system.A, system.C, len(system.A), len(F), d.shape[0]
    seen = d[:, None] * H + e[:, None] * (H @ F if size else H)
    if size:
        own = _sylvester(F, F, G @ G.T)
        drive = jnp.einsum("nk,s->kns", b, own @ H + G @ L)
        cross = _sylvester(A, F, drive)
        fed = jnp.einsum("kns,s,mk->nm", cross, H, b)
    else:
        own, cross, fed = jnp.zeros((0, 0), b.dtype), jnp.zeros((k, n, 0), b.dtype), jnp.zeros((n, n), b.dtype)
    inner = _sylvester(A, A, fed + fed.T + (L @ L) * b @ b.T)
    start_y = inner @ C + jnp.einsum("kns,ks->n", cross, seen)
    start_q = jnp.einsum("kns,n->ks", cross, C) + seen @ own
    top = jnp.concatenate([A, jnp.einsum("nk,s->nks", b, H).reshape(n, k * size)], axis=1)
    bottom = jnp.concatenate([jnp.zeros((k * size, n), b.dtype), jnp.kron(jnp.eye(k, dtype=b.dtype), F)], axis=1)
    return _Covariances(
        jnp.concatenate([top, bottom]),
        jnp.concatenate([C, seen.reshape(-1)]),
        jnp.concatenate([start_y, start_q.reshape(-1)]),
    )


class _Autocovariance(NamedTuple):
    """r of the sampled output: r(0), and `r(lΔ) = row powers[0]^(l-1) next` beyond; powers[k] = powers[0]^(2^k)."""

    zero: Float[Array, ""]
    row: Float[Array, " all"]
    powers: Float[Array, "doublings all all"]
    next: Float[Array, " all"]

    def lagged(self, lags: int) -> Float[Array, " lags"]:
        """r at lags 0, Δ, 2Δ ...: from few steps to the right and few long ones to the left, which meet in one product."""
        short = (lags.bit_length() + 1) // 2
        columns, rows = self.next[:, None], self.row[None]
        for power in self.powers[:short]:
            columns = jnp.concatenate([columns, power @ columns], axis=1)
        for power in self.powers[short:]:
            if len(rows) * columns.shape[1] >= lags - 1:
                break
            rows = jnp.concatenate([rows, rows @ power])
        return jnp.concatenate([self.zero[None], (rows @ columns).reshape(-1)])[:lags]

    def mean_variance(self, samples: Int[Array | np.ndarray, ""] | int) -> Float[Array, ""]:
        """Variance of the mean of that many successive samples, `Σ_l 2 (n - l) / n² r(lΔ) + r(0) / n`, l = 1 ... n - 1.

        Sums of `Φ^m v` and of `m Φ^m v` double their length from power to power; a block counts if its bit of n - 1 is set.
        """
        n, count, zero = jnp.asarray(samples, self.row.dtype), jnp.asarray(samples) - 1, jnp.zeros_like(self.next)

        def double(sums: Array, block: tuple[Array, Array]) -> tuple[Array, None]:
            power, bit = block
            sum_all, rise_all, sum_here, rise_here = sums
            length = (2**bit).astype(n.dtype)
            moved = jnp.stack([rise_all + length * sum_all, sum_all, rise_here + length * sum_here, sum_here]) @ power.T
            counts = (count >> bit) % 2 == 1  # this block, then what is there already
            both = jnp.stack([sum_here + moved[1], rise_here + moved[0]])
            return jnp.concatenate([jnp.where(counts, both, sums[:2]), sums[2:] + moved[:1:-1]]), None

        bits = jnp.arange(len(self.powers), dtype=count.dtype)
        sums, _ = jax.lax.scan(double, jnp.stack([zero, zero, self.next, zero]), (self.powers, bits))
        return self.zero / n + 2 / n**2 * self.row @ ((n - 1) * sums[0] - sums[1])


def _autocovariance(system: _Covariances, interval: float, lags: int, sampling: str) -> _Autocovariance:
    """Autocovariance of the sampled output, good for that many lags; not finite where it does not decay."""
    matrix, row, start = system
    if sampling == "average":
        # Means over the interval: r(0) = 2/Δ² c ∫(Δ-s) e^(Ms) ds v and r(lΔ) = c J Φ^(l-1) J v / Δ², J = ∫ e^(Ms) ds.
        n = len(matrix)
        zero, eye = jnp.zeros_like(matrix), jnp.eye(n, dtype=matrix.dtype)
        blocks = jnp.block([[matrix * interval, eye, zero], [zero, zero, eye], [zero, zero, zero]])
        whole = jax.scipy.linalg.expm(blocks)
        step, mean, ramp = whole[:n, :n], whole[:n, n : 2 * n], whole[:n, 2 * n :]
        first, row, following = 2 * row @ ramp @ start, row @ mean, mean @ start
    else:
        step = jax.scipy.linalg.expm(matrix * interval)
        first, following = row @ start, step @ start
    count = (lags - 1).bit_length() + 1
    _, powers = jax.lax.scan(lambda power, _: (power @ power, power), step, length=count)
    # The last power carries an unstable system beyond any bound: no stationary covariance, so none is returned.
    stable = jnp.max(jnp.abs(powers[-1])) < 1e3
    return _Autocovariance(jnp.where(stable, first, jnp.nan), row, powers, jnp.where(stable, following, jnp.nan))


@functools.cache
def low_pass_spread(settings: SpectrumSettings) -> Float[np.ndarray, " lags"]:
    """ρ, the autocorrelation of the low-pass's impulse response at lags -m ... m: it turns r into `r * ρ`."""
    if settings.sections is None:
        return np.ones(1)
    impulse = scipy.signal.sosfilt(settings.sections, np.eye(1, 64 * settings.length)[0])
    spread = scipy.signal.correlate(impulse, impulse, method="fft")
    if settings.filter_direction == "both":
        spread = scipy.signal.correlate(spread, spread, method="fft")
    centre = len(spread) // 2
    reach = int(np.max(np.flatnonzero(np.abs(spread) > TAIL * np.abs(spread).max())) - centre)
    return spread[centre - reach : centre + reach + 1]


@functools.cache
def covariance_operator(settings: SpectrumSettings) -> Float[np.ndarray, "bins_and_two lags"]:
    """M with expected Welch power `E_k = Σ_l M_kl r(l Δ)`: low-pass, detrending, taper and transform.

    The low-pass turns r into `r * ρ` (`low_pass_spread`); a bin is `Σ_l α_k(l) r(l)`, α_k the autocorrelation of its row of
    `bin_rows`. Both are folded onto lags l >= 0. Two more rows: the variance of what has passed, (r * ρ)(0); and
    `Σ_l ((|·| * ρ)(l) - |l|) r(l)`, by which the low-pass lowers n² times the variance of the mean of n samples
    (`Σ_l (n - |l|) / n² r(l)` without it; where r has decayed at the n-th lag).
    """
    rows, spread = bin_rows(settings), low_pass_spread(settings)
    lagged = np.array([scipy.signal.correlate(row, row, method="fft").real for row in rows])
    lagged = np.concatenate([lagged, np.eye(1, lagged.shape[1], lagged.shape[1] // 2)])
    full = np.array([scipy.signal.convolve(row, spread, method="fft") for row in lagged])
    centre, reach = full.shape[1] // 2, len(spread) // 2
    lag = np.arange(-2 * reach, 2 * reach + 1)
    lowered = np.convolve(np.abs(lag), spread, mode="valid") - np.abs(lag[reach : lag.size - reach])
    full = np.concatenate([full, np.pad(lowered, centre - reach)[None]])
    folded = full[:, centre:].copy()
    folded[:, 1:] += full[:, centre - 1 :: -1]
    return folded


def noise_response(
    task: AbstractTask, system: Linearisation, settings: SpectrumSettings, samples: Int[Array | np.ndarray, ""] | int
) -> tuple[Float[Array, " bins"], Float[Array, ""]]:
    """Expected Welch power, and variance of so many low-passed samples about their mean, without the harmonic."""
    operator = covariance_operator(settings)
    lags = operator.shape[1]
    r = _autocovariance(_covariances(task, system), 1 / settings.rate, max(lags, LONGEST), settings.sampling)
    found = jnp.asarray(operator, r.zero.dtype) @ r.lagged(lags)
    return found[:-2], found[-2] - r.mean_variance(samples) + found[-1] / jnp.asarray(samples, found.dtype) ** 2


def noise_variance(task: AbstractTask, system: Linearisation) -> Float[Array, ""]:
    """Stationary variance of the output without the harmonic, at an instant, before any low-pass."""
    found = _covariances(task, system)
    return found.row @ found.start


def response(
    task: AbstractTask,
    settings: SpectrumSettings,
    window: tuple[float, float],
    samples: Int[Array | np.ndarray, ""] | int | None = None,
) -> tuple[Moments, Linearisation]:
    """Expected moments of the linearised task in the window, and the linearisation. Not finite where it is unstable.

    The variance is that of so many samples from the window's begin on, by default as many as it has.
    """
    samples = samples_in(window, settings) if samples is None else samples
    system = linearise(task)
    noise, variance = noise_response(task, system, settings, samples)
    line, swing = harmonic_line(task, system, settings, window, samples)
    # Without the slowest rate, which has no second derivative.
    return Moments(noise + line, line, system.rest, variance + swing, jnp.full((), jnp.nan, line.dtype)), system


_compiled_response = kept(response)


def expected_moments(
    task: AbstractTask,
    settings: SpectrumSettings,
    window: tuple[float, float],
    samples: Int[Array | np.ndarray, ""] | int | None = None,
) -> tuple[Moments, Linearisation]:
    """`response`, compiled once for all numbers of samples."""
    samples = samples_in(window, settings) if samples is None else samples
    return _compiled_response(as_arrays(task), settings, window, as_arrays(samples, int))


@kept
def log_variation_sd(task: AbstractTask, settings: SpectrumSettings, samples: int) -> Float[Array, ""]:
    """Standard deviation of the log of the coefficient of variation of so many successive samples, in linear response.

    For low-passed Gaussian noise of autocovariance r and a line of mean square h at the frequency f, s² that of both,

        Var s² = 2/n Σ_l (1 - |l|/n) r̃(lΔ)² + 4h/n Σ_l (1 - |l|/n) r̃(lΔ) cos(2πf lΔ),    r̃ = r - Var(mean),

    and sd(ln CV) = √(Var s²) / (2 s²). How the mean scatters is left out: it counts as CV² beside this.
    """
    system = linearise(task)
    spread = jnp.asarray(low_pass_spread(settings), system.A.dtype)
    reach = len(spread) // 2
    found = _autocovariance(_covariances(task, system), 1 / settings.rate, samples + reach, settings.sampling)
    r = found.lagged(samples + reach)
    r = jnp.convolve(jnp.concatenate([r[reach:0:-1], r]), spread, mode="valid") - found.mean_variance(samples)
    _, swing = harmonic_line(task, system, settings, WINDOW, samples)
    lag = jnp.arange(samples, dtype=r.dtype)
    weight = jnp.where(lag > 0, 2.0, 1.0) * (1 - lag / samples) / samples
    turning = jnp.cos(2 * np.pi * task.harmonic.frequency * lag / settings.rate)
    variance = jnp.sum(weight * (2 * r**2 + 4 * swing * r * turning))
    return 0.5 * jnp.sqrt(variance) / (r[0] + swing)


def linear_spectrum(task: AbstractTask, settings: SpectrumSettings, window: tuple[float, float] = WINDOW) -> Spectrum:
    """The expected Welch spectrum in linear response, of tasks that have one; not finite where they have not."""
    moments, _ = expected_moments(task, settings, window)
    frequency = jnp.asarray(settings.frequency, moments.power.dtype)
    return Spectrum(frequency, moments.power, settings, task.output_unit)


def check_power(task: AbstractTask, moments: Moments) -> None:
    """Refuse a spectrum that is zero but for rounding: fluctuations below the last digits of the mean."""
    power, mean = np.asarray(moments.power), float(moments.mean)
    least = (1e3 * np.finfo(power.dtype).eps * mean) ** 2
    if not np.sum(power) * task.settings.resolution > least:
        raise ValueError(f"the expected spectrum of this {type(task).__name__} is zero: it has neither noise nor a "
                         f"harmonic that moves {task.output_name}; set noise_K_w, say")  # fmt: skip


def check_line(task: AbstractTask, settings: SpectrumSettings) -> None:
    """Refuse a harmonic that sampling would fold to another frequency."""
    frequency = float(task.harmonic.frequency)
    if frequency >= settings.rate / 2 and float(task.harmonic.amplitude) > 0:
        raise ValueError(f"harmonic_frequency = {frequency} Hz is not below half the sampling rate of {settings.rate} Hz: "
                         "raise rate, or set harmonic_amplitude = 0")  # fmt: skip
