"""The mechanics of tasks of every make, linearised with many values by one program (docs/model.md,
*By few programs*)."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle.model._muscle import Muscle
from jaxmuscle.model._parameters import REFLEX, USUALLY_FREE, part_at, paths_of, set_parameters
from jaxmuscle.model._signals import AbstractSignal, Constant, SmoothStep
from jaxmuscle.model._tasks import AbstractTask

from ._equilibrium import HOLD, mechanics, signals_of
from ._linear_task import Linearisation, LinearTask, balanced, linearise_traced

POINTS, LATEST = 32, 8  # points of a program; tasks that are kept prepared

# free with a known mean force, with a moved insertion and in designs
SOMETIMES = ("P_w", "m_w", "m_z", *REFLEX)

NOT_MECHANICAL = ("noise", "harmonic", "activation")


def program_names(task: AbstractTask, own: Sequence[str] = ()) -> tuple[str, ...]:
    """The names that a program has slopes for: of the usually free ones those that the task has, in
    one order whatever is asked for, then other ones of one's `own`."""
    known = task.parameter_names
    usual = (name for name in (*USUALLY_FREE, *SOMETIMES) if name in known)
    return tuple(dict.fromkeys([*usual, *own]))


class Operating(NamedTuple):
    """A linearisation, the same `balanced`, and K_w0, K_z0, C_w0 and C_z0."""

    system: Linearisation
    balanced: Linearisation
    base: Float[Array, "4"]


class Near(NamedTuple):
    """The operating point at some mechanical values, and its slopes with respect to them."""

    point: Operating
    slopes: Operating
    values: Float[Array, " moving"]

    def at(self, values: Float[Array, " moving"]) -> Operating:
        """To first order, which gives its value and its slope there exactly."""
        away = values - self.values
        return jax.tree.map(lambda x, slope: x + slope @ away, self.point, self.slopes)


def value_and_slopes(function: Callable[[Any], Any], at: Any) -> tuple[Any, Any]:
    """A function's value and its Jacobian."""

    def twice(at):
        value = function(at)
        return value, value

    slopes, value = jax.jacfwd(twice, has_aux=True)(at)
    return value, slopes


@kept
def _operating_points(
    task: AbstractTask,
    names: tuple[str, ...],
    time: Any,
    values: Float[Array | np.ndarray, "points names"],
) -> tuple[Operating, Operating]:
    """Of a bare task with each row of its mechanical values, and the slopes."""

    def one(values):
        there = set_parameters(task, dict(zip(names, values, strict=True)))
        system = linearise_traced(there, time)
        return Operating(system, balanced(system), there.muscle.base())

    return jax.vmap(lambda values: value_and_slopes(one, values))(values)


class KnownBase(Muscle):
    """A muscle of which only the base coefficients are known: what noise and harmonic are fractions
    of."""

    coefficients: Float[Array | np.ndarray, "4"] | None = None

    def base(self) -> Float[Array, "4"]:
        return jnp.asarray(self.coefficients)


