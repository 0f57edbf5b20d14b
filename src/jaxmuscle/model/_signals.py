"""Functions of time: inputs (constant, smooth step, ramp and hold, decay, sampled) and the
harmonic."""

import abc
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import Inexact, require
from jaxmuscle._common.cards import Spelled
from jaxmuscle._common.types import Scalar

from ._parameters import default


class AbstractSignal(Spelled, Inexact):
    """A scalar function of time [s] with a `level` (its held value, the parameter a fit can move).

    `smoothness` counts its continuous derivatives.
    """

    level: eqx.AbstractVar[Scalar]
    smoothness: ClassVar[int]

    @abc.abstractmethod
    def __call__(self, t: Scalar) -> Scalar:
        """Value at time t [s]."""


class Constant(AbstractSignal):
    """`s(t) = level`."""

    level: Scalar = 0.0
    smoothness: ClassVar[int] = 99

    def __call__(self, t: Scalar) -> Scalar:
        return self.level + 0.0 * t


class Harmonic(Spelled, Inexact):
    """`S(t) = amplitude envelope(t) sin(2π frequency t + phase)`, a fraction of the base stiffness
    K_j0 of both tissues.

    **Arguments:** `amplitude` >= 0 (fraction of K_j0), `frequency` [Hz] > 0, `phase` [rad],
    `envelope` (a signal with at least one continuous derivative; constant 1 by default).

    **Raises:** `ValueError` for a negative amplitude or a frequency that is not positive.

    **Source:** the paper, S(t) in equation (2). In its simulation of [12] the amplitude of the
    harmonic changes in time: that is what the envelope is for.
    """

    amplitude: Scalar = default("harmonic_amplitude")
    frequency: Scalar = default("harmonic_frequency")
    phase: Scalar = default("harmonic_phase")
    envelope: AbstractSignal = eqx.field(default_factory=lambda: Constant(1.0))

    def __check_init__(self):
        require(
            self.amplitude >= 0,
            f"harmonic_amplitude = {self.amplitude} must not be negative: shift the phase",
        )
        require(self.frequency > 0, f"harmonic_frequency = {self.frequency} Hz must be positive")

    def __call__(self, t: Scalar) -> Scalar:
        """Relative change of stiffness at time t [s]."""
        return (
            self.amplitude
            * self.envelope(t)
            * jnp.sin(2 * jnp.pi * self.frequency * t + self.phase)
        )


class SmoothStep(AbstractSignal):
    """A Heaviside step with a finite rise: `initial` before `start`, `level` after `start + rise`.

    Between them `initial + (level - initial) (35 p⁴ - 84 p⁵ + 70 p⁶ - 20 p⁷)`, p = (t - start) /
    rise: three continuous derivatives, which `PrescribedMotion` needs (its P_w contains x_z''').

    **Arguments:** `level`, `start` [s], `rise` [s] > 0, `initial`. **Raises:** `ValueError` if rise
    <= 0.
    """

    level: Scalar = 1.0
    start: Scalar = 0.5
    rise: Scalar = 1.0
    initial: Scalar = 0.0
    smoothness: ClassVar[int] = 3

    def __check_init__(self):
        require(
            self.rise > 0,
            f"rise = {self.rise} s: a step without rise time has no derivatives; give rise > 0,"
            " 0.05 say",
        )

    def __call__(self, t: Scalar) -> Scalar:
        p = jnp.clip((t - self.start) / self.rise, 0.0, 1.0)
        return self.initial + (self.level - self.initial) * p**4 * (
            35.0 - p * (84.0 - p * (70.0 - 20.0 * p))
        )


