"""How an ensemble is cut into chunks, and what runs them."""

import contextlib
import dataclasses
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
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
from jaxmuscle.response._linear_task import LinearTask
from jaxmuscle.simulation._batch import (
    LANES,
    THREADED,
    Recipe,
    blocks,
    local_mesh,
    run_points,
    run_seeds,
    threads_of,
)
from jaxmuscle.simulation._simulate import Schedule, companion, schedule
from jaxmuscle.spectra._settings import WINDOW

from ._processes import agreed
from ._sweep import Sweep

BLOCKS = 4
STEPS_AT_ONCE = 4_000_000
# Of a GPU, which hides its latency by many lanes and has memory for them. With 16 384 and 65 536 an
# H100 was as fast, with 4096 nearly three times slower.
WIDE_LANES, WIDE_STEPS_AT_ONCE = 65_536, 250_000_000
EIGHT = 8

Found = dict[str, np.ndarray]


class Chunk(NamedTuple):
    """Some points and some seeds of an ensemble."""

    number: int
    points: range
    seeds: range


class Pace(NamedTuple):
    """How far this process is, in its share of the seeds (points times seeds in a sweep), and how
    fast.

    `done` of `total` seeds; `seeds_per_second`; `real_time_factor`, simulated over real time;
    `left` [s].
    """

    done: int
    total: int
    seeds_per_second: float
    real_time_factor: float
    left: float

    def __str__(self) -> str:
        return (
            f"{self.done} of {self.total} seeds, {self.seeds_per_second:.3g} seeds/s, "
            f"{self.real_time_factor:.3g} x real time, {self.left:.0f} s left"
        )


class Watch(NamedTuple):
    """For `progress=` of `ensemble`: `tell` is called with the `Pace` after every chunk."""

    tell: Callable[[Pace], None]


class Cut(NamedTuple):
    """Size of a chunk: so many points together, and so many seeds of each."""

    together: int
    width: int


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
    mesh: Mesh | None
    threads: int

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
        return Chunk(
            number,
            points,
            range(column * self.width, min((column + 1) * self.width, len(self.seeds))),
        )

    def chunk_of(self, point: int, column: int) -> int:
        """Number of the chunk that has a point and a seed, counted from 0."""
        return (point // self.together) * math.ceil(
            len(self.seeds) / self.width
        ) + column // self.width

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
    recipe = Recipe(plan.grid, plan.sampling, states, settings, lanes_of(plan), draws=draws)
    if spectrum:
        edges = (round(WINDOW[0] * settings.rate), round(WINDOW[1] * settings.rate))
        recipe = dataclasses.replace(recipe, every=round(plan.rate / settings.rate), edges=edges)
    return Layout(task, key, seeds, plan, linear, recipe, *cut, local_mesh(), threads_of(threads))


def _one_of(task: AbstractTask | Sweep) -> AbstractTask:
    """A task with the classes and settings of all points."""
    return task.task if isinstance(task, Sweep) else task


def cut_of(
    task: AbstractTask | Sweep,
    seeds: int,
    plan: Schedule,
    chunk: int | None,
    *,
    shared: bool,
    parts: int | None = None,
) -> Cut:
    """As many seeds at once as the cache of every device likes, times `BLOCKS`; whole points where
    their seeds are few.

    Where processes share the work, what process 0 says. Parts of a store cannot ask one another:
    each takes what one device likes, so that machines need not be alike, or less, so that there is
    as much for every part.
    """
    if chunk is not None:
        lanes, most, parts = chunk, chunk, None
    else:
        lanes = lanes_of(plan) * (
            mesh.size if parts is None and (mesh := local_mesh()) is not None else 1
        )
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
    cores = jax.default_backend() in THREADED
    most, steps = (LANES, STEPS_AT_ONCE) if cores else (WIDE_LANES, WIDE_STEPS_AT_ONCE)
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


class _Ready:
    """The arrays of the single task that was needed last, on its devices."""

    def __init__(self, layout: Layout):
        self.layout, self.lock, self.point, self.arrays = layout, threading.Lock(), -1, None

    def of(self, point: int) -> Any:
        layout = self.layout
        with self.lock:
            if point != self.point:
                arrays = as_arrays(
                    (layout.task_of(point), None if layout.linear is None else layout.linear[point])
                )
                self.arrays = (
                    arrays
                    if layout.mesh is None
                    else eqx.filter_shard(arrays, NamedSharding(layout.mesh, P()))
                )
                self.point = point
            return self.arrays


