"""The linear response of many tasks at once, with slopes, by programs that tasks of every make
share (docs/model.md, *By few programs*).

A program of the mechanics, one of what the noise is made of, one for a part of the noise and a
direction, two for the line.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._parameters import set_parameters
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._signals import Constant
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._settings import LONGEST, WINDOW, SpectrumSettings

from ._autocovariance import DECAY, Chain, chains, sampled_autocovariance, stacked
from ._expected import (
    Moments,
    covariance_operator,
    expected_powers,
    lags_of,
    log_variation_sd,
    low_pass_spread,
)
from ._harmonic_line import (
    LONG,
    LineTable,
    Segments,
    harmonic_line,
    harmonic_size,
    segments_of,
    table_of,
)
from ._input_response import stiffness_rows
from ._linear_task import Linearisation, LinearTask
from ._mechanics import Mechanics, Near, Operating, in_parts, value_and_slopes
from ._transfer import SignalSystem, harmonic_system, transfer

MANY = 512  # points that are held at once
# Rows of a call; of a block, enough for vectors, few enough that a call for one point is short; of
# a block of lines, whose frequencies are few.
ROWS, BLOCK, FEW = 512, 32, 8
# Sizes of the large program: states behind those of a task, and channels. A filter alone; a filter
# and an activation. What has more channels is parts of their own.
SIZES = ((2, 4), (4, 2))
LEAST_LAGS, LEAST_BINS = 512, 32


class Sampling(NamedTuple):
    """How moments are sampled: settings and window of the spectrum, number of samples of the
    recording whose variance it is, and the interval [s] at which it was recorded, as in
    `response`."""

    settings: SpectrumSettings
    window: tuple[float, float]
    samples: Int[Array | np.ndarray, ""] | int
    recorded: Scalar


def moments_of_rows(
    task: AbstractTask,
    own: Sequence[str],
    values: Float[np.ndarray, "rows own"],
    sampled: Sampling,
    points: Float[np.ndarray, " points"] | None = None,
    along: Sequence[str] | None = None,
    *,
    spectral: bool = True,
) -> tuple[Moments, Moments, Linearisation]:
    """Moments of the task with each row of natural values for its `own` names, their slopes `along`
    these (or some of them) in a last axis, and the linearisations. As `response`, whose numbers
    these are. Unless `spectral`, power and variance are not computed, and one.

    A moment is a sum over the parts p of the noise, M = Σ_p m(x_p), and its slope with respect to a
    value v is `Σ_p m'(x_p) dx_p/dv`: a row of the large program is a part and one direction. So it
    costs what is asked for, however many parts there are.
    """
    sampled = sampled._replace(
        samples=as_arrays(sampled.samples, int), recorded=as_arrays(sampled.recorded)
    )
    many = _Many(task, tuple(own), tuple(own if along is None else along), sampled, spectral)
    found = [many.moments(values[i : i + MANY], points) for i in range(0, len(values), MANY)]
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


class _Line(NamedTuple):
    """A steady harmonic: what responds to it, its size (real and imaginary part), its frequency."""

    system: SignalSystem
    size: Float[Array | np.ndarray, "2"]
    frequency: Float[Array | np.ndarray, ""]


def _with_values(
    task: LinearTask, names: tuple[str, ...], values: Array, point: Operating
) -> AbstractTask:
    """The task with these values of noise, harmonic and activation, and base coefficients."""
    own = task.parameter_names
    return set_parameters(
        eqx.tree_at(lambda t: t.muscle.coefficients, task, point.base),
        {n: v for n, v in zip(names, values, strict=True) if n in own},
    )


def _of_values(function: Callable[[Any, Any], Any], given: Any, values: Any, near: Near) -> Any:
    """`function(task, balanced system)` of a task with each row of values, the mechanical ones
    first, and its slopes. `given`: the task and the names of the values."""

    task, names = given

    def one(values, near):
        def at(values):
            point = near.at(values[: len(near.values)])
            return function(_with_values(task, names, values, point), point.balanced)

        return value_and_slopes(at, values)

    return jax.vmap(one)(values, near)


@kept
def _parts_of(given: tuple[LinearTask, tuple[str, ...]], values: Any, near: Near) -> Any:
    """The parts of a noise that is alone in its task, of each size (or nothing): `_of_values`."""
    states = len(given[0].system.A)
    limits = [0, *(states + more for more, _ in SIZES[:-1]), np.inf]

    def parts(there, system):
        (whole,) = chains(there, system)
        found = []
        for i, (more, channels) in enumerate(SIZES):
            own = [x for x in whole if limits[i] < max(len(x.matrix), 1) <= limits[i + 1]]
            few = [x for part in own for x in part.split(channels)]
            found.append(stacked(few, states + more, channels) if few else ())
        return tuple(found)

    return _of_values(parts, given, values, near)


@kept
def _line_of(given: tuple[LinearTask, tuple[str, ...]], values: Any, near: Near) -> Any:
    """The line of a task: `_of_values`."""
    size = len(given[0].system.A) + 2  # with the states of an activation

    def line(there, system):
        reply = harmonic_size(there, system.A.dtype)
        return _Line(
            _filled(harmonic_system(there, system), size),
            jnp.stack([jnp.real(reply), jnp.imag(reply)]),
            jnp.asarray(there.harmonic.frequency, system.A.dtype),
        )

    return _of_values(line, given, values, near)


@kept
def _enveloped(
    sampled: tuple[SpectrumSettings, tuple[float, float]],
    given: tuple[LinearTask, tuple[str, ...]],
    values: Any,
    near: Near,
) -> Any:
    """`harmonic_line` under an envelope that moves: `_of_values`."""
    return _of_values(
        lambda there, system: harmonic_line(there, system, *sampled, 1), given, values, near
    )


def _filled(system: SignalSystem, size: int) -> SignalSystem:
    """With states that nothing drives or reads."""
    more = size - len(system.A)
    idle = -DECAY * jnp.eye(more, dtype=system.A.dtype)
    A = jax.scipy.linalg.block_diag(system.A, idle)
    return SignalSystem(A, jnp.pad(system.b, (0, more)), jnp.pad(system.c, (0, more)), *system[3:])


def _in_blocks(
    function: Callable[[Any], Any], rows: Any, towards: Any, count: Array, block: int = BLOCK
) -> Any:
    """A function of rows along a leading axis, and its slope in one direction for each: of the
    first `count`, a `block` at a time; zeros for the others, which so take no time."""

    def at(i):
        cut = functools.partial(
            jax.lax.dynamic_slice_in_dim, start_index=i * block, slice_size=block
        )
        return jax.jvp(function, (jax.tree.map(cut, rows),), (jax.tree.map(cut, towards),))

    def put(i, found):
        return jax.tree.map(
            lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, i * block, 0),
            found,
            at(i),
        )

    size = len(jax.tree.leaves(rows)[0])
    nothing = jax.tree.map(
        lambda x: jnp.zeros((size, *x.shape[1:]), x.dtype), jax.eval_shape(at, 0)
    )
    return jax.lax.fori_loop(0, (count + block - 1) // block, put, nothing)


@kept
def _noise_rows(
    parts: Chain,
    towards: Chain,
    count: Any,
    operator: Float[Array | np.ndarray, "bins_and_two lags"] | SpectrumSettings,
    interval: Float[Array | np.ndarray, ""],
    sampling: str,
    samples: Any,
    recorded: Any,
) -> tuple[Any, Any]:
    """Welch power of parts of the noise in every bin, the variance of so many low-passed samples,
    and their slopes in one direction for each."""
    lags = lags_of(operator) if isinstance(operator, SpectrumSettings) else operator.shape[1]

    def spectrum(parts):
        each = sampled_autocovariance(parts, interval, max(lags, LONGEST), sampling, recorded)
        r = each.lagged(lags)
        if isinstance(operator, SpectrumSettings):
            found = jax.lax.map(functools.partial(expected_powers, operator), r)
        else:
            found = r @ operator.T
        own, lowered = found[:, -2], found[:, -1] / jnp.asarray(samples, r.dtype) ** 2
        return found[:, :-2], own - each.mean_variance(samples) + lowered

    return _in_blocks(spectrum, parts, towards, count)


@kept
def _line_tables(
    frequency: Float[Array | np.ndarray, " rows"],
    count: Any,
    segments: Segments | tuple[SpectrumSettings, tuple[float, float]],
    sampling: str,
    samples: Any,
) -> tuple[LineTable, LineTable]:
    """Of every frequency, and their slopes with respect to it."""
    made = segments if isinstance(segments, Segments) else segments_of(*segments)
    settings = None if isinstance(segments, Segments) else segments[0]

    def tables(frequency):
        return jax.vmap(lambda f: table_of(made, f, samples, sampling, settings))(frequency)

    return _in_blocks(tables, frequency, jnp.ones_like(frequency), count, FEW)


@kept
def _replies(
    system: SignalSystem, frequency: Float[Array | np.ndarray, " lines"]
) -> Float[Array, " lines"]:
    """Mean square of the response to an input of amplitude √2 of each frequency [Hz]."""
    return jnp.abs(jax.vmap(lambda f: transfer(system, 2 * jnp.pi * f))(frequency)) ** 2


def line_levels(
    task: AbstractTask, settings: SpectrumSettings, frequency: Float[np.ndarray, " lines"]
) -> tuple[Float[np.ndarray, "lines bins"], Float[np.ndarray, " lines"]]:
    """Of lines of these frequencies [Hz] in the output: Welch power of a mean square of 1 behind
    the low-pass, the phase averaged; and the mean square behind the low-pass that a harmonic of
    amplitude √2 has."""
    many = _Many(task, (), (), Sampling(settings, WINDOW, as_arrays(1, int), 0.0))
    here = Mechanics.of(task)
    line, _ = many.about(_line_of, here, ("harmonic",), *here.at(np.zeros((1, 0))))
    system = jax.tree.map(lambda x: x[0], line.system)
    table, _ = many.tables(as_arrays(frequency))
    passed = np.asarray(table.passed)
    levels = np.asarray(table.level)[:, 0, : len(settings.frequency)] / passed[:, None]
    return 2 * levels, np.asarray(_replies(system, as_arrays(frequency))) * passed


@kept
def _line_rows(
    given: tuple[_Line, LineTable],
    towards: tuple[_Line, LineTable],
    count: Any,
) -> tuple[Any, Any]:
    """Power in every bin and variance of lines, and their slopes in one direction for each."""

    def one(line, table):
        reply = jax.lax.complex(*line.size) * transfer(line.system, 2 * jnp.pi * line.frequency)
        return table.power(reply), table.variance(reply)

    return _in_blocks(lambda given: jax.vmap(one)(*given), given, towards, count)


def mechanical_rows(
    program: Callable[..., Any],
    task: AbstractTask,
    own: Sequence[str],
    values: Float[np.ndarray, "rows own"],
    *given: np.ndarray,
) -> tuple[Any, Any]:
    """What a program makes of (the bare task, the names of its mechanical values, the
    linearisations of `POINTS` rows, contraction times there, whatever is given for each row), and
    its slopes with respect to one's own values along a last axis.

    The program's slopes are with respect to the mechanical values, then the contraction time (0
    without an activation).
    """
    here = Mechanics.of(task, own)
    _, near = here.at(values)
    time = np.full(len(values), 0.0 if task.activation is None else float(task.activation.time))
    if "activation_time" in own:
        time = values[:, list(own).index("activation_time")]
    value, slopes = in_parts(
        functools.partial(program, here.bare, here.moving), near, *as_arrays((time, *given))
    )
    return value, _widened(slopes, (*here.moving, "activation_time"), own)


def _widened(slopes: Any, names: Sequence[str], own: Sequence[str]) -> Any:
    """Slopes with respect to some values as slopes with respect to one's own."""
    place = np.array([names.index(n) if n in names else len(names) for n in own], dtype=int)
    return jax.tree.map(
        lambda x: np.concatenate([x, np.zeros((*x.shape[:-1], 1), x.dtype)], -1)[..., place],
        slopes,
    )


