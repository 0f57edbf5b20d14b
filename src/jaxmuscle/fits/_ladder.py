"""The ladder: richer models, one after the other, until one describes the data."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle.model._noise import NoiseSum
from jaxmuscle.model._parameters import HARMONIC, default
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._rungs import QUIET, rung_name
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import FitOptions, Plan
from jaxmuscle.objective._covariance import effective_parameters
from jaxmuscle.objective._likelihood import log_marginal, measured_bins
from jaxmuscle.objective._starts import continued, starting_points

from ._adequacy import ADEQUATE, Endpoint, rows_of
from ._checks import Stage
from ._harmonic_evidence import SIGNIFICANT, p_of_line_left_out, p_value

STARTS = 32
ALIKE = 2.0
TREMOR = 2  # the rung whose rhythm is no line
DESCENDED = 0.6  # a fit's progress when its descents have ended


class Rung(NamedTuple):
    """A model that was tried: its `number` on the ladder and `model` in words; what it reached.

    `aic`, `-2 ln L + 2 p` with p, `parameters`, the effective number; chi² per bin and `p` of the
    verdict; whether it was `chosen`.
    """

    number: int
    model: str
    aic: float
    parameters: float
    chi2_per_bin: float
    p: float
    chosen: bool = False


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
    """The models that may be tried: up to which rung, how each is fitted, and from which rung on.

    `base` and `plan_of`, of one target: the task of the base model, and how another is fitted.
    `renewed`: of moved records, what the muscles that were fitted make of their targets; None where
    that says nothing new.
    """

    top: int
    plan_at: Callable[[int], Plan]
    lowest: int = 0
    base: AbstractTask | None = None
    plan_of: Callable[[AbstractTask], Plan] | None = None
    renewed: "Callable[[tuple[AbstractTask, ...]], tuple[Plan, Models] | None] | None" = None


def climb(
    first: Plan, models: Models, descend: Descend, keep: Callable[[Climbed], None]
) -> tuple[Rung, ...]:
    """Fit the first model and the next ones until one is adequate; `keep` gets each that is the
    best so far.

    The best has the lowest AIC. A rung that gains nothing is left out, and the next one is tried.
    An adequate model is no end in two cases, and a further one is then taken if its AIC is lower by
    more than 2: noise alone beside which the spectrum shows a significant line, for which the
    harmonic is tried; and a significant harmonic, for which the tremor is.
    """
    tried: list[Climbed] = []
    best: Climbed | None = None
    due: int | None = None  # the model to be tried although the best one describes the data
    numbers = range(models.lowest, models.top + 1)
    for place, number in enumerate(numbers):
        described = best is not None and best.rung.p >= ADEQUATE
        if described and number != due:
            continue
        plan = models.plan_at(number) if number > models.lowest else first
        points = starting_points(plan.problem, plan.starts) if best is None else _warm(plan, best)
        plan = plan._replace(settings=plan.settings | {"starts": len(points)})
        stages: list[Stage] = []
        begin, share = place * DESCENDED / len(numbers), DESCENDED / len(numbers)
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
        if best is None or found.rung.aic < best.rung.aic - ALIKE * described:
            best = found
            keep(found)
        if best.rung.p >= ADEQUATE:
            due = _due(best, number, models)
            if due is None:
                break
    return tuple(each.rung._replace(chosen=each is best) for each in tried)


def _due(best: Climbed, number: int, models: Models) -> int | None:
    """Which model is tried after this one, where the best one describes the data; of several
    targets none."""
    if models.base is None:
        return None
    if number == QUIET:
        line = (
            float(models.base.harmonic.amplitude) > 0
            and p_of_line_left_out(best.ended) < SIGNIFICANT
        )
        return number + 1 if line else None
    return TREMOR if number < TREMOR <= models.top and _has_line(best) else None


def _telling(plan: Plan, which: str, begin: float, end: float) -> Plan:
    """The plan of one of several models: its progress says which one it is, and goes from `begin`
    to `end` of the whole."""
    tell = plan.problem.tell

    def own(text: str, share: float) -> None:
        tell(f"{which}: {text}", begin + (end - begin) * share / DESCENDED)

    return plan._replace(problem=dataclasses.replace(plan.problem, tell=own))


def _has_line(found: Climbed) -> bool:
    """Whether the harmonic of a fit is significant."""
    problem = found.plan.problem
    if not set(HARMONIC) <= set(problem.coordinates.names):
        return False
    return p_value(problem, problem.linear(), found.stages[-1].minima) < SIGNIFICANT


def _warm(plan: Plan, best: Climbed) -> Float[np.ndarray, "starts free"]:
    """Starts of a richer model: for the most part what it shares with the best one begins where
    that ended."""
    before, known = best.plan.problem, dict[str, float]()
    for part, task in zip(before.parts, before.tasks_at(best.ended.seen.theta), strict=True):
        for column, name in zip(part.columns, part.coordinates.names, strict=True):
            known.setdefault(before.coordinates.names[column], float(task[name]))
    return continued(plan.problem, _fewer(plan.starts), known)


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
    return Rung(number, rung_name(number), aic, parameters, verdict.chi2 / sum(numbers), verdict.p)


def criterion(ended: Endpoint) -> tuple[float, float]:
    """AIC of the likelihood where a fit ended, and the effective number of parameters."""
    found, precision = ended.found, np.linalg.pinv(ended.scatter, rcond=1e-9, hermitian=True)
    parameters = effective_parameters(
        found.jacobian.T @ precision @ found.jacobian, ended.problem.prior
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


def line_or_resonance(
    plan: Plan, fitted: AbstractTask, ladder: tuple[Rung, ...], models: Models, descend: Descend
) -> tuple[str, ...]:
    """Whether the rhythm that was found is a line or a narrow resonance, in a sentence, where that
    is the question.

    It is where a harmonic is significant (`climb` has tried the tremor then), and where a resonance
    is narrower than a bin.
    """
    assert models.plan_of is not None  # of one target
    chosen = next(rung for rung in ladder if rung.chosen)
    (part,) = plan.problem.parts
    task, resolution = part.task, part.target.settings.resolution
    if chosen.number < 2:
        tremor = [rung.aic for rung in ladder if rung.number == 2]
        return (told_apart(chosen.aic, tremor[0]),) if tremor else ()
    parts = task.noise.components
    for i, found in enumerate(fitted.noise.components):
        if isinstance(found, ResonantNoise) and float(found.width) < resolution:
            others = parts[:i] + parts[i + 1 :]
            rest = task.with_parts(noise=NoiseSum(others))
            line = {
                "harmonic_amplitude": default("harmonic_amplitude"),
                "harmonic_frequency": float(found.frequency),
            }
            aic = _aic_of(models.plan_of(rest.replace(**line)), descend)
            return () if aic is None else (told_apart(aic, chosen.aic),)
    return ()


def _aic_of(plan: Plan, descend: Descend) -> float | None:
    """What a model reaches; None if no start has a finite spectrum."""
    stages: list[Stage] = []
    plan = _telling(plan, "a line instead of the resonance", 0.95, 1.0)
    if descend(plan, starting_points(plan.problem, _fewer(plan.starts)), stages) is None:
        return None
    return criterion(Endpoint.of(plan.problem, stages[-1]))[0]


def told_apart(line: float, resonance: float) -> str:
    """A line against a resonance by their AIC, in a sentence."""
    said = f"a line of zero width (AIC {line:.1f}) and a resonance (AIC {resonance:.1f})"
    if abs(line - resonance) <= ALIKE:
        return (
            f"{said} cannot be told apart: whether the rhythm is regular or a tremor remains open;"
            " record longer"
        )
    return f"{said}: the data prefer the {'line' if line < resonance else 'resonance'}"
