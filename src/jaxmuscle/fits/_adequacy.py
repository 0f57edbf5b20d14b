"""Does the model describe the data? Chi² of a fit against its distribution under the fitted model, and where it fails."""

import functools
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.special import gammaincinv, ndtr

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.keys import fold_in
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._consequences import Consequences, Expansion, consequences
from jaxmuscle.objective._covariance import residual_covariance
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.objective._residuals import PartResiduals, Residuals
from jaxmuscle.response._linearised import linearised
from jaxmuscle.spectra._bin_law import bin_rows
from jaxmuscle.spectra._settings import SpectrumSettings

ADEQUATE = 0.01
REPLICATES = 999
CHUNK = 500
LINES = 128
STRENGTHS = np.geomspace(0.005, 20.0, 20)
HARMONIC = ("harmonic_amplitude", "harmonic_frequency")
Rows = Float[np.ndarray, "replicates residuals"]


class Adequacy(NamedTuple):
    """`chi2` of all data residuals of a fit, what is `expected` of it under the fitted model, and its p-value `p`.

    `misfit` says in words where the data lie furthest from the model.
    """

    chi2: float
    expected: float
    p: float
    misfit: str

    @property
    def adequate(self) -> bool:
        """Whether the model describes the data: p >= 0.01."""
        return self.p >= ADEQUATE

    @property
    def widening(self) -> float:
        """By how much standard errors grow where the model does not describe the data, `√(chi² / expected)`."""
        return 1.0 if self.adequate else max(1.0, float(np.sqrt(self.chi2 / self.expected)))


class _Refit(NamedTuple):
    """What a refit leaves of residuals, data rows and then those of the prior, with any of several lines as the harmonic.

    With line i residuals lose `change[i]`, and what lies in `taken[i]`, orthonormal columns, is taken up by the other
    parameters, at the `penalty` of the frequency's prior. The last line is the fitted one, which changes nothing.
    `frequency` of each; `used`, the coordinates of amplitude and frequency, none where no line is sought; `prior`, the
    prior's rows at the fit.
    """

    change: Float[np.ndarray, "lines all"]
    taken: Float[np.ndarray, "lines all fitted"]
    penalty: Float[np.ndarray, " lines"]
    prior: Float[np.ndarray, " rows"]
    frequency: Float[np.ndarray, " lines"]
    used: tuple[int, ...]

    def cost(self, residuals: Float[np.ndarray, "rows all"]) -> Float[np.ndarray, "rows lines"]:
        """`|(1 - U Uᵀ) (r - change)|²` with the penalty, less `|r|²`."""
        lines, size, fitted = self.taken.shape
        basis = np.moveaxis(self.taken, 1, 0).reshape(size, -1)
        held = np.einsum("la,lak->lk", self.change, self.taken)
        inside = (residuals @ basis).reshape(len(residuals), lines, fitted) - held
        outside = np.sum(self.change**2, axis=1) + self.penalty - 2 * residuals @ self.change.T
        return outside - np.sum(inside**2, axis=2)

    def left(self, residuals: Float[np.ndarray, "rows all"], line: np.ndarray | int = -1) -> Float[np.ndarray, "rows all"]:
        """What is left of every row with its line."""
        rest = residuals - self.change[line]
        taken = np.broadcast_to(self.taken[line], (len(rest), *self.taken.shape[1:]))
        return rest - np.einsum("rak,rk->ra", taken, np.einsum("rak,ra->rk", taken, rest))


def adequacy(
    problem: FitProblem, objective: Residuals, seen: Expansion, found: Consequences, scatter: np.ndarray
) -> Adequacy | None:
    """Chi² of the data residuals against its distribution under the fitted model; None where the spread is unknown.

    The reference: residuals ε drawn by the law of the bins about the fitted spectrum, and what a refit leaves of them. The
    parameters are taken as linear there, `(1 - H) ε` with `H = J (Jᵀ J + Λ)⁻¹ Jᵀ`, the pull of the prior included for truths
    drawn from it; but the line of one harmonic whose amplitude and frequency are free is sought anew, over the whole band,
    as a fit does.
    """
    if not all(part.statistics.known for part in objective.parts):
        return None
    generator, refit = generator_of(problem, 5), _refit(problem, objective, seen, found)
    count, rows = len(found.residuals), len(refit.prior)
    chi2 = np.empty(0)
    drawn = np.concatenate([_drawn(objective, scatter, generator), generator.normal(size=(REPLICATES, rows))], axis=1)
    for some in np.split(drawn, np.arange(CHUNK, REPLICATES, CHUNK)):
        rest = refit.left(some, np.argmin(refit.cost(some), axis=1))
        chi2 = np.append(chi2, np.sum(rest[:, :count] ** 2, axis=1))
    here = float(np.sum(found.residuals**2))
    p = (1 + np.sum(chi2 >= here)) / (1 + REPLICATES)
    inner = refit.left(refit.left(np.pad(scatter, (0, rows))).T)[:count, :count]
    return Adequacy(here, float(np.mean(chi2)), float(p), _misfit(problem, objective, found.residuals, inner))


