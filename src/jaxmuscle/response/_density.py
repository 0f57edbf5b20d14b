"""The power density of a task's output under its noise, at any frequency."""

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle.model._task import AbstractTask

from ._rows import noise_parts


def noise_density(
    task: AbstractTask, frequency: Float[np.ndarray, " frequencies"]
) -> Float[np.ndarray, "components frequencies"]:
    """One-sided power density [unit²/Hz] that each component of the noise makes, to first order.

        S(f) = 2 Σ |row (2πi f - 𝒜)⁻¹ white|²,    x' = 𝒜 x + white w

    Of the output itself: no sampling, no low-pass, no harmonic.
    """
    with jax.enable_x64(True):
        parts, component = noise_parts(task)
    s = 2j * np.pi * np.asarray(frequency)[:, None, None]
    each = np.array([_density(*part, s) for part in zip(*parts, strict=True)])
    return np.array(
        [np.sum(each[component == i], axis=0) for i in range(len(task.noise.components))]
    )


def _density(
    matrix: np.ndarray, white: np.ndarray, rows: np.ndarray, s: np.ndarray
) -> Float[np.ndarray, " frequencies"]:
    inside = np.linalg.solve(s * np.eye(len(matrix)) - matrix, white[None].astype(s.dtype))
    return 2 * np.sum(np.abs(rows @ inside) ** 2, axis=(1, 2))
