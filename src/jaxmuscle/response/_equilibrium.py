"""The operating point of a task: equilibrium under its held inputs, and its eigenvalues."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays, is_concrete
from jaxmuscle._common.errors import OperatingPointError
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._signals import AbstractSignal, Harmonic
from jaxmuscle.model._task import HOLD as HOLD
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.model._white_noise import BandLimitedNoise
from jaxmuscle.spectra._settings import SpectrumSettings

GUESS = 1e-3


def equilibrium(task: AbstractTask, time: Scalar | float = HOLD) -> Float[Array, " states"]:
    """State y of `task` with `vector_field(time, y, 0) = 0` [m, m/s], by Newton's method;
    differentiable (implicitly).

        state = jm.response.equilibrium(jm.Isometric())

    Not finite where there is none. Functions that need one (`at_force`, `at_level`) end with an
    `OperatingPointError` there.
    """
    if all(is_concrete(leaf) for leaf in jax.tree.leaves((task, time))):
        return _kept_equilibrium(mechanics(task), np.asarray(time, jnp.result_type(float)))
    return _equilibrium(task, time)


@kept
def _kept_equilibrium(task: AbstractTask, time: Scalar) -> Float[Array, " states"]:
    return _equilibrium(task, time)


def _equilibrium(task: AbstractTask, time: Scalar | float) -> Float[Array, " states"]:
    import optimistix as optx  # only here, since a program that is loaded does without

    task = as_arrays(task)
    dtype = jnp.result_type(float)
    tolerance = 1e-12 if dtype == jnp.float64 else 1e-6

    def field(y):
        return task.vector_field(jnp.asarray(time, dtype), y, jnp.zeros(5))

    def newton(function, y):
        method = optx.Newton(rtol=tolerance, atol=tolerance)
        solution = optx.root_find(lambda y, _: function(y), method, y, max_steps=200, throw=False)
        return jnp.where(solution.result == optx.RESULTS.successful, solution.value, jnp.nan)

    # optimistix's own implicit derivative checks its linear solve by a host callback, which JAX's
    # compilation cache cannot keep: the same derivative without it. Off the origin, where the
    # literal equation (2) has no stiffness and Newton's method no direction.
    start = task.initial_state() + GUESS
    held = getattr(task, "x_z", None)
    if task.initial is None and held is not None:
        start = start.at[0].add(
            held(jnp.asarray(time, dtype)) if isinstance(held, AbstractSignal) else held
        )
    # In units of the state, so that one tolerance suits accelerations and displacements in either
    # precision.
    slope = jnp.sum(jnp.abs(jax.lax.stop_gradient(jax.jacfwd(field)(start))), axis=1)
    scale = jnp.where((slope > 0) & jnp.isfinite(slope), slope, 1.0)

    def at_rest(y):
        return field(y) / scale

    return jax.lax.custom_root(
        at_rest, start, newton, lambda g, y: jnp.linalg.solve(jax.jacfwd(g)(y), y)
    )


def mechanics(task: AbstractTask) -> AbstractTask:
    """The task as arrays, with the usual noise, harmonic and spectrum settings and without
    activation, on which its operating point does not depend: one program serves all tasks that
    differ in these."""
    bare = task.with_parts(
        noise=BandLimitedNoise(),
        harmonic=Harmonic(),
        activation=None,
        settings=SpectrumSettings(),
    )
    return as_arrays(bare)


def without_settings(task: AbstractTask) -> AbstractTask:
    """The task as arrays, with the usual spectrum settings: a program that needs none serves tasks
    of any settings."""
    return as_arrays(task.with_parts(settings=SpectrumSettings()))


def jacobian(
    task: AbstractTask, y: Float[Array, " states"], time: Scalar | float = HOLD
) -> Float[Array, "states states"]:
    """Jacobian [1/s] of the vector field with respect to the state at y."""
    task = as_arrays(task)
    return jax.jacfwd(lambda y: task.vector_field(jnp.asarray(time, y.dtype), y, jnp.zeros(5)))(y)


def slowest_rate(task: AbstractTask, time: float = HOLD) -> Float[Array, ""]:
    """Smallest |eigenvalue| [1/s] at the operating point; differentiable."""
    return slowest(jacobian(task, equilibrium(task, time), time))


def slowest(system: Float[Array, "states states"]) -> Float[Array, ""]:
    """Smallest |eigenvalue| of a Jacobian."""
    return jnp.min(jnp.abs(jnp.linalg.eigvals(system)))


def fastest_rate(task: AbstractTask, duration: float) -> float:
    """Largest |eigenvalue| [1/s] at the start and under the inputs at mid-run and end, for the
    stability of a step."""
    with jax.enable_x64(True):
        _, jacobians = _linearisations(mechanics(task), np.array([duration / 2, duration]))
        rates = [
            np.abs(np.linalg.eigvals(j)).max()
            for j in np.asarray(jacobians)
            if np.all(np.isfinite(j))
        ]
    if not rates:
        raise OperatingPointError(
            f"the equations of this {type(task).__name__} are not finite where it starts: one of"
            " its numbers is NaN or infinite, or a mass or a damping that it divides by is 0"
        )
    return float(max(rates))


@kept
def _linearisations(
    task: AbstractTask, times: Float[np.ndarray | Array, " times"]
) -> tuple[Float[Array, "points states"], Float[Array, "points states states"]]:
    """Initial state and equilibria at the given times, with the Jacobians there; that of the start
    at the last time."""
    points = jnp.concatenate(
        [task.initial_state()[None], jax.vmap(lambda t: equilibrium(task, t))(times)]
    )
    return points, jax.vmap(lambda y, t: jacobian(task, y, t))(
        points, jnp.concatenate([times[-1:], times])
    )


def signals_of(task: AbstractTask) -> dict[str, AbstractSignal]:
    """Every input that is a function of time."""
    found = {field.name: getattr(task, field.name) for field in dataclasses.fields(task)}
    return {name: value for name, value in found.items() if isinstance(value, AbstractSignal)}