def judged(problem: FitProblem, objective: Residuals, seen: Expansion) -> Adequacy | None:
    """`adequacy` of the model as it was seen at the point where a fit ended."""
    return adequacy(problem, objective, seen, consequences(objective, seen), scatter_of(problem, objective, seen))


def scatter_of(problem: FitProblem, objective: Residuals, seen: Expansion) -> Float[np.ndarray, "residuals residuals"]:
    """Covariance of the data residuals of all parts."""
    each = [residual_covariance(part.target, own, np.asarray(moments.line / moments.power))
            for part, own, moments in zip(problem.parts, objective.parts, seen.moments, strict=True)]  # fmt: skip
    return np.asarray(block_diag(*each))


def elsewhere(problem: FitProblem, objective: Residuals, seen: Expansion, found: Consequences, sizes: np.ndarray) -> float:
    """Which share of the posterior has the harmonic further than a bin from where the fit has it; 0 without a free one.

    The lines of `adequacy`'s grid, all else refitted to first order, against the fitted one by its curvature; `sizes` is the
    covariance of the estimates, larger than the inverse curvature since neighbouring bins correlate: costs count for less.
    """
    refit = _refit(problem, objective, seen, found)
    if not refit.used:
        return 0.0
    (a, f), sd = refit.used, problem.coordinates.sd
    residual = np.concatenate([found.residuals, refit.prior])
    gain = np.linalg.pinv(found.jacobian.T @ found.jacobian + np.diag(problem.prior), hermitian=True)
    dull = max(1.0, float(sizes[f, f] / gain[f, f]))
    cost = refit.cost(residual[None])[0]
    cost = (cost - cost[-1]) / dull
    apart = np.abs(refit.frequency - refit.frequency[-1])
    weight = np.where(apart >= problem.parts[0].target.settings.resolution, np.exp(-0.5 * np.clip(cost, -700, 700)), 0.0)
    grid = refit.frequency[:LINES]
    cell = np.gradient(grid) / grid / sd[f] * 0.5 * np.log(STRENGTHS[1] / STRENGTHS[0]) / sd[a]
    there = float(np.sum(weight[:-1].reshape(-1, LINES) * cell))
    here = 2 * np.pi * np.sqrt(max(np.linalg.det(sizes[np.ix_([a, f], [a, f])]), 1e-300))
    return there / (there + here)


def without_fitted(jacobian: Float[np.ndarray, "all fitted"]) -> Float[np.ndarray, "all all"]:
    """The projection that removes from residuals what the fitted directions take up."""
    basis = taken_up(jacobian)
    return np.eye(len(jacobian)) - basis @ basis.T


def taken_up(jacobian: Float[np.ndarray, "*lines all fitted"]) -> Float[np.ndarray, "*lines all fitted"]:
    """Orthonormal columns that span what the fitted directions take up; zero where two of them are one."""
    basis, size, _ = np.linalg.svd(np.nan_to_num(jacobian), full_matrices=False)
    return basis * (size > 1e-9 * np.max(size, axis=-1, keepdims=True, initial=1e-300))[..., None, :]


def generator_of(problem: FitProblem, number: int) -> np.random.Generator:
    """Random numbers of one purpose, by the key of the fit."""
    return np.random.default_rng(np.asarray(jax.random.key_data(fold_in(problem.key, number))))


def drawn_log_residuals(part: PartResiduals, generator: np.random.Generator, count: int) -> Float[np.ndarray, "rows bins"]:
    """Log residuals of spectra that scatter about their expectation by the law of the bins: correlated gamma variables."""
    law = part.statistics
    normal = generator.multivariate_normal(np.zeros(len(law.sd)), law.correlation, size=count, method="cholesky")
    z = normal * law.sd
    if np.all(np.isfinite(law.half)):
        z = np.log(gammaincinv(law.half, ndtr(normal)) / law.half) - law.bias
    return (z - z.mean(axis=1, keepdims=True)) / law.sd


