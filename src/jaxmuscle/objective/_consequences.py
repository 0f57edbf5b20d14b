"""What follows from a point θ: moments, their slopes, derived quantities."""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle.model._parameters import PARAMETERS, USUALLY_FREE
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._equilibrium import slowest_rate
from jaxmuscle.response._expected import Moments

from ._coordinates import Coordinates, at
from ._moment_models import Linear

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


BATCH = 32


class Seen(NamedTuple):
    """What a problem's model gives at some θ, and its slopes with respect to θ; a leading axis of points."""

    theta: Any
    moments: Any
    slopes: Any

    def nearby(self, theta: Float[Array, " free"]) -> Any:
        """The moments at another θ to first order (without the leading axis); exact, with exact slopes, at `self.theta`."""
        return jax.tree.map(lambda value, slope: value + slope @ (theta - self.theta), self.moments, self.slopes)


@eqx.filter_jit
def quantities(problem: Any, seen: Seen) -> tuple[dict[str, Array], dict[str, Array]]:
    """Derived quantities of every row where the model was seen, and their slopes with respect to θ."""

    def one(seen):
        def everything(theta):
            values = derived(at(problem.task, problem.coordinates, theta), seen.nearby(theta))
            return values, values

        slopes, values = jax.jacfwd(everything, has_aux=True)(seen.theta)
        return values, slopes

    return jax.vmap(one)(seen)


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


class _Response(eqx.Module):
    """What the moments of a linear response depend on, and nothing else, so that a program is used again."""

    model: Linear
    task: AbstractTask
    coordinates: Coordinates

    def moments(self, theta: Float[Array, " free"]) -> Moments:
        return self.model.moments(at(self.task, self.coordinates, theta))


@eqx.filter_jit
def _moments_and_slopes(problem: Any, theta: Float[Array | np.ndarray, "points free"]) -> tuple[Any, Any]:
    def one(theta):
        def twice(theta):
            moments = problem.moments(theta)
            return moments, moments

        slopes, moments = jax.jacfwd(twice, has_aux=True)(theta)
        return moments, slopes

    return jax.vmap(one)(theta)


@functools.singledispatch
def seen_at(problem: Any, theta: Float[np.ndarray, "points free"]) -> Seen:
    """The problem's moments and their slopes at every θ, as numbers.

    A linear response is computed for `BATCH` points at a time and with slopes also for what a fit usually leaves free, so
    that one compiled program serves any number of points and nearly any choice of free parameters; a Monte Carlo
    simulation for all points together, with the slopes that are asked for.
    """
    if not isinstance(problem.model, Linear):
        return Seen(theta, *jax.tree.map(np.asarray, _moments_and_slopes(problem, theta)))
    count, wide = len(theta), _with_the_usual(problem.coordinates, problem.task)
    own = np.array([wide.names.index(name) for name in problem.coordinates.names])
    padded = np.zeros((-(-count // BATCH) * BATCH, len(wide.names)))
    padded[:, own] = np.concatenate([theta, np.broadcast_to(theta[-1], (len(padded) - count, len(own)))])
    response = _Response(problem.model, problem.task, wide)
    parts = [_moments_and_slopes(response, batch) for batch in np.split(padded, len(padded) // BATCH)]
    moments, slopes = jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)
    return Seen(theta, moments, jax.tree.map(lambda slope: slope[..., own], slopes))


def _with_the_usual(coordinates: Coordinates, task: AbstractTask) -> Coordinates:
    """The coordinates and those of what is usually free, in one order whatever is asked for: θ = 0 is the task's value."""
    known = task.parameter_names
    names = tuple(dict.fromkeys([*(name for name in USUALLY_FREE if name in known), *coordinates.names]))
    given = {name: i for i, name in enumerate(coordinates.names)}
    rows = [(coordinates.centre[given[n]], coordinates.sd[given[n]], coordinates.positive[given[n]]) if n in given
            else (float(task[n]), 1.0, False) for n in names]  # fmt: skip
    centre, sd, positive = (np.array(column) for column in zip(*rows, strict=True))
    return Coordinates(names, centre, sd, positive, np.full(len(names), -np.inf), np.full(len(names), np.inf))
