"""The autocovariance of a task's sampled output under noise, in linear response and closed form."""

import functools
from typing import NamedTuple

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

from ._linearised import Linearisation

SHORT = 4
KINK = 10  # values of r from lag 0 on that say what its kink does to a sum


def _sylvester(A: Array, F: Array, Q: Array) -> Array:
    """X with `A X + X Fᵀ + Q = 0`."""
    if not Q.size:
        return Q
    n, m = A.shape[0], F.shape[0]
    both = jnp.kron(A, jnp.eye(m, dtype=A.dtype)) + jnp.kron(jnp.eye(n, dtype=A.dtype), F)
    return jnp.linalg.solve(both, -Q.reshape(n * m)).reshape(Q.shape)


class Covariances(NamedTuple):
    """A linear system without input whose outputs sum to the autocovariance, `r(s) = Σ row
    exp(matrix s) start`."""

    matrix: Float[Array, "all all"]
    rows: Float[Array, "channels all"]
    start: Float[Array, "channels all"]


class _Chain:
    """Linear systems one behind the other, `x' = M x + Γ w`, and the stationary covariance P of
    their states, built up."""

    def __init__(self, F: Array, G: Array):
        self.matrix, self.white, self.covariance = F, G, _sylvester(F, F, G @ G.T)

    def add(self, A: Array, inflow: Array, white: Array) -> int:
        """Another system `y' = A y + inflow x + white w`; where its states begin. Its covariances
        follow one by one."""
        before, n = len(self.matrix), len(A)
        cross = _sylvester(A, self.matrix, inflow @ self.covariance + white @ self.white.T)
        fed = inflow @ cross.T
        inner = _sylvester(A, A, fed + fed.T + white @ white.T)
        self.matrix = jnp.block([[self.matrix, jnp.zeros((before, n), A.dtype)], [inflow, A]])
        self.covariance = jnp.block([[self.covariance, cross.T], [cross, inner]])
        self.white = jnp.concatenate([self.white, white])
        return before

    def filled(self, row: Array) -> Array:
        """A row that reads the first states, with zeros for those that came later."""
        return jnp.pad(row, (0, len(self.matrix) - len(row)))


def covariances(task: AbstractTask, system: Linearisation) -> list[list[Covariances]]:
    """The stationary response to the noise: of each of its components a sum of independent parts.

    The response `C (s - A)⁻¹ b + d + s e` to a scalar noise that acts on several inputs with b, d,
    e each: its states are those of the transposed system, `p' = Aᵀ p + Cᵀ N`, of which every input
    reads `b p + d N + e N'`. So all inputs that get a noise of the same colour have one small
    system, whatever their number.
    """
    found, system = [], _balanced(system)
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


def _balanced(system: Linearisation) -> Linearisation:
    """The system in units of its states in which rows and columns of A are of one size: single
    precision needs it."""
    A = jax.lax.stop_gradient(jnp.abs(system.A)) * (
        1 - jnp.eye(len(system.A), dtype=system.A.dtype)
    )
    scale = jnp.ones(len(A), A.dtype)
    for _ in range(2):
        for i in range(len(A)):
            row, column = jnp.sum(A[i] * scale) / scale[i], jnp.sum(A[:, i] / scale) * scale[i]
            fits = (row > 0) & (column > 0)
            ratio = jnp.where(fits, row, 1.0) / jnp.where(fits, column, 1.0)
            scale = scale.at[i].multiply(jnp.sqrt(ratio))
    size = jax.lax.stop_gradient(jnp.linalg.norm(system.C * scale))
    size = jnp.where(size > 0, size, 1.0)
    A = system.A * scale / scale[:, None]
    return system._replace(A=A, B=size * system.B / scale[:, None], C=system.C * scale / size)


