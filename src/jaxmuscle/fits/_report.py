"""From where a fit ended to its result: success, fresh spectrum, tables of numbers with their
errors, what is undetermined. `_search.py` calls it when a search has ended.
"""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxmuscle._common.environment import versions
from jaxmuscle._common.errors import SimulationError
from jaxmuscle._common.keys import fold_in
from jaxmuscle.data._target import Target
from jaxmuscle.ensembles._ensemble import runs_for_means
from jaxmuscle.model._noises import with_active_noise
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import SAME, Plan, base_of
from jaxmuscle.objective._covariance import Identifiability, common_scales
from jaxmuscle.objective._derived import (
    MEAN,
    SPLIT,
    TISSUES,
    VARIATION,
    derived_names,
    jackknife,
    observed,
    unit_of,
)
from jaxmuscle.objective._moment_models import Linear
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.objective._starts import PEAK
from jaxmuscle.response._expected import Moments, check_power
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.response._linearised import settled
from jaxmuscle.response._second_order import negative_coefficients, second_order
from jaxmuscle.spectra._bin_law import (
    bin_statistics,
    recorded_interval,
    standardised,
    trial_samples,
)
from jaxmuscle.spectra._settings import WINDOW

from ._checks import (
    array_notices,
    convergence,
    further_notices,
    linear_check,
    mass_notices,
    narrow_notices,
    notices_of,
    polish_check,
    polish_notices,
    prior_notices,
    reach_notices,
    rivals,
    twitch_notices,
    unsettled,
)
from ._intervals import REACH, Interval, is_stated
from ._model_choice import find_unseen, harmonic_test
from ._result import Estimate, FitResult, FittedPart, Rung, Start
from ._signal_checks import RATE
from ._stages import Stage, controlled_moments
from ._verdict import Endpoint, elsewhere

OUTPUTS = (VARIATION, MEAN)
OF_TISSUES = {*SPLIT, "tangent_stiffness", "B0"}  # not stated where there are no such tissues
BASE = {"K_w0": "k_w", "K_z0": "k_z", "C_w0": "c_w", "C_z0": "c_z"}
STRAIGHT = 0.25  # error of a log up to which a quantity is as good as linear
VAGUE = 100.0  # from the lower to the upper end of an interval
MOVES = 0.5  # of its error: a number that a wider prior moves further rests on the prior
LOPSIDED = 1.7  # times as far as its error says is an end that this does not describe


def parameter_table(
    problem: FitProblem,
    tasks: Sequence[AbstractTask],
    covariance: np.ndarray,
    known: Identifiability,
) -> dict[str, Estimate]:
    """Free parameters by name, then the fixed ones; a number that differs between tasks is named
    with its target.

    A proportional parameter, which is free but differs, is given for every target.
    """
    sd, identifiable = np.sqrt(np.diag(covariance)), known.parameters
    free: dict[str, Estimate] = {}
    fixed: dict[str, dict[str, Estimate]] = {}
    for part, task in zip(problem.parts, tasks, strict=True):
        own = part.coordinates.names
        slope = part.coordinates.slope(np.array([float(task[name]) for name in own]))
        for name, value in task.parameters.items():
            if name not in own:
                fixed.setdefault(name, {})[part.name] = Estimate(
                    float(value), unit_of(name), None, False, None
                )
                continue
            column = part.columns[own.index(name)]
            joint = problem.coordinates.names[column]
            told = bool(identifiable[column]) or is_stated(problem, name)
            error = float(sd[column] * slope[own.index(name)]) if told else None
            made = Estimate(float(value), unit_of(name), error, True, told)
            differs = joint in free and abs(free[joint].value - made.value) > SAME * abs(made.value)
            free[f"{joint}@{part.name}" if differs else joint] = made
    held = {}
    for name, values in fixed.items():
        holders = sum(name in task.parameter_names for task in tasks)
        same = len({p.value for p in values.values()}) == 1 and len(values) == holders
        held |= {name if same else f"{name}@{target}": p for target, p in values.items()}
    table = free | held
    return {name: table[name] for name in tasks[0].parameter_names} if len(tasks) == 1 else table


