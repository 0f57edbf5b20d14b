"""The problem of a fit: its targets with their tasks, the coordinates that they share, and the
residuals that follow."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmuscle._common.arrays import all_concrete, as_arrays, as_numbers, is_concrete
from jaxmuscle.data._target import Target
from jaxmuscle.data._target_data import longest
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._equilibrium import fastest_rate
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._expected_moments import variation_sd
from jaxmuscle.response._linearised import has_response
from jaxmuscle.simulation._grid import Grid
from jaxmuscle.simulation._simulate import DURATION, MAX_RATE_STEP, steps_per_sample
from jaxmuscle.spectra._bin_law import (
    bin_statistics,
    mean_error,
    recorded_interval,
    samples_of,
    trial_samples,
)
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings

from ._coordinates import Coordinates, task_at
from ._moment_models import Linear, MonteCarlo
from ._residuals import Data, PartResiduals, Residuals

MOST_SUBSTEPS = 16


def target_variation(target: Target, task: AbstractTask | None = None) -> tuple[Any, Any] | None:
    """Log coefficient of variation of a target and its standard deviation.

    With a task and where the target states its segments: `variation_under` it. Else half the
    relative error of the power in the bins, `½ √(pᵀ V p)` with V the covariance of the log powers,
    which is too much where power lies elsewhere or in a harmonic. The `mean_error` of several
    trials where their scatter is larger.
    """
    values = target.coefficient_of_variation
    if values is None:
        return None
    logs = np.log(np.asarray(values))
    if task is not None and target.segments is not None:
        samples = np.array([samples_of(count, target.settings) for count in target.segments])
        mean, sd = variation_under(
            task, target.settings, logs, samples, longest(int(samples.max()))
        )
        return mean, float(sd) if is_concrete(sd) else sd
    p = np.asarray(target.proportional_power)
    sd = mean_error(logs, 0.5 * np.sqrt(p @ bin_statistics(target).covariance @ p))
    return float(logs.mean()), float(sd)


def variation_under(
    task: AbstractTask,
    settings: SpectrumSettings,
    logs: Float[Array | np.ndarray, " values"],
    samples: Int[Array | np.ndarray, " trials"],
    most: int,
) -> tuple[Any, Any]:
    """Mean of log coefficients of variation, and the standard deviation that it has under a task:
    `variation_sd` of trials with so many samples, at `most` of the number that their program
    has.

    The `mean_error` of several trials where their scatter is larger.
    """
    if all_concrete((task, samples)):
        known = {n: float(variation_sd(task, settings, n, most)) for n in set(samples.tolist())}
        each = np.array([known[int(n)] for n in samples])
        expected = np.sqrt(np.sum(each**2)) / len(samples)
    else:
        each = jax.vmap(lambda n: variation_sd(task, settings, n, most))(samples)
        expected = jnp.sqrt(jnp.sum(each**2)) / len(samples)
    return (np if is_concrete(logs) else jnp).mean(logs), mean_error(logs, expected)


@dataclasses.dataclass(frozen=True)
class Part:
    """One target of a fit: its task, the task's free coordinates, and which `columns` of the fit's
    coordinates they are.

    `variation` and `mean`: (log) coefficient of variation and mean with their standard deviations,
    None where not fitted.
    """

    name: str
    task: AbstractTask
    target: Target
    coordinates: Coordinates
    columns: tuple[int, ...]
    variation: tuple[Any, Any] | None
    mean: tuple[Any, Any] | None

    @property
    def chosen(self) -> np.ndarray:
        """Positions of the target's bins among those of its settings."""
        return self.target.bins - self.target.settings.first_bin

    def own(self, theta: Float[np.ndarray, "*rows free"]) -> Float[np.ndarray, "*rows own"]:
        """Its own coordinates among those of the fit."""
        return theta[..., np.array(self.columns, dtype=int)]

    def task_at(self, theta: Float[np.ndarray, " free"]) -> AbstractTask:
        """Its task at the fit's coordinates θ."""
        return as_numbers(task_at(self.task, self.coordinates, self.own(theta)))

    def theta_of(self, task: AbstractTask) -> Float[np.ndarray, " own"]:
        """Its coordinates of a task's values."""
        return self.coordinates.at(np.array([float(task[name]) for name in self.coordinates.names]))

    def scattering_as(self, task: AbstractTask) -> "Part":
        """The part with a coefficient of variation that scatters as that of this task does."""
        if self.variation is None or not has_response(task, required=False):
            return self
        return dataclasses.replace(self, variation=target_variation(self.target, task))

    @property
    def points(self) -> Float[np.ndarray, " points"] | None:
        """Frequencies of the target's dynamic stiffness [Hz]."""
        return (
            None
            if self.target.stiffness is None
            else np.asarray(self.target.stiffness.known.frequency)
        )

    @property
    def ones(self) -> Moments:
        """The correction of moments that changes nothing."""
        ones, one = np.ones(len(self.chosen)), np.ones(())
        resonant = tuple(
            ones for noise in self.task.noise.components if isinstance(noise, ResonantNoise)
        )
        stiffness = () if self.points is None else np.ones((2, len(self.points)))
        return Moments(ones, ones, one, one, resonant, stiffness)

    def linear(
        self, share: np.ndarray | None = None, correction: Moments | None = None
    ) -> PartResiduals:
        """Its residuals in linear response, times a correction of its moments."""
        return self.residuals(self.expected(correction), share)

    def expected(self, correction: Moments | None = None) -> Linear:
        """The model of its moments in linear response, times a correction."""
        known: Moments = jax.tree.map(np.asarray, self.ones if correction is None else correction)
        recorded = recorded_interval(self.target, self.target.settings)
        samples, recorded = np.asarray(trial_samples(self.target)), np.asarray(recorded)
        return Linear(self.chosen, known, samples, WINDOW, self.points, recorded)

    def residuals(self, model: Linear | MonteCarlo, share: np.ndarray | None) -> PartResiduals:
        """Its residuals with a model of its moments; `share` is what a line holds of each bin."""
        statistics = bin_statistics(self.target, share)
        measured, stiffness = self.target.stiffness, None
        if measured is not None:
            known = measured.known
            stiffness = np.stack([np.real(known.value), np.imag(known.value)]), known.stderr
        spectrum = self.target.proportional_power, statistics.bias, statistics.sd
        data = Data(*spectrum, self.variation, self.mean, stiffness)
        given = as_arrays({"data": data, "statistics": statistics})
        return PartResiduals(as_arrays(self.task), self.coordinates, model, **given)