class _Rows(NamedTuple):
    """Rows of a large program, for points and parts: each has a part of one point, and the column
    of the direction in which its slope is."""

    part: np.ndarray
    column: np.ndarray

    @classmethod
    def of(cls, slopes: Any, parts: int) -> "_Rows":
        """A row for every part and each column that it depends on anywhere; the first column for
        one that depends on none."""
        leaves = [np.asarray(x) for x in jax.tree.leaves(slopes)]
        moves = np.zeros((parts, leaves[0].shape[-1]), dtype=bool)
        for x in leaves:
            axes = (0, *range(2, x.ndim - 1))
            moves |= np.any(x != 0, axis=axes)
        if moves.shape[1]:
            moves[~np.any(moves, axis=1), 0] = True
            return cls(*np.nonzero(moves))
        return cls(np.arange(parts), np.full(parts, -1))

    def run(self, program: Callable[..., Any], given: Any, slopes: Any) -> tuple[Any, Any]:
        """The program's results for every point and row, and their slopes in the rows'
        directions."""
        points = len(jax.tree.leaves(given)[0])
        rows = jax.tree.map(lambda x: _flat(np.asarray(x)[:, self.part]), given)
        towards = jax.tree.map(lambda x: _flat(self._directions(np.asarray(x))), slopes)
        found = _in_calls(program, rows, towards)
        return jax.tree.map(lambda x: x.reshape(points, len(self.part), *x.shape[1:]), found)

    def _directions(self, slopes: np.ndarray) -> np.ndarray:
        if not slopes.shape[-1]:
            return np.zeros((*slopes.shape[:1], len(self.part), *slopes.shape[2:-1]), slopes.dtype)
        return np.moveaxis(slopes[:, self.part, ..., self.column], 0, 1)

    def first(self) -> np.ndarray:
        """Of every part a row, in order."""
        return np.unique(self.part, return_index=True)[1]

    def spread(self, along: np.ndarray, parts: int, columns: int) -> np.ndarray:
        """What is along the rows' directions as slopes of every part along a last axis."""
        found = np.zeros((len(along), parts, *along.shape[2:], columns), along.dtype)
        if columns:
            found[:, self.part, ..., self.column] = np.moveaxis(along, 1, 0)
        return found