def derived_table(
    problem: FitProblem,
    part: Part,
    values: Mapping[str, Any],
    slopes: Mapping[str, Any],
    sampling: Mapping[str, float],
    covariance: np.ndarray,
    known: Identifiability,
) -> dict[str, Estimate]:
    """Derived quantities, judged by the same criterion as the parameters; what follows from fixed
    ones alone is fixed.

    Their errors are those of the parameters and, where a value comes from fresh seeds, their
    sampling error.
    """
    table = {}
    names = derived_names(part.task, len(part.target.bins) > 0, part.points is not None)
    for name in (n for n in names if n in values):
        g = np.asarray(slopes[name])
        free = bool(np.any(g != 0))
        determined = free and (known.determines(g) or is_stated(problem, name))
        stderr = (
            float(np.hypot(np.sqrt(g @ covariance @ g), sampling.get(name, 0.0)))
            if determined
            else None
        )
        unit = unit_of(name, part.task.output_unit)
        table[name] = Estimate(
            float(values[name]), unit, stderr, free, determined if free else None
        )
    return table


def too_curved(problem: FitProblem, derived: Collection[str], known: Identifiability) -> set[str]:
    """Single numbers of muscle and noise, whose errors do not hold while the data leave some
    direction open.

    Along such a direction they bend, unless it is a common scale: on simulated recordings of
    muscles drawn from the prior, intervals by curvature or by profile held the truth in 75 to 85 %
    of cases, not in 95 % (docs/fitting.md). Observed quantities are not concerned, nor what several
    targets share, nor what a dynamic stiffness among the data makes known within a quarter: so
    small an error is straight (docs/perturbed.md).
    """
    names = problem.coordinates.names
    if np.sum(~known.determined) <= len(common_scales(names, known)):
        return set()
    shape = ("_frequency", "_width", "_time")
    single = {n for n in names if not base_of(n).endswith(shape)} | {
        n for n in derived if base_of(n) in BASE
    }
    if any(part.points is not None for part in problem.parts):
        left = {n: known.left(unit) for n, unit in zip(names, np.eye(len(names)), strict=True)}
        single = {n for n in single if left.get(BASE.get(n, n), 1.0) > STRAIGHT**2}
    return single if len(problem.parts) == 1 else {n for n in single if "@" in n}


def merged(
    problem: FitProblem, tables: list[dict[str, Estimate]], slopes: Any
) -> dict[str, Estimate]:
    """Derived quantities: one entry where all targets have the same number for the same reason,
    else one for each that has it."""
    found: dict[str, Estimate] = {}
    for name in dict.fromkeys(name for table in tables for name in table):
        having = [i for i, table in enumerate(tables) if name in table]
        values = np.array([tables[i][name].value for i in having])
        rows = np.stack([slopes[i][name] for i in having])
        same = np.allclose(values, values[0], rtol=SAME, atol=0) and np.allclose(
            rows, rows[0], rtol=SAME, atol=1e-300
        )
        if len(tables) == 1 or (same and name not in OUTPUTS and len(having) == len(tables)):
            found[name] = tables[0][name]
        else:
            found |= {f"{name}@{problem.parts[i].name}": tables[i][name] for i in having}
    # About a mean of zero the variation is infinite, and so is its prior: no measure of what the
    # data determine.
    vague = [
        n
        for n, p in found.items()
        if base_of(n) == OUTPUTS[0] and p.stderr is not None and p.stderr > p.value
    ]
    return without_errors(vague, found)


def correlation_table(names: tuple[str, ...], covariance: np.ndarray) -> dict[str, Any]:
    """Correlation of the free parameters, for JSON."""
    sd = np.sqrt(np.diag(covariance))
    matrix = covariance / np.maximum(np.outer(sd, sd), 1e-300)
    return {"parameters": list(names), "matrix": matrix.tolist()}


def without_errors(names: Collection[str], table: dict[str, Estimate]) -> dict[str, Estimate]:
    """The table with these quantities called not determined."""
    return {
        n: Estimate(p.value, p.unit, None, p.free, False) if n in names and p.free else p
        for n, p in table.items()
    }


