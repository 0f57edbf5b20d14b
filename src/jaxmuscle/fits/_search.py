"""The search of a fit: many starts, the best minima polished, whatever was reached when interrupted."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arrays import as_arrays, as_numbers
from jaxmuscle._common.errors import SimulationError
from jaxmuscle.ensembles._ensemble import ensemble
from jaxmuscle.objective._arguments import Plan
from jaxmuscle.objective._consequences import BATCH
from jaxmuscle.objective._least_squares import Descent, descend
from jaxmuscle.objective._problem import Problem, Setup
from jaxmuscle.objective._starts import contenders, starting_points
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._linearised import settled

from ._checks import Stage, controlled_moments, seen_best
from ._report import report_fit
from ._result import FitResult

FIRST_STEPS = 12
MOST_RIVALS = 3
RIVAL_MARGIN = 6.0
POLISHES = 4
STILL = 2e-3


class FitInterrupted(KeyboardInterrupt):
    """A fit was interrupted; `result` holds what had been reached."""

    def __init__(self, result: FitResult):
        super().__init__("fit interrupted")
        self.result = result


def search(plan: Plan) -> FitResult:
    """From the starting points to a result; Ctrl-C ends it with what had been reached."""
    setup = plan.setup
    points = starting_points(setup.coordinates, setup.target, plan.starts)
    stages: list[Stage] = []
    interrupted = False
    try:
        setup.tell("compiling", 0.0)
        (_linear if setup.method == "linear" else _montecarlo)(setup, points, plan.max_steps, stages)
    except KeyboardInterrupt:
        interrupted = True
    if not stages:
        raise KeyboardInterrupt("fit interrupted before its first step")
    setup.tell("checking on fresh seeds", 0.8)
    result = _reported(plan, stages, plan.check_seeds, interrupted=interrupted)
    setup.tell("done", 1.0)
    if interrupted:
        raise FitInterrupted(result)
    return result


def _reported(plan: Plan, stages: list[Stage], check_seeds: int, *, interrupted: bool = False) -> FitResult:
    return report_fit(plan.setup, stages, check_seeds, plan.settings, plan.seed, plan.max_steps, interrupted=interrupted)


def search_together(plans: list[Plan], tell: Callable[[str, float], None]) -> list[FitResult]:
    """Fits of one model to several targets on the same bins, all starts of all targets in one descent.

    Linear response alone: no nonlinear correction, no check on simulated seeds, no profile over the frequency.
    """
    setups = [plan.setup for plan in plans]
    points = [starting_points(plan.setup.coordinates, plan.setup.target, plan.starts) for plan in plans]
    first = _together([setup.linear() for setup in setups], points, plans[0].max_steps, "trying starts", tell, (0.0, 0.7))
    best = [stage.descent.s[contenders(s.coordinates, s.target, stage.descent, RIVAL_MARGIN)[:BATCH]]
            for s, stage in zip(setups, first, strict=True)]  # fmt: skip
    problems = [_known(setup, stage.problem, stage.descent) for setup, stage in zip(setups, first, strict=True)]
    problems = [setup.linear(share) for setup, share in problems]
    second = _together(problems, best, plans[0].max_steps, "linear response", tell, (0.7, 0.8))
    results = []
    for plan, *stages in zip(plans, first, second, strict=True):
        unused = plan.settings | {"seeds": 0, "check_seeds": 0}
        results.append(_reported(plan._replace(settings=unused), stages, 0))
        tell(f"reporting {plan.setup.target.name}", 0.8 + 0.2 * len(results) / len(plans))
    return results


def _together(
    problems: list[Problem],
    points: list[np.ndarray],
    max_steps: int,
    name: str,
    tell: Callable[[str, float], None],
    shares: tuple[float, float],
) -> list[Stage]:
    """One stage of every problem; they differ in their data only."""
    counts = [len(p) for p in points]
    data = jax.tree.map(lambda *x: np.repeat(np.stack(x), counts, axis=0), *(problem.data for problem in problems))

    def show(descent: Descent) -> None:
        share = min(1.0, descent.steps.max() / max_steps)
        tell(name, shares[0] + (shares[1] - shares[0]) * share)

    found = descend(problems[0], np.concatenate(points), max_steps, data=data, report=show)
    parts = zip(*(np.split(x, np.cumsum(counts)[:-1]) for x in found), strict=True)
    return [Stage(name, problem, Descent(*part)) for problem, part in zip(problems, parts, strict=True)]


def _stage(setup: Setup, stages: list[Stage], problem: Problem, name: str, shares: tuple[float, float], most: int) -> Any:
    """A new stage, and what keeps its newest descent and tells the progress."""
    number = len(stages)

    def show(descent):
        stages[number:] = [Stage(name, problem, descent)]
        share = shares[0] + (shares[1] - shares[0]) * min(1.0, descent.steps.max() / most)
        setup.tell(f"{name}, cost {descent.cost[descent.best]:.2f}", share)

    return show


def _linear(setup: Setup, points: np.ndarray, max_steps: int, stages: list[Stage]) -> None:
    """All starts in linear response, the best of them with the line's share known, then the nonlinear correction."""
    problem = setup.linear()
    show = _stage(setup, stages, problem, "trying starts", (0.05, 0.5), max_steps)
    first = descend(problem, points, max_steps, report=show)
    if not np.isfinite(first.cost[first.best]):
        return
    best = first.s[contenders(setup.coordinates, setup.target, first, RIVAL_MARGIN)[:BATCH]]
    setup, share = _known(setup, problem, first)
    problem = setup.linear(share)
    show = _stage(setup, stages, problem, "linear response", (0.5, 0.6), 15)
    found = descend(problem, best, max_steps, report=show)
    correction = None
    for turn in range(POLISHES):
        if not np.isfinite(found.cost[found.best]):
            return
        new = correction_at(setup, np.asarray(setup.coordinates.theta(found.s[found.best])))
        if new is None:
            return
        change = np.inf if correction is None else np.max(np.abs(np.log(new.power / correction.power)))
        if change < STILL:
            return
        correction, problem = new, setup.linear(share, new)
        show = _stage(setup, stages, problem, "polishing", (0.6 + 0.05 * turn, 0.65 + 0.05 * turn), 15)
        found = descend(problem, found.s, max_steps, report=show)


