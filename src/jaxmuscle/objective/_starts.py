"""Where the starts of a fit begin, and which different minima they ended in."""

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri
from scipy.stats import qmc

from jaxmuscle.data._target import Target

from ._coordinates import Coordinates
from ._least_squares import Descent
from ._problem import Setup


def starting_points(coordinates: Coordinates, target: Target, count: int) -> Float[np.ndarray, "starts free"]:
    """Starts: harmonic frequencies at the target's local maxima and spread over its band, the rest space-filling.

    The first start has all other parameters at their default, the others at half a prior standard deviation about it.
    """
    theta = space_filling(len(coordinates.names), count)
    for name in frequency_names(coordinates):
        theta[:, coordinates.names.index(name)] = coordinates.theta_of(name, candidate_frequencies(target, count))
    return coordinates.from_theta(theta)


def space_filling(size: int, count: int) -> Float[np.ndarray, "count size"]:
    """θ = 0, then a Halton design with half a prior standard deviation about it."""
    cube = qmc.Halton(size, rng=0).random(count)
    theta = 0.5 * ndtri(np.clip(cube, 0.02, 0.98))
    theta[0] = 0.0
    return theta


def frequency_names(coordinates: Coordinates) -> list[str]:
    """The free harmonic frequencies; in a joint fit targets may have one each, called "harmonic_frequency@target"."""
    return [name for name in coordinates.names if name.partition("@")[0] == "harmonic_frequency"]


def contenders(coordinates: Coordinates, target: Target, descent: Descent, margin: float) -> list[int]:
    """The best start, then those whose cost is at most `margin` above it at another harmonic frequency, best first.

    Frequencies differ when no nearer than one bin: a Welch peak is two bins wide, so these are different minima. Where
    several are free, one that differs is enough.
    """
    costs = np.where(np.isfinite(descent.cost), descent.cost, np.inf)
    chosen = [descent.best]
    names = frequency_names(coordinates)
    if not names:
        return chosen
    frequency = np.stack([harmonic_frequencies(coordinates, descent, name) for name in names], axis=1)
    width = target.settings.rate / target.settings.length
    for i in np.argsort(costs, kind="stable"):
        near = np.min(np.max(np.abs(frequency[i] - frequency[chosen]), axis=1)) < width
        if costs[i] <= costs[descent.best] + margin and not near:
            chosen.append(int(i))
    return chosen


def harmonic_frequencies(
    coordinates: Coordinates, descent: Descent, name: str = "harmonic_frequency"
) -> Float[np.ndarray, " starts"]:
    """Harmonic frequency that each start reached [Hz]."""
    theta = np.asarray(coordinates.theta(descent.s))
    column = coordinates.names.index(name)
    return coordinates.centre[column] * np.exp(coordinates.sd[column] * theta[:, column])


def candidate_frequencies(target: Target, count: int) -> Float[np.ndarray, " starts"]:
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


FREQUENCIES = 32


def points_about(setup: Setup, theta: np.ndarray) -> np.ndarray:
    """A point with the harmonic's frequency as it is and at the target's local maxima and over the band, amplitude free."""
    names = setup.coordinates.names
    if "harmonic_frequency" not in names:
        return theta[None]
    points = np.tile(theta, (FREQUENCIES, 1))
    frequencies = candidate_frequencies(setup.target, FREQUENCIES - 1)
    points[1:, names.index("harmonic_frequency")] = setup.coordinates.theta_of("harmonic_frequency", frequencies)
    if "harmonic_amplitude" in names:
        points[1::2, names.index("harmonic_amplitude")] = 0.0
    return points