def widened(table: dict[str, Estimate], factor: float) -> dict[str, Estimate]:
    """The table with every standard error multiplied."""
    return {
        n: p if p.stderr is None else eqx.tree_at(lambda e: e.stderr, p, factor * p.stderr)
        for n, p in table.items()
    }


def with_intervals(table: dict[str, Estimate], ends: Mapping[str, Interval]) -> dict[str, Estimate]:
    """The table with 95 % intervals about its values; a quantity whose interval says next to
    nothing is not determined.

    That is one which is open at both ends, or whose ends are more than a factor of `VAGUE` apart.
    """
    found = {}
    for name, p in table.items():
        if name in ends:
            about = ends[name].about(p.value)
            p = eqx.tree_at(lambda e: e.interval, p, about, is_leaf=lambda x: x is None)
            low, high = about
            wide = low is not None and high is not None and 0 < VAGUE * low < high
            p = (
                Estimate(p.value, p.unit, None, p.free, False)
                if wide or about == (None, None)
                else p
            )
        found[name] = p
    return found


def as_stated(
    ended: Endpoint,
    stage: Stage,
    tables: tuple[dict[str, Estimate], dict[str, Estimate]],
    ends: Mapping[str, Interval],
    max_steps: int,
) -> tuple[tuple[dict[str, Estimate], ...], Mapping[str, Estimate]]:
    """The tables with their intervals, and those numbers of a moved limb that rest on the prior:
    these have the intervals of wide priors. Where an error does not describe the interval, the
    interval stands alone."""
    stated = {
        n: p
        for n, p in (tables[0] | tables[1]).items()
        if n in ends and is_stated(ended.problem, n)
    }
    resting = by_prior(ended, stage, stated, max_steps) if stated else {}
    full = tuple(with_intervals(table, ends) for table in tables)
    full = tuple(table | {n: p for n, p in resting.items() if n in table} for table in full)
    alone = lopsided({n: p for table in full for n, p in table.items() if n in stated})
    return tuple(
        {n: interval_alone(p) if n in alone else p for n, p in table.items()} for table in full
    ), resting


def by_prior(
    ended: Endpoint, stage: Stage, stated: Mapping[str, Estimate], max_steps: int
) -> dict[str, Estimate]:
    """Those of the stated numbers that move by more than `MOVES` of their error where the prior is
    wider, with the intervals that they have then."""
    wide = ended.with_wide_priors(stage.minima, max_steps)
    if not np.all(np.isfinite(wide.found.residuals)):
        return {}
    here, there = (each.values_of(stated) for each in (ended, wide))
    moved = [n for n, p in stated.items() if abs(there[n] - here[n]) > MOVES * (p.stderr or 0.0)]
    ends = wide.intervals(moved, ended.widening)
    values = {n: Estimate(there[n], stated[n].unit, stated[n].stderr) for n in moved}
    return {
        n: eqx.tree_at(lambda e: e.value, p, stated[n].value)
        for n, p in with_intervals(values, ends).items()
    }


def lopsided(stated: Mapping[str, Estimate]) -> set[str]:
    """Those of the stated numbers whose errors do not describe their intervals: an end is open, or
    more than `LOPSIDED` times as far as the error says.

    Of the tissues all, if it is one: their numbers lie on one bent ridge. To state those alone that
    look straight would select them by what they came out as.
    """

    def is_described(p: Estimate) -> bool:
        ends = [math.inf if end is None else abs(end - p.value) for end in p.interval or ()]
        return bool(ends) and max(ends) <= LOPSIDED * REACH * (p.stderr or 0.0)

    found = {n for n, p in stated.items() if not is_described(p)}
    if any(base_of(n) in TISSUES for n in found):
        found |= {n for n in stated if base_of(n) in SPLIT}
    return found


def interval_alone(p: Estimate) -> Estimate:
    """The number without its error."""
    return Estimate(p.value, p.unit, None, p.free, False, p.interval)


