"""Does the model describe the data? `Endpoint` holds what follows from where a fit ended: chi²
against its distribution under the fitted model, where it fails, errors and intervals. The choice
of the model and the report read it.
"""

import dataclasses
import functools
from collections.abc import Iterable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy.linalg import block_diag
from scipy.special import gammaincinv, ndtr

from jaxmuscle._common.keys import fold_in
from jaxmuscle._common.programs import kept
from jaxmuscle._common.text import probability
from jaxmuscle.objective._consequences import Consequences, Expansion, consequences
from jaxmuscle.objective._covariance import parameter_covariance, residual_covariance
from jaxmuscle.objective._least_squares import Minima, least_squares
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import PartResiduals, Residuals, further_residuals
from jaxmuscle.response._expected import Moments

from ._intervals import Interval, intervals
from ._refit import STRENGTHS, LinearisedRefit, linearise_refit
from ._result import ADEQUATE, Adequacy
from ._signal_checks import SignalTest, check_signals
from ._stages import Stage, expand_at_best

ALONE = 2.5  # standard deviations: a single bin beyond the run that is named
REPLICATES = 999
WIDER = 3.0  # the priors of a second descent, which shows what rests on them
SAMPLES = 5  # of the key, for what is simulated beside the samples
ELSEWHERE = (
    "The misfit is in the other data. What comes from these may still be right: fit them alone, and"
    " compare (a dynamic stiffness with jaxmuscle fit stiffness.csv)"
)
Rows = Float[np.ndarray, "replicates residuals"]


@dataclasses.dataclass(frozen=True)
class Endpoint:
    """What follows from where a fit ended; computed when it is asked for, and once."""

    problem: FitProblem
    objective: Residuals
    seen: Expansion
    _ends: dict[str, Interval] = dataclasses.field(default_factory=dict, compare=False)

    @classmethod
    def of(cls, problem: FitProblem, stage: Stage) -> "Endpoint":
        """The best point of a stage."""
        return cls(problem, stage.objective, expand_at_best(stage.objective, stage.minima))

    def with_wide_priors(self, minima: Minima, max_steps: int) -> "Endpoint":
        """Where a descent from the same minima ends if all standard deviations of the prior are
        `WIDER` times as large."""
        rows = tuple(row / WIDER for row in self.problem.damping)
        prior = self.problem.prior / WIDER**2
        problem = dataclasses.replace(self.problem, prior=prior, damping=rows)
        objective = eqx.tree_at(lambda o: o.prior_root, self.objective, problem.prior_root)
        found = least_squares(objective, minima.s, max_steps)
        return Endpoint.of(problem, Stage("wide priors", objective, found))

    @functools.cached_property
    def found(self) -> Consequences:
        """Residuals and derived quantities with their slopes."""
        return consequences(self.objective, self.seen)

    def values_of(self, names: Iterable[str]) -> dict[str, float]:
        """Free parameters and derived quantities."""
        tables = self.problem.by_name(self.found.values)
        free = self.problem.coordinates.names
        natural = self.problem.coordinates.values_of(self.seen.theta[None])[0]
        known = dict(zip(free, natural, strict=True))
        # of several targets, a quantity that is the same for all is that of the first
        first = f"@{self.problem.parts[0].name}"
        return {
            n: float(known[n] if n in known else tables[n] if n in tables else tables[n + first])
            for n in names
        }

    @functools.cached_property
    def scatter(self) -> Float[np.ndarray, "residuals residuals"]:
        """Covariance of the data residuals of all parts."""
        parts = zip(self.problem.parts, self.objective.parts, self.seen.moments, strict=True)
        each = [
            residual_covariance(part.target, own, np.asarray(m.line / m.power))
            for part, own, m in parts
        ]
        return np.asarray(block_diag(*each))

    @functools.cached_property
    def refit(self) -> LinearisedRefit:
        """What a refit leaves of residuals."""
        return linearise_refit(self.problem, self.objective, self.seen, self.found)

    @functools.cached_property
    def covariance(self) -> Float[np.ndarray, "free free"]:
        """That of the estimates, in prior standard deviations."""
        return parameter_covariance(self.found.jacobian, self.scatter, self.problem.precision)

    @functools.cached_property
    def judged(self) -> tuple[Adequacy | None, tuple[str, ...]]:
        """`adequacy`, and a sentence for each kind of data that the model misses although it
        describes all data together."""
        return judged(self)

    @property
    def adequacy(self) -> Adequacy | None:
        """Whether the model describes the data; None where the spread is unknown."""
        return self.judged[0]

    @functools.cached_property
    def further(self) -> tuple[dict[str, float], ...]:
        """Of every part the residuals of the measured mean and coefficient of variation, in
        standard deviations."""
        return tuple(
            further_of(part, moments)
            for part, moments in zip(self.objective.parts, self.seen.moments, strict=True)
        )

    @functools.cached_property
    def signals(self) -> tuple[SignalTest, ...]:
        """What the samples of each target show beside its spectrum."""
        tasks, key = self.problem.tasks_at(self.seen.theta), fold_in(self.problem.key, SAMPLES)
        return tuple(
            check_signals(part.target, task, key)
            for part, task in zip(self.problem.parts, tasks, strict=True)
        )

    @property
    def widening(self) -> float:
        """By how much the errors grow: where the model does not describe the data, or where their
        size changes more than the scatter of the trials has widened them already."""
        unsteady = [
            test.widening / part.target.overdispersion
            for test, part in zip(self.signals, self.problem.parts, strict=True)
        ]
        return max(1.0 if self.adequacy is None else self.adequacy.widening, *unsteady, 1.0)

    def intervals(self, names: Iterable[str], widening: float | None = None) -> dict[str, Interval]:
        """95 % intervals of these quantities; computed once. `widening`, where it is known."""
        factor = self.widening if widening is None else widening
        new = {name: factor for name in names if name not in self._ends}
        where = self.problem, self.objective, self.seen, self.covariance
        self._ends.update(intervals(*where, new))
        return {n: self._ends[n] for n in names if n in self._ends}