def _start(layout: Layout, chunk: Chunk, ready: _Ready) -> dict[str, Any]:
    """Dispatch a chunk, filled up with its last seed and point to its full size and equal parts for
    all devices."""
    devices = 1 if layout.mesh is None else layout.mesh.size
    single = layout.together == 1
    width, step = (
        layout.width,
        EIGHT * devices * blocks(math.ceil(layout.width / devices), layout.recipe.lanes),
    )
    width = step * math.ceil(width / step) if single else width
    columns = np.minimum(chunk.seeds.start + np.arange(width), chunk.seeds.stop - 1)
    seeds = (
        np.asarray(layout.seeds)[columns]
        if not isinstance(layout.seeds, range)
        else layout.seeds.start + columns
    )
    linear = layout.linear
    if single:
        task, beside = ready.of(chunk.points.start)
        return run_seeds(task, beside, layout.key, seeds, layout.recipe, layout.mesh)
    assert isinstance(layout.task, Sweep)
    together = devices * math.ceil(layout.together / devices)
    rows = np.minimum(chunk.points.start + np.arange(together), chunk.points.stop - 1)
    tasks = jax.tree.map(lambda leaf: leaf[rows], layout.task.task)
    beside = (
        None
        if linear is None
        else jax.tree.map(lambda *leaves: np.stack(leaves), *[linear[i] for i in rows])
    )
    return run_points(
        as_arrays(tasks), as_arrays(beside), layout.key, seeds, layout.recipe, layout.mesh
    )


def _finish(chunk: Chunk, found: dict[str, Any]) -> Found:
    """Results on the host with leading axes (points, seeds), without what filled the chunk up."""
    host = {name: np.asarray(values) for name, values in found.items() if values is not None}
    if host["finite"].ndim == 1:
        host = {name: values[None] for name, values in host.items()}
    return {name: values[: len(chunk.points), : len(chunk.seeds)] for name, values in host.items()}


def run_chunks(
    layout: Layout,
    numbers: Iterable[int],
    tell: Callable[[Pace], None],
    work: Callable[[Chunk, Found], Any] | None = None,
) -> Generator[tuple[Chunk, Any], None, None]:
    """Results of the chunks in turn, or what `work` makes of them; others are computed while the
    caller deals with one.

    XLA runs such a program on one core. So as many chunks run at once as there are cores, each
    dispatched from a thread of its own (XLA works off one thread's programs one after the other).
    There are half as many threads more, so that no core waits while the `work` is done.
    """
    chunks = [layout.chunk(number) for number in numbers]
    total = sum(len(chunk.points) * len(chunk.seeds) for chunk in chunks)
    done, begun, waiting, ready, here = 0, 0.0, deque(), _Ready(layout), _settings_of_this_thread()

    def run(chunk: Chunk, started: dict[str, Any] | None = None) -> Any:
        with here():
            with cores:
                found = _finish(chunk, _start(layout, chunk, ready) if started is None else started)
            return found if work is None else work(chunk, found)

    cores, ahead = (
        threading.Semaphore(layout.threads),
        layout.threads + layout.threads // 2 if layout.threads > 1 else 1,
    )
    pool = ThreadPoolExecutor(ahead, thread_name_prefix="jaxmuscle")
    try:
        for chunk in [*chunks, *[None] * ahead]:
            if chunk is not None:
                first = None if begun else _start(layout, chunk, ready)  # compiled once, here
                begun = begun or time.monotonic()
                waiting.append((chunk, pool.submit(run, chunk, first)))
            if len(waiting) > ahead or (chunk is None and waiting):
                chunk, future = waiting.popleft()
                yield chunk, future.result()
                done += len(chunk.points) * len(chunk.seeds)
                speed = done / max(time.monotonic() - begun, 1e-9)
                tell(Pace(done, total, speed, speed * layout.duration, (total - done) / speed))
    finally:
        pool.shutdown(cancel_futures=True)


def _settings_of_this_thread() -> Callable[[], contextlib.AbstractContextManager[Any]]:
    """JAX's precision and device may be set for one thread (`with jax.enable_x64(True)`): the same
    for another one."""
    double, device = (bool(jax.config.jax_enable_x64), jax.config.jax_default_device)  # pyright: ignore[reportAttributeAccessIssue]

    @contextlib.contextmanager
    def here() -> Iterator[None]:
        with jax.enable_x64(double), jax.default_device(device):
            yield

    return here