STRETCH = 5.0
UNSETTLED = 1e-3
UNCHECKED = (
    "not done: the check by new simulations, the test of other frequencies of the harmonic, and its"
    " p-value. --quick (check_seeds=0) leaves these out, and so does an interruption"
)
UNSIMULATED = (
    "the fitted muscle cannot be simulated ({}). So the fluctuations are those of the formula,"
    " without a check. The response and its numbers do not rest on a simulation"
)
TOGETHER = (
    "fitted by the formula alone: no correction and no check by simulation, no profile and no"
    " p-value of the harmonic. For these, fit this target alone with the usual settings"
)


def may_be_elsewhere(share: float) -> str:
    """Why a harmonic that is elsewhere with this probability has no errors; where it seems small,
    from where on."""
    percent = f"{100 * share:.{0 if share >= 0.1 else 1}f}"
    limit = f" (a probability above {100 * UNSETTLED:g} % is enough for that)"
    return (
        "the harmonic may have another frequency, or be too faint to be seen: with a probability"
        f" of {percent} % it is more than a bin from the frequency shown. So no standard errors are"
        f" stated for the harmonic{limit if share < 0.1 else ''}"
    )


def report_fit(
    plan: Plan,
    stages: list[Stage],
    ladder: tuple[Rung, ...] = (),
    *,
    ended: Endpoint | None = None,
    interrupted: bool = False,
    preliminary: bool = False,
) -> FitResult:
    """The result of a fit that ended at the best point of the last stage; with no `check_seeds`
    nothing is simulated.

    Then the second order says whether the linear response holds, unless the result is
    `preliminary`. `ended` is that point, if it has been looked at already.
    """
    problem, final = plan.problem, stages[-1].minima
    first = stages[0].minima
    ends = problem.coordinates.values_of(np.asarray(problem.coordinates.theta(np.asarray(first.s))))
    # further ones have a harmonic at the peaks
    kinds = (*plan.kinds, *[PEAK] * (len(ends) - len(plan.kinds)))
    starts = tuple(
        Start(float(c) if np.isfinite(c) else None, bool(ok), int(n), _six_digits(end), kind)
        for c, ok, n, end, kind in zip(
            first.cost, first.settled, first.steps, ends, kinds, strict=True
        )
    )
    common = {
        "method": problem.method,
        "starts": starts,
        "seed": plan.seed,
        "settings": plan.settings,
        "versions": versions(),
        "ladder": ladder,
    }
    if not np.isfinite(final.cost[final.best]):
        return _failed(problem, common, _not_finite(problem))
    ended = Endpoint.of(problem, stages[-1]) if ended is None else ended
    seen = ended.seen
    theta, tasks = seen.theta, problem.tasks_at(seen.theta)
    try:
        for part, moments in zip(problem.parts, seen.moments, strict=True):
            if len(part.target.bins):
                check_power(part.task, moments)
    except ValueError as error:
        return _failed(problem, common, str(error))
    unchecked: tuple[str, ...] = ()
    try:
        made = [
            (
                _simulated(problem, part, task, moments, plan.check_seeds)
                if plan.check_seeds
                else _expected_only(moments)
            )
            for part, task, moments in zip(problem.parts, tasks, seen.moments, strict=True)
        ]
    except (SimulationError, ValueError) as error:
        if all(part.points is None for part in problem.parts):
            return _failed(problem, common, f"the fitted task cannot be simulated: {error}")
        # a response is known without
        made = [_expected_only(moments) for moments in seen.moments]
        plan, unchecked = plan._replace(check_seeds=0), (UNSIMULATED.format(error),)
    found = ended.found
    judgement, covariance = ended.adequacy, ended.covariance
    known = Identifiability.of_covariance(covariance)
    success, message = convergence(
        final,
        found.residuals,
        found.jacobian,
        problem.precision,
        theta,
        known,
        starts,
        plan.max_steps,
    )
    if interrupted:
        success, message = (
            False,
            f"interrupted after {int(final.steps.max())} steps; this is what had been reached",
        )
    tables = [
        derived_table(
            problem,
            part,
            values | _observed(part, m.each),
            slopes,
            jackknife(m.each),
            covariance,
            known,
        )
        for part, values, slopes, m in zip(
            problem.parts, found.values, found.slopes, made, strict=True
        )
    ]
    parameters = parameter_table(problem, tasks, covariance, known)
    derived = merged(problem, tables, found.slopes)
    names = problem.coordinates.names
    other, moved = rivals(
        problem, stages[0] if problem.method == "linear" else stages[-1], parameters | derived
    )
    share = elsewhere(ended)
    if share > UNSETTLED:
        moved |= {n for n in parameters | derived if base_of(n).startswith("harmonic_")}
        other += (may_be_elsewhere(share),)
    unseen, why = find_unseen(problem, parameters | derived)
    heavy, curved = mass_notices(problem.coordinates, theta), too_curved(problem, derived, known)
    moved |= {
        n
        for n in parameters | derived
        if n in unseen
        or (n in curved and not is_stated(problem, n))
        or (heavy and base_of(n) in OF_TISSUES)
    }
    parameters, derived = (
        widened(without_errors(moved, table), ended.widening) for table in (parameters, derived)
    )
    ends = ended.intervals(
        [n for n, p in (parameters | derived).items() if p.stderr and n in {*derived, *names}]
    )
    (parameters, derived), resting = as_stated(
        ended, stages[-1], (parameters, derived), ends, plan.max_steps
    )
    polish = polish_check(problem, stages, derived)
    parts, notices = _parts(plan, stages, tasks, ended, made, polish)
    describes = judgement is None or judgement.adequate
    line_test = (
        None
        if interrupted or not plan.check_seeds
        else harmonic_test(problem, final, judged=describes)
    )
    simulated = bool(plan.check_seeds) or preliminary or not problem.control
    beyond = (
        () if simulated else tuple(n for task in tasks for n in second_order(settled(task)).notices)
    )
    return FitResult(
        success=success,
        message=message,
        adequacy=judgement,
        parts=parts,
        parameters=parameters,
        derived=derived,
        correlation=correlation_table(names, covariance),
        undetermined=common_scales(names, known),
        singular_values=known.singular_values,
        profile=None if line_test is None else (line_test.frequency, line_test.rise),
        harmonic_p_value=None if line_test is None else line_test.p_value,
        # the gravest first: a printed result shows few of them
        notices=(
            *unchecked,
            *ended.judged[1],
            *heavy,
            *reach_notices(derived, parts),
            *prior_notices(resting),
            *(narrow_notices(derived, parts) if describes else ()),
            *polish_notices(polish),
            *notices,
            *array_notices(tasks),
            *of_several(parts),
            *unsimulated(plan, stages),
            *beyond,
        ),
        unstated=(*other, *why, *twitch_notices(derived)),
        **common,
    )


