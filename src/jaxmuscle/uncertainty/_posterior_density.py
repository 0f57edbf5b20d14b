"""The posterior density with the harmonic's frequency, where it has many modes, summed over a
grid."""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._parameters import amplitude_names
from jaxmuscle.model._signals import Constant
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._coordinates import task_at
from jaxmuscle.objective._likelihood import Likelihood, log_density
from jaxmuscle.objective._moment_models import Linear
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._scoring import Maximum, highest
from jaxmuscle.objective._starts import frequency_names
from jaxmuscle.response._expected import Moments, noise_response, noise_variance
from jaxmuscle.response._harmonic_line import LineTable, harmonic_size
from jaxmuscle.response._input_response import parts_of_stiffness
from jaxmuscle.response._linear_task import Linearisation
from jaxmuscle.response._linearised import linearise
from jaxmuscle.response._transfer import harmonic_system, polynomial, polynomials

from ._frequency_grid import Band, Grid, Numbers, band_about

Free = Float[Array, " free"]
Offsets = Float[Array, " parts"]
Sampled = Float[Array, " sampled"]
Heights = Float[Array, " grid"]
Number = Float[Numbers, ""]
Systems = dict[int, Linearisation]


def _reply(size: Any, numerator: Array, denominator: Array, frequency: Array) -> Array:
    """The line of a harmonic of complex `size` at each frequency."""
    s = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency)
    return size * polynomial(numerator, s) / polynomial(denominator, s)


class Features(NamedTuple):
    """What the spectra at all frequencies of the harmonic follow from: the noise, and the line's
    response to any frequency.

    `numerator` and `denominator` are coefficients of powers of s, highest first: a harmonic of real
    and imaginary part `size` has the line `size numerator(s) / denominator(s)`, s = iω.
    """

    power: Float[Array, " bins"]
    mean: Scalar
    variance: Scalar
    size: Float[Array, "2"]
    numerator: Float[Array, " above"]
    denominator: Float[Array, " below"]
    stiffness: Float[Array, "2 points"] | tuple[()]

    def moments(self, frequency: Heights, table: LineTable) -> Moments:
        """Moments with the harmonic at each frequency, the last axis of the powers and the only one
        of the variance.

        Powers are in units of the noise's, in the precision of the table. They end with the last
        frequency whose line shows in the bins, and with no line at all.
        """
        size = jax.lax.complex(*self.size)
        reply = _reply(size, self.numerator, self.denominator, frequency)
        scale = jax.lax.stop_gradient(jnp.sum(self.power))
        shown = reply[: table.level.shape[-1]] * jax.lax.rsqrt(scale).astype(reply.dtype)
        line = jnp.pad(table.power(shown), ((0, 0), (0, 1)))
        power = (self.power / scale).astype(line.dtype)
        return Moments(
            power[:, None] + line,
            line,
            self.mean,
            self.variance + table.variance(reply),
            stiffness=self.stiffness,
        )


GRID = Moments(1, 1, None, 0, None, None)  # pyright: ignore  # which axis counts the frequencies


class Level(eqx.Module):
    """The common scale of the amplitudes, as the coordinate of one of them, counted from a fixed
    coefficient of variation.

    Only the coefficient of variation shows that scale, and narrowly: in the amplitudes themselves
    the posterior is a thin curved sheet that chains hardly follow; counted from there the scale is
    all but a normal variable of its own. `column` is the coordinate of one amplitude, `start` its
    value at the maximum, `sd` its prior standard deviation, `log_variation` that of the `part` at
    the maximum, `along` what a common factor does to all coordinates, `weight` of the part's
    harmonic frequencies.
    """

    start: Number
    sd: Number
    log_variation: Number
    along: Float[Numbers, " free"]
    weight: Grid
    column: int = eqx.field(static=True)
    part: int = eqx.field(static=True)


