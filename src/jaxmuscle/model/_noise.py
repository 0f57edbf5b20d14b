"""Random perturbations: what every noise has, and sums of noises."""

import abc
import functools
import operator
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import Inexact, as_inexact, require
from jaxmuscle._common.cards import Spelled
from jaxmuscle._common.types import Scalar

from ._parameters import CHANNELS, INPUTS, default

Amplitude = Scalar | tuple | list | dict | None


class Recursion(eqx.Module):
    """One channel of a unit noise from grid point to grid point, exact in distribution: `q ← A q +
    L z`, z standard normals.

    `N = H q` at the grid points, `dN/dt = S q` if it is differentiable, and white noise has the
    increment `direct z` between them. The states q are scaled to a stationary covariance of 1. An
    entry of A, L, H or S that is always zero may be None. The methods take states and normals that
    are scalars or arrays (of channels, of seeds) alike.
    """

    A: tuple[tuple[Scalar | None, ...], ...]
    L: tuple[tuple[Scalar | None, ...], ...]
    H: tuple[Scalar | None, ...]
    S: tuple[Scalar | None, ...] | None = None
    direct: Scalar | None = None

    @property
    def numbers(self) -> int:
        """How many normals a step takes."""
        return len(self.A) if self.direct is None else 1

    def start(self, z: tuple[Array, ...]) -> tuple[Array, ...]:
        """Where it begins, in its stationary distribution, whose covariance is the identity."""
        return z[: len(self.A)]

    def advance(self, q: tuple[Array, ...], z: tuple[Array, ...]) -> tuple[Array, ...]:
        """One step on."""
        return tuple(_dot((*a, *b), (*q, *z)) for a, b in zip(self.A, self.L, strict=True))

    def value(self, q: tuple[Array, ...]) -> Array:
        """N."""
        return _dot(self.H, q)

    def slope(self, q: tuple[Array, ...]) -> Array | None:
        """dN/dt, or None."""
        return None if self.S is None else _dot(self.S, q)


def _dot(row: tuple[Scalar | None, ...], values: tuple[Array, ...]) -> Array:
    return functools.reduce(
        operator.add, [a * x for a, x in zip(row, values, strict=True) if a is not None]
    )


class ShapingFilter(eqx.Module):
    """A unit noise as filtered independent white noises w of density 1: `q' = F q + G w`, `N = H
    q + L w`."""

    F: Float[Array, "states states"]
    G: Float[Array, "states inputs"]
    H: Float[Array, " states"]
    L: Float[Array, " inputs"]


class AbstractNoise(Spelled, Inexact):
    """Noise on the coefficients K_w, K_z, C_w, C_z and the drive P_w, an independent channel each
    (`shared`: one for all).

    `amplitude` is one number for the four coefficients; or four; or five, the last for the drive;
    or a mapping by name. It is a fraction of the base coefficient (`relative`) or in its unit [N/m,
    N s/m]; that of the drive is a fraction of P_w. `smoothness`: 0 white (has no values), 1
    continuous, 2 differentiable. The names of its parameters begin with the class variable `sort`:
    "noise", if a class does not say otherwise ("resonance" for `ResonantNoise`).

    Noises add: `BandLimitedNoise() + ResonantNoise()`.
    """

    amplitude: eqx.AbstractVar[Scalar]
    relative: eqx.AbstractVar[bool]
    shared: eqx.AbstractVar[bool]
    smoothness: ClassVar[int]
    sort: ClassVar[str] = "noise"

    @abc.abstractmethod
    def density(self, f: Scalar) -> Scalar:
        """Two-sided power density [1/Hz] of the unit-amplitude noise at frequency f [Hz]."""

    @abc.abstractmethod
    def recursion(self, dt: Scalar) -> Recursion:
        """How a channel goes on in a step of dt [s]."""

    @abc.abstractmethod
    def shaping_filter(self) -> ShapingFilter:
        """The linear filter whose output the unit-amplitude noise is, for the linear response."""

    @abc.abstractmethod
    def check_step(self, dt: float) -> None:
        """Raise a `ValueError` if a grid of step dt [s] is too coarse for this noise."""

    def psd(self, f: Float[Array | np.ndarray, " frequencies"] | Scalar) -> Float[Array, "..."]:
        """Two-sided power density `amplitude² density(f)` [amplitude²/Hz], one row per amplitude if
        there are several."""
        return jnp.asarray(self.amplitude)[..., None] ** 2 * self.density(
            jnp.atleast_1d(jnp.asarray(f))
        )

    def __add__(self, other: "AbstractNoise") -> "NoiseSum":
        if not isinstance(other, AbstractNoise):
            return NotImplemented
        return NoiseSum((*self.components, *other.components))

    def per_channel(self) -> "AbstractNoise":
        """A copy whose amplitude has one entry for each input that it acts on."""
        if np.ndim(self.amplitude) == 1:
            return self
        whole, count = isinstance(self.amplitude, jax.Array), self._channels_of_one_number
        spread = (
            jnp.broadcast_to(self.amplitude, (count,))
            if whole
            else np.full(count, float(self.amplitude))
        )
        return eqx.tree_at(lambda n: n.amplitude, self, spread)

    _channels_of_one_number: ClassVar[int] = len(CHANNELS)

    @property
    def components(self) -> "tuple[AbstractNoise, ...]":
        """The noises of a sum; of a single one itself."""
        return (self,)

    @property
    def acts_on(self) -> tuple[int, ...]:
        """Positions among `INPUTS` (the four coefficients, then the drive) of what it has an
        amplitude for."""
        return ACTED_ON[
            (
                np.shape(self.amplitude)[-1]
                if np.ndim(self.amplitude)
                else self._channels_of_one_number
            )
        ]

    @property
    def channels(self) -> int:
        """How many independent channels are drawn."""
        return 1 if self.shared else len(self.acts_on)


