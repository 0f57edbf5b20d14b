"""The search of a fit: many starts, the best minima polished, whatever was reached when
interrupted. `_fit.py` and `_joint.py` call `search`, cohorts and bootstraps `search_together`.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import jax
import msgspec
import numpy as np
from jaxtyping import Float

from jaxmuscle._common.environment import fitting
from jaxmuscle._common.errors import SimulationError
from jaxmuscle._common.executors import AnyExecutor, results_of
from jaxmuscle._common.keys import fold_in
from jaxmuscle._common.progress import nothing
from jaxmuscle.ensembles._ensemble import runs_for_means
from jaxmuscle.model._rungs import REFLEX
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import Plan
from jaxmuscle.objective._consequences import BATCH
from jaxmuscle.objective._least_squares import Minima, least_squares
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.objective._starts import contenders, kinds_of_starts, recombined, starting_points
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._linearised import settled

from ._checks import AMBIGUOUS
from ._model_choice import Climbed, Models, climb, rung_of
from ._perturbed import alike
from ._reflex import ReflexTest, look_for_reflex, starts_with_reflex
from ._report import UNCHECKED, report_fit
from ._result import FitResult, Rung
from ._stages import Stage, controlled_moments, expand_at_best
from ._verdict import Endpoint

FIRST_STEPS = 12
MOST_RIVALS = 3
# starts, of which those that are left behind end sooner; of fewer every end is of interest
MANY = 64
RIVAL_MARGIN = 6.0
POLISHES = 4
STILL = 2e-3
# Data that are fitted together. How many must not depend on who works: the last bits of a fit may
# hang on its neighbours. With 32 starts each they fill the programs' rows; more gain nothing.
TOGETHER = 4
# by which chi² and prior fall where a reflex that is seen is kept: 2 for each parameter, and 4
REFLEX_MARGIN = 10.0
RENEWALS = 2  # of the target of a moved record, where a richer model than the base one was chosen
TOLD = {
    "trying starts": "searching from all starting points",
    "linear response": "refining the best",
    "polishing": "correcting by simulation",
}


class FitInterrupted(KeyboardInterrupt):
    """A fit was interrupted; `tasks`, one for each target, are the best that had been reached,
    `result` is the fit at these.

    `report` makes the result when it is asked for. Programs may have to be compiled for that.
    """

    def __init__(self, tasks: tuple[AbstractTask, ...], report: Callable[[], FitResult]):
        super().__init__("fit interrupted")
        self.tasks = tasks
        self.report = report

    @functools.cached_property
    def result(self) -> FitResult:
        with jax.enable_x64(True):
            return self.report()


@dataclasses.dataclass
class _Search:
    """Where a search stands: the plan of the best model so far, its stages, what is known of the
    scatter of its data, and the models that were tried. It changes as the search goes on, so that
    Ctrl-C finds what was reached."""

    plan: Plan
    stages: list[Stage] = dataclasses.field(default_factory=list)
    known: "Known | None" = None
    ladder: tuple[Rung, ...] = ()
    best: Climbed | None = None
    reflex: ReflexTest | None = None

    def keep(self, found: Climbed) -> None:
        """Go on from this model."""
        self.best = found
        self.plan, self.known = found.plan, found.known
        self.stages = found.stages

    def begin(self, plan: Plan, stages: list[Stage]) -> None:
        """Stand in the search of the first model, of which nothing is found yet."""
        self.plan, self.stages = plan, stages

    def find(self, models: Models | None) -> None:
        """The best minimum of one model, or of the best of several."""
        problem = self.plan.problem
        if models is not None:
            self.climb(models)
            self.look_for_reflex(models)
            return
        points = starting_points(problem, self.plan.starts)
        kinds = kinds_of_starts(problem, self.plan.starts)
        self.plan = self.plan._replace(kinds=kinds)
        if problem.method == "linear":
            self.known = _descended(self.plan, points, self.stages)
        else:
            _montecarlo(self.plan, points, self.stages)

    def climb(self, models: Models) -> None:
        """One model after the other; of moved records again with the targets that the muscle of
        the chosen model sees."""
        self.ladder = climb(models, _descended, self.keep, self.begin)
        for _ in range(RENEWALS):
            richer = any(rung.chosen and rung.number > 0 for rung in self.ladder)
            if not richer or models.renewed is None:
                return
            anew = models.renewed(_reached(self.plan, self.stages))
            # until they have been tried, what was found before stays
            better: list[Climbed] = []
            tried = (
                ()
                if anew is None
                else climb(anew, _descended, better.append, self.begin, self.best)
            )
            if anew is None or not better:
                return
            self.ladder, models = tried, anew
            self.keep(better[-1])

    def look_for_reflex(self, models: Models) -> None:
        """Test the best model for a reflex that it lacks, and go on with one that is seen; of
        recordings again, with the target that muscle and reflex see."""
        without = self.best
        if without is None or models.with_reflex is None:
            return
        test = self.reflex = look_for_reflex(without.ended)
        if test is None or not (test.seen or models.reflex == "linear"):
            return
        found = self._with_reflex(models.with_reflex(without.rung.number, ()), without, test)
        if found is None:
            return
        # of one target, with the same errors; that of the second turn is another one
        fell = 2 * (without.least_cost - found.least_cost)
        if models.reflex == "auto" and fell < REFLEX_MARGIN:
            self.reflex = test._replace(fitted=False)
            return
        others = [msgspec.structs.replace(rung, chosen=False) for rung in self.ladder]
        self.ladder = (*others, found.rung)
        self.keep(found)
        # what is taken off the recordings beside the linear answer is that of the reflex found
        for _ in range(RENEWALS if models.renewed is not None else 0):
            seen_by = _reached(self.plan, self.stages)
            again = models.with_reflex(without.rung.number, seen_by)
            parts = zip(self.plan.problem.parts, again.problem.parts, strict=True)
            if all(alike(one.target, other.target) for one, other in parts):
                return
            found = self._with_reflex(again, found, test)
            if found is None:
                return
            self.keep(found)

    def _with_reflex(self, plan: Plan, best: Climbed, test: ReflexTest) -> Climbed | None:
        """A model with a reflex, fitted from where another one ended; None where no search ends."""
        there = best.ended.values_of(best.plan.problem.coordinates.names)
        points, kinds = starts_with_reflex(plan.problem, there, test)
        plan, stages = plan._replace(kinds=kinds), list[Stage]()
        known = _descended(plan, points, stages)
        if known is None:
            return None
        ended = Endpoint.of(plan.problem, stages[-1])
        rung = rung_of(ended, best.rung.number)
        rung = msgspec.structs.replace(rung, model=f"{rung.model} + {REFLEX}", chosen=True)
        return Climbed(plan, stages, known, ended, rung)


def search(
    plan: Plan,
    answer: Callable[[FitResult], None] | None = None,
    models: Models | None = None,
    completed: Callable[[FitResult], FitResult] | None = None,
) -> FitResult:
    """From the starting points to a result; Ctrl-C ends it with what had been reached.

    `answer` gets the result before its checks; Ctrl-C in these keeps it. Of several `models` one
    after the other is tried until one describes the data. What is `completed` is the result.
    """
    run = _Search(plan)
    try:
        plan.problem.tell("compiling, which the first time takes longest", 0.0)
        run.find(models)
        if run.known is not None:
            _polished(run.plan, run.known, run.stages)
    except KeyboardInterrupt:
        if not run.stages:
            raise KeyboardInterrupt("fit interrupted before its first step") from None
        raise _stopped(run.plan, run.stages, run.ladder, interrupted=True) from None
    plan, problem, ended = run.plan, run.plan.problem, None
    try:
        ended = Endpoint.of(problem, run.stages[-1])
        if answer is not None and plan.check_seeds:
            answer(_checked_later(_unchecked(plan, run.stages, run.ladder, ended)))
        problem.tell(
            "checking with new simulations" if plan.check_seeds else "computing the errors", 0.8
        )
        result = report_fit(plan, run.stages, run.ladder, ended=ended)
        if run.reflex is not None and not (run.reflex.seen and run.reflex.fitted):
            said = (run.reflex.notice, *result.notices)
            result = dataclasses.replace(result, notices=said)
        if completed is not None:
            result = completed(result)
        if answer is not None and not plan.check_seeds:
            answer(result)
    except KeyboardInterrupt:
        raise _stopped(plan, run.stages, run.ladder, ended) from None
    problem.tell("done", 1.0)
    return result


def _checked_later(found: FitResult) -> FitResult:
    """Without what the checks, which come, will say: two answers to one question puzzle."""
    parts = {name: dataclasses.replace(part, check={}) for name, part in found.parts.items()}
    return dataclasses.replace(
        found, parts=parts, notices=tuple(n for n in found.notices if n != UNCHECKED)
    )


def _stopped(plan: Plan, stages: list[Stage], *reached: Any, **how: Any) -> FitInterrupted:
    """Where the search stands, and what reports it."""
    tasks = _reached(plan, stages)
    return FitInterrupted(tasks, lambda: _unchecked(plan, stages, *reached, **how))


def _reached(plan: Plan, stages: list[Stage]) -> tuple[AbstractTask, ...]:
    """The tasks of the best point so far."""
    found = stages[-1].minima
    return plan.problem.tasks_at(np.asarray(plan.problem.coordinates.theta(found.s[found.best])))


def _unchecked(
    plan: Plan,
    stages: list[Stage],
    ladder: tuple[Rung, ...],
    ended: Endpoint | None = None,
    *,
    interrupted: bool = False,
) -> FitResult:
    """The result before anything is simulated to check it."""
    plan = plan._replace(check_seeds=0)
    return report_fit(plan, stages, ladder, ended=ended, interrupted=interrupted, preliminary=True)


def search_in_blocks(
    executor: AnyExecutor | None,
    batches: Iterable[list[Plan]],
    tell: Callable[[str, float], None],
    number: int = 0,
    *,
    replicates: bool = False,
) -> Iterator[FitResult]:
    """`search_together` of `TOGETHER` fits of a batch after the other, on an executor or in this
    process: the same results to the last bit, in order."""
    blocks = [batch[i : i + TOGETHER] for batch in batches for i in range(0, len(batch), TOGETHER)]
    search = functools.partial(_searched, number=number, replicates=replicates)
    done, whole = 0, sum(map(len, blocks))
    if executor is not None:
        for block, results in results_of(executor, search, blocks):
            done += len(block)
            tell(f"{done} of {whole} fits", done / whole)
            yield from results
        return
    for block in blocks:

        def show(text: str, share: float, done: int = done, size: int = len(block)) -> None:
            tell(text, (done + share * size) / whole)

        yield from search(block, show)
        done += len(block)


def _searched(
    plans: list[Plan], tell: Callable[[str, float], None] = nothing, **how: Any
) -> list[FitResult]:
    with fitting():  # also in a worker
        return search_together(plans, tell, **how)


def search_together(
    plans: list[Plan],
    tell: Callable[[str, float], None],
    number: int = 0,
    *,
    replicates: bool = False,
) -> list[FitResult]:
    """Fits of one model to several data on the same bins, all starts of all fits in one
    minimisation.

    Linear response alone: no nonlinear correction, no check on simulated seeds, no profile over the
    frequency. The AIC of the model, whose `number` on the ladder this is, stands in every result.
    Of `replicates` the muscle that their response alone asks for is not sought: what made them
    fluctuate is what the model says.
    """
    problems = [plan.problem for plan in plans]
    plans = [p._replace(kinds=kinds_of_starts(p.problem, p.starts)) for p in plans]
    muscle: dict[str, float] | None = {} if replicates else None
    points = [starting_points(plan.problem, plan.starts, muscle) for plan in plans]
    objectives = [problem.linear() for problem in problems]
    first = _together(objectives, points, plans[0].max_steps, "trying starts", tell, (0.0, 0.7))
    best = [
        stage.minima.s[contenders(p, stage.minima, RIVAL_MARGIN)[:BATCH]]
        for p, stage in zip(problems, first, strict=True)
    ]
    known = [_known(problem, stage) for problem, stage in zip(problems, first, strict=True)]
    objectives = [problem.linear(shares) for problem, shares in known]
    second = _together(objectives, best, plans[0].max_steps, "linear response", tell, (0.7, 0.8))
    results = []
    for plan, *stages in zip(plans, first, second, strict=True):
        unused = plan.settings | {"seeds": 0, "check_seeds": 0}
        finite = np.isfinite(stages[-1].minima.cost[stages[-1].minima.best])
        ended = Endpoint.of(plan.problem, stages[-1]) if finite else None
        judged = ended is not None and ended.adequacy is not None and len(plan.problem.parts) == 1
        rungs = ()
        if ended is not None and judged:
            rungs = (msgspec.structs.replace(rung_of(ended, number), chosen=True),)
        results.append(
            report_fit(plan._replace(settings=unused, check_seeds=0), stages, rungs, ended=ended)
        )
        tell(f"computing the errors of {plan.problem.title}", 0.8 + 0.2 * len(results) / len(plans))
    return results


def _together(
    objectives: list[Residuals],
    points: list[np.ndarray],
    max_steps: int,
    name: str,
    tell: Callable[[str, float], None],
    shares: tuple[float, float],
) -> list[Stage]:
    """One stage of every fit; they differ in their data only."""
    counts = [len(p) for p in points]
    data = jax.tree.map(
        lambda *x: np.repeat(np.stack(x), counts, axis=0),
        *(objective.data for objective in objectives),
    )

    def show(minima: Minima) -> None:
        share = min(1.0, minima.steps.max() / max_steps)
        tell(TOLD[name], shares[0] + (shares[1] - shares[0]) * share)

    found = least_squares(objectives[0], np.concatenate(points), max_steps, data=data, report=show)
    parts = zip(*(np.split(x, np.cumsum(counts)[:-1]) for x in found), strict=True)
    return [
        Stage(name, objective, Minima(*part))
        for objective, part in zip(objectives, parts, strict=True)
    ]


def _stage(
    problem: FitProblem,
    stages: list[Stage],
    objective: Residuals,
    name: str,
    shares: tuple[float, float],
    most: int,
) -> Any:
    """A new stage, and what keeps its newest state and tells the progress."""
    number = len(stages)

    def show(minima: Minima) -> None:
        stages[number:] = [Stage(name, objective, minima)]
        share = shares[0] + (shares[1] - shares[0]) * min(1.0, minima.steps.max() / most)
        problem.tell(f"{TOLD[name]}, misfit {minima.cost[minima.best]:.2f}", share)

    return show


Known = tuple[FitProblem, list[Float[np.ndarray, " _"]]]


def _descended(plan: Plan, points: np.ndarray, stages: list[Stage]) -> Known | None:
    """All starts in linear response, then the best of them with the line's share known."""
    problem, max_steps = plan.problem, plan.max_steps
    objective = problem.linear()
    show = _stage(problem, stages, objective, "trying starts", (0.05, 0.5), max_steps)
    margin = AMBIGUOUS if len(points) >= MANY else np.inf
    first = least_squares(objective, points, max_steps, margin=margin, report=show)
    first = _with_recombined(plan, objective, first)
    stages[:] = [Stage("trying starts", objective, first)]
    if not np.isfinite(first.cost[first.best]):
        return None
    best = first.s[contenders(problem, first, RIVAL_MARGIN)[:BATCH]]
    problem, shares = _known(problem, stages[0])
    objective = problem.linear(shares)
    show = _stage(problem, stages, objective, "linear response", (0.5, 0.6), 15)
    least_squares(objective, best, max_steps, report=show)
    return problem, shares