@dataclasses.dataclass(frozen=True)
class FitProblem:
    """What a fit is about, its arguments checked: one target, or several of one person with what
    they share.

    `prior` is the precision of every θ by itself (1, or 0 where it is flat); `damping`, a row for
    each muscle whose damping ratio has a prior, too (`damping_row`). `control`: whether all tasks
    have a linear response.
    """

    parts: tuple[Part, ...]
    coordinates: Coordinates
    prior: np.ndarray
    method: str
    dt: float
    key: Any
    seeds: int
    control: bool
    tell: Callable[[str, float], None]
    damping: tuple[Float[np.ndarray, " free"], ...] = ()

    @property
    def precision(self) -> Float[np.ndarray, "free free"]:
        """That of the prior of all θ, Λ: its density is exp(-½ θᵀ Λ θ)."""
        return np.diag(self.prior) + sum(np.outer(row, row) for row in self.damping)

    @property
    def prior_root(self) -> Float[np.ndarray, "free free"]:
        """The symmetric root of the precision: the residuals of the prior are this times θ."""
        values, vectors = np.linalg.eigh(self.precision)
        return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T

    @classmethod
    def shared(
        cls, problems: "Mapping[str, FitProblem]", names: Mapping[str, Mapping[str, str]]
    ) -> "FitProblem":
        """From the problems of the targets alone and the joint name of each one's parameters, as
        `joint_names` gives them.

        A coordinate that is shared is that of the first target: θ = 0 is the task's own value in
        every one.
        """
        places: dict[str, tuple[FitProblem, int]] = {}
        for target, problem in problems.items():
            for i, name in enumerate(problem.coordinates.names):
                places.setdefault(names[target][name], (problem, i))
        order = {name: i for i, name in enumerate(places)}

        def gathered(field: str) -> np.ndarray:
            return np.array(
                [getattr(problem.coordinates, field)[i] for problem, i in places.values()]
            )

        fields = (gathered(field) for field in ("centre", "sd", "positive", "low", "high"))
        parts = tuple(
            dataclasses.replace(
                p.parts[0], name=t, columns=tuple(order[names[t][n]] for n in p.coordinates.names)
            )
            for t, p in problems.items()
        )
        prior = np.array([problem.prior[i] for problem, i in places.values()])
        rows: dict[tuple[int, ...], np.ndarray] = {}  # a muscle that targets share counts once
        for problem, part in zip(problems.values(), parts, strict=True):
            for own in problem.damping:
                row = np.zeros(len(places))
                row[list(part.columns)] = own
                rows.setdefault(tuple(map(int, np.flatnonzero(row))), row)
        first = next(iter(problems.values()))
        return dataclasses.replace(
            first,
            parts=parts,
            coordinates=Coordinates(tuple(places), *fields),
            prior=prior,
            damping=tuple(rows.values()),
        )

    @property
    def finest(self) -> Target:
        """The target whose bins are narrowest."""
        return min(
            (part.target for part in self.parts), key=lambda target: target.settings.resolution
        )

    @property
    def title(self) -> str:
        """Names of the targets."""
        return ", ".join(part.target.name for part in self.parts)

    @property
    def steps_per_sample(self) -> int:
        """Steps of the noise grid per sampling interval. Raises `ValueError` if dt does not fit
        it."""
        settings = self.parts[0].target.settings
        return steps_per_sample(settings.rate, self.dt, settings.sampling)

    def tasks_at(self, theta: Float[np.ndarray, " free"]) -> tuple[AbstractTask, ...]:
        """Every target's task with the values that θ stands for."""
        return tuple(part.task_at(theta) for part in self.parts)

    def theta_of(self, tasks: Sequence[AbstractTask]) -> Float[np.ndarray, " free"]:
        """Coordinates of the tasks' values; of what is shared, that of the first that has it."""
        theta = np.zeros(len(self.coordinates.names))
        for part, task in reversed(list(zip(self.parts, tasks, strict=True))):
            theta[list(part.columns)] = part.theta_of(task)
        return theta

    def acting(self, name: str) -> tuple[Part, ...]:
        """The parts that a free parameter belongs to."""
        column = self.coordinates.names.index(name)
        return tuple(part for part in self.parts if column in part.columns)

    def where(self, name: str) -> tuple[int, str]:
        """Which part a quantity "name@part" is of, and its name there; of one that belongs to all,
        the first."""
        base, _, target = name.partition("@")
        names = [part.name for part in self.parts]
        return (names.index(target) if target else 0), base

    def by_name(self, tables: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """A table of each part as one: with several parts, names become "name@part"."""
        if len(self.parts) == 1:
            return dict(tables[0])
        return {
            f"{n}@{part.name}": x
            for part, table in zip(self.parts, tables, strict=True)
            for n, x in table.items()
        }

    def scattering_as(self, tasks: Sequence[AbstractTask]) -> "FitProblem":
        """The problem with coefficients of variation that scatter as those of these tasks do."""
        parts = tuple(
            part.scattering_as(task) for part, task in zip(self.parts, tasks, strict=True)
        )
        return dataclasses.replace(self, parts=parts)

    def linear(
        self,
        shares: Sequence[np.ndarray | None] | None = None,
        corrections: Sequence[Moments | None] | None = None,
    ) -> Residuals:
        """Its residuals in linear response; of each part the line's share of the bins and a
        correction, if known."""
        none = [None] * len(self.parts)
        given = zip(self.parts, shares or none, corrections or none, strict=True)
        return self._residuals(part.linear(share, correction) for part, share, correction in given)

    def montecarlo(self, seeds: int, shares: Sequence[np.ndarray] | None = None) -> Residuals:
        """Its residuals on the first `seeds` noise paths."""
        given = zip(self.parts, shares or [None] * len(self.parts), strict=True)
        return self._residuals(
            part.residuals(self._paths(part, seeds), share) for part, share in given
        )

    def _residuals(self, parts: Any) -> Residuals:
        free = as_arrays({"prior_root": self.prior_root, "moving": np.ones(len(self.prior))})
        return Residuals(
            tuple(parts),
            self.coordinates,
            **free,
            columns=tuple(part.columns for part in self.parts),
        )

    def _paths(self, part: Part, seeds: int) -> MonteCarlo:
        settings, every = part.target.settings, self.steps_per_sample
        part.task.check_step(self.dt)
        grid = Grid(self.dt, every * round(DURATION * settings.rate), every, 1, reverse=False)
        key = jax.random.fold_in(self.key, 0)
        return MonteCarlo.of(part.expected(), settings, key, seeds, grid, control=self.control)

    def finer(self, objective: Residuals, points: Float[np.ndarray, "points free"]) -> Residuals:
        """The residuals with as many sub-steps as the stiffest of the points asks for; never fewer
        than they have."""
        if objective.linear:
            return objective
        theta = np.asarray(self.coordinates.theta(points))
        for i, part in enumerate(self.parts):
            rates = [_rate(part, row) for row in theta]
            fastest = max((rate for rate in rates if np.isfinite(rate)), default=0.0)
            needed = min(
                2 ** int(np.ceil(np.log2(max(fastest * self.dt / MAX_RATE_STEP, 1.0)))),
                MOST_SUBSTEPS,
            )
            model = objective.parts[i].model
            assert isinstance(model, MonteCarlo)
            grid = model.grid
            if needed > grid.substeps:
                grid = Grid(grid.dt, grid.steps, grid.every, needed, reverse=False)
                objective = eqx.tree_at(
                    lambda o, i=i: o.parts[i].model.grid,
                    objective,
                    grid,
                    is_leaf=lambda x: isinstance(x, Grid),
                )
        return objective


def _rate(part: Part, theta: Float[np.ndarray, " free"]) -> float:
    try:
        return fastest_rate(
            task_at(as_arrays(part.task), part.coordinates, jnp.asarray(part.own(theta))), DURATION
        )
    except ValueError:
        return np.nan
