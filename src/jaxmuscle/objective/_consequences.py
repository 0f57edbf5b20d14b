"""What follows from a point θ: moments and derived quantities with their slopes, residuals."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmuscle._common.programs import kept
from jaxmuscle.model._parameters import USUALLY_FREE
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._expected import Moments

from ._coordinates import Coordinates, task_at
from ._derived import derived
from ._moment_models import Linear
from ._residuals import PartResiduals, Residuals


def frequency_of(part: PartResiduals) -> Float[Array, " bins"]:
    """Frequencies of the compared bins [Hz]."""
    return jnp.asarray(part.task.settings.frequency)[part.model.chosen]


BATCH = 32
# free with a known mean force, with a moved insertion and in designs, mostly together
SOMETIMES = ("P_w", "m_w", "m_z")
POINTS = 128
LATEST = 4


class Expansion(NamedTuple):
    """What a fit's model gives at some θ, and its slopes with respect to θ; a leading axis of
    points.

    Of a part: `Moments`. Of all parts: a tuple of these.
    """

    theta: Any
    moments: Any
    slopes: Any

    def near(self, theta: Float[Array, " free"]) -> Any:
        """The moments at another θ to first order (without the leading axis); exact, with exact
        slopes, at `self.theta`."""
        return jax.tree.map(
            lambda value, slope: value + slope @ (theta - self.theta), self.moments, self.slopes
        )

    def row(self, i: int) -> "Expansion":
        """At one of the points."""
        return jax.tree.map(lambda x: np.asarray(x)[i], self)


def part_of(objective: Residuals, seen: Expansion, i: int) -> Expansion:
    """What was seen of one part, with slopes with respect to its own coordinates."""
    own = objective.own
    slopes = jax.tree.map(lambda slope: own(slope, i), seen.slopes[i])
    return Expansion(own(seen.theta, i), seen.moments[i], slopes)


Tables = tuple[dict[str, np.ndarray], ...]


def quantities(objective: Residuals, seen: Expansion) -> tuple[Tables, Tables]:
    """Derived quantities of every part, rows where the model was seen, and their slopes with
    respect to θ."""
    found = [
        jax.tree.map(np.asarray, _quantities(part, part_of(objective, seen, i)))
        for i, part in enumerate(objective.parts)
    ]
    spread = objective.spread  # asked for once: every time it makes an object
    slopes = tuple(
        {n: spread(g, i) for n, g in slopes.items()} for i, (_, slopes) in enumerate(found)
    )
    return tuple(values for values, _ in found), slopes


@kept
def _quantities(part: PartResiduals, seen: Expansion) -> tuple[dict[str, Array], dict[str, Array]]:
    def one(seen):
        def everything(theta):
            values = derived(
                task_at(part.task, part.coordinates, theta), seen.near(theta), frequency_of(part)
            )
            return values, values

        slopes, values = jax.jacfwd(everything, has_aux=True)(seen.theta)
        return values, slopes

    return jax.lax.map(one, seen)


class Consequences(NamedTuple):
    """Data residuals at one θ and their Jacobian; derived quantities of every part with their
    slopes."""

    residuals: Float[np.ndarray, " residuals"]
    jacobian: Float[np.ndarray, "residuals free"]
    values: Tables
    slopes: Tables


def consequences(objective: Residuals, seen: Expansion) -> Consequences:
    """What follows at the point where the model was seen; slopes with respect to θ. By the program
    of `BATCH` points."""
    rows = jax.tree.map(lambda x: np.broadcast_to(x, (BATCH, *np.shape(x))), seen)
    return jax.tree.map(lambda x: x[0], consequences_of_rows(objective, rows))


def consequences_of_rows(objective: Residuals, seen: Expansion) -> Consequences:
    """The same at every point where it was seen, with a leading axis of points."""
    found = [
        jax.tree.map(np.asarray, _consequences(part, part_of(objective, seen, i)))
        for i, part in enumerate(objective.parts)
    ]
    spread = objective.spread  # asked for once: every time it makes an object
    return Consequences(
        np.concatenate([values[0] for values, _ in found], axis=1),
        np.concatenate([spread(slopes[0], i) for i, (_, slopes) in enumerate(found)], axis=1),
        tuple(values[1] for values, _ in found),
        tuple(
            {n: spread(g, i) for n, g in slopes[1].items()} for i, (_, slopes) in enumerate(found)
        ),
    )


@kept
def _consequences(part: PartResiduals, seen: Expansion) -> tuple[Any, Any]:
    def one(seen):
        def everything(theta):
            moments = seen.near(theta)
            task = task_at(part.task, part.coordinates, theta)
            values = (
                part.data_residuals(moments, part.data),
                derived(task, moments, frequency_of(part)),
            )
            return values, values

        slopes, values = jax.jacfwd(everything, has_aux=True)(seen.theta)
        return values, slopes

    return jax.lax.map(one, seen)


class _Response(eqx.Module):
    """What the moments of a linear response depend on, and nothing else, so that a program is used
    again."""

    model: Linear
    task: AbstractTask
    coordinates: Coordinates

    def moments(self, theta: Float[Array, " free"]) -> Moments:
        return self.model.moments(task_at(self.task, self.coordinates, theta))


@kept
def _moments_and_slopes(
    part: Any, theta: Float[Array | np.ndarray, "points free"]
) -> tuple[Any, Any]:
    return jax.vmap(lambda theta: _with_slopes(part, theta))(theta)


@eqx.filter_jit  # traced once, though asked for its shape, too
def _with_slopes(part: Any, theta: Float[Array, " free"]) -> tuple[Any, Any]:
    def twice(theta):
        moments = part.moments(theta)
        return moments, moments

    slopes, moments = jax.jacfwd(twice, has_aux=True)(theta)
    return moments, slopes


@kept
def _of_rows(
    part: Any, theta: Float[Array | np.ndarray, "points free"], count: Any
) -> tuple[Any, Any]:
    """Moments and slopes of the first `count` points, one after the other; zeros for the others,
    which so take no time.

    Two mapped at once would run a fifth faster, and take a third longer to trace and to compile.
    """

    def put(i: Any, found: Any) -> Any:
        new = _with_slopes(part, jax.lax.dynamic_index_in_dim(theta, i, keepdims=False))
        return jax.tree.map(
            lambda all, new: jax.lax.dynamic_update_index_in_dim(all, new, i, 0), found, new
        )

    one = jax.eval_shape(_with_slopes, part, theta[0])
    nothing = jax.tree.map(lambda x: jnp.zeros((len(theta), *x.shape), x.dtype), one)
    return jax.lax.fori_loop(0, count, put, nothing)


def expand(objective: Any, theta: Float[np.ndarray, "points free"]) -> Expansion:
    """The moments of every part and their slopes at every θ, as numbers.

    Part by part: each has the program of a fit alone. (One program of two kinds of task hangs under
    jaxlib 0.10.2.)
    """
    each = [
        _expanded(part, np.asarray(objective.own(theta, i)))
        for i, part in enumerate(objective.parts)
    ]
    spread = objective.spread  # asked for once: every time it makes an object
    slopes = tuple(
        jax.tree.map(lambda g, i=i: spread(g, i), slopes) for i, (_, slopes) in enumerate(each)
    )
    return Expansion(theta, tuple(moments for moments, _ in each), slopes)


def _expanded(part: Any, theta: Float[np.ndarray, "points own"]) -> tuple[Any, Any]:
    """Moments of one part and their slopes.

    A linear response is computed for at most `POINTS` points at a time and with slopes also for
    what a fit usually leaves free, so that one compiled program serves any number of points and
    nearly any choice of free parameters; a Monte Carlo simulation for all points together, with the
    slopes that are asked for.
    """
    if not isinstance(part.model, Linear):
        return jax.tree.map(np.asarray, _moments_and_slopes(part, theta))
    count, (response, own) = len(theta), _response_of(part, part.model)
    padded = np.zeros((-(-count // POINTS) * POINTS, len(response.coordinates.names)))
    padded[:, own] = np.concatenate(
        [theta, np.broadcast_to(theta[-1], (len(padded) - count, len(own)))]
    )
    parts = [
        _of_rows(response, padded[i : i + POINTS], np.asarray(min(count - i, POINTS)))
        for i in range(0, count, POINTS)
    ]
    moments, slopes = jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)
    return moments, jax.tree.map(lambda slope: slope[..., own], slopes)


_LATEST: list[tuple[Any, tuple[_Response, np.ndarray]]] = []


def _response_of(part: PartResiduals, model: Linear) -> tuple[_Response, Int[np.ndarray, " own"]]:
    """What is expanded of a part, and where its own coordinates stand in that; of the latest parts
    made only once."""
    for known, found in _LATEST:
        if known is part:
            return found
    wide = _with_the_usual(part.coordinates, part.task)
    own = np.array([wide.names.index(name) for name in part.coordinates.names], dtype=int)
    found = _Response(model, part.task, wide), own
    _LATEST[:] = [(part, found), *_LATEST[: LATEST - 1]]
    return found


def _with_the_usual(coordinates: Coordinates, task: AbstractTask) -> Coordinates:
    """The coordinates and those of what is usually free, in one order whatever is asked for: θ = 0
    is the task's value.

    All of `SOMETIMES` are there if one is asked for: a fit with a mean force and a design then
    share a program.
    """
    known, own = task.parameter_names, coordinates.names
    usual = (*USUALLY_FREE, *(SOMETIMES if any(name in own for name in SOMETIMES) else ()))
    names = tuple(dict.fromkeys([*(name for name in usual if name in known), *own]))
    given = {name: i for i, name in enumerate(own)}
    rows = [
        (
            (coordinates.centre[given[n]], coordinates.sd[given[n]], coordinates.positive[given[n]])
            if n in given
            else (float(task[n]), 1.0, False)
        )
        for n in names
    ]
    centre, sd, positive = (np.array(column) for column in zip(*rows, strict=True))
    return Coordinates(
        names, centre, sd, positive, np.full(len(names), -np.inf), np.full(len(names), np.inf)
    )
