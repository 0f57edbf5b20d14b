"""One model against one data set or many: highest maximum, effective parameters, and how well it
foretells bins left out."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxmuscle._common.programs import kept
from jaxmuscle.data._target import Target
from jaxmuscle.data._target_data import precision_of
from jaxmuscle.model._parameters import HARMONIC, RESONANCE
from jaxmuscle.objective._consequences import BATCH, expand
from jaxmuscle.objective._covariance import effective_parameters
from jaxmuscle.objective._likelihood import Bins, Likelihood, without_offsets
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._scoring import Maximum, maximise
from jaxmuscle.objective._starts import continued, points_about, starting_points
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._bin_law import target_law

SPREAD, RANDOM, PLAIN = 24, 8, 16  # starting points: over the prior, drawn, of a smooth model
BLOCK, BLOCKS, ENOUGH = 12, 20, 1e-3  # steps at once, how often; a gain in ln L that is too small
SAME, KEPT = 1e-3, 16  # heights that are one maximum; starts that are followed on


Sets = Float[np.ndarray, " sets"]
SetsFree = Float[np.ndarray, "sets free"]
SetsBins = Float[np.ndarray, "sets bins"]
Settled = Bool[np.ndarray, " sets"]


class Maxima(NamedTuple):
    """The highest maximum of every data set.

    `log_likelihood` has the offset integrated out; `parameters` is the effective number; `line` the
    harmonic's share of the power of each bin.
    """

    theta: SetsFree
    log_likelihood: Sets
    parameters: Sets
    proportional: SetsBins
    line: SetsBins
    settled: Settled


class HeldOut(NamedTuple):
    """Log density of every bin given the others that were kept, by a fit to those."""

    scores: SetsBins
    settled: Settled


class Candidate(NamedTuple):
    """A likelihood of one target with the precision Λ of its prior, and where to begin."""

    likelihood: Likelihood
    precision: Float[np.ndarray, "free free"]
    starts: Float[np.ndarray, "starts free"]

    @classmethod
    def of(
        cls, problem: FitProblem, *, harmonic: bool, known: Mapping[str, float] | None = None
    ) -> "Candidate":
        """Of a fit, or of the same without harmonic: amplitude zero, whatever the coordinates of
        amplitude and frequency.

        With `known` values, where a poorer model ended, there are as many starts again that begin
        from there: with a free resonance the highest maximum is hard to find from the prior's
        centre.

        The data then say nothing about these two, so that they stay at their prior's centre and
        count as no parameters; the compiled programs are those of the model with harmonic.
        """
        rng = np.random.default_rng(np.asarray(jax.random.key_data(problem.key)).tolist())
        names = problem.coordinates.names
        scattered = 0.5 * rng.standard_normal((RANDOM, len(names)))
        problem = problem if harmonic else without_harmonic(problem)
        # a frequency has a maximum at almost every peak
        wide = harmonic or bool(set(RESONANCE) & set(names))
        spread = problem.coordinates.theta(
            starting_points(problem, SPREAD if wide else PLAIN - RANDOM)
        )
        about = points_about(problem, np.zeros(len(names))) if harmonic else spread[:0]
        on = (
            spread[:0]
            if known is None
            else problem.coordinates.theta(continued(problem, SPREAD + RANDOM, known))
        )
        starts = np.concatenate([about, spread, scattered, on])
        if not harmonic:
            starts[:, [n in HARMONIC for n in names]] = 0.0
        return cls(Likelihood.of(problem), problem.precision, starts)


def without_harmonic(problem: FitProblem) -> FitProblem:
    """The fit with a harmonic of amplitude zero."""
    (part,), c = problem.parts, problem.coordinates
    if "harmonic_amplitude" not in c.names:
        task = part.task.replace(harmonic_amplitude=0.0)
        return dataclasses.replace(problem, parts=(dataclasses.replace(part, task=task),))
    centre = np.where(np.array(c.names) == "harmonic_amplitude", 0.0, c.centre)
    still = eqx.tree_at(lambda c: c.centre, c, centre)
    return dataclasses.replace(
        problem, coordinates=still, parts=(dataclasses.replace(part, coordinates=still),)
    )


def maxima(
    model: Candidate,
    starts: Float[np.ndarray, "sets starts free"],
    bins: Bins | None,
    moving: SetsFree,
) -> Maxima:
    """A block of steps from every start, then on from those that stand at different heights to the
    highest maximum."""
    sets, count, free = starts.shape
    owner = np.repeat(np.arange(sets), count)
    peak = _climb(model, starts.reshape(-1, free), bins, moving, owner)
    on = np.concatenate(
        [s * count + _different(cost) for s, cost in enumerate(peak.cost.reshape(sets, count))]
    )
    peak, settled = _highest(model, peak.theta[on], bins, moving, owner[on])
    (moments,) = expand(model.likelihood.objective, peak.theta).moments
    return Maxima(
        peak.theta,
        marginals(model.likelihood, moments, bins),
        effective_numbers(peak.curvature, model.precision, moving),
        moments.power / moments.power.sum(axis=1, keepdims=True),
        moments.line / moments.power,
        settled,
    )


def _different(cost: Float[np.ndarray, " starts"]) -> Int[np.ndarray, " kept"]:
    """The lowest starts, one of those that stand at the same height."""
    order = np.argsort(np.where(np.isfinite(cost), cost, np.inf), kind="stable")
    kept = order[np.insert(np.diff(cost[order]) > SAME, 0, True)]
    return kept[:KEPT]


def _highest(
    model: Candidate,
    theta: Float[np.ndarray, "rows free"],
    bins: Bins | None,
    moving: np.ndarray,
    owner: Int[np.ndarray, " rows"],
) -> tuple[Maximum, Settled]:
    """The best row of every data set, once a block of steps improves it by less than `ENOUGH`;
    whether it came to that."""
    sets, theta = len(moving), theta.copy()
    best: list[Any] = [None] * sets
    cost, settled = np.full(sets, np.inf), np.zeros(sets, dtype=bool)
    for _ in range(BLOCKS):
        rows = np.flatnonzero(~settled[owner])
        if not rows.size:
            break
        peak = _climb(model, theta[rows], bins, moving, owner[rows])
        theta[rows] = peak.theta
        reached = np.where(np.isfinite(peak.cost), peak.cost, np.inf)
        for s in np.unique(owner[rows]):
            own = np.flatnonzero(owner[rows] == s)
            i = int(own[np.argmin(reached[own])])
            settled[s] = peak.settled[i] or (np.isfinite(cost[s]) and cost[s] - reached[i] < ENOUGH)
            best[s], cost[s] = peak.row(i), reached[i]
    return Maximum(*(np.concatenate(x) for x in zip(*best, strict=True))), settled


def _climb(
    model: Candidate, theta: np.ndarray, bins: Bins | None, moving: np.ndarray, owner: np.ndarray
) -> Maximum:
    own = None if bins is None else (jax.tree.map(lambda x: np.asarray(x)[owner], bins),)
    return maximise(
        model.likelihood, theta, model.precision, bins=own, moving=moving[owner], max_steps=BLOCK
    )


def effective_numbers(
    curvature: Float[np.ndarray, "sets all all"],
    precision: Float[np.ndarray, "free free"],
    moving: SetsFree,
) -> Sets:
    """Effective numbers of parameters over the moving coordinates; `curvature` is that of θ and the
    offset, Λ included."""
    found = []
    for whole, moves in zip(curvature, moving > 0, strict=True):
        both = without_offsets(whole, len(precision))[np.ix_(moves, moves)]
        own = precision[np.ix_(moves, moves)]
        found.append(effective_parameters(both - own, own))
    return np.array(found)


@kept
def _marginals(likelihood: Likelihood, moments: Moments, bins: Bins | None) -> Any:
    return jax.vmap(lambda m, b: likelihood.marginal((m,), None if b is None else (b,)))(
        moments, bins
    )


def marginals(
    likelihood: Likelihood, moments: Moments, bins: Bins | None
) -> Float[np.ndarray, " rows"]:
    """Log likelihood of every row, the offset integrated out; in batches of one size, so that one
    program serves."""
    rows = len(moments.mean)
    found = []
    for start in range(0, rows, BATCH):
        part = np.minimum(np.arange(start, start + BATCH), rows - 1)
        given = jax.tree.map(lambda x, part=part: np.asarray(x)[part], (moments, bins))
        found.append(np.asarray(_marginals(likelihood, *given)))
    return np.concatenate(found)[:rows]


class Folds(NamedTuple):
    """Data sets with bins left out: `kept` without group g, `more` without it but for bin k;
    `group` of every bin."""

    kept: Bins
    more: Bins
    group: Int[np.ndarray, " bins"]

    @classmethod
    def of(cls, targets: list[Target], groups: int) -> "Folds":
        """Every `groups`-th bin of each target is left out together; leading axes (targets, groups)
        and (targets, bins)."""
        group = np.arange(len(targets[0].bins)) % groups
        masks = (group != np.arange(groups)[:, None]).astype(float)
        masks = np.concatenate([masks, masks[group] + np.eye(len(group))])
        both = stack_bins([masked_bins(target, masks) for target in targets])
        kept, more = (
            Bins(*(x[:, part] for x in both)) for part in (slice(groups), slice(groups, None))
        )
        return cls(kept, more, group)


def masked_bins(target: Target, masks: Float[np.ndarray, "rows bins"]) -> Bins:
    """The target's bins once for every mask, 0 for what is left out."""
    if target.segments is None:
        raise ValueError(
            f"{target.name}: states no segments, so the law of its bins is unknown; give segments"
        )
    law = target_law(target)
    power, half = np.log(target.proportional_power), law.degrees / 2
    return stack_bins(
        [Bins(power, half, *precision_of(law.correlation, mask), mask) for mask in masks]
    )


def stack_bins(bins: list[Bins]) -> Bins:
    """Data sets along a new leading axis."""
    return jax.tree.map(lambda *x: np.stack(x), *bins)


def held_out(
    model: Candidate,
    theta: SetsFree,
    folds: Folds,
    moving: SetsFree,
) -> HeldOut:
    """`ln f(p_k | bins kept; θ of the fold) = ln f(p_k and bins kept) - ln f(bins kept)`, refitted
    from `theta`."""
    sets, groups = np.shape(folds.kept.logdet)
    owner = np.repeat(np.arange(sets), groups)
    kept, more = (
        jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), b) for b in (folds.kept, folds.more)
    )
    peak, settled = _highest(model, theta[owner], kept, moving[owner], np.arange(sets * groups))
    (moments,) = expand(model.likelihood.objective, peak.theta).moments
    row = (np.arange(sets)[:, None] * groups + folds.group).ravel()
    above = marginals(model.likelihood, jax.tree.map(lambda x: x[row], moments), more)
    scores = above - marginals(model.likelihood, moments, kept)[row]
    return HeldOut(scores.reshape(sets, -1), np.asarray(settled.reshape(sets, groups).all(axis=1)))