def _polished(plan: Plan, known: Known, stages: list[Stage]) -> None:
    """The nonlinear correction, until it no longer changes."""
    (problem, shares), found, max_steps = known, stages[-1].minima, plan.max_steps
    # no longer that of one of several models
    problem = dataclasses.replace(problem, tell=plan.problem.tell)
    corrections: list[Moments] | None = None
    for turn in range(POLISHES if problem.seeds else 0):
        if not np.isfinite(found.cost[found.best]):
            return
        tasks = problem.tasks_at(np.asarray(problem.coordinates.theta(found.s[found.best])))
        new = [
            correction_at(problem, part, task)
            for part, task in zip(problem.parts, tasks, strict=True)
        ]
        made = [correction for correction in new if correction is not None]
        if len(made) < len(new):
            return
        if corrections is not None:
            changes = [
                np.max(np.abs(np.log(a.power / b.power)), initial=0.0)
                for a, b in zip(made, corrections, strict=True)
            ]
            if max(changes) < STILL:
                return
        corrections, objective = made, problem.linear(shares, made)
        show = _stage(
            problem, stages, objective, "polishing", (0.6 + 0.05 * turn, 0.65 + 0.05 * turn), 15
        )
        found = least_squares(objective, found.s, max_steps, report=show)


def _with_recombined(plan: Plan, objective: Residuals, found: Minima) -> Minima:
    """Where several harmonic frequencies are free: the best point with each of them in turn at its
    candidates, too."""
    problem = plan.problem
    turns = len(recombined(problem, np.zeros(len(problem.prior)), 1))
    for turn in range(turns):
        if not np.isfinite(found.cost[found.best]):
            break
        theta = np.asarray(problem.coordinates.theta(found.s[found.best]))
        more = least_squares(
            objective, recombined(problem, theta, plan.starts)[turn], plan.max_steps
        )
        found = Minima(*map(np.concatenate, zip(found, more, strict=True)))
    return found


