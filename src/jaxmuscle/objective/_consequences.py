"""What follows from a point θ: moments and derived quantities with their slopes, residuals."""

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle.model._parameters import paths_of, set_parameters
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._mechanics import Near, in_parts, value_and_slopes
from jaxmuscle.response._rows import mechanical_rows
from jaxmuscle.response._transfer import half_power_level

from ._derived import (
    derived_names,
    has_tangents,
    of_muscle,
    of_response,
    of_spectrum,
    thirds,
)
from ._moment_models import Linear
from ._residuals import Data, PartResiduals, Residuals, data_residuals, free_size

BATCH = 32


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

    def compared(self, wide: Callable[[np.ndarray], np.ndarray]) -> "Expansion":
        """What residuals follow from, with coordinates made `wide`; a leading axis of points."""
        moments, slopes = (
            tuple(part._replace(resonant=()) for part in parts)
            for parts in (self.moments, self.slopes)
        )
        return Expansion(wide(self.theta), moments, jax.tree.map(wide, slopes))

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
    found = consequences_of_rows(objective, seen)
    return found.values, found.slopes


class Consequences(NamedTuple):
    """Data residuals at one θ and their Jacobian; derived quantities of every part with their
    slopes."""

    residuals: Float[np.ndarray, " residuals"]
    jacobian: Float[np.ndarray, "residuals free"]
    values: Tables
    slopes: Tables


def consequences(objective: Residuals, seen: Expansion) -> Consequences:
    """What follows at the point where the model was seen; slopes with respect to θ."""
    rows = jax.tree.map(lambda x: np.asarray(x)[None], seen)
    return jax.tree.map(lambda x: x[0], consequences_of_rows(objective, rows))


def consequences_of_rows(objective: Residuals, seen: Expansion) -> Consequences:
    """The same at every point where it was seen, with a leading axis of points."""
    found = [_of_part(part, part_of(objective, seen, i)) for i, part in enumerate(objective.parts)]
    spread = objective.spread  # asked for once: every time it makes an object
    return Consequences(
        np.concatenate([rows for rows, *_ in found], axis=1),
        np.concatenate([spread(slopes, i) for i, (_, slopes, *_) in enumerate(found)], axis=1),
        tuple(values for *_, values, _ in found),
        tuple({n: spread(g, i) for n, g in slopes.items()} for i, (*_, slopes) in enumerate(found)),
    )


