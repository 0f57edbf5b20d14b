"""The static characteristics of a muscle: stiffness, damping and force, as its own methods give them."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._law import Scalar
from ._muscle import AbstractMuscle
from ._operating import HOLD, equilibrium
from ._parameter import as_arrays, require
from ._signal import AbstractSignal, Constant
from ._task import AbstractTask, Isometric, PrescribedMotion

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SPAN, SPEED = 0.02, 1.0
Points = Float[np.ndarray, " points"]


class StaticCharacteristics(eqx.Module):
    """What a muscle's springs and dampers do, one by one and together; made by `static_characteristics`.

    **Fields**, all (points,): `displacement` x [m] and `velocity` v [m/s] of one tissue; for tissue j = w, z at them the
    coefficients `K_j` [N/m] and `C_j` [N s/m] of equation (2), their `K_j_tangent` = dF_j/dx and `C_j_tangent` = dF_j/dv,
    which small fluctuations see, and the spring force `F_j` [N]; `F_ext` [N], the static force at the insertion held at
    x_z = `displacement`, at rest (P_w = 0) and `F_ext_active` at the task's P_w, not a number where there is no equilibrium.
    Numbers: `P_w` [N], `x_w` and `x_z` [m] of the task's operating point. `units` names the unit of every field.
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
        "displacement": "m", "velocity": "m/s", "K_w": "N/m", "K_z": "N/m", "K_w_tangent": "N/m", "K_z_tangent": "N/m",
        "C_w": "N s/m", "C_z": "N s/m", "C_w_tangent": "N s/m", "C_z_tangent": "N s/m", "F_w": "N", "F_z": "N",
        "F_ext": "N", "F_ext_active": "N", "P_w": "N", "x_w": "m", "x_z": "m",
    }  # fmt: skip

    def plot(self, ax: "Sequence[Axes] | None" = None) -> "tuple[Axes, Axes, Axes]":
        """K(x), C(v) and force against displacement, in three axes (`ax`: three of yours). Returns the axes."""
        return _draw(self, ax)


def static_characteristics(
    task: AbstractTask, *, span: float | None = None, speed: float = SPEED, points: int = 201
) -> StaticCharacteristics:
    """K(x), C(v) and force against displacement of a task's muscle, from the methods of `AbstractMuscle` alone.

        F_w(x) = active_force(x, 0),      F_z(x) = passive_force(0, 0, x, 0),      K_j(x) = (F_j(x) - F_j(0)) / x
        D_w(v) = active_force(0, v),      D_z(v) = passive_force(0, 0, 0, v),      C_j(v) = (D_j(v) - D_j(0)) / v

    the limit at 0, and the tangents by differentiation. F_ext(x) is the output of `Isometric` in equilibrium at x_z = x.

    **Arguments:** `task`; `span` [m], displacements from -span to span (by default twice the largest of the operating
    point's, at least 0.02 m); `speed` [m/s], the same for velocities; `points`, odd to contain 0.

    **Raises:** `ValueError` for a span or speed that is not positive and for fewer than 3 points.
    """
    require(span is None or span > 0, f"span = {span} m must be positive")
    require(speed > 0, f"speed = {speed} m/s must be positive")
    require(points >= 3, f"points = {points} must be at least 3")
    with jax.enable_x64(True):
        task = as_arrays(task)
        P_w, x_w, x_z = _operating(task)
        reach = max(SPAN, *(2 * abs(x) for x in (x_w, x_z) if np.isfinite(x))) if span is None else span
        x, v = jnp.linspace(-reach, reach, points), jnp.linspace(-speed, speed, points)
        curves = {name: np.asarray(curve) for name, curve in _curves(task.muscle, x, v, jnp.asarray(P_w)).items()}
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
    P_w = task.output(t, y, jnp.zeros(4), jnp.zeros(4)) if isinstance(task, PrescribedMotion) else getattr(task, "P_w")(t)  # noqa: B009
    return float(P_w), float(y[0]), float(x_z)


