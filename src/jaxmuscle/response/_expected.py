"""The expected Welch spectrum of a task in linear response, in closed form."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxmuscle._common.types import Scalar
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._bin_law import bin_rows, sides_of
from jaxmuscle.spectra._settings import LONGEST, SpectrumSettings, samples_in, tapers_of

from ._autocovariance import autocovariances, covariances
from ._harmonic_line import LONG, harmonic_line, removed, transformed
from ._linear_task import Linearisation
from ._linearised import linearise

TAIL = 1e-13
ROUNDING = 1e-20  # of any unit of the output: fluctuations that are smaller are none


class Moments(NamedTuple):
    """What a fit compares: Welch power per bin, that of the harmonic alone, mean and variance of a
    recording.

    The variance is that of the low-passed output, as a recording's: what lies above the low-pass is
    not in it. `resonant`: Welch power per bin of every resonance alone. `stiffness`: real and
    imaginary part of the dynamic stiffness at the points of a measured one.
    """

    power: Float[Array | np.ndarray, " bins"]
    line: Float[Array | np.ndarray, " bins"]
    mean: Float[Array | np.ndarray, ""]
    variance: Float[Array | np.ndarray, ""]
    resonant: tuple[Float[Array | np.ndarray, " bins"], ...] = ()
    stiffness: Float[Array | np.ndarray, "2 points"] | tuple[()] = ()

    @property
    def proportional(self) -> Float[Array | np.ndarray, " bins"]:
        """Proportional power on the compared bins."""
        return self.power / self.power.sum()

    @property
    def variation(self) -> Scalar:
        """Coefficient of variation; infinite about a mean of zero."""
        with np.errstate(divide="ignore"):
            return self.variance**0.5 / abs(self.mean)


@functools.cache
def low_pass_spread(settings: SpectrumSettings) -> Float[np.ndarray, " lags"]:
    """ρ, the autocorrelation of the low-pass's impulse response at lags -m ... m: it turns r into
    `r * ρ`."""
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
    """M with expected Welch power `E_k = Σ_l M_kl r(l Δ)`: low-pass, detrending, taper and
    transform.

    The low-pass turns r into `r * ρ` (`low_pass_spread`); a bin is `Σ_l α_k(l) r(l)`, α_k the sum
    of the autocorrelations of its `bin_rows`. Both are folded onto lags l >= 0. Two more rows: the
    variance of what has passed, (r * ρ)(0); and `Σ_l ((|·| * ρ)(l) - |l|) r(l)`, by which the
    low-pass lowers n² times the variance of the mean of n samples (`Σ_l (n - |l|) / n² r(l)`
    without it; where r has decayed at the n-th lag).
    """
    rows, spread = bin_rows(settings), low_pass_spread(settings)
    lagged = np.array(
        [sum(scipy.signal.correlate(row, row, method="fft").real for row in each) for each in rows]
    )
    lagged = np.concatenate([lagged, np.eye(1, lagged.shape[1], lagged.shape[1] // 2)])
    full = np.array([scipy.signal.convolve(row, spread, method="fft") for row in lagged])
    centre, reach = full.shape[1] // 2, len(spread) // 2
    full = np.concatenate([full, np.pad(_lowered(spread), centre - reach)[None]])
    folded = full[:, centre:].copy()
    folded[:, 1:] += full[:, centre - 1 :: -1]
    return folded


def lags_of(settings: SpectrumSettings) -> int:
    """How many lags of the autocovariance a Welch spectrum depends on."""
    return settings.length + len(low_pass_spread(settings)) // 2


def expected_powers(
    settings: SpectrumSettings, r: Float[Array | np.ndarray, " lags"]
) -> Float[Array, " bins_and_two"]:
    """`covariance_operator(settings) @ r`; of long segments by Fourier transforms, without that
    matrix.

    With R = r * ρ, T the matrix of its values R(|m - n|), w a taper, c its autocorrelation, q the
    orthonormal directions that detrending removes and F the transform at the bins (docs/model.md,
    *Long segments*):

        E_k ∝ Σ_w [F(c R) of both signs of l - 2 Re Σ_q F(w T q)* F(w q)
                   + Σ_pq F(w p)* F(w q) pᵀ T q]_k
    """
    r = jnp.asarray(r)
    if settings.length <= LONG:
        return jnp.asarray(covariance_operator(settings), r.dtype) @ r
    n, spread = settings.length, low_pass_spread(settings)
    reach, tapers, away = len(spread) // 2, tapers_of(settings, n), removed(settings)
    convolved = jax.scipy.signal.fftconvolve
    R = convolved(
        jnp.concatenate([r[reach:0:-1], r[: n + reach]]), jnp.asarray(spread, r.dtype), mode="valid"
    )
    own = np.sum([scipy.signal.correlate(w, w, method="fft")[n - 1 :] for w in tapers], axis=0)
    power = 2 * jnp.real(transformed(settings, jnp.asarray(own, r.dtype) * R)) - own[0] * R[0]
    moved = [
        convolved(jnp.concatenate([R[:0:-1], R]), jnp.asarray(q, r.dtype), mode="valid")
        for q in away
    ]
    for w in tapers:
        seen = [transformed(settings, jnp.asarray(w * q, r.dtype)) for q in away]
        for here, Tq in zip(seen, moved, strict=True):
            power -= 2 * jnp.real(
                jnp.conj(transformed(settings, jnp.asarray(w, r.dtype) * Tq)) * here
            )
            for there, p in zip(seen, away, strict=True):
                power += jnp.real(jnp.conj(there) * here) * (jnp.asarray(p, r.dtype) @ Tq)
    lowered = _lowered(spread)[reach:] * np.append(1.0, np.full(reach, 2.0))
    further = jnp.stack([R[0], jnp.asarray(lowered, r.dtype) @ r[: reach + 1]])
    return jnp.concatenate([power * jnp.asarray(sides_of(settings), r.dtype), further])


def _lowered(spread: Float[np.ndarray, " lags"]) -> Float[np.ndarray, " lags"]:
    """`(|·| * ρ)(l) - |l|` at the lags of ρ."""
    reach = len(spread) // 2
    lag = np.arange(-2 * reach, 2 * reach + 1)
    return np.convolve(np.abs(lag), spread, mode="valid") - np.abs(lag[reach : lag.size - reach])


def noise_response(
    task: AbstractTask,
    system: Linearisation,
    settings: SpectrumSettings,
    samples: Int[Array | np.ndarray, ""] | int,
    recorded: Scalar = 0.0,
) -> tuple[Float[Array, "components bins"], Float[Array, ""]]:
    """Expected Welch power of each component of the noise, and variance of so many low-passed
    samples about their mean. `recorded`: as in `response`."""
    lags = lags_of(settings)
    each, of = autocovariances(task, system, settings, max(lags, LONGEST), recorded)
    belongs = np.equal.outer(np.arange(len(task.noise.components)), of).astype(system.A.dtype)
    r = belongs @ each.lagged(lags)
    found = jnp.stack([expected_powers(settings, own) for own in r])
    slow = jnp.sum(each.mean_variance(samples))
    whole = jnp.sum(found, axis=0)
    return found[:, :-2], whole[-2] - slow + whole[-1] / jnp.asarray(samples, found.dtype) ** 2


def noise_variance(task: AbstractTask, system: Linearisation) -> Float[Array, ""]:
    """Stationary variance of the output without the harmonic, at an instant, before any
    low-pass."""
    each = [own for component in covariances(task, system) for own in component]
    return sum((jnp.sum(own.rows * own.start) for own in each), jnp.zeros((), system.A.dtype))


def response(
    task: AbstractTask,
    settings: SpectrumSettings,
    window: tuple[float, float],
    samples: Int[Array | np.ndarray, ""] | int | None = None,
    recorded: Scalar = 0.0,
) -> tuple[Moments, Linearisation]:
    """Expected moments of the linearised task in the window, and the linearisation. Not finite
    where it is unstable.

    The variance is that of so many samples from the window's begin on, by default as many as it
    has. Where sampling is "filtered", the signal was `recorded` at this interval [s]; 0: it is
    known at all times.
    """
    samples = samples_in(window, settings) if samples is None else samples
    system = linearise(task)
    noise, variance = noise_response(task, system, settings, samples, recorded)
    line, swing = harmonic_line(task, system, settings, window, samples)
    resonant = tuple(
        own
        for own, part in zip(noise, task.noise.components, strict=True)
        if isinstance(part, ResonantNoise)
    )
    power = jnp.sum(noise, axis=0) + line
    return Moments(power, line, system.rest, variance + swing, resonant), system


def log_variation_sd(
    r: Float[Array, " lags"],
    spread: Float[Array | np.ndarray, " around"],
    slow: Scalar,
    swing: Scalar,
    turns: Scalar,
    samples: Int[Array | np.ndarray, ""] | int,
) -> Float[Array, ""]:
    """Standard deviation of the log of the coefficient of variation of so many successive samples,
    in linear response.

    For low-passed Gaussian noise of autocovariance r, `spread` by the low-pass, and a line of mean
    square h (`swing`) that makes so many `turns` in an interval, s² that of both,

        Var s² = 2/n Σ_l (1 - |l|/n) r̃(lΔ)² + 4h/n Σ_l (1 - |l|/n) r̃(lΔ) cos(2πf lΔ)
        r̃ = r - Var(mean),

    Var(mean) = `slow`, and sd(ln CV) = √(Var s²) / (2 s²). How the mean scatters is left out: it
    counts as CV² beside this.
    """
    reach = len(spread) // 2
    r = jnp.convolve(jnp.concatenate([r[reach:0:-1], r]), spread, mode="valid") - slow
    lag, n = jnp.arange(len(r), dtype=r.dtype), jnp.asarray(samples, r.dtype)
    weight = jnp.where(lag > 0, 2.0, 1.0) * jnp.maximum(1 - lag / n, 0.0) / n
    turning = jnp.cos(2 * np.pi * turns * lag)
    variance = jnp.sum(weight * (2 * r**2 + 4 * swing * r * turning))
    return 0.5 * jnp.sqrt(variance) / (r[0] + swing)


def check_power(task: AbstractTask, moments: Moments) -> None:
    """Refuse a spectrum that is zero but for rounding: fluctuations below the last digits of the
    mean."""
    power, mean = np.asarray(moments.power), float(moments.mean)
    least = max(1e3 * np.finfo(power.dtype).eps * abs(mean), ROUNDING) ** 2
    if not np.sum(power) * task.settings.resolution > least:
        idle = "P_w" in task.parameter_names and float(task["P_w"]) == 0
        why = (
            "P_w is 0, so that nothing stretches the muscle; set P_w above 0"
            if idle
            else (
                f"it has neither noise nor a harmonic that moves {task.output_name}; set"
                " noise_K_w, say"
            )
        )
        raise ValueError(f"the expected spectrum of this {type(task).__name__} is zero: {why}")


def check_line(task: AbstractTask, settings: SpectrumSettings) -> None:
    """Refuse a harmonic that sampling would fold to another frequency."""
    frequency = float(task.harmonic.frequency)
    if frequency >= settings.rate / 2 and float(task.harmonic.amplitude) > 0:
        raise ValueError(
            f"harmonic_frequency = {frequency} Hz is not below half the sampling rate of"
            f" {settings.rate} Hz: raise rate, or set harmonic_amplitude = 0"
        )
