"""What a refit leaves of residuals, to first order, but with the line of the harmonic sought
anew. The verdict and the test of the harmonic compare data with such refits.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag

from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import HARMONIC
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._consequences import Consequences, Expansion
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.response._rows import line_levels

LINES = 128  # frequencies, at least
# residuals whose costs are found at a time: what lies in the directions of all lines is large
CHUNK = 100
# Mean squares of lines, over the noise of the bin where each is strongest. A weaker one moves that
# bin by half a per cent; of a stronger one the bin is all line, and its log power moves alike.
STRENGTHS = np.geomspace(0.005, 20.0, 20)


class LinearisedRefit(NamedTuple):
    """What a refit leaves of residuals, data rows and then those of the prior, with any of several
    lines as the harmonic.

    With line i residuals lose `change[i]`, and what lies in `taken[i]`, orthonormal columns, is
    taken up by the other parameters, at the `penalty` of the frequency's prior. The last line is
    the fitted one, which changes nothing. `frequency` of each; `used`, the coordinates of amplitude
    and frequency, none where no line is sought; `prior`, the prior's rows at the fit; `narrow`,
    which turns residuals into the fewer ones that all this is about: of many rows those directions,
    orthonormal columns, in which the parameters can move them.
    """

    change: Float[np.ndarray, "lines all"]
    taken: Float[np.ndarray, "lines all fitted"]
    penalty: Float[np.ndarray, " lines"]
    prior: Float[np.ndarray, " rows"]
    frequency: Float[np.ndarray, " lines"]
    used: tuple[int, ...]
    narrow: Float[np.ndarray, "rows all"]

    def cost(self, residuals: Float[np.ndarray, "rows all"]) -> Float[np.ndarray, "rows lines"]:
        """`|(1 - U Uᵀ) (r - change)|²` with the penalty, less `|r|²`; the largest of its terms in
        single precision."""
        own, (_, size, fitted) = residuals @ self.narrow, self.taken.shape
        # Multiplied out: |r|² falls away, the rest is one product for all rows and lines. Squares
        # of what is taken up are sums of like signs, so single precision serves.
        held = np.einsum("la,lak->lk", self.change, self.taken)
        away = self.change - np.einsum("lak,lk->la", self.taken, held)
        columns = np.transpose(self.taken.astype(np.float32), (1, 2, 0)).reshape(size, -1)
        cost = (
            np.sum(self.change**2, axis=1)
            + self.penalty
            - np.sum(held**2, axis=1)
            - 2 * own @ away.T
        )
        for i in range(0, len(own), CHUNK):
            inside = own[i : i + CHUNK].astype(np.float32) @ columns
            np.square(inside, out=inside)
            cost[i : i + CHUNK] -= inside.reshape(len(inside), fitted, -1).sum(axis=1)
        return cost

    def left(
        self, residuals: Float[np.ndarray, "rows all"], line: np.ndarray | int = -1
    ) -> Float[np.ndarray, "rows all"]:
        """What is left of every row with its line."""
        own = residuals @ self.narrow
        rest = own - self.change[line]
        taken = np.broadcast_to(self.taken[line], (len(rest), *self.taken.shape[1:]))
        rest = rest - np.einsum("rak,rk->ra", taken, np.einsum("rak,ra->rk", taken, rest))
        return residuals + (rest - own) @ self.narrow.T


def linearise_refit(
    problem: FitProblem, objective: Residuals, seen: Expansion, found: Consequences
) -> LinearisedRefit:
    """Lines of every frequency and strength in place of the fitted one, where a fit would have
    found them."""
    names, prior = problem.coordinates.names, problem.prior_root
    free = tuple(names.index(n) for n in HARMONIC if n in names)
    moments, slopes, own = seen.moments[0], seen.slopes[0], objective.parts[0]
    jacobian, turn = _narrowed(objective, found.jacobian)
    found = found._replace(residuals=turn.T @ found.residuals, jacobian=jacobian)
    power, line = np.asarray(moments.power), np.asarray(moments.line)
    alone = len(problem.parts) == 1 and len(free) == 2
    if not (alone and np.all(power > line) and np.any(line > 0)):
        taken = taken_up(np.concatenate([found.jacobian, prior]))[None]
        return LinearisedRefit(
            np.zeros((1, taken.shape[1])),
            taken,
            np.zeros(1),
            prior @ seen.theta,
            np.zeros(1),
            (),
            np.asarray(block_diag(turn, np.eye(len(prior)))),
        )
    part, (a, f), sd, noise = problem.parts[0], free, problem.coordinates.sd, power - line
    task = part.task_at(seen.theta)
    here = float(task["harmonic_frequency"])
    tried = lines_of(part, task, noise, here)
    held = float(np.sum(line) / np.sum(tried.last))
    frequency, square = np.append(tried.frequency, here), np.append(tried.square, held)
    total = noise + np.append(tried.square[:, None] * tried.each, line[None], axis=0)
    kept = np.delete(np.arange(len(names)), free)
    count, bins, lines = len(found.residuals), len(line), len(total)
    change = np.zeros((lines, count + len(kept) + 1))
    jacobian = np.zeros((*change.shape, len(kept)))
    spread = np.asarray(own.data.sd)
    # The level of a line is held: the other parameters move the noise alone, and the amplitude
    # follows.
    level = np.sum(slopes.line, axis=0)[kept] / np.sum(line)
    logs = np.log(total / power)
    change[:, :bins] = (logs - logs.mean(axis=1, keepdims=True)) / spread
    rise = (slopes.power - slopes.line)[:, kept] / total[..., None]
    jacobian[:, :bins] = (rise.mean(axis=1, keepdims=True) - rise) / spread[:, None]
    # What no line changes: the further residuals keep their slopes.
    jacobian[:, bins:count] = found.jacobian[bins:, kept]
    if own.data.variation is not None:
        error, variance = float(own.data.variation[1]), float(moments.variance)
        # Without the fitted line the rest may be nothing but rounding, whose log would be -∞.
        other = np.maximum(variance + square - held, 1e-6 * variance)
        change[:, bins] = -0.5 * np.log(other / variance) / error
        moved = (slopes.variance[kept] - held * level) / other[:, None]
        jacobian[:, bins] = (0.5 * moved - slopes.mean[kept] / float(moments.mean)) / error
    # The prior's residual of the amplitude: of two lines of one frequency the mean square goes with
    # the squared amplitude, of two frequencies with the gain of the muscle, too.
    louder = 0.5 * (np.log(square / held) - np.log(tried.gain / tried.gain[-1])) / sd[a]
    change[:, -1] = -prior[a, a] * louder
    jacobian[:, count:-1] = prior[np.ix_(kept, kept)]
    jacobian[:, -1] = -0.5 * prior[a, a] * level / sd[a]
    theta = seen.theta[f] + np.log(frequency / here) / sd[f]
    rows = np.append((prior @ seen.theta)[kept], prior[a, a] * seen.theta[a])
    return LinearisedRefit(
        change,
        taken_up(jacobian),
        problem.prior[f] * (theta**2 - seen.theta[f] ** 2),
        rows,
        frequency,
        free,
        np.asarray(block_diag(turn, np.eye(len(rows)))),
    )


def _narrowed(
    objective: Residuals, jacobian: Float[np.ndarray, "rows free"]
) -> tuple[np.ndarray, np.ndarray]:
    """The Jacobian with the many rows of a dynamic stiffness turned into few, and what turns
    them."""
    turns, start = [], 0
    for part in objective.parts:
        points = 0 if part.model.points is None else 2 * len(part.model.points)
        rows = part.data.further - points + len(part.statistics.sd)
        turns.append(np.eye(rows))
        start += rows
        if points:
            turns.append(np.linalg.qr(jacobian[start : start + points])[0])
            start += points
    turn = np.asarray(block_diag(*turns))
    return turn.T @ jacobian, turn


class Lines(NamedTuple):
    """Lines over the band of a target, as many strengths as frequencies make rows.

    `frequency` of each; `each`, what a mean square of 1 adds to the bins; `square`, the mean square
    that is tried, from 0.005 to 20 times the noise of the bin where it is strongest; `gain`, the
    mean square of a harmonic of amplitude √2, and that at one more frequency, of which `last` is
    what a mean square of 1 adds.
    """

    frequency: Float[np.ndarray, " lines"]
    each: Float[np.ndarray, "lines bins"]
    square: Float[np.ndarray, " lines"]
    gain: Float[np.ndarray, " lines_and_one"]
    last: Float[np.ndarray, " bins"]


def over_band(target: Target, least: int) -> Float[np.ndarray, " frequencies"]:
    """Frequencies over the band of a target, two to a bin or more: a line is four bins wide."""
    first, last = float(target.frequency[0]), float(target.frequency[-1])
    return np.linspace(
        first, last, max(least, round(2 * (last - first) / target.settings.resolution))
    )


def lines_of(
    part: Part, task: AbstractTask, noise: Float[np.ndarray, " bins"], last: float
) -> Lines:
    """Lines over the band beside noise of these powers, and one more frequency."""
    frequency = over_band(part.target, LINES)
    each, gain = line_levels(task, part.target.settings, np.append(frequency, last))
    each = each[:, part.chosen]
    square = STRENGTHS[:, None] / np.max(each[:-1] / noise, axis=1)
    often = len(STRENGTHS)
    return Lines(
        np.tile(frequency, often),
        np.tile(each[:-1], (often, 1)),
        square.reshape(-1),
        np.append(np.tile(gain[:-1], often), gain[-1]),
        each[-1],
    )


def without_fitted(jacobian: Float[np.ndarray, "all fitted"]) -> Float[np.ndarray, "all all"]:
    """The projection that removes from residuals what the fitted directions take up."""
    basis = taken_up(jacobian)
    return np.eye(len(jacobian)) - basis @ basis.T


def taken_up(
    jacobian: Float[np.ndarray, "*lines all fitted"],
) -> Float[np.ndarray, "*lines all fitted"]:
    """Orthonormal columns that span what the fitted directions take up; zero where two of them are
    one."""
    basis, size, _ = np.linalg.svd(np.nan_to_num(jacobian), full_matrices=False)
    return (
        basis * (size > 1e-9 * np.max(size, axis=-1, keepdims=True, initial=1e-300))[..., None, :]
    )
