"""The tables of a fit: parameters, and what the data determine of their combinations."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._descend import Seen
from ._expected import Moments
from ._objective import at
from ._operating import slowest_rate
from ._parameter import PARAMETERS
from ._problem import Setup
from ._result import Estimate
from ._uncertainty import Identifiability

REDUCED = 0.1
DERIVED = ("corner_frequency", "harmonic_share", "harmonic_frequency", "high_frequency_floor", "K_w0", "K_z0", "C_w0",
           "C_z0", "coefficient_of_variation", "mean")  # fmt: skip
UNITS = {
    "corner_frequency": "Hz",
    "harmonic_frequency": "Hz",
    "K_w0": "N/m",
    "K_z0": "N/m",
    "C_w0": "N s/m",
    "C_z0": "N s/m",
}


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
        "harmonic_share": moments.line.sum() / moments.power.sum(),
        "high_frequency_floor": moments.proportional[-upper:].mean(),
        "coefficient_of_variation": moments.variation,
        "mean": moments.mean,
    }


def jackknife(each: Moments) -> dict[str, float]:
    """Standard errors of the observed quantities from the moments of every seed."""
    count = len(each.mean)
    if count < 2:
        return {}
    left_out = [observed(Moments(*((x.sum(axis=0) - x[i]) / (count - 1) for x in each))) for i in range(count)]
    return {name: float(np.std([o[name] for o in left_out]) * np.sqrt(count - 1)) for name in left_out[0]}


def unit_of(name: str) -> str:
    return PARAMETERS[name].unit if name in PARAMETERS else ""


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


@eqx.filter_jit
def consequences(problem: Any, seen: Seen) -> tuple[Any, Any]:
    """Data residuals and derived quantities at the point where the model was seen, and their slopes with respect to θ."""

    def everything(theta):
        moments = seen.nearby(theta)
        task = at(problem.task, problem.coordinates, theta)
        values = problem.data_residuals(moments, problem.data), derived(task, moments)
        return values, values

    slopes, values = jax.jacfwd(everything, has_aux=True)(seen.theta)
    return values, slopes
