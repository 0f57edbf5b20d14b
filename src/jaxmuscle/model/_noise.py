"""Random perturbations: white, band-limited, Ornstein-Uhlenbeck and resonant noise and their sums, exact on the grid."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxmuscle._common.arrays import require
from jaxmuscle._common.types import Scalar

from ._parameters import CHANNELS, INPUTS, PARAMETERS, default

Amplitude = Scalar | tuple | list | dict | None


class Realisation(eqx.Module):
    """One unit-amplitude noise path on a grid of `steps` steps.

    `values` and `slopes` (N and dN/dt) hold at the `steps + 1` grid points, `increments` (of white noise) between them;
    what a noise does not have is None. Of a sum, which has none of them, the path of each of its `parts`.
    """

    values: Float[Array, "*seeds points channels"] | None = None
    slopes: Float[Array, "*seeds points channels"] | None = None
    increments: Float[Array, "*seeds steps channels"] | None = None
    parts: "tuple[Realisation, ...] | None" = None


class ShapingFilter(eqx.Module):
    """A unit noise as filtered independent white noises w of density 1: `q' = F q + G w`, `N = H q + L w`."""

    F: Float[Array, "states states"]
    G: Float[Array, "states inputs"]
    H: Float[Array, " states"]
    L: Float[Array, " inputs"]


class AbstractNoise(eqx.Module):
    """Noise on the coefficients K_w, K_z, C_w, C_z and the drive P_w, an independent channel each (`shared`: one for all).

    `amplitude` is one number for the four coefficients; or four; or five, the last for the drive; or a mapping by name. It
    is a fraction of the base coefficient (`relative`) or in its unit [N/m, N s/m]; that of the drive is a fraction of P_w.
    `smoothness`: 0 white (has no values), 1 continuous, 2 differentiable.

    Noises add: `BandLimitedNoise() + ResonantNoise()`.
    """

    amplitude: eqx.AbstractVar[Scalar]
    relative: eqx.AbstractVar[bool]
    shared: eqx.AbstractVar[bool]
    smoothness: ClassVar[int]

    @abc.abstractmethod
    def density(self, f: Scalar) -> Scalar:
        """Two-sided power density [1/Hz] of the unit-amplitude noise at frequency f [Hz]."""

    @abc.abstractmethod
    def draw(self, key: PRNGKeyArray, steps: int) -> Any:
        """All normals of one seed, in one block."""

    @abc.abstractmethod
    def realise(self, normals: Any, dt: Scalar) -> Realisation:
        """The unit path that the normals stand for, exact in distribution on the grid of step dt [s]."""

    @abc.abstractmethod
    def shaping_filter(self) -> ShapingFilter:
        """The linear filter whose output the unit-amplitude noise is, for the linear response."""

    @abc.abstractmethod
    def check_step(self, dt: float) -> None:
        """Raise a `ValueError` if a grid of step dt [s] is too coarse for this noise."""

    def psd(self, f: Float[Array | np.ndarray, " frequencies"] | Scalar) -> Float[Array, "..."]:
        """Two-sided power density `amplitude² density(f)` [amplitude²/Hz], one row per amplitude if there are four."""
        return jnp.asarray(self.amplitude)[..., None] ** 2 * self.density(jnp.atleast_1d(jnp.asarray(f)))

    def __add__(self, other: "AbstractNoise") -> "NoiseSum":
        if not isinstance(other, AbstractNoise):
            return NotImplemented
        return NoiseSum((*self.components, *other.components))

    def per_channel(self) -> "AbstractNoise":
        """A copy whose amplitude has one entry for each input that it acts on."""
        if np.ndim(self.amplitude) == 1:
            return self
        whole, count = isinstance(self.amplitude, jax.Array), self._channels_of_one_number
        spread = jnp.broadcast_to(self.amplitude, (count,)) if whole else np.full(count, float(self.amplitude))
        return eqx.tree_at(lambda n: n.amplitude, self, spread)

    _channels_of_one_number: ClassVar[int] = len(CHANNELS)

    @property
    def components(self) -> "tuple[AbstractNoise, ...]":
        """The noises of a sum; of a single one itself."""
        return (self,)

    @property
    def acts_on(self) -> tuple[int, ...]:
        """Positions among `INPUTS` (the four coefficients, then the drive) of what it has an amplitude for."""
        return ACTED_ON[np.shape(self.amplitude)[-1] if np.ndim(self.amplitude) else self._channels_of_one_number]

    @property
    def channels(self) -> int:
        """How many independent channels are drawn."""
        return 1 if self.shared else len(self.acts_on)


ACTED_ON = {1: (len(CHANNELS),), len(CHANNELS): tuple(range(len(CHANNELS))), len(INPUTS): tuple(range(len(INPUTS)))}


def as_amplitude(value: Amplitude) -> Scalar:
    """The paper's structure by default; a number for all coefficients, one each in order, or a mapping by name."""
    if value is None:
        return np.array([default(f"noise_{c}") for c in CHANNELS])
    if isinstance(value, dict):
        unknown = set(value) - set(INPUTS)
        if unknown:
            raise ValueError(f"noise amplitude for unknown input {sorted(unknown)}: known: {', '.join(INPUTS)}")
        value = [value.get(c, 0.0) for c in (INPUTS if "P_w" in value else CHANNELS)]
    if isinstance(value, tuple | list):
        if len(value) not in ACTED_ON:
            raise ValueError(f"noise amplitude has {len(value)} entries: give one number, four for {', '.join(CHANNELS)}, "
                             f"or five for these and the drive P_w")  # fmt: skip
        return jnp.stack([jnp.asarray(v) for v in value]) if _any_jax(value) else np.array(value, dtype=float)
    return value


