"""95 % intervals of what a fit determined: of most quantities the ends of the profile of the cost,
of a half-power frequency those of a test. `Endpoint` of `_verdict.py` asks for them.
"""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle.data._target import Target
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._consequences import (
    Expansion,
    consequences_of_rows,
    expand,
    half_power_levels,
)
from jaxmuscle.objective._derived import LIMB, PHASES, SPLIT
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals

HALF_POWER = "half_power_frequency"
REACH = 1.96  # standard errors to an end of a 95 % interval; 3.84 is its square
# How tightly what is held is held at its aim, in its standard deviations: tight enough that it
# stays there, loose enough that a Gauss-Newton step can follow a ridge that bends.
HELD = 0.1
MOST = 8.0  # prior standard deviations, beyond which no end is looked for
MOST_ROWS = 32  # of one batch, which is compiled once
DAMPING = 1e-2  # of the first step

# Of a profile.
TURNS = 50  # at most, of steps and of moves to the next stage
# First stage, as a share of the way that the curvature says: so near the ridge is almost straight.
# A later stage is at most so many times longer or shorter, since the rise of one stage says little
# about a place far from it.
FIRST, FASTER, SLOWER = 0.4, 2.5, 0.4
# A turn that gains less of the rise ends a stage. The last stage is that in which the root of the
# rise is within `NEAR` of what is sought: over what is left it is extrapolated as a straight line.
GAIN, NEAR = 0.01, 0.05
FURTHEST = 4.0  # times as far as the curvature says: beyond, an end is open
OWN = 0.5  # of the rise, at most, that the prior gives where an end of a moved limb is stated

# Of a half-power frequency.
EACH = 16  # frequencies on either side
NEAREST = 0.5  # standard deviations from the value to the first of them
# A frequency rests after so many turns in a row that gain it less than this share of the cost.
TEST_TURNS, QUIET, TEST_GAIN = 16, 2, 0.02
STIFF = 1e3  # damping at which a step is too short to gain
CLOSE = 2.0  # times the rise at the end of the interval: farther out a frequency need not rest
LOOSE = 0.05  # of the level, at most: 5 % of the power


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


OPEN = Interval(None, None, log=True)


