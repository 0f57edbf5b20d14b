"""Random numbers of a seed: a counter-based generator, Gaussian or weak increments."""

from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from jaxmuscle._common.text import choices

Generator = Literal["hash", "threefry"]
Increments = Literal["gaussian", "weak"]

# of the stream: the same key, seed and version give the same noise. 1 drew all normals of a seed at
# once
VERSION = 2
START = np.uint32(0xFFFFFFFF)  # the step before the first, which draws where a noise begins
# Numbers of a step that one noise of a sum may take: so the next one begins at the same place
# whatever the first one uses, and its numbers do not change with it.
APART = 1024

# 2³² over the golden ratio: its multiples are spread over all words as evenly as can be (Weyl).
_GOLDEN = 0x9E3779B9
_BYTES = 4  # in a word, each of which makes a weak number

# The normal quantile as odd function of x = 1 - 2 tail: x P(L) / Q(L), L = -log(1 - x²). Minimax
# fit of the relative error up to L = 22.3, |z| = 6.4: 1.6e-5.
_P = (1.253295, 0.44145788, 0.084870878, 0.010199065, 4.4658263e-5)
_Q = (1.0, 0.090186474, 0.031676926, 7.8426951e-4)
# log(1 + m) / m for m from √½ - 1 to √2 - 1, 2e-7.
_LOG = (1.0000032, -0.50001965, 0.33303295, -0.24881325, 0.20604704, -0.18902126, 0.11827557)
# Moments 2, 4 and 6 of x (a + b x² + c x⁴), x = (byte - 127.5) / 128, are those of a normal; odd
# ones vanish by symmetry. A scheme of weak order 2 needs moments up to the fifth.
_WEAK = (2.79678067, -6.70456644, 6.73654793)


class Draws(NamedTuple):
    """How random numbers are made: by which `generator`, and as which `increments`; see the
    arguments of `ensemble`.

    jm.model.Draws(increments="weak")
    """

    generator: Generator = "hash"
    increments: Increments = "gaussian"

    @classmethod
    def of(cls, generator: str, increments: str) -> "Draws":
        """The same after a check. **Raises:** `ValueError` for an unknown generator or unknown
        increments."""
        for name, value, known in (
            ("generator", generator, get_args(Generator)),
            ("increments", increments, get_args(Increments)),
        ):
            if value not in known:
                raise ValueError(f"{name} = {value!r}: {choices(value, known)}")
        return cls(generator, increments)  # pyright: ignore[reportArgumentType]