def _drawn(objective: Residuals, scatter: np.ndarray, generator: np.random.Generator) -> Rows:
    """Data residuals of every part at the truth."""
    drawn = generator.multivariate_normal(np.zeros(len(scatter)), scatter, size=REPLICATES, method="eigh")
    start = 0
    for part in objective.parts:
        bins = len(part.statistics.sd)
        if part.residual == "log" and objective.linear:
            drawn[:, start : start + bins] = drawn_log_residuals(part, generator, REPLICATES)
        start += _rows_of(part)
    return drawn


def _rows_of(part: PartResiduals) -> int:
    bins = len(part.statistics.sd) - (part.residual == "cumulative")
    return bins + (part.data.variation is not None) + (part.data.mean is not None)


def _refit(problem: FitProblem, objective: Residuals, seen: Expansion, found: Consequences) -> _Refit:
    """Lines of every frequency and strength in place of the fitted one, where a fit would have found them."""
    names, prior = problem.coordinates.names, np.sqrt(problem.prior)
    free = tuple(names.index(n) for n in HARMONIC if n in names)
    moments, slopes, own = seen.moments[0], seen.slopes[0], objective.parts[0]
    power, line = np.asarray(moments.power), np.asarray(moments.line)
    alone = len(problem.parts) == 1 and len(free) == 2 and problem.residual == "log"
    if not (alone and np.all(power > line) and np.any(line > 0)):
        taken = taken_up(np.concatenate([found.jacobian, np.diag(prior)]))[None]
        return _Refit(np.zeros((1, taken.shape[1])), taken, np.zeros(1), prior * seen.theta, np.zeros(1), ())
    part, (a, f), sd, noise = problem.parts[0], free, problem.coordinates.sd, power - line
    frequency, each, square = line_grid(part, noise)
    task = part.task_at(seen.theta)
    here = float(task["harmonic_frequency"])
    held = float(np.sum(line) / np.sum(line_spectra(part, np.array([here]))))
    frequency, square = np.append(frequency, here), np.append(square, held)
    total = noise + np.append(square[:-1, None] * each, line[None], axis=0)
    kept = np.delete(np.arange(len(names)), free)
    count, bins, lines = len(found.residuals), len(line), len(total)
    change = np.zeros((lines, count + len(kept) + 1))
    jacobian = np.zeros((*change.shape, len(kept)))
    spread = np.asarray(own.data.sd)
    # The level of a line is held: the other parameters move the noise alone, and the amplitude follows.
    level = np.sum(slopes.line, axis=0)[kept] / np.sum(line)
    logs = np.log(total / power)
    change[:, :bins] = (logs - logs.mean(axis=1, keepdims=True)) / spread
    rise = (slopes.power - slopes.line)[:, kept] / total[..., None]
    jacobian[:, :bins] = (rise.mean(axis=1, keepdims=True) - rise) / spread[:, None]
    jacobian[:, bins:count] = found.jacobian[bins:, kept]
    if own.data.variation is not None:
        error, variance = float(own.data.variation[1]), float(moments.variance)
        other = np.maximum(variance + square - held, 1e-6 * variance)
        change[:, bins] = -0.5 * np.log(other / variance) / error
        moved = (slopes.variance[kept] - held * level) / other[:, None]
        jacobian[:, bins] = (0.5 * moved - slopes.mean[kept] / float(moments.mean)) / error
    # Of two lines of one frequency the mean square goes with the squared amplitude.
    louder = 0.5 * (np.log(square / held) - np.log(_gain(task, frequency) / _gain(task, [here]))) / sd[a]
    change[:, -1] = -prior[a] * louder
    jacobian[:, count:-1] = np.diag(prior[kept])
    jacobian[:, -1] = -0.5 * prior[a] * level / sd[a]
    theta = seen.theta[f] + np.log(frequency / here) / sd[f]
    return _Refit(change, taken_up(jacobian), problem.prior[f] * (theta**2 - seen.theta[f] ** 2),
                  np.append(prior[kept] * seen.theta[kept], prior[a] * seen.theta[a]), frequency, free)  # fmt: skip