def further_of(part: PartResiduals, moments: Moments) -> dict[str, float]:
    """Residuals of a target's coefficient of variation and mean by name."""
    names = [
        name
        for name, given in (
            ("coefficient_of_variation", part.data.variation),
            ("mean", part.data.mean),
        )
        if given is not None
    ]
    return dict(zip(names, map(float, np.asarray(_further(moments, part.data))), strict=False))


_further = kept(further_residuals)


def judged(ended: Endpoint) -> tuple[Adequacy | None, tuple[str, ...]]:
    """Chi² of the data residuals against its distribution under the fitted model; None where the
    spread is unknown.

    Also chi² of each kind of data by itself, where there are several: many good points can hide a
    few bad ones.

    The reference: residuals ε drawn by the law of the bins about the fitted spectrum, and what a
    refit leaves of them. The parameters are taken as linear there, `(1 - H) ε` with `H = J (Jᵀ J +
    Λ)⁻¹ Jᵀ`, the pull of the prior included for truths drawn from it; but the line of one harmonic
    whose amplitude and frequency are free is sought anew, over the whole band, as a fit does.
    """
    problem, objective, found, scatter, refit = (
        ended.problem,
        ended.objective,
        ended.found,
        ended.scatter,
        ended.refit,
    )
    if not all(part.statistics.known for part in objective.parts):
        return None, ()
    count, rows = len(found.residuals), len(refit.prior)
    rest = refitted_residuals(ended, generator_of(problem, 5))
    here, expected, p = _tested(found.residuals, rest[:, :count])
    misfit = ""
    if p < ADEQUATE:
        inner = refit.left(refit.left(np.pad(scatter, (0, rows))).T)[:count, :count]
        misfit = _misfit(problem, objective, found.residuals, inner)
    kinds = _kinds(problem, objective)
    alone = {words: _tested(found.residuals[rows], rest[:, rows]) for words, rows in kinds.items()}
    if p < ADEQUATE:
        right = [
            f"{words} ({probability(each[2])})"
            for words, each in alone.items()
            if each[2] >= ADEQUATE
        ]
        return Adequacy(here, expected, p, misfit), tuple(
            [f"taken alone, the model describes {' and '.join(right)}. {ELSEWHERE}"]
            * (bool(right) and len(kinds) > 1)
        )
    hidden = {words: each for words, each in alone.items() if each[2] < ADEQUATE / len(kinds)}
    said = tuple(
        f"the model does not describe {words}, taken alone: chi2 {chi2:.3g}, expected {mean:.3g},"
        f" {probability(own)}. The verdict counts all data together and does not show this. What to"
        f" do: look at the residuals of {words} in the figure"
        for words, (chi2, mean, own) in hidden.items()
    )
    return Adequacy(here, expected, p, misfit), said


