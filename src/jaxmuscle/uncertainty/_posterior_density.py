"""The posterior density with the harmonic's frequency, where it has many modes, summed over a grid."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxmuscle._common.types import Scalar
from jaxmuscle.model._parameters import CHANNELS
from jaxmuscle.model._signals import Constant
from jaxmuscle.objective._coordinates import at
from jaxmuscle.objective._likelihood import Likelihood
from jaxmuscle.objective._problem import Setup
from jaxmuscle.objective._scoring import Peak, highest
from jaxmuscle.response._expected import Moments, noise_response, noise_variance
from jaxmuscle.response._harmonic_line import LineTable, harmonic_size, line_table
from jaxmuscle.response._linearised import Linearisation, linearise
from jaxmuscle.spectra._bin_law import trial_samples
from jaxmuscle.spectra._settings import WINDOW

PER_BIN = 3
BEYOND = 2.0  # bins
HIGHEST = 0.49  # of the sampling rate
MODES, FADED = 4, 8.0
# Standard deviations about a maximum, out to where a wide cell holds next to nothing.
AROUND = np.array([-5.5, -4.0, -3.0, -2.25, -1.5, -0.75, 0.0, 0.75, 1.5, 2.25, 3.0, 4.0, 5.5])
FILLED = 16


class Features(NamedTuple):
    """What the spectra at all frequencies of the harmonic follow from: the noise, and the line's response to any frequency.

    `numerator` and `denominator` are coefficients of powers of s, highest first: a harmonic of real and imaginary part
    `size` has the line `size numerator(s) / denominator(s)`, s = iω.
    """

    power: Float[Array, " bins"]
    mean: Scalar
    variance: Scalar
    size: Float[Array, "2"]
    numerator: Float[Array, " above"]
    denominator: Float[Array, " below"]

    def moments(self, frequency: Float[Array, " grid"], table: LineTable) -> Moments:
        """Moments with the harmonic at each frequency; a leading axis of frequencies."""
        s = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency)
        reply = jax.lax.complex(*self.size) * _polynomial(self.numerator, s) / _polynomial(self.denominator, s)
        line = table.power(reply)
        return Moments(self.power + line, line, jnp.broadcast_to(self.mean, frequency.shape),
                       self.variance + table.variance(reply))  # fmt: skip


def _polynomial(coefficients: Float[Array, " powers"], s: Complex[Array, " grid"]) -> Complex[Array, " grid"]:
    value = jnp.zeros_like(s)
    for c in coefficients:
        value = value * s + c.astype(s.dtype)
    return value


def _rational(A: Array, b: Array, c: Array, d: Array, e: Array) -> tuple[Array, Array]:
    """`c (s - A)⁻¹ b + d + s e` as numerator and denominator, by Faddeev and LeVerrier."""
    n, eye = len(A), jnp.eye(len(A), dtype=A.dtype)
    adjoint, below, above = eye, [jnp.ones((), A.dtype)], []
    for k in range(1, n + 1):
        above.append(c @ adjoint @ b)
        forward = A @ adjoint
        below.append(-jnp.trace(forward) / k)
        adjoint = forward + below[-1] * eye
    denominator = jnp.stack(below)
    inside = jnp.concatenate([jnp.zeros(2, A.dtype), jnp.stack(above)])
    through = jnp.concatenate([jnp.zeros(1, A.dtype), d * denominator])
    return inside + through + jnp.concatenate([e * denominator, jnp.zeros(1, A.dtype)]), denominator


class Level(NamedTuple):
    """The common scale of the amplitudes, as the coordinate of one of them, counted from a fixed coefficient of variation.

    Only the coefficient of variation shows that scale, and narrowly: in the amplitudes themselves the posterior is a thin
    curved sheet that chains hardly follow; counted from there the scale is all but a normal variable of its own. `column`
    is the coordinate of one amplitude, `start` its value at the maximum, `sd` its prior standard deviation,
    `log_variation` that at the maximum, `along` what a common factor does to all coordinates, `weight` of the harmonic's
    frequencies.
    """

    column: int
    start: Float[Array | np.ndarray, ""]
    sd: Float[Array | np.ndarray, ""]
    log_variation: Float[Array | np.ndarray, ""]
    along: Float[Array | np.ndarray, " free"]
    weight: Float[Array | np.ndarray, " grid"]


class Marginal(eqx.Module):
    """Log posterior density of the unbounded coordinates s (without the harmonic's frequency) and the offset.

        ln p(s, u) = ln Σ_j w_j L(θ(s), f_j, u) - ½ Σ θ² + ln |dθ/ds|

    over the grid f_j of the harmonic's frequency, w_j its prior density times the width of the cell. Without a free
    frequency there is one f_j. `columns` are the sampled coordinates among the free ones, `centre` and `scale` whiten them,
    one of them being counted from a `level` (the Jacobian of which is constant).
    """

    likelihood: Likelihood
    frequency: Float[Array | np.ndarray, " grid"]
    log_weight: Float[Array | np.ndarray, " grid"]
    table: LineTable | None
    point: Float[Array | np.ndarray, " free"]
    centre: Float[Array | np.ndarray, " sampled"]
    scale: Float[Array | np.ndarray, "sampled sampled"]
    columns: tuple[int, ...] = eqx.field(static=True)
    offset: bool = eqx.field(static=True)
    level: Level | None = None

    @property
    def size(self) -> int:
        """How many numbers are sampled."""
        return len(self.columns) + self.offset

    def split(self, white: Float[Array, " sampled"]) -> tuple[Float[Array, " free"], Scalar]:
        """Unbounded coordinates (with the point's own where not sampled) and the offset of whitened ones."""
        return self.placed(self.centre + self.scale @ white)[:2]

    def placed(
        self, both: Float[Array | np.ndarray, " sampled"]
    ) -> tuple[Float[Array, " free"], Scalar, Linearisation | None]:
        """The same of sampled coordinates, with the linearised task if that was needed."""
        s = jnp.asarray(self.point).at[jnp.asarray(self.columns)].set(both[: len(self.columns)])
        s, system = self.levelled(s)
        return s, both[-1] if self.offset else jnp.zeros(()), system

    def levelled(self, s: Float[Array, " free"]) -> tuple[Float[Array, " free"], Linearisation | None]:
        """Coordinates s of which one is counted from the level, as they are."""
        level = self.level
        if level is None:
            return s, None
        s, above = s.at[level.column].set(level.start), level.sd * (s[level.column] - level.start)
        found, system = self.log_variation(s, level.weight)
        return s + (level.log_variation + above - found) * level.along, system

    def log_variation(
        self, s: Float[Array, " free"], weight: Float[Array | np.ndarray, " grid"]
    ) -> tuple[Scalar, Linearisation]:
        """Log coefficient of variation of a long recording, the harmonic's frequencies weighted; the linearised task."""
        problem = self.likelihood.problem
        task = at(problem.task, problem.coordinates, problem.coordinates.theta(s))
        system = linearise(task)
        variance, base = noise_variance(task, system), task.harmonic_base()
        top, below = _rational(system.A, system.B @ base, system.C, system.D @ base, system.E @ base)
        frequency = jnp.asarray(self.frequency) if self.table is not None else task.harmonic.frequency
        s = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency)
        reply = harmonic_size(task, system.A.dtype) * _polynomial(top, s) / _polynomial(below, s)
        line = 0.5 * jnp.sum(weight * (jnp.real(reply) ** 2 + jnp.imag(reply) ** 2))
        return 0.5 * jnp.log(variance + line) - jnp.log(jnp.abs(system.rest)), system

    def features(self, s: Float[Array, " free"], system: Linearisation | None = None) -> Features | Moments:
        """Of the model at s (linearised already); the moments themselves where there is no grid."""
        problem = self.likelihood.problem
        theta = problem.coordinates.theta(s)
        if self.table is None:
            return problem.moments(theta)
        task = at(problem.task, problem.coordinates, theta)
        model: Any = problem.model
        chosen, correction = model.chosen, model.correction
        system = linearise(task) if system is None else system
        power, variance = noise_response(task, system, task.settings, model.samples)
        base = task.harmonic_base()
        top, below = _rational(system.A, system.B @ base, system.C, system.D @ base, system.E @ base)
        size = harmonic_size(task, system.A.dtype)
        size = jnp.stack([jnp.real(size), jnp.imag(size)])
        return Features(power[chosen] * correction.power, system.rest, variance, size, top, below)

    def heights(self, features: Any, offset: Scalar) -> Float[Array, " grid"]:
        """Log likelihood at every frequency, with the weights of the grid."""
        if self.table is None:
            return self.likelihood.at(features, offset)[None]
        moments = features.moments(jnp.asarray(self.frequency), self.table)
        return jax.vmap(lambda m: self.likelihood.at(m, offset))(moments) + self.log_weight

    def log_prior(self, s: Float[Array, " free"]) -> Scalar:
        """Log prior density of the sampled coordinates, up to a constant."""
        c, columns = self.likelihood.problem.coordinates, jnp.asarray(self.columns)
        theta = c.theta(s)
        bounded = jnp.isfinite(jnp.asarray(c.low))
        stretch = jnp.where(bounded, jax.nn.log_sigmoid(s) + jax.nn.log_sigmoid(-s), 0.0)
        each = -0.5 * jnp.asarray(self.likelihood.problem.prior) * theta**2 + stretch
        return jnp.sum(each[columns])

    def log_density(self, white: Float[Array, " sampled"]) -> Scalar:
        """The density; minus infinity where the task has no stable equilibrium."""
        s, offset, system = self.placed(self.centre + self.scale @ white)
        found = jax.nn.logsumexp(self.heights(self.features(s, system), offset)) + self.log_prior(s)
        return jnp.where(jnp.isfinite(found), found, -jnp.inf)

    def at_frequencies(self, white: Float[Array, " sampled"]) -> Float[Array, " grid"]:
        """Log density at every frequency of the grid (up to a constant), given the rest."""
        s, offset = self.split(white)
        return self.heights(self.features(s), offset)


def marginal_of(setup: Setup, likelihood: Likelihood, theta: Float[np.ndarray, " free"]) -> tuple[Marginal, Peak, int]:
    """The density about the highest of the maxima climbed to from θ, and these.

    Raises `ValueError` for a prior that is not proper and for a frequency that cannot be summed over.
    """
    coordinates, names = setup.coordinates, setup.coordinates.names
    for name, precision, low in zip(names, setup.prior, coordinates.low, strict=True):
        if precision == 0 and not np.isfinite(low):
            raise ValueError(f"the prior of {name} is flat and without bounds, so there is no posterior: give it a prior "
                             f"(priors={{{name!r}: sd}}) or bounds ({name!r}: (low, high))")  # fmt: skip
    peak, best = highest(setup, likelihood, theta, setup.prior)
    summed = "harmonic_frequency" in names
    if summed and not isinstance(setup.task.harmonic.envelope, Constant):
        raise ValueError("harmonic_frequency: with an envelope that changes its posterior cannot be summed over a grid: fix "
                         "it (free= without harmonic_frequency)")  # fmt: skip
    columns = tuple(i for i, name in enumerate(names) if name != "harmonic_frequency")
    frequency, log_weight, table = np.zeros(1), np.zeros(1), None
    if summed:
        frequency = _grid(setup, peak)
        log_weight = _log_weight(setup, frequency)
        settings = setup.target.settings
        chosen = setup.target.bins - settings.first_bin
        samples = jnp.asarray(trial_samples(setup.target))
        table = jax.jit(jax.vmap(lambda f: line_table(settings, WINDOW, f, samples)))(jnp.asarray(frequency))
        table = jax.tree.map(np.asarray, table._replace(level=table.level[:, chosen], turning=table.turning[:, chosen]))
    s, offset = coordinates.from_theta(peak.theta[best]), likelihood.bins is not None
    stretch = np.append(coordinates.stretch(s), 1.0)
    kept = [*columns, len(names)] if offset else list(columns)
    covariance = np.linalg.pinv(peak.curvature[best] * stretch[:, None] * stretch, hermitian=True)[np.ix_(kept, kept)]
    scale = np.linalg.cholesky(covariance + 1e-10 * np.diag(np.diag(covariance)))
    centre = np.append(s[list(columns)], peak.offset[best])[: len(kept)]
    made = Marginal(likelihood, frequency, log_weight, table, s, centre, scale, columns, offset)
    level = _level(setup, made, peak.offset[best])
    if level is not None:
        made = eqx.tree_at(lambda m: m.level, made, level, is_leaf=lambda x: x is None)
        turn = np.eye(len(kept))
        inner = np.ix_(range(len(columns)), range(len(columns)))
        turn[inner] = np.asarray(jax.jit(jax.jacfwd(lambda s: made.levelled(s)[0]))(jnp.asarray(s)))[
            np.ix_(columns, columns)
        ]
        made = eqx.tree_at(lambda m: m.scale, made, np.linalg.solve(turn, scale))
    return made, peak, best


def _level(setup: Setup, made: Marginal, offset: float) -> Level | None:
    """The level, where a coefficient of variation is known and an amplitude is free and without bounds."""
    names, c = setup.coordinates.names, setup.coordinates
    free = [(n.startswith("noise_") and n.removeprefix("noise_") in CHANNELS) or n == "harmonic_amplitude" for n in names]
    loose = np.array(free) & c.positive & ~np.isfinite(c.low)
    if setup.extra[0] is None or not loose.any() or not isinstance(setup.task.harmonic.envelope, Constant):
        return None
    s = jnp.asarray(made.point)

    @jax.jit
    def seen(s: Array) -> tuple[Array, Array]:
        weight = jax.nn.softmax(made.heights(made.features(s), jnp.asarray(offset)))
        return weight, made.log_variation(s, weight)[0]

    weight, variation = map(np.asarray, seen(s))
    column = int(np.argmax(np.where(loose, [n != "harmonic_amplitude" for n in names], -1.0)))
    return Level(column, np.asarray(s[column]), c.sd[column], variation, np.where(loose, 1 / c.sd, 0.0), weight)


def _grid(setup: Setup, peak: Peak) -> Float[np.ndarray, " grid"]:
    """Frequencies three to a bin over the band, fewer beyond it, and close about every maximum that counts.

    The last is repeated, so that few sizes are compiled.
    """
    names, settings, coordinates = setup.coordinates.names, setup.target.settings, setup.coordinates
    column = names.index("harmonic_frequency")
    theta = np.array([coordinates.low[column], coordinates.high[column]])
    low, high = coordinates.centre[column] * np.exp(coordinates.sd[column] * theta)
    high = min(high, HIGHEST * settings.rate)
    edge = setup.target.frequency[-1] + 2 * settings.resolution
    parts = [
        np.arange(low, min(edge, high), settings.resolution / PER_BIN),
        np.arange(edge, high, BEYOND * settings.resolution),
        [high],
    ]
    found: list[float] = []
    for i in np.argsort(peak.cost, kind="stable"):
        f = float(coordinates.centre[column] * np.exp(coordinates.sd[column] * peak.theta[i, column]))
        near = any(abs(f - g) < 0.5 * settings.resolution for g in found)
        if near or len(found) >= MODES or not peak.cost[i] < peak.cost[peak.best] + FADED:
            continue
        found.append(f)
        sd = f * coordinates.sd[column] * np.sqrt(peak.covariance(int(i))[column, column])
        parts.append(f + min(sd, settings.resolution) * AROUND)
    grid = np.unique(np.clip(np.concatenate(parts), low, high))
    grid = grid[np.append(True, np.diff(grid) > 1e-3 * settings.resolution)]
    return np.append(grid, np.full(-len(grid) % FILLED, grid[-1]))


def edges_of(frequency: Float[np.ndarray, " grid"]) -> Float[np.ndarray, " edges"]:
    """Borders of the cells of a grid: half-way between its points, and its ends."""
    return np.concatenate([frequency[:1], 0.5 * (frequency[1:] + frequency[:-1]), frequency[-1:]])


def _log_weight(setup: Setup, frequency: Float[np.ndarray, " grid"]) -> Float[np.ndarray, " grid"]:
    """Prior density of every frequency times the width of its cell."""
    column = setup.coordinates.names.index("harmonic_frequency")
    theta = setup.coordinates.theta_of("harmonic_frequency", frequency)
    with np.errstate(divide="ignore"):  # what is repeated has no width
        return -0.5 * setup.prior[column] * theta**2 - np.log(frequency) + np.log(np.diff(edges_of(frequency)))
