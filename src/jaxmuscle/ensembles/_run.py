"""Ensembles that are reduced while they run, or streamed to a store, by whoever works."""

import contextlib
import functools
import io
import itertools
import json
import logging
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxmuscle._common.errors import SimulationError, StoreError
from jaxmuscle._common.executors import AnyExecutor, results_of
from jaxmuscle.response._expected_moments import linear_spectrum

from ._arrays import parts_of, region_of, variables_of
from ._chunks import Clock, Found, Known, Pace, block_results, blocks_of
from ._integrity import (
    computed_keys,
    damaged,
    in_words,
    keys_of_chunk,
    read,
    sealed,
    unsealed,
)
from ._layout import Chunk, Layout
from ._opening import finish, opened, take_back
from ._running_moments import (
    CELLS,
    ChunkMoments,
    Edges,
    RunningMoments,
    add,
    count_cells,
    edges_of,
    empty,
    moments,
)
from ._settings import about, identity
from ._store import (
    PROGRESS,
    SETTINGS,
    Variable,
    description_of,
    read_arrays,
    replace,
    require_settings,
    settle,
    write_arrays,
    write_region,
)
from ._summary import EnsembleSummary, computed, summarised
from ._sweep import Sweep

if TYPE_CHECKING:
    import xarray


KEEP_EVERY = 10.0  # seconds between two copies of a tally on disk
KEEP_SHARE = 20  # and at least this many times what writing one took
TALLY = f"{PROGRESS}/tally.npz"
LOG = logging.getLogger("jaxmuscle")

Tell = Callable[[Pace], None]
Failed = list[list[int]]  # point and seed of what did not stay finite


# Reduced


class Reduced(NamedTuple):
    """A tally of the first `chunks` chunks in the order of `stages`, and what failed in them."""

    tally: RunningMoments
    chunks: int
    failed: Failed


class Condensed(NamedTuple):
    """What is left of a block: what each chunk adds to each of its points, how much of their output
    lies in which cell, where the cells of points lie whose first chunk it has, and what failed."""

    parts: list[list[ChunkMoments]]
    cells: dict[int, np.ndarray]
    edges: dict[int, Edges]
    failed: Failed


def reduced(
    layout: Layout,
    levels: tuple[float, ...],
    path: Path | None,
    tell: Tell,
    executor: AnyExecutor | None,
    *,
    begin: str,
) -> EnsembleSummary:
    """Moments, quantiles and the mean spectrum of all chunks; kept in a store from time to time if
    there is one."""
    values = layout.time.size + (2 * layout.bins + 1 if layout.bins else 0)
    tally = empty(layout.points, values, layout.time.size, len(levels), whole=layout.whole)
    nothing = Reduced(tally, 0, [])
    if path is None:
        found = _reduce(layout, levels, nothing, tell, executor, lambda found: None)
        return _summary(layout, levels, found)
    blank = _summary(layout, levels, nothing)
    known = {*blank.coordinates(), "power_expected"}
    variables = {name: Variable.whole(*given) for name, given in blank.arrays().items()}
    variables |= {n: v._replace(values=None) for n, v in variables.items() if n not in known}
    attributes = blank.attributes() | identity(
        layout, {"kind": "reduced", "quantiles": list(levels)}
    )
    with opened(path, variables, blank.coordinates(), attributes, begin=begin) as left:
        if left:
            kept = _read_tally(path) or nothing
            save = functools.partial(_write_tally, path)
            found = _reduce(layout, levels, kept, tell, executor, save)
            arrays = _summary(layout, levels, found).arrays()
            write_arrays(path, {name: arrays[name][1] for name in arrays if name not in known})
            finish(path, found.failed)
        # Before the lock is given back: whoever overwrites the store could come in between.
        return _loaded(layout, levels, path, blank.arrays())


def stages(layout: Layout) -> tuple[Sequence[int], Sequence[int]]:
    """The first chunks of all points, which say where their cells lie; then the others."""
    numbers = range(layout.chunks)
    if layout.whole:
        return numbers, ()
    return numbers[:: layout.across], [n for n in numbers if n % layout.across]


def _reduce(
    layout: Layout,
    levels: tuple[float, ...],
    found: Reduced,
    tell: Tell,
    executor: AnyExecutor | None,
    save: Callable[[Reduced], None],
) -> Reduced:
    """The chunks that `found` does not have yet are added to it, in the order of `stages`, whoever
    computes them; saved from time to time, and when interrupted."""
    first, others = stages(layout)
    todo = first[found.chunks :], others[max(0, found.chunks - len(first)) :]
    clock, keep = Clock(layout, [*todo[0], *todo[1]], tell), _keeper(save)
    outputs: list[np.ndarray] = []  # of a point of which not all chunks are here
    adding = False
    try:
        for numbers in todo:
            low, high = found.tally.low, found.tally.high
            edges = {
                int(i): (low[i], high[i]) for i in np.flatnonzero(np.isfinite(low).all(axis=1))
            }
            results = block_results(layout, numbers, condensed, executor, clock, edges)
            with contextlib.closing(results):
                for part, more in results:
                    adding = True
                    _add_block(layout, levels, found.tally, outputs, part, more)
                    found.failed.extend(more.failed)
                    found = found._replace(chunks=found.chunks + len(part))
                    adding = bool(outputs)
                    if not adding:
                        keep(found)
    except KeyboardInterrupt:
        if not adding:  # else the tally holds a part of something: what was saved last stays
            save(found)
        raise
    return found