def refitted_residuals(ended: Endpoint, generator: np.random.Generator) -> Rows:
    """What a refit leaves of residuals at the truth, those of the prior included, of many data sets
    of the fitted model."""
    refit = ended.refit
    own = _drawn(ended.objective, ended.scatter, generator)
    prior = generator.normal(size=(REPLICATES, len(refit.prior)))
    drawn = np.concatenate([own, prior], axis=1)
    return refit.left(drawn, np.argmin(refit.cost(drawn), axis=1))


def _tested(residuals: np.ndarray, rest: np.ndarray) -> tuple[float, float, float]:
    """Chi², its expectation and p-value among replicates."""
    here, chi2 = float(np.sum(residuals**2)), np.sum(rest**2, axis=1)
    return here, float(np.mean(chi2)), float((1 + np.sum(chi2 >= here)) / (1 + len(chi2)))


def _kinds(problem: FitProblem, objective: Residuals) -> dict[str, slice]:
    """Rows of each target's spectrum and dynamic stiffness, by what they are in words."""
    kinds = dict[str, slice]()
    for part, own, rows in zip(problem.parts, objective.parts, objective.rows, strict=True):
        of = f" of {part.name}" if len(problem.parts) > 1 else ""
        if bins := len(own.statistics.sd):
            kinds[f"the spectrum{of}"] = slice(rows.start, rows.start + bins)
        if part.points is not None:
            kinds[f"the dynamic stiffness{of}"] = slice(rows.stop - 2 * len(part.points), rows.stop)
    return kinds


