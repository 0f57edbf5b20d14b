"""95 % intervals of what a fit determined, from the profile of its cost."""

import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle.objective._consequences import Expansion, consequences_of_rows, expand
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals

REACH = 1.96  # standard errors to an end of a 95 % interval; 3.84 is its square
TURNS = 50  # at most, of steps and of moves to the next stage
# First stage, as a share of the way that the curvature says: so near the ridge is almost straight.
# A later stage is at most so many times longer or shorter, since the rise of one stage says little
# about a place far from it.
FIRST, FASTER, SLOWER = 0.4, 2.5, 0.4
# A turn that gains less of the rise ends a stage. The last stage is that in which the root of the
# rise is within `NEAR` of what is sought: over what is left it is extrapolated as a straight line.
GAIN, NEAR = 0.01, 0.05
# How tightly a quantity is held at its aim, in its standard deviations: tight enough that it stays
# there, loose enough that a Gauss-Newton step can follow a ridge that bends.
HELD = 0.1
FURTHEST = 4.0  # times as far as the curvature says: beyond, an end is open
MOST = 8.0  # prior standard deviations, beyond which no end is looked for
MOST_ROWS = 32  # of one batch, which is compiled once


class Interval(NamedTuple):
    """Ends of an interval, relative to the value (`log`) or as differences from it; None where it
    is open."""

    low: float | None
    high: float | None
    log: bool

    def about(self, value: float) -> tuple[float | None, float | None]:
        """The ends in the unit of the value."""
        low, high = (
            None if d is None else float(value * np.exp(d) if self.log else value + d)
            for d in self[:2]
        )
        return low, high


