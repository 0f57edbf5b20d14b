"""Is there a stretch reflex in the response of a moved limb? What a fit without one leaves is
compared with what a reflex of any delay would leave; and a fit with one. `_search.py` calls it when
a muscle without reflex has been fitted.

The mathematics stand in docs/reflex.md.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arrays import require
from jaxmuscle._common.text import probability
from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import REFLEX
from jaxmuscle.model._reflex import Reflex
from jaxmuscle.model._tasks import AbstractTask, PrescribedLength
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._starts import OTHER_MODEL, SPREAD, starting_points
from jaxmuscle.response._input_response import dynamic_stiffness

from ._verdict import REPLICATES, Endpoint, generator_of, refitted_residuals

SEEN = 0.01  # level of the test
DELAYS = np.arange(0.02, 0.1301, 0.005)  # s
TIME = 0.05  # s, the contraction time with which it begins
USUAL = 0.045  # s: a reflex that is left out is taken to have this delay
POWER = 1.2816  # standard errors: nine of ten are seen
STATED = ("tangent_stiffness", "K_w_tangent", "K_z0")
WIDER = "What would tell: a motion that has power up to 20 or 30 Hz, or a larger or longer one"


class ReflexTest(NamedTuple):
    """`p`, how often data without a reflex look as much like one; the `gain` [N s/m] that fits best
    at each of `DELAYS`; `least`, the gain of which nine of ten are seen; `shifts` {quantity: how
    far it is off if that is left out, over its value and over its error}; `fitted`, whether a
    reflex that is seen describes the response better.
    """

    p: float
    gain: Float[np.ndarray, " delays"]
    least: float
    shifts: dict[str, tuple[float, float]]
    fitted: bool = True

    @property
    def seen(self) -> bool:
        """Whether there is a reflex."""
        return self.p < SEEN

    @property
    def notice(self) -> str:
        """What has to be said of a fit without a reflex."""
        if self.seen:
            return (
                f"a stretch reflex may be in these data ({probability(self.p)}), but with one the"
                " model describes them hardly better, so it is left out. Perhaps the limb is no"
                " two tissues in series. Compare with --reflex linear (reflex='linear')"
            )
        none = f"no stretch reflex is seen ({probability(self.p)})"
        off = {name: each for name, each in self.shifts.items() if each[1] > 1}
        if not off:
            return f"{none}. One of {self.least:.2g} N s/m would have been seen"
        words = ", ".join(f"{name} by {100 * share:.0f} %" for name, (share, _) in off.items())
        return (
            f"muscle and stretch reflex cannot be told apart in these data. {none[0].upper()}"
            f"{none[1:]}; but one that is just too weak to be seen ({self.least:.2g} N s/m) would"
            f" change {words}, more than the errors, which hold if there is none. {WIDER}"
        )


def look_for_reflex(ended: Endpoint) -> ReflexTest | None:
    """A score test for a linear velocity reflex beside the fitted muscle; None without a response.

    A reflex of gain g, delay d and time T changes the residuals of the dynamic stiffness by g u, u
    = G_P R / (g sd). A refit leaves c of u, to first order. With the fitted residuals r the score
    is -c·r over its standard deviation in replicates of data without a reflex, each refitted; p is
    that of the largest score among `DELAYS`.
    """
    problem, objective, found = ended.problem, ended.objective, ended.found
    which = [i for i, part in enumerate(problem.parts) if part.points is not None]
    if not which or ended.adequacy is None:
        return None
    i = which[0]
    columns = np.zeros((len(DELAYS), len(found.residuals) + len(ended.refit.prior)))
    shapes = _responses(ended, i) / np.asarray(objective.parts[i].data.stiffness[1])
    stop, points = objective.rows[i].stop, shapes.shape[1]
    columns[:, stop - 2 * points : stop] = np.hstack([shapes.real, shapes.imag])
    left = ended.refit.left(columns)
    size = np.sum(left**2, axis=1)
    null = refitted_residuals(ended, generator_of(problem, 8)) @ left.T
    spread = null.std(axis=0)
    here = -(np.concatenate([found.residuals, ended.refit.prior]) @ left.T)
    top = np.max(null / spread, axis=1)
    p = (1 + np.sum(top >= np.max(here / spread))) / (1 + REPLICATES)
    usual = int(np.argmin(np.abs(DELAYS - USUAL)))
    least = (np.quantile(top, 1 - SEEN) + POWER) * spread[usual] / size[usual]
    shifts = _shifts(ended, i, least * columns[usual])
    return ReflexTest(float(p), here / size, float(least), shifts)


def _responses(ended: Endpoint, i: int) -> np.ndarray:
    """What a reflex of each delay with a gain of 1 N s/m adds to the dynamic stiffness."""
    part = ended.problem.parts[i]
    task = ended.problem.tasks_at(ended.seen.theta)[i]
    assert isinstance(task, PrescribedLength) and part.points is not None
    s = 2j * np.pi * part.points
    at_once = task.with_parts(reflex=Reflex(1.0, 0.0, TIME))
    added = np.asarray(dynamic_stiffness(at_once, part.points)) - np.asarray(
        dynamic_stiffness(task, part.points)
    )
    return added * np.exp(-np.outer(DELAYS, s))


def _shifts(ended: Endpoint, i: int, column: np.ndarray) -> dict[str, tuple[float, float]]:
    """How far stated quantities are off if a reflex that changes residuals by this column is left
    out: over their value, and over their standard error."""
    jacobian, problem = ended.found.jacobian, ended.problem
    curvature = jacobian.T @ jacobian + problem.precision
    moved = np.linalg.lstsq(curvature, jacobian.T @ column[: len(jacobian)])[0]
    found = {}
    for name in STATED:
        if name in ended.found.slopes[i]:
            slope = np.asarray(ended.found.slopes[i][name])
            value = abs(float(ended.found.values[i][name]))
            error = float(np.sqrt(slope @ ended.covariance @ slope))
            off = abs(float(slope @ moved))
            found[name] = (off / value, off / error)
    return found


def may_have_reflex(task: AbstractTask, target: Target, options: FitOptions) -> bool:
    """Whether a reflex can be looked for beside this task: the paper's muscle, moved, with a
    response among data that are judged."""
    judged = not len(target.bins) or target.segments is not None or target.sigma is not None
    moved = type(task) is PrescribedLength and task.reflex is None and target.stiffness is not None
    return moved and judged and options.method == "linear"


def check_reflex(options: FitOptions, *, possible: bool) -> bool:
    """Whether one is looked for. Raises `ValueError` where it is asked for and cannot be."""
    require(
        possible or options.reflex != "linear",
        "reflex = 'linear': a reflex is fitted to a recording of a moved limb or to its response,"
        " with a PrescribedLength without one, by the formula. Leave it out",
    )
    return possible and options.reflex != "none"


def with_reflex(task: AbstractTask, options: FitOptions) -> tuple[AbstractTask, FitOptions]:
    """The task with a reflex, and how it is fitted: its gain may be anything above 0, and its delay
    anything between 20 and 130 ms."""
    priors = {"reflex_gain": None, "reflex_delay": None, **(options.priors or {})}
    free = (*options.also_free, *REFLEX)
    options = dataclasses.replace(options, also_free=free, priors=priors)
    return task.with_parts(reflex=Reflex()), options


def starts_with_reflex(
    problem: FitProblem, known: dict[str, float], test: ReflexTest
) -> tuple[Float[np.ndarray, "starts free"], tuple[str, ...]]:
    """Starts of a fit with a reflex, at every second delay, and how they began: with the muscle as
    it was found and the gain that fits best beside it; and with the muscles of a fit that begins
    anew, since without the reflex another one may have taken its place."""
    c, best = problem.coordinates, float(np.max(test.gain))
    tried = list(zip(DELAYS[::2], test.gain[::2], strict=True))
    fresh = c.values_of(np.array(c.theta(starting_points(problem, 2 * len(tried)))))
    rows = [dict(zip(c.names, row, strict=True)) for row in fresh]
    for i, row in enumerate(rows):
        delay, _ = tried[i % len(tried)]
        row |= dict(zip(REFLEX, (best * (1 + 3 * (i % 2)), delay, TIME), strict=True))
    rows += [
        known | dict(zip(REFLEX, (max(gain, 0.1 * best), delay, TIME), strict=True))
        for delay, gain in tried
    ]
    values = np.array([[row[name] for name in c.names] for row in rows])
    kinds = (SPREAD,) * len(fresh) + (OTHER_MODEL,) * len(tried)
    return np.asarray(c.from_theta(c.at(values))), kinds
