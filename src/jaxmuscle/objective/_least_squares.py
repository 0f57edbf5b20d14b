"""Levenberg-Marquardt from many starts at once, one optimistix step at a time, so that it can be
watched and stopped."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmuscle._common.programs import kept
from jaxmuscle.response._mechanics import in_parts

from ._consequences import Expansion, expand
from ._residuals import free_size

SMALL = 1e-3
STILL = 1e-4
REFUSALS = 10
# of the way to where it would count, gained by a step: a start that needs two hundred more such
# steps
HOPELESS = 0.005


class Minima(NamedTuple):
    """Where each start stands: coordinates, cost `½ Σ r²`, steps tried, and whether its last step
    gained little."""

    s: Float[np.ndarray, "starts free"]
    cost: Float[np.ndarray, " starts"]
    steps: Int[np.ndarray, " starts"]
    settled: Bool[np.ndarray, " starts"]

    @property
    def best(self) -> int:
        """The finite start of lowest cost; the first if there is none."""
        return int(np.argmin(np.where(np.isfinite(self.cost), self.cost, np.inf)))


def _residuals(
    s: Float[Array, " free"], given: tuple[Any, Any, Expansion]
) -> tuple[Float[Array, " residuals"], None]:
    """Residuals with their slopes at the s where the model was seen: all that a Levenberg-Marquardt
    step asks for."""
    objective, data, seen = given
    theta = objective.theta(s)
    return objective.residuals(theta, seen.near(theta), data), None


def _solver() -> Any:
    import optimistix as optx  # only here, since a program that is loaded does without

    return optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)


def _initial(objective, data, s, seen):
    given = (objective, data, seen)
    shape = jax.eval_shape(lambda s: _residuals(s, given)[0], s)
    return _solver().init(_residuals, s, given, {}, shape, None, frozenset())


@kept
def _start(objective, data, starts, seen):
    def one(data, s, seen):
        return _arrays(_initial(objective, data, s, seen))

    return eqx.filter_vmap(one)(data, starts, seen)


@kept
def _step(objective, data, s, state, seen):
    def one(data, s, state, seen):
        shapes, functions = eqx.partition(
            eqx.filter_eval_shape(_initial, objective, data, s, seen), _is_shape
        )
        state = eqx.combine(jax.tree.unflatten(jax.tree.structure(shapes), state), functions)
        s, state, _ = _solver().step(_residuals, s, (objective, data, seen), {}, state, frozenset())
        return (
            s,
            _arrays(state),
            state.y_eval,
            0.5 * (state.f_info.residual**2).sum(),
            state.num_accepted_steps,
        )

    return eqx.filter_vmap(one)(data, s, state, seen)


def _arrays(state):
    """The arrays of a solver's state, all that goes from program to program: no file can keep its
    functions."""
    return jax.tree.leaves(eqx.filter(state, eqx.is_array))


def _is_shape(leaf):
    return isinstance(leaf, jax.ShapeDtypeStruct)


class _Standing(NamedTuple):
    """Every start: where it is and looks next, its cost, accepted steps, successive small gains."""

    s: np.ndarray
    ahead: np.ndarray
    cost: np.ndarray
    accepted: np.ndarray
    small: np.ndarray
    still: np.ndarray
    behind: np.ndarray
    refused: np.ndarray
    steps: np.ndarray
    active: np.ndarray

    def advanced(
        self,
        s: np.ndarray,
        ahead: np.ndarray,
        cost: np.ndarray,
        accepted: np.ndarray,
        margin: float,
    ) -> "_Standing":
        """After a step of the active starts; the others are given as they were."""
        moved = self.active & (accepted > self.accepted)
        with np.errstate(invalid="ignore"):
            gain = np.where(np.isfinite(self.cost), (self.cost - cost) / self.cost, np.inf)
        small = np.where(moved, np.where(gain < SMALL, self.small + 1, 0), self.small)
        still = np.where(moved, np.where(gain < STILL, self.still + 1, 0), self.still)
        away = cost - (np.min(cost, initial=np.inf, where=np.isfinite(cost)) + margin)
        with np.errstate(invalid="ignore"):
            slow = (away > 0) & (self.cost - cost < HOPELESS * away)
        behind = np.where(moved, np.where(slow, self.behind + 1, 0), self.behind)
        refused = np.where(moved, 0, self.refused + self.active)
        return _Standing(
            s,
            ahead,
            cost,
            accepted,
            small,
            still,
            behind,
            refused,
            self.steps + self.active,
            self.active & (still < 2) & (behind < 2) & (refused < REFUSALS) & np.isfinite(cost),
        )

    def minima(self) -> Minima:
        settled = (self.small >= 1) & np.isfinite(self.cost)
        return Minima(self.s, self.cost, self.steps, settled)


def least_squares(
    objective: Any,
    starts: Float[np.ndarray, "starts free"],
    max_steps: int,
    *,
    data: Any = None,
    margin: float = np.inf,
    prepare: Callable[[Any, np.ndarray], Any] = lambda objective, points: objective,
    report: Callable[[Minima], None] = lambda minima: None,
) -> Minima:
    """Minimise `½ Σ r²`, `r = objective.residuals(θ, moments at θ, data)`, from every start.

    `data` has a leading axis of starts: each may have data of its own; without it all have the
    objective's. Steps to where r is not finite are rejected. A start ends when two accepted steps
    in a row lower its cost by less than `STILL` of it, after `REFUSALS` rejected steps in a row, or
    if it is not finite; what has ended costs nothing more. It also ends when two accepted steps in
    a row gain less than `HOPELESS` of what its cost is above the best by more than `margin`.
    `prepare(objective, points)` may exchange the objective before each step (sub-steps); `report`
    sees every step's outcome.
    """
    count, free = starts.shape
    none, all = np.zeros(count, dtype=int), np.ones(count, dtype=bool)
    nothing = np.full(count, np.inf)
    now = _Standing(starts, starts, nothing, none, none, none, none, none, none, all)
    data = jax.tree.map(np.asarray, for_all(objective.data, count) if data is None else data)
    # What the steps take: one program for fits of any task and any free parameters.
    filled, more = objective.filled(), free_size(free) - free

    def wide(x: np.ndarray) -> np.ndarray:
        return np.pad(x, [*[(0, 0)] * (x.ndim - 1), (0, more)])

    state: Any = None
    for _ in range(max_steps):
        # simulations are compiled for one number of points
        rows = np.flatnonzero(now.active) if objective.linear else np.arange(count)
        objective = prepare(objective, now.ahead[rows])
        seen = expand(objective, np.asarray(objective.theta(now.ahead[rows]))).compared(wide)
        own, s = jax.tree.map(lambda x, rows=rows: x[rows], data), wide(now.s[rows])
        if state is None:
            state = before = in_parts(functools.partial(_start, filled), own, s, seen)
        else:
            before = [x[rows] for x in state]
        s, after, ahead, cost, accepted = in_parts(
            functools.partial(_step, filled), own, s, before, seen
        )
        state = [_put(old, rows, x) for old, x in zip(state, after, strict=True)]
        live, known = now.active[rows], (now.s, now.ahead, now.cost, now.accepted)
        reached = s[:, :free], ahead[:, :free], cost, accepted
        s, ahead, cost, accepted = (
            _put(old, rows[live], x[live]) for old, x in zip(known, reached, strict=True)
        )
        now = now.advanced(s, ahead, cost, accepted, margin)
        report(now.minima())
        if not np.any(now.active):
            break
    return now.minima()


def for_all(data: Any, count: int) -> Any:
    """The same data for each of so many starts."""
    return jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x))), data)


def _put(old: np.ndarray, rows: np.ndarray, new: np.ndarray) -> np.ndarray:
    whole = old.copy()
    whole[rows] = new
    return whole
