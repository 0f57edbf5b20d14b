"""A task of numbers linearised about its equilibrium, and whether it can be."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import all_concrete, as_arrays, as_doubles, as_numbers, is_concrete
from jaxmuscle._common.errors import OperatingPointError
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._signals import AbstractSignal, Constant
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._settings import WINDOW

from ._equilibrium import HOLD, equilibrium, signals_of
from ._linear_task import Linearisation, LinearTask, linearise_traced
from ._mechanics import Mechanics


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
        return linearise_traced(task, time)
    if time == HOLD:
        check_inputs(task)
    system = linearisation(task, time)
    check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))
    return system


def linearisation(task: AbstractTask, time: float = HOLD) -> Linearisation:
    """`linearise` without checks; of a task of numbers by the program that fits use."""
    if isinstance(task, LinearTask) or not all_concrete(task):
        return linearise_traced(task, time)
    found = Mechanics.of(task).at(np.zeros((1, 0)), time)[1].point.system
    # numbers also while something else is traced; NaN is a sign here: no equilibrium
    with jax.ensure_compile_time_eval(), jax.debug_nans(False):
        return jax.tree.map(lambda x: jnp.asarray(x[0]), found)


def settled(task: AbstractTask, time: float = HOLD) -> AbstractTask:
    """See `AbstractTask.settled`."""
    traced = not all(is_concrete(leaf) for leaf in jax.tree.leaves(task))
    point = (
        equilibrium(task, time) if traced else np.asarray(linearisation(task, time).point).tolist()
    )
    levels = _inputs(signals_of(as_arrays(task)), np.array([time]))
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
    if all(isinstance(signal, Constant) for signal in signals_of(task).values()):
        return
    times = np.append(np.linspace(*window, LOOKS), HOLD)
    with jax.enable_x64(True):
        seen = {
            name: np.asarray(values)
            for name, values in _inputs(signals_of(as_doubles(task)), times).items()
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
                " method='montecarlo'; or hold the input: task.settled()"
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
