"""From where a fit ended to its result: success in words, fresh spectrum, standard errors, what is undetermined."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.linalg import block_diag

from jaxmuscle._common.environment import versions
from jaxmuscle._common.errors import SimulationError
from jaxmuscle._common.keys import fold_in
from jaxmuscle.ensembles._ensemble import ensemble
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import SAME, Plan, base_of
from jaxmuscle.objective._consequences import DERIVED, consequences, jackknife, observed, unit_of
from jaxmuscle.objective._covariance import (
    Identifiability,
    identifiability,
    parameter_covariance,
    residual_covariance,
    undetermined_directions,
)
from jaxmuscle.objective._least_squares import SMALL, Minima
from jaxmuscle.objective._moment_models import Linear
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._linearised import settled
from jaxmuscle.spectra._bin_law import bin_statistics, standardised

from ._checks import (
    Stage,
    ambiguity,
    controlled_moments,
    linear_check,
    notices_of,
    polish_check,
    polish_notices,
    rivals,
    seen_best,
    unsettled,
)
from ._harmonic_evidence import harmonic_test
from ._part import Estimate, FittedPart, Start
from ._result import FitResult

OUTPUTS = ("coefficient_of_variation", "mean")
STRETCH = 5.0
UNCHECKED = "not checked on simulated seeds; no profile over the harmonic's frequency and no p-value (check_seeds=0)"
TOGETHER = (
    "in linear response alone: no nonlinear correction, no check on simulated seeds, no profile and p-value of the "
    "harmonic; a fit of this target by itself has them"
)


def report_fit(plan: Plan, stages: list[Stage], *, interrupted: bool = False) -> FitResult:
    """The result of a fit that ended at the best point of the last stage; with no `check_seeds` nothing is simulated."""
    problem, objective, final = plan.problem, stages[-1].objective, stages[-1].minima
    first = stages[0].minima
    starts = tuple(
        Start(float(c) if np.isfinite(c) else None, bool(ok), int(n))
        for c, ok, n in zip(first.cost, first.settled, first.steps, strict=True)
    )
    common = {"method": problem.method, "starts": starts, "seed": plan.seed, "settings": plan.settings,
              "versions": versions()}  # fmt: skip
    if not np.isfinite(final.cost[final.best]):
        return _failed(problem, common, _not_finite(problem))
    seen = seen_best(objective, final)
    theta, tasks = seen.theta, problem.tasks_at(seen.theta)
    try:
        made = [_simulated(problem, part, task, plan.check_seeds) if plan.check_seeds else _expected_only(moments)
                for part, task, moments in zip(problem.parts, tasks, seen.moments, strict=True)]  # fmt: skip
    except (SimulationError, ValueError) as error:
        return _failed(problem, common, f"the fitted task cannot be simulated: {error}")
    found = consequences(objective, seen)
    shares = [moments.line / moments.power for moments in seen.moments]
    made = [m._replace(each=m.each._replace(line=np.tile(np.minimum(x.line, np.mean(m.each.power, axis=0)),
                                                         (len(m.each.mean), 1))))
            for m, x in zip(made, seen.moments, strict=True)]  # fmt: skip
    scatter = np.asarray(
        block_diag(
            *(
                residual_covariance(part.target, own, share)
                for part, own, share in zip(problem.parts, objective.parts, shares, strict=True)
            )
        )
    )
    scaled = found.jacobian / np.sqrt(np.maximum(np.diag(scatter), 1.0))[:, None]
    known = identifiability(scaled)
    success, message = verdict(final, found.residuals, found.jacobian, problem.prior, theta, known, starts, plan.max_steps)
    if interrupted:
        success, message = False, f"interrupted after {int(final.steps.max())} steps; this is what had been reached"
    covariance = parameter_covariance(found.jacobian, scatter, problem.prior)
    sizes = _Sizes(covariance, scaled, problem.prior)
    tables = [derived_table(part, values | observed(_mean(m.each)), slopes, jackknife(m.each), sizes)
              for part, values, slopes, m in zip(problem.parts, found.values, found.slopes, made, strict=True)]  # fmt: skip
    parameters = parameter_table(problem, tasks, covariance, known)
    derived = merged(problem, tables, found.slopes)
    told, moved = rivals(problem, first if problem.method == "linear" else final)
    parameters, derived = (_without_errors(moved, table) for table in (parameters, derived))
    polish = polish_check(problem, stages, derived)
    parts, notices = _parts(plan, stages, tasks, seen.moments, made, polish)
    line_test = None if interrupted or not plan.check_seeds else harmonic_test(problem, final)
    return FitResult(
        success=success,
        message=message,
        parts=parts,
        parameters=parameters,
        derived=derived,
        correlation=correlation_table(problem.coordinates.names, covariance),
        undetermined=undetermined_directions(problem.coordinates.names, known),
        singular_values=known.singular_values,
        profile=None if line_test is None else (line_test.frequency, line_test.rise),
        harmonic_p_value=None if line_test is None else line_test.p_value,
        notices=(*notices, *ambiguity(told, moved), *polish_notices(polish), *of_several(parts), *unsimulated(plan, stages)),
        **common,
    )


class _Made(NamedTuple):
    """Moments of every fresh seed on a target's bins, the expected powers if they are simulated, a stretch of output."""

    each: Moments
    expected: np.ndarray | None
    stretch: tuple[np.ndarray, np.ndarray]


