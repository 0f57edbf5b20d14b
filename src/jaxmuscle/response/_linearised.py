"""A task linearised about its equilibrium."""

import dataclasses
import functools
import operator
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import all_concrete, as_arrays, as_doubles, as_numbers, is_concrete
from jaxmuscle._common.errors import OperatingPointError
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._muscle import Perturbation
from jaxmuscle.model._signals import AbstractSignal, Constant
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


def linearise(task: AbstractTask, time: float = HOLD) -> Linearisation:
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
    system = linearisation(mechanics(task), time)
    check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))
    return system


def _linearise(task: AbstractTask, time: float = HOLD) -> Linearisation:
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
        return self.system.point

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


def settled(task: AbstractTask, time: float = HOLD) -> AbstractTask:
    """The task with its inputs held at their values at `time` [s] from the start, and starting from
    equilibrium.

        run = jm.simulate(jm.settled(jm.Isometric()), jax.random.key(0), duration=10.0)

    Its simulation has no rise and no transient of the mean: what the linear response describes.
    """
    traced = not all(is_concrete(leaf) for leaf in jax.tree.leaves(task))
    point = (
        equilibrium(task, time)
        if traced
        else np.asarray(linearisation(mechanics(task), time).point).tolist()
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


linearisation = kept(_linearise)  # of what `mechanics` gives: one program for tasks of any settings


def linearised(task: AbstractTask, time: float = HOLD) -> LinearTask:
    """`LinearTask.of`, compiled."""
    return LinearTask.of(as_arrays(task), linearisation(mechanics(task), time))


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
        system = linearisation(mechanics(task))
        try:
            check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))
            check_inputs(task)
        except OperatingPointError:
            if required:
                raise
            return False
    return True