def _six_digits(values: np.ndarray) -> tuple[float, ...]:
    """As `Start` keeps them."""
    return tuple(float(f"{value:.6g}") for value in values) if np.isfinite(values).all() else ()


class _Made(NamedTuple):
    """Moments of every fresh seed on a target's bins, the expected powers if they are simulated, a
    stretch of output."""

    each: Moments
    expected: np.ndarray | None
    stretch: tuple[np.ndarray, np.ndarray]


def _simulated(
    problem: FitProblem, part: Part, task: AbstractTask, moments: Moments, seeds: int
) -> _Made:
    """Of fresh seeds of the nonlinear model; the line as in linear response, as far as there is so
    much power."""
    still = settled(task) if problem.control else task
    key = fold_in(problem.key, 1)
    runs = runs_for_means(still, key, seeds)
    each, expected = controlled_moments(runs, part.target, task)
    power = np.asarray(each.power)[:, part.chosen]
    line = np.tile(np.minimum(moments.line, np.mean(power, axis=0)), (len(power), 1))
    each = each._replace(power=power, line=line)
    start = round((runs.time[-1] - STRETCH) * runs.rate)
    stretch = runs.time[start:], np.asarray(runs.output[0])[start:]
    return _Made(
        each, None if expected is None else np.asarray(expected.power)[part.chosen], stretch
    )


