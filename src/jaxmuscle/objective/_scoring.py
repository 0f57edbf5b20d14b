"""The maximum of a likelihood, or of a posterior, from many points at once, by damped Fisher
scoring."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxmuscle._common.programs import kept

from ._consequences import Expansion, expand, quantities
from ._coordinates import Coordinates
from ._likelihood import AllBins, Likelihood
from ._problem import FitProblem
from ._residuals import Residuals, free_size
from ._starts import points_about

STEPS = 60
GAIN = 1e-5
HARDEST = 1e9


class Maximum(NamedTuple):
    """Where each row ended: θ, offsets, log likelihood (with these maximised), what was minimised,
    and its curvature.

    `curvature` is the Fisher information of θ and the offsets, with the prior's precision on its
    diagonal.
    """

    theta: Float[np.ndarray, "rows free"]
    offset: Float[np.ndarray, "rows parts"]
    log_likelihood: Float[np.ndarray, " rows"]
    cost: Float[np.ndarray, " rows"]
    curvature: Float[np.ndarray, "rows all all"]
    settled: Bool[np.ndarray, " rows"]

    @property
    def best(self) -> int:
        """The finite row of lowest cost."""
        return int(np.argmin(np.where(np.isfinite(self.cost), self.cost, np.inf)))

    def row(self, i: int) -> "Maximum":
        """One row, as rows of one."""
        return Maximum(*(x[[i]] for x in self))

    def covariance(self, i: int) -> Float[np.ndarray, "free free"]:
        """Covariance of θ by the curvature at one row, the offsets integrated out."""
        free = self.theta.shape[1]
        return np.linalg.pinv(self.curvature[i], hermitian=True)[:free, :free]


class Pin(NamedTuple):
    """A derived quantity q of one part (with `log` its logarithm) held near `value` by `½ ((q -
    value) / width)²`.

    A value per row.
    """

    part: int
    name: str
    value: Float[np.ndarray, " rows"]
    width: float
    log: bool

    def seen(
        self, objective: Residuals, seen: Expansion
    ) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows free"]]:
        """q and its slopes."""
        values, slopes = (tables[self.part][self.name] for tables in quantities(objective, seen))
        return (np.log(values), slopes / values[:, None]) if self.log else (values, slopes)


@kept
def _local(
    likelihood: Likelihood, bins: AllBins, seen: Expansion, offset: Array
) -> tuple[Array, Array, Array]:
    """Log likelihood, its gradient and its Fisher information with respect to (θ, offsets), for
    every row."""
    free = seen.theta.shape[-1]

    def one(bins, seen, offset):
        def value(both):
            return likelihood.at(seen.near(both[:free]), both[free:], bins)

        both = jnp.concatenate([seen.theta, offset])
        height, slope = jax.value_and_grad(value)(both)
        return height, slope, likelihood.information(seen, bins)

    return jax.lax.map(lambda row: one(*row), (bins, seen, offset))


def maximise(
    likelihood: Likelihood,
    theta: Float[np.ndarray, "rows free"],
    precision: Float[np.ndarray, "free free"],
    *,
    bins: AllBins | None = None,
    moving: Float[np.ndarray, "rows free"] | None = None,
    pin: Pin | None = None,
    max_steps: int = STEPS,
) -> Maximum:
    """Minimise `-ln L(θ, u) + ½ θᵀ precision θ` from every row, u the offsets; `moving` is 0 where
    a coordinate stays.

    `bins` has a leading axis of rows: each may have data of its own. Steps `-(F + λ diag F)⁻¹ g` in
    the unbounded coordinates, F the Fisher information, λ lowered after accepted steps and raised
    after rejected ones. A row has settled when an accepted step gains less than 1e-5.
    """
    coordinates, rows = likelihood.objective.coordinates, len(theta)
    moving = np.ones_like(theta) if moving is None else moving
    if bins is None:
        bins = tuple(
            jax.tree.map(lambda x: np.broadcast_to(x, (rows, *np.shape(x))), likelihood.bins)
        )
    s, u, damping = coordinates.from_theta(theta), np.zeros((rows, len(bins))), np.full(rows, 1e-2)
    here = _look(likelihood, bins, s, u, precision, pin)
    settled, active = np.zeros(rows, dtype=bool), np.isfinite(here.cost)
    for _ in range(max_steps):
        which = np.flatnonzero(active)
        if not which.size:
            break
        step = _steps(here, coordinates, s, moving, damping, which)
        ahead, above = s.copy(), u.copy()
        ahead[which] += step[:, : s.shape[1]]
        above[which] += step[:, s.shape[1] :]
        part = jax.tree.map(lambda x, which=which: x[which], bins)
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
    return Maximum(
        np.asarray(coordinates.theta(s)), u, here.height, here.cost, here.information, settled
    )


class _Look(NamedTuple):
    height: np.ndarray
    cost: np.ndarray
    slope: np.ndarray
    information: np.ndarray


def _look(
    likelihood: Likelihood,
    bins: AllBins,
    s: np.ndarray,
    u: np.ndarray,
    precision: np.ndarray,
    pin: Pin | None,
) -> _Look:
    """Cost, its slope and curvature with respect to (θ, u), where it is finite."""
    theta = np.asarray(likelihood.objective.coordinates.theta(s))
    seen = expand(likelihood.objective, theta)
    free = s.shape[1]
    height, slope, information = _heights(likelihood, bins, seen, u)
    pulled = theta @ precision
    cost = -height + 0.5 * np.sum(pulled * theta, axis=1)
    slope[:, :free] += pulled
    information[:, :free, :free] += precision
    if pin is not None:
        values, slopes = pin.seen(likelihood.objective, seen)
        off, rise = (values - pin.value) / pin.width, slopes / pin.width
        cost = cost + 0.5 * off**2
        slope[:, :free] += off[:, None] * rise
        information[:, :free, :free] += rise[:, :, None] * rise[:, None, :]
    cost = np.where(np.isfinite(cost) & np.all(np.isfinite(slope), axis=1), cost, np.inf)
    return _Look(height, cost, slope, information)


def _heights(
    likelihood: Likelihood, bins: AllBins, seen: Expansion, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`_local` of the negative log likelihood, by a program that fits share."""
    rows, free = seen.theta.shape
    size = free_size(free)

    def wide(x: np.ndarray) -> np.ndarray:
        return np.pad(x, [*[(0, 0)] * (x.ndim - 1), (0, size - free)])

    given = _filled((bins, seen.compared(wide), u), rows)
    found = _local(likelihood.filled(), *given)
    height, slope, information = (np.array(x)[:rows] for x in found)
    own = np.concatenate([np.arange(free), np.arange(size, size + u.shape[1])])
    return height, -slope[:, own], information[:, own[:, None], own]


