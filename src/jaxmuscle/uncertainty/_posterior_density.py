"""The posterior density with the harmonic's frequency, where it has many modes, summed over a
grid."""

import dataclasses
from functools import partial
from typing import NamedTuple

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

from ._frequency_grid import Band, band_about


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

    def moments(self, frequency: Float[Array, " grid"], table: LineTable) -> Moments:
        """Moments with the harmonic at each frequency, the last axis of the powers and the only one
        of the variance.

        Powers are in units of the noise's, in the precision of the table. They end with the last
        frequency whose line shows in the bins, and with no line at all.
        """
        s = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency)
        reply = (
            jax.lax.complex(*self.size)
            * polynomial(self.numerator, s)
            / polynomial(self.denominator, s)
        )
        scale = jax.lax.stop_gradient(jnp.sum(self.power))
        line = table.power(
            reply[: table.level.shape[-1]] * jax.lax.rsqrt(scale).astype(reply.dtype)
        )
        line = jnp.pad(line, ((0, 0), (0, 1)))
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

    start: Float[Array | np.ndarray, ""]
    sd: Float[Array | np.ndarray, ""]
    log_variation: Float[Array | np.ndarray, ""]
    along: Float[Array | np.ndarray, " free"]
    weight: Float[Array | np.ndarray, " grid"]
    column: int = eqx.field(static=True)
    part: int = eqx.field(static=True)


Systems = dict[int, Linearisation]


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
    point: Float[Array | np.ndarray, " free"]
    centre: Float[Array | np.ndarray, " sampled"]
    scale: Float[Array | np.ndarray, "sampled sampled"]
    levels: tuple[Level, ...]
    columns: tuple[int, ...] = eqx.field(static=True)
    offsets: tuple[int, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """How many numbers are sampled."""
        return len(self.columns) + len(self.offsets)

    def split(
        self, white: Float[Array, " sampled"]
    ) -> tuple[Float[Array, " free"], Float[Array, " parts"]]:
        """Unbounded coordinates (with the point's own where not sampled) and the offsets of
        whitened ones."""
        return self.placed(self.centre + self.scale @ white)[:2]

    def placed(
        self, both: Float[Array | np.ndarray, " sampled"]
    ) -> tuple[Float[Array, " free"], Float[Array, " parts"], Systems]:
        """The same of sampled coordinates, with the linearised tasks as far as they were needed."""
        s = jnp.asarray(self.point).at[jnp.asarray(self.columns)].set(both[: len(self.columns)])
        offsets = jnp.zeros(len(self.likelihood.bins))
        offsets = offsets.at[jnp.asarray(self.offsets, dtype=int)].set(both[len(self.columns) :])
        s, systems = self.levelled(s)
        return s, offsets, systems

    def levelled(self, s: Float[Array, " free"]) -> tuple[Float[Array, " free"], Systems]:
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

    def task(self, s: Float[Array, " free"], part: int) -> AbstractTask:
        """One part's task at s."""
        objective = self.likelihood.objective
        own = objective.parts[part]
        return task_at(
            own.task, own.coordinates, objective.own(objective.coordinates.theta(s), part)
        )

    def log_variation(
        self, s: Float[Array, " free"], part: int, weight: Float[Array | np.ndarray, " grid"]
    ) -> tuple[Scalar, Linearisation]:
        """Log coefficient of variation of a long recording, the harmonic's frequencies weighted;
        the linearised task."""
        task, band = self.task(s, part), self.band_of(part)
        system = linearise(task)
        variance, (top, below) = (
            noise_variance(task, system),
            polynomials(harmonic_system(task, system)),
        )
        frequency = jnp.atleast_1d(
            task.harmonic.frequency if band is None else jnp.asarray(band.frequency)
        )
        s = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency)
        reply = harmonic_size(task, system.A.dtype) * polynomial(top, s) / polynomial(below, s)
        line = 0.5 * jnp.sum(weight * (jnp.real(reply) ** 2 + jnp.imag(reply) ** 2))
        return 0.5 * jnp.log(variance + line) - jnp.log(jnp.abs(system.rest)), system

    def features(self, s: Float[Array, " free"], part: int, systems: Systems) -> Features:
        """Of a part's model at s (linearised already, perhaps)."""
        task, model = self.task(s, part), self.likelihood.objective.parts[part].model
        assert isinstance(model, Linear)
        system = systems[part] if part in systems else linearise(task)
        power, variance = noise_response(task, system, task.settings, model.samples, model.recorded)
        size = harmonic_size(task, system.A.dtype)
        size = jnp.stack([jnp.real(size), jnp.imag(size)])
        power = jnp.sum(power, axis=0)[model.chosen] * model.correction.power
        stiffness = () if model.points is None else parts_of_stiffness(task, system, model.points)
        return Features(
            power,
            system.rest,
            variance,
            size,
            *polynomials(harmonic_system(task, system)),
            stiffness,
        )

    def heights(
        self,
        band: Band,
        s: Float[Array, " free"],
        offsets: Float[Array, " parts"],
        systems: Systems,
    ) -> Float[Array, " grid"]:
        """Log likelihood of a band's targets at every frequency, with the weights of the grid."""
        found = jnp.asarray(band.log_weight)
        for part, table in zip(band.parts, band.tables, strict=True):
            features, bins = self.features(s, part, systems), self.likelihood.bins[part]
            moments = features.moments(jnp.asarray(band.frequency), table)
            which = np.minimum(np.arange(len(band.frequency)), table.level.shape[-1])
            spread = moments._replace(power=moments.power[:, which], line=moments.line[:, which])
            if bins is None:
                own = partial(self.likelihood.of_part, part, offset=offsets[part], bins=None)
                found += jax.vmap(lambda m, own=own: own(m), in_axes=(GRID,))(spread)
            else:
                law, offset = as_arrays((bins, offsets[part]), moments.power.dtype)
                found += log_density(law, moments.power, moments.line, offset)[which].astype(
                    found.dtype
                )
                found += jax.vmap(lambda m, i=part: self.likelihood.further(i, m), in_axes=(GRID,))(
                    spread
                )
        return found

    def log_prior(self, s: Float[Array, " free"]) -> Scalar:
        """Log prior density of the sampled coordinates, up to a constant."""
        c, columns = self.likelihood.objective.coordinates, jnp.asarray(self.columns)
        theta = c.theta(s)
        bounded = jnp.isfinite(jnp.asarray(c.low))
        stretch = jnp.where(bounded, jax.nn.log_sigmoid(s) + jax.nn.log_sigmoid(-s), 0.0)
        # What is summed over has its own prior in the weights of the grid.
        pulled = jnp.asarray(self.likelihood.objective.prior_root)[:, columns] @ theta[columns]
        return jnp.sum(stretch[columns]) - 0.5 * jnp.sum(pulled**2)

    def log_density(self, white: Float[Array, " sampled"]) -> Scalar:
        """The density; minus infinity where a task has no stable equilibrium."""
        s, offsets, systems = self.placed(self.centre + self.scale @ white)
        found = self.log_prior(s)
        for band in self.bands:
            found += jax.nn.logsumexp(self.heights(band, s, offsets, systems))
        for part, bins in enumerate(self.likelihood.bins):
            if self.band_of(part) is None:
                objective = self.likelihood.objective
                moments = objective.parts[part].moments(
                    jnp.asarray(objective.own(objective.coordinates.theta(s), part))
                )
                found += self.likelihood.of_part(part, moments, offsets[part], bins)
        return jnp.where(jnp.isfinite(found), found, -jnp.inf)

    def at_frequencies(self, white: Float[Array, " sampled"]) -> tuple[Float[Array, " grid"], ...]:
        """Log density at every frequency of each band (up to a constant), given the rest."""
        s, offsets, systems = self.placed(self.centre + self.scale @ white)
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
    s, offsets = (
        coordinates.from_theta(peak.theta[best]),
        tuple(i for i, b in enumerate(likelihood.bins) if b is not None),
    )
    stretch = np.append(coordinates.stretch(s), np.ones(len(likelihood.bins)))
    sampled = [*columns, *(len(names) + i for i in offsets)]
    covariance = np.linalg.pinv(peak.curvature[best] * stretch[:, None] * stretch, hermitian=True)[
        np.ix_(sampled, sampled)
    ]
    scale = np.linalg.cholesky(covariance + 1e-10 * np.diag(np.diag(covariance)))
    centre = np.append(s, peak.offset[best])[sampled]
    made = PosteriorDensity(likelihood, bands, s, centre, scale, (), columns, offsets)
    levels = _levels(problem, made, peak.offset[best])
    if levels:
        made = dataclasses.replace(made, levels=levels)
        turn = np.eye(len(sampled))
        inner = np.ix_(range(len(columns)), range(len(columns)))
        slope = np.asarray(_levelling(made, s))
        turn[inner] = slope[np.ix_(columns, columns)]
        made = dataclasses.replace(made, scale=np.linalg.solve(turn, scale))
    return made, peak, best


