"""The expected moments of tasks, by programs that tasks of every make share."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmuscle._common.arrays import all_concrete, as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings, samples_in
from jaxmuscle.spectra._welch import Spectrum

from ._autocovariance import autocovariances
from ._expected import Moments, log_variation_sd, low_pass_spread, response
from ._harmonic_line import harmonic_line
from ._linear_task import Linearisation
from ._linearised import linearise
from ._rows import Sampling, low_pass_of, moments_of_rows, variation_sd_of_numbers

_response = kept(response)  # compiled apart, so that it is traced once


def expected_moments(
    task: AbstractTask,
    settings: SpectrumSettings,
    window: tuple[float, float],
    samples: Int[Array | np.ndarray, ""] | int | None = None,
    recorded: Scalar = 0.0,
) -> tuple[Moments, Linearisation]:
    """`response`; outside a transformation by the programs of `moments_of_rows`."""
    samples = samples_in(window, settings) if samples is None else samples
    if not all_concrete((task, samples, recorded)):
        return _response(as_arrays(task), settings, window, samples, as_arrays(recorded))
    sampled = Sampling(settings, window, samples, recorded)
    moments, _, system = moments_of_rows(task, (), np.zeros((1, 0)), sampled)
    # numbers also while something else is traced; NaN is a sign here: no equilibrium
    with jax.ensure_compile_time_eval(), jax.debug_nans(False):
        return jax.tree.map(lambda x: jnp.asarray(x[0]), (moments, system))


def variation_sd(
    task: AbstractTask, settings: SpectrumSettings, samples: Any, most: int
) -> Float[Array, ""]:
    """`log_variation_sd` of a task's output, by a program for at `most` so many samples: trials are
    rarely of one length."""
    lags = most + len(low_pass_of(settings)) // 2
    if all_concrete((task, samples)):
        return variation_sd_of_numbers(task, Sampling(settings, WINDOW, samples, 0.0), lags)
    return _variation_sd(as_arrays(task), settings, samples, lags)


@kept
def _variation_sd(
    task: AbstractTask, settings: SpectrumSettings, samples: Any, lags: int
) -> Float[Array, ""]:
    system = linearise(task)
    each, _ = autocovariances(task, system, settings, lags)
    _, swing = harmonic_line(task, system, settings, WINDOW, samples)
    return log_variation_sd(
        jnp.sum(each.lagged(lags), axis=0),
        jnp.asarray(low_pass_spread(settings), system.A.dtype),
        jnp.sum(each.mean_variance(samples)),
        swing,
        task.harmonic.frequency / settings.rate,
        samples,
    )


def linear_spectrum(
    task: AbstractTask, settings: SpectrumSettings, window: tuple[float, float] = WINDOW
) -> Spectrum:
    """The expected Welch spectrum in linear response, of tasks that have one; not finite where they
    have not."""
    moments, _ = expected_moments(task, settings, window)
    frequency = jnp.asarray(settings.frequency, moments.power.dtype)
    return Spectrum(frequency, moments.power, settings, task.output_unit)
