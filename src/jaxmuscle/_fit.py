"""Fit of a task's parameters to a target spectrum, by Monte Carlo with common random numbers."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from ._bundled import choices
from ._descend import Descent, descend
from ._law import Scalar
from ._noise import AbstractNoise, BandLimitedNoise, OrnsteinUhlenbeckNoise, WhiteNoise
from ._objective import Coordinates, Moments, MonteCarlo, at
from ._operating import fastest_rate
from ._parameter import CHANNELS, DEFAULT_FREE, PARAMETERS, as_arrays, as_numbers
from ._path import Grid
from ._report import report_fit
from ._result import FitResult
from ._simulate import DURATION, MAX_RATE_STEP, draw, whole
from ._starts import contenders, starting_points
from ._target import Target
from ._task import AbstractTask, Isometric, PrescribedForce
from ._trajectory import WINDOW
from ._uncertainty import BinStatistics, bin_statistics, shares_map, target_variation

RESIDUALS = ("log", "linear", "cumulative")
NOISES: dict[str, type[AbstractNoise]] = {
    "white": WhiteNoise,
    "band-limited": BandLimitedNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckNoise,
}
DT = 2.5e-3
FIRST_STEPS = 12
MOST_RIVALS = 3
RIVAL_MARGIN = 6.0
MOST_SUBSTEPS = 16


class FitInterrupted(KeyboardInterrupt):
    """A fit was interrupted; `result` holds what had been reached."""

    def __init__(self, result: FitResult):
        super().__init__("fit interrupted")
        self.result = result


def task_for(target: Target, *, noise: str | AbstractNoise | None = None) -> AbstractTask:
    """The task that a target measured: `Isometric` for force and torque, `PrescribedForce` for displacement.

    It has the target's spectrum settings and default parameters; `noise` is a name of `NOISES` or a noise object.
    """
    kind = PrescribedForce if target.quantity == "displacement" else Isometric
    return with_noise(kind(settings=target.settings), noise)


def with_noise(
    task: AbstractTask, noise: str | AbstractNoise | None, fix: Mapping[str, float] | None = None
) -> AbstractTask:
    """The task with another noise, at its default amplitudes except those that `fix` names."""
    if noise is None:
        return task
    if isinstance(noise, AbstractNoise):
        return task.with_parts(noise=noise)
    if noise not in NOISES:
        raise ValueError(f"noise = {noise!r}: {choices(noise, NOISES)}")
    kind: Any = NOISES[noise]
    made = kind().per_channel()
    values = {f"noise_{c}": float(made.amplitude[i]) for i, c in enumerate(CHANNELS)} | dict(fix or {})
    fixed = [values[f"noise_{c}"] for c in CHANNELS]
    return task.with_parts(noise=eqx.tree_at(lambda n: n.amplitude, made, np.array(fixed)))


class Problem(eqx.Module):
    """Everything that the residuals of a fit depend on besides the free coordinates."""

    task: AbstractTask
    coordinates: Coordinates
    model: MonteCarlo
    target: Float[Array, " bins"]
    statistics: BinStatistics
    sigma: Float[Array, " bins"]
    prior: Float[Array, " free"]
    extra: tuple[tuple[Scalar, Scalar] | None, tuple[Scalar, Scalar] | None]
    residual: str = eqx.field(static=True)

    def moments(self, theta: Float[Array, " free"]) -> Moments:
        """Moments of the model at θ."""
        return self.model.moments(at(self.task, self.coordinates, theta))

    def data_residuals(self, moments: Moments) -> Float[Array, " residuals"]:
        """Residuals in standard deviations of the data: spectrum, then coefficient of variation and mean force."""
        rows = [self._spectrum_residuals(moments)]
        variation, mean = self.extra
        if variation is not None:
            rows.append((jnp.log(moments.variation) - variation[0])[None] / variation[1])
        if mean is not None:
            rows.append((moments.mean - mean[0])[None] / mean[1])
        return jnp.concatenate(rows)

    def _spectrum_residuals(self, moments: Moments) -> Float[Array, " bins"]:
        if self.residual == "log":
            z = jnp.log(self.target) - self.statistics.bias - jnp.log(moments.power)
            return (z - jnp.mean(z)) / self.statistics.sd
        difference = self.target - moments.proportional
        if self.residual == "linear":
            return difference / self.sigma
        return jnp.cumsum(difference)[:-1] / self.sigma[:-1]

    def residuals(self, s: Float[Array, " free"]) -> Float[Array, " all"]:
        """Data residuals, then those of the prior."""
        theta = self.coordinates.theta(s)
        return jnp.concatenate([self.data_residuals(self.moments(theta)), jnp.sqrt(self.prior) * theta])


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


def fit(
    task: AbstractTask,
    target: Target,
    *,
    free: Iterable[str] | None = None,
    fix: Mapping[str, float] | None = None,
    noise: str | AbstractNoise | None = None,
    method: str = "montecarlo",
    residual: str = "log",
    starts: int = 8,
    seeds: int = 48,
    key: PRNGKeyArray | int = 0,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, float | None] | None = None,
    coefficient_of_variation: bool = True,
    mean_force: tuple[float, float] | None = None,
    max_steps: int = 40,
    dt: float = DT,
    check_seeds: int = 200,
    progress: bool | Callable[[str, float], None] = False,
) -> FitResult:
    """Find the parameters whose expected spectrum is the target's: Levenberg-Marquardt from several starts.

    Minimises `½ Σ r_k² + ½ Σ θ_j²`, r the residuals in standard deviations of the target (log residual:
    `(z_k - z̄) / sd_k`, `z_k = ln(target_k / fitted_k) - bias_k`), θ the free parameters' distance from the task's own
    values in standard deviations of the prior. The model's spectrum is a mean over `seeds` noise paths that stay the
    same throughout (common random numbers); the reported spectrum and errors come from `check_seeds` fresh ones.

    **Arguments:** `task` (its values are the prior's centre; `task_for(target)` makes one) and `target`, whose spectrum
    settings replace the task's; `free`, names to fit (default: `DEFAULT_FREE`, those of them that the task has);
    `fix`, values to set, which are then not free; `noise`, a name or an object; `residual`, "log", "linear" or
    "cumulative"; `starts`; `seeds`; `key`, a `jax.random` key or a seed number; `bounds` {name: (low, high)};
    `priors` {name: sd in log, or None for a flat one}; `coefficient_of_variation`, whether the target's, if it states
    one, is one more residual (it fixes the scale of the noise); `mean_force` (value, sd) [N] as a further residual;
    `max_steps` for the last descent; `dt` [s], noise grid of the fit; `progress`, True or a function of (text, share).

    **Returns:** a `FitResult`; a fit that fails is one, too, and says why.

    **Raises:** `ValueError` for bad arguments (unknown names with the nearest known, too few bins, values outside
    bounds); `FitInterrupted` on Ctrl-C, with what was reached.
    """
    if method != "montecarlo":
        raise ValueError(f"method = {method!r}: this version fits by 'montecarlo'")
    if residual not in RESIDUALS:
        raise ValueError(f"residual = {residual!r}: {choices(residual, RESIDUALS)}")
    for name, count in (("starts", starts), ("seeds", seeds), ("check_seeds", check_seeds), ("max_steps", max_steps)):
        if count < 1:
            raise ValueError(f"{name} = {count} must be at least 1")
    task = with_noise(task, noise, fix).with_parts(settings=target.settings).replace(**(fix or {}))
    task = as_numbers(task)
    names = free_names(task, free, fix or {}, len(target.bins))
    sds = {n: (priors or {}).get(n, PARAMETERS[n].prior_sd if n in PARAMETERS else 1.0) for n in names}
    _check_names("priors", priors or {}, names)
    _check_names("bounds", bounds or {}, names)
    seed = key if isinstance(key, int) else None
    tell = _teller(progress)
    settings = {
        "free": list(names), "residual": residual, "starts": starts, "seeds": seeds, "dt": dt, "max_steps": max_steps,
        "check_seeds": check_seeds, "prior_sd": sds, "bounds": {n: list(b) for n, b in (bounds or {}).items()},
        "coefficient_of_variation": coefficient_of_variation and target.coefficient_of_variation is not None,
        "mean_force": None if mean_force is None else list(mean_force), "spectrum": target.settings.to_dict(),
    }  # fmt: skip
    with jax.enable_x64(True):
        key = jax.random.key(key) if isinstance(key, int) else key
        values = {name: float(task[name]) for name in names}
        coordinates = Coordinates.of(values, dict(bounds or {}), {n: sd or 1.0 for n, sd in sds.items()})
        prior = np.array([0.0 if sds[n] is None else 1.0 for n in names])
        extra = (target_variation(target) if coefficient_of_variation else None, mean_force)
        setup = _Setup(task, target, coordinates, prior, extra, residual, dt, key, seeds, tell)
        return _search(setup, starts, max_steps, check_seeds, settings, seed)


@dataclasses.dataclass(frozen=True)
class _Setup:
    """The arguments of a fit, checked; makes the problem for a number of seeds."""

    task: AbstractTask
    target: Target
    coordinates: Coordinates
    prior: np.ndarray
    extra: tuple
    residual: str
    dt: float
    key: Any
    seeds: int
    tell: Callable[[str, float], None]

    def problem(self, seeds: int, line_share: np.ndarray | None = None) -> Problem:
        """The problem on the first `seeds` noise paths."""
        task, settings = as_arrays(self.task), self.target.settings
        every = whole(1 / (settings.rate * self.dt), f"dt = {self.dt} s does not divide the sampling interval "
                      f"{1 / settings.rate} s")  # fmt: skip
        self.task.noise.check_step(self.dt)
        grid = Grid(self.dt, every * round(DURATION * settings.rate), every, 1, reverse=False)
        normals = draw(task.noise, jax.random.fold_in(self.key, 0), jnp.arange(seeds), grid.steps)
        colour = any(name in ("noise_cutoff", "noise_correlation_time") for name in self.coordinates.names)
        chosen = self.target.bins - settings.first_bin
        model = MonteCarlo.of(task, normals, grid, chosen, WINDOW, colour_free=colour)
        statistics = bin_statistics(self.target, line_share)
        sigma = residual_sigma(self.residual, self.target, statistics)
        power = jnp.asarray(self.target.proportional_power)
        prior, extra = jnp.asarray(self.prior), jax.tree.map(jnp.asarray, self.extra)
        return Problem(task, self.coordinates, model, power, statistics, jnp.asarray(sigma), prior, extra, self.residual)

    def finer(self, problem: Problem, points: np.ndarray) -> Problem:
        """The problem with as many sub-steps as the stiffest of the points asks for; never fewer than it has."""
        fastest = 0.0
        for s in points:
            theta = np.asarray(self.coordinates.theta(jnp.asarray(s)))
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


def _search(setup: _Setup, starts: int, max_steps: int, check_seeds: int, settings: dict, seed: int | None) -> FitResult:
    """Many starts on few seeds, then the best few minima on all; whatever was reached when interrupted."""
    points = starting_points(setup.coordinates, setup.target, starts)
    reached: list[Descent] = []
    problem, interrupted = None, False

    def report(stage, low, high, most):
        def show(descent):
            reached[stage:] = [descent]
            share = low + (high - low) * min(1.0, descent.steps.max() / most)
            setup.tell(f"{'trying starts' if stage == 0 else 'polishing'}, cost {descent.cost[descent.best]:.2f}", share)

        return show

    try:
        problem = setup.problem(max(8, setup.seeds // 3))
        setup.tell("compiling", 0.0)
        first = descend(problem, points, FIRST_STEPS, prepare=setup.finer, report=report(0, 0.05, 0.5, FIRST_STEPS))
        chosen = contenders(setup.coordinates, setup.target, first, RIVAL_MARGIN)[:MOST_RIVALS]
        points = first.s[chosen]
        share = np.nan_to_num(np.asarray(_share(problem, jnp.asarray(points[0]))))
        problem = setup.finer(setup.problem(setup.seeds, share), points)
        descend(problem, points, max_steps, prepare=setup.finer, report=report(1, 0.5, 0.9, 15))
    except KeyboardInterrupt:
        interrupted = True
    if problem is None or not reached:
        raise KeyboardInterrupt("fit interrupted before its first step")
    setup.tell("checking on fresh seeds", 0.9)
    result = report_fit(setup, problem, reached, check_seeds, settings, seed, max_steps, interrupted=interrupted)
    setup.tell("done", 1.0)
    if interrupted:
        raise FitInterrupted(result)
    return result


@eqx.filter_jit
def _share(problem: Problem, s: Float[Array, " free"]) -> Float[Array, " bins"]:
    moments = problem.moments(problem.coordinates.theta(s))
    return jnp.clip(moments.line / moments.power, 0.0, 1.0)


def free_names(task: AbstractTask, free: Iterable[str] | None, fix: Mapping[str, float], bins: int) -> tuple[str, ...]:
    """The parameters to fit, checked against the task, the fixed ones and the number of bins."""
    known = task.parameter_names
    if free is None:
        wanted = [*DEFAULT_FREE, "noise_correlation_time"]
        names = [n for n in wanted if n in known and n not in fix and float(task[n]) > 0]
    else:
        names = list(dict.fromkeys(free))
        _check_names("free", names, known)
        both = sorted(set(names) & set(fix))
        if both:
            raise ValueError(f"{', '.join(both)} cannot be both free and fixed")
    if not names:
        raise ValueError("no parameter is free: name at least one in free")
    if bins < len(names):
        raise ValueError(f"{bins} bins cannot determine {len(names)} free parameters ({', '.join(names)}): fix some")
    return tuple(names)


def _check_names(argument: str, names: Iterable[str], known: Iterable[str]) -> None:
    known = list(known)
    for name in names:
        if name not in known:
            raise ValueError(f"{argument}: unknown or not free parameter {name!r}: {choices(name, known)}")


def _teller(progress: bool | Callable[[str, float], None]) -> Callable[[str, float], None]:
    if callable(progress):
        return progress
    if not progress:
        return lambda text, share: None
    return lambda text, share: print(f"{100 * share:3.0f} %  {text}", flush=True)
