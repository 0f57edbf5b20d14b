"""From where a fit ended to its result: success in words, fresh spectrum, standard errors, what is undetermined."""

from typing import Any

import jax
import numpy as np

from jaxmuscle._common.arrays import as_arrays, as_numbers
from jaxmuscle._common.environment import versions
from jaxmuscle._common.errors import SimulationError
from jaxmuscle.ensembles._ensemble import ensemble
from jaxmuscle.objective._consequences import DERIVED, UNITS, consequences, jackknife, observed, unit_of
from jaxmuscle.objective._covariance import (
    Identifiability,
    identifiability,
    parameter_covariance,
    residual_covariance,
    undetermined_directions,
)
from jaxmuscle.objective._least_squares import SMALL, Descent
from jaxmuscle.objective._problem import Setup
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._linearised import settled
from jaxmuscle.spectra._bin_law import bin_statistics, standardised

from ._checks import (
    Stage,
    controlled_moments,
    linear_check,
    notices_of,
    polish_check,
    rival_frequencies,
    seen_best,
    unsettled,
)
from ._harmonic_evidence import harmonic_test
from ._result import Estimate, FitResult, Start

STRETCH = 5.0
TOGETHER = (
    "fitted together with other targets, in linear response and without simulation: fit it alone for the nonlinear "
    "correction, the check on simulated seeds, and the harmonic's profile and p-value"
)


def report_fit(
    setup: Setup,
    stages: list[Stage],
    check_seeds: int,
    settings: dict[str, Any],
    seed: int | None,
    max_steps: int,
    *,
    interrupted: bool,
) -> FitResult:
    """The result of a fit that ended at the best point of the last stage; `check_seeds` = 0 simulates nothing."""
    _, problem, final = stages[-1]
    first = stages[0].descent
    starts = tuple(
        Start(float(c) if np.isfinite(c) else None, bool(ok), int(n))
        for c, ok, n in zip(first.cost, first.settled, first.steps, strict=True)
    )
    common = {"target": setup.target, "method": setup.method, "starts": starts, "seed": seed,
              "settings": settings, "versions": versions()}  # fmt: skip
    if not np.isfinite(final.cost[final.best]):
        reason = "no start has a finite spectrum: the model explodes there; lower the noise or damping of the task"
        if setup.method == "linear":
            reason = ("no start has a finite spectrum in linear response: there is no stable equilibrium, or no noise that "
                      f"moves {setup.task.output_name} (noise on C does nothing at rest)")  # fmt: skip
        return _failed(setup, common, reason)
    seen = seen_best(problem, final)
    (residuals, quantities), (jacobian, found_slopes) = jax.tree.map(np.asarray, consequences(problem, seen))
    theta, moments = seen.theta, seen.moments
    task = as_numbers(setup.task.replace(**{n: float(v) for n, v in setup.coordinates.values(theta).items()}))
    try:
        each, expected, stretch = _simulated(setup, task, check_seeds) if check_seeds else _expected_only(moments)
    except (SimulationError, ValueError) as error:
        return _failed(setup, common, f"the fitted task cannot be simulated: {error}")
    power, share = np.mean(each.power, axis=0), moments.line / moments.power
    each = each._replace(line=np.tile(np.minimum(moments.line, power), (len(each.mean), 1)))
    values = quantities | observed(Moments(*(np.mean(x, axis=0) for x in each)))
    scatter = residual_covariance(setup, problem, share)
    scaled = jacobian / np.sqrt(np.maximum(np.diag(scatter), 1.0))[:, None]
    known = identifiability(scaled)
    success, message = verdict(final, residuals, jacobian, setup.prior, theta, known, starts, max_steps)
    if interrupted:
        success, message = False, f"interrupted after {int(final.steps.max())} steps; this is what had been reached"
    covariance = parameter_covariance(jacobian, scatter, setup.prior)
    statistics = bin_statistics(setup.target, share)
    fitted = power / power.sum()
    residual = standardised(np.asarray(setup.target.proportional_power), fitted, statistics)
    log_error = np.log(setup.target.proportional_power / fitted)
    rivals = rival_frequencies(setup, first if setup.method == "linear" else final)
    parameters = parameter_table(setup, task, covariance, known)
    found = derived_table(setup, values, found_slopes, jackknife(each), covariance, scaled, setup.prior)
    if rivals:
        parameters, found = without_error("harmonic_frequency", parameters), without_error("harmonic_frequency", found)
    check = {} if expected is None else linear_check(np.asarray(each.power), expected, statistics)
    check |= polish_check(setup, stages, found)
    notices = notices_of(setup.target, statistics, rivals, check, unsettled(setup, task))
    if not check_seeds:
        notices = (*notices, TOGETHER)
    line_test = None if interrupted or not check_seeds else harmonic_test(setup, final)
    return FitResult(
        success=success,
        message=message,
        task=task,
        parameters=parameters,
        derived=found,
        correlation=correlation_table(setup.coordinates.names, covariance),
        undetermined=undetermined_directions(setup.coordinates.names, known),
        singular_values=known.singular_values,
        chi2_per_bin=float(np.sum(residual**2) / (len(residual) - 1)) if statistics.known else None,
        rms_log_error=float(np.std(log_error)),
        fitted=fitted,
        harmonic_share=share,
        residual=residual,
        deviation=statistics.sd if statistics.known else None,
        stretch=stretch,
        profile=None if line_test is None else (line_test.frequency, line_test.rise),
        harmonic_p_value=None if line_test is None else line_test.p_value,
        check=check,
        notices=notices,
        **common,
    )


