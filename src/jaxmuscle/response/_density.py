"""The power density of a task's output under its noise, at any frequency."""

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arrays import as_arrays, as_doubles
from jaxmuscle._common.programs import kept
from jaxmuscle.model._task import AbstractTask

from ._autocovariance import Covariances, covariances
from ._equilibrium import mechanics
from ._linearised import linearisation

_covariances = kept(covariances)


def noise_density(
    task: AbstractTask, frequency: Float[np.ndarray, " frequencies"]
) -> Float[np.ndarray, "components frequencies"]:
    """One-sided power density [unit²/Hz] that each component of the noise makes, to first order.

        S(f) = 4 Re Σ row (2πi f - 𝒜)⁻¹ start,    r(τ) = Σ row exp(𝒜 τ) start

    Of the output itself: no sampling, no low-pass, no harmonic.
    """
    with jax.enable_x64(True):
        found = _covariances(as_doubles(as_arrays(task)), linearisation(mechanics(task)))
    s = 2j * np.pi * np.asarray(frequency)[:, None, None]
    return np.array([np.sum([_density(own, s) for own in each], axis=0) for each in found])


def _density(system: Covariances, s: np.ndarray) -> Float[np.ndarray, " frequencies"]:
    matrix, rows, start = map(np.asarray, system)
    inside = np.linalg.solve(s * np.eye(len(matrix)) - matrix, start.T[None])
    return 4 * np.real(np.einsum("cs,fsc->f", rows, inside))