def _of_groups(
    task: AbstractTask,
    system: Linearisation,
    noise: AbstractNoise,
    groups: list[tuple[bool, list[int]]],
) -> Covariances:
    """The response to one component of the noise through some of its inputs, in groups: through the
    activation or not."""
    scale = task.noise_scale(noise)
    b, d, e = (x[..., np.array(noise.acts_on)] * scale for x in (system.B, system.D, system.E))
    made: ShapingFilter = jax.tree.map(lambda x: x.astype(b.dtype), noise.shaping_filter())
    chain, rows = _Chain(made.F, made.G), []
    for active, group in groups:
        # What the group gets: a row of the states and one of the white noise.
        value, white = chain.filled(made.H), made.L
        if active and task.activation is not None:
            own, into = (x.astype(b.dtype) for x in task.activation.states())
            first = chain.add(own, jnp.outer(into, value), jnp.outer(into, white))
            value, white = jnp.eye(len(chain.matrix), dtype=b.dtype)[first], jnp.zeros_like(white)
        slope = value @ chain.matrix
        chain.add(system.A.T, jnp.outer(system.C, value), jnp.outer(system.C, white))
        rows += [jnp.concatenate([d[j] * value + e[j] * slope, b[:, j]]) for j in group]
    stacked = jnp.stack([chain.filled(row) for row in rows])
    stacked = jnp.sum(stacked, axis=0, keepdims=True) if noise.shared else stacked
    return Covariances(chain.matrix, stacked, stacked @ chain.covariance)


class Autocovariance(NamedTuple):
    """r of the sampled output: its first q values, and `r(lΔ) = Σ row powers[0]^(l-q) next` beyond.

    powers[k] = powers[0]^(2^k).
    """

    head: Float[Array, " q"]
    rows: Float[Array, "channels all"]
    powers: Float[Array, "doublings all all"]
    next: Float[Array, "channels all"]

    def lagged(self, lags: int) -> Float[Array, " lags"]:
        """r at lags 0, Δ, 2Δ ...: from few steps to the right and few long ones to the left, which
        meet in one product."""
        short, (channels, n) = (lags.bit_length() + 1) // 2, self.next.shape
        columns, rows = self.next.T[:, None], self.rows[None]
        for power in self.powers[:short]:
            later = (power @ columns.reshape(n, -1)).reshape(columns.shape)
            columns = jnp.concatenate([columns, later], axis=1)
        for power in self.powers[short:]:
            if rows.shape[0] * columns.shape[1] >= lags - 1:
                break
            rows = jnp.concatenate([rows, (rows.reshape(-1, n) @ power).reshape(rows.shape)])
        later = rows.reshape(-1, channels * n) @ columns.transpose(2, 0, 1).reshape(
            channels * n, -1
        )
        return jnp.concatenate([self.head, later.reshape(-1)])[:lags]

    def mean_variance(self, samples: Int[Array | np.ndarray, ""] | int) -> Float[Array, ""]:
        """Variance of the mean of that many successive samples, `Σ_l 2 (n - l) / n² r(lΔ) + r(0) /
        n`, l = 1 ... n - 1.

        Sums of `Φ^m v` and of `m Φ^m v` double their length from power to power; a block counts if
        its bit of n - q is set.
        """
        q, n, zero = (
            len(self.head),
            jnp.asarray(samples, self.next.dtype),
            jnp.zeros_like(self.next),
        )
        count = jnp.maximum(jnp.asarray(samples) - q, 0)

        def double(sums: Array, block: tuple[Array, Array]) -> tuple[Array, None]:
            power, bit = block
            sum_all, rise_all, sum_here, rise_here = sums
            length = (2**bit).astype(n.dtype)
            moved = jnp.stack(
                [rise_all + length * sum_all, sum_all, rise_here + length * sum_here, sum_here]
            )
            moved = product(moved, power.T)
            counts = (count >> bit) % 2 == 1  # this block, then what is there already
            both = jnp.stack([sum_here + moved[1], rise_here + moved[0]])
            return (
                jnp.concatenate([jnp.where(counts, both, sums[:2]), sums[2:] + moved[:1:-1]]),
                None,
            )

        bits = jnp.arange(len(self.powers), dtype=count.dtype)
        sums, _ = jax.lax.scan(
            double, jnp.stack([zero, zero, self.next, zero]), (self.powers, bits)
        )
        lag = jnp.arange(q, dtype=n.dtype)
        first = jnp.where(lag > 0, 2.0, 1.0) * jnp.maximum(n - lag, 0.0) @ self.head
        return (first + 2 * jnp.sum(self.rows * ((n - q) * sums[0] - sums[1]))) / n**2


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
    short, long = powers[0].T, powers[SHORT]
    _, columns = jax.lax.scan(lambda x, _: (x @ short, x), start, length=2**SHORT)
    blocks = jnp.tensordot(spread[::-1], columns, 1)
    both = rows, jnp.zeros_like(start)
    (_, carried), rows = jax.lax.scan(
        lambda x, block: ((x[0] @ long, x[1] @ long.T + block), x[0]), both, blocks
    )
    r = jnp.einsum("acn,bcn->ab", rows, columns).reshape(-1)
    more = steps**2 * (coarser[0] + steps**2 * coarser[1])
    return head @ r + more @ r[:KINK], carried


