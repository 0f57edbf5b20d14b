"""Pink noise: a sum of Ornstein-Uhlenbeck states whose density is close to 1/f in a band."""

import functools
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.special
from jaxtyping import Float

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

TOLERANCE = 0.05
POINTS = 2000

States = tuple[Float[np.ndarray, " states"], Float[np.ndarray, " states"]]


def _zolotarev(low: float, high: float, count: int) -> States:
    """Corners f_i [Hz] and shares w_i of the variance of the `count` states whose density is
    nearest to 1/f in the band.

    `Σ w_i / (π f_i) / (1 + (f / f_i)²)` is a rational function of f² of degree (count - 1, count);
    Zolotarev's deviates least, relatively, from 1/√f². Its poles and zeros are at f² = -low² sc²(l
    K / 2 count | k), l odd and even, k² = 1 - (low / high)² (hep-lat/0402037, hep-lat/0206007).
    """
    m1 = (low / high) ** 2
    sn, cn, _, _ = scipy.special.ellipj(
        scipy.special.ellipkm1(m1) * np.arange(1, count + 1) / (2 * count), 1 - m1
    )
    half = low / high * (sn / cn) ** 2  # in units of low high, about which they are symmetric
    points = np.concatenate([half, 1 / half[-2::-1]])
    poles, zeros = points[::2], points[1::2]
    residues = [
        np.prod(zeros - pole) / np.prod(np.delete(poles, i) - pole) for i, pole in enumerate(poles)
    ]
    shares = np.array(residues) / np.sqrt(poles)
    return np.sqrt(low * high * poles), shares / shares.sum()


def _density(states: States, f: Scalar) -> Scalar:
    return sum(
        share / (np.pi * corner) / (1 + (f / corner) ** 2)
        for corner, share in zip(*states, strict=True)
    )


def _deviation(states: States, low: float, high: float) -> float:
    f = np.geomspace(low, high, POINTS * len(states[0]) + 1)
    level = np.log(f * _density(states, f))
    return float(np.abs(level - level.mean()).max())


@functools.cache
def _states(low: float, high: float) -> States:
    """As few states as keep f density constant within `TOLERANCE`."""
    count = 1
    while _deviation(_zolotarev(low, high, count), low, high) > TOLERANCE:
        count += 1
    return _zolotarev(low, high, count)


class PinkNoise(AbstractNoise):
    """`N = std Σ √w_i q_i`, `dq_i = -ω_i q_i dt + √(2 ω_i) dW_i`: close to 1/f from f_low to
    f_high, flat below, 1/f² above.

    `density = Σ w_i / (π f_i) / (1 + (f / f_i)²)`, ω_i = 2π f_i, Σ w_i = 1. The corners f_i and
    shares w_i are the best for their number, which is the least that keeps the density within 5 %
    of 1/f in the whole band: four states for the default band, within 3.6 % (`deviation`).
    Continuous, not differentiable.

    **Arguments:**

    - `std` (stationary standard deviation of the whole, see `AbstractNoise`)
    - `f_low`, `f_high` [Hz]: plain numbers with 0 < 2 f_low <= f_high, which are no parameters of a
      fit
    - `relative`, `shared`: as in `AbstractNoise`

    **Raises:** `ValueError` for an impossible band or amplitude.
    """

    amplitude: Scalar = eqx.field(converter=as_amplitude)
    f_low: float = eqx.field(static=True, converter=float)
    f_high: float = eqx.field(static=True, converter=float)
    relative: bool = eqx.field(static=True)
    shared: bool = eqx.field(static=True)
    smoothness: ClassVar[int] = 1

    def __init__(
        self,
        std: Amplitude = None,
        f_low: float = 0.05,
        f_high: float = 50.0,
        *,
        relative: bool = True,
        shared: bool = False,
    ):
        self.amplitude, self.f_low, self.f_high = std, f_low, f_high
        self.relative, self.shared = relative, shared

    def __check_init__(self):
        check_amplitude(self)
        band = f"f_low = {self.f_low} Hz, f_high = {self.f_high} Hz"
        require(
            0 < 2 * self.f_low <= self.f_high < np.inf,
            f"pink noise with {band}: needs 0 < 2 f_low <= f_high",
        )

    @property
    def corners(self) -> Float[np.ndarray, " states"]:
        """Corner frequencies f_i [Hz] of the states, rising."""
        return _states(self.f_low, self.f_high)[0]

    @property
    def shares(self) -> Float[np.ndarray, " states"]:
        """Shares w_i of the states in the variance."""
        return _states(self.f_low, self.f_high)[1]

    def deviation(self) -> float:
        """Largest deviation of ln(f density) from its mean over ln f, from f_low to f_high."""
        return _deviation((self.corners, self.shares), self.f_low, self.f_high)

    def density(self, f: Scalar) -> Scalar:
        return _density((self.corners, self.shares), f)

    def recursion(self, dt: Scalar) -> Recursion:
        count, weights = self.corners.size, np.sqrt(self.shares)
        x = [2 * np.pi * corner * dt for corner in self.corners]
        A = tuple(
            tuple(jnp.exp(-x[i]) if i == j else None for j in range(count)) for i in range(count)
        )
        L = tuple(
            tuple(jnp.sqrt(-jnp.expm1(-2 * x[i])) if i == j else None for j in range(count))
            for i in range(count)
        )
        return Recursion(A, L, tuple(float(weight) for weight in weights))

    def shaping_filter(self) -> ShapingFilter:
        dtype = jnp.result_type(float)
        rates, weights = (
            jnp.asarray(2 * np.pi * self.corners, dtype),
            jnp.asarray(np.sqrt(self.shares), dtype),
        )
        return ShapingFilter(
            -jnp.diag(rates), jnp.diag(jnp.sqrt(2 * rates)), weights, jnp.zeros_like(rates)
        )

    def check_step(self, dt: float) -> None:
        require(
            self.f_high * dt <= 0.25,
            f"dt = {dt} s is too coarse for pink noise up to f_high = {self.f_high} Hz: use dt <="
            f" 0.25 / f_high = {0.25 / self.f_high} s",
        )
