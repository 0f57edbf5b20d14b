"""Where the starts of a fit begin, and which different minima they ended in."""

import dataclasses
import itertools
import math
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import ndtri

from jaxmuscle.data._measured import can_be_tested
from jaxmuscle.data._target import Target
from jaxmuscle.spectra._peak_test import find_peaks

from ._coordinates import Coordinates
from ._least_squares import Minima, for_all, least_squares
from ._problem import FitProblem
from ._residuals import Data, Residuals
from ._two_tissues import muscle_in_series

RANGE = 30.0  # of stiffness and damping, about the default
PEAKED = 3  # of every four starts, the one at a peak
HEIGHTS = 0.1, 0.3, 0.03  # of a resonance there: its amplitude
WIDE = 2.0  # Hz, of a tremor whose width is not measured
NARROW = 0.3  # Hz, of a resonance that stands for a line
SLOWEST = 1.5  # Hz, of a peak: below, the spectrum bends by itself
PEAK, ANSWER, OTHER_MODEL, SPREAD, OWN = "peak", "response", "other model", "spread", "own values"
RESPONSE = ("k_w", "k_z", "c_w", "c_z", "m_w", "m_z", "P_w")
# starts that begin at the measured response, and steps that are made to find them
MOST, STEPS = 8, 25
# by the response alone: how many, how many must agree, to which
SEARCHES, AGREEING, SAME, BEHIND = (10, 22), 4, 0.1, 10.0
# difference of their costs, and how far above the best one a search ends if it gains little
UNKNOWN = 1e6  # standard deviation of a log power that is not to count


def starting_points(
    problem: FitProblem, count: int, muscle: Mapping[str, float] | None = None
) -> Float[np.ndarray, "starts free"]:
    """Starts: harmonic frequencies at the targets' local maxima and spread over their band, the
    rest space-filling.

    The first start has all other parameters at their default, the others at half a prior standard
    deviation about it. With several frequencies which of their candidates meet is left to chance;
    `recombined` tries the rest. Of a moved record some begin at the muscle that its response alone
    asks for, `muscle_of_response` unless given.
    """
    coordinates = problem.coordinates
    theta = space_filling(len(coordinates.names), count)
    for number, name in enumerate(frequency_names(coordinates)):
        frequencies = frequencies_for(problem, name, count)
        if number:
            frequencies = np.random.default_rng(number).permutation(frequencies)
        theta[:, coordinates.names.index(name)] = coordinates.theta_of(name, frequencies)
    _spread_resonances(problem, theta)
    if any(part.points is not None for part in problem.parts):
        _spread_coefficients(problem, theta)
        muscle = muscle_of_response(problem) if muscle is None else muscle
        return _on_response(problem, coordinates.from_theta(theta), muscle)
    return coordinates.from_theta(theta)


def continued(
    problem: FitProblem,
    count: int,
    known: Mapping[str, float],
    muscle: Mapping[str, float] | None = None,
) -> Float[np.ndarray, "starts free"]:
    """Starts of a further model: in two thirds of them what it shares with another one begins where
    that ended (`known`), but for those at peaks. `muscle` as in `starting_points`.

    In the third of them a narrow resonance stands for its harmonic.
    """
    c = problem.coordinates
    points = np.array(c.theta(starting_points(problem, count, muscle)))
    rows = np.flatnonzero(np.array(kinds_of_starts(problem, count, continued=True)) == OTHER_MODEL)
    for column, name in enumerate(c.names):
        if name in known and c.positive[column]:
            points[rows, column] = c.theta_of(name, known[name])
    for name in resonance_names(c) if len(rows) > 1 else ():
        line = known.get(name.replace("resonance", "harmonic"), 0.0)
        if "_2_" not in name and line > 0 and _inside(c, name, np.array([line]))[0]:
            points[rows[1], c.names.index(name)] = c.theta_of(name, line)
            width = name.replace("frequency", "width")
            if width in c.names:
                points[rows[1], c.names.index(width)] = c.theta_of(width, NARROW)
    return c.from_theta(points)


