"""Ensembles that outlive their process: reduced while they run, or streamed to a store, by one
process or many."""

import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Int

from jaxmuscle._common.errors import SimulationError
from jaxmuscle.response._expected_moments import linear_spectrum

from ._arrays import region_of, variables_of
from ._layout import Chunk, Layout, Pace, run_chunks
from ._mending import drop_damaged
from ._opening import opened
from ._parts import Part, PartReport, failed_in, finish
from ._places import AbstractPlace
from ._processes import meet, rank_and_count
from ._running_moments import (
    CELLS,
    ChunkMoments,
    RunningMoments,
    add,
    count_cells,
    empty,
    moments,
    set_cells,
)
from ._settings import about, identity
from ._store import PARTS, Begin, Variable, chunk_log, ensemble_at, logged, write_region
from ._summary import EnsembleSummary, summarised
from ._tallies import (
    Reduced,
    generation_of,
    read_tallies,
    read_tally,
    tally_key,
    tally_keys,
    write_tally,
)

if TYPE_CHECKING:
    import xarray


KEEP_EVERY = 10.0  # seconds between two copies of a tally on disk
KEEP_SHARE = 20  # and at least this many times what writing one took

Tell = Callable[[Pace], None]


def reduced(
    layout: Layout,
    levels: tuple[float, ...],
    place: AbstractPlace | None,
    tell: Tell,
    *,
    begin: Begin = "new",
    part: Part | None = None,
) -> EnsembleSummary | PartReport:
    """Moments, quantiles and the mean spectrum of all chunks; kept in a store from time to time if
    there is one.

    Of one part its chunks only, whose tally stays in the store until it is merged.
    """
    identified = identity(layout, part, {"kind": "reduced", "quantiles": list(levels)})
    values = layout.time.size + (2 * layout.bins + 1 if layout.bins else 0)

    def nothing() -> Reduced:
        tally = empty(layout.points, values, layout.time.size, len(levels), whole=layout.whole)
        return Reduced(tally, frozenset(), [])

    blank = _summary(layout, levels, nothing())
    if place is None:
        found = _reduce(layout, levels, nothing(), range(layout.chunks), tell, lambda found: None)
        return _summary(layout, levels, found)
    known = {*blank.coordinates(), "power_expected"}
    variables = {
        name: Variable(
            dims, array.shape, array.shape, array.dtype, units, array if name in known else None
        )
        for name, (dims, array, units) in blank.arrays().items()
    }
    attributes = blank.attributes() | identified
    with opened(
        layout, place, variables, blank.coordinates(), attributes, begin=begin, part=part
    ) as left:
        if part is not None:
            failed = (
                _reduce_part(layout, levels, place, part, tell, nothing)
                if left
                else failed_in(place)
            )
            return _report(layout, part, failed, complete=not left)
        if left:
            _reduce_all(layout, levels, place, tell, nothing)
            _finished(layout, place)
        # Before the lock is given back: whoever overwrites the store could come in between.
        return _loaded(place, blank)


def _finished(layout: Layout, place: AbstractPlace) -> None:
    """Process 0 makes the store complete, once all are done."""
    if rank_and_count()[0] == 0:
        finish(place, layout.chunks)
    meet()


def _reduce_all(
    layout: Layout,
    levels: tuple[float, ...],
    place: AbstractPlace,
    tell: Tell,
    nothing: Callable[[], Reduced],
) -> None:
    """All that is left; of a store made in parts, which was damaged, part by part, so that the
    numbers are the same."""
    parts = ensemble_at(place).get(PARTS)
    if parts is None:
        return _share_tallies(layout, levels, place, tell, nothing)
    rank, count = rank_and_count()
    for number in range(1, parts + 1)[rank::count]:
        _reduce_part(layout, levels, place, Part(number, parts), tell, nothing)
    meet()


def _share_tallies(
    layout: Layout,
    levels: tuple[float, ...],
    place: AbstractPlace,
    tell: Tell,
    nothing: Callable[[], Reduced],
) -> None:
    """Every process reduces its share of what no tally in the store has yet; process 0 takes over
    those there are."""
    rank, count = rank_and_count()
    base, old = read_tallies(place) or nothing(), tally_keys(place)
    todo = [n for n in range(layout.chunks) if n not in base.chunks][rank::count]
    key = tally_key(1 + max(map(generation_of, old), default=0), rank)
    meet()  # all know what is left before anybody adds to it
    if rank == 0 and old:
        write_tally(place, key, base)
        place.remove(*old)
    found = _reduce(
        layout,
        levels,
        base if rank == 0 else nothing(),
        todo,
        tell,
        lambda found: write_tally(place, key, found),
    )
    write_tally(place, key, found)
    meet()


