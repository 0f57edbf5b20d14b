"""Random keys by programs that are kept: JAX's own would be compiled in every process."""

from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from .programs import kept


def key_of(seed: int) -> PRNGKeyArray:
    """`jax.random.key`."""
    return _key(np.asarray(seed))


def fold_in(key: PRNGKeyArray, number: int) -> PRNGKeyArray:
    """`jax.random.fold_in`."""
    return _folded(key, np.asarray(number, dtype=np.uint32))


@kept
def _key(seed: Any) -> PRNGKeyArray:
    return jax.random.key(seed)


@kept
def _folded(key: PRNGKeyArray, number: Any) -> PRNGKeyArray:
    return jax.random.fold_in(key, number)
