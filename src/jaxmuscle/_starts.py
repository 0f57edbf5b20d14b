"""Where the starts of a fit begin, and which different minima they ended in."""

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import qmc

from ._descend import Descent
from ._objective import Coordinates
from ._target import Target


def starting_points(coordinates: Coordinates, target: Target, count: int) -> Float[np.ndarray, "starts free"]:
    """Starts: harmonic frequencies at the target's local maxima and spread over its band, the rest space-filling.

    The first start has all other parameters at their default, the others at half a prior standard deviation about it.
    """
    size = len(coordinates.names)
    cube = qmc.Halton(size, rng=0).random(count)
    theta = 0.5 * ndtri(np.clip(cube, 0.02, 0.98))
    theta[0] = 0.0
    if "harmonic_frequency" in coordinates.names:
        column = coordinates.names.index("harmonic_frequency")
        frequencies = _candidate_frequencies(target, count)
        theta[:, column] = coordinates.theta_of("harmonic_frequency", frequencies)
    return coordinates.from_theta(theta)


def contenders(coordinates: Coordinates, target: Target, descent: Descent, margin: float) -> list[int]:
    """The best start, then those whose cost is at most `margin` above it at another harmonic frequency, best first.

    Frequencies differ when no nearer than one bin: a Welch peak is two bins wide, so these are different minima.
    """
    costs = np.where(np.isfinite(descent.cost), descent.cost, np.inf)
    chosen = [descent.best]
    if "harmonic_frequency" not in coordinates.names:
        return chosen
    frequency = harmonic_frequencies(coordinates, descent)
    width = target.settings.rate / target.settings.length
    for i in np.argsort(costs, kind="stable"):
        near = np.min(np.abs(frequency[i] - frequency[chosen])) < width
        if costs[i] <= costs[descent.best] + margin and not near:
            chosen.append(int(i))
    return chosen


def harmonic_frequencies(coordinates: Coordinates, descent: Descent) -> Float[np.ndarray, " starts"]:
    """Harmonic frequency that each start reached [Hz]."""
    theta = np.asarray(coordinates.theta(descent.s))
    column = coordinates.names.index("harmonic_frequency")
    return coordinates.centre[column] * np.exp(coordinates.sd[column] * theta[:, column])


def _candidate_frequencies(target: Target, count: int) -> Float[np.ndarray, " starts"]:
    """The target's local maxima, highest above their neighbours first, and a quarter bin beside each; then the band.

    A maximum is the vertex of the parabola through the log powers of three bins: a line that is narrower than a bin is
    found from nearby, but not from a bin away.
    """
    f, p = np.asarray(target.frequency), np.log(np.asarray(target.proportional_power))
    inner = np.flatnonzero((p[1:-1] > p[:-2]) & (p[1:-1] > p[2:])) + 1
    bend = 2 * p[inner] - p[inner - 1] - p[inner + 1]
    inner, bend = inner[np.argsort(-bend)], np.sort(bend)[::-1]
    peaks = f[inner] + 0.25 * (f[inner + 1] - f[inner - 1]) * (p[inner + 1] - p[inner - 1]) / bend
    width = target.settings.rate / target.settings.length
    near = np.clip(peaks[:, None] + width * np.array([0.0, -0.25, 0.25]), f[0], f[-1]).ravel()
    spread = np.geomspace(f[0], f[-1], max(count, 2))
    order = np.argsort([-np.min(np.abs(np.log(s / np.append(peaks, 1e9)))) for s in spread])
    return np.concatenate([near[: max(1, count // 2)], spread[order], near[max(1, count // 2) :]])[:count]
