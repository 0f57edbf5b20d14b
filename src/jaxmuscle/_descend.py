"""Levenberg-Marquardt from many starts at once, one optimistix step at a time, so that it can be watched and stopped."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

SMALL = 1e-3
REFUSALS = 6
BATCH = 32


class Descent(NamedTuple):
    """Where each start stands: coordinates, cost `½ Σ r²`, steps tried, and whether its last step gained little."""

    s: Float[np.ndarray, "starts free"]
    cost: Float[np.ndarray, " starts"]
    steps: Int[np.ndarray, " starts"]
    settled: Bool[np.ndarray, " starts"]

    @property
    def best(self) -> int:
        """The finite start of lowest cost; the first if there is none."""
        return int(np.argmin(np.where(np.isfinite(self.cost), self.cost, np.inf)))


@eqx.filter_custom_jvp
def _residuals(s: Float[Array, " free"], problem: Any) -> Float[Array, " residuals"]:
    return problem.residuals(s)


@_residuals.def_jvp
def _residuals_jvp(primals, tangents):
    s, problem = primals
    direction = tangents[0]
    jacobian, value = jax.jacfwd(lambda s: 2 * (problem.residuals(s),), has_aux=True)(s)
    return value, jacobian @ direction


def _function(s, problem):
    return _residuals(s, problem), None


SOLVER = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)


@eqx.filter_jit
def _start(problem, starts):
    def one(s):
        shape = eqx.filter_eval_shape(_function, s, problem)[0]
        return SOLVER.init(_function, s, problem, {}, shape, None, frozenset())

    return eqx.filter_vmap(one)(starts)


@eqx.filter_jit
def _step(problem, s, state):
    def one(s, state):
        s, state, _ = SOLVER.step(_function, s, problem, {}, state, frozenset())
        return s, state, 0.5 * jnp.sum(state.f_info.residual**2), state.num_accepted_steps

    return eqx.filter_vmap(one)(s, state)


def descend(
    problem: Any,
    starts: Float[np.ndarray, "starts free"],
    max_steps: int,
    *,
    prepare: Callable[[Any, np.ndarray], Any],
    report: Callable[[Descent], None],
) -> Descent:
    """Minimise `½ |problem.residuals(s)|²` from every start; rejects steps to where it is not finite.

    A start settles when two accepted steps in a row lower its cost by less than a thousandth; the loop ends when all
    have or `REFUSALS` steps in a row were rejected, or after `max_steps`. `prepare(problem, points)` may exchange the
    problem before each step (sub-steps); `report` sees where each start stands after each step.
    """
    s = jnp.asarray(starts)
    count = len(starts)
    cost = np.full(count, np.inf)
    accepted = np.zeros(count, dtype=int)
    small = np.zeros(count, dtype=int)
    refused = np.zeros(count, dtype=int)
    steps = np.zeros(count, dtype=int)
    problem = prepare(problem, np.asarray(s))
    state = _start(problem, s)
    result = Descent(np.asarray(s), cost, steps, np.zeros(count, dtype=bool))
    for _ in range(max_steps):
        problem = prepare(problem, np.asarray(state.y_eval))
        s, state, now, taken = _step(problem, s, state)
        now, taken = np.asarray(now), np.asarray(taken)
        active = (small < 2) & (refused < REFUSALS)
        moved = (taken > accepted) & np.isfinite(cost)
        refused = np.where(taken > accepted, 0, refused + 1)
        little = (cost - now) < SMALL * cost
        small = np.where(active, np.where(moved, np.where(little, small + 1, 0), small), small)
        steps += active
        cost, accepted = now, taken
        result = Descent(np.asarray(s), cost, steps.copy(), (small >= 1) & np.isfinite(cost))
        report(result)
        if np.all((small >= 2) | (refused >= REFUSALS) | ~np.isfinite(cost)):
            break
    return result


def in_batches(
    problem: Any, starts: Float[np.ndarray, "starts free"], max_steps: int, report: Callable[[Descent], None]
) -> Descent:
    """`descend` for any number of starts, `BATCH` at a time, so that one compiled step serves every number."""
    count, size = starts.shape
    done = Descent(starts.copy(), np.full(count, np.inf), np.zeros(count, dtype=int), np.zeros(count, dtype=bool))
    for begin in range(0, count, BATCH):
        here = starts[begin : begin + BATCH]
        padded = np.concatenate([here, np.broadcast_to(here[-1], (BATCH - len(here), size))])
        now = done

        def show(part, begin=begin, so_far=done):
            nonlocal now
            now = Descent(*(_put(old, new[: count - begin], begin) for old, new in zip(so_far, part, strict=True)))
            report(now)

        descend(problem, padded, max_steps, prepare=lambda problem, points: problem, report=show)
        done = now
    return done


def _put(old: np.ndarray, new: np.ndarray, begin: int) -> np.ndarray:
    whole = old.copy()
    whole[begin : begin + len(new)] = new
    return whole