def elsewhere(ended: Endpoint) -> float:
    """Which share of the posterior has the harmonic further than a bin from where the fit has it; 0
    without a free one.

    The lines of `adequacy`'s grid, all else refitted to first order, against the fitted one by its
    curvature. The covariance of the estimates is larger than the inverse curvature, since
    neighbouring bins correlate: costs count for less.
    """
    problem, found, refit, sizes = ended.problem, ended.found, ended.refit, ended.covariance
    if not refit.used:
        return 0.0
    (a, f), sd = refit.used, problem.coordinates.sd
    residual = np.concatenate([found.residuals, refit.prior])
    gain = np.linalg.pinv(found.jacobian.T @ found.jacobian + problem.precision, hermitian=True)
    dull = max(1.0, float(sizes[f, f] / gain[f, f]))
    cost = refit.cost(residual[None])[0]
    cost = (cost - cost[-1]) / dull
    apart = np.abs(refit.frequency - refit.frequency[-1])
    weight = np.where(
        apart >= problem.parts[0].target.settings.resolution,
        np.exp(-0.5 * np.clip(cost, -700, 700)),
        0.0,
    )
    grid = refit.frequency[: len(refit.frequency) // len(STRENGTHS)]
    cell = np.gradient(grid) / grid / sd[f] * 0.5 * np.log(STRENGTHS[1] / STRENGTHS[0]) / sd[a]
    there = float(np.sum(weight[:-1].reshape(-1, len(grid)) * cell))
    here = 2 * np.pi * np.sqrt(max(np.linalg.det(sizes[np.ix_([a, f], [a, f])]), 1e-300))
    return there / (there + here)


def generator_of(problem: FitProblem, number: int) -> np.random.Generator:
    """Random numbers of one purpose, by the key of the fit."""
    return np.random.default_rng(np.asarray(jax.random.key_data(fold_in(problem.key, number))))


def drawn_log_residuals(
    part: PartResiduals, generator: np.random.Generator, count: int
) -> Float[np.ndarray, "rows bins"]:
    """Log residuals of spectra that scatter about their expectation by the law of the bins:
    correlated gamma variables."""
    law = part.statistics
    normal = generator.multivariate_normal(
        np.zeros(len(law.sd)), law.correlation, size=count, method="cholesky"
    )
    z = normal * law.sd
    if np.all(np.isfinite(law.half)):
        z = np.log(gammaincinv(law.half, ndtr(normal)) / law.half) - law.bias
    return (z - z.mean(axis=1, keepdims=True)) / law.sd


def _drawn(objective: Residuals, scatter: np.ndarray, generator: np.random.Generator) -> Rows:
    """Data residuals of every part at the truth."""
    drawn = generator.multivariate_normal(
        np.zeros(len(scatter)), scatter, size=REPLICATES, method="eigh"
    )
    for part, rows in zip(objective.parts, objective.rows, strict=True):
        bins = len(part.statistics.sd)
        if objective.linear and bins:
            own = drawn_log_residuals(part, generator, REPLICATES)
            drawn[:, rows.start : rows.start + bins] = own
    return drawn


def _misfit(
    problem: FitProblem, objective: Residuals, residuals: np.ndarray, covariance: np.ndarray
) -> str:
    """In words, where the data lie furthest from the model: the run of neighbouring bins, or the
    point of a dynamic stiffness, that is the most of its standard errors off."""
    found = [(0.0, "")]
    for part, own, rows in zip(problem.parts, objective.parts, objective.rows, strict=True):
        whose = f"{part.name} has" if len(problem.parts) > 1 else "the data have"
        bins = slice(rows.start, rows.start + len(own.statistics.sd))
        if part.points is not None:
            each = residuals[rows.stop - 2 * len(part.points) : rows.stop].reshape(2, -1)
            off = np.sqrt(np.sum(each**2, axis=0))
            i = int(np.argmax(off))
            said = (
                f"{whose} another dynamic stiffness than the model at {part.points[i]:.2g} Hz"
                f" ({off[i]:.1f} standard errors)"
            )
            found.append((float(off[i]), said))
        if len(own.statistics.sd):
            size, said = _worst_run(part.target.frequency, residuals[bins], covariance[bins, bins])
            found.append((size, f"{whose} {said}"))
    return max(found, key=lambda each: each[0])[1]


def _worst_run(
    frequency: Float[np.ndarray, " bins"],
    residuals: Float[np.ndarray, " bins"],
    covariance: Float[np.ndarray, "bins bins"],
) -> tuple[float, str]:
    """The run of neighbouring bins whose residuals have the largest sum in its standard errors:
    this size, and the run in words.

    No bin in it is off by more than one standard deviation the other way.
    """
    bins = len(residuals)
    size = np.append(0.0, np.cumsum(residuals))
    spread = np.zeros((bins + 1, bins + 1))
    spread[1:, 1:] = np.cumsum(np.cumsum(covariance, axis=0), axis=1)
    corner = np.diag(spread)
    variance = corner[:, None] + corner[None] - 2 * spread
    first, last = np.triu_indices(bins + 1, 1)
    # A run that the fit has taken up has hardly any variance of its own.
    ratio = (size[last] - size[first]) / np.sqrt(
        np.maximum(variance[first, last], 0.1 * (last - first))
    )
    # Where a bin is clearly off the other way, the figure shows no such run.
    mixed = [
        np.min(np.sign(x) * residuals[a:b]) < -1.0
        for x, a, b in zip(ratio, first, last, strict=True)
    ]
    ratio[mixed] = 0.0
    i = int(np.argmax(np.abs(ratio)))
    run = slice(first[i], last[i])
    low, high = frequency[run][[0, -1]]
    low, high = f"{low:.2g}", f"{high:.2g}"
    place = f"at {low} Hz" if low == high else f"from {low} to {high} Hz"
    said = (
        f"{'more' if ratio[i] > 0 else 'less'} power than the model {place} ({abs(ratio[i]):.1f}"
        " standard errors)"
    )
    # What else the eye finds in the figure.
    apart = residuals.copy()
    apart[run] = 0.0
    k = int(np.argmax(np.abs(apart)))
    if abs(apart[k]) > ALONE:
        said += f", and {'more' if apart[k] > 0 else 'less'} at {frequency[k]:.2g} Hz"
    return float(abs(ratio[i])), said