def _simulated(problem: FitProblem, part: Part, task: AbstractTask, seeds: int) -> _Made:
    """Of fresh seeds of the nonlinear model."""
    still = settled(task) if problem.control else task
    runs = ensemble(still, fold_in(problem.key, 1), seeds=seeds)
    each, expected = controlled_moments(runs, part.target)
    each = each._replace(power=np.asarray(each.power)[:, part.chosen])
    start = round((runs.time[-1] - STRETCH) * runs.rate)
    stretch = runs.time[start:], np.asarray(runs.output[0])[start:]
    return _Made(each, None if expected is None else np.asarray(expected.power)[part.chosen], stretch)


def _expected_only(moments: Moments) -> _Made:
    """Of the linear response, where nothing is simulated."""
    return _Made(jax.tree.map(lambda x: np.asarray(x)[None], moments), None, (np.zeros(0), np.zeros(0)))


def _mean(each: Moments) -> Moments:
    return jax.tree.map(lambda x: np.mean(x, axis=0), each)


def _parts(
    plan: Plan,
    stages: list[Stage],
    tasks: tuple[AbstractTask, ...],
    seen: tuple[Moments, ...],
    made: list[_Made],
    polish: dict[str, float | int],
) -> tuple[dict[str, FittedPart], list[str]]:
    """Every target's spectrum, and what has to be said of it."""
    parts, notices = {}, []
    for i, (part, task, moments, simulated) in enumerate(zip(plan.problem.parts, tasks, seen, made, strict=True)):
        target, share = part.target, np.asarray(moments.line / moments.power)
        statistics, power = bin_statistics(target, share), np.mean(simulated.each.power, axis=0)
        fitted = np.asarray(power / power.sum())
        residual = standardised(np.asarray(target.proportional_power), fitted, statistics)
        check: dict[str, float | int] = {}
        if simulated.expected is not None:
            check = linear_check(np.asarray(simulated.each.power), simulated.expected, statistics)
        elif isinstance(model := stages[-1].objective.parts[i].model, Linear) and stages[-1].name == "polishing":
            check = {"largest_deviation": float(np.max(np.abs(np.asarray(model.correction.power) - 1)))}
        own = notices_of(target, statistics, check, unsettled(plan.problem, moments))
        notices += own if len(tasks) == 1 else [f"{part.name}: {notice}" for notice in own]
        parts[part.name or target.name] = FittedPart(
            target=target,
            task=task,
            chi2_per_bin=float(np.sum(residual**2) / (len(residual) - 1)) if statistics.known else None,
            rms_log_error=float(np.std(np.log(target.proportional_power / fitted))),
            fitted=fitted,
            harmonic_share=share,
            residual=residual,
            deviation=statistics.sd if statistics.known else None,
            stretch=simulated.stretch,
            check=check | polish,
        )
    return parts, notices


