"""What the force does when the insertion is moved as measured: the nonlinear muscle, without
noise."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.programs import kept
from jaxmuscle.model._parameters import INPUTS
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.response._equilibrium import HOLD, equilibrium, fastest_rate, mechanics

from ._grid import parts_for

BLOCK = 10_240  # half steps; a program serves all recordings of as many blocks
# of rate times step: half of what keeps the method stable, since damping grows with speed
LONGEST = 1.4
MOST = 256


def driven(
    task: PrescribedLength, motion: Float[np.ndarray, "3 times"], interval: float
) -> Float[np.ndarray, " steps"]:
    """F_ext less its value at rest [N] at every second of some times, by the Runge-Kutta method of
    order 4.

    **Arguments:** `task`, whose P_w is held; `motion`: x_z, x_z', x_z'' about the task's own x_z at
    times `interval` [s] apart, an odd number of them; they begin at rest.

    A step, two intervals, is cut into as many parts (a power of two, at most `MOST`) as the fastest
    rate of the muscle asks for. Within a step the motion is the parabola through its three values.
    Not finite where that is not enough.
    """
    times = motion.shape[1]
    filled = np.pad(motion, ((0, 0), (0, -(times - 1) % BLOCK)))
    parts = min(parts_for(fastest_rate(task, HOLD), 2 * interval, LONGEST), MOST)
    force = _driven(mechanics(task), filled, 2 * interval, np.asarray(parts))
    return np.asarray(force)[: (times + 1) // 2]


@kept
def _driven(task: Any, motion: Any, step: Any, parts: Any) -> Float[Array, " steps"]:
    t, start = jnp.asarray(HOLD, motion.dtype), equilibrium(task)
    cut = parts.astype(motion.dtype)
    still, rest = jnp.zeros(len(INPUTS), motion.dtype), task.insertion(t)[0].astype(motion.dtype)

    def at(y, row):
        return task.moved(t, y, still, (rest + row[0], row[1], row[2]))

    def advance(y, rows):
        first, middle, last = rows
        bend = 2 * (first - 2 * middle + last)

        def along(s):
            return first + s * (last - first + bend * (s - 1))

        def part(i, y):
            begin = i.astype(cut.dtype) / cut
            a = at(y, along(begin))[0]
            b = at(y + 0.5 * short * a, along(begin + 0.5 / cut))[0]
            c = at(y + 0.5 * short * b, along(begin + 0.5 / cut))[0]
            d = at(y + short * c, along(begin + 1 / cut))[0]
            return y + short / 6 * (a + 2 * b + 2 * c + d)

        return jax.lax.fori_loop(0, parts, part, y), at(y, first)[1]

    table, short = motion.T, step / cut
    y, found = jax.lax.scan(advance, start, (table[:-1:2], table[1::2], table[2::2]))
    force = jnp.append(found, at(y, table[-1])[1])
    return force - at(start, jnp.zeros(3, motion.dtype))[1]
