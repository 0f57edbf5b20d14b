"""A task linearised about its equilibrium."""

import dataclasses
import functools
import operator
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import all_concrete, as_arrays, as_doubles, as_numbers, is_concrete
from jaxmuscle._common.errors import OperatingPointError
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._muscle import Muscle, Perturbation
from jaxmuscle.model._parameters import USUALLY_FREE, part_at, paths_of, set_parameters
from jaxmuscle.model._signals import AbstractSignal, Constant, SmoothStep
from jaxmuscle.model._tasks import AbstractTask, State
from jaxmuscle.spectra._settings import WINDOW

from ._equilibrium import HOLD, equilibrium, mechanics


class Linearisation(NamedTuple):
    """A task about its equilibrium, `y' = A (y - point) + B u`, `z = rest + C (y - point) + D u + E
    u'`. Made by `linearise`.

    y are the states (`task.state_names`), z is the output (`task.output_name`), and u are the five
    perturbations (ΔK_w, ΔK_z [N/m], ΔC_w, ΔC_z [N s/m], ΔP_w / P_w). `point` is y, and `rest` is z
    at the equilibrium.
    """

    point: Float[Array, " states"]
    rest: Float[Array, ""]
    A: Float[Array, "states states"]
    B: Float[Array, "states 5"]
    C: Float[Array, " states"]
    D: Float[Array, "5"]
    E: Float[Array, "5"]


def linearise(task: AbstractTask, time: Scalar | float = HOLD) -> Linearisation:
    """Jacobians of a task's vector field and output at its equilibrium under the inputs at `time`
    [s].

        system = jm.response.linearise(jm.Isometric())
        np.linalg.eigvals(system.A)  # 1/s

        A = ∂f/∂y,   B = ∂f/∂u,   C = ∂z/∂y,   D = ∂z/∂u,   E = ∂z/∂u'

    with f the `vector_field` and z the `output` of the task. All of the linear response follows
    from this and from the noise: the transfer function from u to z is `C (s - A)⁻¹ B + D + s E`.

    **Arguments:** `task`; `time` [s], 15 s by default. **Returns:** a `Linearisation`: `point`
    (states,), `rest` (), `A` (states, states), `B` (states, 5), `C` (states,), `D` and `E` (5,).
    Differentiable, also under `jit` and `vmap`.

    **Raises:** `OperatingPointError` (a `ValueError`) without a stable, damped equilibrium, and,
    unless a time is given, where an input moves in the analysed window. Under a transformation
    nothing is raised: without an equilibrium the result is not finite.
    """
    if isinstance(task, LinearTask) or not all_concrete((task, time)):
        return _linearise(task, time)
    if time == HOLD:
        check_inputs(task)
    system = linearisation(task, time)
    check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))
    return system


def _linearise(task: AbstractTask, time: Scalar | float = HOLD) -> Linearisation:
    """`linearise` without checks."""
    if isinstance(task, LinearTask):
        return task.system
    point = equilibrium(task, time)
    n, t, still = point.shape[0], jnp.asarray(time, point.dtype), jnp.zeros(5, point.dtype)

    def field(both):
        return task.vector_field(t, both[:n], both[n:])

    def output(all_three):
        z = task.output(t, all_three[:n], all_three[n : n + 5], all_three[n + 5 :])
        return z, z

    AB = jax.jacfwd(field)(jnp.concatenate([point, still]))
    CDE, rest = jax.jacfwd(output, has_aux=True)(jnp.concatenate([point, still, still]))
    return Linearisation(point, rest, AB[:, :n], AB[:, n:], CDE[:n], CDE[n : n + 5], CDE[n + 5 :])


class LinearTask(AbstractTask):
    """A task replaced by its linearisation about the equilibrium, where it starts; same noise,
    harmonic and settings."""

    system: Linearisation
    state_names: ClassVar[tuple[str, ...]] = ()
    state_units: ClassVar[tuple[str, ...]] = ()
    output_name: ClassVar[str] = "z"
    output_unit: ClassVar[str] = ""
    smoothness_needed: ClassVar[tuple[int, ...]] = (0, 0, 0, 0, 0)

    @classmethod
    def of(cls, task: AbstractTask, system: Linearisation | None = None) -> "LinearTask":
        """The linearisation of a task, if it is known already as `system`."""
        return cls(linearise(task) if system is None else system, **task.common)

    def initial_state(self) -> State:
        return jnp.asarray(self.system.point)

    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        s, away = self.system, [y[i] - self.system.point[i] for i in range(len(self.system.A))]
        return jnp.stack([_sum(s.A[i], away) + _sum(s.B[i], u) for i in range(len(s.A))])

    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        s = self.system
        return (
            s.rest
            + _sum(s.C, [y[i] - s.point[i] for i in range(len(s.A))])
            + _sum(s.D, u)
            + _sum(s.E, du)
        )


def _sum(row: Array, values: Any) -> Array:
    """Their product, term by term: in a loop over many seeds XLA makes vectors of that, not of
    small matrices."""
    return functools.reduce(operator.add, (row[i] * values[i] for i in range(len(row))))


POINTS, LATEST = 32, 8  # points of a program; tasks that are kept prepared
# free with a known mean force, with a moved insertion and in designs
SOMETIMES = ("P_w", "m_w", "m_z")
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
        system = _linearise(there, time)
        return Operating(system, balanced(system), there.muscle.base())

    return jax.vmap(lambda values: value_and_slopes(one, values))(values)


