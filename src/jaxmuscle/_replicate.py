"""Spectra that a model predicts for another measurement, and whether the one measured is among them."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.special import gammaincinv, ndtr

from ._again import theta_of
from ._descend import seen_at
from ._expected import Moments
from ._likelihood import LEAST, Likelihood
from ._problem import Setup
from ._target import Target
from ._task import AbstractTask
from ._uncertainty import BinStatistics, bin_statistics, standardised


class Replicates(NamedTuple):
    """`expected` and `power`: proportional powers of the model and of a spectrum drawn about it; `chi2` of the measured
    spectrum and `chi2_drawn` of the drawn one about the same model; `p_value`, how often the drawn one is further away.
    """

    expected: Float[np.ndarray, "*draws bins"]
    power: Float[np.ndarray, "*draws bins"]
    chi2: Float[np.ndarray, "*draws"]
    chi2_drawn: Float[np.ndarray, "*draws"]

    @property
    def p_value(self) -> float:
        """Posterior-predictive p-value (Gelman, Meng & Stern 1996)."""
        return float(np.mean(self.chi2_drawn >= self.chi2))


def repeated(setup: Setup, task: AbstractTask, count: int) -> Moments:
    """The task's moments in linear response, in `count` rows; for `drawn_spectra`."""
    seen = seen_at(setup.linear(), theta_of(setup, task)[None])
    return Moments(*(np.repeat(np.asarray(x), count, axis=0) for x in seen.moments))


def drawn_spectra(likelihood: Likelihood, target: Target, moments: Moments, key: Array) -> Float[np.ndarray, "rows bins"]:
    """Proportional powers scattering about the model's: correlated gamma variables, or Gaussian in the log with a sigma."""
    normal = np.asarray(jax.random.normal(key, np.shape(moments.power)))
    power = np.asarray(moments.power)
    bins: Any = likelihood.bins
    if bins is None:
        drawn = power * np.exp(normal * np.asarray(bin_statistics(target).sd))
    else:
        share = np.clip(np.asarray(moments.line) / power, 0.0, 1.0)
        half = np.asarray(bins.half) / np.maximum(1 - share**2, LEAST)
        root = np.linalg.cholesky(np.linalg.inv(np.asarray(bins.precision)))
        drawn = power * gammaincinv(half, ndtr(normal @ root.T)) / half
    return drawn / drawn.sum(axis=-1, keepdims=True)


def chi2_of(
    power: Float[np.ndarray, "rows bins"], moments: Moments, statistics: BinStatistics
) -> Float[np.ndarray, " rows"]:
    """`Σ (z_k - z̄)² / variance_k / (bins - 1)` of every row about its own model."""
    expected = np.asarray(moments.power)
    z = np.stack([standardised(p, e / e.sum(), statistics) for p, e in zip(power, expected, strict=True)])
    return np.sum(z**2, axis=1) / (z.shape[1] - 1)


def replicates(likelihood: Likelihood, target: Target, moments: Moments, shape: tuple[int, ...], key: Array) -> Replicates:
    """One spectrum drawn for every row of moments; results have the given leading shape."""
    drawn = drawn_spectra(likelihood, target, moments, key)
    statistics = bin_statistics(target)
    measured = np.broadcast_to(target.proportional_power, drawn.shape)
    power = np.asarray(moments.power)
    expected = power / power.sum(axis=-1, keepdims=True)
    found = chi2_of(measured, moments, statistics), chi2_of(drawn, moments, statistics)
    whole = (*shape, power.shape[-1])
    return Replicates(expected.reshape(whole), drawn.reshape(whole), *(x.reshape(shape) for x in found))
