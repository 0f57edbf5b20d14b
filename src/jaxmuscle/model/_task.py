"""What every task has: muscle, perturbation, parameters by name, and what a task shows of
itself."""

import abc
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import Inexact, _is_scalar, checked, is_concrete, require
from jaxmuscle._common.cards import Card, Shown, in_columns
from jaxmuscle._common.types import Scalar
from jaxmuscle._common.upward import load_above
from jaxmuscle.spectra._settings import SpectrumSettings

from ._activation import ACTIVE, Activation
from ._muscle import AbstractMuscle, Muscle, Perturbation
from ._noise import AbstractNoise, NoiseSum
from ._noise_names import named_noise
from ._own_parts import check_muscle, check_noise
from ._parameters import (
    BASE,
    CHANNELS,
    INPUTS,
    PARAMETERS,
    assigned,
    get_parameter,
    paths_of,
    set_parameters,
    usually_free,
    value_of,
)
from ._reflex import Reflex
from ._resonant_noise import ResonantNoise
from ._signals import AbstractSignal, Harmonic
from ._white_noise import BandLimitedNoise

State = Float[Array, " states"]
Task = TypeVar("Task", bound="AbstractTask")
HOLD = 15.0  # s from the start, by when inputs are held: the end of the analysed window


# What a field must be, and how one is written.
PARTS = {
    "muscle": (AbstractMuscle, "jaxmuscle.Muscle()"),
    "noise": (AbstractNoise, "jaxmuscle.PinkNoise(), or a name, as 'pink'"),
    "harmonic": (Harmonic, "jaxmuscle.Harmonic(amplitude=0.02, frequency=9.0)"),
    "activation": (Activation, "jaxmuscle.Activation(time=0.06)"),
    "reflex": (Reflex, "jaxmuscle.Reflex(gain=5.0, delay=0.045)"),
    "settings": (SpectrumSettings, "jaxmuscle.SpectrumSettings.named('slow')"),
}


def proper_part(name: str, value: Any) -> Any:
    """A field of a task as it is. Raises `ValueError` for what cannot be one, with an example."""
    kind, example = PARTS[name]
    if not isinstance(value, kind):
        what = f"the class {value.__name__}" if isinstance(value, type) else repr(value)
        raise ValueError(f"{name} = {what}: give an object, as {example}")
    return value


