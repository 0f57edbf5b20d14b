"""Profile likelihood: how far one quantity can move while everything else follows."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import fitting
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import choices, folded
from jaxmuscle.data._target import Target
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.fits._result import FitResult
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._derived import unit_of
from jaxmuscle.objective._likelihood import Likelihood
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._scoring import Maximum, Pin, highest, maximise
from jaxmuscle.objective._starts import distinct, frequency_names

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes


# precision that keeps what nothing determines from running away: sd 3 in the logarithm
WEAK = 1 / 9
FURTHEST = 1.0  # standard deviations in the logarithm that a step of 1 may have
FAR = np.log([5.0, 10.0, 30.0, 100.0])
STEPS = np.array([0.4, 0.8, 1.2, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0])
PER_BIN = 4
MODES, COUNTS = 4, 8.0
HELD = 0.02  # standard errors that a derived quantity is held to


class Profile(Printed, Result, eqx.Module):
    """Twice the fall of the log likelihood (`rise`) with a quantity held at `values`, all else
    fitted anew.

    `value` at the maximum; `stderr`, by the curvature there; `intervals`, where `rise` is below the
    χ² quantile of `level` with one degree of freedom, None for an end that the data leave open;
    `with_priors`, whether the priors count as data; `name` and `unit` of the quantity; `target`.
    """

    name: str
    unit: str
    target: str
    value: float
    stderr: float
    values: Float[np.ndarray, " points"]
    rise: Float[np.ndarray, " points"]
    intervals: tuple[tuple[float | None, float | None], ...]
    level: float
    with_priors: bool

    @property
    def threshold(self) -> float:
        """The rise that bounds the interval."""
        return float(scipy.stats.chi2.ppf(self.level, 1))

    @property
    def low(self) -> float | None:
        """Lower end of the (lowest) interval, None if open."""
        return self.intervals[0][0]

    @property
    def high(self) -> float | None:
        """Upper end of the (highest) interval, None if open."""
        return self.intervals[-1][1]

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each point: `value` of the quantity and the `rise` there."""
        return frame({"value": self.values, "rise": self.rise})

    def plot(self, ax: "Axes | None" = None) -> "Axes":
        """The profile with its interval and the parabola of the curvature. Returns the axes."""
        return plot.profile(self, ax)

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        percent = f"{100 * self.level:g} %"
        if all(low is None and high is None for low, high in self.intervals):
            span = (
                f"the data set it no limits between {self.values[0]:.3g} and"
                f" {self.values[-1]:.3g}{unit}"
            )
        else:
            span = f"{percent} interval " + " and ".join(
                _in_words(*ends, unit) for ends in self.intervals
            )
        kind = (
            "profile of likelihood and prior"
            if self.with_priors
            else "profile likelihood, without priors"
        )
        return folded(
            [
                f"{self.name} = {self.value:.4g}{unit}: {span} ({kind}); ± {self.stderr:.2g} by"
                " curvature"
            ]
        )


def _in_words(low: float | None, high: float | None, unit: str) -> str:
    if low is None and high is None:
        return "open"
    if low is None:
        return f"below {high:.4g}{unit} (open downwards)"
    if high is None:
        return f"above {low:.4g}{unit} (open upwards)"
    return f"{low:.4g} to {high:.4g}{unit}"


