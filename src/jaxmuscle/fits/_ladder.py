"""The ladder: richer models, one after the other, until one describes the data."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import HARMONIC
from jaxmuscle.model._resonant_noise import narrow_resonances
from jaxmuscle.model._rungs import QUIET, RICHER, rung_name
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import Plan
from jaxmuscle.objective._covariance import effective_parameters
from jaxmuscle.objective._likelihood import log_marginal, measured_bins
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._starts import (
    continued,
    kinds_of_starts,
    muscle_of_response,
    starting_points,
)

from ._adequacy import Endpoint, rows_of
from ._checks import Stage
from ._fit_file import ADEQUATE, Rung
from ._harmonic_evidence import SIGNIFICANT, p_of_line_left_out
from ._peaks import find_slower_peak, find_tremor

STARTS = 32
ALIKE = 2.0
DESCENDED = 0.6  # a fit's progress when its descents have ended


class Climbed(NamedTuple):
    """A rung that was fitted: its plan, the stages of its search, what is known of the scatter,
    where it ended."""

    plan: Plan
    stages: list[Stage]
    known: Any
    ended: Endpoint
    rung: Rung


def options_for(task: AbstractTask, options: FitOptions) -> FitOptions:
    """How one of the models is fitted: a harmonic that it does not have is not fixed."""
    if float(task.harmonic.amplitude) > 0:
        return options
    return dataclasses.replace(
        options, fix={n: value for n, value in (options.fix or {}).items() if n not in HARMONIC}
    )


Descend = Callable[[Plan, np.ndarray, list[Stage]], Any]


class Models(NamedTuple):
    """The models that may be tried: the first, from which rung up to which, and how each is fitted.

    `renewed`: of moved records, what the muscles that were fitted make of their targets; None where
    that says nothing new.
    """

    first: int
    lowest: int
    top: int
    plan_at: Callable[[int], Plan]
    renewed: "Callable[[tuple[AbstractTask, ...]], Models | None] | None" = None


def first_rung(targets: list[Target], lowest: int, top: int) -> int:
    """The model that the spectra ask for: one with a resonance where one of them shows a tremor,
    with two where that one shows a slower peak, too, else the lowest."""
    trembling = [target for target in targets if find_tremor(target) is not None]
    asked = lowest
    if trembling:
        slower = any(find_slower_peak(target) is not None for target in trembling)
        asked = RICHER["two resonances" if slower else "resonance"]
    return min(asked, top)


def climb(
    models: Models,
    descend: Descend,
    keep: Callable[[Climbed], None],
    before: Climbed | None = None,
) -> tuple[Rung, ...]:
    """Fit one model after the other until one describes the data; `keep` gets each that is the best
    so far.

    The best has the lowest AIC: a model that gains nothing is left out, and the next one is tried.
    An adequate model is no end in two cases, and a further one is then taken if its AIC is lower by
    more than 2. A resonance for the tremor that came out narrower than a bin may be a line, for
    which the models with a harmonic are tried. And so is the first of these beside noise alone, if
    the spectrum shows a significant line. `before`: the best for nearly the same data, where the
    first model then begins.
    """
    tried: list[Climbed] = []
    best: Climbed | None = None
    muscle: dict[str, float] | None = None
    waiting = list(range(models.first, models.top + 1))
    while waiting:
        number = waiting.pop(0)
        plan = models.plan_at(number)
        muscle = muscle_of_response(plan.problem) if muscle is None else muscle
        points, plan = _begin(plan, best or before, muscle)
        stages: list[Stage] = []
        share = DESCENDED / (models.top - models.lowest + 1)
        begin = len(tried) * share
        telling = _telling(
            plan, f"model {number} (of models 0 to {models.top})", begin, begin + share
        )
        telling.problem.tell(rung_name(number), 0.0)
        known = descend(telling, points, stages)
        if known is None:
            continue
        ended = Endpoint.of(plan.problem, stages[-1])
        found = Climbed(plan, stages, known, ended, rung_of(ended, number))
        tried.append(found)
        described = best is not None and best.rung.p >= ADEQUATE
        if best is None or found.rung.aic < best.rung.aic - ALIKE * described:
            best = found
            keep(found)
        if number == models.first >= RICHER["resonance"] and is_narrow(found):
            waiting = [*range(max(models.lowest, 0), number), *waiting]
        elif best.rung.p >= ADEQUATE and not (number == QUIET and _shows_line(best)):
            break
    in_order = sorted(tried, key=lambda each: each.rung.number)
    return tuple(msgspec.structs.replace(each.rung, chosen=each is best) for each in in_order)


def is_narrow(found: Climbed) -> bool:
    """Whether a resonance of the fitted model is narrower than a bin."""
    problem = found.plan.problem
    tasks = problem.tasks_at(found.ended.seen.theta)
    return any(
        narrow_resonances(task.noise, part.target.settings.resolution)
        for part, task in zip(problem.parts, tasks, strict=True)
    )


def _shows_line(quiet: Climbed) -> bool:
    return p_of_line_left_out(quiet.ended) < SIGNIFICANT


def _telling(plan: Plan, which: str, begin: float, end: float) -> Plan:
    """The plan of one of several models: its progress says which one it is, and goes from `begin`
    to `end` of the whole."""
    tell = plan.problem.tell

    def own(text: str, share: float) -> None:
        tell(f"{which}: {text}", begin + (end - begin) * share / DESCENDED)

    return plan._replace(problem=dataclasses.replace(plan.problem, tell=own))


def _begin(
    plan: Plan, best: Climbed | None, muscle: dict[str, float]
) -> tuple[Float[np.ndarray, "starts free"], Plan]:
    """Starts of a model, and its plan with these; of a richer one for the most part where what it
    shares with the best one ended. `muscle`: that of `muscle_of_response`."""
    problem, count = plan.problem, plan.starts if best is None else _fewer(plan.starts)
    if best is None:
        points = starting_points(problem, count, muscle)
    else:
        before, known = best.plan.problem, dict[str, float]()
        for part, task in zip(before.parts, before.tasks_at(best.ended.seen.theta), strict=True):
            for column, name in zip(part.columns, part.coordinates.names, strict=True):
                known.setdefault(before.coordinates.names[column], float(task[name]))
        points = continued(problem, count, known, muscle)
    kinds = kinds_of_starts(problem, count, continued=best is not None)
    return points, plan._replace(settings=plan.settings | {"starts": count}, kinds=kinds)


def _fewer(starts: int) -> int:
    """Starts of a further model: 32 of the usual 100, and more where more were asked for."""
    return max(min(starts, STARTS), starts * STARTS // 100)


def rung_of(ended: Endpoint, number: int) -> Rung:
    """The rung that was fitted, of data whose scatter is known."""
    verdict = ended.adequacy
    assert verdict is not None
    aic, parameters = criterion(ended)
    numbers = [
        max(len(part.target.bins) - 1, 0) + (0 if part.points is None else 2 * len(part.points))
        for part in ended.problem.parts
    ]
    each = verdict.chi2 / sum(numbers)
    return Rung(number, rung_name(number), aic, parameters, each, verdict.p, chosen=False)


def criterion(ended: Endpoint) -> tuple[float, float]:
    """AIC of the likelihood where a fit ended, and the effective number of parameters."""
    found, precision = ended.found, np.linalg.pinv(ended.scatter, rcond=1e-9, hermitian=True)
    parameters = effective_parameters(
        found.jacobian.T @ precision @ found.jacobian, ended.problem.precision
    )
    height = 0.0
    for part, moments, rows in zip(
        ended.problem.parts, ended.seen.moments, rows_of(ended), strict=True
    ):
        residuals = found.residuals[rows]
        if part.target.segments is None:
            height -= 0.5 * float(residuals @ precision[rows, rows] @ residuals)
        else:
            law = as_arrays(measured_bins(part.target))
            height += float(_height(law, np.asarray(moments.power), np.asarray(moments.line)))
            height -= 0.5 * float(np.sum(residuals[len(part.target.bins) :] ** 2))
    return 2 * parameters - 2 * height, parameters


@kept
def _height(law: Any, power: Any, line: Any) -> Any:
    return log_marginal(law, power, line)