def _autocovariance(
    system: Covariances, interval: float, lags: int, sampling: str, recorded: Scalar
) -> Autocovariance:
    """Autocovariance of the sampled output, good for that many lags; not finite where it does not
    decay. `recorded`: the interval of the recording [s] of which it is sampled, if "filtered"."""
    (matrix, rows, start), finer = system, FINER if sampling == "filtered" else 1
    if sampling == "average":
        # Means over the interval: r(0) = 2/Δ² c ∫(Δ-s) e^(Ms) ds v and r(lΔ) = c J Φ^(l-1) J v /
        # Δ², J = ∫ e^(Ms) ds.
        n = len(matrix)
        zero, eye = jnp.zeros_like(matrix), jnp.eye(n, dtype=matrix.dtype)
        blocks = jnp.block([[matrix * interval, eye, zero], [zero, zero, eye], [zero, zero, zero]])
        whole = exponential(blocks)
        step, mean, ramp = whole[:n, :n], whole[:n, n : 2 * n], whole[:n, 2 * n :]
        first, rows, following = 2 * jnp.sum(rows @ ramp * start)[None], rows @ mean, start @ mean.T
    else:
        step = exponential(matrix * (interval / finer))
        first, following = jnp.sum(rows * start)[None], start @ step.T
    count = (lags - 1).bit_length() + finer.bit_length()
    _, powers = jax.lax.scan(lambda power, _: (product(power, power), power), step, length=count)
    if sampling == "filtered":
        first, following = _decimated(
            powers, rows, start, jnp.asarray(recorded, step.dtype) * finer / interval
        )
        powers = powers[finer.bit_length() - 1 :]
    # The last power carries an unstable system beyond any bound: no stationary covariance, so none
    # is returned.
    stable = jnp.max(jnp.abs(powers[-1])) < 1e3
    return Autocovariance(
        jnp.where(stable, first, jnp.nan), rows, powers, jnp.where(stable, following, jnp.nan)
    )


def autocovariances(
    task: AbstractTask,
    system: Linearisation,
    settings: SpectrumSettings,
    lags: int,
    recorded: Scalar = 0.0,
) -> tuple[Autocovariance, list[int]]:
    """Of every independent part of the noise, along a leading axis; which component of the noise
    each belongs to.

    All are filled up to one size, so that whatever follows is traced and compiled once, however
    many there are.
    """
    parts = [(own, i) for i, each in enumerate(covariances(task, system)) for own in each]
    size = max(len(own.matrix) for own, _ in parts)
    count = max(len(own.rows) for own, _ in parts)

    def filled(own: Covariances) -> Covariances:
        more, less = size - len(own.matrix), count - len(own.rows)
        # states that nothing drives or reads
        decaying = -settings.rate * jnp.eye(more, dtype=own.matrix.dtype)
        rows, start = (jnp.pad(x, ((0, less), (0, more))) for x in (own.rows, own.start))
        return Covariances(jax.scipy.linalg.block_diag(own.matrix, decaying), rows, start)

    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(filled(own) for own, _ in parts))
    made = functools.partial(_autocovariance, sampling=settings.sampling, recorded=recorded)
    found = jax.vmap(lambda own: made(own, 1 / settings.rate, lags))(stacked)
    return found, [i for _, i in parts]
