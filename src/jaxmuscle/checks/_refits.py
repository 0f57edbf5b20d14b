"""Data drawn from a fit, and each set of them fitted by the whole nonlinear descent, all in one
batch."""

from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxmuscle.fits._result import FitResult
from jaxmuscle.objective._consequences import expand
from jaxmuscle.objective._least_squares import least_squares
from jaxmuscle.objective._likelihood import Likelihood, drawn_spectra, repeated
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Data, Residuals
from jaxmuscle.objective._starts import frequency_names
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._bin_law import bin_statistics

Rows = Float[np.ndarray, "rows bins"]
ELSEWHERE = 3
LINE_SHAPE = np.array([0.25, 1.0, 0.25])


class Drawn(NamedTuple):
    """Of every part: spectra drawn from the fit, what they scatter about, and their further data
    (None without)."""

    power: tuple[Rows, ...]
    expected: tuple[Float[np.ndarray, " bins"], ...]
    variation: tuple[Any, ...]
    mean: tuple[Any, ...]
    stiffness: tuple[Any, ...]


class Refits(NamedTuple):
    """Where every drawn set's fit ended; of every part the `expected` proportional power, the
    `share` of the line, and the `stiffness` at the points of a measured one, real and imaginary
    part along the second axis."""

    theta: Float[np.ndarray, "rows free"]
    cost: Float[np.ndarray, " rows"]
    expected: tuple[Rows, ...]
    share: tuple[Rows, ...]
    stiffness: tuple[Any, ...]


def drawn_about(
    problem: FitProblem, result: FitResult, count: int
) -> tuple[Drawn, tuple[Moments, ...]]:
    moments = repeated(problem, tuple(result.tasks.values()), count)
    found = []
    for i, (part, bins, seen) in enumerate(
        zip(problem.parts, Likelihood.of(problem).bins, moments, strict=True)
    ):
        key = jax.random.fold_in(problem.key, 21)
        key = jax.random.fold_in(key, i) if i else key
        keys = jax.random.split(key, 3)

        def scattered(given: Any, values: np.ndarray, key: Array) -> Any:
            if given is None:
                return None
            return values + given[1] * np.asarray(jax.random.normal(key, (count,))), np.full(
                count, float(given[1])
            )

        power = drawn_spectra(bins, part.target, seen, keys[0])
        variation = scattered(part.variation, np.log(seen.variation), keys[1])
        mean = scattered(part.mean, np.asarray(seen.mean), keys[2])
        stiffness = None
        if part.target.stiffness is not None:
            sd = np.tile(part.target.stiffness.known.stderr, (count, 1))
            normal = np.asarray(
                jax.random.normal(jax.random.fold_in(key, 3), np.shape(seen.stiffness))
            )
            stiffness = np.asarray(seen.stiffness) + sd[:, None] * normal, sd
        found.append((power, seen.power[0] / np.sum(seen.power[0]), variation, mean, stiffness))
    return Drawn(*zip(*found, strict=True)), moments


def refitted(problem: FitProblem, theta: Float[np.ndarray, " free"], drawn: Drawn) -> Refits:
    """Every drawn set fitted: all bins scattering alike first, then again with the line's share of
    each known."""
    objective, count = problem.linear(), len(drawn.power[0])
    starts = _starts(problem, theta, drawn)
    each = starts.shape[1]
    data = _data(problem, drawn, tuple(np.zeros_like(power) for power in drawn.power))
    first = least_squares(
        objective,
        problem.coordinates.from_theta(starts.reshape(count * each, -1)),
        40,
        data=jax.tree.map(lambda x: np.repeat(x, each, axis=0), data),
    )
    cost = np.where(np.isfinite(first.cost), first.cost, np.inf).reshape(count, each)
    s = first.s.reshape(count, each, -1)[np.arange(count), np.argmin(cost, axis=1)]
    share = _seen(objective, s)[1]
    second = least_squares(objective, s, 40, data=_data(problem, drawn, share))
    return Refits(np.asarray(objective.theta(second.s)), second.cost, *_seen(objective, second.s))


def _starts(
    problem: FitProblem, theta: np.ndarray, drawn: Drawn
) -> Float[np.ndarray, "rows starts free"]:
    """The fit's own values; and each harmonic, as strong as its prior has it, in the highest
    excesses of each spectrum."""
    c, count = problem.coordinates, len(drawn.power[0])
    starts = [np.broadcast_to(theta, (count, len(theta)))]
    for name in frequency_names(c):
        strengths = [
            i
            for i, n in enumerate(c.names)
            if n in ("harmonic_amplitude", name.replace("frequency", "amplitude"))
        ]
        for part, power, expected in zip(problem.parts, drawn.power, drawn.expected, strict=True):
            if c.names.index(name) not in part.columns:
                continue
            excess = np.log(power / expected)
            score = np.stack([np.convolve(row - row.mean(), LINE_SHAPE, "same") for row in excess])
            for _ in range(ELSEWHERE):
                best, points = np.argmax(score, axis=1), np.array(starts[0])
                points[:, c.names.index(name)] = c.theta_of(
                    name, np.asarray(part.target.frequency)[best]
                )
                points[:, strengths] = 0.0
                starts.append(points)
                score = np.where(
                    np.abs(np.arange(score.shape[1]) - best[:, None]) <= 1, -np.inf, score
                )
    return np.stack(starts, axis=1)


def _data(problem: FitProblem, drawn: Drawn, share: tuple[Rows, ...]) -> tuple[Data, ...]:
    made = []
    for i, part in enumerate(problem.parts):
        law = bin_statistics(part.target, share[i])
        made.append(
            Data(
                drawn.power[i],
                law.bias,
                law.sd,
                drawn.variation[i],
                drawn.mean[i],
                drawn.stiffness[i],
            )
        )
    return tuple(made)


def _seen(
    objective: Residuals, s: np.ndarray
) -> tuple[tuple[Rows, ...], tuple[Rows, ...], tuple[Any, ...]]:
    """Of every part, at every row of coordinates: proportional power, share of the line, dynamic
    stiffness."""
    moments = expand(objective, np.asarray(objective.theta(s))).moments
    power = [np.asarray(m.power) for m in moments]
    share = tuple(
        np.clip(np.nan_to_num(np.asarray(m.line) / p), 0.0, 1.0)
        for m, p in zip(moments, power, strict=True)
    )
    whole = tuple(p / p.sum(axis=1, keepdims=True) for p in power)
    return whole, share, tuple(np.asarray(m.stiffness) for m in moments)