class Stream(eqx.Module):
    """The random numbers of one seed. Number j of step k is a function of the seed's key, j and k
    alone.

    `words` [2] are 64 bits of the seed's key. A word of 32 random bits is

        word(k, j) = mix3(mix2(k ^ words[0]) ^ words[1] + (j + 1) γ),   γ = 2³² / golden ratio

    where mix2 and mix3 are bijections that spread every bit over all (Wellons, *Hash Prospector*,
    2018: two and three rounds of multiplication and shift). With generator "threefry" it is
    `jax.random.bits` of the key folded with k.

    A Gaussian takes one word: 31 bits for the tail probability, one for the sign. A weak number
    takes a byte: 256 equally likely values, whose moments 1 to 7 are those of the standard normal.
    """

    key: PRNGKeyArray
    words: UInt32[Array, "2"]
    draws: Draws = eqx.field(static=True)

    @classmethod
    def of(cls, key: PRNGKeyArray, draws: Draws = Draws()) -> "Stream":  # noqa: B008
        """That of a seed's key."""
        return cls(key, jax.random.bits(key, (2,), jnp.uint32), draws)

    def ahead(
        self, steps: Int[Array, " steps"], first: tuple[int, ...], count: tuple[int, ...]
    ) -> tuple:
        """What is best made for many steps at once: the words of weak numbers, else the steps' own
        numbers."""
        if self.draws.increments == "gaussian":
            return (steps,)
        return tuple(
            self._words(steps, f, -(-n // _BYTES)) for f, n in zip(first, count, strict=True)
        )

    def numbers(
        self, made: tuple, part: int, first: int, count: int
    ) -> tuple[Float[Array, "..."], ...]:
        """The numbers of a step, of `ahead`'s answer there, for the noise that is the part-th of a
        sum."""
        if self.draws.increments == "gaussian":
            return self.normals(made[0], first, count)
        return tuple(
            _weak(word >> jnp.uint32(8 * i)) for word in made[part] for i in range(_BYTES)
        )[:count]

    def normals(
        self, step: Int[Array, "*steps"] | np.uint32, first: int, count: int
    ) -> tuple[Float[Array, "..."], ...]:
        """Standard normals of a step, or of steps, an array for each; of single precision in either
        precision."""
        dtype = jnp.result_type(float)
        if step is START and count:  # once in a run: all together are compiled sooner
            return tuple(_normal(jnp.stack(self._words(step, first, count))).astype(dtype))
        return tuple(_normal(word).astype(dtype) for word in self._words(step, first, count))

    def _words(
        self, step: Array | np.uint32, first: int, count: int
    ) -> tuple[UInt32[Array, "..."], ...]:
        step = jnp.asarray(step).astype(jnp.uint32)
        if self.draws.generator == "threefry":

            def words(k: Array) -> Array:
                key = jax.random.fold_in(jax.random.fold_in(self.key, k), first)
                return jax.random.bits(key, (count,), jnp.uint32)

            found = words(step) if step.ndim == 0 else jax.vmap(words)(step)
            return tuple(found[..., i] for i in range(count))
        mixed = _mix2(step ^ self.words[0]) ^ self.words[1]
        return tuple(
            _mix3(mixed + np.uint32((first + i + 1) * _GOLDEN & 0xFFFFFFFF)) for i in range(count)
        )


# Shift down, then multiply up, so that every bit moves every other; odd factors, since only these
# have an inverse modulo 2³². Shifts and factors are those of least bias that Wellons found.
def _mix2(x: Array) -> Array:
    x = (x ^ (x >> jnp.uint32(16))) * jnp.uint32(0x7FEB352D)
    x = (x ^ (x >> jnp.uint32(15))) * jnp.uint32(0x846CA68B)
    return x ^ (x >> jnp.uint32(16))


def _mix3(x: Array) -> Array:
    x = (x ^ (x >> jnp.uint32(17))) * jnp.uint32(0xED5AD4BB)
    x = (x ^ (x >> jnp.uint32(11))) * jnp.uint32(0xAC4C1B51)
    x = (x ^ (x >> jnp.uint32(15))) * jnp.uint32(0x31848BAB)
    return x ^ (x >> jnp.uint32(14))


def _horner(coefficients: tuple[float, ...], x: Array) -> Array:
    found = jnp.float32(coefficients[-1])
    for value in coefficients[-2::-1]:
        found = found * x + jnp.float32(value)
    return found


def _log(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Natural logarithm of a normal positive number in single precision, of shifts and products
    alone."""
    bits = jax.lax.bitcast_convert_type(x, jnp.int32)
    power = (bits - jnp.int32(0x3F3504F3)) >> 23
    rest = jax.lax.bitcast_convert_type(bits - (power << 23), jnp.float32) - 1
    return rest * _horner(_LOG, rest) + power.astype(jnp.float32) * jnp.float32(np.log(2))


def _normal(word: UInt32[Array, "..."]) -> Float[Array, "..."]:
    """The standard normal that a word stands for.

    The division comes last: XLA computes it once for all who ask, where sums and products would be
    repeated for each.
    """
    # of |z|, twice
    tail = ((word >> jnp.uint32(1)).astype(jnp.int32).astype(jnp.float32) + 0.5) * jnp.float32(
        2**-31
    )
    L = -_log(tail * (2 - tail))
    size = jax.lax.bitcast_convert_type(1 - tail, jnp.uint32)
    x = jax.lax.bitcast_convert_type(size | (word << jnp.uint32(31)), jnp.float32)
    return x * _horner(_P, L) / _horner(_Q, L)


def _weak(word: UInt32[Array, "..."]) -> Float[Array, "..."]:
    """The weak number that the last byte of a word stands for."""
    x = (word & jnp.uint32(255)).astype(jnp.int32).astype(jnp.float32) * jnp.float32(
        1 / 128
    ) - jnp.float32(127.5 / 128)
    return (x * _horner(_WEAK, x * x)).astype(jnp.result_type(float))
