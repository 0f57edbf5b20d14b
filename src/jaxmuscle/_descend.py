"""Levenberg-Marquardt from many starts at once, one optimistix step at a time, so that it can be watched and stopped."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ._expected import Moments
from ._objective import Coordinates, Linear, at
from ._parameter import USUALLY_FREE
from ._task import AbstractTask

SMALL = 1e-3
STILL = 1e-4
REFUSALS = 10
BATCH = 32
ROWS = 128


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


class Seen(NamedTuple):
    """What a problem's model gives at some θ, and its slopes with respect to θ; a leading axis of points."""

    theta: Any
    moments: Any
    slopes: Any

    def nearby(self, theta: Float[Array, " free"]) -> Any:
        """The moments at another θ to first order (without the leading axis); exact, with exact slopes, at `self.theta`."""
        return jax.tree.map(lambda value, slope: value + slope @ (theta - self.theta), self.moments, self.slopes)


class _Response(eqx.Module):
    """What the moments of a linear response depend on, and nothing else, so that a program is used again."""

    model: Linear
    task: AbstractTask
    coordinates: Coordinates

    def moments(self, theta: Float[Array, " free"]) -> Moments:
        return self.model.moments(at(self.task, self.coordinates, theta))


@eqx.filter_jit
def _moments_and_slopes(problem: Any, theta: Float[Array | np.ndarray, "points free"]) -> tuple[Any, Any]:
    def one(theta):
        def twice(theta):
            moments = problem.moments(theta)
            return moments, moments

        slopes, moments = jax.jacfwd(twice, has_aux=True)(theta)
        return moments, slopes

    return jax.vmap(one)(theta)


