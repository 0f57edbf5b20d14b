"""How an ensemble is cut into chunks, and what runs one of them."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Int, PRNGKeyArray

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.model._stream import Draws
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._linearised import LinearTask
from jaxmuscle.simulation._batch import LANES, Recipe, blocks, local_mesh, run_points, run_seeds
from jaxmuscle.simulation._simulate import Schedule, companion, schedule
from jaxmuscle.spectra._settings import WINDOW

from ._processes import agreed
from ._sweep import Sweep

BLOCKS = 4
STEPS_AT_ONCE = 4_000_000
EIGHT = 8


class Chunk(NamedTuple):
    """Some points and some seeds of an ensemble."""

    number: int
    points: range
    seeds: range


class Pace(NamedTuple):
    """How far this process is, in its share of the seeds (points times seeds in a sweep), and how fast.

    `done` of `total` seeds; `seeds_per_second`; `real_time_factor`, simulated over real time; `left` [s].
    """

    done: int
    total: int
    seeds_per_second: float
    real_time_factor: float
    left: float

    def __str__(self) -> str:
        return (f"{self.done} of {self.total} seeds, {self.seeds_per_second:.3g} seeds/s, "
                f"{self.real_time_factor:.3g} x real time, {self.left:.0f} s left")  # fmt: skip


class Watch(NamedTuple):
    """For `progress=` of `ensemble`: `tell` is called with the `Pace` after every chunk."""

    tell: Callable[[Pace], None]


class Cut(NamedTuple):
    """Size of a chunk: so many points together, and so many seeds of each."""

    together: int
    width: int


class Layout(NamedTuple):
    """An ensemble of `points` times `seeds`, cut into chunks of `together` points by `width` seeds, and its programs."""

    task: AbstractTask | Sweep
    key: PRNGKeyArray
    seeds: Int[np.ndarray, " seeds"] | range
    plan: Schedule
    linear: tuple[LinearTask, ...] | None
    recipe: Recipe
    together: int
    width: int
    mesh: Mesh | None

    @property
    def points(self) -> int:
        return len(self.task) if isinstance(self.task, Sweep) else 1

    @property
    def whole(self) -> bool:
        """Whether all seeds of a point come together."""
        return self.width >= len(self.seeds)

    @property
    def chunks(self) -> int:
        return math.ceil(self.points / self.together) * math.ceil(len(self.seeds) / self.width)

    def chunk(self, number: int) -> Chunk:
        """Chunks go through the seeds of a point before the next point."""
        across = math.ceil(len(self.seeds) / self.width)
        row, column = divmod(number, across)
        points = range(row * self.together, min((row + 1) * self.together, self.points))
        return Chunk(number, points, range(column * self.width, min((column + 1) * self.width, len(self.seeds))))

    def chunk_of(self, point: int, column: int) -> int:
        """Number of the chunk that has a point and a seed, counted from 0."""
        return (point // self.together) * math.ceil(len(self.seeds) / self.width) + column // self.width

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


def laid_out(
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
) -> Layout:
    """The layout; with `spectrum` the Welch power of every seed is computed, with `states` they are kept."""
    settings = _one_of(task).settings
    recipe = Recipe(plan.grid, plan.sampling, states, settings, lanes_of(plan), draws=draws)
    if spectrum:
        edges = (round(WINDOW[0] * settings.rate), round(WINDOW[1] * settings.rate))
        recipe = dataclasses.replace(recipe, every=round(plan.rate / settings.rate), edges=edges)
    return Layout(task, key, seeds, plan, linear, recipe, *cut, local_mesh())


def _one_of(task: AbstractTask | Sweep) -> AbstractTask:
    """A task with the classes and settings of all points."""
    return task.task if isinstance(task, Sweep) else task


def cut_of(
    task: AbstractTask | Sweep, seeds: int, plan: Schedule, chunk: int | None, *, shared: bool, parts: int | None = None
) -> Cut:
    """As many seeds at once as the cache of every device likes, times `BLOCKS`; whole points where their seeds are few.

    Where processes share the work, what process 0 says. Parts of a store cannot ask one another: each takes what one device
    likes, so that machines need not be alike, or less, so that there is as much for every part.
    """
    if chunk is not None:
        lanes, most, parts = chunk, chunk, None
    else:
        lanes = lanes_of(plan) * (jax.local_device_count() if parts is None else 1)
        lanes = int(agreed(str(lanes))) if shared else lanes
        most = lanes * BLOCKS
    points = len(task) if isinstance(task, Sweep) else 1
    if isinstance(task, Sweep) and 2 * seeds <= lanes:
        return Cut(min(math.ceil(points / (parts or 1)), lanes // seeds), seeds)
    width, fair = min(most, seeds), math.ceil(points * seeds / (parts or 1))
    if fair < seeds:  # a part has several equal chunks, or one
        width = math.ceil(fair / math.ceil(fair / width))
    return Cut(1, EIGHT * math.ceil(width / EIGHT))


def lanes_of(plan: Schedule) -> int:
    """How many seeds a device simulates side by side."""
    return max(EIGHT, min(LANES, EIGHT * (STEPS_AT_ONCE // plan.grid.steps // EIGHT)))


def covers_window(plan: Schedule, task: AbstractTask | Sweep) -> bool:
    """Whether a run covers the analysed 5 s to 15 s at a multiple of the spectrum's rate."""
    every = plan.rate / _one_of(task).settings.rate
    whole = every >= 1 and abs(every - round(every)) < 1e-9 * every
    return whole and plan.grid.dt * plan.grid.steps >= WINDOW[1] - 1e-9


