"""What a Monte Carlo fit compares: mean Welch powers over fixed noise paths, as a function of free coordinates."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.signal
from jaxtyping import Array, Float, Int
from scipy.special import expit

from ._expected import Moments, expected_moments, response, samples_in
from ._lanes import respond
from ._law import Scalar
from ._linear import LinearTask, settled
from ._noise import Realisation
from ._parameter import PARAMETERS, Parameter, set_parameters
from ._path import Grid
from ._spectrum import SpectrumSettings, lowpass
from ._task import AbstractTask

Numbers = TypeVar("Numbers", bound=Float[Array | np.ndarray, "*batch free"])


class Coordinates(eqx.Module):
    """Free parameters as unconstrained numbers.

    `θ = (ln v - ln v0) / sd` for positive parameters, `(v - v0) / sd` for others, v0 the task's own value and sd the
    prior's; a parameter with two finite bounds is `θ = low + (high - low) sigmoid(s)`, otherwise θ = s.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    centre: Float[np.ndarray, " free"]
    sd: Float[np.ndarray, " free"]
    positive: np.ndarray
    low: Float[np.ndarray, " free"]
    high: Float[np.ndarray, " free"]

    @classmethod
    def of(cls, values: dict[str, float], bounds: dict[str, tuple[float, float]], sds: dict[str, float]) -> "Coordinates":
        """Coordinates about the given values. Raises `ValueError` for one that cannot be fitted."""
        rows = {name: PARAMETERS.get(name, _generic(name)) for name in values}
        low, high = [], []
        for name, value in values.items():
            row = rows[name]
            a, b = bounds.get(name, (row.fit_lower, row.fit_upper))
            if row.positive and not value > 0:
                raise ValueError(
                    f"{name} = {value} cannot be fitted: it is fitted in log space, start from a positive value"
                )
            if not a < value < b:
                raise ValueError(f"{name} = {value} {row.unit} must lie inside its bounds ({a}, {b})")
            low.append((_log(a) - np.log(value)) / sds[name] if row.positive else (a - value) / sds[name])
            high.append((_log(b) - np.log(value)) / sds[name] if row.positive else (b - value) / sds[name])
        positive = np.array([rows[name].positive for name in values])
        centre = np.array([float(v) for v in values.values()])
        sd = np.array([sds[name] for name in values])
        return cls(tuple(values), centre, sd, positive, *_both_or_none(np.array(low), np.array(high)))

    def theta(self, s: Numbers) -> Numbers:
        """Coordinates in standard deviations of the prior."""
        xp, sigmoid = self._library(s)
        bounded = xp.isfinite(self.low)
        low, high = xp.where(bounded, self.low, 0.0), xp.where(bounded, self.high, 1.0)
        return xp.where(bounded, low + (high - low) * sigmoid(s), s)

    def stretch(self, s: Float[np.ndarray, "*batch free"]) -> Float[np.ndarray, "*batch free"]:
        """dθ/ds."""
        bounded = np.isfinite(self.low)
        share = expit(s)
        return np.where(bounded, np.where(bounded, self.high - self.low, 1.0) * share * (1 - share), 1.0)

    def _library(self, given: Any) -> tuple[Any, Any]:
        """NumPy for numbers, which needs no compilation, else JAX; with its sigmoid."""
        return (np, expit) if isinstance(given, np.ndarray) and isinstance(self.low, np.ndarray) else (jnp, jax.nn.sigmoid)

    def from_theta(self, theta: Float[np.ndarray, "*batch free"]) -> Float[np.ndarray, "*batch free"]:
        """The reverse of `theta`, clipped into the bounds."""
        bounded = np.isfinite(self.low)
        low, high = np.where(bounded, self.low, 0.0), np.where(bounded, self.high, 1.0)
        share = np.clip((theta - low) / (high - low), 1e-3, 1 - 1e-3)
        return np.where(bounded, np.log(share / (1 - share)), theta)

    def values(self, theta: Float[Array | np.ndarray, " free"]) -> dict[str, Scalar]:
        """Natural values of the parameters at θ."""
        xp, _ = self._library(theta)
        step = self.sd * theta
        natural = xp.where(self.positive, self.centre * xp.exp(xp.where(self.positive, step, 0.0)), self.centre + step)
        return dict(zip(self.names, natural, strict=True))

    def values_of(self, theta: Float[np.ndarray, "rows free"]) -> Float[np.ndarray, "rows free"]:
        """Natural values of many θ, in the order of `names`."""
        step = self.sd * theta
        return np.where(self.positive, self.centre * np.exp(np.where(self.positive, step, 0.0)), self.centre + step)

    def theta_of(self, name: str, values: Float[np.ndarray, "*values"] | float) -> Float[np.ndarray, "*values"]:
        """θ of one positive parameter at natural values."""
        i = self.names.index(name)
        return np.asarray(np.log(values / self.centre[i]) / self.sd[i])

    def slope(self, values: Float[np.ndarray, " free"]) -> Float[np.ndarray, " free"]:
        """dv/dθ at natural values."""
        return np.where(self.positive, values, 1.0) * self.sd


