"""From where a joint fit ended to its result: standard errors of what is shared, every target's spectrum, what is open."""

from typing import Any

import jax
import numpy as np
from scipy.linalg import block_diag

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.environment import versions
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._consequences import consequences, unit_of
from jaxmuscle.objective._covariance import (
    identifiability,
    parameter_covariance,
    residual_covariance,
    undetermined_directions,
)
from jaxmuscle.objective._least_squares import Descent
from jaxmuscle.objective._problem import Setup
from jaxmuscle.objective._starts import contenders, frequency_names, harmonic_frequencies
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._bin_law import bin_statistics, standardised

from ._checks import AMBIGUOUS, notices_of, seen_best, unsettled
from ._joint_problem import JointProblem, JointSetup
from ._joint_result import JointPart, JointResult
from ._report import correlation_table, derived_table, verdict
from ._result import Estimate, Start

SAME = 1e-9
OUTPUTS = ("coefficient_of_variation", "mean")


def report_joint(
    setup: JointSetup,
    problem: JointProblem,
    first: Descent,
    final: Descent,
    settings: dict[str, Any],
    seed: int | None,
    max_steps: int,
    nonlinearity: dict[str, float],
) -> JointResult:
    """The result of a joint fit that ended at the best point of `final`."""
    starts = tuple(
        Start(float(c) if np.isfinite(c) else None, bool(ok), int(n))
        for c, ok, n in zip(first.cost, first.settled, first.steps, strict=True)
    )
    common = {"starts": starts, "seed": seed, "settings": settings, "versions": versions()}
    if not np.isfinite(final.cost[final.best]):
        return _failed(setup, common)
    names = setup.coordinates.names
    seen = jax.tree.map(np.asarray, seen_best(problem, final))
    tasks = {name: as_numbers(task) for name, task in setup.tasks(seen.theta).items()}
    found = [jax.tree.map(np.asarray, consequences(part, problem.part_of(seen, i))) for i, part in enumerate(problem.parts)]
    residuals = np.concatenate([values[0] for values, _ in found])
    jacobian = np.concatenate([problem.spread(slopes[0], i) for i, (_, slopes) in enumerate(found)])
    shares = [moments.line / moments.power for moments in seen.moments]
    each = zip(setup.setups.values(), problem.parts, shares, strict=True)
    scatter = np.asarray(block_diag(*(residual_covariance(s, part, share) for s, part, share in each)))
    scaled = jacobian / np.sqrt(np.maximum(np.diag(scatter), 1.0))[:, None]
    known = identifiability(scaled)
    success, message = verdict(final, residuals, jacobian, setup.prior, seen.theta, known, starts, max_steps)
    covariance = parameter_covariance(jacobian, scatter, setup.prior)
    gradients = [{n: problem.spread(g, i) for n, g in slopes[1].items()} for i, (_, slopes) in enumerate(found)]
    tables = {name: derived_table(s, values[1], g, {}, covariance, scaled, setup.prior)
              for (name, s), (values, _), g in zip(setup.setups.items(), found, gradients, strict=True)}  # fmt: skip
    parameters = _parameters(setup, tasks, covariance, known.parameters)
    derived = _merged(tables, gradients)
    rivals, moved = _rivals(setup, first)
    parameters, derived = (_without_errors(moved, table) for table in (parameters, derived))
    parts = {name: _part(s, tasks[name], moments, nonlinearity.get(name))
             for (name, s), moments in zip(setup.setups.items(), seen.moments, strict=True)}  # fmt: skip
    return JointResult(
        success=success,
        message=message,
        parts=parts,
        parameters=parameters,
        derived=derived,
        correlation=correlation_table(names, covariance),
        undetermined=undetermined_directions(names, known),
        singular_values=known.singular_values,
        notices=_notices(setup, parts, rivals, nonlinearity),
        **common,
    )


def _part(setup: Setup, task: AbstractTask, moments: Moments, nonlinearity: float | None) -> JointPart:
    target, share = setup.target, np.asarray(moments.line / moments.power)
    statistics, fitted = bin_statistics(target, share), np.asarray(moments.proportional)
    residual = standardised(np.asarray(target.proportional_power), fitted, statistics)
    return JointPart(
        target=target,
        task=task,
        chi2_per_bin=float(np.sum(residual**2) / (len(residual) - 1)) if statistics.known else None,
        rms_log_error=float(np.std(np.log(target.proportional_power / fitted))),
        fitted=fitted,
        harmonic_share=share,
        residual=residual,
        deviation=statistics.sd if statistics.known else None,
        nonlinearity=nonlinearity,
    )