@functools.singledispatch
def seen_at(problem: Any, theta: Float[np.ndarray, "points free"]) -> Seen:
    """The problem's moments and their slopes at every θ, as numbers.

    A linear response is computed for `BATCH` points at a time and with slopes also for what a fit usually leaves free, so
    that one compiled program serves any number of points and nearly any choice of free parameters; a Monte Carlo
    simulation for all points together, with the slopes that are asked for.
    """
    if not isinstance(problem.model, Linear):
        return Seen(theta, *jax.tree.map(np.asarray, _moments_and_slopes(problem, theta)))
    count, wide = len(theta), _with_the_usual(problem.coordinates, problem.task)
    own = np.array([wide.names.index(name) for name in problem.coordinates.names])
    padded = np.zeros((-(-count // BATCH) * BATCH, len(wide.names)))
    padded[:, own] = np.concatenate([theta, np.broadcast_to(theta[-1], (len(padded) - count, len(own)))])
    response = _Response(problem.model, problem.task, wide)
    parts = [_moments_and_slopes(response, batch) for batch in np.split(padded, len(padded) // BATCH)]
    moments, slopes = jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)
    return Seen(theta, moments, jax.tree.map(lambda slope: slope[..., own], slopes))


def _with_the_usual(coordinates: Coordinates, task: AbstractTask) -> Coordinates:
    """The coordinates and those of what is usually free, in one order whatever is asked for: θ = 0 is the task's value."""
    known = task.parameter_names
    names = tuple(dict.fromkeys([*(name for name in USUALLY_FREE if name in known), *coordinates.names]))
    given = {name: i for i, name in enumerate(coordinates.names)}
    rows = [(coordinates.centre[given[n]], coordinates.sd[given[n]], coordinates.positive[given[n]]) if n in given
            else (float(task[n]), 1.0, False) for n in names]  # fmt: skip
    centre, sd, positive = (np.array(column) for column in zip(*rows, strict=True))
    return Coordinates(names, centre, sd, positive, np.full(len(names), -np.inf), np.full(len(names), np.inf))


def _residuals(s: Float[Array, " free"], given: tuple[Any, Any, Seen]) -> tuple[Float[Array, " residuals"], None]:
    """Residuals with their slopes at the s where the model was seen: all that a Levenberg-Marquardt step asks for."""
    problem, data, seen = given
    theta = problem.theta(s)
    return problem.residuals(theta, seen.nearby(theta), data), None


SOLVER = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)


@eqx.filter_jit
def _start(problem, data, starts, seen):
    def one(data, s, seen):
        given = (problem, data, seen)
        shape = jax.eval_shape(lambda s: _residuals(s, given)[0], s)
        return SOLVER.init(_residuals, s, given, {}, shape, None, frozenset())

    return eqx.filter_vmap(one)(data, starts, seen)


@eqx.filter_jit
def _step(problem, data, s, state, seen):
    def one(data, s, state, seen):
        s, state, _ = SOLVER.step(_residuals, s, (problem, data, seen), {}, state, frozenset())
        return s, state, 0.5 * (state.f_info.residual**2).sum(), state.num_accepted_steps

    return eqx.filter_vmap(one)(data, s, state, seen)


class _Standing(NamedTuple):
    """Every start (and filled-up) row: where it is and looks next, its cost, accepted steps, successive small gains."""

    s: np.ndarray
    ahead: np.ndarray
    cost: np.ndarray
    accepted: np.ndarray
    small: np.ndarray
    still: np.ndarray
    refused: np.ndarray
    steps: np.ndarray
    active: np.ndarray

    def advanced(self, s: np.ndarray, ahead: np.ndarray, cost: np.ndarray, accepted: np.ndarray) -> "_Standing":
        """After a step of the active rows; the others stay as they are."""
        moved = self.active & (accepted > self.accepted)
        with np.errstate(invalid="ignore"):
            gain = np.where(np.isfinite(self.cost), (self.cost - cost) / self.cost, np.inf)
        small = np.where(moved, np.where(gain < SMALL, self.small + 1, 0), self.small)
        still = np.where(moved, np.where(gain < STILL, self.still + 1, 0), self.still)
        refused = np.where(moved, 0, self.refused + self.active)
        keep = self.active[:, None]
        return _Standing(
            np.where(keep, s, self.s),
            np.where(keep, ahead, self.ahead),
            np.where(self.active, cost, self.cost),
            np.where(self.active, accepted, self.accepted),
            small,
            still,
            refused,
            self.steps + self.active,
            self.active & (still < 2) & (refused < REFUSALS) & np.isfinite(cost),
        )

    def descent(self, count: int) -> Descent:
        settled = (self.small >= 1) & np.isfinite(self.cost)
        return Descent(self.s[:count], self.cost[:count], self.steps[:count], settled[:count])


def descend(
    problem: Any,
    starts: Float[np.ndarray, "starts free"],
    max_steps: int,
    *,
    data: Any = None,
    prepare: Callable[[Any, np.ndarray], Any] = lambda problem, points: problem,
    report: Callable[[Descent], None] = lambda descent: None,
) -> Descent:
    """Minimise `½ Σ r²`, `r = problem.residuals(θ, problem.moments(θ), data)`, from every start.

    `data` has a leading axis of starts: each may have a target of its own; without it all have the problem's.
    Steps to where r is not finite are rejected. A start ends when two accepted steps in a row lower its cost by less than
    `STILL` of it, after `REFUSALS` rejected steps in a row, or if it is not finite; what has ended costs nothing more.
    `prepare(problem, points)` may exchange the problem before each step (sub-steps); `report` sees every step's outcome.
    """
    count, free = starts.shape
    batched = isinstance(problem.model, Linear)
    fill = -count % ROWS if batched else 0
    s = np.concatenate([starts, np.broadcast_to(starts[-1], (fill, free))])
    none, nothing = np.zeros(len(s), dtype=int), np.full(len(s), np.inf)
    now = _Standing(s, s, nothing, none, none, none, none, none, np.arange(len(s)) < count)
    last = np.minimum(np.arange(count + fill), count - 1)
    data = jax.tree.map(lambda x: np.asarray(x)[last], _for_all(problem.data, count) if data is None else data)
    seen = state = None
    for _ in range(max_steps):
        rows = np.flatnonzero(now.active) if batched else np.arange(count)
        problem = prepare(problem, now.ahead[rows])
        new = seen_at(problem, np.asarray(problem.theta(now.ahead[rows])))
        if seen is None:
            seen = jax.tree.map(lambda x: x[last], new)
            state = _start(problem, data, now.s, seen)
        else:
            seen = jax.tree.map(lambda old, x, rows=rows: _put(old, rows, x), seen, new)
        s, state, cost, accepted = _step(problem, data, now.s, state, seen)
        now = now.advanced(*map(np.asarray, (s, state.y_eval, cost, accepted)))
        report(now.descent(count))
        if not np.any(now.active):
            break
    return now.descent(count)


def _for_all(data: Any, count: int) -> Any:
    return jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x))), data)


def _put(old: np.ndarray, rows: np.ndarray, new: np.ndarray) -> np.ndarray:
    whole = old.copy()
    whole[rows] = new
    return whole