@eqx.filter_jit
def _curves(muscle: AbstractMuscle, x: Array, v: Array, P_w: Array) -> dict[str, Array]:
    zero, still = jnp.zeros(()), jnp.zeros(4)
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
    return values, jnp.where(near, tangents, (values - force(jnp.zeros(()))) / jnp.where(near, 1.0, q)), tangents


def _held_force(muscle: AbstractMuscle, x_z: Array, P_w: Array) -> Array:
    held = Isometric(muscle=muscle, P_w=Constant(P_w), x_z=x_z)
    return held.output(jnp.zeros(()), equilibrium(held), jnp.zeros(4), jnp.zeros(4))


def _draw(curves: Any, ax: "Sequence[Axes] | None") -> "tuple[Axes, Axes, Axes]":
    import matplotlib.pyplot as plt

    from ._style import styled

    def panels() -> "tuple[Axes, Axes, Axes]":
        axes: Any = plt.subplots(1, 3, figsize=(9.0, 3.0), layout="constrained")[1] if ax is None else ax
        if len(axes) != 3:
            raise ValueError(f"ax has {len(axes)} axes: give three, for K(x), C(v) and force against displacement")
        _coefficients(curves, axes[0], axes[1])
        _forces(curves, axes[2])
        return tuple(axes)

    return styled(panels)()


def _coefficients(curves: Any, stiffness: "Axes", damping: "Axes") -> None:
    from ._style import BLUE, VERMILLION

    x = 1e3 * curves.displacement
    for j, colour, tissue, width in (("w", BLUE, "active tissue", 3.0), ("z", VERMILLION, "passive tissue", 1.5)):
        slope = rf"d$F_\mathrm{{{j}}}$/d$x$ of its spring"
        stiffness.plot(x, getattr(curves, f"K_{j}"), color=colour, lw=width, label=rf"$K_\mathrm{{{j}}}$, {tissue}")
        stiffness.plot(x, getattr(curves, f"K_{j}_tangent"), color=colour, lw=0.7 * width, ls="--", label=slope)
        damping.plot(
            curves.velocity, getattr(curves, f"C_{j}"), color=colour, lw=width, label=rf"$C_\mathrm{{{j}}}$, {tissue}"
        )
        place = getattr(curves, f"x_{j}")
        if np.isfinite(place):
            stiffness.axvline(1e3 * place, color=colour, lw=0.8, ls=":", label=rf"$x_\mathrm{{{j}}}$ of the task", zorder=1)
    _finish(stiffness, "Displacement (mm)", "Stiffness (N/m)", room=0.75)
    _finish(damping, "Velocity (m/s)", "Damping (N s/m)", room=0.35)


def _forces(curves: Any, ax: "Axes") -> None:
    from ._style import BLUE, GREEN, GREY, VERMILLION

    x = 1e3 * curves.displacement
    ax.plot(x, curves.F_w, color=BLUE, lw=3.0, label="spring of the active tissue")
    ax.plot(x, curves.F_z, color=VERMILLION, label="spring of the passive tissue")
    ax.plot(x, curves.F_ext, color=GREY, label=r"$F_\mathrm{ext}$ held at $x$, $P_\mathrm{w}$ = 0")
    if np.isfinite(curves.P_w) and curves.P_w != 0:
        label = rf"$F_\mathrm{{ext}}$ held at $x$, $P_\mathrm{{w}}$ = {curves.P_w:.3g} N"
        ax.plot(x, curves.F_ext_active, color=GREEN, label=label)
    _finish(ax, "Displacement (mm)", "Force (N)", room=0.6)


def _finish(ax: "Axes", across: str, up: str, *, room: float) -> None:
    """Labels, and a legend above the curves in `room` times their height."""
    low, high = ax.get_ylim()
    low = min(low, 0.0)
    ax.set_ylim(low, high + room * (high - low))
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.legend(loc="upper center", fontsize=6.5)