class Mechanics:
    """One task to be linearised with many values of its `own` parameters.

    `bare`: what its mechanics depend on, with the names of the `moving` values; `names`: all that
    programs have slopes for, of which the moving ones are at `place`.
    """

    def __init__(self, task: AbstractTask, own: tuple[str, ...]):
        self.task, self.own, self.names = task, own, program_names(task, own)
        self.dtype = jnp.result_type(float)
        self.defaults = np.array([float(task[name]) for name in self.names])
        self.columns = np.array([self.names.index(name) for name in own], dtype=int)
        self.bare, paths = mechanics(task), paths_of(task)
        self.held = with_held_inputs(self.bare)
        place = [i for i, n in enumerate(self.names) if paths[n][0] not in NOT_MECHANICAL]
        self.place, self.moving = np.array(place, dtype=int), tuple(self.names[i] for i in place)
        self.seen: dict[float, tuple[np.ndarray, Near]] = {}
        self._tasks_about: dict[tuple[Any, ...], Any] = {}

    @classmethod
    def of(cls, task: AbstractTask, own: Sequence[str] = ()) -> "Mechanics":
        """Of the latest tasks made only once: to prepare one takes longer than to linearise it."""
        for known in _LATEST:
            kind = known.own, known.dtype
            if known.task is task and kind == (tuple(own), jnp.result_type(float)):
                return known
        found = cls(task, tuple(own))
        _LATEST[:] = [found, *_LATEST[: LATEST - 1]]
        return found

    @property
    def components(self) -> list[tuple[Any, ...]]:
        """Where each component of the noise is in it."""
        noise = self.task.noise
        if noise.components == (noise,):
            return [()]
        return [("parts", i) for i in range(len(noise.components))]

    def task_about(self, about: tuple[Any, ...]) -> tuple[LinearTask, tuple[str, ...], np.ndarray]:
        """A task that has nothing but the activation and one component of the noise, or the
        harmonic, `about` which it is; what its values are called, and their columns: the mechanical
        ones first."""
        if about not in self._tasks_about:
            point = jax.tree.map(lambda x: x[0], next(iter(self.seen.values()))[1].point)
            common: Any = self.bare.common | {"muscle": KnownBase(coefficients=point.base)}
            common["activation"] = self.task.activation
            if about[0] == "harmonic":
                common["harmonic"] = self.task.harmonic
            else:
                common["noise"] = part_at(self.task, about)
            found = as_arrays(LinearTask(point.system, **common))
            own = {path: name for name, path in paths_of(found).items()}
            rows = [("", i) for i in self.place]  # by the operating point, not by name
            for i, name in enumerate(self.names):
                path = paths_of(self.task)[name]
                if path[0] == "activation" or path[: len(about)] == about:
                    kind = path if path[0] == "activation" else (about[0], *path[len(about) :])
                    rows.append((own[kind], i))
            names, columns = zip(*rows, strict=True)
            self._tasks_about[about] = found, names, np.array(columns, dtype=int)
        return self._tasks_about[about]

    def at(
        self, values: Float[np.ndarray, "rows own"], time: float = HOLD
    ) -> tuple[np.ndarray, Near]:
        """Values of all names, and the operating points there."""
        whole = np.tile(self.defaults, (len(values), 1))
        whole[:, self.columns] = values
        whole = as_arrays(whole)
        known = self.seen.get(time)
        if known is None or not np.array_equal(whole, known[0]):
            moving = whole[:, self.place]
            task = self.held if time == HOLD else self.bare
            program = functools.partial(_operating_points, task, self.moving, as_arrays(time))
            found, slopes = in_parts(program, moving)
            known = self.seen[time] = whole, Near(found, slopes, moving)
        return known


_LATEST: list[Mechanics] = []


def with_held_inputs(task: AbstractTask) -> AbstractTask:
    """The task with steps that are over at `HOLD` as constants, and with the state from which its
    equilibrium is looked for: a program serves tasks with and without these."""
    parts: dict[str, Any] = {
        name: Constant(signal.level)
        for name, signal in signals_of(task).items()
        if type(signal) is SmoothStep and float(signal.start + signal.rise) <= HOLD
    }
    place = getattr(task, "x_z", 0.0)
    place = place.level if isinstance(place, Constant) else place
    size = len(task.state_names)
    usual = task.initial is None and type(task).initial_state is AbstractTask.initial_state
    if usual and size and not isinstance(place, AbstractSignal):
        parts["initial"] = as_arrays((place, *[0.0] * (size - 1)))
    return task.with_parts(**parts) if parts else task


def in_parts(program: Callable[..., Any], *rows: Any) -> Any:
    """What a program for `POINTS` rows makes of any number of them, as numbers."""
    count = len(jax.tree.leaves(rows)[0])
    found = []
    for i in range(0, count, POINTS):
        here = np.minimum(np.arange(i, i + POINTS), count - 1)
        made = program(*jax.tree.map(lambda x, here=here: np.asarray(x)[here], rows))
        found.append(jax.tree.map(lambda x, n=count - i: np.asarray(x)[:n], made))
    return jax.tree.map(lambda *x: np.concatenate(x), *found)
