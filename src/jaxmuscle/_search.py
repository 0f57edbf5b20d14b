"""The search of a fit: many starts, the best minima polished, whatever was reached when interrupted."""

from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ._check import Stage, controlled_moments
from ._descend import BATCH, Descent, descend, seen_at
from ._expected import Moments
from ._linear import settled
from ._parameter import as_arrays, as_numbers
from ._problem import Problem, Setup
from ._report import report_fit
from ._result import FitResult
from ._simulate import SimulationError, ensemble
from ._starts import contenders, starting_points
from ._trajectory import WINDOW

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


def search(setup: Setup, starts: int, max_steps: int, check_seeds: int, settings: dict, seed: int | None) -> FitResult:
    """From the starting points to a result; Ctrl-C ends it with what had been reached."""
    points = starting_points(setup.coordinates, setup.target, starts)
    stages: list[Stage] = []
    interrupted = False
    try:
        setup.tell("compiling", 0.0)
        (_linear if setup.method == "linear" else _montecarlo)(setup, points, max_steps, stages)
    except KeyboardInterrupt:
        interrupted = True
    if not stages:
        raise KeyboardInterrupt("fit interrupted before its first step")
    setup.tell("checking on fresh seeds", 0.8)
    result = report_fit(setup, stages, check_seeds, settings, seed, max_steps, interrupted=interrupted)
    setup.tell("done", 1.0)
    if interrupted:
        raise FitInterrupted(result)
    return result


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
    share = _share(problem, first)
    problem = setup.linear(share)
    show = _stage(setup, stages, problem, "linear response", (0.5, 0.6), 15)
    found = descend(problem, best, max_steps, report=show)
    correction = None
    for turn in range(POLISHES):
        new = _correction(setup, found)
        if new is None:
            return
        change = np.inf if correction is None else np.max(np.abs(np.log(new.power / correction.power)))
        if change < STILL:
            return
        correction, problem = new, setup.linear(share, new)
        show = _stage(setup, stages, problem, "polishing", (0.6 + 0.05 * turn, 0.65 + 0.05 * turn), 15)
        found = descend(problem, found.s, max_steps, report=show)


def _correction(setup: Setup, found: Descent) -> Moments | None:
    """Moments of the nonlinear model over those of the linear response at the best point; None if it cannot be simulated."""
    if not np.isfinite(found.cost[found.best]):
        return None
    values = setup.coordinates.values(setup.coordinates.theta(found.s[found.best]))
    task = setup.task.replace(**{name: float(v) for name, v in values.items()})
    try:
        runs = ensemble(as_numbers(settled(as_arrays(task))), jax.random.fold_in(setup.key, 2), seeds=setup.seeds)
    except (SimulationError, ValueError):
        return None  # the check on fresh seeds meets the same error and reports it
    chosen = setup.target.bins - setup.target.settings.first_bin
    each, expected = controlled_moments(runs, setup.target.settings, WINDOW)
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
    share = _share(problem, first)
    problem = setup.finer(setup.montecarlo(setup.seeds, share), best)
    descend(problem, best, max_steps, prepare=setup.finer,
            report=_stage(setup, stages, problem, "polishing", (0.4, 0.8), 15))  # fmt: skip


def _share(problem: Problem, descent: Descent) -> Float[np.ndarray, " bins"]:
    """Share of the harmonic's line in each bin at the best point."""
    moments = seen_at(problem, np.asarray(problem.theta(descent.s))).moments
    share = moments.line[descent.best] / moments.power[descent.best]
    return np.clip(np.nan_to_num(share), 0.0, 1.0)
