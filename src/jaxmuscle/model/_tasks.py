"""Tasks: which end of the muscle is held or loaded, equations of motion, inputs and output."""

import abc
import dataclasses
from typing import Any, ClassVar, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import is_concrete, require
from jaxmuscle._common.text import choices
from jaxmuscle._common.types import Scalar
from jaxmuscle.spectra._settings import SpectrumSettings

from ._activation import ACTIVE, Activation
from ._muscle import AbstractMuscle, Muscle, Perturbation
from ._noise import AbstractNoise, NoiseSum
from ._parameters import CHANNELS, INPUTS, default, get_parameter, paths_of, set_parameters
from ._resonant_noise import ResonantNoise
from ._signals import AbstractSignal, Harmonic, as_held, as_signal, derivatives
from ._white_noise import BandLimitedNoise

State = Float[Array, " states"]
Observed = Literal["displacement", "acceleration"]


class AbstractTask(eqx.Module):
    """What is simulated: `y' = vector_field(t, y, u)`, observed as `output(t, y, u, u')`.

    `u = (ΔK_w, ΔK_z, ΔC_w, ΔC_z, ΔP_w / P_w)` [N/m, N s/m, 1] is the perturbation of coefficients and drive: noise and
    harmonic, those of K_w, C_w and P_w through the `activation` if there is one. Common to all tasks are the `muscle`, the
    `noise` (None in a field: the default), the `harmonic`, the `activation` (None: none), how the output's spectrum is
    estimated (`settings`) and the initial state (`initial`, zero by default).

    `task[name]` reads, `task.replace(name=value)` changes a parameter by its name in the parameter table.
    """

    muscle: AbstractMuscle = eqx.field(default_factory=Muscle, kw_only=True)
    noise: AbstractNoise = eqx.field(
        default_factory=BandLimitedNoise, kw_only=True, converter=lambda noise: noise.per_channel()
    )
    harmonic: Harmonic = eqx.field(default_factory=Harmonic, kw_only=True)
    activation: Activation | None = eqx.field(default=None, kw_only=True)
    settings: SpectrumSettings = eqx.field(static=True, default_factory=SpectrumSettings, kw_only=True)
    initial: tuple[Scalar, ...] | None = eqx.field(default=None, kw_only=True)

    state_names: ClassVar[tuple[str, ...]]
    state_units: ClassVar[tuple[str, ...]]
    output_name: ClassVar[str]
    output_unit: ClassVar[str]
    smoothness_needed: ClassVar[tuple[int, ...]]

    @abc.abstractmethod
    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        """Time derivative of the state."""

    @abc.abstractmethod
    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        """What is measured, given the state, the perturbation and its time derivative."""

    def __getitem__(self, name: str) -> Scalar:
        return get_parameter(self, name)

    def replace(self, **values: Scalar) -> "AbstractTask":
        """A copy with the named parameters set. Raises `ValueError` for an unknown name or an impossible value."""
        return set_parameters(self, values)

    def with_parts(self, **parts: Any) -> "AbstractTask":
        """A copy with whole parts (`muscle`, `noise`, `harmonic`, `settings`, inputs) exchanged."""
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return type(self)(**(fields | parts))

    def as_task(self, task: "type[AbstractTask]", **inputs: Any) -> "AbstractTask":
        """The same muscle, perturbation and settings in another task, with that task's default inputs unless given."""
        return task(**self.common, **inputs)

    @property
    def common(self) -> dict[str, Any]:
        """What all tasks have: muscle, noise, harmonic, activation and spectrum settings."""
        return {n: getattr(self, n) for n in ("muscle", "noise", "harmonic", "activation", "settings")}

    @property
    def quantity(self) -> str:
        """What the output is, by its unit: "force", "displacement" or "acceleration", as a `Target` calls it."""
        return {"m": "displacement", "m/s^2": "acceleration"}.get(self.output_unit, "force")

    def with_input(self, name: str) -> "AbstractTask":
        """A copy with the activation (`activation_time`) or the drive's channel of the noise (`noise_P_w`) switched on."""
        if name == "activation_time":
            return self.with_parts(activation=Activation())
        parts = list(self.noise.components)
        which = next((i for i, part in enumerate(parts) if not isinstance(part, ResonantNoise)), None)
        if which is None or len(parts[which].acts_on) != len(CHANNELS):
            return self
        amplitude = parts[which].amplitude
        wider = jnp.append(amplitude, 0.0) if isinstance(amplitude, jax.Array) else np.append(np.asarray(amplitude), 0.0)
        parts[which] = eqx.tree_at(lambda n: n.amplitude, parts[which], wider)
        return self.with_parts(noise=NoiseSum(tuple(parts)) if len(parts) > 1 else parts[0])

    def check_step(self, dt: float) -> None:
        """Raise a `ValueError` if a grid of step dt [s] is too coarse for noise or activation."""
        self.noise.check_step(dt)
        if self.activation is not None:
            self.activation.check_step(dt)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of all parameters of this task."""
        return tuple(paths_of(self))

    @property
    def parameters(self) -> dict[str, Scalar]:
        """All parameters by name."""
        return {name: get_parameter(self, name) for name in self.parameter_names}

    def initial_state(self) -> State:
        """State at t = 0."""
        size = len(self.state_names)
        return jnp.zeros(size) if self.initial is None else jnp.stack([jnp.asarray(v) * 1.0 for v in self.initial])

    def noise_scale(self, noise: AbstractNoise | None = None) -> Float[Array, " inputs"]:
        """Amplitude of the noise, or of one of its components, in the units of the inputs that it acts on."""
        noise = self.noise if noise is None else noise
        amplitude = jnp.asarray(noise.amplitude)
        if not noise.relative or len(noise.acts_on) == 1:
            return amplitude
        base = self.muscle.base()
        return amplitude * (base if len(noise.acts_on) == len(base) else jnp.append(base, jnp.ones((), base.dtype)))

    def harmonic_base(self) -> Perturbation:
        """What the harmonic is a fraction of: (K_w0, K_z0, 0, 0, 0)."""
        base = self.muscle.base()
        stiffness = np.array([1.0, 1.0, 0.0, 0.0, 0.0], dtype=jnp.result_type(float))
        return jnp.append(base, jnp.zeros((), base.dtype)) * stiffness


def require_task(task: Any, example: str) -> None:
    """Raise a `ValueError` for what is no task, where one is needed."""
    require(
        isinstance(task, AbstractTask),
        f"task: a {type(task).__name__}; give a task first, as jaxmuscle.Isometric(): {example}",
    )


def _check_task(task: AbstractTask) -> None:
    if task.initial is not None and len(task.initial) != len(task.state_names):
        raise ValueError(f"initial has {len(task.initial)} entries, {type(task).__name__} needs {task.state_names}")
    _check_noise(task)


def _check_noise(task: AbstractTask) -> None:
    """Refuse noise rougher than the task can sample or differentiate, where its amplitude is not zero."""
    what = {1: f"appears directly in the output {task.output_name}, where white noise has no value",
            2: "must be differentiable in time"}  # fmt: skip
    needed = (*task.smoothness_needed, 0)
    for noise in task.noise.components:
        if not is_concrete(noise.amplitude):
            continue
        for i, amplitude in zip(noise.acts_on, np.asarray(noise.amplitude), strict=True):
            have = noise.smoothness + 2 * (task.activation is not None and i in ACTIVE)
            if have < needed[i] and amplitude != 0:
                raise ValueError(
                    f"{type(noise).__name__} on {INPUTS[i]} cannot be used in {type(task).__name__}: there it "
                    f"{what[needed[i]]}. Use BandLimitedNoise, or set noise_{INPUTS[i]} = 0"
                )


def _check_smooth(task: AbstractTask, name: str, need: int) -> None:
    signal = getattr(task, name)
    if signal.smoothness < need:
        raise ValueError(f"{name} is a {type(signal).__name__} with {signal.smoothness} continuous derivatives; "
                         f"{type(task).__name__} needs {need}: use SmoothStep, RampHold or Sampled")  # fmt: skip


class PrescribedMotion(AbstractTask):
    """Task 1: the insertion moves as prescribed, which internal force P_w does that need?

    State x_w. Equation (1b) gives `x_w' = v` such that `passive_force(x_w, v, x_z, x_z', u) = -(F_ext + m_z x_z'')`, for
    the paper's muscle `x_w' = x_z' + (F_ext + m_z x_z'' + K_z (x_z - x_w)) / C_z`, and (1a) the output

        P_w = m_w x_w'' + active_force(x_w, x_w', u) + m_z x_z'' + F_ext

    where x_w'' is the total time derivative of the right-hand side along (1, x_w', u').

    **Arguments:** `x_z` [m] and `F_ext` [N], numbers (smooth steps from zero) or signals; the common fields.

    **Raises:** `ValueError` if C_z0 = 0 (x_w' would be infinite at rest), if noise on K_z or C_z is not differentiable,
    for white noise anywhere (P_w contains it), for inputs that are not smooth enough.
    """

    x_z: AbstractSignal = eqx.field(converter=as_signal, default=default("x_z"))
    F_ext: AbstractSignal = eqx.field(converter=as_signal, default=10.0)
    state_names: ClassVar[tuple[str, ...]] = ("x_w",)
    state_units: ClassVar[tuple[str, ...]] = ("m",)
    output_name: ClassVar[str] = "P_w"
    output_unit: ClassVar[str] = "N"
    smoothness_needed: ClassVar[tuple[int, ...]] = (1, 2, 1, 2, 1)

    def __check_init__(self):
        _check_task(self)
        _check_smooth(self, "x_z", 3)
        _check_smooth(self, "F_ext", 1)
        _check_smooth_envelope(self)
        require(self.muscle.base()[3] > 0, "C_z0 = c_z v_ref_z^2 = 0: in PrescribedMotion x_w' divides by C_z, which "
                "would vanish whenever the insertion rests; give c_z > 0 and v_ref_z > 0")  # fmt: skip

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

    State (x_w, x_w', x_z, x_z'), equations (1a) and (1b). Output: x_z [m]; or with `observe="acceleration"`, what an
    accelerometer on the insertion reads but for gravity,

        x_z'' = -(F_ext + passive_force(x_w, x_w', x_z, x_z', u)) / m_z    [m/s^2]

    Its mean is zero. So it has no coefficient of variation.

    **Arguments:** `P_w` and `F_ext` [N], numbers (smooth steps from zero) or signals; `observe`, "displacement" or
    "acceleration"; the common fields.

    **Raises:** `ValueError` for another `observe`, and for white noise on K_z or C_z, which x_z'' contains directly.
    """

    P_w: AbstractSignal = eqx.field(converter=as_signal, default=default("P_w"))
    F_ext: AbstractSignal = eqx.field(converter=as_signal, default=default("F_ext"))
    observe: Observed = eqx.field(static=True, default="displacement", kw_only=True)
    state_names: ClassVar[tuple[str, ...]] = ("x_w", "v_w", "x_z", "v_z")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m/s", "m", "m/s")

    def __check_init__(self):
        if self.observe not in get_args(Observed):
            raise ValueError(f"observe = {self.observe!r}: {choices(str(self.observe), get_args(Observed))}")
        _check_task(self)

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
        """x_z'' contains the noise on K_z and C_z."""
        return (0, 0, 0, 0, 0) if self.observe == "displacement" else (0, 1, 0, 1, 0)

    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        x_w, v_w, x_z, v_z = y[0], y[1], y[2], y[3]
        muscle = self.muscle
        passive = muscle.passive_force(x_w, v_w, x_z, v_z, u)
        a_w = (muscle.drive(self.P_w(t), u) - muscle.active_force(x_w, v_w, u) + passive) / muscle.m_w
        return jnp.stack([v_w, a_w, v_z, -(self.F_ext(t) + passive) / muscle.m_z])

    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        return y[2] if self.observe == "displacement" else self.vector_field(t, y, u)[3]


class PrescribedLength(AbstractTask):
    """The perturbation experiment: a motor moves the insertion as prescribed, a sensor there reads F_ext.

    State (x_w, x_w'), equation (1a) with x_z(t) given; output, by (1b),

        F_ext = -(passive_force(x_w, x_w', x_z, x_z', u) + m_z x_z'')

    x_z counts in the direction of the muscle's pull: where it rises, the muscle shortens. `dynamic_stiffness` is the
    linear response of -F_ext to it.

    **Arguments:** `P_w` [N], a number (a smooth step from zero) or a signal; `x_z` [m], a number (held from the start) or
    a signal with two continuous derivatives; the common fields.

    **Raises:** `ValueError` for white noise on K_z or C_z, which F_ext contains directly, and for an x_z that is not smooth.
    """

    P_w: AbstractSignal = eqx.field(converter=as_signal, default=default("P_w"))
    x_z: AbstractSignal = eqx.field(converter=as_held, default=default("x_z"))
    state_names: ClassVar[tuple[str, ...]] = ("x_w", "v_w")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m/s")
    output_name: ClassVar[str] = "F_ext"
    output_unit: ClassVar[str] = "N"
    smoothness_needed: ClassVar[tuple[int, ...]] = (0, 1, 0, 1, 0)

    def __check_init__(self):
        _check_task(self)
        if isinstance(self.x_z, AbstractSignal):
            _check_smooth(self, "x_z", 2)

    def insertion(self, t: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        """Where the insertion is at time t [s], its velocity and its acceleration."""
        return derivatives(self.x_z, t, 2)  # pyright: ignore[reportReturnType]

    def moved(self, t: Scalar, y: State, u: Perturbation, insertion: tuple[Scalar, Scalar, Scalar]) -> tuple[State, Scalar]:
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

    `PrescribedLength` with an insertion at rest: output `F_ext = C_z x_w' + K_z (x_w - x_z)`, the negative passive force.

    **Arguments:** `P_w` [N], a number (a smooth step from zero) or a signal; `x_z` [m], a number; the common fields.

    **Raises:** `ValueError` for white noise on K_z or C_z, which F_ext contains directly.
    """

    x_z: Scalar = default("x_z")  # pyright: ignore[reportIncompatibleVariableOverride]

    def insertion(self, t: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        x_z = jnp.asarray(self.x_z)
        return x_z, jnp.zeros_like(x_z), jnp.zeros_like(x_z)


def _check_smooth_envelope(task: AbstractTask) -> None:
    envelope = task.harmonic.envelope
    if envelope.smoothness < 1:
        raise ValueError(f"harmonic envelope {type(envelope).__name__} must have a continuous derivative")


TASKS: dict[str, type[AbstractTask]] = {
    "isometric": Isometric,
    "prescribed-length": PrescribedLength,
    "prescribed-motion": PrescribedMotion,
    "prescribed-force": PrescribedForce,
}
