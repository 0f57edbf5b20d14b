"""How a fit predicts moments: in linear response, or by Monte Carlo over fixed noise paths."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int, PRNGKeyArray

from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._stream import Draws, Stream
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._expected import Moments, response
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.response._input_response import parts_of_stiffness
from jaxmuscle.response._linear_task import Linearisation, LinearTask
from jaxmuscle.response._linearised import settled
from jaxmuscle.response._rows import Sampling, moments_of_rows
from jaxmuscle.simulation._batch import streams_of
from jaxmuscle.simulation._grid import Grid
from jaxmuscle.spectra._bin_law import bin_rows
from jaxmuscle.spectra._settings import SpectrumSettings
from jaxmuscle.spectra._welch import lowpass


def welch_operator(
    settings: SpectrumSettings, samples: int, window: tuple[float, float]
) -> Float[np.ndarray, "parts samples"]:
    """The linear part of `spectrum_of` as one matrix.

    Low-pass, window, detrending, taper and transform are linear, so a Welch power is `Σ (A x)²`
    over the rows of its bin; the rows are ordered (segments, tapers and real/imaginary part, bins),
    scaled so that the sum is the power itself.
    """
    x = np.eye(samples)
    if settings.sections is not None:
        both = settings.filter_direction == "both"
        low_pass: Any = scipy.signal.sosfiltfilt if both else scipy.signal.sosfilt
        x = np.asarray(low_pass(settings.sections, x))
    x = x[:, round(window[0] * settings.rate) : round(window[1] * settings.rate)]
    count, n = settings.segments(x.shape[1]), settings.length
    if count < 1:
        raise ValueError(
            f"window {window} s is shorter than one segment of {n} samples at {settings.rate} Hz"
        )
    rows = bin_rows(settings).swapaxes(0, 1) / np.sqrt(count)
    segments = [x[:, k * settings.step : k * settings.step + n].T for k in range(count)]
    each = [taper @ segment for segment in segments for taper in rows]
    return np.concatenate([part for transform in each for part in (transform.real, transform.imag)])


class Linear(eqx.Module):
    """The expected spectrum of a task in linear response, times a `correction` (of a nonlinear
    simulation, say).

    Its variance is that of a recording of so many `samples`, `recorded` at an interval [s].
    `points`: frequencies of a measured dynamic stiffness [Hz]. Unless `spectral`, rows have ones in
    place of power and variance: of a search that compares neither.
    """

    chosen: np.ndarray
    correction: Moments
    samples: Int[Array | np.ndarray, ""]
    window: tuple[float, float] = eqx.field(static=True)
    points: Float[Array | np.ndarray, " points"] | None = None
    recorded: Float[Array | np.ndarray, ""] | float = 0.0
    spectral: bool = eqx.field(static=True, default=True)

    def moments(self, task: AbstractTask) -> Moments:
        """Expected moments of the task's output that are compared with data."""
        # Compiled apart, so that it is traced once.
        found, system = expected_moments(
            task, task.settings, self.window, self.samples, self.recorded
        )
        return self.compared(task, found, system)

    def compared(self, task: AbstractTask, found: Moments, system: Linearisation) -> Moments:
        """What is compared of a task's moments, and its dynamic stiffness."""
        stiffness = () if self.points is None else parts_of_stiffness(task, system, self.points)
        return self._chosen(found._replace(stiffness=stiffness), jnp.multiply)

    def of_rows(
        self,
        task: AbstractTask,
        own: tuple[str, ...],
        values: Float[np.ndarray, "rows own"],
        along: tuple[str, ...],
    ) -> tuple[Moments, Moments]:
        """The same with each row of values, and their slopes along a last axis."""
        sampled = Sampling(task.settings, self.window, self.samples, self.recorded)
        points = None if self.points is None else np.asarray(self.points)
        moments, slopes, _ = moments_of_rows(
            task, own, values, sampled, points, along, spectral=self.spectral
        )
        slopes = self._chosen(
            slopes, lambda x, c: x * np.asarray(c)[..., None], lambda x: x[:, self.chosen]
        )
        return self._chosen(moments, np.multiply, lambda x: x[:, self.chosen]), slopes

    def _chosen(self, found: Moments, times: Any, pick: Any = None) -> Moments:
        """At the compared bins, corrected."""
        pick = (lambda x: x[self.chosen]) if pick is None else pick
        power, line, resonant = jax.tree.map(pick, (found.power, found.line, found.resonant))
        found = found._replace(power=power, line=line, resonant=resonant)
        return jax.tree.map(times, found, self.correction)