def _flat(x: np.ndarray) -> np.ndarray:
    return x.reshape(-1, *x.shape[2:])


def _in_calls(program: Callable[..., Any], *rows: Any) -> Any:
    """What a program for `ROWS` rows makes of any number of them; it is told how many count."""
    whole, found = len(jax.tree.leaves(rows)[0]), []
    for i in range(0, whole, ROWS):
        count = min(ROWS, whole - i)

        def cut(x: np.ndarray, i: int = i, count: int = count) -> np.ndarray:
            filled = np.zeros((ROWS, *x.shape[1:]), x.dtype)
            filled[:count] = x[i : i + count]
            return filled

        made = program(*jax.tree.map(cut, rows), np.asarray(count))
        found.append(jax.tree.map(lambda x, count=count: np.asarray(x)[:count], made))
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


class _Many(NamedTuple):
    """One task, to be seen with many values of its `own` parameters, and slopes along some."""

    task: AbstractTask
    own: tuple[str, ...]
    along: tuple[str, ...]
    sampled: Sampling
    spectral: bool = True

    def seen(self, values: np.ndarray) -> "_Seen":
        """At some rows."""
        here = Mechanics.of(self.task, self.own)
        whole, near = here.at(values)
        each = [
            self.about(_parts_of, here, ("noise", *place), whole, near) for place in here.components
        ]
        groups = []
        for size in range(len(SIZES)):
            own = [(i, x[size], by[size]) for i, (x, by) in enumerate(each) if x[size] != ()]
            if own:
                component = [[i] * x.matrix.shape[1] for i, x, _ in own]
                found = [(x, by) for _, x, by in own]
                groups.append(
                    _Group(
                        np.concatenate(component),
                        *jax.tree.map(lambda *x: np.concatenate(x, axis=1), *found),
                    )
                )
        line = by_line = None
        if isinstance(self.task.harmonic.envelope, Constant):
            line, by_line = self.about(_line_of, here, ("harmonic",), whole, near)
        return _Seen(here, whole, near, groups, line, by_line)

    def about(
        self, program: Any, here: Mechanics, about: tuple, whole: np.ndarray, near: Near
    ) -> tuple[Any, Any]:
        """A program about one component, and its slopes along one's own."""
        *given, columns = here.task_about(about)
        found, slopes = in_parts(functools.partial(program, tuple(given)), whole[:, columns], near)
        return found, _widened(slopes, [here.names[i] for i in columns], self.along)

    def moments(
        self, values: np.ndarray, points: np.ndarray | None
    ) -> tuple[Moments, Moments, Linearisation]:
        """Of some rows."""
        here = Mechanics.of(self.task, self.own)
        near = here.at(values)[1]

        def widened(slope: Any) -> np.ndarray:
            return _widened(slope, here.moving, self.along)

        power, line, variance, resonant = self._spectra(values)
        stiffness: Any = ((), ())
        if points is not None:
            value, slope = stiffness_rows(here, near, points)
            stiffness = value, widened(slope)
        system = near.point.system
        mean = system.rest, widened(near.slopes.system.rest)
        value, slope = (
            Moments(*each)
            for each in zip(power, line, mean, variance, resonant, stiffness, strict=True)
        )
        return value, slope, system

    def _spectra(self, values: np.ndarray) -> tuple[Any, ...]:
        """Power of all and of the harmonic, variance, power of the resonances, each with its
        slopes."""
        if not self.spectral:
            return self._ones(len(values))
        seen = self.seen(values)
        power, variance, resonant = self.noise(seen)
        line, swing = self.line(seen)
        power, variance = (
            tuple(x + own for x, own in zip(*both, strict=True))
            for both in ((power, line), (variance, swing))
        )
        return power, line, variance, resonant

    def _ones(self, rows: int) -> tuple[Any, ...]:
        """In place of spectra that nobody asks for."""
        components, columns = self.task.noise.components, len(self.along)
        each = np.ones((rows, len(self.sampled.settings.frequency)))
        count = sum(isinstance(noise, ResonantNoise) for noise in components)
        resonant = (each,) * count
        found = each, 0 * each, np.ones(rows), resonant
        return tuple((x, jax.tree.map(lambda x: np.zeros((*x.shape, columns)), x)) for x in found)

    def noise(self, seen: "_Seen") -> tuple[Any, ...]:
        """Power and variance of all noise, and power of every resonance, each with its slopes."""
        settings = self.sampled.settings
        program = functools.partial(
            _noise_rows,
            operator=as_arrays(_arrays_of(settings, self.sampled.window)[0]),
            interval=as_arrays(1 / settings.rate),
            sampling=settings.sampling,
            samples=self.sampled.samples,
            recorded=self.sampled.recorded,
        )
        each = [group.run(program, len(settings.frequency)) for group in seen.groups]
        power, by_power, variance, by_variance = (
            np.concatenate(x, axis=1) for x in zip(*each, strict=True)
        )
        component = np.concatenate([group.component for group in seen.groups])
        resonant = (
            tuple(
                np.sum(x[:, component == i], axis=1)
                for i, noise in enumerate(self.task.noise.components)
                if isinstance(noise, ResonantNoise)
            )
            for x in (power, by_power)
        )
        power, variance = (
            tuple(np.sum(x, axis=1) for x in both)
            for both in ((power, by_power), (variance, by_variance))
        )
        return power, variance, tuple(resonant)

    def line(self, seen: "_Seen") -> tuple[Any, Any]:
        """Power and variance of the harmonic, each with its slopes."""
        line, by = seen.line, seen.by_line
        if line is None or by is None:
            return self._enveloped(seen)
        settings, frequency = self.sampled.settings, np.asarray(line.frequency)
        different, back = np.unique(frequency, return_inverse=True)
        table, slope = jax.tree.map(lambda x: x[back], self.tables(different))
        by_table = jax.tree.map(
            lambda x: x[..., None] * by.frequency.reshape(len(x), *[1] * (x.ndim - 1), -1), slope
        )
        given, slopes = jax.tree.map(lambda x: x[:, None], ((line, table), (by, by_table)))
        rows = _Rows.of(slopes, 1)
        (power, swing), (along, rise) = rows.run(_line_rows, given, slopes)
        bins, columns = len(settings.frequency), len(self.along)
        by_power = rows.spread(along[..., :bins], 1, columns)[:, 0]
        by_swing = rows.spread(rise, 1, columns)[:, 0]
        return (power[:, 0, :bins], by_power), (swing[:, 0], by_swing)

    def tables(self, frequency: Float[np.ndarray, " lines"]) -> tuple[LineTable, LineTable]:
        """What a line of each frequency [Hz] comes to, and its slopes with respect to it."""
        settings = self.sampled.settings
        segments = _arrays_of(settings, self.sampled.window)[1]
        segments = as_arrays(segments) if isinstance(segments, Segments) else segments
        sampling = settings.sampling, self.sampled.samples
        return _in_calls(lambda f, n: _line_tables(f, n, segments, *sampling), frequency)

    def _enveloped(self, seen: "_Seen") -> tuple[Any, Any]:
        sampled = self.sampled.settings, self.sampled.window
        program = functools.partial(_enveloped, sampled)
        found, slopes = self.about(program, seen.here, ("harmonic",), seen.whole, seen.near)
        (power, swing), (by_power, by_swing) = found, slopes
        return (power, by_power), (swing, by_swing)


