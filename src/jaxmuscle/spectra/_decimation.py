"""Sampling with a low-pass against aliases, as `scipy.signal.resample_poly` does it, in JAX."""

import functools
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxmuscle._common.programs import kept

REACH = 10  # samples to either side
FINER = 8  # points in a sampling interval where the low-pass takes a signal known at all times
LEAST_RATES = 2  # of the spectrum, in the rate of a recording whose aliases are known


@functools.cache
def anti_alias(every: int) -> Float[np.ndarray, " taps"]:
    """The low-pass for one of so many points: cut off at half the lower rate (gain 0.5), a Kaiser
    window with β = 5."""
    return np.asarray(scipy.signal.firwin(2 * REACH * every + 1, 1 / every, window=("kaiser", 5.0)))


@kept
def decimated(signal: Any, every: int) -> Float[Array, "*batch fewer"]:
    """Every so-manieth value of what the low-pass lets through, as `resample_poly(signal, 1, every,
    padtype="line")`.

    Beyond the ends the straight line from the first to the last value goes on.
    """
    signal = jnp.asarray(signal)
    fewer, dtype = (signal.shape[-1] - 1) // every + 1, signal.dtype
    share = jnp.linspace(0, 1, signal.shape[-1], dtype=dtype)
    line = signal[..., :1] + (signal[..., -1:] - signal[..., :1]) * share
    # Blocks of `every` points; each output is made of 21 neighbouring ones, of which each gives all
    # its sums at once.
    blocks = fewer + 2 * REACH
    around = (REACH * every, blocks * every - REACH * every - signal.shape[-1])
    padded = jnp.pad(signal - line, [(0, 0)] * (signal.ndim - 1) + [around])
    taps = np.pad(anti_alias(every), (0, every - 1)).reshape(-1, every)
    sums = jnp.matmul(
        padded.reshape(*signal.shape[:-1], blocks, every),
        jnp.asarray(taps.T, dtype),
        precision="highest",
    )
    passed = sum(sums[..., i : i + fewer, i] for i in range(2 * REACH + 1))
    return line[..., ::every] + passed


def at_every(signal: Any, every: int, sampling: str) -> Any:
    """One of so many values, as `SpectrumSettings.sampling` says: decimated where it is
    "filtered"."""
    return (
        decimated(signal, every) if sampling == "filtered" and every > 1 else signal[..., ::every]
    )