class PosteriorDensity(eqx.Module):
    """Log posterior density of the unbounded coordinates s (without the harmonics' frequencies) and
    the offsets u.

        ln p(s, u) = Σ_b ln Σ_j w_bj Π_i L_i(θ(s), f_bj, u_i) + Σ_i ln L_i(θ(s), u_i)
                     - ½ Σ θ² + ln |dθ/ds|

    over the `bands` b, each a grid of a harmonic's frequency with the targets i that it acts on,
    and over the other targets. `columns` are the sampled coordinates among the free ones, `offsets`
    the targets whose u is sampled, `centre` and `scale` whiten both, some of the coordinates being
    counted from `levels` (the Jacobian of which is 1).
    """

    likelihood: Likelihood
    bands: tuple[Band, ...]
    point: Float[Numbers, " free"]
    centre: Float[Numbers, " sampled"]
    scale: Float[Numbers, "sampled sampled"]
    levels: tuple[Level, ...]
    columns: tuple[int, ...] = eqx.field(static=True)
    offsets: tuple[int, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """How many numbers are sampled."""
        return len(self.columns) + len(self.offsets)

    def split(self, white: Sampled) -> tuple[Free, Offsets]:
        """Unbounded coordinates (with the point's own where not sampled) and the offsets of
        whitened ones."""
        return self.place(self.centre + self.scale @ white)[:2]

    def place(self, both: Float[Numbers, " sampled"]) -> tuple[Free, Offsets, Systems]:
        """The same of sampled coordinates, with the linearised tasks as far as they were needed."""
        s = jnp.asarray(self.point).at[jnp.asarray(self.columns)].set(both[: len(self.columns)])
        offsets = jnp.zeros(len(self.likelihood.bins))
        offsets = offsets.at[jnp.asarray(self.offsets, dtype=int)].set(both[len(self.columns) :])
        s, systems = self.from_levels(s)
        return s, offsets, systems

    def from_levels(self, s: Free) -> tuple[Free, Systems]:
        """Coordinates s of which some are counted from a level, as they are."""
        systems: Systems = {}
        for level in self.levels:
            s, above = (
                s.at[level.column].set(level.start),
                level.sd * (s[level.column] - level.start),
            )
            found, systems[level.part] = self.log_variation(s, level.part, level.weight)
            s = s + (level.log_variation + above - found) * level.along
        return s, systems

    def band_of(self, part: int) -> Band | None:
        """The band that acts on a part."""
        return next((band for band in self.bands if part in band.parts), None)

    def task(self, s: Free, part: int) -> AbstractTask:
        """One part's task at s."""
        objective = self.likelihood.objective
        own = objective.parts[part]
        return task_at(
            own.task, own.coordinates, objective.own(objective.coordinates.theta(s), part)
        )

    def log_variation(self, s: Free, part: int, weight: Grid) -> tuple[Scalar, Linearisation]:
        """Log coefficient of variation of a long recording, the harmonic's frequencies weighted;
        the linearised task."""
        task, band = self.task(s, part), self.band_of(part)
        system = linearise(task)
        frequency = task.harmonic.frequency if band is None else band.frequency
        size = harmonic_size(task, system.A.dtype)
        top, below = polynomials(harmonic_system(task, system))
        reply = _reply(size, top, below, jnp.atleast_1d(jnp.asarray(frequency)))
        line = 0.5 * jnp.sum(weight * (jnp.real(reply) ** 2 + jnp.imag(reply) ** 2))
        variance = noise_variance(task, system) + line
        return 0.5 * jnp.log(variance) - jnp.log(jnp.abs(system.rest)), system

    def features(self, s: Free, part: int, systems: Systems) -> Features:
        """Of a part's model at s (linearised already, perhaps)."""
        task, model = self.task(s, part), self.likelihood.objective.parts[part].model
        assert isinstance(model, Linear)
        system = systems[part] if part in systems else linearise(task)
        power, variance = noise_response(task, system, task.settings, model.samples, model.recorded)
        size = harmonic_size(task, system.A.dtype)
        size = jnp.stack([jnp.real(size), jnp.imag(size)])
        power = jnp.sum(power, axis=0)[model.chosen] * model.correction.power
        stiffness = () if model.points is None else parts_of_stiffness(task, system, model.points)
        line = polynomials(harmonic_system(task, system))
        return Features(power, system.rest, variance, size, *line, stiffness)

    def heights(self, band: Band, s: Free, offsets: Offsets, systems: Systems) -> Heights:
        """Log likelihood of a band's targets at every frequency, with the weights of the grid."""
        found = jnp.asarray(band.log_weight)
        for part, table in zip(band.parts, band.tables, strict=True):
            features, bins = self.features(s, part, systems), self.likelihood.bins[part]
            moments = features.moments(jnp.asarray(band.frequency), table)
            which = np.minimum(np.arange(len(band.frequency)), table.level.shape[-1])
            spread = moments._replace(power=moments.power[:, which], line=moments.line[:, which])
            if bins is None:
                own = partial(self.likelihood.of_part, part, offset=offsets[part], bins=None)
            else:
                own = partial(self.likelihood.further, part)
                law, offset = as_arrays((bins, offsets[part]), moments.power.dtype)
                height = log_density(law, moments.power, moments.line, offset)
                found += height[which].astype(found.dtype)
            found += jax.vmap(lambda m, own=own: own(m), in_axes=(GRID,))(spread)
        return found

    def log_prior(self, s: Free) -> Scalar:
        """Log prior density of the sampled coordinates, up to a constant."""
        c, columns = self.likelihood.objective.coordinates, jnp.asarray(self.columns)
        theta = c.theta(s)
        bounded = jnp.isfinite(jnp.asarray(c.low))
        stretch = jnp.where(bounded, jax.nn.log_sigmoid(s) + jax.nn.log_sigmoid(-s), 0.0)
        # What is summed over has its own prior in the weights of the grid.
        pulled = jnp.asarray(self.likelihood.objective.prior_root)[:, columns] @ theta[columns]
        return jnp.sum(stretch[columns]) - 0.5 * jnp.sum(pulled**2)

    def log_density(self, white: Sampled) -> Scalar:
        """The density; minus infinity where a task has no stable equilibrium."""
        s, offsets, systems = self.place(self.centre + self.scale @ white)
        found = self.log_prior(s)
        for band in self.bands:
            found += jax.nn.logsumexp(self.heights(band, s, offsets, systems))
        objective = self.likelihood.objective
        theta = objective.coordinates.theta(s)
        for part, bins in enumerate(self.likelihood.bins):
            if self.band_of(part) is None:
                moments = objective.parts[part].moments(jnp.asarray(objective.own(theta, part)))
                found += self.likelihood.of_part(part, moments, offsets[part], bins)
        return jnp.where(jnp.isfinite(found), found, -jnp.inf)

    def at_frequencies(self, white: Sampled) -> tuple[Heights, ...]:
        """Log density at every frequency of each band (up to a constant), given the rest."""
        s, offsets, systems = self.place(self.centre + self.scale @ white)
        return tuple(self.heights(band, s, offsets, systems) for band in self.bands)


def density_about(
    problem: FitProblem, likelihood: Likelihood, theta: Float[np.ndarray, " free"]
) -> tuple[PosteriorDensity, Maximum, int]:
    """The density about the highest of the maxima climbed to from θ, and these.

    Raises `ValueError` for a prior that is not proper and for a frequency that cannot be summed
    over.
    """
    coordinates, names = problem.coordinates, problem.coordinates.names
    for name, precision, low in zip(names, problem.prior, coordinates.low, strict=True):
        if precision == 0 and not np.isfinite(low):
            raise ValueError(
                f"the prior of {name} is flat and without bounds, so there is no posterior: give it"
                f" a prior (priors={{{name!r}: sd}}) or bounds ({name!r}: (low, high))"
            )
    peak, best = highest(problem, likelihood, theta, problem.precision)
    summed = frequency_names(coordinates)
    bands = tuple(band_about(problem, peak, name) for name in summed)
    columns = tuple(i for i, name in enumerate(names) if name not in summed)
    offsets = tuple(i for i, bins in enumerate(likelihood.bins) if bins is not None)
    s = coordinates.from_theta(peak.theta[best])
    stretch = np.append(coordinates.stretch(s), np.ones(len(likelihood.bins)))
    sampled = [*columns, *(len(names) + i for i in offsets)]
    curvature = peak.curvature[best] * stretch[:, None] * stretch
    covariance = np.linalg.pinv(curvature, hermitian=True)[np.ix_(sampled, sampled)]
    # what nothing determines has no variance in a pseudo-inverse
    scale = np.linalg.cholesky(covariance + 1e-10 * np.diag(np.diag(covariance)))
    centre = np.append(s, peak.offset[best])[sampled]
    made = PosteriorDensity(likelihood, bands, s, centre, scale, (), columns, offsets)
    levels = _levels(problem, made, peak.offset[best])
    if levels:
        made = dataclasses.replace(made, levels=levels)
        turn, inner = np.eye(len(sampled)), np.s_[: len(columns), : len(columns)]
        turn[inner] = np.asarray(_levelling(made, s))[np.ix_(columns, columns)]
        made = dataclasses.replace(made, scale=np.linalg.solve(turn, scale))
    return made, peak, best


def _levels(problem: FitProblem, made: PosteriorDensity, offsets: np.ndarray) -> tuple[Level, ...]:
    """A level for every coefficient of variation that is known, where amplitudes of its own are
    free and without bounds."""
    c = problem.coordinates
    base = [name.partition("@")[0] for name in c.names]
    amplitudes = {name for part in problem.parts for name in amplitude_names(part.task)}
    open_now = np.isin(base, list(amplitudes)) & c.positive & ~np.isfinite(c.low)
    s, levels = np.asarray(made.point), []
    for i, part in enumerate(problem.parts):
        loose = open_now & np.isin(np.arange(len(base)), part.columns)
        still = isinstance(part.task.harmonic.envelope, Constant)
        if part.variation is None or not loose.any() or not still:
            continue
        weight, variation = map(np.asarray, _weights(made, s, offsets, i))
        # that of a noise, where there is one
        column = int(np.argmax(np.where(loose, [n != "harmonic_amplitude" for n in base], -1.0)))
        start, sd = np.asarray(s[column]), np.asarray(c.sd[column])
        along = np.where(loose, 1 / c.sd, 0.0)
        levels.append(Level(start, sd, variation, along, weight, column, i))
        open_now = open_now & ~loose
    return tuple(levels)


@kept
def _levelling(made: PosteriorDensity, s: Numbers) -> Array:
    """How coordinates change with those that are counted from levels."""
    return jax.jacfwd(lambda s: made.from_levels(s)[0])(jnp.asarray(s))


@kept
def _weights(
    made: PosteriorDensity, point: Numbers, offsets: Numbers, part: int
) -> tuple[Array, Array]:
    """Of the frequencies of the band that acts on a part; the log coefficient of variation with
    these."""
    band, s, weight = made.band_of(part), jnp.asarray(point), jnp.ones(1)
    if band is not None:
        weight = jax.nn.softmax(made.heights(band, s, jnp.asarray(offsets), {}))
    return weight, made.log_variation(s, part, weight)[0]
