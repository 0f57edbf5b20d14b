"""Is the harmonic there, and at which frequency? Profile of chi² over it, and a parametric bootstrap without it."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.special import gammaincinv, ndtr

from jaxmuscle._common.keys import fold_in
from jaxmuscle.objective._consequences import consequences, expand
from jaxmuscle.objective._least_squares import Minima, least_squares
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.spectra._bin_law import bin_statistics

from ._checks import seen_best

PROFILE = 64
STEPS = 40
ABSENT = 1e-6
TEMPLATES = 128
STRENGTHS = np.geomspace(0.02, 20.0, 16)
REPLICATES = 999


class HarmonicTest(NamedTuple):
    """`rise` of chi² above its minimum over `frequency` [Hz], all else fitted anew; p-value of the harmonic or None."""

    frequency: Float[np.ndarray, " frequencies"]
    rise: Float[np.ndarray, " frequencies"]
    p_value: float | None


def harmonic_test(problem: FitProblem, final: Minima) -> HarmonicTest | None:
    """Profile and p-value in linear response; None for several targets, without one, or if the harmonic is not fitted.

    All bins scatter here as if none held a line (see `bin_statistics`): else the best frequency would count for more.
    """
    names = problem.coordinates.names
    if len(problem.parts) > 1 or not problem.control or "harmonic_frequency" not in names:
        return None
    objective = problem.linear()
    problem.tell("profile over frequency", 0.9)
    frequency, rise = _profile(problem, objective, final)
    if "harmonic_amplitude" not in names or problem.residual != "log" or not objective.parts[0].statistics.known:
        return HarmonicTest(frequency, rise, None)
    problem.tell("bootstrap without harmonic", 0.95)
    return HarmonicTest(frequency, rise, _p_value(problem, objective, final))


def _pinned(objective: Residuals, columns: list[int]) -> Residuals:
    moving = np.ones(len(objective.coordinates.names))
    moving[columns] = 0.0
    return eqx.tree_at(lambda p: p.moving, objective, moving)


def _profile(problem: FitProblem, objective: Residuals, final: Minima) -> tuple[np.ndarray, np.ndarray]:
    coordinates, column = problem.coordinates, problem.coordinates.names.index("harmonic_frequency")
    frequency = np.linspace(
        float(problem.parts[0].target.frequency[0]), float(problem.parts[0].target.frequency[-1]), PROFILE
    )
    theta = np.tile(np.asarray(coordinates.theta(final.s[final.best])), (PROFILE, 1))
    theta[:, column] = coordinates.theta_of("harmonic_frequency", frequency)
    found = least_squares(_pinned(objective, [column]), coordinates.from_theta(theta), STEPS)
    best = least_squares(objective, final.s[[final.best]], STEPS)
    return frequency, 2 * (found.cost - min(np.nanmin(found.cost), best.cost[0]))


def _p_value(problem: FitProblem, objective: Residuals, final: Minima) -> float:
    """Improvement of chi² by a harmonic of any frequency and strength, against that in spectra that have none.

    The model without harmonic is fitted; about it the other parameters are linear (`M` removes what they take up), a
    harmonic adds `ln(1 + g line_k(f) / power_k)` to the log powers, and the improvement is the largest over a grid of f
    and g. The same is done with spectra drawn from that model: scaled chi² bins, correlated as Welch's are.
    """
    names = problem.coordinates.names
    columns = [names.index(name) for name in ("harmonic_amplitude", "harmonic_frequency")]
    theta = np.array(problem.coordinates.theta(final.s))
    theta[:, columns[0]] = problem.coordinates.theta_of("harmonic_amplitude", ABSENT)
    objective = _pinned(objective, columns)
    without = least_squares(objective, problem.coordinates.from_theta(theta), STEPS)
    here = seen_best(objective, without)
    found = consequences(objective, here)
    null, theta = here.moments[0], np.tile(here.theta, (TEMPLATES, 1))
    frequencies = np.linspace(
        float(problem.parts[0].target.frequency[0]), float(problem.parts[0].target.frequency[-1]), TEMPLATES
    )
    theta[:, columns] = np.stack(
        [np.zeros(TEMPLATES), problem.coordinates.theta_of("harmonic_frequency", frequencies)], axis=1
    )
    lines = expand(objective, theta).moments[0]
    n, sd = len(problem.parts[0].target.bins), np.asarray(objective.parts[0].statistics.sd)
    kept = np.delete(np.arange(len(names)), columns)
    residual = np.concatenate([found.residuals, np.sqrt(problem.prior[kept]) * here.theta[kept]])
    jacobian = np.concatenate([found.jacobian[:, kept], np.diag(np.sqrt(problem.prior[kept]))])

    strength = lines.line / null.power
    strength = STRENGTHS[:, None, None] * (strength / strength.max(axis=1, keepdims=True))
    added = np.zeros((STRENGTHS.size * TEMPLATES, len(residual)))
    logs = np.log1p(strength).reshape(-1, n)
    added[:, :n] = -(logs - logs.mean(axis=1, keepdims=True)) / sd
    if objective.data[0].variation is not None:
        swing = (lines.variance / null.variance - 1) / (lines.line / null.power).max(axis=1)
        added[:, n] = 0.5 * np.log1p(STRENGTHS[:, None] * swing).reshape(-1) / float(objective.data[0].variation[1])
    basis = np.linalg.svd(jacobian, full_matrices=False)
    u = basis[0][:, basis[1] > 1e-9 * basis[1].max()]
    left = added - (added @ u) @ u.T
    size = np.sum(left**2, axis=1)

    def improvement(rows: np.ndarray) -> np.ndarray:
        return np.max(-2 * rows @ left.T - size, axis=1)

    noise = np.zeros((REPLICATES, len(residual)))
    noise[:, :n] = _scatter(problem, n)
    if objective.data[0].variation is not None:
        noise[:, n] = _generator(problem, 4).normal(size=REPLICATES)
    better = np.sum(improvement(noise) >= improvement(residual[None])[0])
    return float((1 + better) / (1 + REPLICATES))


def _generator(problem: FitProblem, number: int) -> np.random.Generator:
    return np.random.default_rng(np.asarray(jax.random.key_data(fold_in(problem.key, number))))


def _scatter(problem: FitProblem, n: int) -> np.ndarray:
    """Log residuals of spectra without harmonic, scattering about their expectation."""
    (target,) = (part.target for part in problem.parts)
    law = bin_statistics(target)
    normal = _generator(problem, 3).multivariate_normal(np.zeros(n), law.correlation, size=REPLICATES, method="cholesky")
    z = normal * law.sd
    if target.segments is not None:
        z = np.log(gammaincinv(law.half, ndtr(normal)) / law.half) - law.bias
    return (z - z.mean(axis=1, keepdims=True)) / law.sd