def _filled(tree: Any, rows: int) -> Any:
    """Rows filled up to a power of two, so that few sizes are compiled."""
    size = max(32, 1 << (rows - 1).bit_length())
    last = np.minimum(np.arange(size), rows - 1)
    return jax.tree.map(lambda x: np.asarray(x)[last], tree)


def _steps(
    here: _Look,
    coordinates: Coordinates,
    s: np.ndarray,
    moving: np.ndarray,
    damping: np.ndarray,
    which: np.ndarray,
) -> np.ndarray:
    """Damped Newton steps in the unbounded coordinates and the offsets."""
    offsets = here.slope.shape[1] - s.shape[1]
    stretch = np.concatenate(
        [coordinates.stretch(s[which]) * moving[which], np.ones((len(which), offsets))], axis=1
    )
    slope = here.slope[which] * stretch
    curvature = here.information[which] * stretch[:, :, None] * stretch[:, None, :]
    size = np.maximum(np.diagonal(curvature, axis1=1, axis2=2), 1e-8)
    still = stretch == 0
    curvature = (
        curvature
        + np.eye(size.shape[1])
        * np.where(still, 1.0, damping[which][:, None] * size + 1e-12)[:, None, :]
    )
    step = -np.linalg.solve(curvature, slope[:, :, None])[:, :, 0]
    longest = np.max(np.abs(step), axis=1, keepdims=True)
    return step * np.minimum(1.0, 2.0 / np.maximum(longest, 1e-300))


def highest(
    problem: FitProblem, likelihood: Likelihood, theta: np.ndarray, precision: np.ndarray
) -> tuple[Maximum, int]:
    """Maxima climbed to from `points_about`, and which of them is the highest."""
    peak = maximise(likelihood, points_about(problem, theta), precision)
    if not np.isfinite(peak.cost[peak.best]):
        raise ValueError(f"{problem.title}: the likelihood is not finite anywhere near the fit")
    return peak, peak.best
