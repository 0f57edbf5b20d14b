"""95 % interval of a half-power frequency: the frequencies at which the response may have half its
power."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle.data._target import Target
from jaxmuscle.objective._consequences import Expansion, expand, half_power_levels
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals

from ._intervals import HELD, MOST, REACH, Interval, Point, chosen_rows, held_step, renewed

HALF_POWER = "half_power_frequency"
EACH = 16  # frequencies on either side
NEAREST = 0.5  # standard deviations from the value to the first of them
TURNS, QUIET = 16, 2  # a frequency rests after so many turns in a row that gain it little
STIFF = 1e3  # damping at which a step is too short to gain
GAIN, NEAR = 0.02, 2.0  # of the cost; of the rise at the end of the interval
LOOSE = 0.05  # of the level, at most: 5 % of the power
OPEN = Interval(None, None, log=True)


def half_power_intervals(
    problem: FitProblem,
    objective: Residuals,
    seen: Expansion,
    covariance: np.ndarray,
    widening: Mapping[str, float],
) -> dict[str, Interval]:
    """The frequencies at which the response may have half its power, from the lowest to the
    highest; of each of the names.

    `L(f) = ln(2 |H(f)|² / |H(0)|²)` is zero at the true one, whatever the shape of the response. So
    f belongs to the interval if L(f) can be held at zero, all else fitted anew, and twice the cost
    rises by at most `3.84 w² gᵀ C g / gᵀ G g`: g is the slope of L(f) with respect to θ, C the
    covariance of the estimates, G the inverse curvature of the cost, w by how much the errors of
    this quantity are widened (`widening`, of every name). Open at both ends, which means not
    determined, if it leaves the compared bins and points: no data are there.

    Of fits in linear response only (empty otherwise).

    **Source:** the inversion of a test is Fieller's (1954, doi:10.1111/j.2517-6161.1954.tb00159.x).
    """
    if not objective.linear:
        return {}
    # a row that runs away belongs to no interval
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return {
            name: _interval(problem, objective, seen, factor**2 * covariance, name)
            for name, factor in widening.items()
        }


def _interval(
    problem: FitProblem, objective: Residuals, seen: Expansion, covariance: np.ndarray, name: str
) -> Interval:
    """Damped Gauss-Newton steps from the ridge `θ - G g L / (gᵀ G g)`, all frequencies at once.

    After each step a frequency goes on from where it stands best, be it another's place. One that
    rests is left out until another's place suits it better.
    """
    found = _Search.of(problem, objective, seen, covariance, name)
    if found is None:
        return OPEN
    search, theta = found
    here = search.look(theta).shared(search)
    damping, merit, quiet = (
        np.full(len(theta), 1e-2),
        here.merit(search),
        np.zeros(len(theta), dtype=int),
    )
    for _ in range(TURNS):
        moving = quiet < QUIET
        tried = here.moved(moving, search.look((here.theta + here.step(search, damping))[moving]))
        better = tried.merit(search) < merit
        damping = np.where(moving, np.where(better, 0.2 * damping, 10 * damping), damping)
        here, before = here.where(better, tried).shared(search), merit
        merit = here.merit(search)
        gain = before - merit
        # a shorter step may do better
        quiet = np.where(gain >= GAIN, 0, quiet + (better | (damping > STIFF)))
        if np.all(quiet[search.rise(merit) < NEAR] >= QUIET) or search.reaches_an_edge(merit):
            break
    return search.ends(merit)


class _Search(NamedTuple):
    """One row for each frequency [ln Hz] that is tried: below the value `top` and then above it,
    outward.

    `tight`, how closely its level is held; `wanted`, root of the rise of twice the `cost` that ends
    the interval.
    """

    problem: FitProblem
    objective: Residuals
    part: int
    top: float
    log_f: Float[np.ndarray, " rows"]
    tight: Float[np.ndarray, " rows"]
    wanted: Float[np.ndarray, " rows"]
    cost: float

    @classmethod
    def of(
        cls,
        problem: FitProblem,
        objective: Residuals,
        seen: Expansion,
        covariance: np.ndarray,
        name: str,
    ) -> "tuple[_Search, Float[np.ndarray, 'rows free']] | None":
        """With the point of the ridge of each frequency; nothing where the value is outside the
        compared bins."""
        part, _ = problem.where(name)
        here = Point.of(problem, objective, jax.tree.map(lambda x: np.asarray(x)[None], seen))
        value, slope = (pair[0] for pair in here.quantity(name))
        low, high = np.log(_compared(problem.parts[part].target, objective.parts[part].model))
        top = float(np.log(value))
        if not low < top < high:
            return None
        sd = float(np.sqrt(slope @ covariance @ slope) / value)
        log_f = np.concatenate([_aims(top, sd, edge) for edge in (low, high)])
        # one size, one program
        everywhere = np.tile(here.theta, (len(log_f), 1)), np.tile(log_f, (len(log_f), 1))
        level, g = (x[0] for x in _levels_of(objective, part, *everywhere))
        gain = np.linalg.pinv(
            here.jacobian[0].T @ here.jacobian[0] + problem.precision, hermitian=True
        )
        ours, stated = (np.einsum("fi,ij,fj->f", g, matrix, g) for matrix in (gain, covariance))
        tight = np.minimum(HELD * np.sqrt(ours), LOOSE)
        search = cls(
            problem,
            objective,
            part,
            top,
            log_f,
            tight,
            REACH * np.sqrt(stated / ours),
            float(here.cost[0]),
        )
        return search, here.theta[0] - (g @ gain) * (level / ours)[:, None]

    def look(self, theta: Float[np.ndarray, "rows free"]) -> "_Rows":
        """What the fit sees at each row."""
        theta = np.clip(theta, -MOST, MOST)
        point = Point.of(self.problem, self.objective, expand(self.objective, theta))
        # One size, so that one program serves all.
        every = np.minimum(np.arange(len(self.log_f)), len(theta) - 1)
        levels, slopes = _levels_of(
            self.objective, self.part, theta[every], np.tile(self.log_f, (len(every), 1))
        )
        count = len(theta)
        return _Rows(
            theta, levels[:count], slopes[:count], point.residual, point.jacobian, point.cost
        )

    def rise(self, merit: Float[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """Root of twice the rise of the cost, over that at the end of the interval."""
        return np.sqrt(np.maximum(2 * (merit - self.cost), 0.0)) / self.wanted

    def reaches_an_edge(self, merit: Float[np.ndarray, " rows"]) -> bool:
        """Whether the last frequency of a side belongs to the interval. A merit only falls."""
        return bool(np.any(self.rise(merit)[[EACH - 1, -1]] <= 1))

    def ends(self, merit: Float[np.ndarray, " rows"]) -> Interval:
        """The outermost points where the rise is 1; its root is nearly linear in between."""
        if self.reaches_an_edge(merit):
            return OPEN
        low, high = (self._end(rows, self.rise(merit)) for rows in (slice(EACH), slice(EACH, None)))
        return Interval(low - self.top, high - self.top, log=True)

    def _end(self, rows: slice, rise: Float[np.ndarray, " rows"]) -> float:
        """Of one side."""
        at, rise = np.append(self.top, self.log_f[rows]), np.append(0.0, rise[rows])
        last = int(np.flatnonzero(rise <= 1)[-1])
        return float(np.interp(1.0, rise[last : last + 2], at[last : last + 2]))


class _Rows(NamedTuple):
    """Of each row θ, the level at every frequency with its slopes, data residuals with slopes, and
    cost."""

    theta: Float[np.ndarray, "rows free"]
    level: Float[np.ndarray, "rows rows"]
    slope: Float[np.ndarray, "rows rows free"]
    residual: Float[np.ndarray, "rows residuals"]
    jacobian: Float[np.ndarray, "rows residuals free"]
    cost: Float[np.ndarray, " rows"]

    def merits(self, search: _Search) -> Float[np.ndarray, "rows rows"]:
        """The cost with the level at one frequency (second axis) held at zero."""
        merits = self.cost[:, None] + 0.5 * (self.level / search.tight) ** 2
        return np.where(np.isfinite(merits), merits, np.inf)

    def merit(self, search: _Search) -> Float[np.ndarray, " rows"]:
        """That of each row's own frequency."""
        return np.diagonal(self.merits(search))

    def shared(self, search: _Search) -> "_Rows":
        """For every frequency the row that suits it best."""
        pick = np.argmin(self.merits(search), axis=0)
        return _Rows(*(x[pick] for x in self))

    def moved(self, which: np.ndarray, there: "_Rows") -> "_Rows":
        """Some rows somewhere else, the others as they are."""
        return _Rows(*renewed(which, there, self))

    def where(self, better: np.ndarray, other: "_Rows") -> "_Rows":
        """The other where it is better."""
        return _Rows(*chosen_rows(better, other, self))

    def step(self, search: _Search, damping: np.ndarray) -> Float[np.ndarray, "rows free"]:
        """A damped Gauss-Newton step of the merit, at most one prior standard deviation."""
        rows = np.arange(len(self.theta))
        pull, rise = (
            self.level[rows, rows] / search.tight,
            self.slope[rows, rows] / search.tight[:, None],
        )
        return held_step(search.problem, self, pull, rise, damping)


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


def _levels_of(
    objective: Residuals,
    part: int,
    theta: Float[np.ndarray, "rows free"],
    log_f: Float[np.ndarray, "rows points"],
) -> tuple[Float[np.ndarray, "rows points"], Float[np.ndarray, "rows points free"]]:
    """`ln(2 |H(f)|² / |H(0)|²)` of one part at every row's frequencies [ln Hz], and its slopes with
    respect to θ.

    It is zero where f is the half-power frequency.
    """
    own = np.asarray(objective.own(theta, part))
    levels, slopes = half_power_levels(objective.parts[part], own, log_f)
    return levels, objective.spread(slopes, part)
