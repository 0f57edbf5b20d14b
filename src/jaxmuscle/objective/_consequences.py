"""What follows from a point θ: moments, their slopes, derived quantities."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmuscle._common.programs import kept
from jaxmuscle.model._muscle import Muscle
from jaxmuscle.model._parameters import PARAMETERS, USUALLY_FREE
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._signals import AbstractSignal
from jaxmuscle.model._tasks import AbstractTask, PrescribedLength
from jaxmuscle.response._equilibrium import HOLD
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._fluctuations import BANDS, EDGES, in_bands

from ._coordinates import Coordinates, task_at
from ._moment_models import Linear
from ._residuals import PartResiduals, Residuals

DERIVED = ("corner_frequency", "half_power_frequency", "contraction_time", "tremor_frequency", "tremor_width",
           "tremor_share", "resonance_2_share", "harmonic_share", "harmonic_frequency", "high_frequency_floor",
           "K_w0", "K_z0", "C_w0", "C_z0", "K_w_tangent", "tangent_stiffness", "coefficient_of_variation", "mean",
           *BANDS)  # fmt: skip
UNITS = {
    "corner_frequency": "Hz",
    "half_power_frequency": "Hz",
    "contraction_time": "s",
    "tremor_frequency": "Hz",
    "tremor_width": "Hz",
    "harmonic_frequency": "Hz",
    "K_w0": "N/m",
    "K_z0": "N/m",
    "C_w0": "N s/m",
    "C_z0": "N s/m",
    "K_w_tangent": "N/m",
    "tangent_stiffness": "N/m",
}


MEANINGS = {
    "corner_frequency": "where the slow response of the muscle falls off",
    "half_power_frequency": "where muscle and activation together let half the power through",
    "contraction_time": "contraction time of a twitch",
    "tremor_frequency": "frequency of the tremor in the drive, before the muscle smooths it",
    "tremor_width": "full width of the tremor at half power",
    "tremor_share": "the tremor's share of the power, counted from half its frequency on",
    "resonance_2_share": "the second resonance's share of the power, counted from half its frequency on",
    "harmonic_share": "the harmonic's share of the power",
    "high_frequency_floor": "mean power of the highest third of the bins, a tremor included",
    "K_w0": "active stiffness at rest",
    "K_z0": "passive stiffness at rest",
    "C_w0": "active damping at rest",
    "C_z0": "passive damping at rest",
    "K_w_tangent": "active stiffness as stretched in the hold",
    "tangent_stiffness": "stiffness of both tissues in series, H(0)",
    "coefficient_of_variation": "standard deviation over mean of the output",
    "mean": "mean of the output",
    **{name: f"share of the power from {low:g} to {high:g} Hz" for name, (low, high) in BANDS.items()},
}


OF_SPECTRUM = {"harmonic_share", "harmonic_frequency", "high_frequency_floor", "tremor_frequency", "tremor_width",
               "tremor_share", "resonance_2_share", "coefficient_of_variation", "mean", *BANDS}  # fmt: skip


def derived_names(task: Any, spectrum: bool = True) -> tuple[str, ...]:
    """The derived quantities that a task has; without a spectrum among the data those of the muscle alone."""
    frequency, resonances = task.settings.frequency, sum(isinstance(n, ResonantNoise) for n in task.noise.components)
    covered = np.sum(in_bands(frequency, task.settings.resolution), axis=1) * task.settings.resolution
    bands = {name for name, there, width in zip(BANDS, covered, np.diff(EDGES), strict=True) if there >= 0.5 * width}
    missing = set(BANDS) - bands | (set() if spectrum else OF_SPECTRUM)
    missing |= set() if task.activation is not None else {"contraction_time"}
    missing |= set() if _moved(task) else {"K_w_tangent", "tangent_stiffness"}
    missing |= {"tremor_frequency", "tremor_width", "tremor_share"} if resonances < 1 else set()
    missing |= {"resonance_2_share"} if resonances < 2 else set()
    # About a mean of zero, and where the response begins with f².
    missing |= {"coefficient_of_variation", "mean", "half_power_frequency"} if task.quantity == "acceleration" else set()
    return tuple(name for name in DERIVED if name not in missing)


def _moved(task: Any) -> bool:
    """Whether a motor moves the insertion of the paper's muscle."""
    return type(task) is PrescribedLength and type(task.muscle) is Muscle


