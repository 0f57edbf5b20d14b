"""How an ensemble is cut into chunks."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Int, PRNGKeyArray

from jaxmuscle.model._stream import Draws
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._linear_task import LinearTask
from jaxmuscle.simulation._batch import LANES, THREADED, Recipe, local_mesh, threads_of
from jaxmuscle.simulation._simulate import Schedule, companion, schedule
from jaxmuscle.spectra._settings import WINDOW

from ._sweep import Sweep

BLOCKS = 4
STEPS_AT_ONCE = 4_000_000
# Of a GPU, which hides its latency by many lanes and has memory for them. With 16 384 and 65 536 an
# H100 was as fast, with 4096 nearly three times slower.
WIDE_LANES, WIDE_STEPS_AT_ONCE = 65_536, 250_000_000
EIGHT = 8
PIECES = 16  # chunks of a small ensemble, so that every core has some,
NARROW = 32  # if they have as many seeds: with fewer a step costs its overhead


class Chunk(NamedTuple):
    """Some points and some seeds of an ensemble."""

    number: int
    points: range
    seeds: range


class Cut(NamedTuple):
    """Size of a chunk: so many points together, and so many seeds of each; `whole` if quantiles are
    those of all seeds of a point together, not counted in cells."""

    together: int
    width: int
    whole: bool


class Layout(NamedTuple):
    """An ensemble of `points` times `seeds`, cut into chunks of `together` points by `width` seeds,
    and its programs."""

    task: AbstractTask | Sweep
    key: PRNGKeyArray
    seeds: Int[np.ndarray, " seeds"] | range
    plan: Schedule
    linear: tuple[LinearTask, ...] | None
    recipe: Recipe
    together: int
    width: int
    whole: bool
    mesh: Mesh | None
    threads: int

    @property
    def points(self) -> int:
        return len(self.task) if isinstance(self.task, Sweep) else 1

    @property
    def across(self) -> int:
        """Chunks of a point."""
        return math.ceil(len(self.seeds) / self.width)

    @property
    def chunks(self) -> int:
        return math.ceil(self.points / self.together) * self.across

    def chunk(self, number: int) -> Chunk:
        """Chunks go through the seeds of a point before the next point."""
        row, column = divmod(number, self.across)
        points = range(row * self.together, min((row + 1) * self.together, self.points))
        return Chunk(
            number,
            points,
            range(column * self.width, min((column + 1) * self.width, len(self.seeds))),
        )

    def count(self, numbers: Iterable[int]) -> int:
        """Seeds in chunks, of all their points."""
        return sum(len(c.points) * len(c.seeds) for c in map(self.chunk, numbers))

    @property
    def duration(self) -> float:
        return self.plan.grid.dt * self.plan.grid.steps

    @property
    def time(self) -> np.ndarray:
        """Of the saved samples [s]."""
        return np.arange(self.plan.grid.steps // self.plan.grid.every + 1) / self.plan.rate

    @property
    def bins(self) -> int:
        """Of the spectrum; 0 if none is computed."""
        return 0 if self.recipe.edges is None else self.recipe.settings.frequency.size

    def task_of(self, point: int) -> AbstractTask:
        return self.task[point] if isinstance(self.task, Sweep) else self.task


def laid_out(  # noqa: PLR0913 (each is a field of the layout or its recipe)
    task: AbstractTask | Sweep,
    key: PRNGKeyArray,
    seeds: Int[np.ndarray, " seeds"] | range,
    plan: Schedule,
    linear: tuple[LinearTask, ...] | None,
    *,
    cut: Cut,
    states: bool,
    spectrum: bool,
    draws: Draws,
    threads: int | None,
) -> Layout:
    """The layout; with `spectrum` the Welch power of every seed is computed, with `states` they are
    kept.

    `threads`: on how many cores of a CPU; None for all that this process may use.
    """
    settings = _one_of(task).settings
    every, edges = 1, None
    if spectrum:
        every = round(plan.rate / settings.rate)
        edges = (round(WINDOW[0] * settings.rate), round(WINDOW[1] * settings.rate))
    lanes = lanes_of(plan)
    recipe = Recipe(plan.grid, plan.sampling, states, settings, lanes, every, edges, draws)
    return Layout(task, key, seeds, plan, linear, recipe, *cut, local_mesh(), threads_of(threads))


def _one_of(task: AbstractTask | Sweep) -> AbstractTask:
    """A task with the classes and settings of all points."""
    return task.task if isinstance(task, Sweep) else task


def cut_of(task: AbstractTask | Sweep, seeds: int, plan: Schedule, chunk: int | None) -> Cut:
    """As many seeds at once as the cache of a core likes, times `BLOCKS`, or fewer, so that every
    core has a chunk; whole points where their seeds are few.

    Means are added chunk by chunk. So the cut depends neither on the threads, nor on the workers,
    nor on how many devices there are.
    """
    points = len(task) if isinstance(task, Sweep) else 1
    lanes = lanes_of(plan) if chunk is None else chunk
    most = lanes * BLOCKS if chunk is None else chunk
    fair = most
    if chunk is None:
        # A power of two: few programs serve ensembles of any size. A GPU wants all of its lanes.
        fair = 2 ** int(math.log2(max(1, points * seeds / PIECES)))
        fair = max(fair, NARROW if _on_cores() else lanes)
    if isinstance(task, Sweep) and 2 * seeds <= lanes:
        return Cut(min(points, max(1, min(lanes, fair) // seeds)), seeds, True)
    return Cut(1, EIGHT * math.ceil(min(fair, most, seeds) / EIGHT), seeds <= most)


def _on_cores() -> bool:
    return jax.default_backend() in THREADED


def lanes_of(plan: Schedule) -> int:
    """How many seeds a device simulates side by side."""
    most, steps = (LANES, STEPS_AT_ONCE) if _on_cores() else (WIDE_LANES, WIDE_STEPS_AT_ONCE)
    return max(EIGHT, min(most, EIGHT * (steps // plan.grid.steps // EIGHT)))


def covers_window(plan: Schedule, task: AbstractTask | Sweep) -> bool:
    """Whether a run covers the analysed 5 s to 15 s at a multiple of the spectrum's rate."""
    every = plan.rate / _one_of(task).settings.rate
    whole = every >= 1 and abs(every - round(every)) < 1e-9 * every
    return whole and plan.grid.dt * plan.grid.steps >= WINDOW[1] - 1e-9


def plan_of(task: AbstractTask | Sweep, *given: Any) -> Schedule:
    """The plan of a task; of a sweep with the sub-steps that its fastest point needs."""
    plans = [
        schedule(each, *given) for each in ([task] if isinstance(task, AbstractTask) else task)
    ]
    return max(plans, key=lambda plan: plan.grid.substeps)


def companions(
    task: AbstractTask | Sweep, duration: float, control: bool | None
) -> tuple[LinearTask, ...] | None:
    """The linearised task of every point, or None if they are not wanted or not all of them have a
    stationary response."""
    if control is False:
        return None
    found = []
    for each in [task] if isinstance(task, AbstractTask) else task:
        linear = companion(each, duration, required=control is True)
        if linear is None:
            return None
        found.append(linear)
    return tuple(found)