def of_several(parts: dict[str, FittedPart]) -> tuple[str, ...]:
    """Tasks that do not differ although their targets' levels do."""
    levels = {name: p.target.mvc_fraction for name, p in parts.items() if p.target.mvc_fraction is not None}
    inputs = {tuple(float(parts[name].task[n]) for n in ("P_w", "F_ext") if n in parts[name].task.parameter_names)
              for name in levels}  # fmt: skip
    if len(set(levels.values())) < 2 or len(inputs) > 1:
        return ()
    said = ", ".join(f"{name} {100 * level:.3g} % MVC" for name, level in levels.items())
    return (f"the targets state different levels ({said}), but their tasks have the same forces: give tasks=",)


def unsimulated(plan: Plan, stages: list[Stage]) -> tuple[str, ...]:
    """What was left out of a fit."""
    if plan.check_seeds:
        return ()
    if len(plan.problem.parts) == 1:
        return (UNCHECKED if stages[-1].name == "polishing" else TOGETHER,)
    if stages[-1].name == "polishing":
        return ()
    return ("in linear response, without the nonlinear model's correction (0.2 % of a bin is usual)",)


def _not_finite(problem: FitProblem) -> str:
    if problem.method != "linear":
        return "no start has a finite spectrum: the model explodes there; lower the noise or damping of the task"
    if len(problem.parts) == 1:
        return ("no start has a finite spectrum in linear response: there is no stable equilibrium, or no noise that "
                f"moves {problem.parts[0].task.output_name} (noise on C does nothing at rest)")  # fmt: skip
    return ("no start has a finite spectrum of every target in linear response: a task has no stable equilibrium there, or "
            "no noise that moves its output; fit the targets one by one to see which")  # fmt: skip


def _failed(problem: FitProblem, common: dict[str, Any], reason: str) -> FitResult:
    free = len(problem.coordinates.names)
    parts, notices = {}, []
    for part in problem.parts:
        notices += [n if len(problem.parts) == 1 else f"{part.name}: {n}" for n in part.target.notices]
        nothing, none = np.full(len(part.target.bins), np.nan), (np.zeros(0), np.zeros(0))
        made = FittedPart(part.target, part.task, None, None, nothing, nothing, nothing, None, none, {})
        parts[part.name or part.target.name] = made
    unknown = identifiability(np.zeros((free, free)))
    tasks = tuple(part.task for part in problem.parts)
    return FitResult(
        success=False, message=reason, parts=parts, derived={}, correlation={}, undetermined=(),
        parameters=parameter_table(problem, tasks, np.zeros((free, free)), unknown), profile=None, harmonic_p_value=None,
        singular_values=np.full(free, np.nan), notices=tuple(notices),
        **common,
    )  # fmt: skip


def verdict(
    final: Minima,
    residuals: np.ndarray,
    jacobian: np.ndarray,
    prior: np.ndarray,
    theta: np.ndarray,
    known: Identifiability,
    starts: tuple[Start, ...],
    max_steps: int,
) -> tuple[bool, str]:
    """Success: a further step gains less than a thousandth of the cost, or only runs along what is not determined."""
    cost = final.cost[final.best]
    curvature = jacobian.T @ jacobian + np.diag(prior)
    gradient = jacobian.T @ residuals + prior * theta
    step = -np.linalg.pinv(curvature, hermitian=True) @ gradient
    gain = -0.5 * gradient @ step / max(cost, 1e-300)
    finite = [s.cost for s in starts if s.cost is not None]
    near = sum(c <= 1.05 * min(finite) for c in finite) if finite else 0
    census = f"{near} of {len(starts)} starts came within 5 % of the best"
    if final.settled[final.best] or gain < SMALL:
        return True, f"one more step would lower the cost by less than 0.1 %; {census}"
    along = known.directions[~known.determined] @ step
    if along @ along >= 0.9 * (step @ step):
        return True, f"stopped after {max_steps} steps along a direction that the data do not determine; {census}"
    return False, (f"after {max_steps} steps one more would still lower the cost by {100 * gain:.2g} %; "
                   f"raise max_steps or give more starts")  # fmt: skip


