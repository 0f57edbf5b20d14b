"""What the force does when the insertion is moved as measured: the nonlinear muscle, without noise."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle.model._parameters import INPUTS
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.response._equilibrium import HOLD, equilibrium

BLOCK = 10_240  # half steps; a program serves all recordings of as many blocks


def driven(task: PrescribedLength, motion: Float[np.ndarray, "3 times"], interval: float) -> Float[np.ndarray, " steps"]:
    """F_ext less its value at rest [N] at every second of some times, by the Runge-Kutta method of order 4.

    **Arguments:** `task`, whose P_w is held; `motion`: x_z, x_z', x_z'' about the task's own x_z at times `interval` [s]
    apart, an odd number of them; they begin at rest. Not finite where the step, two intervals, is too long.
    """
    times = motion.shape[1]
    filled = np.pad(motion, ((0, 0), (0, -(times - 1) % BLOCK)))
    return np.asarray(_driven(as_arrays(task), filled, 2 * interval))[: (times + 1) // 2]


@kept
def _driven(task: Any, motion: Any, step: Any) -> Float[Array, " steps"]:
    t, start = jnp.asarray(HOLD, motion.dtype), equilibrium(task)
    still, rest = jnp.zeros(len(INPUTS), motion.dtype), task.insertion(t)[0].astype(motion.dtype)

    def at(y, row):
        return task.moved(t, y, still, (rest + row[0], row[1], row[2]))

    def advance(y, rows):
        first, middle, last = rows
        a, force = at(y, first)
        b = at(y + 0.5 * step * a, middle)[0]
        c = at(y + 0.5 * step * b, middle)[0]
        d = at(y + step * c, last)[0]
        return y + step / 6 * (a + 2 * b + 2 * c + d), force

    table = motion.T
    y, found = jax.lax.scan(advance, start, (table[:-1:2], table[1::2], table[2::2]))
    force = jnp.append(found, at(y, table[-1])[1])
    return force - at(start, jnp.zeros(3, motion.dtype))[1]