def _expected_only(moments: Moments) -> _Made:
    """Of the linear response, where nothing is simulated."""
    return _Made(
        jax.tree.map(lambda x: np.asarray(x)[None], moments), None, (np.zeros(0), np.zeros(0))
    )


def _observed(part: Part, each: Moments) -> dict[str, Any]:
    """What follows from the mean of the moments, where there is a spectrum."""
    return (
        observed(jax.tree.map(lambda x: np.mean(x, axis=0), each)) if len(part.target.bins) else {}
    )


def _parts(
    plan: Plan,
    stages: list[Stage],
    tasks: tuple[AbstractTask, ...],
    ended: Endpoint,
    made: list[_Made],
    polish: dict[str, float | int],
) -> tuple[dict[str, FittedPart], list[str]]:
    """Every target's spectrum, and what has to be said of it."""
    parts, notices, polished = {}, [], stages[-1].name == "polishing"
    for i, (part, task, moments, simulated) in enumerate(
        zip(plan.problem.parts, tasks, ended.seen.moments, made, strict=True)
    ):
        target, share = part.target, np.asarray(moments.line / moments.power)
        statistics, power = bin_statistics(target, share), np.mean(simulated.each.power, axis=0)
        fitted = np.asarray(power / power.sum())
        residual = standardised(np.asarray(target.proportional_power), fitted, statistics)
        check: dict[str, float | int] = {}
        if simulated.expected is not None:
            check = linear_check(np.asarray(simulated.each.power), simulated.expected, statistics)
        elif (
            polished
            and len(residual)
            and isinstance(model := stages[-1].objective.parts[i].model, Linear)
        ):
            check = {
                "largest_deviation": float(np.max(np.abs(np.asarray(model.correction.power) - 1)))
            }
        further = ended.further[i]
        own = [
            *notices_of(
                target,
                statistics,
                check | polish,
                unsettled(plan.problem, float(ended.found.values[i]["corner_frequency"])),
                plan.problem.method,
            ),
            *further_notices(further),
            *ended.signals[i].notices,
            *negative_coefficients(task),
        ]
        notices += own if len(tasks) == 1 else [f"{part.name}: {notice}" for notice in own]
        parts[part.name or target.name] = FittedPart(
            target=ended.signals[i].widened(target),
            task=task,
            chi2_per_bin=(
                float(np.sum(residual**2) / (len(residual) - 1))
                if statistics.known and len(residual)
                else None
            ),
            rms_log_error=(
                float(np.std(np.log(target.proportional_power / fitted))) if len(residual) else None
            ),
            fitted=fitted,
            harmonic_share=share,
            residual=residual,
            deviation=statistics.sd if statistics.known else None,
            components=_components(part, settled(task)) if plan.problem.control else {},
            stretch=simulated.stretch,
            recorded=_first_seconds(target),
            check=check | polish,
            further=further,
            stiffness=(
                None if part.points is None else np.array([1, 1j]) @ np.asarray(moments.stiffness)
            ),
        )
    return parts, notices


def _first_seconds(target: Target) -> tuple[np.ndarray, np.ndarray]:
    """Of the first trial, as long as the simulated stretch; nothing of a bare spectrum."""
    samples = next(iter(target.signals), np.zeros(0))[: round(STRETCH * RATE)]
    return np.arange(samples.size) / RATE, samples


def _components(part: Part, task: AbstractTask) -> dict[str, np.ndarray]:
    """Share of each bin's power that every part of the model has in linear response, of a settled
    task."""
    settings = part.target.settings
    sampled = trial_samples(part.target), recorded_interval(part.target, settings)

    def powers(task: AbstractTask) -> tuple[np.ndarray, list[np.ndarray]]:
        moments, _ = expected_moments(task, settings, WINDOW, *sampled)
        rhythms = [np.asarray(x)[part.chosen] for x in (moments.line, *moments.resonant)]
        return np.asarray(moments.power)[part.chosen], rhythms

    power, rhythms = powers(task)
    active, own = powers(with_active_noise(task))
    relaxation = active - np.sum(own, axis=0)
    floor = power - relaxation - np.sum(rhythms, axis=0)
    names = (
        "relaxation",
        "floor",
        "harmonic",
        "resonance",
        *(f"resonance_{i}" for i in range(2, len(rhythms))),
    )
    return {
        name: own / power for name, own in zip(names, (relaxation, floor, *rhythms), strict=False)
    }