def _reduce_part(
    layout: Layout,
    levels: tuple[float, ...],
    place: AbstractPlace,
    part: Part,
    tell: Tell,
    nothing: Callable[[], Reduced],
) -> list[list[int]]:
    """One part goes on with its own tally, and no other process writes that; the (point, seed) that
    failed."""
    key = tally_key(0, part.number)
    base = read_tally(place, key) or nothing()
    todo = [n for n in part.chunks(layout.chunks) if n not in base.chunks]
    if todo:
        base = _reduce(
            layout, levels, base, todo, tell, lambda found: write_tally(place, key, found)
        )
        write_tally(place, key, base)
    return base.failed


def _reduce(
    layout: Layout,
    levels: tuple[float, ...],
    found: Reduced,
    numbers: Any,
    tell: Tell,
    save: Callable[[Reduced], None],
) -> Reduced:
    """Chunks into a tally, which starts as `found`; saved from time to time, and when
    interrupted."""
    tally, chunks, failed = found.tally, set(found.chunks), list(found.failed)
    known = np.flatnonzero(~np.isnan(tally.low).any(axis=1))
    edges: dict[int, Edges] = {int(point): (tally.low[point], tally.high[point]) for point in known}
    keep, adding = _keeper(save), False

    def condensed(chunk: Chunk, result: dict[str, np.ndarray]) -> Condensed:
        """On the thread that has simulated the chunk."""
        each = [
            _moments(layout, levels, result, row, edges.get(point))
            for row, point in enumerate(chunk.points)
        ]
        return Condensed(each, _failed(layout, chunk, result), result["output"], result["finite"])

    try:
        with contextlib.closing(run_chunks(layout, numbers, tell, condensed)) as results:
            for chunk, more in results:
                adding = True
                _add_chunk(layout, tally, edges, chunk, more)
                failed += more.failed
                chunks.add(chunk.number)
                adding = False
                keep(Reduced(tally, frozenset(chunks), failed))
    except KeyboardInterrupt:
        if not adding:  # else the tally holds a part of a chunk: what was saved last stays
            save(Reduced(tally, frozenset(chunks), failed))
        raise
    return Reduced(tally, frozenset(chunks), failed)


Edges = tuple[np.ndarray, np.ndarray]


def _add_chunk(
    layout: Layout, tally: RunningMoments, edges: dict[int, Edges], chunk: Chunk, more: "Condensed"
) -> None:
    """One chunk into the tally. The first one of a point says where the cells of the point lie."""
    for row, point in enumerate(chunk.points):
        part = more.moments[row]
        if part.cells is None and not layout.whole:  # the thread did not know yet where they lie
            output = more.output[row][more.finite[row]]
            if point not in edges:
                set_cells(tally, point, _cell_sample(layout, chunk, point, output))
                edges[point] = tally.low[point], tally.high[point]
            part = part._replace(cells=count_cells(*edges[point], output))
        add(tally, point, part)


class Condensed(NamedTuple):
    """What is left of a chunk: moments of every point, (point, seed) of what failed, and the
    output, whose cells may have to be counted yet."""

    moments: list[ChunkMoments]
    failed: list[list[int]]
    output: np.ndarray
    finite: np.ndarray


def _moments(
    layout: Layout,
    levels: tuple[float, ...],
    result: dict[str, np.ndarray],
    row: int,
    edges: Edges | None,
) -> ChunkMoments:
    """Of one point of a chunk; its cells are counted if their `edges` are known."""
    finite = result["finite"][row]
    stayed = slice(None) if finite.all() else finite  # a slice copies nothing
    output = result["output"][row][stayed]
    found = moments(_rows(layout, result, row)[stayed])
    if layout.whole:
        return found._replace(exact=np.quantile(output, levels, axis=0) if len(output) else None)
    return found if edges is None else found._replace(cells=count_cells(*edges, output))


