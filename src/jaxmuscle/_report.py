"""From where a fit ended to its result: success in words, fresh spectrum, standard errors, what is undetermined."""

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._descend import SMALL, Descent
from ._objective import Moments, at
from ._operating import slowest_rate
from ._parameter import PARAMETERS, as_arrays, as_numbers
from ._result import Estimate, FitResult, Start
from ._simulate import SimulationError, ensemble
from ._starts import contenders, harmonic_frequencies
from ._trajectory import WINDOW, versions
from ._uncertainty import (
    BinStatistics,
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

if TYPE_CHECKING:
    from ._fit import Problem, _Setup

STRETCH = 5.0
REDUCED = 0.1
AMBIGUOUS = 1.92
UNITS = {
    "corner_frequency": "Hz",
    "harmonic_frequency": "Hz",
    "K_w0": "N/m",
    "K_z0": "N/m",
    "C_w0": "N s/m",
    "C_z0": "N s/m",
}


@eqx.filter_jit
def _linearised(problem: Any, theta: Any) -> tuple[Any, ...]:
    """Moments, data residuals and derived quantities at θ, with their Jacobians."""

    def everything(theta):
        moments = problem.moments(theta)
        values = (
            moments,
            problem.data_residuals(moments),
            derived(at(problem.task, problem.coordinates, theta), moments),
        )
        return values, values

    slopes, values = jax.jacfwd(everything, has_aux=True)(theta)
    return values, slopes


def derived(task: Any, moments: Moments) -> dict[str, Any]:
    """What the data can determine.

    `corner_frequency` |λ_slow|/2π of the operating point; `harmonic_share` of the compared power; `harmonic_frequency`;
    `high_frequency_floor`, mean proportional power per bin over the highest third of the bins; the base coefficients;
    `coefficient_of_variation` and `mean` of the output.
    """
    base, seen = task.muscle.base(), observed(moments)
    return {
        "corner_frequency": slowest_rate(task) / (2 * jnp.pi),
        "harmonic_share": seen["harmonic_share"],
        "harmonic_frequency": task.harmonic.frequency * jnp.ones(()),
        "high_frequency_floor": seen["high_frequency_floor"],
        "K_w0": base[0],
        "K_z0": base[1],
        "C_w0": base[2],
        "C_z0": base[3],
        "coefficient_of_variation": seen["coefficient_of_variation"],
        "mean": seen["mean"],
    }


def observed(moments: Moments) -> dict[str, Any]:
    """Those derived quantities that follow from simulated moments."""
    upper = moments.power.shape[0] // 3
    return {
        "harmonic_share": jnp.sum(moments.line) / jnp.sum(moments.power),
        "high_frequency_floor": jnp.mean(moments.proportional[-upper:]),
        "coefficient_of_variation": moments.variation,
        "mean": moments.mean,
    }


def _jackknife(each: Moments) -> dict[str, float]:
    """Standard errors of the observed quantities from the moments of every seed."""
    count = len(each.mean)
    if count < 2:
        return {}
    without = jax.tree.map(lambda x: (x.sum(0) - x) / (count - 1), each)
    return {name: float(np.std(v) * np.sqrt(count - 1)) for name, v in jax.vmap(observed)(without).items()}


def report_fit(
    setup: "_Setup",
    problem: "Problem",
    reached: list[Descent],
    check_seeds: int,
    settings: dict[str, Any],
    seed: int | None,
    max_steps: int,
    *,
    interrupted: bool,
) -> FitResult:
    """The result of a fit that ended at the best point of the last descent."""
    final = reached[-1]
    starts = tuple(
        Start(float(c) if np.isfinite(c) else None, bool(ok), int(n))
        for c, ok, n in zip(reached[0].cost, reached[0].settled, reached[0].steps, strict=True)
    )
    common = {"target": setup.target, "method": "montecarlo", "starts": starts, "seed": seed,
              "settings": settings, "versions": versions()}  # fmt: skip
    cost = final.cost[final.best]
    if not np.isfinite(cost):
        reason = "no start has a finite spectrum: the model explodes there; lower the noise or damping of the task"
        return _failed(setup, common, reason)
    theta = np.asarray(setup.coordinates.theta(jnp.asarray(final.s[final.best])))
    (moments, residuals, _), (_, jacobian, found_slopes) = _linearised(problem, jnp.asarray(theta))
    residuals, jacobian = np.asarray(residuals), np.asarray(jacobian)
    task = as_numbers(setup.task.replace(**{n: float(v) for n, v in setup.coordinates.values(jnp.asarray(theta)).items()}))
    try:
        runs = ensemble(task, jax.random.fold_in(setup.key, 1), seeds=check_seeds)
    except (SimulationError, ValueError) as error:
        return _failed(setup, common, f"the fitted task cannot be simulated: {error}")
    chosen = setup.target.bins - setup.target.settings.first_bin
    powers = np.asarray(runs.spectrum().power)[:, chosen]
    power = powers.mean(axis=0)
    line = np.minimum(np.asarray(moments.line), power)
    share = np.asarray(moments.line / moments.power)
    held = np.asarray(runs.between(WINDOW))
    each = Moments(*map(jnp.asarray, (powers, np.tile(line, (len(powers), 1)), held.mean(axis=1), held.var(axis=1))))
    values = derived(as_arrays(task), jax.tree.map(lambda x: x.mean(axis=0), each))
    scatter = _residual_covariance(setup, problem, share)
    seen = jacobian / np.sqrt(np.maximum(np.diag(scatter), 1.0))[:, None]
    known = identifiability(seen)
    success, message = _verdict(final, residuals, jacobian, setup.prior, theta, known, starts, max_steps)
    if interrupted:
        success, message = False, f"interrupted after {int(final.steps.max())} steps; this is what had been reached"
    covariance = parameter_covariance(jacobian, scatter, setup.prior)
    statistics = bin_statistics(setup.target, share)
    fitted = power / power.sum()
    residual = standardised(np.asarray(setup.target.proportional_power), fitted, statistics)
    log_error = np.log(setup.target.proportional_power / fitted)
    start = round((runs.time[-1] - STRETCH) * runs.rate)
    rivals = rival_frequencies(setup, final)
    parameters = _parameters(setup, task, covariance, known)
    found = _derived(setup, values, found_slopes, _jackknife(each), covariance, seen, setup.prior)
    if rivals:
        parameters, found = _without_error("harmonic_frequency", parameters), _without_error("harmonic_frequency", found)
    return FitResult(
        success=success,
        message=message,
        task=task,
        parameters=parameters,
        derived=found,
        correlation=_correlation(setup.coordinates.names, covariance),
        undetermined=undetermined_directions(setup.coordinates.names, known),
        singular_values=known.singular_values,
        chi2_per_bin=float(np.sum(residual**2) / (len(residual) - 1)) if statistics.known else None,
        rms_log_error=float(np.std(log_error)),
        fitted=fitted,
        harmonic_share=share,
        residual=residual,
        deviation=statistics.sd if statistics.known else None,
        stretch=(runs.time[start:], np.asarray(runs.output[0])[start:]),
        notices=_notices(setup.target, statistics, rivals),
        **common,
    )


def _failed(setup: "_Setup", common: dict[str, Any], reason: str) -> FitResult:
    nothing = np.full(len(setup.target.bins), np.nan)
    free = setup.coordinates.names
    parameters = {name: Estimate(float(value), _unit(name), None, name in free, name not in free)
                  for name, value in setup.task.parameters.items()}  # fmt: skip
    return FitResult(
        success=False, message=reason, task=setup.task, parameters=parameters, derived={}, correlation={},
        undetermined=(), singular_values=np.full(len(free), np.nan), chi2_per_bin=None, rms_log_error=None,
        fitted=nothing, harmonic_share=nothing, residual=nothing, deviation=None,
        stretch=(np.zeros(0), np.zeros(0)), notices=setup.target.notices, **common,
    )  # fmt: skip


def _verdict(
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


def _residual_covariance(setup: "_Setup", problem: "Problem", share: np.ndarray) -> np.ndarray:
    """Covariance of the data residuals: scatter of the target and of the simulated mean."""
    target = setup.target
    start, stop = WINDOW
    per_seed = target.settings.degrees_of_freedom(target.settings.segments(round((stop - start) * target.settings.rate)))
    seeds = jax.tree.leaves(problem.model.noise)[0].shape[0] - 1
    variance = log_power_moments(per_seed * seeds)[1] * np.maximum(1 - share**2, 0.0)
    correlation = bin_correlation(target.settings, target.bins, (6,))
    simulated = np.sqrt(variance)[:, None] * correlation * np.sqrt(variance)
    measured = problem.statistics.covariance
    p = np.asarray(target.proportional_power)
    spread = _spread_map(problem, p)
    total = spread @ (measured + simulated) @ spread.T
    rows: list[float] = [1.0 + 0.25 * float(p @ simulated @ p) / float(extra[1]) ** 2 if i == 0 else 1.0
            for i, extra in enumerate(problem.extra) if extra is not None]  # fmt: skip
    return np.block([[total, np.zeros((len(total), len(rows)))], [np.zeros((len(rows), len(total))), np.diag(rows)]])


def _spread_map(problem: "Problem", p: np.ndarray) -> np.ndarray:
    """How the spectrum's residuals move with the log powers."""
    n = len(p)
    if problem.residual == "log":
        return (np.eye(n) - 1 / n) / problem.statistics.sd[:, None]
    if problem.residual == "linear":
        return shares_map(p) / problem.sigma[:, None]
    return (np.tril(np.ones((n, n))) @ shares_map(p) / problem.sigma[:, None])[:-1]


def _unit(name: str) -> str:
    return PARAMETERS[name].unit if name in PARAMETERS else ""


def _parameters(setup: "_Setup", task: Any, covariance: np.ndarray, known: Identifiability) -> dict[str, Estimate]:
    names = setup.coordinates.names
    slope = setup.coordinates.slope(np.array([float(task[name]) for name in names]))
    errors = dict(zip(names, np.sqrt(np.diag(covariance)) * slope, strict=True))
    identifiable = dict(zip(names, known.parameters, strict=True))
    return {
        name: Estimate(
            float(value),
            _unit(name),
            float(errors[name]) if identifiable.get(name) else None,
            name in errors,
            bool(identifiable.get(name, name not in errors)),
        )
        for name, value in task.parameters.items()
    }


def _derived(
    setup: "_Setup",
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
    for name, value in values.items():
        g = np.asarray(slopes[name])
        free = bool(np.any(g != 0))
        determined = free and bool(g @ after @ g <= REDUCED * (g @ before @ g))
        stderr = float(np.hypot(np.sqrt(g @ covariance @ g), sampling.get(name, 0.0))) if determined else None
        unit = setup.task.output_unit if name == "mean" else UNITS.get(name, "1")
        table[name] = Estimate(float(value), unit, stderr, free, determined or not free)
    return table


def _correlation(names: tuple[str, ...], covariance: np.ndarray) -> dict[str, Any]:
    sd = np.sqrt(np.diag(covariance))
    matrix = covariance / np.maximum(np.outer(sd, sd), 1e-300)
    return {"parameters": list(names), "matrix": matrix.tolist()}


def rival_frequencies(setup: "_Setup", final: Descent) -> list[float]:
    """Harmonic frequencies of other minima that fit almost as well as the best one, best first [Hz].

    Almost as well: a cost `½ Σ r²` within 1.92 of the lowest, half the 95 % quantile of χ² with one degree of freedom, so
    that a likelihood interval for the frequency would contain them.
    """
    chosen = contenders(setup.coordinates, setup.target, final, AMBIGUOUS)
    if len(chosen) < 2:
        return []
    frequency = harmonic_frequencies(setup.coordinates, final)
    return [float(frequency[i]) for i in chosen[1:]]


def _without_error(name: str, table: dict[str, Estimate]) -> dict[str, Estimate]:
    old = table[name]
    return table | {name: Estimate(old.value, old.unit, None, old.free, False)}


def _notices(target: Any, statistics: BinStatistics, rivals: list[float]) -> tuple[str, ...]:
    notices = list(target.notices)
    if not statistics.known:
        notices.append("the target states neither segments nor sigma: every bin counts alike and there is no chi2")
    if rivals:
        others = " and ".join(f"{f:.2f} Hz" for f in rivals)
        notices.append(f"harmonic_frequency is ambiguous: {others} fits almost as well (log-likelihood within {AMBIGUOUS}); "
                       "the other numbers hold for the frequency shown")  # fmt: skip
    return tuple(notices)