def of_several(parts: dict[str, FittedPart]) -> tuple[str, ...]:
    """Spectra of one recording; tasks that do not differ although their targets' levels do."""
    aims = [(name, p.target) for name, p in parts.items()]
    twice = tuple(
        f"{a} and {b} state one source and different spectra: if that is one recording, its data"
        " count twice and the errors are too small; fit one of them"
        for (a, one), (b, two) in itertools.combinations(aims, 2)
        if one.source == two.source and one.settings != two.settings
    )
    levels = {
        name: p.target.mvc_fraction
        for name, p in parts.items()
        if p.target.mvc_fraction is not None
    }
    inputs = {
        tuple(
            float(parts[name].task[n])
            for n in ("P_w", "F_ext")
            if n in parts[name].task.parameter_names
        )
        for name in levels
    }
    if len(set(levels.values())) < 2 or len(inputs) > 1:
        return twice
    said = ", ".join(f"{name} {100 * level:.3g} % MVC" for name, level in levels.items())
    return (
        *twice,
        (
            f"the targets state different levels ({said}), but their tasks have the same forces:"
            " give a task for each"
        ),
    )


def unsimulated(plan: Plan, stages: list[Stage]) -> tuple[str, ...]:
    """What was left out of a fit."""
    if plan.check_seeds or not any(len(part.target.bins) for part in plan.problem.parts):
        return ()
    if len(plan.problem.parts) == 1:
        return (
            UNCHECKED if stages[-1].name == "polishing" or not plan.problem.control else TOGETHER,
        )
    if stages[-1].name == "polishing":
        return ()
    return (
        (
            "fitted by the formula alone. The correction by simulation was left out; usually it is"
            " 0.2 % of a bin"
        ),
    )


def _not_finite(problem: FitProblem) -> str:
    if problem.method != "linear":
        return (
            "none of the starts gives a finite spectrum: probably the simulation grows without"
            " limit. Lower the noise, or in Python dt"
        )
    if len(problem.parts) == 1:
        return (
            "none of the starts gives a spectrum: the muscle has no stable equilibrium, or no"
            f" noise moves {problem.parts[0].task.output_name} (noise on damping alone does nothing"
            " when nothing moves). Check the values that you fixed or gave"
        )
    return (
        "none of the starts gives a spectrum of every target: a task has no stable equilibrium, or"
        " no noise moves its output. Fit the targets one by one to see which"
    )


def _failed(problem: FitProblem, common: dict[str, Any], reason: str) -> FitResult:
    free = len(problem.coordinates.names)
    parts, notices = {}, []
    for part in problem.parts:
        notices += [
            n if len(problem.parts) == 1 else f"{part.name}: {n}" for n in part.target.notices
        ]
        nothing, none = np.full(len(part.target.bins), np.nan), (np.zeros(0), np.zeros(0))
        made = FittedPart(
            part.target,
            part.task,
            None,
            None,
            nothing,
            nothing,
            nothing,
            None,
            {},
            none,
            none,
            {},
            {},
        )
        parts[part.name or part.target.name] = made
    unknown = Identifiability.of_covariance(np.eye(free))
    tasks = tuple(part.task for part in problem.parts)
    return FitResult(
        success=False,
        message=reason,
        adequacy=None,
        parts=parts,
        derived={},
        correlation={},
        undetermined=(),
        parameters=parameter_table(problem, tasks, np.zeros((free, free)), unknown),
        profile=None,
        harmonic_p_value=None,
        singular_values=np.full(free, np.nan),
        notices=tuple(notices),
        unstated=(),
        **common,
    )