def _levels(problem: FitProblem, made: PosteriorDensity, offsets: np.ndarray) -> tuple[Level, ...]:
    """A level for every coefficient of variation that is known, where amplitudes of its own are
    free and without bounds."""
    c = problem.coordinates
    base = [name.partition("@")[0] for name in c.names]
    amplitudes = {name for part in problem.parts for name in amplitude_names(part.task)}
    amplitude = [name in amplitudes for name in base]
    open_now = np.array(amplitude) & c.positive & ~np.isfinite(c.low)
    s, levels = np.asarray(made.point), []
    for i, part in enumerate(problem.parts):
        loose = open_now & np.isin(np.arange(len(base)), part.columns)
        if (
            part.variation is None
            or not loose.any()
            or not isinstance(part.task.harmonic.envelope, Constant)
        ):
            continue
        weight, variation = map(np.asarray, _weights(made, s, offsets, i))
        column = int(np.argmax(np.where(loose, [n != "harmonic_amplitude" for n in base], -1.0)))
        along = np.where(loose, 1 / c.sd, 0.0)
        levels.append(
            Level(
                np.asarray(s[column]), np.asarray(c.sd[column]), variation, along, weight, column, i
            )
        )
        open_now = open_now & ~loose
    return tuple(levels)


@kept
def _levelling(made: PosteriorDensity, s: Array | np.ndarray) -> Array:
    """How coordinates change with those that are counted from levels."""
    return jax.jacfwd(lambda s: made.levelled(s)[0])(jnp.asarray(s))


@kept
def _weights(
    made: PosteriorDensity, point: Array | np.ndarray, offsets: Array | np.ndarray, part: int
) -> tuple[Array, Array]:
    """Of the frequencies of the band that acts on a part; the log coefficient of variation with
    these."""
    band, s = made.band_of(part), jnp.asarray(point)
    weight = (
        jnp.ones(1)
        if band is None
        else jax.nn.softmax(made.heights(band, s, jnp.asarray(offsets), {}))
    )
    return weight, made.log_variation(s, part, weight)[0]
