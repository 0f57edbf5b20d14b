"""The static characteristics of a muscle: stiffness, damping and force, as its own methods give
them."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import as_arrays, require
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._muscle import AbstractMuscle
from jaxmuscle.model._signals import AbstractSignal, Constant
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedMotion

from ._equilibrium import HOLD, equilibrium

if TYPE_CHECKING:
    from matplotlib.axes import Axes


SPAN, SPEED = 0.02, 1.0
Points = Float[np.ndarray, " points"]


class StaticCharacteristics(eqx.Module):
    """What a muscle's springs and dampers do, one by one and together; made by
    `static_characteristics`.

    **Fields**, all (points,): `displacement` x [m] and `velocity` v [m/s] of one tissue; for tissue
    j = w, z at them the coefficients `K_j` [N/m] and `C_j` [N s/m] of equation (2), their tangents
    `K_j_tangent` = dF_j/dx and `C_j_tangent` = dD_j/dv (D_j: force of the damper), which small
    fluctuations see, and the spring force `F_j` [N]; `F_ext` [N], the static force at the insertion
    held at x_z = `displacement`, at rest (P_w = 0) and `F_ext_active` at the task's P_w, not a
    number where there is no equilibrium. Numbers: `P_w` [N], `x_w` and `x_z` [m] of the task's
    operating point. `units` names the unit of every field.
    """

    displacement: Points
    velocity: Points
    K_w: Points
    K_z: Points
    K_w_tangent: Points
    K_z_tangent: Points
    C_w: Points
    C_z: Points
    C_w_tangent: Points
    C_z_tangent: Points
    F_w: Points
    F_z: Points
    F_ext: Points
    F_ext_active: Points
    P_w: float
    x_w: float
    x_z: float

    units: ClassVar[dict[str, str]] = {
        "displacement": "m",
        "velocity": "m/s",
        "K_w": "N/m",
        "K_z": "N/m",
        "K_w_tangent": "N/m",
        "K_z_tangent": "N/m",
        "C_w": "N s/m",
        "C_z": "N s/m",
        "C_w_tangent": "N s/m",
        "C_z_tangent": "N s/m",
        "F_w": "N",
        "F_z": "N",
        "F_ext": "N",
        "F_ext_active": "N",
        "P_w": "N",
        "x_w": "m",
        "x_z": "m",
    }

    def plot(self, ax: "Sequence[Axes] | None" = None) -> "tuple[Axes, Axes, Axes]":
        """K(x), C(v) and force against displacement, in three axes (`ax`: three of yours). Returns
        the axes."""
        return plot.static(self, ax)


def static_characteristics(
    task: AbstractTask, *, span: float | None = None, speed: float = SPEED, points: int = 201
) -> StaticCharacteristics:
    """K(x), C(v) and force against displacement of a task's muscle, from the methods of
    `AbstractMuscle` alone.

        jm.response.static_characteristics(jm.Isometric()).plot()

        F_w(x) = active_force(x, 0),      F_z(x) = passive_force(0, 0, x, 0)
        K_j(x) = (F_j(x) - F_j(0)) / x
        D_w(v) = active_force(0, v),      D_z(v) = passive_force(0, 0, 0, v)
        C_j(v) = (D_j(v) - D_j(0)) / v

    the limit at 0, and the tangents by differentiation. F_ext(x) is the output of `Isometric` in
    equilibrium at x_z = x.

    **Arguments:**

    - `task`: whose muscle it is
    - `span` [m]: displacements from -span to span (by default twice the largest of the operating
      point's, at least 0.02 m)
    - `speed` [m/s]: velocities from -speed to speed (by default 1 m/s)
    - `points`: odd to contain 0

    **Raises:** `ValueError` for a span or speed that is not positive and for fewer than 3 points.
    """
    require(span is None or span > 0, f"span = {span} m must be positive")
    require(speed > 0, f"speed = {speed} m/s must be positive")
    require(points >= 3, f"points = {points} must be at least 3")
    with jax.enable_x64(True):
        task = as_arrays(task)
        P_w, x_w, x_z = _operating(task)
        reach = (
            max(SPAN, *(2 * abs(x) for x in (x_w, x_z) if np.isfinite(x))) if span is None else span
        )
        x, v = jnp.linspace(-reach, reach, points), jnp.linspace(-speed, speed, points)
        curves = {
            name: np.asarray(curve)
            for name, curve in _curves(task.muscle, x, v, jnp.asarray(P_w)).items()
        }
    return StaticCharacteristics(np.asarray(x), np.asarray(v), **curves, P_w=P_w, x_w=x_w, x_z=x_z)


def _operating(task: AbstractTask) -> tuple[float, float, float]:
    """P_w, x_w and x_z in equilibrium under the held inputs."""
    t = jnp.asarray(HOLD, float)
    y = equilibrium(task)
    prescribed: Any = getattr(task, "x_z", None)
    if prescribed is None:
        x_z = y[task.state_names.index("x_z")] if "x_z" in task.state_names else jnp.nan
    else:
        x_z = prescribed(t) if isinstance(prescribed, AbstractSignal) else prescribed
    if isinstance(task, PrescribedMotion):
        P_w = task.output(t, y, jnp.zeros(5), jnp.zeros(5))
    else:
        P_w = getattr(task, "P_w")(t)  # noqa: B009 (no attribute of all tasks)
    return float(P_w), float(y[0]), float(x_z)


@kept
def _curves(muscle: AbstractMuscle, x: Array, v: Array, P_w: Array) -> dict[str, Array]:
    zero, still = jnp.zeros(()), jnp.zeros(5)
    springs = {
        "w": lambda q: muscle.active_force(q, zero, still),
        "z": lambda q: muscle.passive_force(zero, zero, q, zero, still),
    }
    dampers = {
        "w": lambda q: muscle.active_force(zero, q, still),
        "z": lambda q: muscle.passive_force(zero, zero, zero, q, still),
    }
    curves = {}
    for j in "wz":
        curves[f"F_{j}"], curves[f"K_{j}"], curves[f"K_{j}_tangent"] = _slopes(springs[j], x)
        _, curves[f"C_{j}"], curves[f"C_{j}_tangent"] = _slopes(dampers[j], v)
    for name, active in (("F_ext", zero), ("F_ext_active", P_w)):
        curves[name] = jax.vmap(lambda held, active=active: _held_force(muscle, held, active))(x)
    return curves


def _slopes(force: Callable[[Scalar], Scalar], q: Array) -> tuple[Array, Array, Array]:
    """A force, its slope from the origin (at the origin its limit) and its tangent."""
    values, tangents = jax.vmap(lambda at: jax.jvp(force, (at,), (jnp.ones_like(at),)))(q)
    # Within rounding of the origin the difference has no digits.
    near = jnp.abs(q) < 1e-9 * jnp.max(jnp.abs(q))
    return (
        values,
        jnp.where(near, tangents, (values - force(jnp.zeros(()))) / jnp.where(near, 1.0, q)),
        tangents,
    )


def _held_force(muscle: AbstractMuscle, x_z: Array, P_w: Array) -> Array:
    held = Isometric(muscle=muscle, P_w=Constant(P_w), x_z=x_z)
    return held.output(jnp.zeros(()), equilibrium(held), jnp.zeros(5), jnp.zeros(5))