def _add_block(
    layout: Layout,
    levels: tuple[float, ...],
    tally: RunningMoments,
    outputs: list[np.ndarray],
    part: Sequence[int],
    more: Condensed,
) -> None:
    """A block into the tally, chunk by chunk, so that sums do not depend on the blocks."""
    for number, moments_of in zip(part, more.parts, strict=True):
        chunk = layout.chunk(number)
        for point, piece in zip(chunk.points, moments_of, strict=True):
            add(tally, point, piece)
            if piece.output is not None:
                outputs.append(piece.output)
                if chunk.seeds.stop == len(layout.seeds):
                    together = np.concatenate(outputs)
                    if len(together):
                        tally.exact[point] = np.quantile(together, levels, axis=0)
                    outputs.clear()
    for point, (low, high) in more.edges.items():
        tally.low[point], tally.high[point] = low, high
    for point, cells in more.cells.items():
        tally.cells[point] += cells


def condensed(layout: Layout, simulated: Iterable[tuple[Chunk, Found]], edges: Known) -> Condensed:
    """What is left of a block of chunks, by whoever has simulated them."""
    made = Condensed([], {}, {}, [])
    for chunk, found in simulated:
        made.failed.extend(_failed(layout, chunk, found["finite"]))
        made.parts.append([])
        for row, point in enumerate(chunk.points):
            finite = found["finite"][row]
            stayed = slice(None) if finite.all() else finite  # a slice copies nothing
            output = found["output"][row][stayed]
            piece = moments(_rows(layout, found, row)[stayed])
            if layout.whole:
                piece = piece._replace(output=output)
            else:
                if point not in edges:
                    made.edges[point] = _edges(point, output)
                low, high = edges[point] if point in edges else made.edges[point]
                counted = count_cells(low, high, output)
                made.cells[point] = counted + made.cells.get(point, 0)
            made.parts[-1].append(piece)
    packed = {i: n.astype(np.min_scalar_type(n.max())) for i, n in made.cells.items()}
    return made._replace(cells=packed)


def _edges(point: int, output: np.ndarray) -> Edges:
    if len(output) == 0:
        raise SimulationError(
            f"none of the first seeds of point {point} stayed finite: lower the noise amplitude"
            " or dt"
        )
    return edges_of(output)


def _failed(layout: Layout, chunk: Chunk, finite: np.ndarray) -> Failed:
    """Point and seed of what did not stay finite."""
    return [[chunk.points[i], int(layout.seeds[chunk.seeds[j]])] for i, j in np.argwhere(~finite)]


def _rows(layout: Layout, found: dict[str, np.ndarray], row: int) -> np.ndarray:
    """The values of every seed that are averaged: output, Welch power, what the linear response
    leaves of it, variation."""
    output = found["output"][row]
    if not layout.bins:
        return output.astype(float)
    power = found["power"][row]
    left = power - found["linear_power"][row] if layout.linear is not None else 0 * power
    return np.concatenate(
        [output, power, left, found["variation"][row][:, None]], axis=1, dtype=float
    )


def _keeper(save: Callable[[Reduced], None]) -> Callable[[Reduced], None]:
    """Saves what it is given, not too often."""
    due = time.monotonic() + KEEP_EVERY

    def keep(found: Reduced) -> None:
        nonlocal due
        begun = time.monotonic()
        if begun >= due:
            save(found)
            now = time.monotonic()
            due = now + max(KEEP_EVERY, KEEP_SHARE * (now - begun))

    return keep


def _write_tally(path: Path, found: Reduced) -> None:
    """Keep what was reduced so far."""
    data = io.BytesIO()
    failed = np.array(found.failed, int).reshape(-1, 2)
    np.savez(data, chunks=found.chunks, failed=failed, **found.tally._asdict())
    replace(path, TALLY, sealed(data.getvalue()))


def _read_tally(path: Path) -> Reduced | None:
    """What was kept, None if there is nothing; if it is damaged, that is said."""
    kept = read(path / TALLY)
    content = unsealed(kept or b"")
    if content is None:
        if kept:
            LOG.warning("notice: %s: %s is damaged; what it held is computed again", path, TALLY)
        return None
    with np.load(io.BytesIO(content)) as data:
        tally = RunningMoments(*(data[name] for name in RunningMoments._fields))
        return Reduced(tally, int(data["chunks"]), data["failed"].tolist())


