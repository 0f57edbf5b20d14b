"""Tasks: which end of the muscle is held or loaded, equations of motion, inputs and output."""

from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxmuscle._common.arrays import require
from jaxmuscle._common.text import choices
from jaxmuscle._common.types import Scalar

from ._muscle import AbstractMuscle, Perturbation
from ._parameters import PARAMETERS, default
from ._reflex import Reflex
from ._signals import AbstractSignal, Constant, as_held, as_level, as_signal, derivatives
from ._task import AbstractTask, State, check_smooth, check_smooth_envelope, check_task, fill

Observed = Literal["displacement", "acceleration"]


class PrescribedMotion(AbstractTask):
    """Task 1: the insertion moves as prescribed, which internal force P_w does that need?

    State x_w. Equation (1b) gives `x_w' = v` such that `passive_force(x_w, v, x_z, x_z', u) =
    -(F_ext + m_z x_z'')`, for the paper's muscle `x_w' = x_z' + (F_ext + m_z x_z'' + K_z (x_z -
    x_w)) / C_z`, and (1a) the output

        P_w = m_w x_w'' + active_force(x_w, x_w', u) + m_z x_z'' + F_ext

    where x_w'' is the total time derivative of the right-hand side along (1, x_w', u').

    **Arguments:** `x_z` [m] and `F_ext` [N], numbers (smooth steps from zero) or signals; the
    common fields.

    **Raises:** `ValueError` if C_z0 = 0 (x_w' would be infinite at rest), if noise on K_z or C_z is
    not differentiable, for white noise anywhere (P_w contains it), for inputs that are not smooth
    enough.
    """

    x_z: AbstractSignal = eqx.field(converter=as_signal, default=default("x_z"))
    F_ext: AbstractSignal = eqx.field(converter=as_signal, default=10.0)
    state_names: ClassVar[tuple[str, ...]] = ("x_w",)
    state_units: ClassVar[tuple[str, ...]] = ("m",)
    output_name: ClassVar[str] = "P_w"
    output_unit: ClassVar[str] = "N"
    smoothness_needed: ClassVar[tuple[int, ...]] = (1, 2, 1, 2, 1)

    def __init__(
        self,
        x_z: "AbstractSignal | Scalar" = PARAMETERS["x_z"].default,
        F_ext: "AbstractSignal | Scalar" = 10.0,
        **parts: Any,
    ):
        fill(self, {"x_z": x_z, "F_ext": F_ext} | parts)

    def __check_init__(self):
        check_task(self)
        check_smooth(self, "x_z", 3)
        check_smooth(self, "F_ext", 1)
        check_smooth_envelope(self)
        require(
            type(self.muscle).contraction_velocity is not AbstractMuscle.contraction_velocity,
            f"{type(self.muscle).__name__} has no method contraction_velocity, which"
            " PrescribedMotion needs: write it (see docs/own-muscle.md), or use another task",
        )
        require(
            self.muscle.base()[3] > 0,
            "C_z0 = c_z v_ref_z^2 = 0: in PrescribedMotion x_w' divides by C_z, which "
            "would vanish whenever the insertion rests; give c_z > 0 and v_ref_z > 0",
        )

    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        x_z, v_z, a_z = derivatives(self.x_z, t, 2)
        force = -(self.F_ext(t) + self.muscle.m_z * a_z)
        return self.muscle.contraction_velocity(y[0], x_z, v_z, force, u)[None]

    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        t = jnp.asarray(t)
        v_w = self.vector_field(t, y, u)
        _, a_w = jax.jvp(self.vector_field, (t, y, u), (jnp.ones_like(t), v_w, du))
        _, _, a_z = derivatives(self.x_z, t, 2)
        active = self.muscle.active_force(y[0], v_w[0], u)
        return self.muscle.m_w * a_w[0] + active + self.muscle.m_z * a_z + self.F_ext(t)