def balanced(system: Linearisation) -> Linearisation:
    """The system in units of its states in which rows and columns of A are of one size: single
    precision needs it."""
    A = jax.lax.stop_gradient(jnp.abs(system.A)) * (
        1 - jnp.eye(len(system.A), dtype=system.A.dtype)
    )
    scale = jnp.ones(len(A), A.dtype)
    for _ in range(2):
        for i in range(len(A)):
            row, column = jnp.sum(A[i] * scale) / scale[i], jnp.sum(A[:, i] / scale) * scale[i]
            fits = (row > 0) & (column > 0)
            ratio = jnp.where(fits, row, 1.0) / jnp.where(fits, column, 1.0)
            scale = scale.at[i].multiply(jnp.sqrt(ratio))
    size = jax.lax.stop_gradient(jnp.linalg.norm(system.C * scale))
    size = jnp.where(size > 0, size, 1.0)
    A = system.A * scale / scale[:, None]
    return system._replace(A=A, B=size * system.B / scale[:, None], C=system.C * scale / size)


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
        for name, signal in _signals(task).items()
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


def linearisation(task: AbstractTask, time: float = HOLD) -> Linearisation:
    """`linearise` without checks; of a task of numbers by the program that fits use."""
    if isinstance(task, LinearTask) or not all_concrete(task):
        return _linearise(task, time)
    found = Mechanics.of(task).at(np.zeros((1, 0)), time)[1].point.system
    # numbers also while something else is traced; NaN is a sign here: no equilibrium
    with jax.ensure_compile_time_eval(), jax.debug_nans(False):
        return jax.tree.map(lambda x: jnp.asarray(x[0]), found)


def settled(task: AbstractTask, time: float = HOLD) -> AbstractTask:
    """The task with its inputs held at their values at `time` [s] from the start, and starting from
    equilibrium.

        run = jm.simulate(jm.settled(jm.Isometric()), jax.random.key(0), duration=10.0)

    Its simulation has no rise and no transient of the mean: what the linear response describes.
    """
    traced = not all(is_concrete(leaf) for leaf in jax.tree.leaves(task))
    point = (
        equilibrium(task, time) if traced else np.asarray(linearisation(task, time).point).tolist()
    )
    levels = _inputs(_signals(as_arrays(task)), np.array([time]))
    held = {
        name: Constant(level[0] if traced else float(np.asarray(level)[0]))
        for name, level in levels.items()
    }
    found = task.with_parts(**held, initial=tuple(point))
    return found if traced else as_numbers(found)


@kept
def _inputs(
    signals: dict[str, AbstractSignal], times: Float[Array | np.ndarray, " times"]
) -> dict[str, Float[Array, " times"]]:
    """Their values at some times."""
    return {name: jax.vmap(signal)(jnp.asarray(times)) for name, signal in signals.items()}


def _signals(task: AbstractTask) -> dict[str, AbstractSignal]:
    """Every input that is a function of time."""
    found = {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
    return {name: value for name, value in found.items() if isinstance(value, AbstractSignal)}


def linearised(task: AbstractTask, time: float = HOLD) -> LinearTask:
    """`LinearTask.of`, compiled."""
    return LinearTask.of(as_arrays(task), linearisation(task, time))


def check_equilibrium(task: Any, point: np.ndarray, A: np.ndarray) -> float:
    """The slowest decay rate [1/s]; refuses what has no linear response: no equilibrium, an
    unstable or undamped one."""
    name = type(task).__name__
    if not (np.all(np.isfinite(point)) and np.all(np.isfinite(A))):
        with jax.ensure_compile_time_eval():
            base = np.asarray(as_arrays(task).muscle.base())
        raise OperatingPointError(
            f"{name} has no equilibrium at t = {HOLD} s under its inputs (K_w0, K_z0, C_w0, C_z0 ="
            f" {base}): a stiffness must balance them"
        )
    eigenvalues = np.linalg.eigvals(A)
    margin = 1e3 * np.finfo(A.dtype).eps * np.abs(eigenvalues).max()
    if eigenvalues.real.max() > -margin:
        kind = "unstable" if eigenvalues.real.max() > margin else "undamped"
        listed = ", ".join(f"{v:.4g}" for v in eigenvalues)
        raise OperatingPointError(
            f"the equilibrium of this {name} is {kind}: eigenvalues {listed} 1/s at {point}; a"
            " linear response needs damping at rest (c_w, c_z, v_ref_w, v_ref_z > 0) and stiffness"
            " (k_w, x_ref_w > 0)"
        )
    return float(-eigenvalues.real.max())


MOVING = 1e-4
LOOKS = 33


def check_inputs(task: AbstractTask, window: tuple[float, float] = WINDOW) -> None:
    """Refuse inputs that move in the window: a linear response is about held ones."""
    if all(isinstance(signal, Constant) for signal in _signals(task).values()):
        return
    times = np.append(np.linspace(*window, LOOKS), HOLD)
    with jax.enable_x64(True):
        seen = {
            name: np.asarray(values)
            for name, values in _inputs(_signals(as_doubles(task)), times).items()
        }
    for name, values in seen.items():
        off = np.abs(values[:-1] - values[-1])
        if np.max(off) > MOVING * np.max(np.abs(values)):
            when = times[np.argmax(off)]
            raise OperatingPointError(
                f"{name} of this {type(task).__name__} moves in the analysed window: at {when:.3g}"
                f" s it is {values[np.argmax(off)]:.3g}, at the end {values[-1]:.3g}. The linear"
                f" response needs inputs that are held from {window[0]:g} s to {window[1]:g} s."
                " Simulate instead, ensemble(task, key).spectrum(), or fit with"
                " method='montecarlo'; or hold the input: settled(task)"
            )


def has_response(task: AbstractTask, *, required: bool) -> bool:
    """Whether a task has a stable, damped equilibrium under held inputs; with `required`, why not
    is an error."""
    with jax.enable_x64(True):
        system = linearisation(task)
        try:
            check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))
            check_inputs(task)
        except OperatingPointError:
            if required:
                raise
            return False
    return True