class RampHold(AbstractSignal):
    """A linear ramp from `initial` at `start` to `level` at `start + ramp`, then held; its corners
    are rounded.

    The slope rises and falls over `corner` seconds by the smooth step above, so that three
    derivatives are continuous.

    **Arguments:** `level`, `start`, `ramp` [s], `corner` [s], 0 < corner <= ramp / 2, `initial`.
    """

    level: Scalar = 1.0
    start: Scalar = 0.5
    ramp: Scalar = 2.0
    corner: Scalar = 0.2
    initial: Scalar = 0.0
    smoothness: ClassVar[int] = 3

    def __check_init__(self):
        require(
            self.corner > 0,
            f"corner = {self.corner} s must be positive: a sharp corner has no second derivative",
        )
        require(
            2 * self.corner <= self.ramp,
            f"corner = {self.corner} s must be at most half the ramp {self.ramp} s",
        )

    def __call__(self, t: Scalar) -> Scalar:
        def rounded(s):
            # Integral of the smooth step of degree 5, which has the two derivatives that the slope
            # needs. One comparison decides between the pieces: two that round differently would
            # lose the slope at the joint.
            p = jnp.maximum(s / self.corner, 0.0)
            return jnp.where(
                p < 1.0, self.corner * p**4 * (2.5 - p * (3.0 - p)), s - 0.5 * self.corner
            )

        begin, end = t - self.start, t - self.start - (self.ramp - self.corner)
        return self.initial + (self.level - self.initial) * (rounded(begin) - rounded(end)) / (
            self.ramp - self.corner
        )


class Decay(AbstractSignal):
    """`level` until `start`, then an exponential approach to `final` with a flat beginning (one
    continuous derivative).

    `s = final + (level - final) (2 e^-p - e^-2p)`, p = (t - start) / time_constant >= 0.

    **Arguments:** `level`, `final`, `start` [s], `time_constant` [s] > 0.
    """

    level: Scalar = 1.0
    final: Scalar = 0.0
    start: Scalar = 5.0
    time_constant: Scalar = 3.0
    smoothness: ClassVar[int] = 1

    def __check_init__(self):
        require(self.time_constant > 0, f"time_constant = {self.time_constant} s must be positive")

    def __call__(self, t: Scalar) -> Scalar:
        fading = jnp.exp(-jnp.maximum(t - self.start, 0.0) / self.time_constant)
        return self.final + (self.level - self.final) * fading * (2.0 - fading)


class Sampled(AbstractSignal):
    """`level` times the quintic spline through samples (four continuous derivatives), held beyond
    its ends.

    Build it with `Sampled.through(times, values)`, which makes `breaks` [s] and `coefficients`
    (pieces, 6) of its pieces.
    """

    breaks: Float[np.ndarray | Array, " pieces_plus_one"]
    coefficients: Float[np.ndarray | Array, "pieces 6"]
    level: Scalar = 1.0
    smoothness: ClassVar[int] = 4

    def __check_init__(self):
        pieces = len(self.breaks) - 1
        require(
            pieces >= 1 and np.shape(self.coefficients) == (pieces, 6),
            f"breaks {np.shape(self.breaks)} and coefficients {np.shape(self.coefficients)} do not"
            " belong together: a spline of n pieces has n + 1 breaks and n rows of 6 coefficients",
        )
        rising = self.breaks[1:] > self.breaks[:-1]
        require(rising, "breaks must increase")

    @classmethod
    def through(
        cls,
        times: Float[Array | np.ndarray, " samples"],
        values: Float[Array | np.ndarray, " samples"],
    ) -> "Sampled":
        """Spline through `values` at `times` [s], at least six, increasing. Raises `ValueError`
        otherwise."""
        times, values = np.asarray(times, dtype=float), np.asarray(values, dtype=float)
        if times.ndim != 1 or times.shape != values.shape or len(times) < 6:
            raise ValueError(
                f"times {times.shape} and values {values.shape} must be two equally long lists, 6"
                " samples at least"
            )
        if not (
            np.all(np.isfinite(times))
            and np.all(np.isfinite(values))
            and np.all(np.diff(times) > 0)
        ):
            raise ValueError("times must increase and both times and values be finite")
        pieces = scipy.interpolate.PPoly.from_spline(
            scipy.interpolate.make_interp_spline(times, values, k=5)
        )
        keep = np.diff(pieces.x) > 0
        breaks = np.append(pieces.x[:-1][keep], pieces.x[-1])
        return cls(breaks=breaks, coefficients=pieces.c[:, keep].T.copy())

    def __call__(self, t: Scalar) -> Scalar:
        breaks, coefficients = jnp.asarray(self.breaks), jnp.asarray(self.coefficients)
        t = jnp.clip(t, breaks[0], breaks[-1])
        piece = jnp.clip(
            jnp.searchsorted(breaks, jax.lax.stop_gradient(t), side="right") - 1, 0, len(breaks) - 2
        )
        return self.level * jnp.polyval(coefficients[piece], t - breaks[piece])