class AbstractTask(Shown, Inexact):
    """What is simulated: `y' = vector_field(t, y, u)`, observed as `output(t, y, u, u')`.

    `u = (ΔK_w, ΔK_z, ΔC_w, ΔC_z, ΔP_w / P_w)` [N/m, N s/m, 1] is the perturbation of coefficients
    and drive: noise and harmonic, those of K_w, C_w and P_w through the `activation` if there is
    one. Common to all tasks are the `muscle`, the `noise`, the `harmonic`, the `activation`, how
    the output's spectrum is estimated (`settings`) and the initial state (`initial`). As an
    argument None stands for the default muscle, noise, harmonic and settings, for no activation,
    and for an initial state of zero.

    `task[name]` and `task.name` read a parameter by its name in the parameter table,
    `task.replace(name=value)` changes it; the tasks of the package take it as an argument, too, and
    a noise by its name: `Isometric(k_w=4e5, noise="pink")`. A name that is a field of the task
    (`P_w`, the signal) stays the field: `task["P_w"]` is its level. Printed, a task is a table.
    """

    muscle: AbstractMuscle = eqx.field(default_factory=Muscle, kw_only=True)
    noise: AbstractNoise = eqx.field(
        default_factory=BandLimitedNoise,
        kw_only=True,
        converter=lambda noise: proper_part("noise", noise).per_channel(),
    )
    harmonic: Harmonic = eqx.field(default_factory=Harmonic, kw_only=True)
    activation: Activation | None = eqx.field(default=None, kw_only=True)
    settings: SpectrumSettings = eqx.field(
        static=True, default_factory=SpectrumSettings, kw_only=True
    )
    initial: tuple[Scalar, ...] | None = eqx.field(default=None, kw_only=True)

    state_names: ClassVar[tuple[str, ...]]
    state_units: ClassVar[tuple[str, ...]]
    output_name: ClassVar[str]
    output_unit: ClassVar[str]
    smoothness_needed: ClassVar[tuple[int, ...]]

    def __check_init__(self):
        if missing := [name for name in SAID if not hasattr(type(self), name)]:
            raise ValueError(
                f"{type(self).__name__} does not say its {', '.join(missing)}: a task of your own"
                f" needs {', '.join(SAID)} as class variables, as jaxmuscle.Isometric has them"
            )

    @abc.abstractmethod
    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        """Time derivative of the state."""

    @abc.abstractmethod
    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        """What is measured, given the state, the perturbation and its time derivative."""

    def __getitem__(self, name: str) -> Scalar:
        return get_parameter(self, name)

    def __getattr__(self, name: str) -> Scalar:
        """A parameter by its name. Raises `AttributeError` for what is neither a parameter nor
        anything else."""
        if name[:1] == "_" or name in {field.name for field in dataclasses.fields(self)}:
            raise AttributeError(f"{type(self).__name__} has no {name}", name=name, obj=self)
        try:
            return get_parameter(self, name)
        except ValueError as error:
            raise AttributeError(str(error), name=name, obj=self) from None

    def __dir__(self) -> list[str]:
        return [*object.__dir__(self), *self.parameter_names, *BASE]

    def replace(self: Task, **values: Scalar) -> Task:
        """A copy with the named parameters set. Raises `ValueError` for an unknown name or an
        impossible value.

        task = jm.Isometric().replace(k_w=4e5, noise_K_w=0.1)
        """
        return set_parameters(self, values)

    def with_parts(self: Task, **parts: Any) -> Task:
        """A copy with whole parts exchanged: fields of the task, as `muscle`, `noise`, `harmonic`,
        `settings`, and inputs over time, as `P_w`. The tasks of the package take parameters here,
        too, as `k_w=4e5`.

            task = jm.Isometric().with_parts(noise=jm.PinkNoise())

        Raises `ValueError` for what is neither a field nor a parameter of the task.
        """
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return type(self)(**(fields | parts))

    def as_task(self, task: type[Task], **inputs: Any) -> Task:
        """The same muscle, perturbation and settings in another task, with that task's default
        inputs unless given.

        moving = jm.Isometric().as_task(jm.PrescribedForce, P_w=4.0)
        """
        return task(**self.common, **inputs)

    @property
    def common(self) -> dict[str, Any]:
        """What all tasks have: muscle, noise, harmonic, activation and spectrum settings."""
        return {
            n: getattr(self, n) for n in ("muscle", "noise", "harmonic", "activation", "settings")
        }

    @property
    def quantity(self) -> str:
        """What the output is, by its unit: "force", "displacement" or "acceleration", as a `Target`
        calls it."""
        return {"m": "displacement", "m/s^2": "acceleration"}.get(self.output_unit, "force")

    def with_input(self, name: str) -> "AbstractTask":
        """A copy that has the parameter `name`, of those that a task may lack.

        "activation_time" adds an activation with its default contraction time; "noise_P_w" adds the
        drive's channel to the noise, with the amplitude 0, which `replace` changes.
        """
        if name == "activation_time":
            return self.with_parts(activation=Activation())
        parts = list(self.noise.components)
        which = next(
            (i for i, part in enumerate(parts) if not isinstance(part, ResonantNoise)), None
        )
        if which is None or len(parts[which].acts_on) != len(CHANNELS):
            return self
        amplitude = parts[which].amplitude
        wider = (
            jnp.append(amplitude, 0.0)
            if isinstance(amplitude, jax.Array)
            else np.append(np.asarray(amplitude), 0.0)
        )
        parts[which] = eqx.tree_at(lambda n: n.amplitude, parts[which], wider)
        return self.with_parts(noise=NoiseSum(tuple(parts)) if len(parts) > 1 else parts[0])

    def settled(self: Task, time: float = HOLD) -> Task:
        """The task with its inputs held at their values at `time` [s] from the start, and starting
        from equilibrium.

            run = jm.simulate(jm.Isometric().settled(), jax.random.key(0), duration=10.0)

        Its simulation has no rise and no transient of the mean: what the linear response describes.
        """
        return load_above("response._linearised").settled(self, time)

    def at_force(self: Task, mean: Scalar) -> Task:
        """The task scaled to another mean force: forces, masses, stiffness and damping multiplied
        by one number.

            task = jm.Isometric().at_force(40.5)

            P_w, F_ext, m_j, k_j, c_j ∝ s    (and noise in absolute units)
            s = mean / (mean force of the task)

        Every term of (1a) and (1b) is then s times what it was: displacements, times, proportional
        power and the coefficient of variation stay to the last digit, forces are s times as large.
        So a fit that starts from this task has its priors centred on these values, and a mean force
        in newtons can be data (`fit(..., mean_force=)`).

        **Arguments:** `mean` [N], of the sign of the task's own mean force.

        **Raises:** `ValueError` for a task whose output is not a force or has a mean of zero, a
        `mean` of zero or of the other sign, a muscle that is not made of the paper's quadratic
        laws; `OperatingPointError` (a `ValueError`) where there is no stable equilibrium.
        """
        return load_above("response._scaling").at_force(self, mean)

    def at_level(
        self: Task,
        mvc_fraction: Scalar,
        *,
        reference: Scalar = 0.3,
        steadiest: Scalar = 0.3,
        contrast: Scalar = 1.0,
        resting: Scalar = 0.0,
        damping: Scalar = 1.0,
    ) -> Task:
        """The task at another level of contraction, `mvc_fraction` L; as it is, it stands for
        `reference` L₀.

            strong = jm.Isometric().at_level(0.6)

            P_w, F_ext ∝ L,   k_j ∝ κ(L) = resting + (1 - resting) L,   c_j ∝ κ(L)^damping
            coefficient of variation of the output ∝ g(L) = relative_variation(L)

        The last is what has been measured; all amplitudes of noise and harmonic are multiplied by
        the one number that makes the expected (linear-response) value follow it, from the task's
        own at L₀. With `resting = 0` the operating point does not move and force is proportional to
        L. `task.at_level(reference)` is the task; two steps make one. It means the same in every
        task: P_w is prescribed in `Isometric` and `PrescribedForce`, in `PrescribedMotion` it
        follows from F_ext.

        **Arguments:**

        - `mvc_fraction`, `reference`, `steadiest`: in (0, 1], fractions of the maximum voluntary
          contraction
        - `contrast` of g
        - `resting` in [0, 1), the share of the stiffness at L = 1 that is there without activation
        - `damping`: 1 keeps C/K, 0.5 the damping ratio

        **Raises:** `ValueError` for a fraction outside (0, 1] (30 % is 0.3), for a task in which no
        force is prescribed, for a muscle that is not made of the paper's quadratic laws;
        `OperatingPointError` (a `ValueError`) where there is no stable equilibrium.

        **Source:** stiffness proportional to force: Shadmehr & Arbib 1992, doi:10.1007/BF00204111
        (muscle without reflexes). Both tissues alike, damping and the noise law: assumptions, see
        docs/scaling.md.
        """
        law = {"reference": reference, "steadiest": steadiest, "contrast": contrast}
        law |= {"resting": resting, "damping": damping}
        return load_above("response._scaling").at_level(self, mvc_fraction, **law)

    def scaled(
        self: Task,
        size: Scalar,
        *,
        time_exponent: Scalar = 1.0,
        strength_exponent: Scalar = 0.25,
    ) -> Task:
        """A geometrically similar muscle, all lengths multiplied by `size` s, under the same
        stress.

            bigger = jm.Isometric().scaled(1.2)

            x_ref, x_z ∝ s,   P_w, F_ext ∝ s²,   m ∝ s³,   K_0 ∝ s (k ∝ 1/s)
            C_0 ∝ s^(1 + e),   v_ref ∝ s^(1 - e)
            coefficient of variation of the output ∝ (s²)^(-strength_exponent)

        e, `time_exponent`, says how intrinsic times grow: 1 is dynamic similarity, every rate ∝ 1/s
        (velocities and damping ratio stay); 0 keeps C/K, as a material of given viscosity would.
        Strength is s²; 1/2 as exponent is independent motor units, as many as strength asks for.
        All amplitudes of noise and harmonic are multiplied by the one number that makes the
        expected coefficient of variation follow. Frequency and cut-off of harmonic and noise, times
        of inputs and spectrum settings stay: they are the nervous system's and the experimenter's.

        **Arguments:** `size` > 0, the ratio of lengths; the two exponents.

        **Raises:** `ValueError` for a size that is not positive, for a muscle that is not made of
        the paper's quadratic laws; `OperatingPointError` (a `ValueError`) where there is no stable
        equilibrium.

        **Source:** times ∝ length: Hill 1950, Sci Prog 38:209-230. Variation falling with strength,
        mainly by the number of motor units: Hamilton, Jones & Wolpert 2004,
        doi:10.1007/s00221-004-1856-7. The exponent 0.25 is an assumption, see docs/scaling.md.
        """
        return load_above("response._scaling").scaled(self, size, time_exponent, strength_exponent)

    def save(
        self, path: str | Path, *, description: str = "", fit: dict[str, Any] | None = None
    ) -> None:
        """Write the task to `path` as a preset: TOML with a description and the task table.

            jm.Isometric(k_w=4e5).save("mine.toml")
            task = jm.load_preset("mine.toml")

        `load_preset` reads it back equal. `fit`, a dictionary that says how the task was fitted, is
        written as a note for the reader.
        """
        load_above("response._presets").save_preset(path, self, description, fit)

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
        return (
            jnp.zeros(size)
            if self.initial is None
            else jnp.stack([jnp.asarray(v) * 1.0 for v in self.initial])
        )

    def noise_scale(self, noise: AbstractNoise | None = None) -> Float[Array, " inputs"]:
        """Amplitudes of the noise, or of `noise`, one of its components: for each entry of u that
        it acts on, in its unit.

        Relative amplitudes are multiplied by K_w0, K_z0, C_w0 and C_z0; that of the drive stays a
        fraction.
        """
        noise = self.noise if noise is None else noise
        amplitude = jnp.asarray(noise.amplitude)
        if not noise.relative or len(noise.acts_on) == 1:
            return amplitude
        base = self.muscle.base()
        return amplitude * (
            base if len(noise.acts_on) == len(base) else jnp.append(base, jnp.ones((), base.dtype))
        )

    def _card(self) -> Card:
        parts = isinstance(self.noise, AbstractNoise) and isinstance(self.muscle, AbstractMuscle)
        if not parts or isinstance(self.noise.amplitude, tuple):
            return Card(eqx.tree_pformat(self))  # a tree that JAX or Equinox took apart
        free, noises = (
            usually_free(self),
            " + ".join(type(part).__name__ for part in self.noise.components),
        )
        facts = [f"noise     {noises}", f"spectrum  {self.settings.name or 'settings of its own'}"]
        facts += (
            [] if isinstance(self.muscle, Muscle) else [f"muscle    {type(self.muscle).__name__}"]
        )
        facts += [f"{name:<8}  {type(value).__name__}" for name, value in self._inputs().items()]
        rows = tuple(
            _shown_row(self, name, path, name in free) for name, path in paths_of(self).items()
        )
        heading = f"{type(self).__name__}, which gives {self.output_name} [{self.output_unit}]"
        text = "\n".join([heading, *(f"  {fact}" for fact in facts), *in_columns(COLUMNS, rows)])
        return Card(text, heading, COLUMNS, rows, tuple(" ".join(fact.split()) for fact in facts))

    def _inputs(self) -> dict[str, Any]:
        fields = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: value for name, value in fields.items() if isinstance(value, AbstractSignal)}

    def harmonic_base(self) -> Perturbation:
        """What the harmonic is a fraction of: (K_w0, K_z0, 0, 0, 0)."""
        base = self.muscle.base()
        stiffness = np.array([1.0, 1.0, 0.0, 0.0, 0.0], dtype=jnp.result_type(float))
        return jnp.append(base, jnp.zeros((), base.dtype)) * stiffness