class PrescribedForce(AbstractTask):
    """Task 2: the muscle pulls with a prescribed force P_w, how does the insertion move?

    State (x_w, x_w', x_z, x_z'), equations (1a) and (1b). Output: x_z [m]; or with
    `observe="acceleration"`, what an accelerometer on the insertion reads but for gravity,

        x_z'' = -(F_ext + passive_force(x_w, x_w', x_z, x_z', u)) / m_z    [m/s^2]

    Its mean is zero. So it has no coefficient of variation.

    **Arguments:** `P_w` and `F_ext` [N], numbers (smooth steps from zero) or signals; `observe`,
    "displacement" or "acceleration"; the common fields.

    **Raises:** `ValueError` for another `observe`, and for white noise on K_z or C_z, which x_z''
    contains directly.
    """

    P_w: AbstractSignal = eqx.field(converter=as_signal, default=default("P_w"))
    F_ext: AbstractSignal = eqx.field(converter=as_signal, default=default("F_ext"))
    observe: Observed = eqx.field(static=True, default="displacement", kw_only=True)
    state_names: ClassVar[tuple[str, ...]] = ("x_w", "v_w", "x_z", "v_z")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m/s", "m", "m/s")

    def __init__(
        self,
        P_w: "AbstractSignal | Scalar" = PARAMETERS["P_w"].default,
        F_ext: "AbstractSignal | Scalar" = PARAMETERS["F_ext"].default,
        *,
        observe: Observed = "displacement",
        **parts: Any,
    ):
        fill(self, {"P_w": P_w, "F_ext": F_ext, "observe": observe} | parts)

    def __check_init__(self):
        if self.observe not in get_args(Observed):
            raise ValueError(
                f"observe = {self.observe!r}: {choices(str(self.observe), get_args(Observed))}"
            )
        check_task(self)

    @property
    def output_name(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """x_z, or a_z for x_z''."""
        return "x_z" if self.observe == "displacement" else "a_z"

    @property
    def output_unit(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of the output."""
        return "m" if self.observe == "displacement" else "m/s^2"

    @property
    def smoothness_needed(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The least `smoothness` that the noise on K_w, K_z, C_w, C_z and P_w must have; 0: any.

        With `observe="acceleration"` it is 1 for K_z and C_z, since x_z'' contains their noise.
        """
        return (0, 0, 0, 0, 0) if self.observe == "displacement" else (0, 1, 0, 1, 0)

    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        x_w, v_w, x_z, v_z = y[0], y[1], y[2], y[3]
        muscle = self.muscle
        passive = muscle.passive_force(x_w, v_w, x_z, v_z, u)
        a_w = (
            muscle.drive(self.P_w(t), u) - muscle.active_force(x_w, v_w, u) + passive
        ) / muscle.m_w
        return jnp.stack([v_w, a_w, v_z, -(self.F_ext(t) + passive) / muscle.m_z])

    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        return y[2] if self.observe == "displacement" else self.vector_field(t, y, u)[3]


class PrescribedLength(AbstractTask):
    """The perturbation experiment: a motor moves the insertion as prescribed, a sensor there reads
    F_ext.

    State (x_w, x_w'), equation (1a) with x_z(t) given; output, by (1b),

        F_ext = -(passive_force(x_w, x_w', x_z, x_z', u) + m_z x_z'')

    x_z counts in the direction of the muscle's pull: where it rises, the muscle shortens.
    `dynamic_stiffness` is the linear response of -F_ext to it.

    **Arguments:**

    - `P_w` [N]: a number (a smooth step from zero) or a signal, as `jaxmuscle.model.RampHold(5.0)`
    - `x_z` [m]: a number (held from the start) or a signal with two continuous derivatives; samples
      over time become one by `jaxmuscle.model.Sampled.through(times, values)`
    - `muscle`, `noise`, `harmonic`, `activation`, `settings`, `initial`: the fields that all tasks
      have
    - `reflex`: a `Reflex`, which only the linear response has (`dynamic_stiffness`, fits): F_ext
      answers a lengthening l with `H l + G_P R l`, G_P being what F_ext does with a force on the
      active tissue. In a hold it does nothing
    - any other name: a parameter of the table `jaxmuscle.model.PARAMETERS`, as `k_w=4e5`

    **Raises:** `ValueError` for white noise on K_z or C_z, which F_ext contains directly, for an
    x_z that is not smooth, and for what moves with a reflex: a delay cannot be simulated yet.
    """

    P_w: AbstractSignal = eqx.field(converter=as_signal, default=default("P_w"))
    x_z: AbstractSignal = eqx.field(converter=as_held, default=default("x_z"))
    reflex: Reflex | None = eqx.field(default=None, kw_only=True)
    state_names: ClassVar[tuple[str, ...]] = ("x_w", "v_w")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m/s")
    output_name: ClassVar[str] = "F_ext"
    output_unit: ClassVar[str] = "N"
    smoothness_needed: ClassVar[tuple[int, ...]] = (0, 1, 0, 1, 0)

    def __init__(
        self,
        P_w: "AbstractSignal | Scalar" = PARAMETERS["P_w"].default,
        x_z: "AbstractSignal | Scalar" = PARAMETERS["x_z"].default,
        **parts: Any,
    ):
        fill(self, {"P_w": P_w, "x_z": x_z} | parts)

    def __check_init__(self):
        check_task(self)
        if isinstance(self.x_z, AbstractSignal):
            check_smooth(self, "x_z", 2)
        if self.reflex is not None:
            self.reflex.__check_init__()
            require(
                not isinstance(self.x_z, AbstractSignal) or type(self.x_z) is Constant,
                "reflex: the insertion moves, and what a reflex does then can be computed in linear"
                " response only (jaxmuscle.response.dynamic_stiffness): hold x_z, or leave the"
                " reflex out",
            )

    def insertion(self, t: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """Where the insertion is at time t [s], its velocity and its acceleration."""
        return derivatives(self.x_z, t, 2)  # pyright: ignore[reportReturnType]

    def moved(
        self, t: Scalar, y: State, u: Perturbation, insertion: tuple[Scalar, Scalar, Scalar]
    ) -> tuple[State, Scalar]:
        """Time derivative of the state, and F_ext, with the insertion there."""
        x_z, v_z, a_z = insertion
        passive = self.muscle.passive_force(y[0], y[1], x_z, v_z, u)
        drive = self.muscle.drive(self.P_w(t), u)
        force = drive - self.muscle.active_force(y[0], y[1], u) + passive
        return jnp.stack([y[1], force / self.muscle.m_w]), -(passive + self.muscle.m_z * a_z)

    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        return self.moved(t, y, u, self.insertion(t))[0]

    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        return self.moved(t, y, u, self.insertion(t))[1]


class Isometric(PrescribedLength):
    """The experiments of [30] and [12]: the insertion is held at x_z, a sensor there reads F_ext.

    `PrescribedLength` with an insertion at rest: output `F_ext = C_z x_w' + K_z (x_w - x_z)`, the
    negative passive force.

    **Arguments:**

    - `P_w` [N]: a number (a smooth step from zero) or a signal, as `jaxmuscle.model.RampHold(5.0)`
    - `x_z` [m]: a number
    - `muscle`, `noise`, `harmonic`, `activation`, `settings`, `initial`: the fields that all tasks
      have
    - any other name: a parameter of the table `jaxmuscle.model.PARAMETERS`, as `k_w=4e5`

    **Raises:** `ValueError` for white noise on K_z or C_z, which F_ext contains directly.
    """

    x_z: Scalar = eqx.field(converter=as_level, default=default("x_z"))  # pyright: ignore[reportIncompatibleVariableOverride]

    def insertion(self, t: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        x_z = jnp.asarray(self.x_z)
        return x_z, jnp.zeros_like(x_z), jnp.zeros_like(x_z)


TASKS: dict[str, type[AbstractTask]] = {
    "isometric": Isometric,
    "prescribed-length": PrescribedLength,
    "prescribed-motion": PrescribedMotion,
    "prescribed-force": PrescribedForce,
}