class MonteCarlo(eqx.Module):
    """Mean spectrum of a task over noise paths that stay the same (common random numbers).

    They are drawn while the task is integrated, from the random numbers of each seed. With
    `control` the task starts settled and the linearised task runs on the same paths as control
    variate. Without it the first of the seeds has no noise, which gives the harmonic's own
    response; that is taken off every seed before the spectrum and its power added after: the cross
    term between line and noise has expectation zero, yet for fixed paths it makes the cost ripple
    with the frequency.
    """

    linear: Linear
    streams: Stream
    operator: Float[Array, "parts samples"]
    grid: Grid
    control: bool = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        linear: Linear,
        settings: SpectrumSettings,
        key: PRNGKeyArray,
        seeds: int,
        grid: Grid,
        *,
        control: bool,
    ) -> "MonteCarlo":
        """On seeds 0 to `seeds - 1` of the key; `linear`, what is expected in linear response: its
        bins and points are those of the paths, and with a control variate its variance, of a
        recording of so many samples."""
        numbers = jnp.arange(seeds) if control else jnp.maximum(jnp.arange(seeds + 1) - 1, 0)
        operator = welch_operator(settings, grid.steps // grid.every + 1, linear.window)
        return cls(linear, streams_of(key, numbers, Draws()), jnp.asarray(operator), grid, control)

    @property
    def chosen(self) -> Int[Array | np.ndarray, " chosen"]:
        """Positions of the compared bins among the settings'."""
        return self.linear.chosen

    @property
    def window(self) -> tuple[float, float]:
        """The analysed part [s]."""
        return self.linear.window

    @property
    def points(self) -> Float[Array | np.ndarray, " points"] | None:
        """Frequencies of a measured dynamic stiffness [Hz]."""
        return self.linear.points

    @property
    def seeds(self) -> int:
        """How many noise paths there are."""
        return len(self.streams.words) - (not self.control)

    def moments(self, task: AbstractTask) -> Moments:
        """Moments of the task's output."""
        # and diffrax, which a linear fit does without
        from jaxmuscle.simulation._integrator import integrated

        settings = task.settings
        start, stop = (round(edge * settings.rate) for edge in self.window)

        def outputs(loud, *tasks):
            return integrated(
                tasks, self.streams, self.grid, settings.sampling, states=False, loud=loud
            ).outputs

        def swing(seen):
            return jnp.var(lowpass(seen, settings)[..., start:stop], axis=-1)

        if self.control:
            task = settled(task)
            linear = self.linear
            exact, system = response(task, settings, linear.window, linear.samples, linear.recorded)
            exact = linear.compared(task, exact, system)
            seen, beside = outputs(None, task, LinearTask.of(task, system))
            more = self._power(seen, settings) - self._power(beside, settings)
            return exact._replace(
                power=exact.power + jnp.mean(more, 0),
                mean=jnp.mean(seen[:, start:stop]),
                variance=exact.variance + jnp.mean(swing(seen) - swing(beside)),
            )
        (seen,) = outputs(jnp.minimum(jnp.arange(self.seeds + 1.0), 1.0), task)
        mean = jnp.mean(seen[1:, start:stop])
        quiet, noisy = seen[:1], seen[1:] - seen[:1]
        line, random = (
            jnp.mean(self._power(quiet, settings), 0),
            jnp.mean(self._power(noisy, settings), 0),
        )
        variance = swing(quiet[0]) + jnp.mean(swing(noisy))
        none = tuple(
            jnp.full_like(line, jnp.nan)
            for part in task.noise.components
            if isinstance(part, ResonantNoise)
        )
        return Moments(line + random, line, mean, variance, none)

    def _power(
        self, outputs: Float[Array, "seeds samples"], settings: SpectrumSettings
    ) -> Float[Array, "seeds bins"]:
        bins = settings.last_bin - settings.first_bin + 1
        parts = (outputs @ self.operator.T).reshape(len(outputs), -1, bins)
        return jnp.sum(parts**2, axis=1)[:, self.chosen]
