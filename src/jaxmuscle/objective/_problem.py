"""The data of a fit and its residuals; the checked arguments that make it."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays, is_concrete
from jaxmuscle._common.types import Scalar
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._equilibrium import fastest_rate
from jaxmuscle.response._expected import Moments, log_variation_sd
from jaxmuscle.response._linearised import has_response
from jaxmuscle.simulation._batch import draw
from jaxmuscle.simulation._integrator import Grid
from jaxmuscle.simulation._simulate import DURATION, MAX_RATE_STEP, whole
from jaxmuscle.spectra._bin_law import BinStatistics, bin_statistics, samples_of, shares_map, trial_samples
from jaxmuscle.spectra._settings import WINDOW

from ._coordinates import Coordinates, at
from ._moment_models import Linear, MonteCarlo


def target_variation(target: Target, task: AbstractTask | None = None) -> tuple[Any, Any] | None:
    """Log coefficient of variation of a target and its standard deviation.

    With a task and where the target states its segments: `log_variation_sd` of recordings that give so many. Else half the
    relative error of the power in the bins, `½ √(pᵀ V p)` with V the covariance of the log powers, which is too much where
    power lies elsewhere or in a harmonic. The standard error over trials where there are several and it is larger.
    """
    values = target.coefficient_of_variation
    if values is None:
        return None
    logs = np.log(np.asarray(values))
    p = np.asarray(target.proportional_power)
    sd: Any = 0.5 * np.sqrt(p @ bin_statistics(target).covariance @ p)
    if task is not None and target.segments is not None:
        settings, counts, arrays = target.settings, target.segments, as_arrays(task)
        each = {k: log_variation_sd(arrays, settings, samples_of(k, settings)) for k in set(counts)}
        sd = sum(each[k] ** 2 for k in counts) ** 0.5 / len(counts)
    if len(logs) > 1:
        sd = jnp.maximum(sd, logs.std(ddof=1) / np.sqrt(len(logs)))
    return float(logs.mean()), float(sd) if is_concrete(sd) else sd


MOST_SUBSTEPS = 16


class Data(eqx.Module):
    """What a fit knows of its target: powers, their spread, further residuals. The model does not depend on it."""

    target: Float[Array | np.ndarray, "*rows bins"]
    bias: Float[Array | np.ndarray, "*rows bins"]
    sd: Float[Array | np.ndarray, "*rows bins"]
    sigma: Float[Array | np.ndarray, "*rows bins"]
    extra: tuple[tuple[Scalar, Scalar] | None, tuple[Scalar, Scalar] | None]


class Problem(eqx.Module):
    """Everything that the residuals of a fit depend on besides the free coordinates."""

    task: AbstractTask
    coordinates: Coordinates
    model: Linear | MonteCarlo
    data: Data
    statistics: BinStatistics
    prior: Float[Array | np.ndarray, " free"]
    moving: Float[Array | np.ndarray, " free"]
    residual: str = eqx.field(static=True)

    def theta(self, s: Float[Array | np.ndarray, "*rows free"]) -> Float[Array | np.ndarray, "*rows free"]:
        """Coordinates in prior standard deviations; what is not `moving` (1, else 0) has no slope."""
        if not isinstance(s, np.ndarray):
            s = jnp.where(self.moving > 0, s, jax.lax.stop_gradient(s))
        return self.coordinates.theta(s)

    def moments(self, theta: Float[Array, " free"]) -> Moments:
        """Moments of the model at θ."""
        return self.model.moments(at(self.task, self.coordinates, theta))

    def data_residuals(self, moments: Moments, data: Data) -> Float[Array, " residuals"]:
        """Residuals in standard deviations of the data: spectrum, then coefficient of variation and mean force."""
        rows = [jnp.asarray(self._spectrum_residuals(moments, data))]
        variation, mean = data.extra
        if variation is not None:
            rows.append((jnp.log(moments.variation) - variation[0])[None] / variation[1])
        if mean is not None:
            rows.append((moments.mean - mean[0])[None] / mean[1])
        return jnp.concatenate(rows)

    def _spectrum_residuals(self, moments: Moments, data: Data) -> Float[Array | np.ndarray, " bins"]:
        if self.residual == "log":
            z = jnp.log(data.target) - data.bias - jnp.log(moments.power)
            return (z - jnp.mean(z)) / data.sd
        difference = data.target - moments.proportional
        if self.residual == "linear":
            return difference / data.sigma
        return jnp.cumsum(difference)[:-1] / data.sigma[:-1]

    def residuals(self, theta: Float[Array, " free"], moments: Moments, data: Data) -> Float[Array, " all"]:
        """Data residuals of the moments at θ, then those of the prior."""
        return jnp.concatenate([self.data_residuals(moments, data), jnp.sqrt(self.prior) * theta])


def residual_sigma(kind: str, target: Target, statistics: BinStatistics) -> Float[np.ndarray, " bins"]:
    """What the linear and the cumulative residual are divided by: standard deviations of p_k or of its running sum."""
    p = target.proportional_power
    if kind == "linear" and target.sigma is not None and target.segments is None:
        return np.asarray(target.sigma)
    spread = shares_map(p) @ statistics.covariance @ shares_map(p).T
    if kind == "cumulative":
        summed = np.tril(np.ones((len(p), len(p))))
        spread = summed @ spread @ summed.T
    return np.sqrt(np.maximum(np.diag(spread), 1e-300))


@dataclasses.dataclass(frozen=True)
class Setup:
    """The arguments of a fit, checked; makes the problem for a number of seeds."""

    task: AbstractTask
    target: Target
    coordinates: Coordinates
    prior: np.ndarray
    extra: tuple
    residual: str
    method: str
    dt: float
    key: Any
    seeds: int
    control: bool
    tell: Callable[[str, float], None]

    @property
    def steps_per_sample(self) -> int:
        """Steps of the noise grid per sampling interval. Raises `ValueError` if dt does not divide it."""
        interval = 1 / self.target.settings.rate
        return whole(interval / self.dt, f"dt = {self.dt} s does not divide the sampling interval {interval} s")

    def at(self, theta: Float[np.ndarray, " free"]) -> AbstractTask:
        """The task with the values that θ stands for."""
        return self.task.replace(**{name: float(value) for name, value in self.coordinates.values(theta).items()})

    def scattering_as(self, task: AbstractTask) -> "Setup":
        """The setup with a coefficient of variation that scatters as that of this task does."""
        if self.extra[0] is None or not has_response(task, required=False):
            return self
        return dataclasses.replace(self, extra=(target_variation(self.target, task), self.extra[1]))

    def linear(self, line_share: np.ndarray | None = None, correction: Moments | None = None) -> Problem:
        """The problem in linear response, times a correction of its moments."""
        chosen = self.target.bins - self.target.settings.first_bin
        if correction is None:
            ones = np.ones(len(chosen))
            correction = Moments(ones, ones, np.ones(()), np.ones(()))
        samples = jnp.asarray(trial_samples(self.target))
        return self._with_model(Linear(chosen, jax.tree.map(jnp.asarray, correction), samples, WINDOW), line_share)

    def montecarlo(self, seeds: int, line_share: np.ndarray | None = None) -> Problem:
        """The problem on the first `seeds` noise paths."""
        task, settings, every = as_arrays(self.task), self.target.settings, self.steps_per_sample
        self.task.noise.check_step(self.dt)
        grid = Grid(self.dt, every * round(DURATION * settings.rate), every, 1, reverse=False)
        normals = draw(task.noise, jax.random.fold_in(self.key, 0), jnp.arange(seeds), grid.steps)
        colour = any(name in ("noise_cutoff", "noise_correlation_time") for name in self.coordinates.names)
        chosen = self.target.bins - settings.first_bin
        model = MonteCarlo.of(task, normals, grid, chosen, WINDOW, colour_free=colour, control=self.control,
                              samples=trial_samples(self.target))  # fmt: skip
        return self._with_model(model, line_share)

    def _with_model(self, model: Linear | MonteCarlo, line_share: np.ndarray | None) -> Problem:
        statistics = bin_statistics(self.target, line_share)
        sigma = residual_sigma(self.residual, self.target, statistics)
        data = Data(self.target.proportional_power, statistics.bias, statistics.sd, sigma, self.extra)
        given = as_arrays({"data": data, "statistics": statistics, "prior": self.prior, "moving": np.ones(len(self.prior))})
        return Problem(as_arrays(self.task), self.coordinates, model, **given, residual=self.residual)

    def finer(self, problem: Problem, points: np.ndarray) -> Problem:
        """The problem with as many sub-steps as the stiffest of the points asks for; never fewer than it has."""
        if isinstance(problem.model, Linear):
            return problem
        fastest = 0.0
        for s in points:
            theta = np.asarray(self.coordinates.theta(s))
            rate = _rate(problem.task, self.coordinates, theta)
            fastest = max(fastest, rate if np.isfinite(rate) else 0.0)
        needed = 2 ** int(np.ceil(np.log2(max(fastest * self.dt / MAX_RATE_STEP, 1.0))))
        needed = min(needed, MOST_SUBSTEPS)
        grid = problem.model.grid
        if needed <= grid.substeps:
            return problem
        grid = Grid(grid.dt, grid.steps, grid.every, needed, reverse=False)
        return eqx.tree_at(lambda p: p.model.grid, problem, grid, is_leaf=lambda x: isinstance(x, Grid))


def _rate(task: AbstractTask, coordinates: Coordinates, theta: np.ndarray) -> float:
    try:
        return fastest_rate(at(task, coordinates, jnp.asarray(theta)), DURATION)
    except ValueError:
        return np.nan


def theta_of(setup: Setup, task: Any) -> np.ndarray:
    """Coordinates of a task's values."""
    c = setup.coordinates
    values = np.array([float(task[name]) for name in c.names])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(c.positive, np.log(values / c.centre), values - c.centre) / c.sd
