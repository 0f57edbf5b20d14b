"""The autocovariance of a task's output under its noise, at any lags."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.matrices import exponential
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._task import require_task
from jaxmuscle.model._tasks import AbstractTask

from ._autocovariance import Covariances, covariances
from ._linearised import linearise

# exp(M s) as the 2^SQUARED-th power of exp(M s / 2^SQUARED): right for lags 2^SQUARED times as long
SQUARED = 10


def autocovariance(
    task: AbstractTask, lag: Float[Array | np.ndarray, "*lags"] | Scalar
) -> Float[Array, "*lags"]:
    """Autocovariance [unit²] of the noise in a task's output, in linear response, before it is
    sampled.

        r = jm.response.autocovariance(jm.Isometric(), np.linspace(0.0, 1.0, 101))
        r / r[0]  # the autocorrelation

        r(s) = Σ c exp(𝒜 |s|) P cᵀ = ∫_0^∞ S(f) cos(2πf s) df,    𝒜 P + P 𝒜ᵀ + 𝒬 = 0

    𝒜 is the task linearised about its equilibrium together with the filters that shape the noise, c
    a row that reads the output of one independent part of the noise, P its stationary covariance; S
    is `noise_density`. r(0) is the variance. The harmonic is not in it: it adds `½ h² cos(2πf s)`,
    which does not decay.

    **Arguments:** `task`; `lag` [s], of any shape and sign. **Returns:** an array of that shape,
    differentiable in both, also under `jit` and `vmap`. **Raises:** `OperatingPointError` as
    `linearise` does.
    """
    require_task(task, "autocovariance(task, lag)")
    linearise(task)  # its checks
    return _autocovariance(as_arrays(task), as_arrays(lag))


@kept
def _autocovariance(
    task: AbstractTask, lag: Float[Array | np.ndarray, "*lags"]
) -> Float[Array, "*lags"]:
    each = [own for parts in covariances(task, linearise(task)) for own in parts]

    def at(s: Array) -> Array:
        return sum((_at(own, s) for own in each), jnp.zeros_like(s))

    away = jnp.abs(jnp.asarray(lag))
    return jax.vmap(at)(away.reshape(-1)).reshape(away.shape)


def _at(own: Covariances, s: Float[Array, ""]) -> Float[Array, ""]:
    step = exponential(own.matrix * s / 2**SQUARED)
    for _ in range(SQUARED):
        step = step @ step
    return jnp.sum(own.rows * (own.start @ step.T))
