"""The maximum of a likelihood, or of a posterior, from many points at once, by damped Fisher scoring."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._consequences import Seen, quantities, seen_at
from ._coordinates import Coordinates
from ._likelihood import Bins, Likelihood
from ._problem import Setup
from ._starts import points_about

STEPS = 60
GAIN = 1e-5
HARDEST = 1e9


class Peak(NamedTuple):
    """Where each row ended: θ, offset, log likelihood (with the offset maximised), what was minimised, and its curvature.

    `curvature` is the Fisher information of θ and the offset, with the prior's precision on its diagonal.
    """

    theta: Float[np.ndarray, "rows free"]
    offset: Float[np.ndarray, " rows"]
    log_likelihood: Float[np.ndarray, " rows"]
    cost: Float[np.ndarray, " rows"]
    curvature: Float[np.ndarray, "rows all all"]
    settled: Bool[np.ndarray, " rows"]

    @property
    def best(self) -> int:
        """The finite row of lowest cost."""
        return int(np.argmin(np.where(np.isfinite(self.cost), self.cost, np.inf)))

    def row(self, i: int) -> "Peak":
        """One row, as rows of one."""
        return Peak(*(x[[i]] for x in self))

    def covariance(self, i: int) -> Float[np.ndarray, "free free"]:
        """Covariance of θ by the curvature at one row, the offset integrated out."""
        return np.linalg.pinv(self.curvature[i], hermitian=True)[:-1, :-1]


class Pin(NamedTuple):
    """A derived quantity q (with `log` its logarithm) held near `value` by `½ ((q - value) / width)²`; a value per row."""

    name: str
    value: Float[np.ndarray, " rows"]
    width: float
    log: bool

    def seen(self, problem: Any, seen: Seen) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows free"]]:
        """q and its slopes."""
        values, slopes = (np.asarray(x[self.name]) for x in quantities(problem, seen))
        return (np.log(values), slopes / values[:, None]) if self.log else (values, slopes)


@eqx.filter_jit
def _local(likelihood: Likelihood, bins: Bins | None, seen: Seen, offset: Array) -> tuple[Array, Array, Array]:
    """Log likelihood, its gradient and its Fisher information with respect to (θ, offset), for every row."""

    def one(bins, seen, offset):
        def value(both):
            return likelihood.at(seen.nearby(both[:-1]), both[-1], bins)

        both = jnp.append(seen.theta, offset)
        height, slope = jax.value_and_grad(value)(both)
        return height, slope, likelihood.information(seen, bins)

    return jax.vmap(one)(bins, seen, offset)


def climb(
    likelihood: Likelihood,
    theta: Float[np.ndarray, "rows free"],
    precision: Float[np.ndarray, " free"],
    *,
    bins: Bins | None = None,
    moving: Float[np.ndarray, "rows free"] | None = None,
    pin: Pin | None = None,
    max_steps: int = STEPS,
) -> Peak:
    """Minimise `-ln L(θ, u) + ½ Σ precision θ²` from every row; `moving` is 0 where a coordinate stays.

    `bins` has a leading axis of rows: each may have data of its own. Steps `-(F + λ diag F)⁻¹ g` in the unbounded
    coordinates, F the Fisher information, λ lowered after accepted steps and raised after rejected ones. A row has settled
    when an accepted step gains less than 1e-5.
    """
    coordinates, rows = likelihood.problem.coordinates, len(theta)
    moving = np.ones_like(theta) if moving is None else moving
    data = likelihood.bins if bins is None else bins
    if bins is None and data is not None:
        data = jax.tree.map(lambda x: np.broadcast_to(x, (rows, *np.shape(x))), data)
    s, u, damping = coordinates.from_theta(theta), np.zeros(rows), np.full(rows, 1e-2)
    here = _look(likelihood, data, s, u, precision, pin)
    settled, active = np.zeros(rows, dtype=bool), np.isfinite(here.cost)
    for _ in range(max_steps):
        which = np.flatnonzero(active)
        if not which.size:
            break
        step = _steps(here, coordinates, s, moving, damping, which)
        ahead, above = s.copy(), u.copy()
        ahead[which] += step[:, :-1]
        above[which] += step[:, -1]
        part = None if data is None else jax.tree.map(lambda x, which=which: x[which], data)
        near = None if pin is None else pin._replace(value=pin.value[which])
        there = _look(likelihood, part, ahead[which], above[which], precision, near)
        better = there.cost < here.cost[which]
        gain = here.cost[which] - there.cost
        for old, new in zip(here, there, strict=True):
            old[which[better]] = new[better]
        s[which[better]], u[which[better]] = ahead[which[better]], above[which[better]]
        damping[which] = np.where(better, 0.2 * damping[which], 5 * damping[which])
        settled[which] = better & (gain < GAIN)
        # Refused although the step was short: at the maximum to rounding.
        settled[which] |= ~better & (np.max(np.abs(step), axis=1) < 1e-7)
        active[which] = ~settled[which] & (damping[which] < HARDEST)
    return Peak(np.asarray(coordinates.theta(s)), u, here.height, here.cost, here.information, settled)


class _Look(NamedTuple):
    height: np.ndarray
    cost: np.ndarray
    slope: np.ndarray
    information: np.ndarray


def _look(likelihood: Likelihood, bins: Bins | None, s: np.ndarray, u: np.ndarray, precision: np.ndarray,
          pin: Pin | None) -> _Look:  # fmt: skip
    """Cost, its slope and curvature with respect to (θ, u), where it is finite."""
    theta = np.asarray(likelihood.problem.coordinates.theta(s))
    seen = seen_at(likelihood.problem, theta)
    height, slope, information = (np.array(x) for x in _local(*_padded(likelihood, bins, seen, u)))
    height, slope, information = height[: len(s)], -slope[: len(s)], information[: len(s)]
    weight = np.append(precision, 0.0)
    cost = -height + 0.5 * np.sum(precision * theta**2, axis=1)
    slope[:, :-1] += precision * theta
    information += np.diag(weight)
    if pin is not None:
        values, slopes = pin.seen(likelihood.problem, _filled(seen, len(s)))
        values, slopes = values[: len(s)], slopes[: len(s)]
        off, rise = (values - pin.value) / pin.width, slopes / pin.width
        cost = cost + 0.5 * off**2
        slope[:, :-1] += off[:, None] * rise
        information[:, :-1, :-1] += rise[:, :, None] * rise[:, None, :]
    cost = np.where(np.isfinite(cost) & np.all(np.isfinite(slope), axis=1), cost, np.inf)
    return _Look(height, cost, slope, information)


def _padded(likelihood: Likelihood, bins: Bins | None, seen: Seen, u: np.ndarray) -> tuple[Any, ...]:
    return (likelihood, *_filled((bins, seen, u), len(u)))


def _filled(tree: Any, rows: int) -> Any:
    """Rows filled up to a power of two, so that few sizes are compiled."""
    size = max(32, 1 << (rows - 1).bit_length())
    last = np.minimum(np.arange(size), rows - 1)
    return jax.tree.map(lambda x: np.asarray(x)[last], tree)


def _steps(here: _Look, coordinates: Coordinates, s: np.ndarray, moving: np.ndarray, damping: np.ndarray,
           which: np.ndarray) -> np.ndarray:  # fmt: skip
    """Damped Newton steps in the unbounded coordinates and the offset."""
    stretch = np.concatenate([coordinates.stretch(s[which]) * moving[which], np.ones((len(which), 1))], axis=1)
    slope = here.slope[which] * stretch
    curvature = here.information[which] * stretch[:, :, None] * stretch[:, None, :]
    size = np.maximum(np.diagonal(curvature, axis1=1, axis2=2), 1e-8)
    still = stretch == 0
    curvature = curvature + np.eye(size.shape[1]) * np.where(still, 1.0, damping[which][:, None] * size + 1e-12)[:, None, :]
    step = -np.linalg.solve(curvature, slope[:, :, None])[:, :, 0]
    longest = np.max(np.abs(step), axis=1, keepdims=True)
    return step * np.minimum(1.0, 2.0 / np.maximum(longest, 1e-300))


def highest(setup: Setup, likelihood: Likelihood, theta: np.ndarray, precision: np.ndarray) -> tuple[Peak, int]:
    """Maxima climbed to from `points_about`, and which of them is the highest."""
    peak = climb(likelihood, points_about(setup, theta), precision)
    if not np.isfinite(peak.cost[peak.best]):
        raise ValueError(f"{setup.target.name}: the likelihood is not finite anywhere near the fit")
    return peak, peak.best
