"""Which model is fitted: the one that the peaks ask for, then richer ones until one describes the
data (`climb`, for `_search.py`); and whether the harmonic and the rhythms of the chosen one are
there (for `_report.py`).
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import msgspec
import numpy as np
from jaxtyping import Float, Int

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle.data._measured import can_be_tested
from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import HARMONIC
from jaxmuscle.model._resonant_noise import narrow_resonances
from jaxmuscle.model._rungs import QUIET, RICHER, rung_name
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import SLOWER, Plan, base_of, target_of
from jaxmuscle.objective._covariance import effective_parameters
from jaxmuscle.objective._least_squares import Minima, least_squares
from jaxmuscle.objective._likelihood import log_marginal, measured_bins
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.objective._starts import (
    SLOWEST,
    continued,
    kinds_of_starts,
    muscle_of_response,
    starting_points,
)
from jaxmuscle.spectra._peak_test import find_peaks

from ._refit import lines_of, over_band, without_fitted
from ._result import ADEQUATE, Estimate, Rung
from ._stages import Stage, expand_at_best
from ._verdict import Endpoint, drawn_log_residuals, generator_of

NEAR = 0.25  # in the logarithm: what lies at a peak
CORNER = "corner_frequency"


def find_tremor(target: Target) -> float | None:
    """Frequency [Hz] of the significant peak that is measured in the band of tremors; None without
    one."""
    seen = target.measured.get("tremor_frequency")
    return None if seen is None or not math.isfinite(seen.value) else float(seen.value)


def find_slower_peak(target: Target) -> float | None:
    """Frequency [Hz] of the clearest significant peak below the tremors, from 1.5 Hz on; None
    without one."""
    band = SLOWEST, SLOWER[1]
    if not can_be_tested(target, band):
        return None
    given = target.proportional_power, target.settings, target.segments or (), band
    return next((peak.frequency for peak in find_peaks(*given).peaks), None)


def find_unseen(
    problem: FitProblem, table: Mapping[str, Estimate]
) -> tuple[set[str], tuple[str, ...]]:
    """Quantities that the peaks do not bear out, and why, in sentences.

    Of a resonance a significant peak is needed at most a quarter away from its frequency, in one of
    the targets that it acts on; a corner frequency must not lie so near to a tremor: there the
    muscle swings instead.
    """
    if not any(base_of(n).startswith("resonance") or base_of(n) == CORNER for n in table):
        return set(), ()
    peaks = {
        "resonance": [find_tremor(part.target) for part in problem.parts],
        "resonance_2": [find_slower_peak(part.target) for part in problem.parts],
    }
    without, said = set[str](), list[str]()
    for name, estimate in table.items():
        base, own = base_of(name), target_of(name)
        here = [i for i, part in enumerate(problem.parts) if own in ("", part.name)]
        # a bend of the slow part may look like a slower peak: that is what a corner is
        if base == CORNER and any(_near(estimate.value, f) for f in _of(peaks["resonance"], here)):
            without.add(name)
            said.append(
                f"{name} ({estimate.value:.3g} Hz) lies at the tremor that is measured: here the"
                " muscle of the model swings as the tremor does. It is not stated"
            )
        which = base.removesuffix("_frequency")
        if which not in peaks or which == base:
            continue
        seen = _of(peaks[which], here)
        if any(_near(estimate.value, f) for f in seen):
            continue
        at = "@" + own if own else ""
        names = {f"{which}_{what}" for what in ("amplitude", "frequency", "width", "share")}
        without |= {n for n in table if base_of(n) in names and n.endswith(at)}
        said.append(_why(name, estimate.value, seen))
    return without, tuple(said)


def _of(peaks: list[float | None], parts: Iterable[int]) -> list[float]:
    return [f for i in parts if (f := peaks[i]) is not None]


def _near(frequency: float, peak: float) -> bool:
    return abs(math.log(max(frequency, 1e-9) / peak)) < NEAR


def _why(name: str, value: float, seen: list[float]) -> str:
    where = "tremor" if "_2_" not in name else "slower rhythm"
    if not seen:
        return (
            f"the spectrum shows no significant peak for a {where}: the resonance of the model only"
            " helps to describe the spectrum, and its numbers are not stated"
        )
    return (
        f"{name} ({value:.3g} Hz) lies elsewhere than the peak that is measured"
        f" ({', '.join(f'{f:.3g}' for f in seen)} Hz), so it is not stated"
    )


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
    ended = Endpoint(problem, objective, expand_at_best(objective, without))
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


STARTS = 32
AIC_MARGIN = 2.0  # by which a richer model than an adequate one must be better
DESCENDED = 0.6  # a fit's progress when its descents have ended


class Climbed(NamedTuple):
    """A rung that was fitted: its plan, the stages of its search, what is known of the scatter,
    where it ended."""

    plan: Plan
    stages: list[Stage]
    known: Any
    ended: Endpoint
    rung: Rung

    @property
    def least_cost(self) -> float:
        """Half of chi² and prior where it ended."""
        minima = self.stages[-1].minima
        return float(minima.cost[minima.best])


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
    that says nothing new. `with_reflex`: the plan of a rung with a reflex, its targets those which
    tasks make of the records (none: as they were); `reflex`, whether one is looked for ("auto"),
    left out ("none") or fitted in any case ("linear").
    """

    first: int
    lowest: int
    top: int
    plan_at: Callable[[int], Plan]
    renewed: "Callable[[tuple[AbstractTask, ...]], Models | None] | None" = None
    with_reflex: Callable[[int, tuple[AbstractTask, ...]], Plan] | None = None
    reflex: str = "none"


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
    begun: Callable[[Plan, list[Stage]], None],
    before: Climbed | None = None,
) -> tuple[Rung, ...]:
    """Fit one model after the other until one describes the data; `keep` gets each that is the best
    so far. As long as there is none, `begun` gets the plan of a model and the stages of its search,
    which are filled later.

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
        if best is None and before is None:
            begun(plan, stages)
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
        if best is None or found.rung.aic < best.rung.aic - AIC_MARGIN * described:
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
        ended.problem.parts, ended.seen.moments, ended.objective.rows, strict=True
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
