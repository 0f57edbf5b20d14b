"""The tables of a fit's result: parameters and derived quantities with their errors, what the data
determine of them."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import SAME, base_of
from jaxmuscle.objective._covariance import Identifiability, common_scales
from jaxmuscle.objective._derived import MEAN, VARIATION, derived_names, unit_of
from jaxmuscle.objective._problem import FitProblem, Part

from ._intervals import Interval
from ._part import Estimate

OUTPUTS = (VARIATION, MEAN)
BASE = {"K_w0": "k_w", "K_z0": "k_z", "C_w0": "c_w", "C_z0": "c_z"}
STRAIGHT = 0.25  # error of a log up to which a quantity is as good as linear
VAGUE = 100.0  # from the lower to the upper end of an interval


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


def derived_table(
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
    for name in (n for n in derived_names(part.task, len(part.target.bins) > 0) if n in values):
        g = np.asarray(slopes[name])
        free = bool(np.any(g != 0))
        determined = free and known.determines(g)
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