def profile(
    result: FitResult,
    name: str,
    target: Target | None = None,
    *,
    with_priors: bool = False,
    level: float = 0.95,
    free: Iterable[str] | None = None,
    priors: Mapping[str, float | tuple[float, float | None] | None] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> Profile:
    """Profile likelihood of a free parameter or a derived quantity, with its confidence interval.

        print(jm.profile(result, "corner_frequency"))

    `rise(q) = 2 (max ln L - max_{θ: q(θ) = q} ln L)`, compared with a χ² quantile (Wilks 1938). The
    likelihood is that of `log_likelihood`, its maximum searched from the fit and from other
    frequencies of the harmonic. Without `with_priors` the priors do not count: a quantity that the
    data leave open has an open interval (they still hold everything else within three prior
    standard deviations or so, three times wider than in the fit).

    **Arguments:**

    - `result` of `fit`
    - `name`
    - `target` (the result's own)
    - `level` of the interval
    - `free`, `priors`, `bounds`: instead of the fit's

    **Returns:** a `Profile`. **Raises:** `ValueError` for an unknown or fixed name, a target that
    states neither segments nor sigma, a level outside (0, 1), and a failed fit.

    **Source:** Raue et al. 2009, doi:10.1093/bioinformatics/btp358.
    """
    if not 0 < level < 1:
        raise ValueError(f"level = {level}: give a probability between 0 and 1, 0.95 say")
    with fitting():
        problem = reopened(result, target, free=free, priors=priors, bounds=bounds)
        names = problem.coordinates.names
        known = (*names, *(n for n in result.derived_names if n not in names))
        if name not in known:
            raise ValueError(f"name = {name!r} is neither free nor derived: {choices(name, known)}")
        likelihood = Likelihood.of(problem)
        precision = problem.precision if with_priors else WEAK * np.eye(len(names))
        peak, best = highest(
            problem, likelihood, problem.theta_of(tuple(result.tasks.values())), precision
        )
        scan = _parameter if name in names else _derived
        value, stderr, values, height, cost = scan(problem, likelihood, peak, best, precision, name)
    order = np.argsort(values, kind="stable")
    values, height, cost = values[order], height[order], cost[order]
    rise = 2 * (cost - cost.min()) if with_priors else 2 * (height.max() - height)
    intervals = _intervals(values, rise, float(scipy.stats.chi2.ppf(level, 1)))
    unit = unit_of(name, problem.parts[problem.where(name)[0]].task.output_unit) or "1"
    return Profile(
        name, unit, problem.title, value, stderr, values, rise, intervals, level, with_priors
    )


Scan = tuple[float, float, np.ndarray, np.ndarray, np.ndarray]


def _parameter(
    problem: FitProblem,
    likelihood: Likelihood,
    peak: Maximum,
    best: int,
    precision: np.ndarray,
    name: str,
) -> Scan:
    """A free parameter held at θ_j."""
    coordinates = problem.coordinates
    j = coordinates.names.index(name)
    centre, sd = peak.theta[best, j], np.sqrt(peak.covariance(best)[j, j])
    if name in frequency_names(coordinates):
        acting = [part.target.frequency for part in problem.acting(name)]
        low, high = min(f[0] for f in acting), max(f[-1] for f in acting)
        held = np.arange(low, high + 1e-9, problem.finest.settings.resolution / PER_BIN)
        held = coordinates.theta_of(
            name, np.append(held, coordinates.values(peak.theta[best])[name])
        )
    else:
        held = _outward(centre, sd, 1 / coordinates.sd[j])
    theta = np.concatenate([_along(peak, i, j, held) for i in _modes(problem, peak, name)])
    moving = np.ones_like(theta)
    moving[:, j] = 0.0
    found = maximise(likelihood, theta, precision, moving=moving)
    values = coordinates.values_of(found.theta)[:, j]
    slope = coordinates.slope(coordinates.values_of(peak.theta[[best]])[0])[j]
    top = float(coordinates.values_of(peak.theta[[best]])[0, j])
    value, height, cost = _best_of(values, found.log_likelihood, found.cost, len(held))
    value, height, cost = (
        np.append(a, b)
        for a, b in zip(
            (value, height, cost), (top, peak.log_likelihood[best], peak.cost[best]), strict=True
        )
    )
    return top, float(sd * slope), *_unique(value, height, cost)


def _derived(
    problem: FitProblem,
    likelihood: Likelihood,
    peak: Maximum,
    best: int,
    precision: np.ndarray,
    name: str,
) -> Scan:
    """A derived quantity held by a stiff penalty; its own value where that ends."""
    part, quantity = problem.where(name)
    tables = quantities(likelihood.objective, expand(likelihood.objective, peak.theta))
    q, g = (table[part][quantity] for table in tables)
    if not np.any(g[best]):
        raise ValueError(
            f"{name} follows from none of the free parameters"
            f" ({', '.join(problem.coordinates.names)})"
        )
    log = bool(q[best] > 0)
    top, rise = (np.log(q), g / q[:, None]) if log else (q, g)
    spread = np.sqrt(rise[best] @ peak.covariance(best) @ rise[best])
    held = _outward(top[best], spread, FURTHEST if log else np.inf)
    rows = []
    for i in _modes(problem, peak, name):
        toward = peak.covariance(i) @ rise[i]
        rows.append(peak.theta[i] + np.outer(held - top[i], toward / (rise[i] @ toward)))
    theta = np.clip(np.concatenate(rows), -8, 8)
    pin = Pin(
        part,
        quantity,
        np.tile(held, len(rows)),
        HELD * min(spread, FURTHEST) if log else HELD * spread,
        log,
    )
    found = maximise(likelihood, theta, precision, pin=pin, max_steps=100)
    seen = quantities(likelihood.objective, expand(likelihood.objective, found.theta))[0][part][
        quantity
    ]
    pulled = np.sum((found.theta @ precision) * found.theta, axis=1)
    cost = 0.5 * pulled - found.log_likelihood
    value, height, cost = _best_of(
        seen, found.log_likelihood, np.where(np.isfinite(found.cost), cost, np.inf), len(held)
    )
    value, height, cost = (
        np.append(a, b)
        for a, b in zip(
            (value, height, cost),
            (q[best], peak.log_likelihood[best], peak.cost[best]),
            strict=True,
        )
    )
    return float(q[best]), float(spread * (q[best] if log else 1.0)), *_unique(value, height, cost)


def _outward(centre: float, sd: float, most: float) -> np.ndarray:
    """Points about the maximum; in a logarithm (`most` finite) on to a hundredth and a
    hundredfold."""
    step = min(sd, most)
    steps = step * STEPS
    if np.isfinite(most):
        steps = np.append(steps, [far * most for far in FAR if far * most > 1.2 * steps[-1]])
    return centre + np.concatenate([-steps[::-1], steps])


def _along(peak: Maximum, i: int, j: int, held: np.ndarray) -> np.ndarray:
    """θ on the ridge of one maximum with the coordinate j held."""
    covariance = peak.covariance(i)
    theta = peak.theta[i] + np.outer(held - peak.theta[i, j], covariance[:, j] / covariance[j, j])
    theta = np.clip(theta, -8, 8)
    theta[:, j] = held
    return theta


def _modes(problem: FitProblem, peak: Maximum, name: str) -> list[int]:
    """The best maximum and others near in height but at another frequency of a harmonic."""
    if name in frequency_names(problem.coordinates):
        return [peak.best]
    return distinct(
        problem, peak.cost, peak.theta, problem.finest.settings.resolution, COUNTS, MODES
    )


def _best_of(
    values: np.ndarray, height: np.ndarray, cost: np.ndarray, count: int
) -> tuple[np.ndarray, ...]:
    """Of the maxima with the same held value, the highest."""
    table = cost.reshape(-1, count)
    pick = np.argmin(np.where(np.isfinite(table), table, np.inf), axis=0), np.arange(count)
    chosen = tuple(x.reshape(-1, count)[pick] for x in (values, height, cost))
    fine = np.isfinite(chosen[2])
    return tuple(x[fine] for x in chosen)


def _unique(
    values: np.ndarray, height: np.ndarray, cost: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    values, index = np.unique(values, return_index=True)
    return values, height[index], cost[index]


def _intervals(
    values: np.ndarray, rise: np.ndarray, most: float
) -> tuple[tuple[float | None, float | None], ...]:
    """Where the rise is below a bound; its root is nearly linear, so crossings are interpolated in
    it."""
    root, bound = np.sqrt(np.maximum(rise, 0.0)), np.sqrt(most)
    inside = root <= bound
    found: list[tuple[float | None, float | None]] = []
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    crossings = [
        float(values[i] + (bound - root[i]) / (root[i + 1] - root[i]) * (values[i + 1] - values[i]))
        for i in edges
    ]
    ends: list[Any] = [None] * bool(inside[0]) + crossings + [None] * bool(inside[-1])
    for k in range(0, len(ends), 2):
        found.append((ends[k], ends[k + 1]))
    return tuple(found)
