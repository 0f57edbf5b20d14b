"""The expected spectrum of a task, for everybody: with what has to be refused or said."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import all_concrete, is_concrete
from jaxmuscle.model._task import AbstractTask, require_task
from jaxmuscle.spectra._decimation import LEAST_RATES
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings
from jaxmuscle.spectra._welch import Spectrum

from ._expected import Moments, check_line, check_power
from ._expected_moments import expected_moments
from ._linearised import check_equilibrium, check_inputs
from ._second_order import warn_beyond


def expected_spectrum(
    task: AbstractTask,
    settings: SpectrumSettings | None = None,
    window: tuple[float, float] = WINDOW,
    *,
    recorded_at: float | int | None = None,
) -> Spectrum:
    """The expected Welch spectrum of a task's output, to first order in its perturbations: no Monte
    Carlo.

        jm.expected_spectrum(jm.Isometric(k_w=4e5)).plot()

        E_k = Σ_l M_kl r(l Δ) + line_k,    r(τ) = c exp(𝒜 τ) P cᵀ,    𝒜 P + P 𝒜ᵀ + 𝒬 = 0

    𝒜 is the task linearised about its equilibrium together with the filters that shape the noise; M
    holds window, detrending and low-pass (docs/model.md, *From autocovariance to Welch power*), Δ
    is the sampling interval, so that aliases are part of it; line_k is the harmonic's response with
    phase and leakage, all its channels added coherently. The estimate's mean for a process that has
    forgotten its start; exact where the response is linear, as it is within 0.2 % at human force
    fluctuations.

    **Arguments:** `task`; `settings` (the task's own by default); the analysed `window` [s] (only
    the harmonic's phase and an envelope that changes depend on it); `recorded_at` [Hz], if the
    settings' sampling is "filtered": the rate of the recording that is sampled, which it must
    exceed twice. The recording has aliases from half its rate on; by default it has none.

    **Returns:** a `Spectrum`, power [unit²/Hz] of shape (bins,); differentiable, also under `jit`
    and `vmap`.

    **Raises:** `OperatingPointError` (a `ValueError`) without a stable, damped equilibrium, and
    where an input still moves in the window; `ValueError` for a harmonic beyond half the sampling
    rate and for a task without noise and harmonic. Warns (`FirstOrderWarning`) where the second
    order adds more than 10 % to a bin, and of coefficients that turn negative. Under a
    transformation, where values cannot be looked at, nothing is raised: without a stable
    equilibrium the result is not finite, and all else that would be refused gives numbers without
    meaning.
    """
    call = "expected_spectrum(task)"
    moments, settings = _moments(task, call, settings, window, recorded_at)
    frequency = jnp.asarray(settings.frequency, moments.power.dtype)
    return Spectrum(frequency, moments.power, settings, task.output_unit)


def expected_variation(
    task: AbstractTask,
    settings: SpectrumSettings | None = None,
    window: tuple[float, float] = WINDOW,
    *,
    recorded_at: float | int | None = None,
) -> Float[Array, ""]:
    """The expected coefficient of variation of a task's output, to first order in its
    perturbations: no Monte Carlo.

        jm.response.expected_variation(jm.Isometric(k_w=4e5))

        CV = √E[s²] / |μ|,    E[s²] = r(0) - Var(mean) + ½ h²

    r is the autocovariance of the output behind the low-pass of the settings, s² the variance
    within the window, μ the output at the operating point, and h the amplitude of the harmonic in
    the low-passed output. Slow fluctuations count less in a short window, which hardly holds one of
    their periods.

    **Arguments:** as of `expected_spectrum`; the `window` [s] also says how long the recording is
    (10 s by default); `recorded_at` [Hz], whose aliases are in the variance.

    **Returns:** a fraction, not a percentage; differentiable, also under `jit` and `vmap`.
    **Raises** and warns as `expected_spectrum`.
    """
    moments, _ = _moments(task, "expected_variation(task)", settings, window, recorded_at)
    return jnp.sqrt(moments.variance) / jnp.abs(moments.mean)


def _moments(
    task: AbstractTask,
    call: str,
    settings: SpectrumSettings | None,
    window: tuple[float, float],
    recorded_at: float | int | None,
) -> tuple[Moments, SpectrumSettings]:
    """The expected moments, after what has to be refused or said."""
    require_task(task, call)
    settings = task.settings if settings is None else settings
    if not isinstance(settings, SpectrumSettings):
        raise ValueError(
            f"settings: this is a {type(settings).__name__}; give a jaxmuscle.SpectrumSettings, as "
            "SpectrumSettings.named('slow')"
        )
    start, stop = window
    if not 0 <= start < stop:
        raise ValueError(f"window = {window}: give its start and its end [s], 0 <= start < end")
    least = LEAST_RATES * settings.rate
    if recorded_at is not None and (settings.sampling != "filtered" or not recorded_at >= least):
        raise ValueError(
            f"recorded_at={recorded_at!r}: give a rate of {least:g} Hz or more, with settings whose"
            f" sampling is 'filtered' (here {settings.sampling!r}); or leave it out"
        )
    concrete = all_concrete(task)
    if concrete:
        check_line(task, settings)
        check_inputs(task, window)
    moments, system = expected_moments(
        task, settings, window, None, 0.0 if recorded_at is None else 1 / recorded_at
    )
    if is_concrete(moments.power):
        check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))
        check_power(task, moments)
    if concrete:
        warn_beyond(task, settings, moments)
    return moments, settings
