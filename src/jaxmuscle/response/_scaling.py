"""The same muscle at another level of contraction, or of another size: scaling laws, derived in
docs/scaling.md."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmuscle._common.arrays import all_concrete, as_doubles, as_numbers, is_concrete, require
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._muscle import Muscle, QuadraticDamping, QuadraticStiffness
from jaxmuscle.model._parameters import amplitude_names, names_of
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._settings import WINDOW

from ._expected import Moments
from ._expected_moments import expected_moments
from ._linearised import check_equilibrium, check_inputs, linearise
from ._second_order import warn_beyond

FORCES = ("P_w", "F_ext")
NO_FORCE = 1e-15  # N, below which a mean force is rounding
SIZES_OF_A_SIGNAL = ("level", "initial", "final")


def relative_variation(
    mvc_fraction: Scalar, *, steadiest: Scalar = 0.3, contrast: Scalar = 1.0
) -> Scalar:
    """Coefficient of variation of force at a level L (`mvc_fraction`) over that at the steadiest
    level `L*` (`steadiest`).

        jm.response.relative_variation(0.95)

        g(L) = (L*/L · exp(L/L* - 1))^contrast

    With `contrast = 1` the standard deviation grows as `exp(L/L*)`; the smallest coefficient of
    variation is at `L*`, whatever the contrast. The largest of 5 to 95 % MVC is at 95 % for `L* <
    0.305`.

    **Source:** standard deviation exponential in force: Slifkin & Newell 1999,
    doi:10.1037/0096-1523.25.3.837; `L* = 0.3`: Taylor, Christou & Enoka 2003,
    doi:10.1152/jn.00056.2003.
    """
    _check_fraction("mvc_fraction", mvc_fraction)
    _check_fraction("steadiest", steadiest)
    require(
        contrast >= 0,
        f"contrast = {contrast} must not be negative: 0 is the same variation at every level",
    )
    ratio = _number(mvc_fraction) / _number(steadiest)
    exp: Any = math.exp if isinstance(ratio, float) else jnp.exp
    return (exp(ratio - 1) / ratio) ** _number(contrast)


def at_level(
    task: AbstractTask,
    mvc_fraction: Scalar,
    *,
    reference: Scalar,
    steadiest: Scalar,
    contrast: Scalar,
    resting: Scalar,
    damping: Scalar,
) -> AbstractTask:
    """See `AbstractTask.at_level`."""
    _check_fraction("mvc_fraction", mvc_fraction)
    _check_fraction("reference", reference)
    require(
        (resting >= 0) & (resting < 1),
        f"resting = {resting} must be in [0, 1): a share of the stiffness at 100 % MVC",
    )
    _check_some_force(task)
    level, before, resting, damping = (
        _number(v) for v in (mvc_fraction, reference, resting, damping)
    )
    stiffer = (resting + (1 - resting) * level) / (resting + (1 - resting) * before)
    more, less = (
        relative_variation(at, steadiest=steadiest, contrast=contrast) for at in (level, before)
    )
    moved = _multiplied(task, force=level / before, stiffness=stiffer, damping=stiffer**damping)
    return _with_variation(moved, task, more / less)


def at_force(task: AbstractTask, mean: Scalar) -> AbstractTask:
    """See `AbstractTask.at_force`."""
    if task.output_unit != "N":
        raise ValueError(
            f"the output of {type(task).__name__} is {task.output_name} in {task.output_unit}, not"
            " a force"
        )
    here = _mean(task)
    require(
        abs(here) > NO_FORCE,
        "the mean force of this task is zero, and stays so: give it a P_w or F_ext",
    )
    factor = _number(mean) / here
    require(
        factor > 0,
        f"the mean force of this task is {here} N: give a mean of the same sign, not {mean} N",
    )
    return times_force(task, factor)


def times_force(task: AbstractTask, factor: Scalar) -> AbstractTask:
    """Forces, masses, stiffness and damping (and noise in absolute units) multiplied by one
    number."""
    moved = _multiplied(task, force=factor, mass=factor, stiffness=factor, damping=factor)
    absolute = [
        n for part in moved.noise.components if not part.relative for n in names_of(moved, part)
    ]
    return moved.replace(**{name: task[name] * factor for name in absolute})


def scaled(
    task: AbstractTask, size: Scalar, time_exponent: Scalar, strength_exponent: Scalar
) -> AbstractTask:
    """See `AbstractTask.scaled`."""
    require(
        size > 0, f"size = {size} must be positive: the ratio of lengths, 1 for the same muscle"
    )
    s, slower = _number(size), _number(size) ** _number(time_exponent)
    parts: dict[str, Any] = {}
    if hasattr(task, "x_z"):
        parts["x_z"] = _times(getattr(task, "x_z"), s)  # noqa: B009
    if task.initial is not None:
        units = {"m": s, "m/s": s / slower}
        parts["initial"] = tuple(
            v * units[unit] for v, unit in zip(task.initial, task.state_units, strict=True)
        )
    tissue = {"stiffness": s, "damping": s * slower, "length": s, "velocity": s / slower}
    moved = _multiplied(task.with_parts(**parts), force=s**2, mass=s**3, **tissue)
    return _with_variation(moved, task, s ** (-2 * _number(strength_exponent)))


def _number(value: Any) -> Any:
    """A Python number, which loses no digits in either precision, unless a transformation is
    tracing the value."""
    return float(value) if is_concrete(value) else value


def _check_fraction(name: str, value: Scalar) -> None:
    require(
        (value > 0) & (value <= 1),
        f"{name} = {value} must be a fraction of the maximum voluntary contraction in "
        "(0, 1]: 30 % is 0.3",
    )


def _check_some_force(task: AbstractTask) -> None:
    """Refuse a task in which nothing says how strongly the muscle contracts."""
    named = [name for name in FORCES if hasattr(task, name)]
    sizes = [
        getattr(s, field)
        for s in (getattr(task, n) for n in named)
        for field in SIZES_OF_A_SIGNAL
        if hasattr(s, field)
    ]
    if sizes and all(is_concrete(v) and np.all(np.asarray(v) == 0) for v in sizes):
        raise ValueError(
            f"{' and '.join(named)} of this {type(task).__name__} = 0: without a force there is no"
            f" level of contraction; give {named[0]}"
        )


def _times(value: Any, factor: Scalar) -> Any:
    """An input, a number or a signal, multiplied; its times stay."""
    if not isinstance(value, eqx.Module):
        return value * factor
    sizes = [f.name for f in dataclasses.fields(value) if f.name in SIZES_OF_A_SIGNAL]
    if "level" not in sizes:
        raise ValueError(
            f"an input of class {type(value).__name__} has no level to multiply: give the class a"
            " field level"
        )
    return dataclasses.replace(value, **{name: getattr(value, name) * factor for name in sizes})


def is_scalable(muscle: Any) -> bool:
    """Whether the muscle is made of the paper's quadratic laws, so that it is known what to
    multiply."""
    laws = [
        type(getattr(muscle, f"{kind}_{j}", None))
        for kind in ("stiffness", "damping")
        for j in "wz"
    ]
    return isinstance(muscle, Muscle) and laws == [QuadraticStiffness] * 2 + [QuadraticDamping] * 2


def _multiplied(
    task: AbstractTask,
    *,
    force: Scalar,
    stiffness: Scalar,
    damping: Scalar,
    mass: Scalar = 1.0,
    length: Scalar = 1.0,
    velocity: Scalar = 1.0,
) -> AbstractTask:
    """P_w and F_ext, and of both tissues K_j0, C_j0, m_j, x_ref and v_ref multiplied by the
    factors."""
    if not is_scalable(task.muscle):
        raise ValueError(
            f"the muscle, a {type(task.muscle).__name__}, is not made of the paper's quadratic"
            " laws: change its own parameters with replace(...)"
        )
    inputs = {name: _times(getattr(task, name), force) for name in FORCES if hasattr(task, name)}
    factors = {
        "m": mass,
        "k": stiffness / length**2,
        "x_ref": length,
        "c": damping / velocity**2,
        "v_ref": velocity,
    }
    names = [(f"{name}_{j}", factor) for name, factor in factors.items() for j in "wz"]
    values = {name: task[name] * factor for name, factor in names}
    return task.with_parts(**inputs).replace(**values)


def _with_variation(task: AbstractTask, before: AbstractTask, factor: Scalar) -> AbstractTask:
    """The task with all amplitudes multiplied so that its coefficient of variation is `factor`
    times that of `before`."""
    if task.quantity == "acceleration":
        raise ValueError(
            "an acceleration has no coefficient of variation, which sets the noise here: move the"
            " task with observe='displacement', then change it by"
            " with_parts(observe='acceleration')"
        )
    now, then = _moments(task).variation, _moments(before).variation
    moving = then > 0
    if is_concrete(moving):
        louder = factor * then / now if moving else 1.0
    else:
        louder = jnp.where(moving, factor * then / jnp.where(moving, now, 1.0), 1.0)
    return task.replace(**{name: task[name] * louder for name in amplitude_names(task)})


def _mean(task: AbstractTask) -> Scalar:
    """Expected mean of the output."""
    if not all_concrete(task):
        return linearise(task).rest
    with jax.enable_x64(True):
        return as_numbers(linearise(as_doubles(task)).rest)


def _moments(task: AbstractTask) -> Moments:
    """Expected moments of the output; its variation is to first order proportional to the
    amplitudes."""
    if not all_concrete(task):
        return expected_moments(task, task.settings, WINDOW)[0]
    with jax.enable_x64(True):
        moments, system = expected_moments(as_doubles(task), task.settings, WINDOW)
        check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))
        check_inputs(task)
        warn_beyond(task, moments=moments)
        return jax.tree.map(as_numbers, moments)