def plan_of(task: AbstractTask | Sweep, *given: Any) -> Schedule:
    """The plan of a task; of a sweep with the sub-steps that its fastest point needs."""
    plans = [schedule(each, *given) for each in ([task] if isinstance(task, AbstractTask) else task)]
    return max(plans, key=lambda plan: plan.grid.substeps)


def companions(task: AbstractTask | Sweep, duration: float, control: bool | None) -> tuple[LinearTask, ...] | None:
    """The linearised task of every point, or None if they are not wanted or not all of them have a stationary response."""
    if control is False:
        return None
    found = []
    for each in [task] if isinstance(task, AbstractTask) else task:
        linear = companion(each, duration, required=control is True)
        if linear is None:
            return None
        found.append(linear)
    return tuple(found)


def _start(layout: Layout, chunk: Chunk, ready: dict[int, Any]) -> dict[str, Any]:
    """Dispatch a chunk, filled up with its last seed and point to its full size and equal parts for all devices.

    `ready` keeps the arrays of the last single task, which are made once.
    """
    devices = 1 if layout.mesh is None else layout.mesh.size
    single = layout.together == 1
    width, step = layout.width, EIGHT * devices * blocks(math.ceil(layout.width / devices), layout.recipe.lanes)
    width = step * math.ceil(width / step) if single else width
    columns = np.minimum(chunk.seeds.start + np.arange(width), chunk.seeds.stop - 1)
    seeds = np.asarray(layout.seeds)[columns] if not isinstance(layout.seeds, range) else layout.seeds.start + columns
    linear = layout.linear
    if single:
        point = chunk.points.start
        if point not in ready:
            ready.clear()
            arrays = as_arrays((layout.task_of(point), None if linear is None else linear[point]))
            ready[point] = arrays if layout.mesh is None else eqx.filter_shard(arrays, NamedSharding(layout.mesh, P()))
        task, beside = ready[point]
        return run_seeds(task, beside, layout.key, seeds, layout.recipe, layout.mesh)
    assert isinstance(layout.task, Sweep)
    together = devices * math.ceil(layout.together / devices)
    rows = np.minimum(chunk.points.start + np.arange(together), chunk.points.stop - 1)
    tasks = jax.tree.map(lambda leaf: leaf[rows], layout.task.task)
    beside = None if linear is None else jax.tree.map(lambda *leaves: np.stack(leaves), *[linear[i] for i in rows])
    return run_points(as_arrays(tasks), as_arrays(beside), layout.key, seeds, layout.recipe, layout.mesh)


def _finish(chunk: Chunk, found: dict[str, Any]) -> dict[str, np.ndarray]:
    """Results on the host with leading axes (points, seeds), without what filled the chunk up."""
    host = {name: np.asarray(values) for name, values in found.items() if values is not None}
    if host["finite"].ndim == 1:
        host = {name: values[None] for name, values in host.items()}
    return {name: values[: len(chunk.points), : len(chunk.seeds)] for name, values in host.items()}


def run_chunks(
    layout: Layout, numbers: Iterable[int], tell: Callable[[Pace], None]
) -> Iterator[tuple[Chunk, dict[str, np.ndarray]]]:
    """Results of the chunks in turn; the next one is computed while the caller deals with the last."""
    chunks = [layout.chunk(number) for number in numbers]
    total = sum(len(chunk.points) * len(chunk.seeds) for chunk in chunks)
    done, begun, waiting, ready = 0, 0.0, None, {}
    for chunk in [*chunks, None]:
        started = None if chunk is None else (chunk, _start(layout, chunk, ready))
        begun = begun or time.monotonic()  # once the first has been compiled
        if waiting is not None:
            yield waiting[0], _finish(*waiting)
            done += len(waiting[0].points) * len(waiting[0].seeds)
            speed = done / max(time.monotonic() - begun, 1e-9)
            tell(Pace(done, total, speed, speed * layout.duration, (total - done) / speed))
        waiting = started