COLUMNS = ("name", "value", "unit", "fit", "what it is")


def _shown_row(task: AbstractTask, name: str, path: tuple, free: bool) -> tuple[str, ...]:
    row = PARAMETERS.get(name)
    unit, meaning = ("", "") if row is None else ("" if row.unit == "1" else row.unit, row.meaning)
    return (
        name,
        in_numbers(value_of(task, path)),
        unit,
        "free" if free else "fixed",
        meaning.partition(";")[0],
    )


def in_numbers(value: Any) -> str:
    """A number, the range of several, or of what is traced its kind."""
    if not (_is_scalar(value) and is_concrete(value)):
        return eqx.tree_pformat(value)
    numbers = np.asarray(value)
    if numbers.ndim == 0 or not numbers.size:
        return f"{float(numbers):.5g}" if numbers.size else "none"
    low, high = numbers.min(), numbers.max()
    return f"{numbers.size} of {low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"


def fill(task: AbstractTask, given: Mapping[str, Any]) -> None:
    """Set the fields of a task that is being made, by their names: a part that is None or not given
    to its default, a noise also by its own name. What is no field is a parameter: it is set then.
    """
    parameters = dict(given)
    for field in dataclasses.fields(task):
        value = parameters.pop(field.name, None)
        if field.name not in given or (value is None and field.name in PARTS):
            made = field.default_factory
            value = field.default if made is dataclasses.MISSING else made()
        if field.name == "noise" and isinstance(value, str):
            value = named_noise(value, task.smoothness_needed)
        if field.name in PARTS and value is not None:
            value = proper_part(field.name, value)
        converter = field.metadata.get("converter")
        object.__setattr__(task, field.name, value if converter is None else converter(value))
    if parameters:
        made = assigned(task, parameters)
        for field in dataclasses.fields(task):
            # its numbers are others than those that it was made with
            part = getattr(made, field.name)
            object.__setattr__(
                task, field.name, checked(part) if isinstance(part, eqx.Module) else part
            )