REDUCED = 0.1


def parameter_table(
    problem: FitProblem, tasks: Sequence[AbstractTask], covariance: np.ndarray, known: Identifiability
) -> dict[str, Estimate]:
    """Free parameters by name, then the fixed ones; a number that differs between tasks is named with its target.

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
                fixed.setdefault(name, {})[part.name] = Estimate(float(value), unit_of(name), None, False, True)
                continue
            column = part.columns[own.index(name)]
            joint = problem.coordinates.names[column]
            error = float(sd[column] * slope[own.index(name)]) if identifiable[column] else None
            made = Estimate(float(value), unit_of(name), error, True, bool(identifiable[column]))
            differs = joint in free and abs(free[joint].value - made.value) > SAME * abs(made.value)
            free[f"{joint}@{part.name}" if differs else joint] = made
    held = {}
    for name, values in fixed.items():
        holders = sum(name in task.parameter_names for task in tasks)
        same = len({p.value for p in values.values()}) == 1 and len(values) == holders
        held |= {name if same else f"{name}@{target}": p for target, p in values.items()}
    table = free | held
    return {name: table[name] for name in tasks[0].parameter_names} if len(tasks) == 1 else table


class _Sizes(NamedTuple):
    """What errors of derived quantities follow from: covariance of θ, scaled Jacobian of the data, prior precision."""

    covariance: np.ndarray
    jacobian: np.ndarray
    prior: np.ndarray


def derived_table(
    part: Part, values: dict[str, Any], slopes: dict[str, Any], sampling: dict[str, float], sizes: _Sizes
) -> dict[str, Estimate]:
    """Derived quantities; one is determined if the data leave at most a tenth of its prior variance.

    Their errors are those of the parameters and, where a value comes from fresh seeds, their sampling error.
    """
    after = np.linalg.pinv(sizes.jacobian.T @ sizes.jacobian + np.diag(sizes.prior), hermitian=True)
    before = np.diag(1 / np.maximum(sizes.prior, 1e-6))
    table = {}
    for name in DERIVED:
        g = np.asarray(slopes[name])
        free = bool(np.any(g != 0))
        determined = free and bool(g @ after @ g <= REDUCED * (g @ before @ g))
        stderr = float(np.hypot(np.sqrt(g @ sizes.covariance @ g), sampling.get(name, 0.0))) if determined else None
        table[name] = Estimate(
            float(values[name]), unit_of(name, part.task.output_unit), stderr, free, determined or not free
        )
    return table


def merged(problem: FitProblem, tables: list[dict[str, Estimate]], slopes: Any) -> dict[str, Estimate]:
    """Derived quantities: one entry where all targets have the same number for the same reason, else one for each."""
    found: dict[str, Estimate] = {}
    for name in tables[0]:
        values = np.array([table[name].value for table in tables])
        rows = np.stack([g[name] for g in slopes])
        same = np.allclose(values, values[0], rtol=SAME, atol=0) and np.allclose(rows, rows[0], rtol=SAME, atol=1e-300)
        if len(tables) == 1 or (same and name not in OUTPUTS):
            found[name] = tables[0][name]
        else:
            found |= {f"{name}@{part.name}": table[name] for part, table in zip(problem.parts, tables, strict=True)}
    # About a mean of zero the variation is infinite, and so is its prior: no measure of what the data determine.
    vague = [n for n, p in found.items() if base_of(n) == OUTPUTS[0] and p.stderr is not None and p.stderr > p.value]
    return _without_errors(vague, found)


def correlation_table(names: tuple[str, ...], covariance: np.ndarray) -> dict[str, Any]:
    sd = np.sqrt(np.diag(covariance))
    matrix = covariance / np.maximum(np.outer(sd, sd), 1e-300)
    return {"parameters": list(names), "matrix": matrix.tolist()}


def _without_errors(names: list[str], table: dict[str, Estimate]) -> dict[str, Estimate]:
    return {name: Estimate(p.value, p.unit, None, p.free, False) if name in names else p for name, p in table.items()}