def kinds_of_starts(problem: FitProblem, count: int, *, continued: bool = False) -> tuple[str, ...]:
    """How each start was chosen: at a peak, by the measured response, where another model ended,
    or spread."""
    rows, names = np.arange(count), problem.coordinates.names
    kinds = np.full(count, SPREAD, dtype=object)
    if resonance_names(problem.coordinates):
        kinds[rows % 4 == PEAKED] = PEAK
    elif frequency_names(problem.coordinates):
        kinds[rows < count // 2] = PEAK
    elif count:
        kinds[0] = OWN
    if continued:
        # the rest, of all kinds, may contradict these
        at_peaks = (kinds == PEAK) & bool(resonance_names(problem.coordinates))
        kinds[(rows % 3 != 2) & ~at_peaks] = OTHER_MODEL
    answers = any(name.partition("@")[0] in RESPONSE for name in names)
    if problem.control and answers and any(part.points is not None for part in problem.parts):
        kinds[_answering_rows(count)] = ANSWER
    return tuple(kinds)


def resonance_names(coordinates: Coordinates) -> list[str]:
    """The free frequencies of resonances; in a joint fit targets may have one each."""
    return [
        name
        for name in coordinates.names
        if name.partition("@")[0] in ("resonance_frequency", "resonance_2_frequency")
    ]


def _inside(
    c: Coordinates, name: str, frequency: Float[np.ndarray, " frequencies"]
) -> Bool[np.ndarray, " frequencies"]:
    """Which frequencies lie within the bounds of a parameter."""
    i, theta = c.names.index(name), c.theta_of(name, frequency)
    return (theta > c.low[i]) & (theta < c.high[i])


def _spread_resonances(problem: FitProblem, theta: Float[np.ndarray, "starts free"]) -> None:
    """Of every four starts one has each resonance at candidates of the target, and one at what
    stands out of its spectrum.

    The latter have a resonance as wide as the peak, in turn of a few heights, and every other one
    the default muscle, which damps, over a low floor. A peak that is high above a low floor is far
    from the default in several parameters at once: no other start lies there.
    """
    c, rows = problem.coordinates, np.arange(1, len(theta), 4)
    for number, name in enumerate(resonance_names(c)):
        found = frequencies_for(problem, name, len(theta))
        found = found[_inside(c, name, found)]
        if len(found):
            spread = np.random.default_rng(number).permutation(np.resize(found, len(rows)))
            theta[rows, c.names.index(name)] = c.theta_of(name, spread)
    rows = np.arange(PEAKED, len(theta), 4)
    peaks = {name: _peaks_of(problem, name) for name in resonance_names(c)}
    if not len(rows) or not any(peaks.values()):
        return
    most, turn = max(map(len, peaks.values())), np.arange(len(rows))
    still = rows[(turn // most) % 2 == 0]
    theta[still] = 0.0
    for column, name in enumerate(c.names):
        if name.partition("@")[0] == "noise_K_z":
            theta[still, column] = -1 / c.sd[column]
    for name, each in peaks.items():
        if not each:
            continue
        frequency, width = np.array(each)[turn % len(each)].T
        height = np.resize(HEIGHTS, len(rows) * len(each))[turn // len(each)]
        own = {"frequency": frequency, "width": width, "amplitude": height}
        for what, values in own.items():
            if (key := name.replace("frequency", what)) in c.names:
                theta[rows, c.names.index(key)] = c.theta_of(key, values)


def _peaks_of(problem: FitProblem, name: str) -> list[tuple[float, float]]:
    """Frequency and width [Hz] of what stands out of the spectra within the bounds of a resonance,
    whether or not it is significant: the tremor that is measured (over more bins than are
    compared), then the clearest hills of the bins, if these can be tested."""
    c, found = problem.coordinates, []
    column = c.names.index(name)
    low, high = c.centre[column] * np.exp(c.sd[column] * np.array([c.low[column], c.high[column]]))
    for target in (part.target for part in problem.acting(name)):
        seen = target.measured.get("tremor_frequency")
        if seen is not None and low < seen.value < high:
            found.append((seen.value, WIDE))
        band = max(float(low), SLOWEST), min(float(high), float(target.frequency[-1]))
        if can_be_tested(target, band):
            given = target.proportional_power, target.settings, target.segments or (), band
            found += [(hill.frequency, hill.width) for hill in find_peaks(*given, level=1.0).peaks]
    return [(f, width) for f, width in found if low < f < high]


def _spread_coefficients(problem: FitProblem, theta: Float[np.ndarray, "starts free"]) -> None:
    """Every other start has stiffness and damping up to `RANGE` times larger or smaller than by
    default.

    A dynamic stiffness knows both, wherever they are: a person may well be ten times softer than
    the default muscle of the same force, and from there a search finds its way only if it begins at
    the right order of magnitude.
    """
    names, rows = problem.coordinates.names, np.arange(1, len(theta), 2)
    factors = math.log(RANGE) * (2 * halton(2, len(rows)) - 1)
    for pair, factor in zip((("k_w", "k_z"), ("c_w", "c_z")), factors.T, strict=True):
        for column in (i for i, name in enumerate(names) if name.partition("@")[0] in pair):
            theta[rows, column] += factor / problem.coordinates.sd[column]


def _on_response(
    problem: FitProblem, points: Float[np.ndarray, "starts free"], muscle: Mapping[str, float]
) -> Float[np.ndarray, "starts free"]:
    """Some of the starts are found in two steps: the muscle by its response alone, then what makes
    it fluctuate.

    The fluctuations may have another origin than the model says. Then they pull a search that fits
    both at once into a muscle that does neither. So every other start of the last third begins
    where the dynamic stiffness alone is fitted best, and where beside this muscle the fluctuations
    are.
    """
    rows, c = _answering_rows(len(points)), problem.coordinates
    if not len(rows) or not muscle:
        return points
    answers, theta = np.isin(c.names, list(muscle)), np.zeros((1, len(c.names)))
    for name in itertools.compress(c.names, answers):
        theta[:, c.names.index(name)] = c.theta_of(name, muscle[name])
    points, objective = points.copy(), problem.linear()
    points[np.ix_(rows, answers)] = c.from_theta(theta)[0, answers]
    held = dataclasses.replace(objective, moving=np.where(answers, 0.0, objective.moving))
    beside = least_squares(held, points[rows], STEPS)
    points[rows] = np.where(np.isfinite(beside.cost)[:, None], beside.s, points[rows])
    return points


def _answering_rows(count: int) -> Int[np.ndarray, " rows"]:
    return np.arange(2 * count // 3, count)[::2][:MOST]


def muscle_of_response(problem: FitProblem) -> dict[str, float]:
    """Values of the muscle with which the dynamic stiffness alone is fitted best, of some searches
    and, unless these agree, of more; the first begins at `muscle_in_series`. Nothing where no
    insertion was moved, and of an own muscle, of which nobody knows which parameters answer.

    It does not depend on what makes the muscle fluctuate: models that differ in that share it.
    """
    c = problem.coordinates
    answers = np.isin([name.partition("@")[0] for name in c.names], RESPONSE)
    moved = any(part.points is not None for part in problem.parts)
    if not (moved and problem.control and np.any(answers)):
        return {}
    spread = np.zeros((2 * sum(SEARCHES), len(c.names)))
    _spread_coefficients(problem, spread)
    spread = spread[1::2]
    for part in problem.parts:
        for name, value in muscle_in_series(part, part.task).items():
            if name in c.names:
                spread[0, c.names.index(name)] = c.theta_of(name, value)
    starts, objective = c.from_theta(spread), _without_spectra(problem.linear(), answers)
    blind = tuple(map(_blind, objective.data))
    ends, cost = np.zeros((0, starts.shape[1])), np.zeros(0)
    for some in np.split(starts, np.cumsum(SEARCHES)[:-1]):
        found = least_squares(objective, some, STEPS, data=for_all(blind, len(some)), margin=BEHIND)
        ends, cost = (
            np.concatenate([ends, found.s]),
            np.append(cost, np.where(np.isfinite(found.cost), found.cost, np.inf)),
        )
        if np.sum(cost < np.min(cost) + SAME) >= AGREEING:
            break
    if not np.isfinite(np.min(cost)):
        return {}
    values = c.values_of(np.asarray(c.theta(ends[[np.argmin(cost)]])))[0]
    return {name: float(values[i]) for i, name in enumerate(c.names) if answers[i]}


def _without_spectra(objective: Residuals, answers: Bool[np.ndarray, " free"]) -> Residuals:
    """The same for data that are `_blind`, with nothing moving but what answers."""
    parts = (
        dataclasses.replace(part, model=dataclasses.replace(part.model, spectral=False))
        for part in objective.parts
    )
    moving = np.where(answers, objective.moving, 0.0)
    return dataclasses.replace(objective, parts=tuple(parts), moving=moving)


def _blind(data: Data) -> Data:
    """The same of a target whose spectrum does not count, nor how large the fluctuations are."""
    sd = np.full_like(data.sd, UNKNOWN)
    variation = None if data.variation is None else (data.variation[0], np.asarray(UNKNOWN))
    return dataclasses.replace(data, sd=sd, variation=variation)


def frequencies_for(problem: FitProblem, name: str, count: int) -> Float[np.ndarray, " starts"]:
    """Candidates of the target that a harmonic frequency acts on; of several targets in turn, then
    over their band."""
    targets = [part.target for part in problem.acting(name)]
    if len(problem.parts) == 1:
        return candidate_frequencies(targets[0], count)
    each = [candidate_frequencies(target, -(-count // len(targets))) for target in targets]
    low, high = (
        edge(target.frequency[i] for target in targets) for edge, i in ((min, 0), (max, -1))
    )
    found = np.concatenate([np.stack(each, axis=1).ravel(), np.geomspace(low, high, 2 * count)])
    _, first = np.unique(np.round(np.log(found), 3), return_index=True)
    return found[np.sort(first)[:count]]


def recombined(
    problem: FitProblem, theta: Float[np.ndarray, " free"], count: int
) -> list[Float[np.ndarray, "starts free"]]:
    """Where several harmonic frequencies are free: further starts, a point with each of them in
    turn at its candidates."""
    coordinates = problem.coordinates
    names, found = frequency_names(coordinates), []
    for name in names if len(names) > 1 else ():
        points = np.tile(theta, (count, 1))
        points[:, coordinates.names.index(name)] = coordinates.theta_of(
            name, frequencies_for(problem, name, count)
        )
        strength = f"harmonic_amplitude@{name.partition('@')[2]}"
        if strength in coordinates.names:  # else a harmonic that had vanished would stay so
            points[:, coordinates.names.index(strength)] = 0.0
        found.append(coordinates.from_theta(points))
    return found


def space_filling(size: int, count: int) -> Float[np.ndarray, "count size"]:
    """θ = 0, then a Halton design with half a prior standard deviation about it."""
    theta = 0.5 * ndtri(np.clip(halton(size, count), 0.02, 0.98))
    theta[0] = 0.0
    return theta


def halton(size: int, count: int) -> Float[np.ndarray, "count size"]:
    """Scrambled Halton points in the unit cube (Owen 2017, arXiv:1706.02808).

    Those of `scipy.stats.qmc.Halton(size, rng=0)`, for which a fit would wait half a second: that
    is how long scipy.stats takes to import.
    """
    (rng,) = np.random.default_rng(0).spawn(1)
    points = np.zeros((count, size))
    for column, prime in enumerate(itertools.islice(filter(_is_prime, itertools.count(2)), size)):
        rest, weight = np.arange(count), 1 / prime
        for _ in range(math.ceil(54 / math.log2(prime)) - 1):
            points[:, column] += rng.permutation(prime)[rest % prime] * weight
            rest, weight = rest // prime, weight / prime
    return points


def _is_prime(number: int) -> bool:
    return all(number % smaller for smaller in range(2, number))


def frequency_names(coordinates: Coordinates) -> list[str]:
    """The free harmonic frequencies; in a joint fit targets may have one each, called
    "harmonic_frequency@target"."""
    return [name for name in coordinates.names if name.partition("@")[0] == "harmonic_frequency"]


def amplitude_columns(names: tuple[str, ...], frequency: str) -> list[int]:
    """Where among the names the amplitude stands that goes with a harmonic frequency."""
    own = "harmonic_amplitude", frequency.replace("frequency", "amplitude")
    return [i for i, name in enumerate(names) if name in own]


def contenders(problem: FitProblem, minima: Minima, margin: float) -> list[int]:
    """The best start, then those whose cost is at most `margin` above it at another harmonic
    frequency, best first.

    Frequencies differ when no nearer than one bin: a Welch peak is two bins wide, so these are
    different minima. Where several are free, one that differs is enough.
    """
    theta = np.asarray(problem.coordinates.theta(minima.s))
    return distinct(problem, minima.cost, theta, problem.finest.settings.resolution, margin)


def distinct(
    problem: FitProblem,
    cost: Float[np.ndarray, " rows"],
    theta: Float[np.ndarray, "rows free"],
    width: float,
    margin: float,
    most: int | None = None,
    names: list[str] | None = None,
) -> list[int]:
    """The lowest row, then those at most `margin` above it and, in a harmonic frequency, at least
    `width` from all others.

    `names` of the frequencies, all that are free unless given.
    """
    cost = np.where(np.isfinite(cost), cost, np.inf)
    chosen = [int(np.argmin(cost))]
    names = frequency_names(problem.coordinates) if names is None else names
    if not names:
        return chosen
    frequency = np.stack([harmonic_frequencies(problem, theta, name) for name in names], axis=1)
    for i in np.argsort(cost, kind="stable"):
        near = np.min(np.max(np.abs(frequency[i] - frequency[chosen]), axis=1)) < width
        if (
            cost[i] <= cost[chosen[0]] + margin
            and not near
            and (most is None or len(chosen) < most)
        ):
            chosen.append(int(i))
    return chosen


def harmonic_frequencies(
    problem: FitProblem, theta: Float[np.ndarray, "rows free"], name: str = "harmonic_frequency"
) -> Float[np.ndarray, " rows"]:
    """Harmonic frequency of every row [Hz]."""
    column = problem.coordinates.names.index(name)
    return problem.coordinates.values_of(theta)[:, column]


def candidate_frequencies(target: Target, count: int) -> Float[np.ndarray, " starts"]:
    """The target's local maxima, highest above their neighbours first, and a quarter bin beside
    each; then the band.

    Of more maxima than `MAXIMA` (narrow bins) each is tried before any has others beside it.

    A maximum is the vertex of the parabola through the log powers of three bins: a line that is
    narrower than a bin is found from nearby, but not from a bin away.
    """
    f, p = np.asarray(target.frequency), np.log(np.asarray(target.proportional_power))
    inner = np.flatnonzero((p[1:-1] > p[:-2]) & (p[1:-1] > p[2:])) + 1
    bend = 2 * p[inner] - p[inner - 1] - p[inner + 1]
    inner, bend = inner[np.argsort(-bend)], np.sort(bend)[::-1]
    peaks = f[inner] + 0.25 * (f[inner + 1] - f[inner - 1]) * (p[inner + 1] - p[inner - 1]) / bend
    width = target.settings.rate / target.settings.length
    near = np.clip(peaks[:, None] + width * np.array([0.0, -0.25, 0.25]), f[0], f[-1])
    near = (near.T if len(peaks) > MAXIMA else near).ravel()
    spread = np.geomspace(f[0], f[-1], max(count, 2))
    order = np.argsort([-np.min(np.abs(np.log(s / np.append(peaks, 1e9)))) for s in spread])
    return np.concatenate([near[: max(1, count // 2)], spread[order], near[max(1, count // 2) :]])[
        :count
    ]


FREQUENCIES, MAXIMA = 32, 16


def points_about(problem: FitProblem, theta: np.ndarray) -> np.ndarray:
    """A point with each harmonic frequency as it is and at its targets' local maxima and over the
    band, amplitude free."""
    names, found = problem.coordinates.names, [theta[None]]
    for name in frequency_names(problem.coordinates):
        points = np.tile(theta, (FREQUENCIES - 1, 1))
        points[:, names.index(name)] = problem.coordinates.theta_of(
            name, frequencies_for(problem, name, FREQUENCIES - 1)
        )
        points[np.ix_(range(0, len(points), 2), amplitude_columns(names, name))] = 0.0
        found.append(points)
    return np.concatenate(found)