def require_task(task: Any, example: str) -> None:
    """Raise a `ValueError` for what is no task, where one is needed."""
    require(
        isinstance(task, AbstractTask),
        f"task: this is of type {type(task).__name__}; give a task first, as jaxmuscle.Isometric():"
        f" {example}",
    )
    if is_batched(task):
        raise ValueError(
            "task: these are several tasks in one, as jax.vmap makes them: each number has an axis"
            " in front. Give one task: inside jax.vmap it is one. For simulations of several, give"
            " jaxmuscle.ensemble a jaxmuscle.ensembles.Sweep"
        )


def is_batched(task: AbstractTask) -> bool:
    """Whether a task's numbers have an axis in front, as `jax.vmap` returns them."""
    return any(np.ndim(noise.amplitude) > 1 for noise in task.noise.components)


# What a class of tasks says of itself.
SAID = ("state_names", "state_units", "output_name", "output_unit", "smoothness_needed")


def check_task(task: AbstractTask) -> None:
    if task.initial is not None and len(task.initial) != len(task.state_names):
        raise ValueError(
            f"initial has {len(task.initial)} entries, {type(task).__name__} needs"
            f" {task.state_names}"
        )
    for field in dataclasses.fields(task):
        value = getattr(task, field.name)
        level = getattr(value, "level", value)  # of an input that is a signal
        if _is_scalar(level) and is_concrete(level):
            require(np.isfinite(level), f"{field.name} = {level}: give a finite number")
    check_muscle(task.muscle)
    for noise in task.noise.components:
        check_noise(noise)
    _check_noise(task)


