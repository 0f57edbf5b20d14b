"""Resonant noise: a tremor, exact on the grid."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import require
from jaxmuscle._common.matrices import exponential
from jaxmuscle._common.quadrature import NODES, WEIGHTS
from jaxmuscle._common.types import Scalar

from ._noise import (
    AbstractNoise,
    Amplitude,
    Recursion,
    ShapingFilter,
    as_amplitude,
    check_amplitude,
)
from ._parameters import PARAMETERS


def exact_step(
    made: ShapingFilter, dt: Scalar
) -> tuple[Float[Array, "states states"], Float[Array, "states states"]]:
    """Transition Φ = exp(F dt) of a filter over a step, and L with `L Lᵀ = ∫ exp(F s) G Gᵀ exp(Fᵀ
    s) ds` over it.

    By Gauss-Legendre quadrature, a sum of squares: of `P - Φ P Φᵀ` short steps leave no digits in
    single precision.
    """
    size = len(made.F)
    steps = exponential(
        made.F * dt * jnp.append(jnp.asarray(NODES, made.F.dtype), 1.0)[:, None, None]
    )
    kicks = jnp.moveaxis(
        steps[:-1] @ made.G * jnp.sqrt(dt * jnp.asarray(WEIGHTS, made.F.dtype))[:, None, None], 0, 1
    )
    kicks = kicks.reshape(size, -1)
    # Rows of unit length, so that rounding is relative to each.
    scale = jnp.sqrt(jnp.sum(kicks**2, axis=1))
    unit = kicks / scale[:, None]
    return steps[-1], scale[:, None] * jnp.linalg.cholesky(unit @ unit.T)


class ResonantNoise(AbstractNoise):
    """A tremor: white noise through a resonance, `S(f) = std² (b/π) f² / ((f0² - f²)² + b² f²)`, ∫
    S df = std².

    Two-sided density, f0 the `frequency` and b the `width`: the full width at half power. Without
    power at 0. In the time domain `N' = -2πb N - 2πf0 q + std √(4πb) w`, `q' = 2πf0 N`; N and q
    have the variance std². As b → 0 it becomes a line whose phase and amplitude are random
    (Rayleigh). Continuous, not differentiable.

    **Arguments:**

    - `std`: the standard deviation. One number is that of the drive, a fraction of P_w; four or
      five, or a mapping, as in `AbstractNoise`
    - `frequency` [Hz] > 0, `width` [Hz] > 0
    - `relative`, `shared`: as in `AbstractNoise`
    """

    amplitude: Scalar = eqx.field(converter=as_amplitude)
    frequency: Scalar
    width: Scalar
    relative: bool = eqx.field(static=True)
    shared: bool = eqx.field(static=True)
    smoothness: ClassVar[int] = 1
    sort: ClassVar[str] = "resonance"
    _channels_of_one_number: ClassVar[int] = 1

    def __init__(
        self,
        std: Amplitude = PARAMETERS["resonance_amplitude"].default,
        frequency: Scalar = PARAMETERS["resonance_frequency"].default,
        width: Scalar = PARAMETERS["resonance_width"].default,
        *,
        relative: bool = True,
        shared: bool = False,
    ):
        self.amplitude, self.frequency, self.width = std, frequency, width
        self.relative, self.shared = relative, shared

    def __check_init__(self):
        check_amplitude(self)
        require(self.frequency > 0, f"resonance_frequency = {self.frequency} Hz must be positive")
        require(self.width > 0, f"resonance_width = {self.width} Hz must be positive")

    def density(self, f: Scalar) -> Scalar:
        b2 = self.width**2 * f**2
        return self.width / jnp.pi * f**2 / ((self.frequency**2 - f**2) ** 2 + b2)

    def recursion(self, dt: Scalar) -> Recursion:
        step, kick = exact_step(self.shaping_filter(), dt)
        A = tuple((row[0], row[1]) for row in step)
        return Recursion(A, ((kick[0, 0], None), (kick[1, 0], kick[1, 1])), (None, 1.0))

    def shaping_filter(self) -> ShapingFilter:
        omega, rate = 2 * jnp.pi * jnp.asarray(self.frequency), 2 * jnp.pi * jnp.asarray(self.width)
        none = jnp.zeros_like(omega + rate)
        F = jnp.stack([jnp.stack([none, omega]), jnp.stack([-omega, -rate])])
        return ShapingFilter(
            F, jnp.stack([none, jnp.sqrt(2 * rate)])[:, None], jnp.array([0.0, 1.0]), jnp.zeros(1)
        )

    def check_step(self, dt: float) -> None:
        require(
            (self.frequency + self.width) * dt <= 0.1,
            f"dt = {dt} s is too coarse for a resonance at {self.frequency} Hz, {self.width} Hz"
            " wide: use dt <= 0.1 / (resonance_frequency + resonance_width) ="
            f" {0.1 / (self.frequency + self.width)} s",
        )


def narrow_resonances(noise: AbstractNoise, resolution: float) -> tuple[ResonantNoise, ...]:
    """The resonances of a noise, or of a sum, that are narrower than a bin [Hz]: in a spectrum they
    look like lines."""
    return tuple(
        each
        for each in noise.components
        if isinstance(each, ResonantNoise) and float(each.width) < resolution
    )