class Tabulated(AbstractSignal):
    """A function of time and its first two derivatives at multiples of `interval` [s], looked up:
    for use in a loop."""

    rows: Float[Array, "3 points"]
    interval: float = eqx.field(static=True)
    level: Scalar = 1.0
    smoothness: ClassVar[int] = 2

    @classmethod
    def of(cls, signal: Callable[[Scalar], Scalar], interval: float, points: int) -> "Tabulated":
        """A signal or harmonic from t = 0 on."""
        rows = jax.vmap(lambda t: jnp.stack(derivatives(signal, t, 2)))(
            jnp.arange(float(points)) * interval
        )
        return cls(rows=rows.T, interval=interval)

    def __call__(self, t: Scalar) -> Scalar:
        return _row(0, self.interval, self.rows, t)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _row(order: int, interval: float, rows: Array, t: Scalar) -> Scalar:
    return rows[order, jnp.clip(jnp.round(t / interval).astype(int), 0, rows.shape[1] - 1)]


@_row.defjvp
def _row_jvp(order, interval, primals, tangents):
    (rows, t), (rows_dot, t_dot) = primals, tangents
    slope = _row(order, interval, rows_dot, t) + _row(order + 1, interval, rows, t) * t_dot
    return _row(order, interval, rows, t), slope


def as_signal(value: "AbstractSignal | Scalar") -> AbstractSignal:
    """A signal as it is; a number as a smooth step to that level."""
    return value if isinstance(value, AbstractSignal) else SmoothStep(as_level(value))


def as_held(value: "AbstractSignal | Scalar") -> AbstractSignal:
    """A signal as it is; a number as that level from the start."""
    return value if isinstance(value, AbstractSignal) else Constant(as_level(value))


def as_level(value: Any) -> Any:
    """One number, as it is. Raises `ValueError` for what is none."""
    if isinstance(value, AbstractSignal):
        raise ValueError(
            f"x_z = {value}: Isometric holds the insertion, so this is a number; PrescribedLength"
            " moves it"
        )
    if isinstance(value, bool | str | bytes | list | tuple | dict | None):
        raise ValueError(
            f"an input is {value!r}: give a number or a signal, as jaxmuscle.model.SmoothStep(5.0)"
        )
    if callable(value):
        raise ValueError(
            "an input is a function: give a number or a signal. Of its values at some times"
            " jaxmuscle.model.Sampled.through(times, values) makes a signal"
        )
    if np.ndim(value) > 0:
        raise ValueError(
            f"an input is an array of shape {np.shape(value)}: give a number or a signal. Of values"
            " at some times jaxmuscle.model.Sampled.through(times, values) makes a signal"
        )
    return value


def derivatives(signal: Callable[[Scalar], Scalar], t: Scalar, order: int) -> tuple[Scalar, ...]:
    """The signal and its time derivatives up to `order`."""
    t = jnp.asarray(t)

    def up_to(n):
        if n == 0:
            return lambda s: (signal(s),)
        lower = up_to(n - 1)

        def stacked(s):
            values, slopes = jax.jvp(lower, (s,), (jnp.ones_like(s),))
            return (*values, slopes[-1])

        return stacked

    return up_to(order)(t)