def intervals(
    problem: FitProblem,
    objective: Residuals,
    seen: Expansion,
    covariance: np.ndarray,
    widening: Mapping[str, float],
) -> dict[str, Interval]:
    """95 % intervals of the quantities of which `widening` says by how much their errors are
    widened.

    That of a half-power frequency by `_test_interval`, all others by `_profile_intervals`. Of fits
    in linear response only (empty otherwise).
    """
    if not objective.linear:
        return {}
    here = Point.of(problem, objective, jax.tree.map(lambda x: np.asarray(x)[None], seen))
    smooth = {n: w for n, w in widening.items() if base_of(n) != HALF_POWER}
    found: dict[str, Interval] = {}
    # a row that runs away is an open end, and belongs to no interval
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for start in range(0, len(smooth), MOST_ROWS // 2):
            some = dict(itertools.islice(smooth.items(), start, start + MOST_ROWS // 2))
            found |= _profile_intervals(here, objective, covariance, some)
        for name in (n for n in widening if n not in smooth):
            found[name] = _test_interval(here, objective, widening[name] ** 2 * covariance, name)
    return found


def is_stated(problem: FitProblem, name: str) -> bool:
    """Whether this number of a moved limb is stated however little is known of it."""
    moved = any(part.points is not None for part in problem.parts)
    return moved and base_of(name) in {*LIMB, *SPLIT}


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
        cost = np.where(np.isfinite(cost), cost, np.inf)
        tables = problem.by_name(found.values), problem.by_name(found.slopes)
        return cls(problem, seen.theta, found.residuals, found.jacobian, cost, tables)

    def at(self, objective: Residuals, theta: Float[np.ndarray, "rows free"]) -> "Point":
        """What it sees at other θ, within what is looked at."""
        most = np.maximum(MOST, np.abs(self.theta[0]) + 1)  # the fit itself may lie far out
        return Point.of(self.problem, objective, expand(objective, np.clip(theta, -most, most)))

    @property
    def gain(self) -> Float[np.ndarray, "free free"]:
        """Inverse curvature of the cost at the first row. Directions that neither data nor prior
        determine have no curvature: they are left alone."""
        curvature = self.jacobian[0].T @ self.jacobian[0] + self.problem.precision
        return np.linalg.pinv(curvature, hermitian=True)

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


class Rows(NamedTuple):
    """Rows of θ with data residuals, their slopes and the cost; and in each row what is `held` (one
    quantity, or the level at every frequency) with its `slope`."""

    theta: Float[np.ndarray, "rows free"]
    residual: Float[np.ndarray, "rows residuals"]
    jacobian: Float[np.ndarray, "rows residuals free"]
    cost: Float[np.ndarray, " rows"]
    held: Float[np.ndarray, "rows *each"]
    slope: Float[np.ndarray, "rows *each free"]

    @classmethod
    def of(cls, point: Point, held: np.ndarray, slope: np.ndarray) -> "Rows":
        return cls(point.theta, point.residual, point.jacobian, point.cost, held, slope)

    def replaced(self, which: np.ndarray, new: "Rows") -> "Rows":
        """With new rows in some places; `new` has all rows, or these alone."""

        def put(old: np.ndarray, other: np.ndarray) -> np.ndarray:
            found = old.copy()
            found[which] = other[which] if len(other) == len(old) else other
            return found

        return Rows(*map(put, self, new))

    def merit(self, aim: np.ndarray, tight: np.ndarray) -> np.ndarray:
        """The cost with one quantity a row held at its aim."""
        return self.cost + 0.5 * ((self.held - aim) / tight) ** 2

    def rise(self, cost: np.ndarray) -> np.ndarray:
        """Root of twice the rise of the cost above that of the fit."""
        return np.sqrt(np.maximum(2 * (self.cost - cost), 0.0))

    def step(
        self, prior: np.ndarray, pull: np.ndarray, rise: np.ndarray, damping: np.ndarray
    ) -> Float[np.ndarray, "rows free"]:
        """A damped Gauss-Newton step of `cost + ½ pull²` in every row, at most one prior standard
        deviation.

        `pull`, how far what is held is from where it is held, in units of how tightly; `rise`, its
        slope.
        """
        curvature = (
            np.einsum("rki,rkj->rij", self.jacobian, self.jacobian)
            + prior
            + rise[:, :, None] * rise[:, None]
        )
        gradient = (
            np.einsum("rki,rk->ri", self.jacobian, self.residual)
            + self.theta @ prior
            + pull[:, None] * rise
        )
        # Marquardt's scaling: damping means the same in every coordinate, whatever its curvature.
        size = np.maximum(np.diagonal(curvature, axis1=1, axis2=2), 1e-8)
        curvature = curvature + (damping[:, None] * size)[:, None] * np.eye(len(prior))
        fine = np.isfinite(self.cost) & np.all(np.isfinite(gradient), axis=1)
        step = np.zeros_like(self.theta)
        step[fine] = -np.linalg.solve(curvature[fine], gradient[fine][..., None])[..., 0]
        # Beyond a prior standard deviation the linear model of the residuals is worth nothing.
        longest = np.max(np.abs(step), axis=1, keepdims=True)
        return step * np.minimum(1.0, 1.0 / np.maximum(longest, 1e-300))


def _damped(damping: np.ndarray, better: np.ndarray) -> np.ndarray:
    """Damping of the next step: a success trusts the quadratic model more; one failure undoes more
    than one success."""
    return np.where(better, 0.2 * damping, 10 * damping)


def _profile_intervals(
    here: Point, objective: Residuals, covariance: np.ndarray, widening: Mapping[str, float]
) -> dict[str, Interval]:
    """Where twice the cost, all else fitted anew, has risen by 3.84 times the factor that
    correlated bins ask for.

    A quantity q is moved along the ridge `θ + G g (q* - q) / (gᵀ G g)`, G the inverse curvature of
    the cost and g the slope of q. It moves in stages, two fifths of the way at first: where the
    ridge bends, the far end of the straight line costs a hundred times too much. In each stage it
    is held while damped Gauss-Newton steps lower the cost, until they gain little. The next stage
    begins on the line from the fit through where it stands, further out or in. The last is where
    the rise is `3.84 w² gᵀ C g / gᵀ G g`, C the covariance of the estimates, w by how much the
    errors of this quantity are widened. Positive quantities move in their logarithm. All at once.
    """
    names, gain, prior = list(widening), here.gain, here.problem.precision
    seen_here = [here.quantity(name) for name in names]
    value, slope = (np.repeat([pair[k][0] for pair in seen_here], 2, axis=0) for k in (0, 1))
    # a phase may be zero
    log = (value > 0) & np.repeat([base_of(name) not in PHASES for name in names], 2)
    slope = np.where(log[:, None], slope / np.where(log, value, 1.0)[:, None], slope)
    start = np.where(log, np.log(np.where(log, value, 1.0)), value)

    def look(theta: np.ndarray, rows: np.ndarray) -> Rows:
        """Each of these rows with its own quantity, or its logarithm: of every name there are
        two."""
        point, in_log = here.at(objective, theta), log[rows]
        value, slope = np.empty(len(rows)), np.empty(theta.shape)
        for i in np.unique(rows // 2):
            values, slopes = point.quantity(names[i])
            own = rows // 2 == i
            value[own], slope[own] = values[own], slopes[own]
        positive = np.maximum(value, 1e-300)
        at = np.where(in_log, np.log(positive), value)
        slope = np.where(in_log[:, None], slope / positive[:, None], slope)
        return Rows.of(point, at, slope)

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
    best = look(theta, np.arange(len(theta)))
    damping, further = np.full(len(aim), DAMPING), best.theta
    done, moving = np.zeros((2, len(aim)), dtype=bool)
    for _ in range(TURNS):
        step = best.step(prior, (best.held - aim) / tight, best.slope / tight[:, None], damping)
        trial = np.where(moving[:, None], further, best.theta + step)
        tried = best.replaced(~done, look(trial[~done], np.flatnonzero(~done)))
        gain_of_all = best.merit(aim, tight) - tried.merit(aim, tight)
        better = moving | (gain_of_all > 0)
        best = best.replaced(better, tried)
        damping = np.where(moving, DAMPING, _damped(damping, better))
        rise = best.rise(here.cost)
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
    moved, rise = side * (best.held - start), best.rise(here.cost)
    # What is left of the way is short: the root of the rise grows along it as the quantity does.
    end = moved * wanted / rise
    # A row that rose by less than half came to where the cost no longer rises: an open end.
    good = np.isfinite(end) & (moved > 0) & (rise > 0.5 * wanted) & _by_data(here, best, names)
    ends = [float(s * e) if fine else None for s, e, fine in zip(side, end, good, strict=True)]
    return {
        n: Interval(ends[2 * i], ends[2 * i + 1], bool(log[2 * i])) for i, n in enumerate(names)
    }


def _by_data(here: Point, best: Rows, names: list[str]) -> np.ndarray:
    """Whether the data, and not the prior, stop each row. It is asked of those numbers alone that
    are stated however little is known of them: their ends are open else.

    The prior of m_w does not count as one here: no record tells m_w, and its doubt is to be in all
    intervals.
    """
    problem = here.problem
    others = np.array([base_of(name) != "m_w" for name in problem.coordinates.names])
    prior = problem.precision * np.outer(others, others)
    pulled, before = (0.5 * np.sum((x @ prior) * x, axis=-1) for x in (best.theta, here.theta[0]))
    asked = np.repeat([is_stated(problem, name) for name in names], 2)
    return ~asked | (pulled - before < OWN * (best.cost - here.cost))


def _test_interval(
    here: Point, objective: Residuals, covariance: np.ndarray, name: str
) -> Interval:
    """The frequencies at which the response may have half its power, from the lowest to the
    highest.

    `L(f) = ln(2 |H(f)|² / |H(0)|²)` is zero at the true one, whatever the shape of the response. So
    f belongs to the interval if L(f) can be held at zero, all else fitted anew, and twice the cost
    rises by at most `3.84 w² gᵀ C g / gᵀ G g`: g is the slope of L(f) with respect to θ, w² C the
    widened covariance of the estimates, G the inverse curvature of the cost. Open at both ends,
    which means not determined, if it leaves the compared bins and points: no data are there.

    Damped Gauss-Newton steps from the ridge `θ - G g L / (gᵀ G g)`, all frequencies at once, below
    the value and then above it, outward. After each step a frequency goes on from where it stands
    best, be it another's place. One that rests is left out until another's place suits it better.

    **Source:** the inversion of a test is Fieller's (1954, doi:10.1111/j.2517-6161.1954.tb00159.x).
    """
    part, _ = here.problem.where(name)
    value, slope = (pair[0] for pair in here.quantity(name))
    low, high = np.log(_compared(here.problem.parts[part].target, objective.parts[part].model))
    top = float(np.log(value))
    if not low < top < high:
        return OPEN
    sd = float(np.sqrt(slope @ covariance @ slope) / value)
    log_f = np.concatenate([_aims(top, sd, edge) for edge in (low, high)])
    each = np.arange(len(log_f))

    def levels(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """L(f) of one part at every row and frequency, and its slopes with respect to θ."""
        # one size, so that one program serves all
        rows = np.asarray(objective.own(theta[np.minimum(each, len(theta) - 1)], part))
        found, slopes = half_power_levels(
            objective.parts[part], rows, np.tile(log_f, (len(each), 1))
        )
        return found[: len(theta)], objective.spread(slopes, part)[: len(theta)]

    level, g = (x[0] for x in levels(here.theta))
    gain, prior = here.gain, here.problem.precision
    ours, stated = (np.einsum("fi,ij,fj->f", g, matrix, g) for matrix in (gain, covariance))
    tight, wanted = np.minimum(HELD * np.sqrt(ours), LOOSE), REACH * np.sqrt(stated / ours)

    def look(theta: np.ndarray) -> Rows:
        point = here.at(objective, theta)
        return Rows.of(point, *levels(point.theta))

    def merits(rows: Rows) -> np.ndarray:
        """The cost with the level at one frequency (second axis) held at zero."""
        found = rows.cost[:, None] + 0.5 * (rows.held / tight) ** 2
        return np.where(np.isfinite(found), found, np.inf)

    def shared(rows: Rows) -> Rows:
        """For every frequency the row that suits it best."""
        pick = np.argmin(merits(rows), axis=0)
        return Rows(*(x[pick] for x in rows))

    def rises(merit: np.ndarray) -> np.ndarray:
        """Root of twice the rise of the cost, over that at the end of the interval."""
        return np.sqrt(np.maximum(2 * (merit - here.cost[0]), 0.0)) / wanted

    at = shared(look(here.theta[0] - (g @ gain) * (level / ours)[:, None]))
    damping, quiet = np.full(len(each), DAMPING), np.zeros(len(each), dtype=int)
    merit = np.diagonal(merits(at))
    for _ in range(TEST_TURNS):
        moving = quiet < QUIET
        pull, rise = at.held[each, each] / tight, at.slope[each, each] / tight[:, None]
        step = at.step(prior, pull, rise, damping)
        tried = at.replaced(moving, look((at.theta + step)[moving]))
        better = np.diagonal(merits(tried)) < merit
        damping = np.where(moving, _damped(damping, better), damping)
        at, before = shared(at.replaced(better, tried)), merit
        merit = np.diagonal(merits(at))
        gained = before - merit
        # a shorter step may do better
        quiet = np.where(gained >= TEST_GAIN, 0, quiet + (better | (damping > STIFF)))
        # A merit only falls: a last frequency that belongs to the interval goes on doing so.
        at_an_edge = np.any(rises(merit)[[EACH - 1, -1]] <= 1)
        if at_an_edge or np.all(quiet[rises(merit) < CLOSE] >= QUIET):
            break
    rise = rises(merit)
    if np.any(rise[[EACH - 1, -1]] <= 1):
        return OPEN
    low, high = (_end(top, log_f[side], rise[side]) for side in (slice(EACH), slice(EACH, None)))
    return Interval(low - top, high - top, log=True)


def _end(top: float, log_f: Float[np.ndarray, " each"], rise: Float[np.ndarray, " each"]) -> float:
    """The outermost point of one side where the rise is 1; its root is nearly linear in between."""
    at, rise = np.append(top, log_f), np.append(0.0, rise)
    last = int(np.flatnonzero(rise <= 1)[-1])
    return float(np.interp(1.0, rise[last : last + 2], at[last : last + 2]))


def _compared(target: Target, model: Any) -> tuple[float, float]:
    """From where to where [Hz] there are data: edges of the outer bins, or points of a measured
    dynamic stiffness beyond."""
    half = target.settings.resolution / 2
    points = getattr(model, "points", None)
    found = np.concatenate(
        [
            target.frequency - half,
            target.frequency + half,
            [] if points is None else np.asarray(points),
        ]
    )
    return float(found.min()), float(found.max())


def _aims(top: float, sd: float, edge: float) -> Float[np.ndarray, " each"]:
    """Frequencies [ln Hz] from near the value to an edge of the bins, ever further apart."""
    reach = abs(edge - top)
    return top + np.sign(edge - top) * np.geomspace(min(NEAREST * sd, reach / EACH), reach, EACH)
