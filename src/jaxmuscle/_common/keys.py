"""Random keys and seeds, checked; keys are made by programs that are kept: JAX's own would be
compiled in every process."""

from typing import Any

import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Int, PRNGKeyArray

from .programs import kept

SEEDS = 2**32  # how many there are


def seed_of(seed: Any, name: str = "seed") -> int:
    """A seed as a number. Raises `ValueError` naming the argument unless it is a whole number from
    0 to 2³² - 1."""
    whole = not isinstance(seed, bool | np.bool_) and isinstance(seed, int | np.integer)
    number = int(seed) if whole else -1
    if not 0 <= number < SEEDS:
        raise ValueError(f"{name} = {seed!r}: give a whole number from 0 to 2^32 - 1 = {SEEDS - 1}")
    return number


def seeds_of(seeds: Any, name: str = "seeds") -> range | Int[np.ndarray, " seeds"]:
    """So many seeds from 0, or those given. Raises `ValueError` unless each is whole, in range and
    there once."""
    try:
        single = np.ndim(seeds) == 0
    except ValueError:  # lists of several lengths
        raise ValueError(
            f"{name} = {seeds!r}: give a number of seeds, or whole numbers in a list"
        ) from None
    if single:
        if isinstance(seeds, int | np.integer) and seeds < 1:
            raise ValueError(f"{name} = {seeds!r}: give at least one seed")
        return range(seed_of(seeds, name))
    numbers = seeds if isinstance(seeds, range) else np.asarray(seeds)
    if isinstance(numbers, np.ndarray) and (
        numbers.ndim != 1 or not np.issubdtype(numbers.dtype, np.integer)
    ):
        raise ValueError(
            f"{name}: {numbers.dtype} of shape {numbers.shape}; give a number of seeds, or whole"
            " numbers in a list"
        )
    if len(numbers) == 0:
        raise ValueError(f"{name} is empty: give at least one seed")
    if min(numbers) < 0 or max(numbers) >= SEEDS:
        wrong = next(int(number) for number in numbers if not 0 <= number < SEEDS)
        raise ValueError(
            f"{name} holds {wrong}: seeds are whole numbers from 0 to 2^32 - 1 = {SEEDS - 1}"
        )
    if isinstance(numbers, np.ndarray) and len(np.unique(numbers)) < len(numbers):
        values, counts = np.unique(numbers, return_counts=True)
        raise ValueError(
            f"{name} holds {values[counts > 1][0]} more than once: every seed is one noise path,"
            " give it once"
        )
    return numbers if isinstance(numbers, range) else numbers.astype(np.int64)


def number_of(key: Any) -> int | None:
    """The key as a seed number, if it was given as one."""
    return seed_of(key, "key") if isinstance(key, int | np.integer) else None


def check_key(key: Any) -> None:
    """Raise a `ValueError` unless it is a seed number, a key of `jax.random.key`, or the words of
    `jax.random.PRNGKey`."""
    if _is_typed(key):
        if key.shape:
            raise ValueError(
                f"key has shape {key.shape}: give one key, as jax.random.split(key)[0]"
            )
    elif not _is_words(key) and not (isinstance(key, Tracer) and _is_whole(key)):
        try:
            seed_of(int(key) if _is_whole(key) else key, "key")
        except ValueError as error:
            raise ValueError(f"{error}, or a key, as jax.random.key(0)") from None


def key_of(key: Any) -> PRNGKeyArray:
    """The key that is meant, see `check_key`. Raises `ValueError` for anything else."""
    check_key(key)
    if _is_typed(key):
        return key
    if _is_words(key):
        return _wrapped(key)
    return _key(key if isinstance(key, Tracer) else np.asarray(int(key), np.uint32))


def _is_typed(key: Any) -> bool:
    return isinstance(key, jax.Array) and jax.numpy.issubdtype(key.dtype, jax.dtypes.prng_key)


def _is_words(key: Any) -> bool:
    return isinstance(key, jax.Array | np.ndarray) and key.dtype == np.uint32 and key.shape == (2,)


def _is_whole(key: Any) -> bool:
    """Whether it is an array of one whole number."""
    return (
        isinstance(key, jax.Array | np.ndarray)
        and key.shape == ()
        and np.issubdtype(key.dtype, np.integer)
    )


def fold_in(key: PRNGKeyArray, number: int) -> PRNGKeyArray:
    """`jax.random.fold_in`."""
    return _folded(key, np.asarray(number, dtype=np.uint32))


@kept
def _key(seed: Any) -> PRNGKeyArray:
    return jax.random.key(seed)


@kept
def _folded(key: PRNGKeyArray, number: Any) -> PRNGKeyArray:
    return jax.random.fold_in(key, number)


@kept
def _wrapped(words: Any) -> PRNGKeyArray:
    return jax.random.wrap_key_data(words)
