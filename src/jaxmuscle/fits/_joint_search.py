"""The search of a joint fit: starts at all targets' local maxima, the best minima, the nonlinear correction."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle.objective._arguments import target_of
from jaxmuscle.objective._consequences import BATCH
from jaxmuscle.objective._least_squares import Descent, descend
from jaxmuscle.objective._starts import candidate_frequencies, contenders, frequency_names, space_filling
from jaxmuscle.response._expected import Moments

from ._checks import seen_best
from ._joint_problem import JointProblem, JointSetup
from ._joint_report import report_joint
from ._joint_result import JointResult
from ._search import POLISHES, RIVAL_MARGIN, STILL, correction_at


class JointPlan(NamedTuple):
    """A joint fit to be done."""

    setup: JointSetup
    starts: int
    seeds: int
    max_steps: int
    settings: dict[str, Any]
    seed: int | None


def search_jointly(plan: JointPlan) -> JointResult:
    """From the starting points to a result."""
    setup, most = plan.setup, plan.max_steps
    setup.tell("compiling", 0.0)
    problem = setup.linear()
    first = _stage(setup, problem, joint_starts(setup, plan.starts), most, "trying starts", (0.05, 0.5))
    first = _recombined(setup, problem, first, plan)
    if not np.isfinite(first.cost[first.best]):
        return report_joint(setup, problem, first, first, plan.settings, plan.seed, most, {})
    best = first.s[contenders(setup.coordinates, setup.finest, first, RIVAL_MARGIN)[:BATCH]]
    setup = setup.scattering_as(first.s[first.best])
    shares = [np.clip(np.nan_to_num(m.line / m.power), 0.0, 1.0) for m in seen_best(problem, first).moments]
    problem = setup.linear(shares)
    found = _stage(setup, problem, best, most, "linear response", (0.6, 0.7))
    problem, found, check = _polished(setup, shares, problem, found, plan)
    setup.tell("done", 1.0)
    return report_joint(setup, problem, first, found, plan.settings, plan.seed, most, check)


def joint_starts(setup: JointSetup, count: int) -> Float[np.ndarray, "starts free"]:
    """Starts as those of a fit; a harmonic frequency in turn at the candidates of each target that it acts on."""
    coordinates = setup.coordinates
    theta = space_filling(len(coordinates.names), count)
    for number, name in enumerate(frequency_names(coordinates)):
        frequencies = _candidates(setup, name, count)
        if number:  # which of them meet is left to chance; `_recombined` tries the rest
            frequencies = np.random.default_rng(number).permutation(frequencies)
        theta[:, coordinates.names.index(name)] = coordinates.theta_of(name, frequencies)
    return coordinates.from_theta(theta)


def _candidates(setup: JointSetup, name: str, count: int) -> Float[np.ndarray, " starts"]:
    """The candidates of each target that a harmonic frequency acts on, in turn, then over the band."""
    column = setup.coordinates.names.index(name)
    targets = [s.target for s, columns in zip(setup.setups.values(), setup.columns, strict=True) if column in columns]
    each = [candidate_frequencies(target, -(-count // len(targets))) for target in targets]
    low, high = (edge(target.frequency[i] for target in targets) for edge, i in ((min, 0), (max, -1)))
    found = np.concatenate([np.stack(each, axis=1).ravel(), np.geomspace(low, high, 2 * count)])
    _, first = np.unique(np.round(np.log(found), 3), return_index=True)
    return found[np.sort(first)[:count]]


def _stage(
    setup: JointSetup, problem: JointProblem, points: np.ndarray, most: int, name: str, shares: tuple[float, float]
) -> Descent:
    def show(descent: Descent) -> None:
        done = min(1.0, descent.steps.max() / most)
        setup.tell(f"{name}, cost {descent.cost[descent.best]:.2f}", shares[0] + (shares[1] - shares[0]) * done)

    return descend(problem, points, most, report=show)


def _recombined(setup: JointSetup, problem: JointProblem, found: Descent, plan: JointPlan) -> Descent:
    """Where several harmonic frequencies are free: the best point with each of them in turn at its candidates."""
    coordinates = setup.coordinates
    names = frequency_names(coordinates)
    for name in names if len(names) > 1 else ():
        if not np.isfinite(found.cost[found.best]):
            break
        theta = np.tile(np.asarray(coordinates.theta(found.s[found.best])), (plan.starts, 1))
        theta[:, coordinates.names.index(name)] = coordinates.theta_of(name, _candidates(setup, name, plan.starts))
        strength = f"harmonic_amplitude@{target_of(name)}"
        if strength in coordinates.names:  # else a harmonic that had vanished would stay so
            theta[:, coordinates.names.index(strength)] = 0.0
        more = _stage(setup, problem, coordinates.from_theta(theta), plan.max_steps, "recombining", (0.5, 0.6))
        found = Descent(*map(np.concatenate, zip(found, more, strict=True)))
    return found


def _polished(
    setup: JointSetup, shares: list[np.ndarray], problem: JointProblem, found: Descent, plan: JointPlan
) -> tuple[JointProblem, Descent, dict[str, float]]:
    """The fit repeated with the linear response times the nonlinear model's correction until that stays.

    Also how far simulation and linear response are apart for each target: the largest deviation of a bin.
    """
    corrections: list[Moments] | None = None
    for _ in range(POLISHES if plan.seeds else 0):
        if not np.isfinite(found.cost[found.best]):
            break
        theta = np.asarray(problem.theta(found.s[found.best]))
        new = [correction_at(s, setup.theta_of_part(theta, i)) for i, s in enumerate(setup.setups.values())]
        if any(c is None for c in new):
            break
        old, corrections = corrections, [c for c in new if c is not None]
        if old is not None and max(np.max(np.abs(np.log(a.power / b.power)))
                                   for a, b in zip(corrections, old, strict=True)) < STILL:  # fmt: skip
            break
        problem = setup.linear(shares, corrections)
        found = _stage(setup, problem, found.s, plan.max_steps, "polishing", (0.7, 0.9))
    if corrections is None:
        return problem, found, {}
    apart = (float(np.max(np.abs(c.power - 1))) for c in corrections)
    return problem, found, dict(zip(setup.setups, apart, strict=True))