class _Group(NamedTuple):
    """Parts of the noise of one size, with the component that each belongs to, and their slopes."""

    component: Int[np.ndarray, " parts"]
    parts: Chain
    slopes: Chain

    def run(self, program: Any, bins: int) -> tuple[np.ndarray, ...]:
        """Power in the bins, its slopes, variance and its slopes, of each point and part."""
        count, columns = len(self.component), self.slopes.matrix.shape[-1]
        rows = _Rows.of(self.slopes, count)
        (power, variance), (along, rise) = rows.run(program, self.parts, self.slopes)
        first = rows.first()
        return (
            power[:, first, :bins],
            rows.spread(along[..., :bins], count, columns),
            variance[:, first],
            rows.spread(rise, count, columns),
        )

    def alone(self, size: int, channels: int) -> Any:
        """Of a single point a `Chain` of numbers, filled up as `Chain.filled` does."""
        matrix, white, rows = (np.asarray(x)[0] for x in self.parts)
        more, fewer = size - matrix.shape[-1], channels - rows.shape[1]
        whole = np.zeros((len(matrix), size, size)) - DECAY * np.eye(size)
        whole[:, : size - more, : size - more] = matrix
        white = np.pad(white, ((0, 0), (0, more), (0, 0)))
        rows = np.pad(rows, ((0, 0), (0, fewer), (0, more)))
        return self.parts._replace(matrix=whole, white=white, rows=rows)