def _parameters(
    setup: JointSetup, tasks: dict[str, AbstractTask], covariance: np.ndarray, identifiable: np.ndarray
) -> dict[str, Estimate]:
    """Free parameters by joint name, then the fixed ones; a number that differs between tasks is named with its target.

    A proportional parameter, which is free but differs, is given for every target.
    """
    sd = np.sqrt(np.diag(covariance))
    free: dict[str, Estimate] = {}
    fixed: dict[str, dict[str, Estimate]] = {}
    for (target, s), columns in zip(setup.setups.items(), setup.columns, strict=True):
        task, own = tasks[target], s.coordinates.names
        slope = s.coordinates.slope(np.array([float(task[name]) for name in own]))
        for name, value in task.parameters.items():
            if name not in own:
                fixed.setdefault(name, {})[target] = Estimate(float(value), unit_of(name), None, False, True)
                continue
            column = columns[own.index(name)]
            joint = setup.coordinates.names[column]
            error = float(sd[column] * slope[own.index(name)]) if identifiable[column] else None
            made = Estimate(float(value), unit_of(name), error, True, bool(identifiable[column]))
            differs = joint in free and abs(free[joint].value - made.value) > SAME * abs(made.value)
            free[f"{joint}@{target}" if differs else joint] = made
    held = {}
    for name, values in fixed.items():
        holders = sum(name in task.parameter_names for task in tasks.values())
        same = len({p.value for p in values.values()}) == 1 and len(values) == holders
        held |= {name if same else f"{name}@{target}": p for target, p in values.items()}
    return free | held


def _merged(tables: dict[str, dict[str, Estimate]], gradients: list[dict[str, np.ndarray]]) -> dict[str, Estimate]:
    """Derived quantities: one entry where all targets have the same number for the same reason, else one for each."""
    merged: dict[str, Estimate] = {}
    first = next(iter(tables.values()))
    for name in first:
        values = np.array([table[name].value for table in tables.values()])
        slopes = np.stack([g[name] for g in gradients])
        same = np.allclose(values, values[0], rtol=SAME, atol=0) and np.allclose(slopes, slopes[0], rtol=SAME, atol=1e-300)
        if same and name not in OUTPUTS:
            merged[name] = first[name]
        else:
            merged |= {f"{name}@{target}": table[name] for target, table in tables.items()}
    # About a mean of zero the variation is infinite, and so is its prior: no measure of what the data determine.
    vague = [n for n, p in merged.items() if base_of(n) == OUTPUTS[0] and p.stderr is not None and p.stderr > p.value]
    return _without_errors(vague, merged)


def _rivals(setup: JointSetup, first: Descent) -> tuple[list[str], list[str]]:
    """Other minima that fit almost as well, in words, and which harmonic frequencies differ in them."""
    names, target = frequency_names(setup.coordinates), setup.finest
    chosen = contenders(setup.coordinates, target, first, AMBIGUOUS)
    if len(chosen) < 2:
        return [], []
    told, moved = [], []
    frequency = {name: harmonic_frequencies(setup.coordinates, first, name)[chosen] for name in names}
    for i in range(1, len(chosen)):
        differ = [n for n, f in frequency.items() if abs(f[i] - f[0]) >= target.settings.resolution]
        told.append(" with ".join(f"{n} {frequency[n][i]:.2f} Hz" for n in differ))
        moved += differ
    return told, sorted(set(moved))


def _without_errors(names: list[str], table: dict[str, Estimate]) -> dict[str, Estimate]:
    return {name: Estimate(p.value, p.unit, None, p.free, False) if name in names else p for name, p in table.items()}


def _notices(
    setup: JointSetup, parts: dict[str, JointPart], rivals: list[str], nonlinearity: dict[str, float]
) -> tuple[str, ...]:
    notices = []
    for name, s in setup.setups.items():
        statistics = bin_statistics(s.target, parts[name].harmonic_share)
        check: dict[str, float | int] = {"largest_deviation": nonlinearity.get(name, 0.0)}
        own = notices_of(s.target, statistics, [], check, unsettled(s, parts[name].task))
        notices += [f"{name}: {notice}" for notice in own]
    if rivals:
        notices.append(f"ambiguous: {' or '.join(rivals)} fits almost as well (log-likelihood within {AMBIGUOUS}); the "
                       "other numbers hold for what is shown")  # fmt: skip
    levels = {name: part.target.mvc_fraction for name, part in parts.items() if part.target.mvc_fraction is not None}
    inputs = {name: tuple(float(parts[name].task[n]) for n in ("P_w", "F_ext") if n in parts[name].task.parameter_names)
              for name in levels}  # fmt: skip
    if len(set(levels.values())) > 1 and len(set(inputs.values())) == 1:
        said = ", ".join(f"{name} {100 * level:.3g} % MVC" for name, level in levels.items())
        notices.append(f"the targets state different levels ({said}), but their tasks have the same forces: give tasks=")
    if not nonlinearity:
        notices.append("in linear response, without the nonlinear model's correction (0.2 % of a bin is usual)")
    return tuple(notices)


def _failed(setup: JointSetup, common: dict[str, Any]) -> JointResult:
    tasks = {name: s.task for name, s in setup.setups.items()}
    free = len(setup.coordinates.names)
    parameters = _parameters(setup, tasks, np.zeros((free, free)), np.zeros(free, dtype=bool))

    def part(s: Setup) -> JointPart:
        nothing = np.full(len(s.target.bins), np.nan)
        return JointPart(s.target, s.task, None, None, nothing, nothing, nothing, None, None)

    return JointResult(
        success=False,
        message="no start has a finite spectrum of every target in linear response: a task has no stable equilibrium there, "
        "or no noise that moves its output; fit the targets one by one to see which",
        parts={name: part(s) for name, s in setup.setups.items()}, parameters=parameters, derived={}, correlation={},
        undetermined=(), singular_values=np.full(free, np.nan),
        notices=tuple(f"{name}: {n}" for name, s in setup.setups.items() for n in s.target.notices), **common,
    )  # fmt: skip