def _failed(layout: Layout, chunk: Chunk, found: dict[str, np.ndarray]) -> list[list[int]]:
    """Point and seed of what did not stay finite."""
    return [
        [chunk.points[i], int(layout.seeds[chunk.seeds[j]])]
        for i, j in np.argwhere(~found["finite"])
    ]


def _cell_sample(layout: Layout, chunk: Chunk, point: int, output: np.ndarray) -> np.ndarray:
    """Output of the first chunk of a point, by which every process places its cells."""
    first = layout.chunk_of(point, 0)
    if chunk.number != first:
        ((_, found),) = run_chunks(layout, [first], lambda pace: None)
        output = found["output"][0][found["finite"][0]]
    if len(output) == 0:
        raise SimulationError(
            f"none of the first seeds of point {point} stayed finite: lower the noise amplitude"
            " or dt"
        )
    return output


def _rows(layout: Layout, found: dict[str, np.ndarray], row: int) -> np.ndarray:
    """The values of every seed that are averaged: output, Welch power, what the linear response
    leaves of it, variation."""
    output = found["output"][row]
    if not layout.bins:
        return output.astype(float)
    power = found["power"][row]
    left = power - found["linear_power"][row] if layout.linear is not None else np.zeros_like(power)
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


def stored(
    layout: Layout,
    place: AbstractPlace,
    tell: Tell,
    *,
    begin: Begin,
    states: bool,
    part: Part | None,
) -> "xarray.Dataset | PartReport":
    """Every trajectory, and its Welch power, to a store; opened when it is complete. Of one part
    its chunks only."""
    import xarray

    attributes = about(layout) | identity(layout, part, {"kind": "trajectories", "states": states})
    variables, coordinates = variables_of(layout, states=states)
    own = range(layout.chunks) if part is None else part.chunks(layout.chunks)
    with opened(layout, place, variables, coordinates, attributes, begin=begin, part=part) as left:
        if left:
            _write_chunks(layout, place, own, tell, states=states)
        if part is not None:
            there = logged(place, own)
            failed = (
                [entry for number in sorted(there) for entry in there[number]]
                if left
                else failed_in(place)
            )
            return _report(layout, part, failed, complete=not left)
        if left:
            _finished(layout, place)
        return xarray.open_zarr(place.opened())


def _write_chunks(
    layout: Layout, place: AbstractPlace, own: range, tell: Tell, *, states: bool
) -> None:
    """Every process writes its share of those of these chunks that are not there, or are
    damaged."""
    rank, count = rank_and_count()
    drop_damaged(place, logged(place, own[rank::count]))
    meet()
    done = logged(place, own)
    meet()  # all know what is left before anybody adds to it
    todo = [n for n in own if n not in done][rank::count]
    with chunk_log(place) as log, contextlib.closing(run_chunks(layout, todo, tell)) as results:
        for chunk, found in results:
            region, parts = region_of(layout, chunk, found, states=states)
            write_region(place, region, parts)
            log(chunk.number, _failed(layout, chunk, found))
    meet()


def _report(layout: Layout, part: Part, failed: list[list[int]], *, complete: bool) -> PartReport:
    chunks = [layout.chunk(number) for number in part.chunks(layout.chunks)]
    seeds = sum(len(chunk.points) * len(chunk.seeds) for chunk in chunks)
    return PartReport(*part, seeds, np.array(sorted(failed), int).reshape(-1, 2), complete)


def _summary(layout: Layout, levels: tuple[float, ...], found: Reduced) -> EnsembleSummary:
    expected = None
    if layout.bins and layout.linear is not None:
        spectra = [
            linear_spectrum(layout.task_of(i), layout.recipe.settings) for i in range(layout.points)
        ]
        expected = np.stack([np.asarray(spectrum.power, float) for spectrum in spectra])
    failed: Int[np.ndarray, "failed 2"] = np.array(sorted(found.failed), int).reshape(-1, 2)
    described = about(layout) | ({} if layout.whole else {"cells_per_quantile": CELLS})
    return summarised(layout, found.tally, levels, expected, failed, described)


def _loaded(place: AbstractPlace, blank: EnsembleSummary) -> EnsembleSummary:
    """The summary in a complete store."""
    import zarr

    group: Any = zarr.open_group(place.opened(), mode="r")
    failed = np.array(failed_in(place), int).reshape(-1, 2)
    return blank.with_arrays(
        {name: np.asarray(group[name][...]) for name in blank.arrays()}, failed
    )