def _of_part(
    part: PartResiduals, seen: Expansion
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Data residuals and derived quantities of a part, each with its slopes."""
    values, slopes = part.coordinates.values_of(seen.theta), part.coordinates.slope
    known, along = _parameters(part.task, part.coordinates.names, values)
    muscle, by_muscle = _of_muscles(part, values)
    along |= by_muscle
    along = {name: x * slopes(values) for name, x in along.items()}
    (residuals, spectral), (jacobian, by_spectrum) = _of_spectra(part, seen, known)
    found, along = known | muscle | spectral, along | by_spectrum
    points, measured = part.model.points, part.data.stiffness
    if points is not None and measured is not None:
        value, stderr = map(np.asarray, measured)
        at = thirds(np.asarray(points), value[0] + 1j * value[1], stderr)
        response, by = of_response(seen.moments.stiffness, seen.slopes.stiffness, value, at)
        found, along = found | response, along | by
    names = derived_names(part.task, response=points is not None)
    return (
        residuals,
        jacobian,
        {name: found[name] for name in names},
        {name: along[name] for name in names},
    )


_PARAMETERS = {
    ("activation", "time"): "contraction_time",
    ("harmonic", "frequency"): "harmonic_frequency",
}


def _parameters(
    task: AbstractTask, names: tuple[str, ...], values: Float[np.ndarray, "rows own"]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Derived quantities that are parameters, and their slopes with respect to the natural
    values."""
    here = [
        ("noise",) if noise is task.noise else ("noise", "parts", i)
        for i, noise in enumerate(task.noise.components)
        if isinstance(noise, ResonantNoise)
    ]
    wanted = dict(_PARAMETERS)
    for place, which in zip(here, ("resonance", "resonance_2"), strict=False):
        wanted |= {(*place, what): f"{which}_{what}" for what in ("frequency", "width")}
    found, slopes = {}, {}
    for name, path in paths_of(task).items():
        if (quantity := wanted.get(path)) is not None:
            own = np.array(names) == name
            constant = np.full(len(values), float(task[name]))
            found[quantity] = values[:, names.index(name)] if name in names else constant
            slopes[quantity] = np.broadcast_to(own.astype(float), values.shape)
    return found, slopes


def _of_muscles(
    part: PartResiduals, values: Float[np.ndarray, "rows own"]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """`of_muscle` in every row, and the slopes with respect to the natural values."""
    model = part.model
    mean = model.correction.mean if isinstance(model, Linear) else 1.0
    scale = np.full(len(values), mean)
    found, slopes = mechanical_rows(_muscles, part.task, part.coordinates.names, values, scale)
    if not (isinstance(model, Linear) or model.control):  # no linear response
        found["half_power_frequency"] = np.full(len(values), np.nan)
    return found, slopes


@kept
def _muscles(
    task: AbstractTask, names: tuple[str, ...], near: Near, time: Array, scale: Array
) -> tuple[dict[str, Array], dict[str, Array]]:
    def one(near, time, scale):
        def found(both):
            values, moved = dict(zip(names, both[:-1], strict=True)), has_tangents(task)
            there = set_parameters(task, values) if moved else None
            return of_muscle(near.at(both[:-1]), both[-1], there, scale)

        return value_and_slopes(found, jnp.append(near.values, time))

    return jax.vmap(one)(near, time, scale)


def half_power_levels(
    part: PartResiduals,
    theta: Float[np.ndarray, "rows own"],
    log_f: Float[np.ndarray, "rows points"],
) -> tuple[Float[np.ndarray, "rows points"], Float[np.ndarray, "rows points own"]]:
    """`half_power_level` at every row's frequencies [ln Hz], and its slopes with respect to θ."""
    values = part.coordinates.values_of(theta)
    levels, slopes = mechanical_rows(_levels, part.task, part.coordinates.names, values, log_f)
    return levels, slopes * part.coordinates.slope(values)[:, None]


@kept
def _levels(
    task: AbstractTask, names: tuple[str, ...], near: Near, time: Array, log_f: Array
) -> tuple[Array, Array]:
    def one(near, time, log_f):
        def found(both):
            point = near.at(both[:-1])
            return half_power_level(point.system, point.base[0], both[-1], log_f)

        return value_and_slopes(found, jnp.append(near.values, time))

    return jax.vmap(one)(near, time, log_f)


def _of_spectra(
    part: PartResiduals, seen: Expansion, known: dict[str, np.ndarray]
) -> tuple[tuple[np.ndarray, Any], tuple[np.ndarray, Any]]:
    """Data residuals and `of_spectrum` in every row, and their slopes with respect to θ: by a
    program for two resonances and as many coordinates as fits share."""
    count, free = seen.theta.shape
    peaks = [
        known.get(f"{which}_frequency", np.zeros(count)) for which in ("resonance", "resonance_2")
    ]

    def filled(moments: Moments, *shape: int) -> Moments:
        none = np.zeros((count, len(part.model.chosen), *shape))
        resonant = (*moments.resonant, none, none)[:2]
        return moments._replace(resonant=resonant)

    more = free_size(free) - free
    slopes = jax.tree.map(
        lambda x: np.pad(x, [*[(0, 0)] * (np.ndim(x) - 1), (0, more)]), filled(seen.slopes, free)
    )
    settings = part.task.settings
    given = as_arrays((settings.frequency[part.model.chosen], settings.resolution))
    program = functools.partial(_spectra, part.data, *given)
    values, slopes = in_parts(program, filled(seen.moments), slopes, np.stack(peaks, axis=1))
    return values, jax.tree.map(lambda x: x[..., :free], slopes)


@kept
def _spectra(
    data: Data,
    frequency: Float[Array, " bins"],
    resolution: Float[Array, ""],
    moments: Moments,
    slopes: Moments,
    peaks: Float[Array, "rows resonances"],
) -> tuple[Any, Any]:
    def one(moments, slopes, peaks):
        def found(away):
            near = jax.tree.map(lambda x, slope: x + slope @ away, moments, slopes)
            return (
                data_residuals(near, data),
                of_spectrum(near, frequency, resolution, peaks),
            )

        return value_and_slopes(found, jnp.zeros(slopes.power.shape[-1]))

    return jax.vmap(one)(moments, slopes, peaks)


@kept
def _moments_and_slopes(
    part: Any, theta: Float[Array | np.ndarray, "points free"]
) -> tuple[Any, Any]:
    return jax.vmap(lambda theta: value_and_slopes(part.moments, theta))(theta)


def expand(
    objective: Any, theta: Float[np.ndarray, "points free"], *, slopes: bool = True
) -> Expansion:
    """The moments of every part and their slopes at every θ, as numbers; without `slopes`, and
    along what is not moving, these are not computed, and zero."""
    moving = np.asarray(objective.moving) * slopes
    each = [
        _expanded(part, np.asarray(objective.own(theta, i)), objective.own(moving, i) > 0)
        for i, part in enumerate(objective.parts)
    ]
    spread = objective.spread  # asked for once: every time it makes an object
    along = tuple(
        jax.tree.map(lambda g, i=i: spread(g, i), slopes) for i, (_, slopes) in enumerate(each)
    )
    return Expansion(theta, tuple(moments for moments, _ in each), along)


def _expanded(
    part: Any, theta: Float[np.ndarray, "points own"], moving: Bool[np.ndarray, " own"]
) -> tuple[Any, Any]:
    """Moments of one part and their slopes along what is moving: a linear response by the programs
    that all share, a Monte Carlo simulation for all points together."""
    if not isinstance(part.model, Linear):
        return jax.tree.map(np.asarray, _moments_and_slopes(part, theta))
    names, values = part.coordinates.names, part.coordinates.values_of(theta)
    along = tuple(itertools.compress(names, moving))
    moments, slopes = part.model.of_rows(part.task, names, values, along)
    stretch = part.coordinates.slope(values)[:, moving]

    def spread(x: np.ndarray) -> np.ndarray:
        whole = np.zeros((*np.shape(x)[:-1], len(names)))
        with np.errstate(invalid="ignore"):  # of rows where a search runs off
            whole[..., moving] = x * stretch.reshape(len(values), *[1] * (np.ndim(x) - 2), -1)
        return whole

    return moments, jax.tree.map(spread, slopes)
