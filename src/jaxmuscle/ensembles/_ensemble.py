"""Ensembles: many seeds, many points, in memory, reduced while they run, or streamed to a store."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import jax.numpy as jnp
import numpy as np

from jaxmuscle._common.arguments import count, is_real
from jaxmuscle._common.arrays import all_concrete, as_arrays
from jaxmuscle._common.executors import AnyExecutor
from jaxmuscle._common.keys import key_of, seeds_of
from jaxmuscle._common.progress import told
from jaxmuscle._common.text import listed
from jaxmuscle._common.types import Key, Seeds
from jaxmuscle.model._stream import Draws
from jaxmuscle.model._task import AbstractTask, require_task
from jaxmuscle.response._linear_task import LinearTask
from jaxmuscle.response._linearised import linearise
from jaxmuscle.simulation._simulate import DT, DURATION, require_finite, trajectories
from jaxmuscle.simulation._trajectory import Trajectory

from ._chunks import Clock, Found, Known, Pace, Watch, block_results
from ._layout import Chunk, Layout, companions, covers_window, cut_of, laid_out, plan_of
from ._run import reduced, stored
from ._running_moments import LEVELS
from ._settings import begun_with
from ._store import folder_of
from ._summary import EnsembleSummary
from ._sweep import Population, Sweep

if TYPE_CHECKING:
    import xarray


FURTHEST = 0.01  # quantiles that weak increments are good for
AT_ONCE = 16  # seeds of a fit that a core simulates side by side

Progress = bool | Callable[[str, float], None] | Watch


Tasks = AbstractTask | Sweep | Sequence[AbstractTask]


@overload
def ensemble(
    task: Tasks, key: Key, *, seeds: Seeds, reduce: Literal[True] | tuple[float, ...], **given: Any
) -> EnsembleSummary: ...


@overload
def ensemble(
    task: Tasks, key: Key, *, seeds: Seeds, store: str | Path, **given: Any
) -> "xarray.Dataset": ...


@overload
def ensemble(
    task: AbstractTask, key: Key, *, seeds: Seeds, reduce: Literal[False] = ..., **given: Any
) -> Trajectory: ...


@overload
def ensemble(
    task: Sweep | Sequence[AbstractTask],
    key: Key,
    *,
    seeds: Seeds,
    reduce: Literal[False] = ...,
    **given: Any,
) -> Population: ...


def ensemble(  # noqa: PLR0913 (public options)  # pyright: ignore[reportInconsistentOverload]
    task: Tasks,
    key: Key,
    *,
    seeds: Seeds,
    duration: float = DURATION,
    dt: float = DT,
    rate: float | None = None,
    substeps: int | None = None,
    sampling: str | None = None,
    chunk: int | None = None,
    control: bool | None = None,
    progress: Progress = False,
    reduce: bool | tuple[float, ...] = False,
    store: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    states: bool = False,
    executor: AnyExecutor | None = None,
    increments: str = "gaussian",
    generator: str = "hash",
    threads: int | None = None,
) -> Any:
    """Simulate many seeds (0 to seeds - 1, or those given) of one task, or of every point of a
    sweep.

        runs = jm.ensemble(jm.Isometric(), jax.random.key(0), seeds=100)
        runs.spectrum().plot()

    Seed i is `simulate(..., seed=i)`, whatever the chunk, the devices or the workers. Chunks run on
    all GPUs of this process. Without a GPU they run on all cores of the CPU that the process may
    use, or on so many as `threads` says. With `executor` its workers do them, on any machines.

    **Arguments:**

    - `task`: or a `Sweep`, or tasks that differ in numbers only
    - `key`, `duration` [s], `dt` [s], `rate` [Hz], `substeps`, `sampling`: as in `simulate`
    - `chunk`: how many seeds (points times seeds) run at once
    - `progress`: True for a bar; or a function of (text, share), the share of the work that is
      done, from 0 to 1; or a `Watch`

    `control` carries the linearised task along on the same noise paths, as control variate for the
    mean spectrum; None does so wherever it pays: the run covers the analysed window and the task
    has a stable equilibrium whose transients have decayed there.

    `reduce`, True or the levels of the quantiles, keeps moments, quantiles and the mean spectrum
    only: memory does not depend on the number of seeds. `store`, the folder of a zarr store,
    streams every chunk there (`states` with it), or what is reduced from time to time; with
    `resume` an interrupted one is continued, with `overwrite` an older ensemble is replaced.

    `executor`, any of `concurrent.futures` (of processes: those that are spawned) or a client of
    Dask, shares the chunks among its workers. The result is the same to the last bit, however many
    they are. All must see the store's folder if trajectories are written there.

    `increments="weak"` takes numbers of 256 values with the first seven moments of a normal instead
    of normals, which is faster. Expectations keep their order in dt, paths mean nothing: with
    `reduce` only, and quantiles from 1 to 99 %. `generator`, "hash" (counter-based, see
    `docs/engine.md`) or "threefry" (JAX's own, slower), makes other noise.

    **Returns:** a `Trajectory`, of a sweep a `Population`; with `reduce` an `EnsembleSummary`; with
    `store` alone the opened `xarray.Dataset` (dimensions (point,) seed, time, frequency).

    **Raises:** as `simulate`: what does not stay finite is an error that names every such seed;
    with `reduce` or `store` it is left out, or NaN, and listed in `failed`. `ValueError` for a
    store that exists already or was made with other settings; `OSError` for one that cannot be
    written; `WorkersLostError` if the workers of the executor, or their scheduler, are lost.
    """
    if not isinstance(task, Sweep):
        for each in task if isinstance(task, list | tuple) else [task]:
            require_task(each, "ensemble(task, key, seeds=...)")
    if not isinstance(task, AbstractTask | Sweep):
        task = Sweep.of(task)
    key, numbers = key_of(key), seeds_of(seeds)
    path = None if store is None else folder_of(store)
    _check_options(path, resume, overwrite, states, control, chunk, threads, executor)
    draws = Draws.of(generator, increments)
    levels = _levels(reduce, weak=draws.increments == "weak")
    plan = plan_of(task, duration, dt, rate, substeps, sampling)
    if not all_concrete((task, key)):
        if isinstance(task, Sweep) or levels or path is not None:
            raise ValueError(
                "under a JAX transformation an ensemble can be of one task, in memory: no sweep,"
                " reduce or store"
            )
        linear = LinearTask.of(as_arrays(task), linearise(task)) if control else None
        return trajectories(task, linear, key, jnp.asarray(np.asarray(numbers)), plan, draws=draws)
    linear = companions(task, duration, control)
    kept = levels is not None or path is not None
    spectrum = kept and covers_window(plan, task)
    whole = not kept or (states and levels is None)
    begun = None if path is None or not resume or chunk is not None else begun_with(path)
    cut = begun or cut_of(task, len(numbers), plan, chunk)
    layout = laid_out(
        task,
        key,
        numbers,
        plan,
        linear,
        cut=cut,
        states=whole,
        spectrum=spectrum,
        draws=draws,
        threads=threads,
    )
    begin = "resume" if resume else "overwrite" if overwrite else "new"
    with telling(progress, layout) as tell:
        if levels is not None:
            return reduced(layout, levels, path, tell, executor, begin=begin)
        if path is not None:
            return stored(layout, path, tell, executor, begin=begin, states=states)
        return _in_memory(layout, tell, executor)


def runs_for_means(task: AbstractTask, key: Key, seeds: int) -> Trajectory:
    """Seeds 0 to seeds - 1 as `ensemble` simulates them.

    `AT_ONCE` of them at once: one program for any number, and each core of a CPU has some.
    """
    return ensemble(task, key, seeds=seeds, chunk=AT_ONCE)


def _check_options(
    path: Path | None,
    resume: bool,
    overwrite: bool,
    states: bool,
    control: bool | None,
    chunk: int | None,
    threads: int | None,
    executor: AnyExecutor | None,
) -> None:
    """Raise a `ValueError` for options that are wrong, alone or together."""
    if control is not None and not isinstance(control, bool):
        raise ValueError(f"control = {control!r}: give True, False, or None to let it be decided")
    if chunk is not None:
        count("chunk", chunk, 1)
    if threads is not None:
        count("threads", threads, 1, 1024)
        if executor is not None:
            raise ValueError(
                f"threads = {threads} belongs to one process: leave it out where an executor works"
            )
    if resume and overwrite:
        raise ValueError(
            "resume (--resume) continues a store, overwrite (--force) replaces it: give one of"
            " the two"
        )
    if (resume or states) and path is None:
        raise ValueError(
            f"{'resume' if resume else 'states'} = True belongs to a store: give store="
        )


def _levels(reduce: bool | tuple[float, ...], *, weak: bool) -> tuple[float, ...] | None:
    """Levels of the quantiles, None if nothing is reduced."""
    if reduce is False:
        if weak:
            raise ValueError(
                'increments = "weak" is for expectations, its paths mean nothing: give reduce=True'
                " (--reduce)"
            )
        return None
    levels = LEVELS if reduce is True else reduce
    if (
        not isinstance(levels, tuple | list)
        or not levels
        or not all(is_real(level) and 0 < level < 1 for level in levels)
    ):
        raise ValueError(f"reduce = {reduce}: levels of quantiles lie between 0 and 1")
    outside = [level for level in levels if not FURTHEST <= level <= 1 - FURTHEST]
    if weak and outside:
        raise ValueError(
            f'reduce = {levels} with increments = "weak": quantiles beyond {FURTHEST:g} and'
            f" {1 - FURTHEST:g} depend on the tails of single increments ({listed(outside)}): leave"
            " increments out"
        )
    return tuple(sorted(map(float, levels)))


def everything(
    layout: Layout, simulated: Iterable[tuple[Chunk, Found]], known: Known
) -> list[Found]:
    """All that is kept of a block's chunks in memory."""
    names = ("states", "output", *(("linear",) if layout.linear is not None else ()))
    return [{name: found[name] for name in names} for _, found in simulated]


def _in_memory(
    layout: Layout, tell: Callable[[Pace], None], executor: AnyExecutor | None
) -> Trajectory | Population:
    """Everything, joined; a sweep point by point."""
    numbers = range(layout.chunks)
    results = block_results(layout, numbers, everything, executor, Clock(layout, numbers, tell))
    chunks = [found for _, made in results for found in made]
    grid, plan, seeds = layout.plan.grid, layout.plan, np.asarray(layout.seeds)
    members = []
    for point in range(layout.points):
        first, row = divmod(point, layout.together)
        own = chunks[first * layout.across : (first + 1) * layout.across]
        joined = {name: np.concatenate([found[name][row] for found in own]) for name in own[0]}
        members.append(
            Trajectory(
                layout.task_of(point),
                joined["states"],
                joined["output"],
                seeds,
                plan.rate,
                grid.dt,
                grid.substeps,
                plan.sampling,
                joined.get("linear"),
            )
        )
        require_finite(
            members[-1], f" at point {point} of the sweep" if isinstance(layout.task, Sweep) else ""
        )
    return Population(layout.task, tuple(members)) if isinstance(layout.task, Sweep) else members[0]


@contextlib.contextmanager
def telling(progress: Progress, layout: Layout) -> Iterator[Callable[[Pace], None]]:
    """A bar, a function of (text, share), or silence."""
    if isinstance(progress, Watch):
        yield progress.tell
        return
    with told(progress, f"simulating {layout.points * len(layout.seeds)} seeds") as tell:
        yield lambda pace: tell(str(pace), pace.done / pace.total)