def standard_normals(key: PRNGKeyArray, shape: tuple[int, ...]) -> Float[Array, "..."]:
    """Standard normals of single precision in either precision: seed i is the same path in both, and cheaper to draw."""
    return jax.random.normal(key, shape, jnp.float32).astype(jnp.result_type(float))


def _any_jax(values: tuple | list) -> bool:
    return any(isinstance(v, jax.Array) for v in values)


def check_amplitude(noise: AbstractNoise) -> None:
    if np.ndim(noise.amplitude) and (np.ndim(noise.amplitude) > 1 or np.shape(noise.amplitude)[0] not in ACTED_ON):
        raise ValueError(f"noise amplitude has shape {np.shape(noise.amplitude)}: give one number, four or five")
    require(noise.amplitude >= 0, f"noise amplitude {noise.amplitude} must not be negative")


class WhiteNoise(AbstractNoise):
    """White noise whose samples at `rate` have standard deviation `amplitude`: two-sided density `amplitude² / rate`.

    The convention of a Simulink band-limited white noise block with that sample rate. In the stochastic differential
    equation its diffusion is `amplitude / √rate`, in the Stratonovich sense (the limit of band-limited noise).

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

    def draw(self, key: PRNGKeyArray, steps: int) -> Float[Array, "..."]:
        return standard_normals(key, (steps, self.channels))

    def realise(self, normals: Float[Array, "..."], dt: Scalar) -> Realisation:
        return Realisation(increments=normals * jnp.sqrt(dt / self.rate))

    def shaping_filter(self) -> ShapingFilter:
        direct = 1 / jnp.sqrt(jnp.asarray(self.rate))
        return ShapingFilter(jnp.zeros((0, 0)), jnp.zeros((0, 1)), jnp.zeros(0), direct[None])

    def check_step(self, dt: float) -> None:
        pass


class BandLimitedNoise(AbstractNoise):
    """White noise through a second-order Butterworth low-pass, `density = 1 / rate / (1 + (f / cutoff)⁴)`.

    `N'' + √2 ω N' + ω² N = ω² w`, ω = 2π cutoff, w white of density amplitude² / rate: the same in-band density as
    `WhiteNoise`, with differentiable paths. The two states per channel are advanced by their exact transition.

    **Arguments:** `amplitude` (see `AbstractNoise`; the standard deviation that a white noise of the same in-band density
    has when sampled at `rate`), `rate` [Hz], `cutoff` [Hz], `relative`, `shared`.
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

    def draw(self, key: PRNGKeyArray, steps: int) -> Float[Array, "..."]:
        return standard_normals(key, (steps + 1, 2 * self.channels))

    def realise(self, normals: Float[Array, "..."], dt: Scalar) -> Realisation:
        omega = 2 * jnp.pi * self.cutoff
        p = omega * dt / np.sqrt(2)
        fade, c, s = jnp.exp(-p), jnp.cos(p), jnp.sin(p)
        # Transition of (N, N'/ω), both scaled to unit stationary variance; its process noise is I - F Fᵀ = L Lᵀ.
        f11, f12, f21, f22 = fade * (c + s), fade * np.sqrt(2) * s, -fade * np.sqrt(2) * s, fade * (c - s)
        l11 = jnp.sqrt(1 - f11**2 - f12**2)
        l21 = -(f11 * f21 + f12 * f22) / l11
        l22 = jnp.sqrt(1 - f21**2 - f22**2 - l21**2)

        def advance(state, kick):
            n, slope = state
            first, second = jnp.split(kick, 2)
            new = f11 * n + f12 * slope + l11 * first, f21 * n + f22 * slope + l21 * first + l22 * second
            return new, new

        # Two outputs, so that XLA leaves the slopes out where nobody asks for them.
        start = jnp.split(normals[0], 2)
        _, (n, slope) = jax.lax.scan(advance, (start[0], start[1]), normals[1:])
        std = jnp.sqrt(omega / (2 * np.sqrt(2) * self.rate))
        values, slopes = jnp.concatenate([start[0][None], n]), jnp.concatenate([start[1][None], slope])
        return Realisation(values=std * values, slopes=std * omega * slopes)

    def shaping_filter(self) -> ShapingFilter:
        # States (N, N'/ω), so that both have the same scale.
        omega = 2 * jnp.pi * jnp.asarray(self.cutoff)
        F = omega * jnp.array([[0.0, 1.0], [-1.0, -np.sqrt(2)]])
        G = jnp.stack([0 * omega, omega])[:, None] / jnp.sqrt(self.rate)
        return ShapingFilter(F, G, jnp.array([1.0, 0.0]), jnp.zeros(1))

    def check_step(self, dt: float) -> None:
        require(
            self.cutoff * dt <= 0.25,
            f"dt = {dt} s is too coarse for noise_cutoff = {self.cutoff} Hz: use dt <= 0.25 / noise_cutoff",
        )


