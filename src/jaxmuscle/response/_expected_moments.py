"""The expected moments of tasks, by programs that tasks of every make share."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxmuscle._common.arrays import all_concrete
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings, samples_in
from jaxmuscle.spectra._welch import Spectrum

from ._expected import Moments, response
from ._linearised import Linearisation
from ._rows import Sampled, moments_of_rows


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
        return response(task, settings, window, samples, recorded)
    sampled = Sampled(settings, window, samples, recorded)
    moments, _, system = moments_of_rows(task, (), np.zeros((1, 0)), sampled)
    return jax.tree.map(lambda x: jnp.asarray(x[0]), (moments, system))


def linear_spectrum(
    task: AbstractTask, settings: SpectrumSettings, window: tuple[float, float] = WINDOW
) -> Spectrum:
    """The expected Welch spectrum in linear response, of tasks that have one; not finite where they
    have not."""
    moments, _ = expected_moments(task, settings, window)
    frequency = jnp.asarray(settings.frequency, moments.power.dtype)
    return Spectrum(frequency, moments.power, settings, task.output_unit)
