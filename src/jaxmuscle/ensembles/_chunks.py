"""What simulates the chunks of an ensemble: threads of this process, or the workers of an
executor."""

import contextlib
import dataclasses
import functools
import math
import threading
import time
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.sharding import NamedSharding
from jax.sharding import PartitionSpec as P

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.executors import AnyExecutor, results_of
from jaxmuscle.simulation._batch import blocks, local_mesh, run_points, run_seeds

from ._layout import EIGHT, Chunk, Layout, lanes_of
from ._sweep import Sweep

TASKS = 8000  # blocks that a scheduler is given, at most about so many
SEVERAL, ENOUGH = 8, 256  # chunks in a block, if that makes enough blocks

Found = dict[str, np.ndarray]
Known = Mapping[int, Any]
Made = TypeVar("Made")
# What is made of the results of some chunks, one after the other, and of what is known of their
# points.
Work = Callable[[Layout, Iterable[tuple[Chunk, Found]], Known], Made]


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


class Clock:
    """How far the work on the chunks of these numbers is."""

    def __init__(self, layout: Layout, numbers: Iterable[int], tell: Callable[[Pace], None]):
        self.layout, self.tell, self.done, self.begun = layout, tell, 0, 0.0
        self.total = layout.count(numbers)

    def begin(self) -> None:
        """From now on, unless it has begun."""
        self.begun = self.begun or time.monotonic()

    def add(self, numbers: Iterable[int]) -> None:
        """These are done."""
        self.done += self.layout.count(numbers)
        speed = self.done / max(time.monotonic() - self.begun, 1e-9)
        left = (self.total - self.done) / speed
        self.tell(Pace(self.done, self.total, speed, speed * self.layout.duration, left))


def block_results(
    layout: Layout,
    numbers: Sequence[int],
    work: Work[Made],
    executor: AnyExecutor | None,
    clock: Clock,
    known: Known = MappingProxyType({}),
) -> Generator[tuple[Sequence[int], Made], None, None]:
    """Blocks of these numbers of chunks, and what `work` makes of each, in their order, whoever
    works.

    On threads, a block is a chunk. `known`: what the work needs to know of some points; a block is
    told of its own.
    """
    parts = blocks_of(numbers, executor)
    items = (
        (part, {i: known[i] for n in part for i in layout.chunk(n).points if i in known})
        for part in parts
    )
    if executor is None:
        results = _on_threads(layout, items, work, clock)
    else:
        clock.begin()
        # A worker has devices of its own.
        results = results_of(executor, Remote(layout._replace(mesh=None), work), items)
    with contextlib.closing(results):
        for (part, _), made in results:
            yield part, made
            clock.add(part)


def blocks_of(numbers: Sequence[int], executor: AnyExecutor | None) -> list[Sequence[int]]:
    """Runs of neighbours: single ones for threads; for workers as many at a time as a scheduler
    likes."""
    count = len(numbers)
    several = max(1, min(SEVERAL, count // ENOUGH), math.ceil(count / TASKS))
    size = 1 if executor is None else several
    return [numbers[i : i + size] for i in range(0, count, size)]


class Remote(NamedTuple, Generic[Made]):
    """The work on a block in a worker: one chunk after the other, on its devices."""

    layout: Layout
    work: Work[Made]

    def __call__(self, item: tuple[Sequence[int], Known]) -> Made:
        numbers, known = item
        recipe = dataclasses.replace(self.layout.recipe, lanes=lanes_of(self.layout.plan))
        layout = self.layout._replace(mesh=local_mesh(), recipe=recipe)
        ready = _ready(layout)
        simulated = (
            (chunk, _finish(chunk, _start(layout, chunk, ready)))
            for chunk in map(layout.chunk, numbers)
        )
        return self.work(layout, simulated, known)


def _on_threads(
    layout: Layout, items: Iterable[tuple[Sequence[int], Known]], work: Work[Made], clock: Clock
) -> Generator[tuple[tuple[Sequence[int], Known], Made], None, None]:
    """XLA runs such a program on one core. So as many chunks run at once as there are cores, each
    dispatched from a thread of its own (XLA works off one thread's programs one after the other).
    There are half as many threads more, so that no core waits while the `work` is done.
    """
    ready, first, cores = _ready(layout), threading.Lock(), threading.Semaphore(layout.threads)
    device = jax.config.jax_default_device  # that of this thread  # pyright: ignore[reportAttributeAccessIssue]
    ahead = layout.threads + layout.threads // 2 if layout.threads > 1 else 1

    def run(item: tuple[Sequence[int], Known]) -> Made:
        (number,), known = item
        chunk = layout.chunk(number)
        with jax.default_device(device):
            with cores:
                with contextlib.nullcontext() if clock.begun else first:  # compiled once
                    begun = _start(layout, chunk, ready)
                    clock.begin()
                found = _finish(chunk, begun)
            return work(layout, [(chunk, found)], known)

    pool = ThreadPoolExecutor(ahead, thread_name_prefix="jaxmuscle")
    try:
        yield from results_of(pool, run, items, window=ahead + 1)
    finally:
        pool.shutdown(cancel_futures=True)


Ready = Callable[[int], Any]


def _ready(layout: Layout) -> Ready:
    """The arrays of the single task that was needed last, on its devices."""

    @functools.lru_cache(1)
    def of(point: int) -> Any:
        linear = None if layout.linear is None else layout.linear[point]
        arrays = as_arrays((layout.task_of(point), linear))
        if layout.mesh is None:
            return arrays
        return eqx.filter_shard(arrays, NamedSharding(layout.mesh, P()))

    return of


def _start(layout: Layout, chunk: Chunk, ready: Ready) -> dict[str, Any]:
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
        task, beside = ready(chunk.points.start)
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
