"""A task with another noise."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ._activation import ACTIVE
from ._noise import AbstractNoise, NoiseSum
from ._noise_names import NOISES as NOISES
from ._noise_names import made_by_name
from ._parameters import CHANNELS
from ._resonant_noise import ResonantNoise
from ._tasks import AbstractTask


def with_noise(
    task: AbstractTask, noise: str | AbstractNoise | None, fix: Mapping[str, float] | None = None
) -> AbstractTask:
    """The task with another noise, at its default amplitudes except those that `fix` names; by name
    it keeps its tremor."""
    if noise is None:
        return task
    if isinstance(noise, AbstractNoise):
        return task.with_parts(noise=noise)
    made = made_by_name(noise)
    values = {f"noise_{c}": float(made.amplitude[i]) for i, c in enumerate(CHANNELS)} | dict(
        fix or {}
    )
    fixed = [values[f"noise_{c}"] for c in CHANNELS]
    made = eqx.tree_at(lambda n: n.amplitude, made, np.array(fixed))
    tremor = [part for part in task.noise.components if isinstance(part, ResonantNoise)]
    return task.with_parts(noise=NoiseSum((made, *tremor)) if tremor else made)


def with_active_noise(task: AbstractTask) -> AbstractTask:
    """The task with noise on the active tissue and the drive only."""
    return with_noise_times(
        task, lambda n: np.isin(n.acts_on, ACTIVE).astype(jnp.result_type(n.amplitude))
    )


def with_noise_times(task: AbstractTask, factor: Callable[[AbstractNoise], Any]) -> AbstractTask:
    """The task with the amplitudes of each of its noises times a factor."""
    amplitudes = [noise.amplitude * factor(noise) for noise in task.noise.components]
    return eqx.tree_at(
        lambda t: [noise.amplitude for noise in t.noise.components], task, amplitudes
    )
