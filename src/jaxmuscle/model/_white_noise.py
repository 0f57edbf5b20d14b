"""White noise, and white noise through a low-pass: band-limited and Ornstein-Uhlenbeck noise, exact
on the grid."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxmuscle._common.arrays import require
from jaxmuscle._common.types import Scalar

from ._noise import (
    AbstractNoise,
    Amplitude,
    Recursion,
    ShapingFilter,
    as_amplitude,
    check_amplitude,
)
from ._parameters import PARAMETERS, default


class WhiteNoise(AbstractNoise):
    """White noise whose samples at `rate` have standard deviation `amplitude`: two-sided density
    `amplitude² / rate`.

    The convention of a Simulink band-limited white noise block with that sample rate. In the
    stochastic differential equation its diffusion is `amplitude / √rate`, in the Stratonovich sense
    (the limit of band-limited noise).

    **Arguments:** `amplitude` (see `AbstractNoise`), `rate` [Hz] > 0, `relative`, `shared`.
    """

    amplitude: Scalar = eqx.field(converter=as_amplitude, default=None)
    rate: Scalar = 100.0
    relative: bool = eqx.field(static=True, default=True)
    shared: bool = eqx.field(static=True, default=False)
    smoothness: ClassVar[int] = 0

    def __check_init__(self):
        check_amplitude(self)
        require(self.rate > 0, f"noise rate = {self.rate} Hz must be positive")

    def density(self, f: Scalar) -> Scalar:
        return jnp.ones_like(f) / self.rate

    def recursion(self, dt: Scalar) -> Recursion:
        return Recursion((), (), (), direct=jnp.sqrt(dt / self.rate))

    def shaping_filter(self) -> ShapingFilter:
        direct = 1 / jnp.sqrt(jnp.asarray(self.rate))
        return ShapingFilter(jnp.zeros((0, 0)), jnp.zeros((0, 1)), jnp.zeros(0), direct[None])

    def check_step(self, dt: float) -> None:
        pass


class BandLimitedNoise(AbstractNoise):
    """White noise through a second-order Butterworth low-pass, `density = 1 / rate / (1 + (f /
    cutoff)⁴)`.

    `N'' + √2 ω N' + ω² N = ω² w`, ω = 2π cutoff, w white of density amplitude² / rate: the same
    in-band density as `WhiteNoise`, with differentiable paths. The two states per channel are
    advanced by their exact transition.

    **Arguments:** `amplitude` (see `AbstractNoise`; the standard deviation that a white noise of
    the same in-band density has when sampled at `rate`), `rate` [Hz], `cutoff` [Hz], `relative`,
    `shared`.
    """

    amplitude: Scalar = eqx.field(converter=as_amplitude, default=None)
    rate: Scalar = 100.0
    cutoff: Scalar = default("noise_cutoff")
    relative: bool = eqx.field(static=True, default=True)
    shared: bool = eqx.field(static=True, default=False)
    smoothness: ClassVar[int] = 2

    def __check_init__(self):
        check_amplitude(self)
        require(self.rate > 0, f"noise rate = {self.rate} Hz must be positive")
        require(self.cutoff > 0, f"noise_cutoff = {self.cutoff} Hz must be positive")

    def density(self, f: Scalar) -> Scalar:
        return 1 / self.rate / (1 + (f / self.cutoff) ** 4)

    def recursion(self, dt: Scalar) -> Recursion:
        omega = 2 * jnp.pi * self.cutoff
        p = omega * dt / np.sqrt(2)
        fade, c, s = jnp.exp(-p), jnp.cos(p), jnp.sin(p)
        # Transition of (N, N'/ω), both scaled to unit stationary variance; its process noise is I -
        # A Aᵀ = L Lᵀ.
        a11, a12, a21, a22 = (
            fade * (c + s),
            fade * np.sqrt(2) * s,
            -fade * np.sqrt(2) * s,
            fade * (c - s),
        )
        l11 = jnp.sqrt(1 - a11**2 - a12**2)
        l21 = -(a11 * a21 + a12 * a22) / l11
        l22 = jnp.sqrt(1 - a21**2 - a22**2 - l21**2)
        std = jnp.sqrt(omega / (2 * np.sqrt(2) * self.rate))
        return Recursion(
            ((a11, a12), (a21, a22)), ((l11, None), (l21, l22)), (std, None), (None, std * omega)
        )

    def shaping_filter(self) -> ShapingFilter:
        # States (N, N'/ω), so that both have the same scale.
        omega = 2 * jnp.pi * jnp.asarray(self.cutoff)
        F = omega * jnp.array([[0.0, 1.0], [-1.0, -np.sqrt(2)]])
        G = jnp.stack([0 * omega, omega])[:, None] / jnp.sqrt(self.rate)
        return ShapingFilter(F, G, jnp.array([1.0, 0.0]), jnp.zeros(1))

    def check_step(self, dt: float) -> None:
        require(
            self.cutoff * dt <= 0.25,
            f"dt = {dt} s is too coarse for noise_cutoff = {self.cutoff} Hz: use dt <= 0.25 /"
            f" noise_cutoff = {0.25 / self.cutoff} s",
        )


class OrnsteinUhlenbeckNoise(AbstractNoise):
    """`dN = -N/τ dt + std √(2/τ) dW`, `density = 2 τ / (1 + (2π f τ)²)` times std².

    Continuous, not differentiable. **Arguments:** `std` (stationary standard deviation, see
    `AbstractNoise`), `correlation_time` τ [s] > 0, `relative`, `shared`.
    """

    amplitude: Scalar = eqx.field(converter=as_amplitude)
    correlation_time: Scalar
    relative: bool = eqx.field(static=True)
    shared: bool = eqx.field(static=True)
    smoothness: ClassVar[int] = 1

    def __init__(
        self,
        std: Amplitude = None,
        correlation_time: Scalar = PARAMETERS["noise_correlation_time"].default,
        *,
        relative: bool = True,
        shared: bool = False,
    ):
        self.amplitude, self.correlation_time = std, correlation_time
        self.relative, self.shared = relative, shared

    def __check_init__(self):
        check_amplitude(self)
        require(
            self.correlation_time > 0,
            f"noise_correlation_time = {self.correlation_time} s must be positive",
        )

    def density(self, f: Scalar) -> Scalar:
        return 2 * self.correlation_time / (1 + (2 * jnp.pi * f * self.correlation_time) ** 2)

    def recursion(self, dt: Scalar) -> Recursion:
        x = dt / self.correlation_time
        return Recursion(((jnp.exp(-x),),), ((jnp.sqrt(-jnp.expm1(-2 * x)),),), (1.0,))

    def shaping_filter(self) -> ShapingFilter:
        rate = 1 / jnp.asarray(self.correlation_time)
        return ShapingFilter(
            -rate[None, None], jnp.sqrt(2 * rate)[None, None], jnp.ones(1), jnp.zeros(1)
        )

    def check_step(self, dt: float) -> None:
        require(
            dt <= 0.5 * self.correlation_time,
            f"dt = {dt} s is too coarse for noise_correlation_time = {self.correlation_time} s: use"
            " at most half of it",
        )