def correction_at(setup: Setup, theta: Float[np.ndarray, " free"]) -> Moments | None:
    """Moments of the nonlinear model over those of the linear response at θ; None if it cannot be simulated."""
    task = setup.at(theta)
    try:
        runs = ensemble(as_numbers(settled(as_arrays(task))), jax.random.fold_in(setup.key, 2), seeds=setup.seeds)
    except (SimulationError, ValueError):
        return None  # the check on fresh seeds meets the same error and reports it
    chosen = setup.target.bins - setup.target.settings.first_bin
    each, expected = controlled_moments(runs, setup.target)
    if expected is None:
        return None
    mean = jax.tree.map(lambda x: np.asarray(x).mean(axis=0), each)
    power = mean.power[chosen] / np.asarray(expected.power)[chosen]
    ratio = Moments(power, np.ones(len(chosen)), mean.mean / expected.mean, mean.variance / expected.variance)
    return ratio if all(np.all(np.isfinite(x) & (np.asarray(x) > 0)) for x in ratio) else None


def _montecarlo(setup: Setup, points: np.ndarray, max_steps: int, stages: list[Stage]) -> None:
    """All starts in linear response, or on few seeds where there is none; then the best few minima on all seeds."""
    if setup.control:
        problem = setup.linear()
        show = _stage(setup, stages, problem, "trying starts", (0.05, 0.4), max_steps)
        first = descend(problem, points, max_steps, report=show)
    else:
        problem = setup.montecarlo(max(8, setup.seeds // 3))
        show = _stage(setup, stages, problem, "trying starts", (0.05, 0.4), FIRST_STEPS)
        first = descend(problem, points, FIRST_STEPS, prepare=setup.finer, report=show)
    if not np.isfinite(first.cost[first.best]):
        return
    best = first.s[contenders(setup.coordinates, setup.target, first, RIVAL_MARGIN)[:MOST_RIVALS]]
    setup, share = _known(setup, problem, first)
    problem = setup.finer(setup.montecarlo(setup.seeds, share), best)
    descend(problem, best, max_steps, prepare=setup.finer,
            report=_stage(setup, stages, problem, "polishing", (0.4, 0.8), 15))  # fmt: skip


def _known(setup: Setup, problem: Problem, descent: Descent) -> tuple[Setup, Float[np.ndarray, " bins"]]:
    """What the best point says of how the data scatter: the setup with it, and the line's share of each bin."""
    moments = seen_best(problem, descent).moments
    share = np.clip(np.nan_to_num(moments.line / moments.power), 0.0, 1.0)
    if np.isfinite(descent.cost[descent.best]):
        setup = setup.scattering_as(setup.at(np.asarray(setup.coordinates.theta(descent.s[descent.best]))))
    return setup, share