class OrnsteinUhlenbeckNoise(AbstractNoise):
    """`dN = -N/τ dt + std √(2/τ) dW`, `density = 2 τ / (1 + (2π f τ)²)` times std².

    Continuous, not differentiable. **Arguments:** `std` (stationary standard deviation, see `AbstractNoise`),
    `correlation_time` τ [s] > 0, `relative`, `shared`.
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
        require(self.correlation_time > 0, f"noise_correlation_time = {self.correlation_time} s must be positive")

    def density(self, f: Scalar) -> Scalar:
        return 2 * self.correlation_time / (1 + (2 * jnp.pi * f * self.correlation_time) ** 2)

    def draw(self, key: PRNGKeyArray, steps: int) -> Float[Array, "..."]:
        return standard_normals(key, (steps + 1, self.channels))

    def realise(self, normals: Float[Array, "..."], dt: Scalar) -> Realisation:
        x = dt / self.correlation_time
        keep, kick = jnp.exp(-x), jnp.sqrt(-jnp.expm1(-2 * x))

        def advance(n, normal):
            n = keep * n + kick * normal
            return n, n

        _, later = jax.lax.scan(advance, normals[0], normals[1:])
        return Realisation(values=jnp.concatenate([normals[:1], later]))

    def shaping_filter(self) -> ShapingFilter:
        rate = 1 / jnp.asarray(self.correlation_time)
        return ShapingFilter(-rate[None, None], jnp.sqrt(2 * rate)[None, None], jnp.ones(1), jnp.zeros(1))

    def check_step(self, dt: float) -> None:
        require(
            dt <= 0.5 * self.correlation_time,
            f"dt = {dt} s is too coarse for noise_correlation_time = {self.correlation_time} s: use at most half of it",
        )


NODES, WEIGHTS = (0.5 * (1 + x) if i == 0 else 0.5 * x for i, x in enumerate(np.polynomial.legendre.leggauss(8)))


def exact_step(made: ShapingFilter, dt: Scalar) -> tuple[Float[Array, "states states"], Float[Array, "states states"]]:
    """Transition Φ = exp(F dt) of a filter over a step, and L with `L Lᵀ = ∫ exp(F s) G Gᵀ exp(Fᵀ s) ds` over it.

    By Gauss-Legendre quadrature, a sum of squares: of `P - Φ P Φᵀ` short steps leave no digits in single precision.
    """
    size = len(made.F)
    steps = jax.vmap(jax.scipy.linalg.expm)(made.F * dt * jnp.append(jnp.asarray(NODES, made.F.dtype), 1.0)[:, None, None])
    kicks = jnp.moveaxis(steps[:-1] @ made.G * jnp.sqrt(dt * jnp.asarray(WEIGHTS, made.F.dtype))[:, None, None], 0, 1)
    kicks = kicks.reshape(size, -1)
    # Rows of unit length, so that rounding is relative to each.
    scale = jnp.sqrt(jnp.sum(kicks**2, axis=1))
    unit = kicks / scale[:, None]
    return steps[-1], scale[:, None] * jnp.linalg.cholesky(unit @ unit.T)


class ResonantNoise(AbstractNoise):
    """A tremor: white noise through a resonance, `S(f) = std² (b/π) f² / ((f0² - f²)² + b² f²)`, ∫ S df = std².

    Two-sided density, f0 the `frequency` and b the `width`: the full width at half power. Without power at 0. In the time
    domain `N' = -2πb N - 2πf0 q + std √(4πb) w`, `q' = 2πf0 N`; N and q have the variance std². As b → 0 it becomes a line
    whose phase and amplitude are random (Rayleigh). Continuous, not differentiable.

    **Arguments:** `std`, the standard deviation: one number is that of the drive, a fraction of P_w; four or five, or a
    mapping, as in `AbstractNoise`; `frequency` [Hz] > 0, `width` [Hz] > 0; `relative`, `shared`.
    """

    amplitude: Scalar = eqx.field(converter=as_amplitude)
    frequency: Scalar
    width: Scalar
    relative: bool = eqx.field(static=True)
    shared: bool = eqx.field(static=True)
    smoothness: ClassVar[int] = 1
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

    def draw(self, key: PRNGKeyArray, steps: int) -> Float[Array, "..."]:
        return standard_normals(key, (steps + 1, 2, self.channels))

    def realise(self, normals: Float[Array, "..."], dt: Scalar) -> Realisation:
        made = jax.tree.map(lambda x: x.astype(normals.dtype), self.shaping_filter())
        step, kick = exact_step(made, dt)

        def advance(state, normal):
            (q, n), (first, second) = state, normal
            new = (
                step[0, 0] * q + step[0, 1] * n + kick[0, 0] * first,
                (step[1, 0] * q + step[1, 1] * n + kick[1, 0] * first + kick[1, 1] * second),
            )
            return new, new[1]

        _, later = jax.lax.scan(advance, (normals[0, 0], normals[0, 1]), normals[1:])
        return Realisation(values=jnp.concatenate([normals[:1, 1], later]))

    def shaping_filter(self) -> ShapingFilter:
        omega, rate = 2 * jnp.pi * jnp.asarray(self.frequency), 2 * jnp.pi * jnp.asarray(self.width)
        none = jnp.zeros_like(omega + rate)
        F = jnp.stack([jnp.stack([none, omega]), jnp.stack([-omega, -rate])])
        return ShapingFilter(F, jnp.stack([none, jnp.sqrt(2 * rate)])[:, None], jnp.array([0.0, 1.0]), jnp.zeros(1))

    def check_step(self, dt: float) -> None:
        require(
            (self.frequency + self.width) * dt <= 0.1,
            f"dt = {dt} s is too coarse for a resonance at {self.frequency} Hz, {self.width} Hz wide: use "
            "dt <= 0.1 / (resonance_frequency + resonance_width)",
        )


class NoiseSum(AbstractNoise):
    """A sum of independent noises, its `parts`, each with amplitudes of its own. Made by `+`."""

    parts: tuple[AbstractNoise, ...]

    def __init__(self, parts: tuple[AbstractNoise, ...]):
        if not all(isinstance(part, AbstractNoise) for part in parts):
            raise ValueError(f"a sum of noises needs noises, not {parts!r}")
        self.parts = tuple(part.per_channel() for each in parts for part in each.components)

    def __check_init__(self):
        if not self.parts:
            raise ValueError("a sum of noises needs at least one")

    @property
    def components(self) -> tuple[AbstractNoise, ...]:
        return self.parts

    @property
    def amplitude(self) -> Float[Array | np.ndarray, " amplitudes"]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The amplitudes of all parts, one after the other."""
        each = [part.amplitude for part in self.parts]
        return jnp.concatenate(each) if any(not isinstance(a, np.ndarray) for a in each) else np.concatenate(each)

    @property
    def relative(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all parts are fractions of what they act on."""
        return all(part.relative for part in self.parts)

    @property
    def shared(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all parts are."""
        return all(part.shared for part in self.parts)

    @property
    def smoothness(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """That of the roughest part."""
        return min(part.smoothness for part in self.parts)

    def density(self, f: Scalar) -> Scalar:
        raise ValueError("a sum of noises has no density of unit amplitude: ask its components, or psd(f)")

    def psd(self, f: Float[Array | np.ndarray, " frequencies"] | Scalar) -> Float[Array, "..."]:
        """Two-sided power density [amplitude²/Hz] of the sum, a row for each of `INPUTS`."""
        rows = jnp.zeros((len(INPUTS), jnp.atleast_1d(jnp.asarray(f)).size))
        for part in self.parts:
            rows = rows.at[jnp.array(part.acts_on)].add(part.psd(f))
        return rows

    def per_channel(self) -> "NoiseSum":
        return self

    @property
    def channels(self) -> int:
        return sum(part.channels for part in self.parts)

    def draw(self, key: PRNGKeyArray, steps: int) -> Any:
        # The first part draws what it would draw alone, so that a tremor can be added to a path.
        keys = [key, *(jax.random.fold_in(key, i) for i in range(1, len(self.parts)))]
        return tuple(part.draw(own, steps) for part, own in zip(self.parts, keys, strict=True))

    def realise(self, normals: Any, dt: Scalar) -> Realisation:
        return Realisation(parts=tuple(p.realise(own, dt) for p, own in zip(self.parts, normals, strict=True)))

    def shaping_filter(self) -> ShapingFilter:
        raise ValueError("a sum of noises has a shaping filter for each of its components")

    def check_step(self, dt: float) -> None:
        for part in self.parts:
            part.check_step(dt)
