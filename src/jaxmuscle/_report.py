"""From where a fit ended to its result: success in words, fresh spectrum, standard errors, what is undetermined."""

from typing import Any

import jax
import numpy as np

from ._check import (
    Stage,
    controlled_moments,
    linear_check,
    notices_of,
    polish_check,
    rival_frequencies,
    seen_best,
    unsettled,
)
from ._derived import (
    consequences,
    correlation_table,
    derived_table,
    jackknife,
    observed,
    parameter_table,
    unit_of,
    without_error,
)
from ._descend import SMALL, Descent
from ._ensemble import ensemble
from ._expected import Moments
from ._harmonic_test import harmonic_test
from ._linear import settled
from ._objective import MonteCarlo
from ._parameter import as_arrays, as_numbers
from ._problem import Problem, Setup
from ._result import Estimate, FitResult, Start
from ._simulate import SimulationError
from ._trajectory import WINDOW, versions
from ._uncertainty import (
    Identifiability,
    bin_correlation,
    bin_statistics,
    identifiability,
    log_power_moments,
    parameter_covariance,
    shares_map,
    standardised,
    undetermined_directions,
)

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


def residual_covariance(setup: Setup, problem: Problem, share: np.ndarray) -> np.ndarray:
    """Covariance of the data residuals: scatter of the target and of the simulated mean."""
    target = setup.target
    start, stop = WINDOW
    per_seed = target.settings.degrees_of_freedom(target.settings.segments(round((stop - start) * target.settings.rate)))
    # A linear response has no sampling error, and a control variate leaves next to nothing of it.
    model = problem.model
    plain = model if isinstance(model, MonteCarlo) and not model.control else None
    each = 0.0 if plain is None else log_power_moments(per_seed * plain.seeds)[1]
    variance = each * np.maximum(1 - share**2, 0.0)
    correlation = bin_correlation(target.settings, target.bins, (6,))
    simulated = np.sqrt(variance)[:, None] * correlation * np.sqrt(variance)
    measured = problem.statistics.covariance
    p = np.asarray(target.proportional_power)
    spread = _spread_map(problem, p)
    total = spread @ (measured + simulated) @ spread.T
    rows: list[float] = [1.0 + 0.25 * float(p @ simulated @ p) / float(extra[1]) ** 2 if i == 0 else 1.0
            for i, extra in enumerate(problem.data.extra) if extra is not None]  # fmt: skip
    return np.block([[total, np.zeros((len(total), len(rows)))], [np.zeros((len(rows), len(total))), np.diag(rows)]])


def _spread_map(problem: Problem, p: np.ndarray) -> np.ndarray:
    """How the spectrum's residuals move with the log powers."""
    n = len(p)
    if problem.residual == "log":
        return (np.eye(n) - 1 / n) / problem.statistics.sd[:, None]
    if problem.residual == "linear":
        return shares_map(p) / problem.data.sigma[:, None]
    return (np.tril(np.ones((n, n))) @ shares_map(p) / problem.data.sigma[:, None])[:-1]