ACTED_ON = {
    1: (len(CHANNELS),),
    len(CHANNELS): tuple(range(len(CHANNELS))),
    len(INPUTS): tuple(range(len(INPUTS))),
}


def as_amplitude(value: Amplitude) -> Scalar:
    """An amplitude in any form as what a noise keeps: the converter of the field `amplitude`, also
    of a noise of your own.

        jm.model.as_amplitude({"K_w": 0.02, "K_z": 0.005})

    A noise of your own has it as `eqx.field(converter=jm.model.as_amplitude, default=None)`.

    **Arguments:** `value`, one number for the four coefficients (kept as it is); a list of four, or
    of five with the drive; a dictionary by `K_w`, `K_z`, `C_w`, `C_z`, `P_w`, of which those left
    out are 0; or None, the defaults of the parameter table. **Returns:** an array, or the number.
    **Raises:** `ValueError` for an unknown name or another number of entries.
    """
    if value is None:
        return np.array([default(f"noise_{c}") for c in CHANNELS])
    if isinstance(value, dict):
        unknown = set(value) - set(INPUTS)
        if unknown:
            raise ValueError(
                f"noise amplitude for unknown input {sorted(unknown)}: known: {', '.join(INPUTS)}"
            )
        value = [value.get(c, 0.0) for c in (INPUTS if "P_w" in value else CHANNELS)]
    if isinstance(value, tuple | list):
        if len(value) not in ACTED_ON:
            raise ValueError(
                f"noise amplitude has {len(value)} entries: give one number, four for"
                f" {', '.join(CHANNELS)}, or five for these and the drive P_w"
            )
        return (
            jnp.stack([jnp.asarray(v) for v in value])
            if _any_jax(value)
            else np.array(value, dtype=float)
        )
    return as_inexact(value)


def _any_jax(values: tuple | list) -> bool:
    return any(isinstance(v, jax.Array) for v in values)


def check_amplitude(noise: AbstractNoise) -> None:
    if np.ndim(noise.amplitude) and (
        np.ndim(noise.amplitude) > 1 or np.shape(noise.amplitude)[0] not in ACTED_ON
    ):
        raise ValueError(
            f"noise amplitude has shape {np.shape(noise.amplitude)}: give one number, four or five"
        )
    require(noise.amplitude >= 0, f"noise amplitude {noise.amplitude} must not be negative")


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
        return (
            jnp.concatenate(each)
            if any(not isinstance(a, np.ndarray) for a in each)
            else np.concatenate(each)
        )

    @property
    def relative(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all parts are fractions of what they act on."""
        return all(part.relative for part in self.parts)

    @property
    def shared(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether all parts are."""
        return all(part.shared for part in self.parts)

    def density(self, f: Scalar) -> Scalar:
        raise ValueError(
            "a sum of noises has no density of unit amplitude: ask its components, or psd(f)"
        )

    def psd(self, f: Float[Array | np.ndarray, " frequencies"] | Scalar) -> Float[Array, "..."]:
        """Two-sided power density [amplitude²/Hz] of the sum, a row for each of `INPUTS`."""
        rows = jnp.zeros((len(INPUTS), jnp.atleast_1d(jnp.asarray(f)).size))
        for part in self.parts:
            rows = rows.at[jnp.array(part.acts_on)].add(part.psd(f))
        return rows

    def recursion(self, dt: Scalar) -> Recursion:
        raise ValueError("a sum of noises has a recursion for each of its components")

    def shaping_filter(self) -> ShapingFilter:
        raise ValueError("a sum of noises has a shaping filter for each of its components")

    def check_step(self, dt: float) -> None:
        for part in self.parts:
            part.check_step(dt)