def _check_noise(task: AbstractTask) -> None:
    """Refuse noise rougher than the task can sample or differentiate, where its amplitude is not
    zero."""
    what = {
        1: f"appears directly in the output {task.output_name}, where white noise has no value",
        2: "must be differentiable in time",
    }
    needed = (*task.smoothness_needed, 0)
    for noise in task.noise.components:
        if not is_concrete(noise.amplitude):
            continue
        for i, amplitude in zip(noise.acts_on, np.asarray(noise.amplitude), strict=True):
            have = noise.smoothness + 2 * (task.activation is not None and i in ACTIVE)
            if have < needed[i] and amplitude != 0:
                raise ValueError(
                    f"{type(noise).__name__} on {INPUTS[i]} cannot be used in"
                    f" {type(task).__name__}: there it {what[needed[i]]}. Use BandLimitedNoise, or"
                    f" set noise_{INPUTS[i]} = 0"
                )


def check_smooth(task: AbstractTask, name: str, need: int) -> None:
    signal = getattr(task, name)
    if signal.smoothness < need:
        raise ValueError(
            f"{name} is a {type(signal).__name__} with {signal.smoothness} continuous derivatives; "
            f"{type(task).__name__} needs {need}: use SmoothStep, RampHold or Sampled"
        )


def check_smooth_envelope(task: AbstractTask) -> None:
    envelope = task.harmonic.envelope
    if envelope.smoothness < 1:
        raise ValueError(
            f"harmonic envelope {type(envelope).__name__} must have a continuous derivative"
        )