def _summary(layout: Layout, levels: tuple[float, ...], found: Reduced) -> EnsembleSummary:
    expected = None
    if layout.bins and layout.linear is not None:
        spectra = [
            linear_spectrum(layout.task_of(i), layout.recipe.settings) for i in range(layout.points)
        ]
        expected = np.stack([np.asarray(spectrum.power, float) for spectrum in spectra])
    arrays = computed(found.tally, levels, expected)
    if not isinstance(layout.task, Sweep):
        arrays = {name: values[0] for name, values in arrays.items()}
    return _made(layout, levels, arrays, found.failed)


def _loaded(
    layout: Layout, levels: tuple[float, ...], path: Path, names: Iterable[str]
) -> EnsembleSummary:
    """The summary in a complete store."""
    failed = json.loads(description_of(path)["attributes"]["failed"])
    return _made(layout, levels, read_arrays(path, names), failed)


def _made(
    layout: Layout, levels: tuple[float, ...], arrays: dict[str, np.ndarray], failed: Failed
) -> EnsembleSummary:
    described = about(layout) | ({} if layout.whole else {"cells_per_quantile": CELLS})
    return summarised(
        layout, levels, arrays, np.array(sorted(failed), int).reshape(-1, 2), described
    )


# Stored


class Home(NamedTuple):
    """Where trajectories belong: a store of these settings, with states or not."""

    path: Path
    settings: str
    states: bool

    def write(
        self, layout: Layout, simulated: Iterable[tuple[Chunk, Found]], known: Known
    ) -> Failed:
        """Write chunks; twice does no harm. The (point, seed) that failed in them."""
        failed: Failed = []
        for chunk, found in simulated:
            # Nobody may have replaced it while this process was cut off from the one that began it.
            require_settings(self.path, self.settings)
            values = parts_of(layout, found, states=self.states)
            write_region(self.path, region_of(layout, chunk), values)
            failed += _failed(layout, chunk, found["finite"])
        return failed

    def look(self, layout: Layout, numbers: Sequence[int]) -> tuple[dict[int, Failed], list[str]]:
        """Those of these chunks that are there as they were written, and the (point, seed) that
        failed in them; files of others that are damaged."""
        document, task = description_of(self.path), layout.task_of(0)
        keys = {number: keys_of_chunk(document, number) for number in numbers}
        bad = set(damaged(self.path, itertools.chain(*keys.values())))
        names = {task.output_name, *(task.state_names if self.states else ())}
        there: dict[int, Failed] = {}
        for number in numbers:
            if bad.isdisjoint(keys[number]):
                chunk = layout.chunk(number)
                values = read_arrays(self.path, names, region_of(layout, chunk)).values()
                finite = np.all([np.isfinite(value).all(axis=-1) for value in values], axis=0)
                shape = len(chunk.points), len(chunk.seeds)
                there[number] = _failed(layout, chunk, finite.reshape(shape))
        return there, [key for key in bad if (self.path / key).exists()]


def stored(
    layout: Layout,
    path: Path,
    tell: Tell,
    executor: AnyExecutor | None,
    *,
    begin: str,
    states: bool,
) -> "xarray.Dataset":
    """Every trajectory, and its Welch power, to a store; opened when it is complete."""
    import xarray

    attributes = about(layout) | identity(layout, {"kind": "trajectories", "states": states})
    variables, coordinates = variables_of(layout, states=states)
    with opened(path, variables, coordinates, attributes, begin=begin) as left:
        if left:
            # a worker has a folder of its own to begin at
            place = path if executor is None else path.absolute()
            home = Home(place, attributes[SETTINGS], states)
            failed = {} if left == "new" else _there(layout, home, executor)
            todo = [number for number in range(layout.chunks) if number not in failed]
            results = block_results(layout, todo, home.write, executor, Clock(layout, todo, tell))
            with contextlib.closing(results):
                for part, more in results:
                    failed[part[0]] = more
            _settle(path)
            finish(path, [entry for entries in failed.values() for entry in entries])
        return xarray.open_zarr(path)


def _there(layout: Layout, home: Home, executor: AnyExecutor | None) -> dict[int, Failed]:
    """The chunks that are in a store as they were written, and the (point, seed) that failed in
    them. What is damaged is taken back."""
    there: dict[int, Failed] = {}
    lost: list[str] = []
    with ThreadPoolExecutor() as threads:
        pool = threads if executor is None else executor
        look = functools.partial(home.look, layout._replace(mesh=None))
        for _, (some, bad) in results_of(pool, look, blocks_of(range(layout.chunks), pool)):
            there |= some
            lost += bad
    if lost:
        take_back(home.path, lost)
    return there


def _settle(path: Path) -> None:
    """Wait until all chunks are on disk."""
    keys = list(computed_keys(description_of(path)))
    missing = [key for key in keys if not (path / key).exists()]
    if missing:
        raise StoreError(
            f"{path}: {in_words(missing)} although all is done: is the folder the same for all"
            " workers? Resume (--resume, resume=True) in a folder that they share"
        )
    settle(path, keys)