def correction_at(problem: FitProblem, part: Part, task: AbstractTask) -> Moments | None:
    """Moments of the nonlinear model over those of the linear response; None if the task cannot be
    simulated."""
    if not len(part.target.bins):
        return part.ones
    try:
        runs = runs_for_means(settled(task), fold_in(problem.key, 2), problem.seeds)
    except (SimulationError, ValueError):
        return None  # the check on fresh seeds meets the same error and reports it
    each, expected = controlled_moments(runs, part.target, task)
    if expected is None:
        return None
    mean = jax.tree.map(lambda x: np.asarray(x).mean(axis=0), each)
    power = mean.power[part.chosen] / np.asarray(expected.power)[part.chosen]
    # the mean of one is zero
    level = np.ones(()) if task.quantity == "acceleration" else mean.mean / expected.mean
    found = part.ones._replace(power=power, mean=level, variance=mean.variance / expected.variance)
    return found if all(np.all(np.isfinite(x) & (np.asarray(x) > 0)) for x in found[:4]) else None


def _montecarlo(plan: Plan, points: np.ndarray, stages: list[Stage]) -> None:
    """All starts in linear response, or on few seeds where there is none; then the best few minima
    on all seeds."""
    problem, max_steps = plan.problem, plan.max_steps
    if problem.control:
        objective = problem.linear()
        show = _stage(problem, stages, objective, "trying starts", (0.05, 0.4), max_steps)
        first = least_squares(objective, points, max_steps, report=show)
    else:
        objective = problem.montecarlo(max(8, problem.seeds // 3))
        show = _stage(problem, stages, objective, "trying starts", (0.05, 0.4), FIRST_STEPS)
        first = least_squares(objective, points, FIRST_STEPS, prepare=problem.finer, report=show)
    if not np.isfinite(first.cost[first.best]):
        return
    best = first.s[contenders(problem, first, RIVAL_MARGIN)[:MOST_RIVALS]]
    problem, shares = _known(problem, stages[0])
    objective = problem.finer(problem.montecarlo(problem.seeds, shares), best)
    least_squares(
        objective,
        best,
        max_steps,
        prepare=problem.finer,
        report=_stage(problem, stages, objective, "polishing", (0.4, 0.8), 15),
    )


def _known(problem: FitProblem, stage: Stage) -> tuple[FitProblem, list[Float[np.ndarray, " _"]]]:
    """What the best point says of how the data scatter: the problem with it, and the line's share
    of each bin."""
    seen = expand_at_best(stage.objective, stage.minima)
    shares = [
        np.clip(np.nan_to_num(moments.line / moments.power), 0.0, 1.0) for moments in seen.moments
    ]
    if np.isfinite(stage.minima.cost[stage.minima.best]):
        problem = problem.scattering_as(problem.tasks_at(seen.theta))
    return problem, shares
