"""Targets that scatter by the law of their bins, and fits of them that many tests look at: each fit
is made once a session (in every worker), when the first test asks for it."""

import functools
from typing import Any

import jax
import numpy as np
import scipy.stats

import jaxmuscle as jm
from jaxmuscle.spectra._bin_law import bin_statistics

TASK = jm.Isometric()
QUICK: dict[str, Any] = {"starts": 8, "seeds": 0, "check_seeds": 0}
TREMOR = {"resonance_amplitude": 0.08, "resonance_frequency": 9.0, "resonance_width": 2.0}


def expected(task: jm.Isometric) -> np.ndarray:
    """Proportional power of a muscle."""
    with jax.enable_x64(True):
        return np.asarray(jm.expected_spectrum(task).proportional)


def drawn(power: np.ndarray, segments: int, seed: int) -> jm.Target:
    """A spectrum that scatters about a power by the law of its bins."""
    law = bin_statistics(jm.Target("x", power, segments=[segments]))
    normal = np.random.default_rng(seed).multivariate_normal(np.zeros(30), law.correlation)
    made = power * scipy.stats.gamma.ppf(scipy.stats.norm.cdf(normal), law.half) / law.half
    return jm.Target(f"drawn {segments} {seed}", made, segments=[segments])


def with_tremor() -> jm.Isometric:
    """A muscle with a twitch of 60 ms and a tremor at 9 Hz."""
    return jm.model.on_rung(TASK, 2).replace(activation_time=0.06, **TREMOR)


def with_band(share: float, frequency: float = 9.0, width: float = 2.0) -> np.ndarray:
    """The default muscle's spectrum with a band of tremor that holds a share of the power."""
    f = TASK.settings.frequency
    band = width**2 * f**2 / ((frequency**2 - f**2) ** 2 + width**2 * f**2)
    return (1 - share) * expected(TASK) + share * band / band.sum()


@functools.cache
def plain_fit() -> jm.fits.FitResult:
    """Of the default muscle's own spectrum."""
    return jm.fit(TASK, drawn(expected(TASK), 12, 2), **QUICK)


@functools.cache
def tremor_fit() -> jm.fits.FitResult:
    """Of a muscle with a tremor, which the ladder finds."""
    return jm.fit(TASK, drawn(expected(with_tremor()), 90, 1), **QUICK)


@functools.cache
def missed_fit() -> jm.fits.FitResult:
    """Of a spectrum that the model does not describe: a tenth of its power is a band."""
    return jm.fit(TASK, drawn(with_band(0.1), 60, 3), rungs=0, **QUICK)