def _gain(task: AbstractTask, frequency: Any) -> Float[np.ndarray, " lines"]:
    """Mean square of the output behind the low-pass for a harmonic of amplitude √2."""
    system, settings = jax.tree.map(np.asarray, linearised(task).system), task.settings
    base = np.asarray(as_arrays(task).harmonic_base())
    s = 2j * np.pi * np.asarray(frequency)
    inside = np.linalg.solve(s[:, None, None] * np.eye(len(system.A)) - system.A, (system.B @ base)[:, None])[..., 0]
    reply = inside @ system.C + system.D @ base + s * (system.E @ base)
    if settings.sections is not None:
        back = np.exp(-s / settings.rate) ** np.arange(3)[:, None]
        passed = np.prod((settings.sections[:, :3] @ back) / (settings.sections[:, 3:] @ back), axis=0)
        reply = reply * passed ** (2 if settings.filter_direction == "both" else 1)
    return np.abs(reply) ** 2


def line_grid(
    part: Part, noise: Float[np.ndarray, " bins"]
) -> tuple[Float[np.ndarray, " lines"], Float[np.ndarray, "lines bins"], Float[np.ndarray, " lines"]]:
    """Lines over the band of a target: frequency, what a mean square of 1 adds to every bin, and the mean squares tried.

    They hold 0.005 to 20 times the `noise` of the bin where they are strongest.
    """
    frequency = np.linspace(part.target.frequency[0], part.target.frequency[-1], LINES)
    each = line_spectra(part, frequency)
    square = STRENGTHS[:, None] / np.max(each / noise, axis=1)
    return np.tile(frequency, len(STRENGTHS)), np.tile(each, (len(STRENGTHS), 1)), square.reshape(-1)


def line_spectra(part: Part, frequency: Float[np.ndarray, " lines"]) -> Float[np.ndarray, "lines bins"]:
    """Welch power of a line of mean square 1 behind the low-pass, its phase averaged: `½ (|X_k(f)|² + |X_k(-f)|²)`."""
    return _line_spectra(part.target.settings, tuple(part.chosen.tolist()), tuple(frequency.tolist()))


@functools.lru_cache(maxsize=64)
def _line_spectra(settings: SpectrumSettings, chosen: tuple[int, ...], frequency: tuple[float, ...]) -> np.ndarray:
    rows = bin_rows(settings)[list(chosen)]
    spin = np.exp(2j * np.pi * np.outer(np.arange(settings.length), frequency) / settings.rate)
    return 0.5 * (np.abs(rows @ spin) ** 2 + np.abs(rows @ spin.conj()) ** 2).T


def _misfit(problem: FitProblem, objective: Residuals, residuals: np.ndarray, covariance: np.ndarray) -> str:
    """In words, the run of neighbouring bins whose residuals have the largest sum in its standard errors."""
    if problem.residual == "cumulative":
        return ""
    start, worst = 0, (0.0, "")
    for part, own in zip(problem.parts, objective.parts, strict=True):
        bins = _rows_of(own) - (own.data.variation is not None) - (own.data.mean is not None)
        rows = slice(start, start + bins)
        start += _rows_of(own)
        size = np.concatenate([[0.0], np.cumsum(residuals[rows])])
        spread = np.zeros((bins + 1, bins + 1))
        spread[1:, 1:] = np.cumsum(np.cumsum(covariance[rows, rows], axis=0), axis=1)
        corner = np.diag(spread)
        variance = corner[:, None] + corner[None] - 2 * spread
        first, last = np.triu_indices(bins + 1, 1)
        # A run that the fit has taken up has hardly any variance of its own.
        ratio = (size[last] - size[first]) / np.sqrt(np.maximum(variance[first, last], 0.1 * (last - first)))
        i = int(np.argmax(np.abs(ratio)))
        if abs(ratio[i]) > abs(worst[0]):
            low, high = part.target.frequency[first[i]], part.target.frequency[last[i] - 1]
            place = f"at {low:.2g} Hz" if last[i] - first[i] == 1 else f"from {low:.2g} to {high:.2g} Hz"
            more = "more" if ratio[i] > 0 else "less"
            whose = f"{part.name} has" if len(problem.parts) > 1 else "the data have"
            worst = ratio[i], f"{whose} {more} power than the model {place} ({abs(ratio[i]):.1f} standard errors)"
    return worst[1]
