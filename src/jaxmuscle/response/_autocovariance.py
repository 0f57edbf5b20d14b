"""The autocovariance of a task's output in linear response, in closed form, as it is sampled."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxmuscle._common.matrices import exponential, product
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._activation import ACTIVE
from jaxmuscle.model._noise import AbstractNoise, ShapingFilter
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._decimation import FINER, REACH, anti_alias
from jaxmuscle.spectra._settings import SpectrumSettings

from ._linear_task import Linearisation, balanced

SHORT = 4  # doublings: blocks of sixteen, about the root of the points of the low-pass
KINK = 10  # values of r from lag 0 on that say what its kink does to a sum
# 1/s, of states that nothing drives or reads: they must decay, since the equation of the stationary
# covariance has no solution where two eigenvalues cancel
DECAY = 100.0


class Chain(NamedTuple):
    """Noise through linear systems, one behind the other: `x' = matrix x + white w`, w of density
    1; each channel reads, with its `row`, an x of its own."""

    matrix: Float[Array, "*parts all all"]
    white: Float[Array, "*parts all noises"]
    rows: Float[Array, "*parts channels all"]

    def add(self, A: Array, inflow: Array, white: Array) -> "Chain":
        """With another system behind, `y' = A y + inflow x + white w`."""
        before, n = len(self.matrix), len(A)
        matrix = jnp.block([[self.matrix, jnp.zeros((before, n), A.dtype)], [inflow, A]])
        rows = jnp.pad(self.rows, ((0, 0), (0, n)))
        return Chain(matrix, jnp.concatenate([self.white, white]), rows)

    def split(self, channels: int) -> "list[Chain]":
        """Parts of at most so many channels, which are independent of each other."""
        return [
            self._replace(rows=self.rows[i : i + channels])
            for i in range(0, len(self.rows), channels)
        ]

    def filled(self, size: int, noises: int, channels: int) -> "Chain":
        """The same in a larger shape: with states that nothing drives or reads, and zeros."""
        (channel, n), noise = self.rows.shape, self.white.shape[1]
        more = size - n
        idle = -DECAY * jnp.eye(more, dtype=self.matrix.dtype)
        return Chain(
            jax.scipy.linalg.block_diag(self.matrix, idle),
            jnp.pad(self.white, ((0, more), (0, noises - noise))),
            jnp.pad(self.rows, ((0, channels - channel), (0, more))),
        )


def chains(task: AbstractTask, system: Linearisation) -> list[list[Chain]]:
    """What the output gets of the noise: of each of its components a sum of independent parts. Of a
    `balanced` system.

    The response `C (s - A)⁻¹ b + d + s e` to a scalar noise that acts on several inputs with b, d,
    e each: its states are those of the transposed system, `p' = Aᵀ p + Cᵀ N`, of which every input
    reads `b p + d N + e N'`. So all inputs that get a noise of the same colour have one small
    system, whatever their number.
    """
    found = []
    for noise in task.noise.components:
        passes = [task.activation is not None and i in ACTIVE for i in noise.acts_on]
        groups = [
            (active, [j for j, own in enumerate(passes) if own == active])
            for active in (True, False)
        ]
        groups = [(active, group) for active, group in groups if group]
        apart = [groups] if noise.shared else [[group] for group in groups]
        found.append([_of_groups(task, system, noise, own) for own in apart])
    return found


def _of_groups(
    task: AbstractTask,
    system: Linearisation,
    noise: AbstractNoise,
    groups: list[tuple[bool, list[int]]],
) -> Chain:
    """The response to one component of the noise through some of its inputs, in groups: through the
    activation or not."""
    scale = task.noise_scale(noise)
    b, d, e = (x[..., np.array(noise.acts_on)] * scale for x in (system.B, system.D, system.E))
    made: ShapingFilter = jax.tree.map(lambda x: x.astype(b.dtype), noise.shaping_filter())
    chain = Chain(made.F, made.G, jnp.zeros((0, len(made.F)), b.dtype))
    for active, group in groups:
        # What the group gets: a row of the states and one of the white noise.
        value, white = jnp.pad(made.H, (0, len(chain.matrix) - len(made.H))), made.L
        if active and task.activation is not None:
            own, into = (x.astype(b.dtype) for x in task.activation.states())
            first = len(chain.matrix)
            chain = chain.add(own, jnp.outer(into, value), jnp.outer(into, white))
            value, white = jnp.eye(len(chain.matrix), dtype=b.dtype)[first], jnp.zeros_like(white)
        slope = value @ chain.matrix
        through = jnp.outer(d[jnp.array(group)], value) + jnp.outer(e[jnp.array(group)], slope)
        chain = chain.add(system.A.T, jnp.outer(system.C, value), jnp.outer(system.C, white))
        rows = jnp.concatenate([through, b[:, jnp.array(group)].T], axis=1)
        chain = chain._replace(rows=jnp.concatenate([chain.rows, rows]))
    return (
        chain._replace(rows=jnp.sum(chain.rows, axis=0, keepdims=True)) if noise.shared else chain
    )


def stationary(
    matrix: Float[Array, "*parts all all"], white: Float[Array, "*parts all noises"]
) -> Float[Array, "*parts all all"]:
    """P with `M P + P Mᵀ + Γ Γᵀ = 0`: the covariance of the states. Solved for its upper
    triangle."""
    n, eye = matrix.shape[-1], jnp.eye(matrix.shape[-1], dtype=matrix.dtype)
    i, j = np.triu_indices(n)
    upper, place = i * n + j, np.zeros((n, n), dtype=int)
    place[i, j] = place[j, i] = np.arange(len(i))
    both = (
        matrix[..., :, None, :, None] * eye[:, None, :]
        + eye[:, None, :, None] * matrix[..., None, :, None, :]
    )
    # P is symmetric: an entry and its mirror image are one unknown. So there are half as many, and
    # to solve for them takes about an eighth of the operations.
    both = both + jnp.swapaxes(both, -1, -2)
    both = both.reshape(*both.shape[:-4], n * n, n * n)[..., upper, :][..., upper]
    driven = (white @ jnp.swapaxes(white, -1, -2)).reshape(*matrix.shape[:-2], n * n)[..., upper]
    twice = jnp.asarray(np.where(i == j, 0.5, 1.0), matrix.dtype)
    return jnp.linalg.solve(both * twice, -driven[..., None])[..., 0][..., place]


class Covariances(NamedTuple):
    """A linear system without input whose outputs sum to the autocovariance, `r(s) = Σ row
    exp(matrix s) start`."""

    matrix: Float[Array, "*parts all all"]
    rows: Float[Array, "*parts channels all"]
    start: Float[Array, "*parts channels all"]

    @classmethod
    def of(cls, chain: Chain) -> "Covariances":
        """Where the chain has been driven for ever."""
        return cls(chain.matrix, chain.rows, chain.rows @ stationary(chain.matrix, chain.white))


def covariances(task: AbstractTask, system: Linearisation) -> list[list[Covariances]]:
    """The stationary response to the noise: of each of its components a sum of independent
    parts."""
    return [[Covariances.of(part) for part in own] for own in chains(task, balanced(system))]


def stacked(parts: list[Chain], size: int = 0, channels: int = 0) -> Chain:
    """Along a leading axis, filled up to one size (and at least to the given one), so that whatever
    follows is traced and compiled once, however many there are."""
    size = max(size, *(len(own.matrix) for own in parts))
    noises = max(own.white.shape[1] for own in parts)
    channels = max(channels, *(len(own.rows) for own in parts))
    return jax.tree.map(lambda *x: jnp.stack(x), *(p.filled(size, noises, channels) for p in parts))


class Autocovariance(NamedTuple):
    """r of the sampled output: its first q values, and `r(lΔ) = Σ row powers[0]^(l-q) next` beyond.

    powers[k] = powers[0]^(2^k). Of parts along an axis, in powers the second.
    """

    head: Float[Array, "parts q"]
    rows: Float[Array, "parts channels all"]
    powers: Float[Array, "doublings parts all all"]
    next: Float[Array, "parts all channels"]

    def lagged(self, lags: int) -> Float[Array, "parts lags"]:
        """r at lags 0, Δ, 2Δ ...: from few steps to the right and few long ones to the left, which
        meet in one product."""
        # 2^k steps on one side and 2^(n - k) on the other: fewest at k = n / 2.
        short = (lags.bit_length() + 1) // 2
        long = max((lags - 2).bit_length() - short, 0)
        columns = _further(self.powers[:short], self.next)
        rows = _before(self.powers[short : short + long], self.rows)
        return jnp.concatenate([self.head, _meeting(rows, columns)], axis=1)[:, :lags]

    def mean_variance(self, samples: Int[Array | np.ndarray, ""] | int) -> Float[Array, " parts"]:
        """Variance of the mean of that many successive samples, `Σ_l 2 (n - l) / n² r(lΔ) + r(0) /
        n`, l = 1 ... n - 1.

        Sums of `Φ^m v` and of `m Φ^m v` double their length from power to power; a block counts if
        its bit of n - q is set.
        """
        q, n, zero = (
            self.head.shape[1],
            jnp.asarray(samples, self.next.dtype),
            jnp.zeros_like(self.next),
        )
        count = jnp.maximum(jnp.asarray(samples) - q, 0)

        def double(sums: tuple[Array, ...], block: tuple[Array, Array]) -> tuple[Any, None]:
            power, bit = block
            sum_all, rise_all, sum_here, rise_here = sums
            length = (2**bit).astype(n.dtype)
            moved = jnp.split(power @ jnp.concatenate(sums, axis=2), 4, axis=2)
            counts = (count >> bit) % 2 == 1  # this block, then what is there already
            return (
                jnp.where(counts, sum_here + moved[0], sum_all),
                jnp.where(counts, rise_here + moved[1] + length * moved[0], rise_all),
                sum_here + moved[2],
                rise_here + moved[3] + length * moved[2],
            ), None

        bits = jnp.arange(len(self.powers), dtype=count.dtype)
        sums, _ = jax.lax.scan(double, (zero, zero, self.next, zero), (self.powers, bits))
        lag = jnp.arange(q, dtype=n.dtype)
        first = self.head @ (jnp.where(lag > 0, 2.0, 1.0) * jnp.maximum(n - lag, 0.0))
        rest = jnp.swapaxes((n - q) * sums[0] - sums[1], 1, 2)
        return (first + 2 * jnp.sum(self.rows * rest, axis=(1, 2))) / n**2


def _further(powers: Array, vectors: Float[Array, "parts all channels"]) -> Array:
    """Φ^m v, m = 0 ... 2^k - 1, along a last axis, by k powers Φ, Φ², Φ⁴ ..."""
    found = vectors[..., None]
    for power in powers:
        later = (power @ found.reshape(*found.shape[:2], -1)).reshape(found.shape)
        found = jnp.concatenate([found, later], axis=3)
    return found


def _before(powers: Array, rows: Float[Array, "parts channels all"]) -> Array:
    """c Φ^m along a second axis."""
    found = rows[:, None]
    for power in powers:
        later = (found.reshape(len(found), -1, found.shape[-1]) @ power).reshape(found.shape)
        found = jnp.concatenate([found, later], axis=1)
    return found


def _meeting(rows: Array, columns: Array) -> Float[Array, "parts lags"]:
    """`Σ c Φ^(a + b) v`, all a times all b."""
    parts, count, channels, n = rows.shape
    columns = jnp.swapaxes(columns, 1, 2).reshape(parts, channels * n, -1)
    return (rows.reshape(parts, count, channels * n) @ columns).reshape(parts, -1)


class _Folded(NamedTuple):
    """The autocorrelation ρ of the low-pass as a quadrature rule, see `_folded`."""

    head: Float[np.ndarray, "q points"]
    coarser: Float[np.ndarray, "2 q kink"]
    blocks: Float[np.ndarray, "blocks short"]


@functools.cache
def _folded() -> _Folded:
    """ρ folded for lags 0 ... q - 1, and as it is, in blocks of 2^SHORT: `r'(lΔ) = ∫ ρ(s) r(|lΔ -
    s|) ds`, a sum in steps of δ = Δ / FINER.

    From the lag q on, which ρ reaches, no lag is negative. Before it r has a kink, where a sum in
    steps of τδ exceeds the integral, for r(s) = exp(-x s / δ) by

        ρ(lΔ) D(τ) - δ² ρ''(lΔ) τ⁴ x / 120
        D(τ) = τ coth(τ x / 2) - 2 / x = τ² x / 6 - τ⁴ x³ / 360 ...

    (Euler and Maclaurin): the aliases. Derivatives at the kink are differences of r at 0, δ, 2δ
    ... What τ = 1 makes is taken off `head` (Gregory's rule, which is bounded however fast r
    decays); what a recording makes is put on, τ² times the first of `coarser` and τ⁴ times the
    second.
    """
    spread = scipy.signal.correlate(anti_alias(FINER), anti_alias(FINER))
    q, reach, n = 2 * REACH, len(spread) // 2, np.arange(KINK)
    at = reach + FINER * np.arange(q)
    low, bent = spread[at], (spread[at - 1] - 2 * spread[at] + spread[at + 1]) / 20
    # D in powers of x, as weights of exp(-x i), i = 0, 1, 2 ...
    terms = 2 * scipy.special.bernoulli(KINK)[1:] / scipy.special.factorial(n + 1)
    taylor = (-1.0 * n) ** n[:, None] / scipy.special.factorial(n)[:, None]
    first, third, every = np.linalg.solve(taylor, (terms * [n == 1, n == 3, n > 0]).T).T
    bent = np.outer(bent, first)
    coarser = np.stack([np.outer(low, first), np.outer(low, third) - bent])
    spread = np.pad(spread, (0, -len(spread) % 2**SHORT))
    head = np.zeros((q, len(spread)))
    for lag in range(q):
        np.add.at(head[lag], np.abs(lag * FINER + reach - np.arange(len(spread))), spread)
    head[:, :KINK] -= np.outer(low, every) - bent
    return _Folded(head, coarser, spread.reshape(-1, 2**SHORT))


def _decimated(
    powers: Array, rows: Array, start: Array, steps: Float[Array, ""]
) -> tuple[Array, Array]:
    """The first q values of what is low-passed against aliases, and its vector at the lag q; Φ
    carries to the next point. Of a signal known at every so many `steps` of them (0: at all times).

    `Σ_j ρ_j Φ^j start` and `rows Φ^j start` with j = 2^SHORT a + b: few short steps, then few long
    ones.
    """
    head, coarser, spread = (jnp.asarray(x, start.dtype) for x in _folded())
    blocks, long = len(spread), (len(spread) - 1).bit_length()
    columns = _further(powers[:SHORT], start)
    r = _meeting(_before(powers[SHORT : SHORT + long], rows)[:, :blocks], columns)
    more = steps**2 * (coarser[0] + steps**2 * coarser[1])
    later = columns @ jnp.pad(spread, ((0, 2**long - blocks), (0, 0))).T
    for power in powers[SHORT : SHORT + long]:  # Σ_a Φ^(16 a) of the blocks: of two one
        odd = later[..., 1::2]
        later = later[..., ::2] + (power @ odd.reshape(*odd.shape[:2], -1)).reshape(odd.shape)
    return r @ head.T + r[:, :KINK] @ more.T, later[..., 0]


def sampled_autocovariance(
    chain: Chain, interval: Scalar, lags: int, sampling: str, recorded: Scalar
) -> Autocovariance:
    """Autocovariance of the sampled output of parts along a leading axis, good for that many lags;
    not finite where it does not decay. `recorded`: the interval of the recording [s] of which it is
    sampled, if "filtered"."""
    (matrix, rows, start), finer = Covariances.of(chain), FINER if sampling == "filtered" else 1
    columns = jnp.swapaxes(start, 1, 2)
    if sampling == "average":
        # Means over the interval: r(0) = 2/Δ² c ∫(Δ-s) e^(Ms) ds v and r(lΔ) = c J Φ^(l-1) J v /
        # Δ², J = ∫ e^(Ms) ds.
        n = matrix.shape[-1]
        zero, eye = jnp.zeros_like(matrix), jnp.zeros_like(matrix) + jnp.eye(n, dtype=matrix.dtype)
        whole = exponential(
            jnp.block([[matrix * interval, eye, zero], [zero, zero, eye], [zero, zero, zero]])
        )
        step, mean, ramp = (whole[:, :n, k * n : (k + 1) * n] for k in range(3))
        first = 2 * jnp.sum(rows @ ramp * start, axis=(1, 2))[:, None]
        rows, following = rows @ mean, mean @ columns
    else:
        step = exponential(matrix * (interval / finer))
        first, following = jnp.sum(rows * start, axis=(1, 2))[:, None], step @ columns
    count = (lags - 1).bit_length() + finer.bit_length()
    _, powers = jax.lax.scan(lambda power, _: (product(power, power), power), step, length=count)
    if sampling == "filtered":
        steps = jnp.asarray(recorded, step.dtype) * finer / interval
        first, following = _decimated(powers, rows, columns, steps)
        powers = powers[finer.bit_length() - 1 :]
    # The last power carries an unstable system beyond any bound: no stationary covariance, so none
    # is returned.
    stable = jnp.max(jnp.abs(powers[-1]), axis=(1, 2)) < 1e3
    return Autocovariance(
        jnp.where(stable[:, None], first, jnp.nan),
        rows,
        powers,
        jnp.where(stable[:, None, None], following, jnp.nan),
    )


def autocovariances(
    task: AbstractTask,
    system: Linearisation,
    settings: SpectrumSettings,
    lags: int,
    recorded: Scalar = 0.0,
) -> tuple[Autocovariance, list[int]]:
    """Of every independent part of the noise, along a leading axis; which component of the noise
    each belongs to."""
    parts = [(own, i) for i, each in enumerate(chains(task, balanced(system))) for own in each]
    found = sampled_autocovariance(
        stacked([own for own, _ in parts]), 1 / settings.rate, lags, settings.sampling, recorded
    )
    return found, [i for _, i in parts]