def _simulated(setup: Setup, task: Any, seeds: int) -> tuple[Moments, np.ndarray | None, tuple[np.ndarray, np.ndarray]]:
    """Moments of fresh seeds of the nonlinear model on the target's bins, the expected powers, a stretch of output."""
    still = as_numbers(settled(as_arrays(task))) if setup.control else task
    runs = ensemble(still, jax.random.fold_in(setup.key, 1), seeds=seeds)
    each, expected = controlled_moments(runs, setup.target)
    chosen = setup.target.bins - setup.target.settings.first_bin
    each = each._replace(power=np.asarray(each.power)[:, chosen])
    start = round((runs.time[-1] - STRETCH) * runs.rate)
    stretch = runs.time[start:], np.asarray(runs.output[0])[start:]
    return each, None if expected is None else np.asarray(expected.power)[chosen], stretch


def _expected_only(moments: Moments) -> tuple[Moments, None, tuple[np.ndarray, np.ndarray]]:
    """The same of the linear response, where nothing is simulated."""
    return Moments(*(np.asarray(x)[None] for x in moments)), None, (np.zeros(0), np.zeros(0))


def _failed(setup: Setup, common: dict[str, Any], reason: str) -> FitResult:
    nothing = np.full(len(setup.target.bins), np.nan)
    free = setup.coordinates.names
    parameters = {name: Estimate(float(value), unit_of(name), None, name in free, name not in free)
                  for name, value in setup.task.parameters.items()}  # fmt: skip
    return FitResult(
        success=False, message=reason, task=setup.task, parameters=parameters, derived={}, correlation={},
        undetermined=(), singular_values=np.full(len(free), np.nan), chi2_per_bin=None, rms_log_error=None,
        fitted=nothing, harmonic_share=nothing, residual=nothing, deviation=None, profile=None, harmonic_p_value=None,
        check={}, stretch=(np.zeros(0), np.zeros(0)), notices=setup.target.notices, **common,
    )  # fmt: skip


def verdict(
    final: Descent,
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


def parameter_table(setup: Setup, task: Any, covariance: np.ndarray, known: Identifiability) -> dict[str, Estimate]:
    names = setup.coordinates.names
    slope = setup.coordinates.slope(np.array([float(task[name]) for name in names]))
    errors = dict(zip(names, np.sqrt(np.diag(covariance)) * slope, strict=True))
    identifiable = dict(zip(names, known.parameters, strict=True))
    return {
        name: Estimate(
            float(value),
            unit_of(name),
            float(errors[name]) if identifiable.get(name) else None,
            name in errors,
            bool(identifiable.get(name, name not in errors)),
        )
        for name, value in task.parameters.items()
    }


def derived_table(
    setup: Setup,
    values: dict[str, Any],
    slopes: dict[str, Any],
    sampling: dict[str, float],
    covariance: np.ndarray,
    jacobian: np.ndarray,
    prior: np.ndarray,
) -> dict[str, Estimate]:
    """Derived quantities; one is determined if the data leave at most a tenth of its prior variance.

    Their errors are those of the parameters and, where a value comes from fresh seeds, their sampling error.
    """
    curvature = jacobian.T @ jacobian
    after = np.linalg.pinv(curvature + np.diag(prior), hermitian=True)
    before = np.diag(1 / np.maximum(prior, 1e-6))
    table = {}
    for name in DERIVED:
        value = values[name]
        g = np.asarray(slopes[name])
        free = bool(np.any(g != 0))
        determined = free and bool(g @ after @ g <= REDUCED * (g @ before @ g))
        stderr = float(np.hypot(np.sqrt(g @ covariance @ g), sampling.get(name, 0.0))) if determined else None
        unit = setup.task.output_unit if name == "mean" else UNITS.get(name, "1")
        table[name] = Estimate(float(value), unit, stderr, free, determined or not free)
    return table


def correlation_table(names: tuple[str, ...], covariance: np.ndarray) -> dict[str, Any]:
    sd = np.sqrt(np.diag(covariance))
    matrix = covariance / np.maximum(np.outer(sd, sd), 1e-300)
    return {"parameters": list(names), "matrix": matrix.tolist()}


def without_error(name: str, table: dict[str, Estimate]) -> dict[str, Estimate]:
    old = table[name]
    return table | {name: Estimate(old.value, old.unit, None, old.free, False)}