def _log(value: float) -> float:
    return -np.inf if value <= 0 else float(np.log(value))


def _generic(name: str) -> Parameter:
    return Parameter(name, name, "", 1.0, 0.0, np.inf, 1.0, True, "", "a user's own", 0.0, np.inf)


def _both_or_none(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where only one bound is finite the other is set 20 prior standard deviations beyond the centre."""
    some = np.isfinite(low) | np.isfinite(high)
    low = np.where(some & ~np.isfinite(low), -20.0, low)
    high = np.where(some & ~np.isfinite(high), 20.0, high)
    return np.where(some, low, -np.inf), np.where(some, high, np.inf)


def welch_operator(
    settings: SpectrumSettings, samples: int, window: tuple[float, float]
) -> Float[np.ndarray, "parts samples"]:
    """The linear part of `spectrum_of` as one matrix.

    Low-pass, window, detrending, taper and transform are linear, so a Welch power is `Σ (A x)²` over the rows of its
    bin; the rows are ordered (segments and real/imaginary part, bins), scaled so that the sum is the power itself.
    """
    x = np.eye(samples)
    if settings.sections is not None:
        both = settings.filter_direction == "both"
        low_pass: Any = scipy.signal.sosfiltfilt if both else scipy.signal.sosfilt
        x = np.asarray(low_pass(settings.sections, x))
    x = x[:, round(window[0] * settings.rate) : round(window[1] * settings.rate)]
    count, n = settings.segments(x.shape[1]), settings.length
    if count < 1:
        raise ValueError(f"window {window} s is shorter than one segment of {n} samples at {settings.rate} Hz")
    parts = []
    bins = np.arange(settings.first_bin, settings.last_bin + 1)
    doubled = np.where((bins == 0) | (2 * bins == n), 1.0, 2.0)
    scale = np.sqrt(doubled / (settings.rate * np.sum(settings.taper**2) * count))
    for k in range(count):
        segment = x[:, k * settings.step : k * settings.step + n]
        if settings.detrend != "none":
            segment = scipy.signal.detrend(segment, type=settings.detrend)
        transform = np.fft.rfft(np.asarray(segment) * settings.taper)[:, bins] * scale
        parts += [transform.real.T, transform.imag.T]
    return np.concatenate(parts)


class Linear(eqx.Module):
    """The expected spectrum of a task in linear response, times a `correction` (of a nonlinear simulation, say).

    Its variance is that of a recording of so many `samples`.
    """

    chosen: np.ndarray
    correction: Moments
    samples: Int[Array | np.ndarray, ""]
    window: tuple[float, float] = eqx.field(static=True)

    def moments(self, task: AbstractTask) -> Moments:
        """Expected moments of the task's output."""
        found = expected_moments(task, task.settings, self.window, self.samples)[
            0
        ]  # compiled apart, so that it is traced once
        found = found._replace(power=found.power[self.chosen], line=found.line[self.chosen])
        return jax.tree.map(jnp.multiply, found, self.correction)


class MonteCarlo(eqx.Module):
    """Mean spectrum of a task over fixed noise paths (common random numbers).

    `noise` holds normals, or unit paths when no free parameter changes them. With `control` the task starts settled and
    the linearised task runs on the same paths as control variate. Without it the first entry of `noise` is zero, which
    gives the harmonic's own response; that is taken off every seed before the spectrum and its power added after: the
    cross term between line and noise has expectation zero, yet for fixed paths it makes the cost ripple with the frequency.
    """

    noise: Any
    operator: Float[Array, "parts samples"]
    chosen: np.ndarray
    samples: Int[Array | np.ndarray, ""]
    grid: Grid
    window: tuple[float, float] = eqx.field(static=True)
    control: bool = eqx.field(static=True)

    @classmethod
    def of(cls, task: AbstractTask, normals: Any, grid: Grid, chosen: np.ndarray, window: tuple[float, float], *,
           colour_free: bool, control: bool, samples: int | None = None) -> "MonteCarlo":  # fmt: skip
        """Prepare for the task's settings; `chosen` are the positions of the compared bins among the settings' bins.

        With a control variate the variance is that of a recording of so many `samples`, by default as many as simulated.
        """
        if not control:
            normals = jnp.concatenate([jnp.zeros_like(normals[:1]), normals])
        noise = normals if colour_free else jax.jit(jax.vmap(lambda z: task.noise.realise(z, grid.dt)))(normals)
        operator = welch_operator(task.settings, grid.steps // grid.every + 1, window)
        samples = samples_in(window, task.settings) if samples is None else samples
        return cls(noise, jnp.asarray(operator), chosen, jnp.asarray(samples), grid, window, control)

    @property
    def seeds(self) -> int:
        """How many noise paths there are."""
        return jax.tree.leaves(self.noise)[0].shape[0] - (not self.control)

    def moments(self, task: AbstractTask) -> Moments:
        """Moments of the task's output."""
        settings = task.settings
        start, stop = (round(edge * settings.rate) for edge in self.window)

        def outputs(task):
            def one(entry):
                path = entry if isinstance(entry, Realisation) else task.noise.realise(entry, self.grid.dt)
                return respond(task, path, self.grid, settings.sampling)[1]

            return jax.vmap(one)(self.noise)

        task = settled(task) if self.control else task

        def swing(seen):
            return jnp.var(lowpass(seen, settings)[..., start:stop], axis=-1)

        seen = outputs(task)
        mean = jnp.mean(seen[int(not self.control) :, start:stop])
        if self.control:
            exact, system = response(task, settings, self.window, self.samples)
            beside = outputs(LinearTask.of(task, system))
            power = exact.power[self.chosen] + jnp.mean(self._power(seen, settings) - self._power(beside, settings), 0)
            spread = jnp.mean(swing(seen) - swing(beside))
            return Moments(power, exact.line[self.chosen], mean, exact.variance + spread)
        quiet, noisy = seen[:1], seen[1:] - seen[:1]
        line, random = jnp.mean(self._power(quiet, settings), 0), jnp.mean(self._power(noisy, settings), 0)
        variance = swing(quiet[0]) + jnp.mean(swing(noisy))
        return Moments(line + random, line, mean, variance)

    def _power(self, outputs: Float[Array, "seeds samples"], settings: SpectrumSettings) -> Float[Array, "seeds bins"]:
        bins = settings.last_bin - settings.first_bin + 1
        parts = (outputs @ self.operator.T).reshape(len(outputs), -1, bins)
        return jnp.sum(parts**2, axis=1)[:, self.chosen]


def at(task: AbstractTask, coordinates: Coordinates, theta: Float[Array, " free"]) -> AbstractTask:
    """The task at coordinates θ."""
    return set_parameters(task, coordinates.values(theta))
