"""Is the harmonic there, and at which frequency? Profile of chi² over it, and a parametric
bootstrap without it."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxmuscle.model._parameters import HARMONIC
from jaxmuscle.objective._least_squares import Minima, least_squares
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals

from ._adequacy import Endpoint, drawn_log_residuals, generator_of
from ._checks import seen_best
from ._refit import lines_of, over_band, without_fitted

PROFILE = 64
STEPS = 40
ABSENT = 1e-6
SIGNIFICANT = 0.05
REPLICATES = 999


class HarmonicTest(NamedTuple):
    """`rise` of chi² above its minimum over `frequency` [Hz], all else fitted anew; p-value of the
    harmonic or None."""

    frequency: Float[np.ndarray, " frequencies"]
    rise: Float[np.ndarray, " frequencies"]
    p_value: float | None


def harmonic_test(
    problem: FitProblem, final: Minima, *, judged: bool = True
) -> HarmonicTest | None:
    """Profile and p-value in linear response; None for several targets, without one, or if the
    harmonic is not fitted.

    No p-value unless `judged`: about a model that does not describe the data anything improves the
    fit. All bins scatter here as if none held a line (see `bin_statistics`): else the best
    frequency would count for more.
    """
    names = problem.coordinates.names
    if len(problem.parts) > 1 or not problem.control or "harmonic_frequency" not in names:
        return None
    objective = problem.linear()
    problem.tell("trying other frequencies of the harmonic", 0.9)
    frequency, rise = _profile(problem, objective, final)
    if not judged or "harmonic_amplitude" not in names or not objective.parts[0].statistics.known:
        return HarmonicTest(frequency, rise, None)
    problem.tell("simulating spectra without a harmonic", 0.95)
    return HarmonicTest(frequency, rise, p_value(problem, objective, final))


def _pinned(objective: Residuals, columns: list[int]) -> Residuals:
    moving = np.ones(len(objective.coordinates.names))
    moving[columns] = 0.0
    return eqx.tree_at(lambda p: p.moving, objective, moving)


def _profile(
    problem: FitProblem, objective: Residuals, final: Minima
) -> tuple[np.ndarray, np.ndarray]:
    coordinates, column = problem.coordinates, problem.coordinates.names.index("harmonic_frequency")
    frequency = over_band(problem.parts[0].target, PROFILE)
    theta = np.tile(np.asarray(coordinates.theta(final.s[final.best])), (len(frequency), 1))
    theta[:, column] = coordinates.theta_of("harmonic_frequency", frequency)
    found = least_squares(_pinned(objective, [column]), coordinates.from_theta(theta), STEPS)
    best = least_squares(objective, final.s[[final.best]], STEPS)
    return frequency, 2 * (found.cost - min(np.nanmin(found.cost), best.cost[0]))


def p_value(problem: FitProblem, objective: Residuals, final: Minima) -> float:
    """Improvement of chi² by a harmonic of any frequency and strength, against that in spectra that
    have none.

    The model without harmonic is fitted; about it the other parameters are linear (`M` removes what
    they take up), a harmonic adds `ln(1 + g line_k(f) / power_k)` to the log powers, and the
    improvement is the largest over a grid of f and g. The same is done with spectra drawn from that
    model: scaled chi² bins, correlated as Welch's are.
    """
    names = problem.coordinates.names
    columns = [names.index(name) for name in HARMONIC]
    theta = np.array(problem.coordinates.theta(final.s))
    theta[:, columns[0]] = problem.coordinates.theta_of("harmonic_amplitude", ABSENT)
    objective = _pinned(objective, columns)
    without = least_squares(objective, problem.coordinates.from_theta(theta), STEPS)
    ended = Endpoint(problem, objective, seen_best(objective, without))
    return _p_of_line(ended, np.delete(np.arange(len(names)), columns))


def p_of_line_left_out(ended: Endpoint) -> float:
    """The same for a fit of a model without harmonic, of one target; 1 without a
    spectrum."""
    (part,) = ended.problem.parts
    if not len(part.target.bins) or not ended.objective.parts[0].statistics.known:
        return 1.0
    return _p_of_line(ended, np.arange(len(ended.problem.coordinates.names)))


def _p_of_line(ended: Endpoint, kept: Int[np.ndarray, " kept"]) -> float:
    """`p_value` at the fit without a harmonic; `kept`, the coordinates that are free in it."""
    problem, objective, here, found = ended.problem, ended.objective, ended.seen, ended.found
    null, own = here.moments[0], objective.parts[0]
    n, sd = len(problem.parts[0].target.bins), np.asarray(own.statistics.sd)
    residual = np.concatenate([found.residuals, (problem.prior_root @ here.theta)[kept]])
    jacobian = np.concatenate([found.jacobian[:, kept], problem.prior_root[np.ix_(kept, kept)]])
    (part,) = problem.parts
    task = part.task_at(here.theta).replace(harmonic_amplitude=ABSENT)
    tried = lines_of(part, task, np.asarray(null.power), float(part.target.frequency[-1]))
    added = np.zeros((len(tried.square), len(residual)))
    logs = np.log1p(tried.square[:, None] * tried.each / null.power)
    added[:, :n] = -(logs - logs.mean(axis=1, keepdims=True)) / sd
    if own.data.variation is not None:
        added[:, n] = (
            0.5 * np.log1p(tried.square / float(null.variance)) / float(own.data.variation[1])
        )
    left = added @ without_fitted(jacobian)
    size = np.sum(left**2, axis=1)

    def improvement(rows: np.ndarray) -> np.ndarray:
        return np.max(-2 * rows @ left.T - size, axis=1)

    generator = generator_of(problem, 3)
    noise = np.zeros((REPLICATES, len(residual)))
    noise[:, :n] = drawn_log_residuals(own, generator, REPLICATES)
    noise[:, n:] = generator.normal(size=noise[:, n:].shape)
    better = np.sum(improvement(noise) >= improvement(residual[None])[0])
    return float((1 + better) / (1 + REPLICATES))
