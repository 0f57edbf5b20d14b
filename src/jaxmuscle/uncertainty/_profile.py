"""Profile likelihood: how far one quantity can move while everything else follows."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, Unpack

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arguments import check_options
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import fitting
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import choices, folded
from jaxmuscle.data._target import Target
from jaxmuscle.fits._reopened import ReopenOptions, reopened
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
KINDS = {True: "profile of likelihood and prior", False: "profile likelihood, without priors"}
Ends = tuple[float | None, float | None]  # of an interval, None where the data leave it open
OPEN: Ends = (None, None)
Rows = Float[np.ndarray, "rows free"]


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
    intervals: tuple[Ends, ...]
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
        ends = " and ".join(
            _in_words(low, high, unit) for low, high in self.intervals if (low, high) != OPEN
        )
        first, last = self.values[[0, -1]]
        span = (
            f"{100 * self.level:g} % interval {ends}"
            if ends
            else f"the data set it no limits between {first:.3g} and {last:.3g}{unit}"
        )
        kind = KINDS[self.with_priors]
        about = f"{self.name} = {self.value:.4g}{unit}: {span} ({kind})"
        return folded([f"{about}; ± {self.stderr:.2g} by curvature"])


def _in_words(low: float | None, high: float | None, unit: str) -> str:
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
    **options: Unpack[ReopenOptions],
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
    check_options(profile, ReopenOptions, options)
    if not 0 < level < 1:
        raise ValueError(f"level = {level}: give a probability between 0 and 1, 0.95 say")
    with fitting():
        problem = reopened(result, target, **options)
        names = problem.coordinates.names
        known = (*names, *(n for n in result.derived_names if n not in names))
        if name not in known:
            raise ValueError(f"name = {name!r} is neither free nor derived: {choices(name, known)}")
        likelihood = Likelihood.of(problem)
        precision = problem.precision if with_priors else WEAK * np.eye(len(names))
        peak, best = highest(
            problem, likelihood, problem.theta_of(tuple(result.tasks.values())), precision
        )
        # Of two names of one thing the free parameter: it is held exactly.
        scan = (_parameter if name in names else _derived)(problem, likelihood, peak, best, name)
        found = maximise(likelihood, scan.theta, precision, **scan.held)
        values, own = scan.read(found.theta), scan.read(peak.theta[[best]])
    # What a penalty that holds the quantity adds is no cost of its own.
    cost = 0.5 * np.sum((found.theta @ precision) * found.theta, axis=1) - found.log_likelihood
    cost = np.where(np.isfinite(found.cost), cost, np.inf)
    table = np.stack([values, found.log_likelihood, cost]).reshape(3, -1, scan.points)
    # of the maxima with the same held value the highest
    table = table[:, np.argmin(table[2], axis=0), np.arange(scan.points)]
    top = [own, peak.log_likelihood[[best]], peak.cost[[best]]]
    table = np.concatenate([table[:, np.isfinite(table[2])], top], axis=1)
    values, places = np.unique(table[0], return_index=True)
    _, height, cost = table[:, places]
    rise = 2 * (cost - cost.min()) if with_priors else 2 * (height.max() - height)
    unit = unit_of(name, problem.parts[problem.where(name)[0]].task.output_unit) or "1"
    scale, unit = result.scale_as_shown(unit)
    values = scale * values
    return Profile(
        name,
        unit,
        problem.title,
        scale * float(own[0]),
        scale * float(scan.stderr),
        values,
        rise,
        _intervals(values, rise, float(scipy.stats.chi2.ppf(level, 1))),
        level,
        with_priors,
    )


class Scan(NamedTuple):
    """Where a quantity is held: from which θ, and how; what it is at any θ; its standard error by
    the curvature. `points` values follow one another, for each maximum anew."""

    theta: Rows
    points: int
    held: dict[str, Any]
    read: Callable[[Rows], np.ndarray]
    stderr: float


def _parameter(
    problem: FitProblem, likelihood: Likelihood, peak: Maximum, best: int, name: str
) -> Scan:
    """A free parameter held at θ_j."""
    del likelihood
    c = problem.coordinates
    j = c.names.index(name)
    sd, own = np.sqrt(peak.covariance(best)[j, j]), c.values_of(peak.theta[[best]])[0]
    if name in frequency_names(c):
        acting = [part.target.frequency for part in problem.acting(name)]
        low, high = min(f[0] for f in acting), max(f[-1] for f in acting)
        held = np.arange(low, high + 1e-9, problem.finest.settings.resolution / PER_BIN)
        held = c.theta_of(name, np.append(held, own[j]))
    else:
        held = _outward(peak.theta[best, j], sd, 1 / c.sd[j])
    # on the ridge of each maximum
    theta = np.concatenate(
        [
            _along(peak, i, held - peak.theta[i, j], np.eye(len(c.names))[j])
            for i in _modes(problem, peak, name)
        ]
    )
    theta[:, j] = np.resize(held, len(theta))
    moving = np.ones_like(theta)
    moving[:, j] = 0.0
    slope = c.slope(own)[j]
    return Scan(theta, len(held), {"moving": moving}, lambda at: c.values_of(at)[:, j], sd * slope)


def _derived(
    problem: FitProblem, likelihood: Likelihood, peak: Maximum, best: int, name: str
) -> Scan:
    """A derived quantity held by a stiff penalty; its own value where that ends."""
    part, quantity = problem.where(name)

    def read(theta: Rows) -> list[np.ndarray]:
        """Its values and slopes."""
        tables = quantities(likelihood.objective, expand(likelihood.objective, theta))
        return [table[part][quantity] for table in tables]

    q, g = read(peak.theta)
    if not np.any(g[best]):
        raise ValueError(
            f"{name} follows from none of the free parameters"
            f" ({', '.join(problem.coordinates.names)})"
        )
    log = bool(q[best] > 0)
    top, rise = (np.log(q), g / q[:, None]) if log else (q, g)
    spread = np.sqrt(rise[best] @ peak.covariance(best) @ rise[best])
    held = _outward(top[best], spread, FURTHEST if log else np.inf)
    theta = np.concatenate(
        [_along(peak, i, held - top[i], rise[i]) for i in _modes(problem, peak, name)]
    )
    width = HELD * (min(spread, FURTHEST) if log else spread)
    pin = Pin(part, quantity, np.resize(held, len(theta)), width, log)
    stderr = spread * (q[best] if log else 1.0)
    return Scan(theta, len(held), {"pin": pin, "max_steps": 100}, lambda at: read(at)[0], stderr)


def _outward(centre: float, sd: float, most: float) -> np.ndarray:
    """Points about the maximum; in a logarithm (`most` finite) on to a hundredth and a
    hundredfold."""
    steps = min(sd, most) * STEPS
    if np.isfinite(most):
        steps = np.append(steps, [far * most for far in FAR if far * most > 1.2 * steps[-1]])
    return centre + np.concatenate([-steps[::-1], steps])


def _along(peak: Maximum, i: int, steps: np.ndarray, slope: np.ndarray) -> Rows:
    """θ from one maximum on, where a quantity of this slope has changed by the steps and all else
    is as likely as it can be."""
    toward = peak.covariance(i) @ slope
    # beyond 8 prior standard deviations no task can be computed
    return np.clip(peak.theta[i] + np.outer(steps, toward / (slope @ toward)), -8, 8)


def _modes(problem: FitProblem, peak: Maximum, name: str) -> list[int]:
    """The best maximum and others near in height but at another frequency of a harmonic."""
    if name in frequency_names(problem.coordinates):
        return [peak.best]
    return distinct(
        problem, peak.cost, peak.theta, problem.finest.settings.resolution, COUNTS, MODES
    )


def _intervals(values: np.ndarray, rise: np.ndarray, most: float) -> tuple[Ends, ...]:
    """Where the rise is below a bound; its root is nearly linear, so crossings are interpolated in
    it."""
    root, bound = np.sqrt(np.maximum(rise, 0.0)), np.sqrt(most)
    inside = root <= bound
    i = np.flatnonzero(np.diff(inside.astype(int)))
    share = (bound - root[i]) / (root[i + 1] - root[i])
    crossings = (values[i] + share * (values[i + 1] - values[i])).tolist()
    ends: list[Any] = [None] * bool(inside[0]) + crossings + [None] * bool(inside[-1])
    return tuple(zip(ends[::2], ends[1::2], strict=True))