class _Seen(NamedTuple):
    """What is known of some rows: values of all names, operating points, the parts of the noise,
    and the line with its slopes."""

    here: Mechanics
    whole: np.ndarray
    near: Near
    groups: list[_Group]
    line: _Line | None
    by_line: _Line | None

    def alone(self) -> Chain:
        """All parts of a single point in one shape."""
        parts = [group.parts for group in self.groups]
        states, most = len(self.near.point.system.A[0]) + SIZES[-1][0], SIZES[0][1]
        size = max(states, *(x.matrix.shape[-1] for x in parts))
        channels = max(most, *(x.rows.shape[2] for x in parts))
        each = [group.alone(size, channels) for group in self.groups]
        return jax.tree.map(lambda *x: np.concatenate(x), *each)


def noise_parts(task: AbstractTask) -> tuple[Chain, Int[np.ndarray, " parts"]]:
    """The parts of a task's noise along a leading axis, and which component each belongs to."""
    many = _Many(task, (), (), Sampling(task.settings, WINDOW, 0, 0.0))
    seen = many.seen(np.zeros((1, 0)))
    return seen.alone(), np.concatenate([group.component for group in seen.groups])


def variation_sd_of_numbers(task: AbstractTask, sampled: Sampling, lags: int) -> Array:
    """`log_variation_sd` of a task's output, good for that many lags."""
    sampled = sampled._replace(samples=as_arrays(sampled.samples, int))
    many, settings = _Many(task, (), (), sampled), sampled.settings
    seen = many.seen(np.zeros((1, 0)))
    swing = many.line(seen)[1][0][0]
    alone = seen.alone()
    parts = len(alone.matrix)
    every = np.arange(-(-parts // 8) * 8)  # a program for 8, 16 ...
    rows = as_arrays(jax.tree.map(lambda x: x[np.minimum(every, parts - 1)], alone))
    given = every < parts, low_pass_of(settings), 1 / settings.rate
    line = swing, task.harmonic.frequency / settings.rate
    sampling = settings.sampling, lags
    given, line = as_arrays((given, line))
    return _variation_of_parts(rows, given, line, sampled.samples, sampling)


@kept
def _variation_of_parts(
    parts: Chain, given: Any, line: Any, samples: Any, sampling: tuple[str, int]
) -> Array:
    """`log_variation_sd` of those parts that count, 1 or 0 for each."""
    (counts, spread, interval), (swing, turns), (kind, lags) = given, line, sampling
    each = sampled_autocovariance(parts, interval, lags, kind, 0.0)
    r, slow = counts @ each.lagged(lags), counts @ each.mean_variance(samples)
    return log_variation_sd(r, spread, slow, swing, turns, samples)


@functools.cache
def _arrays_of(
    settings: SpectrumSettings, window: tuple[float, float]
) -> tuple[Any, Any, np.ndarray]:
    """What programs take of some settings, as arrays: `padded_operator`, `padded_segments` (or the
    settings themselves of long segments) and `low_pass_spread`."""
    with jax.enable_x64(True):
        *shapes, spread = jax.tree.map(np.asarray, _kept_arrays(settings, window))
    if settings.length > LONG:
        return settings, (settings, window), spread
    return *shapes, spread


def low_pass_of(settings: SpectrumSettings) -> Float[np.ndarray, " lags"]:
    """`low_pass_spread`."""
    return _arrays_of(settings, WINDOW)[2]


@kept
def _kept_arrays(settings: SpectrumSettings, window: tuple[float, float]) -> tuple[Any, ...]:
    """Kept, since to make them takes scipy.signal, half a second to import."""
    if settings.length > LONG:
        return (jnp.asarray(low_pass_spread(settings)),)
    found = (
        _padded_operator(settings),
        _padded_segments(settings, window),
        low_pass_spread(settings),
    )
    return jax.tree.map(jnp.asarray, found)


def _padded_operator(settings: SpectrumSettings) -> Float[np.ndarray, "bins_and_two lags"]:
    """`covariance_operator` in a shape that settings share: with bins of zeros, and lags that do
    not count."""
    operator = covariance_operator(settings)
    bins, lags = operator.shape[0] - 2, operator.shape[1]
    found = np.zeros((_size(bins, LEAST_BINS) + 2, _size(lags, LEAST_LAGS)))
    found[:bins, :lags], found[-2:, :lags] = operator[:-2], operator[-2:]
    return found


def _padded_segments(settings: SpectrumSettings, window: tuple[float, float]) -> Segments:
    """`segments_of` in a shape that settings share."""
    return segments_of(settings, window).filled(
        _size(len(settings.frequency), LEAST_BINS), _size(settings.length, LEAST_LAGS // 2)
    )


def _size(count: int, least: int) -> int:
    """The next of `least`, 1.5 and 2 times as much, 3, 4 ..."""
    while count > least:
        least = least * 3 // 2 if least & (least - 1) == 0 else least * 4 // 3
    return least