def intervals(
    problem: FitProblem,
    objective: Residuals,
    seen: Expansion,
    covariance: np.ndarray,
    widening: Mapping[str, float],
) -> dict[str, Interval]:
    """Where twice the cost, all else fitted anew, has risen by 3.84 times the factor that
    correlated bins ask for.

    A quantity q is moved along the ridge `θ + G g (q* - q) / (gᵀ G g)`, G the inverse curvature of
    the cost and g the slope of q. It moves in stages, two fifths of the way at first: where the
    ridge bends, the far end of the straight line costs a hundred times too much. In each stage it
    is held while damped Gauss-Newton steps lower the cost, until they gain little. The next stage
    begins on the line from the fit through where it stands, further out or in. The last is where
    the rise is `3.84 w² gᵀ C g / gᵀ G g`, C the covariance of the estimates, w by how much the
    errors of this quantity are widened (`widening`, of every name). Positive quantities move in
    their logarithm. All at once.

    Of fits in linear response only (empty otherwise).
    """
    if not objective.linear:
        return {}
    found: dict[str, Interval] = {}
    # a row that runs away is an open end
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for start in range(0, len(widening), MOST_ROWS // 2):
            some = dict(itertools.islice(widening.items(), start, start + MOST_ROWS // 2))
            found |= _some(problem, objective, seen, covariance, some)
    return found


def _some(
    problem: FitProblem,
    objective: Residuals,
    seen: Expansion,
    covariance: np.ndarray,
    widening: Mapping[str, float],
) -> dict[str, Interval]:
    names = list(widening)
    here = Point.of(problem, objective, jax.tree.map(lambda x: np.asarray(x)[None], seen))
    curvature = here.jacobian[0].T @ here.jacobian[0] + problem.precision
    # Directions that neither data nor prior determine have no curvature: they are left alone.
    gain = np.linalg.pinv(curvature, hermitian=True)
    seen_here = [here.quantity(name) for name in names]
    value, slope = (np.repeat([pair[k][0] for pair in seen_here], 2, axis=0) for k in (0, 1))
    log = value > 0
    slope = np.where(log[:, None], slope / np.where(log, value, 1.0)[:, None], slope)
    start = np.where(log, np.log(np.where(log, value, 1.0)), value)
    ours = np.einsum("ri,ij,rj->r", slope, gain, slope)
    stated = np.repeat(list(widening.values()), 2) * np.sqrt(
        np.einsum("ri,ij,rj->r", slope, covariance, slope)
    )
    # Root of the rise that is sought. The cost takes the bins as independent, so its curvature
    # states the error √ours; the true one, √(gᵀ C g), counts their correlation.
    wanted = REACH * stated / np.sqrt(ours)
    side = np.tile([-1.0, 1.0], len(names))
    way = np.full(len(start), FIRST)  # that each row is to go, of what the curvature says
    tight = HELD * np.sqrt(ours)
    aim = start + side * way * REACH * stated
    theta = here.theta[0] + (slope @ gain) * ((aim - start) / ours)[:, None]
    best = _look(problem, objective, theta, np.arange(len(theta)), names, log)
    damping = np.full(len(aim), 1e-2)
    done, moving, further = (
        np.zeros(len(aim), dtype=bool),
        np.zeros(len(aim), dtype=bool),
        best.theta,
    )
    for _ in range(TURNS):
        trial = np.where(moving[:, None], further, best.theta + best.step(aim, tight, damping))
        tried = best.moved(objective, trial, ~done, names, log)
        gain_of_all = best.merit(aim, tight) - tried.merit(aim, tight)
        better = moving | (gain_of_all > 0)
        best = best.where(better, tried)
        # A success trusts the quadratic model more; one failure undoes more than one success.
        damping = np.where(moving, 1e-2, np.where(better, 0.2 * damping, 10 * damping))
        rise = best.rise(here)
        settled = ~moving & (np.abs(gain_of_all) < GAIN * np.maximum(rise, NEAR * wanted) ** 2)
        done |= settled & (
            (np.abs(rise - wanted) < NEAR * wanted) | ((way == FURTHEST) & (rise < wanted))
        )
        if np.all(done):
            break
        moving = settled & ~done  # to the next stage
        stretch = np.where(moving, np.clip(wanted / np.maximum(rise, 1e-6), SLOWER, FASTER), 1.0)
        stretch = np.minimum(stretch, FURTHEST / way)
        # Further out on the line from the fit through where the row stands: the ridge is bent, and
        # the line of the curvature would leave it.
        way = way * stretch
        aim = start + side * way * REACH * stated
        further = here.theta[0] + (best.theta - here.theta[0]) * stretch[:, None]
    moved, rise = side * (best.at - start), best.rise(here)
    # What is left of the way is short: the root of the rise grows along it as the quantity does.
    end = moved * wanted / rise
    # A row that rose by less than half came to where the cost no longer rises: an open end.
    good = np.isfinite(end) & (moved > 0) & (rise > 0.5 * wanted)
    ends = [float(s * e) if fine else None for s, e, fine in zip(side, end, good, strict=True)]
    return {
        n: Interval(ends[2 * i], ends[2 * i + 1], bool(log[2 * i])) for i, n in enumerate(names)
    }


class _Look(NamedTuple):
    """Rows of θ, of each its own quantity `at` (or its logarithm) with slopes, data residuals with
    slopes, and cost."""

    problem: FitProblem
    theta: np.ndarray
    at: np.ndarray
    slope: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    cost: np.ndarray

    def moved(
        self,
        objective: Residuals,
        theta: np.ndarray,
        which: np.ndarray,
        names: list[str],
        log: np.ndarray,
    ) -> "_Look":
        """Some rows at another θ, the others as they are."""
        rows = np.flatnonzero(which)
        return _Look(
            self.problem,
            *renewed(
                rows, _look(self.problem, objective, theta[rows], rows, names, log)[1:], self[1:]
            ),
        )

    def where(self, chosen: np.ndarray, other: "_Look") -> "_Look":
        """The other's rows where they are chosen."""
        return _Look(self.problem, *chosen_rows(chosen, other[1:], self[1:]))

    def rise(self, here: "Point") -> np.ndarray:
        """Root of twice the rise of the cost above that of the fit."""
        return np.sqrt(np.maximum(2 * (self.cost - here.cost[0]), 0.0))

    def merit(self, aim: np.ndarray, tight: np.ndarray) -> np.ndarray:
        """The cost with the quantity held at its aim."""
        return self.cost + 0.5 * ((self.at - aim) / tight) ** 2

    def step(self, aim: np.ndarray, tight: np.ndarray, damping: np.ndarray) -> np.ndarray:
        """A damped Gauss-Newton step of that."""
        pull, rise = (self.at - aim) / tight, self.slope / tight[:, None]
        return held_step(self.problem, self, pull, rise, damping)


@runtime_checkable
class Seen(Protocol):
    """Rows of θ, of each the data residuals with slopes, and the cost."""

    @property
    def theta(self) -> np.ndarray: ...
    @property
    def residual(self) -> np.ndarray: ...
    @property
    def jacobian(self) -> np.ndarray: ...
    @property
    def cost(self) -> np.ndarray: ...


def held_step(
    problem: FitProblem, seen: Seen, pull: np.ndarray, rise: np.ndarray, damping: np.ndarray
) -> Float[np.ndarray, "rows free"]:
    """A damped Gauss-Newton step of `cost + ½ pull²` in every row, at most one prior standard
    deviation.

    `pull`, how far what is held is from where it is held, in units of how tightly; `rise`, its
    slope.
    """
    prior = problem.precision
    curvature = (
        np.einsum("rki,rkj->rij", seen.jacobian, seen.jacobian)
        + prior
        + rise[:, :, None] * rise[:, None]
    )
    gradient = (
        np.einsum("rki,rk->ri", seen.jacobian, seen.residual)
        + seen.theta @ prior
        + pull[:, None] * rise
    )
    # Marquardt's scaling: damping means the same in every coordinate, whatever its curvature.
    size = np.maximum(np.diagonal(curvature, axis1=1, axis2=2), 1e-8)
    curvature = curvature + (damping[:, None] * size)[:, None] * np.eye(len(prior))
    fine = np.isfinite(seen.cost) & np.all(np.isfinite(gradient), axis=1)
    step = np.zeros_like(seen.theta)
    step[fine] = -np.linalg.solve(curvature[fine], gradient[fine][..., None])[..., 0]
    # Beyond a prior standard deviation the linear model of the residuals is worth nothing.
    return step * np.minimum(
        1.0, 1.0 / np.maximum(np.max(np.abs(step), axis=1, keepdims=True), 1e-300)
    )


def renewed(
    which: np.ndarray, new: Sequence[np.ndarray], old: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Arrays with a leading axis of rows, in some of which the new ones stand: these have no
    others."""
    found = [own.copy() for own in old]
    for own, other in zip(found, new, strict=True):
        own[which] = other
    return found


def chosen_rows(
    chosen: np.ndarray, new: Sequence[np.ndarray], old: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Arrays with a leading axis of rows: the new ones where they are chosen."""
    return [
        np.where(chosen.reshape(-1, *[1] * (np.ndim(own) - 1)), other, own)
        for other, own in zip(new, old, strict=True)
    ]


def _look(
    problem: FitProblem,
    objective: Residuals,
    theta: np.ndarray,
    rows: np.ndarray,
    names: list[str],
    log: np.ndarray,
) -> _Look:
    """Each of these rows with its own quantity: of every name there are two."""
    theta, log = np.clip(theta, -MOST, MOST), log[rows]
    point = Point.of(problem, objective, expand(objective, theta))
    value, slope = np.empty(len(rows)), np.empty(theta.shape)
    for i in np.unique(rows // 2):
        values, slopes = point.quantity(names[i])
        own = rows // 2 == i
        value[own], slope[own] = values[own], slopes[own]
    positive = np.maximum(value, 1e-300)
    at, slope = (
        np.where(log, np.log(positive), value),
        np.where(log[:, None], slope / positive[:, None], slope),
    )
    return _Look(problem, theta, at, slope, point.residual, point.jacobian, point.cost)


class Point(NamedTuple):
    """What a fit sees at rows of θ: data residuals, their slopes, cost `½ Σ r² + ½ Σ θ²`, tables of
    quantities."""

    problem: FitProblem
    theta: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    cost: np.ndarray
    tables: tuple[Mapping[str, np.ndarray], Mapping[str, np.ndarray]]

    @classmethod
    def of(cls, problem: FitProblem, objective: Residuals, seen: Expansion) -> "Point":
        count = len(seen.theta)
        # one size, so that one program serves all
        rows = np.minimum(np.arange(MOST_ROWS), count - 1)
        found = consequences_of_rows(objective, jax.tree.map(lambda x: np.asarray(x)[rows], seen))
        found = jax.tree.map(lambda x: x[:count], found)
        cost = 0.5 * np.sum(found.residuals**2, axis=1) + 0.5 * np.sum(
            (seen.theta @ problem.precision) * seen.theta, axis=1
        )
        tables = problem.by_name(found.values), problem.by_name(found.slopes)
        return cls(
            problem,
            seen.theta,
            found.residuals,
            found.jacobian,
            np.where(np.isfinite(cost), cost, np.inf),
            tables,
        )

    def quantity(
        self, name: str
    ) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, "rows free"]]:
        """A free parameter or derived quantity and its slopes with respect to θ."""
        c = self.problem.coordinates
        if name not in c.names:
            # Of several targets, a quantity that is the same for all is that of the first.
            known = name if name in self.tables[0] else f"{name}@{self.problem.parts[0].name}"
            return self.tables[0][known], self.tables[1][known]
        i, natural = c.names.index(name), c.values_of(self.theta)
        slope = np.zeros_like(self.theta)
        slope[:, i] = np.where(c.positive[i], natural[:, i], 1.0) * c.sd[i]
        return natural[:, i], slope