def tangents(task: Any, mean: Float[Array, ""]) -> dict[str, Float[Array, ""]]:
    """Stiffness of the active tissue [N/m] where the mean force stretches it, and of both tissues, slowly pulled.

    K_w_tangent = d(K_w x_w)/dx_w = k_w (x_ref² + 3 x_w²),   x_w = x_z + mean / K_z(x_z)
    tangent_stiffness = H(0) = a T / (T + K_z(x_z)),   T = K_w_tangent,   a = K_z(x_z) + 2 k_z x_z (x_z - x_w)
    """
    x_z = task.x_z(jnp.asarray(HOLD)) if isinstance(task.x_z, AbstractSignal) else task.x_z
    k_w, k_z, x_ref_w, x_ref_z = (task[name] for name in ("k_w", "k_z", "x_ref_w", "x_ref_z"))
    passive = k_z * (x_ref_z**2 + x_z**2)
    x_w = x_z + mean / passive
    active = k_w * (x_ref_w**2 + 3 * x_w**2)
    slope = passive + 2 * k_z * x_z * (x_z - x_w)
    return {"K_w_tangent": active, "tangent_stiffness": slope * active / (active + passive)}


def derived(task: Any, moments: Moments, frequency: Float[Array | np.ndarray, " bins"] | None = None) -> dict[str, Any]:
    """What the data can determine.

    `corner_frequency` |λ_slow|/2π of the operating point; `half_power_frequency` of the slow part, relaxation and activation
    together; `contraction_time`, where there is an activation; where there is a resonance `tremor_frequency`,
    `tremor_width` and `tremor_share` of the compared power, and `resonance_2_share` of a second one, both from half the
    resonance's frequency on (what activation and muscle let through below is no peak and can hardly be told from the rest);
    `harmonic_share` of the compared power; `harmonic_frequency`; `high_frequency_floor`, mean proportional power per bin
    over the highest third of the bins; the base coefficients; where the insertion is moved `tangents`;
    `coefficient_of_variation` and `mean` of the output (not of an acceleration, whose mean is zero, and which has no
    `half_power_frequency`);
    `band_4_8` and so on, the proportional power from 4 to 8 Hz, of bins at the edges the part that lies inside, where the
    bins cover half of the band.
    """
    base, seen = task.muscle.base(), observed(moments)
    at: Any = task.settings.frequency if frequency is None else frequency  # of the bins, if not all are compared
    resonances = [noise for noise in task.noise.components if isinstance(noise, ResonantNoise)]
    whole, one = moments.power.sum(), jnp.ones(())
    found: dict[str, Any] = {
        "corner_frequency": moments.rate / (2 * jnp.pi),
        "half_power_frequency": moments.half,
    }
    if task.activation is not None:
        found["contraction_time"] = task.activation.time * one
    for name, noise, own in zip(("tremor", "resonance_2"), resonances, moments.resonant, strict=False):
        if name == "tremor":
            found |= {"tremor_frequency": noise.frequency * one, "tremor_width": noise.width * one}
        peak = at >= 0.5 * jax.lax.stop_gradient(noise.frequency)
        found[f"{name}_share"] = jnp.sum(jnp.where(peak, own, 0.0)) / whole
    proportional = moments.power / whole
    inside = in_bands(jnp.asarray(at, proportional.dtype), task.settings.resolution)
    found |= dict(zip(BANDS, inside @ proportional, strict=True))
    found |= {
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
    found |= tangents(task, seen["mean"]) if _moved(task) else {}
    return {name: value for name, value in found.items() if name in derived_names(task)}


def frequency_of(part: PartResiduals) -> Float[Array, " bins"]:
    """Frequencies of the compared bins [Hz]."""
    return jnp.asarray(part.task.settings.frequency)[part.model.chosen]


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
    left_out = [observed(jax.tree.map(lambda x, i=i: (x.sum(axis=0) - x[i]) / (count - 1), each)) for i in range(count)]
    return {name: float(np.std([o[name] for o in left_out]) * np.sqrt(count - 1)) for name in left_out[0]}


def unit_of(name: str, output: str = "") -> str:
    """Unit of a parameter or derived quantity, "name@target" too; `output` is that of the task's output."""
    base = name.partition("@")[0]
    if base == "mean":
        return output
    if base in DERIVED:
        return UNITS.get(base, "1")
    return PARAMETERS[base].unit if base in PARAMETERS else ""


BATCH = 32
POINTS, EACH = 128, 8
LATEST = 4


class Expansion(NamedTuple):
    """What a fit's model gives at some θ, and its slopes with respect to θ; a leading axis of points.

    Of a part: `Moments`. Of all parts: a tuple of these.
    """

    theta: Any
    moments: Any
    slopes: Any

    def near(self, theta: Float[Array, " free"]) -> Any:
        """The moments at another θ to first order (without the leading axis); exact, with exact slopes, at `self.theta`."""
        return jax.tree.map(lambda value, slope: value + slope @ (theta - self.theta), self.moments, self.slopes)

    def row(self, i: int) -> "Expansion":
        """At one of the points."""
        return jax.tree.map(lambda x: np.asarray(x)[i], self)


def part_of(objective: Residuals, seen: Expansion, i: int) -> Expansion:
    """What was seen of one part, with slopes with respect to its own coordinates."""
    own = objective.own
    slopes = jax.tree.map(lambda slope: own(slope, i), seen.slopes[i])
    return Expansion(own(seen.theta, i), seen.moments[i], slopes)


Tables = tuple[dict[str, np.ndarray], ...]


def quantities(objective: Residuals, seen: Expansion) -> tuple[Tables, Tables]:
    """Derived quantities of every part, rows where the model was seen, and their slopes with respect to θ."""
    found = [
        jax.tree.map(np.asarray, _quantities(part, part_of(objective, seen, i))) for i, part in enumerate(objective.parts)
    ]
    spread = objective.spread  # asked for once: every time it makes an object
    slopes = tuple({n: spread(g, i) for n, g in slopes.items()} for i, (_, slopes) in enumerate(found))
    return tuple(values for values, _ in found), slopes


@kept
def _quantities(part: PartResiduals, seen: Expansion) -> tuple[dict[str, Array], dict[str, Array]]:
    def one(seen):
        def everything(theta):
            values = derived(task_at(part.task, part.coordinates, theta), seen.near(theta), frequency_of(part))
            return values, values

        slopes, values = jax.jacfwd(everything, has_aux=True)(seen.theta)
        return values, slopes

    return jax.vmap(one)(seen)


class Consequences(NamedTuple):
    """Data residuals at one θ and their Jacobian; derived quantities of every part with their slopes."""

    residuals: Float[np.ndarray, " residuals"]
    jacobian: Float[np.ndarray, "residuals free"]
    values: Tables
    slopes: Tables


def consequences(objective: Residuals, seen: Expansion) -> Consequences:
    """What follows at the point where the model was seen; slopes with respect to θ."""
    rows = consequences_of_rows(objective, jax.tree.map(lambda x: np.asarray(x)[None], seen))
    return jax.tree.map(lambda x: x[0], rows)


def consequences_of_rows(objective: Residuals, seen: Expansion) -> Consequences:
    """The same at every point where it was seen, with a leading axis of points."""
    found = [jax.tree.map(np.asarray, _consequences(part, part_of(objective, seen, i)))
             for i, part in enumerate(objective.parts)]  # fmt: skip
    spread = objective.spread  # asked for once: every time it makes an object
    return Consequences(
        np.concatenate([values[0] for values, _ in found], axis=1),
        np.concatenate([spread(slopes[0], i) for i, (_, slopes) in enumerate(found)], axis=1),
        tuple(values[1] for values, _ in found),
        tuple({n: spread(g, i) for n, g in slopes[1].items()} for i, (_, slopes) in enumerate(found)),
    )


@kept
def _consequences(part: PartResiduals, seen: Expansion) -> tuple[Any, Any]:
    def one(seen):
        def everything(theta):
            moments = seen.near(theta)
            task = task_at(part.task, part.coordinates, theta)
            values = part.data_residuals(moments, part.data), derived(task, moments, frequency_of(part))
            return values, values

        slopes, values = jax.jacfwd(everything, has_aux=True)(seen.theta)
        return values, slopes

    return jax.vmap(one)(seen)


class _Response(eqx.Module):
    """What the moments of a linear response depend on, and nothing else, so that a program is used again."""

    model: Linear
    task: AbstractTask
    coordinates: Coordinates

    def moments(self, theta: Float[Array, " free"]) -> Moments:
        return self.model.moments(task_at(self.task, self.coordinates, theta))


@kept
def _moments_and_slopes(part: Any, theta: Float[Array | np.ndarray, "points free"]) -> tuple[Any, Any]:
    def one(theta):
        def twice(theta):
            moments = part.moments(theta)
            return moments, moments

        slopes, moments = jax.jacfwd(twice, has_aux=True)(theta)
        return moments, slopes

    return jax.vmap(one)(theta)


@kept
def _of_rows(part: Any, theta: Float[Array | np.ndarray, "points free"], count: Any) -> tuple[Any, Any]:
    """Moments and slopes of the first `count` points, `EACH` at a time; zeros for the others, which so take no time."""

    def some(i: Any, found: Any) -> Any:
        new = _moments_and_slopes(part, jax.lax.dynamic_slice_in_dim(theta, i * EACH, EACH))
        return jax.tree.map(lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, i * EACH, 0), found, new)

    one = jax.eval_shape(_moments_and_slopes, part, theta[:EACH])
    nothing = jax.tree.map(lambda x: jnp.zeros((len(theta), *x.shape[1:]), x.dtype), one)
    return jax.lax.fori_loop(0, (count + EACH - 1) // EACH, some, nothing)


def expand(objective: Any, theta: Float[np.ndarray, "points free"]) -> Expansion:
    """The moments of every part and their slopes at every θ, as numbers.

    Part by part: each has the program of a fit alone. (One program of two kinds of task hangs under jaxlib 0.10.2.)
    """
    each = [_expanded(part, np.asarray(objective.own(theta, i))) for i, part in enumerate(objective.parts)]
    spread = objective.spread  # asked for once: every time it makes an object
    slopes = tuple(jax.tree.map(lambda g, i=i: spread(g, i), slopes) for i, (_, slopes) in enumerate(each))
    return Expansion(theta, tuple(moments for moments, _ in each), slopes)


def _expanded(part: Any, theta: Float[np.ndarray, "points own"]) -> tuple[Any, Any]:
    """Moments of one part and their slopes.

    A linear response is computed for at most `POINTS` points at a time and with slopes also for what a fit usually leaves
    free, so that one compiled program serves any number of points and nearly any choice of free parameters; a Monte Carlo
    simulation for all points together, with the slopes that are asked for.
    """
    if not isinstance(part.model, Linear):
        return jax.tree.map(np.asarray, _moments_and_slopes(part, theta))
    count, (response, own) = len(theta), _response_of(part, part.model)
    padded = np.zeros((-(-count // POINTS) * POINTS, len(response.coordinates.names)))
    padded[:, own] = np.concatenate([theta, np.broadcast_to(theta[-1], (len(padded) - count, len(own)))])
    parts = [_of_rows(response, padded[i : i + POINTS], np.asarray(min(count - i, POINTS))) for i in range(0, count, POINTS)]
    moments, slopes = jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)
    return moments, jax.tree.map(lambda slope: slope[..., own], slopes)


_LATEST: list[tuple[Any, tuple[_Response, np.ndarray]]] = []


def _response_of(part: PartResiduals, model: Linear) -> tuple[_Response, Int[np.ndarray, " own"]]:
    """What is expanded of a part, and where its own coordinates stand in that; of the latest parts made only once."""
    for known, found in _LATEST:
        if known is part:
            return found
    wide = _with_the_usual(part.coordinates, part.task)
    own = np.array([wide.names.index(name) for name in part.coordinates.names], dtype=int)
    found = _Response(model, part.task, wide), own
    _LATEST[:] = [(part, found), *_LATEST[: LATEST - 1]]
    return found


def _with_the_usual(coordinates: Coordinates, task: AbstractTask) -> Coordinates:
    """The coordinates and those of what is usually free, in one order whatever is asked for: θ = 0 is the task's value."""
    known = task.parameter_names
    names = tuple(dict.fromkeys([*(name for name in USUALLY_FREE if name in known), *coordinates.names]))
    given = {name: i for i, name in enumerate(coordinates.names)}
    rows = [(coordinates.centre[given[n]], coordinates.sd[given[n]], coordinates.positive[given[n]]) if n in given
            else (float(task[n]), 1.0, False) for n in names]  # fmt: skip
    centre, sd, positive = (np.array(column) for column in zip(*rows, strict=True))
    return Coordinates(names, centre, sd, positive, np.full(len(names), -np.inf), np.full(len(names), np.inf))
