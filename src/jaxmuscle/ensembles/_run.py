"""Ensembles that outlive their process: reduced while they run, or streamed to a store, by one process or many."""

import hashlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Int

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.environment import versions
from jaxmuscle._common.errors import SimulationError, StoreError
from jaxmuscle._common.text import squared
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.response._expected import linear_spectrum
from jaxmuscle.simulation._trajectory import run_attributes

from ._layout import Chunk, Cut, Layout, Pace, run_chunks
from ._processes import agreed, meet, rank_and_count
from ._running_moments import CELLS, add, count_cells, empty, set_cells
from ._store import (
    SETTINGS,
    Begin,
    Reduced,
    Variable,
    attributes_of,
    begin_log,
    complete,
    create,
    log_chunk,
    logged,
    read_tallies,
    state_of,
    tally_files,
    write_moments,
    write_region,
)
from ._summary import EnsembleSummary, summarised
from ._sweep import Sweep

if TYPE_CHECKING:
    import xarray


KEEP_EVERY = 10.0  # seconds between two copies of a tally on disk
KEEP_SHARE = 20  # and at least this many times what writing one took

Tell = Callable[[Pace], None]


def reduced(layout: Layout, levels: tuple[float, ...], path: Path | None, tell: Tell, *, begin: Begin) -> EnsembleSummary:
    """Moments, quantiles and the mean spectrum of all chunks; kept in a store from time to time if there is one."""
    settings = settings_of(layout) | {"kind": "reduced", "quantiles": list(levels)}
    values = _time(layout).size + (2 * _bins(layout) + 1 if _bins(layout) else 0)

    def nothing() -> Reduced:
        tally = empty(layout.points, values, _time(layout).size, len(levels), whole=layout.whole)
        return Reduced(tally, frozenset(), [])

    blank = _summary(layout, levels, nothing())
    if path is None:
        found = _reduce(layout, levels, nothing(), range(layout.chunks), tell, lambda found: None)
        return _summary(layout, levels, found)
    variables = {name: Variable(dims, array.shape, array.shape, array.dtype, units,
                                array if name in blank.coordinates() else None)
                 for name, (dims, array, units) in blank.arrays().items()}  # fmt: skip
    if _opened(path, variables, blank.coordinates(), blank.attributes(), settings, begin=begin):
        _share_tallies(layout, levels, path, tell, nothing)
        if rank_and_count()[0] == 0:
            whole = _summary(layout, levels, read_tallies(path, nothing()))
            write_region(path, ..., {name: array for name, (_, array, _) in whole.arrays().items()})
            complete(path, {"failed": json.dumps(whole.failed.tolist())})
        meet()
    return _loaded(path, blank)


def _share_tallies(
    layout: Layout, levels: tuple[float, ...], path: Path, tell: Tell, nothing: Callable[[], Reduced]
) -> None:
    """Every process reduces its share of what no tally in the store has yet; process 0 takes over those there are."""
    rank, count = rank_and_count()
    base, old = read_tallies(path, nothing()), tally_files(path)
    todo = [n for n in range(layout.chunks) if n not in base.chunks][rank::count]
    name = f"{1 + max((int(file.stem.split('-')[1]) for file in old), default=0):06d}-{rank:06d}"
    meet()  # all know what is left before anybody adds to it
    if rank == 0 and old:
        write_moments(path, name, base)
        for file in old:
            file.unlink(missing_ok=True)
    found = _reduce(layout, levels, base if rank == 0 else nothing(), todo, tell, _keeper(path, name))
    write_moments(path, name, found)
    meet()


def _reduce(
    layout: Layout, levels: tuple[float, ...], found: Reduced, numbers: Any, tell: Tell, keep: Callable[[Reduced], None]
) -> Reduced:
    """Chunks into a tally, which starts as `found`."""
    tally, chunks, failed = found.tally, set(found.chunks), list(found.failed)
    for chunk, result in run_chunks(layout, numbers, tell):
        for row, point in enumerate(chunk.points):
            finite = result["finite"][row]
            output = result["output"][row][finite]
            add(tally, point, _rows(layout, result, row)[finite])
            if layout.whole:
                if len(output):
                    tally.exact[point] = np.quantile(output, levels, axis=0)
                continue
            if np.isnan(tally.low[point]).any():
                set_cells(tally, point, _cell_sample(layout, chunk, point, output))
            count_cells(tally, point, output)
        chunks.add(chunk.number)
        failed += _failed(layout, chunk, result)
        keep(Reduced(tally, frozenset(chunks), failed))
    return Reduced(tally, frozenset(chunks), failed)


def _failed(layout: Layout, chunk: Chunk, found: dict[str, np.ndarray]) -> list[list[int]]:
    """Point and seed of what did not stay finite."""
    return [[chunk.points[i], int(layout.seeds[chunk.seeds[j]])] for i, j in np.argwhere(~found["finite"])]


def _cell_sample(layout: Layout, chunk: Chunk, point: int, output: np.ndarray) -> np.ndarray:
    """Output of the first chunk of a point, by which every process places its cells."""
    first = layout.first_of(point)
    if chunk.number != first:
        (_, found), = run_chunks(layout, [first], lambda pace: None)  # fmt: skip
        output = found["output"][0][found["finite"][0]]
    if len(output) == 0:
        raise SimulationError(f"none of the first seeds of point {point} stayed finite: lower the noise amplitude or dt")
    return output


def _rows(layout: Layout, found: dict[str, np.ndarray], row: int) -> np.ndarray:
    """The values of every seed that are averaged: output, Welch power, what the linear response leaves of it, variation."""
    output = found["output"][row]
    if not _bins(layout):
        return output.astype(float)
    power = found["power"][row]
    left = power - found["linear_power"][row] if layout.linear is not None else np.zeros_like(power)
    return np.concatenate([output, power, left, found["variation"][row][:, None]], axis=1, dtype=float)


def _keeper(path: Path, name: str) -> Callable[[Reduced], None]:
    """Writes what it is given, not too often."""
    due = time.monotonic() + KEEP_EVERY

    def keep(found: Reduced) -> None:
        nonlocal due
        begun = time.monotonic()
        if begun >= due:
            write_moments(path, name, found)
            now = time.monotonic()
            due = now + max(KEEP_EVERY, KEEP_SHARE * (now - begun))

    return keep


def stored(layout: Layout, path: Path, tell: Tell, *, begin: Begin, states: bool) -> "xarray.Dataset":
    """Every trajectory, and its Welch power, to a store; opened when it is complete."""
    import xarray

    settings = settings_of(layout) | {"kind": "trajectories", "states": states}
    variables, coordinates = _variables(layout, states=states)
    if _opened(path, variables, coordinates, _about(layout), settings, begin=begin):
        rank, count = rank_and_count()
        done = logged(path)
        meet()
        begin_log(path, rank)
        todo = [n for n in range(layout.chunks) if n not in done][rank::count]
        for chunk, found in run_chunks(layout, todo, tell):
            region, parts = _region(layout, chunk, found, states=states)
            write_region(path, region, parts)
            log_chunk(path, rank, chunk.number, _failed(layout, chunk, found))
        meet()
        if rank == 0:
            there = logged(path)
            missing = layout.chunks - len(there)
            if missing:
                raise StoreError(f"{path}: {missing} chunks are missing although all processes are done: is the folder the "
                                 "same for all of them? Resume on a shared file system")  # fmt: skip
            failed = [entry for number in sorted(there) for entry in there[number]]
            complete(path, {"failed": json.dumps(failed)})
        meet()
    return xarray.open_zarr(path)


def begun_with(path: Path) -> Cut | None:
    """How an existing store was cut, so that it can be resumed with other devices; None if there is none."""
    if not path.exists():
        return None
    settings = json.loads(attributes_of(path).get(SETTINGS, "{}"))
    return Cut(settings["points at once"], settings["chunk"]) if "chunk" in settings else None


def _opened(
    path: Path, variables: dict[str, Variable], coordinates: list[str], attributes: dict, settings: dict, *, begin: Begin
) -> bool:
    """Make or find the store, as process 0 sees it; whether there is work left. All processes raise the same error."""
    said, failure = "", None
    if rank_and_count()[0] == 0:
        try:
            said = state_of(path, settings, begin=begin)
            if said == "absent":
                create(path, variables, coordinates, attributes | {SETTINGS: json.dumps(settings)})
        except (ValueError, OSError) as error:
            said, failure = f"error: {error}", error
    said = agreed(said)
    if failure is not None:
        raise failure
    if said.startswith("error: "):
        raise StoreError(said.removeprefix("error: "))
    if not path.exists():
        raise StoreError(f"{path}: process {rank_and_count()[0]} does not see what process 0 made: give a folder that all "
                         "processes share")  # fmt: skip
    return said != "complete"


def _variables(layout: Layout, *, states: bool) -> tuple[dict[str, Variable], list[str]]:
    task, time_, swept = layout.task_of(0), _time(layout), isinstance(layout.task, Sweep)
    lead, shape = (("point",), (layout.points,)) if swept else ((), ())
    cut = (layout.together,) if swept else ()
    width, seeds = min(layout.width, len(layout.seeds)), len(layout.seeds)
    dtype = np.dtype(jax.numpy.result_type(float))
    found = {
        "seed": Variable(("seed",), (seeds,), (seeds,), np.int64, "", np.asarray(layout.seeds)),
        "time": Variable(("time",), (time_.size,), (time_.size,), float, "s", time_),
        task.output_name: Variable((*lead, "seed", "time"), (*shape, seeds, time_.size), (*cut, width, time_.size), dtype,
                                   task.output_unit),
    }  # fmt: skip
    units = zip(task.state_names, task.state_units, strict=True) if states else ()
    for name, unit in units:
        found.setdefault(name, found[task.output_name]._replace(units=unit))
    coordinates = ["seed", "time"]
    if _bins(layout):
        bins, frequency = _bins(layout), task.settings.frequency
        found["frequency"] = Variable(("frequency",), (bins,), (bins,), float, "Hz", frequency)
        found["power"] = Variable((*lead, "seed", "frequency"), (*shape, seeds, bins), (*cut, width, bins), dtype,
                                  squared(task.output_unit) + "/Hz")  # fmt: skip
        coordinates.append("frequency")
    if isinstance(layout.task, Sweep):
        for name, values in layout.task.labels.items():
            unit = PARAMETERS[name].unit if name in PARAMETERS else ""
            found[name] = Variable(("point",), values.shape, values.shape, values.dtype, unit, values)
            coordinates.append(name)
    return found, coordinates


def _region(
    layout: Layout, chunk: Chunk, found: dict[str, np.ndarray], *, states: bool
) -> tuple[tuple[slice, ...], dict[str, np.ndarray]]:
    task = layout.task_of(0)
    parts = {task.output_name: found["output"]} | ({"power": found["power"]} if _bins(layout) else {})
    if states:
        for i, name in enumerate(task.state_names):
            parts.setdefault(name, found["states"][..., i])
    region = slice(chunk.points.start, chunk.points.stop), slice(chunk.seeds.start, chunk.seeds.stop)
    if not isinstance(layout.task, Sweep):
        return region[1:], {name: values[0] for name, values in parts.items()}
    return region, parts


def _bins(layout: Layout) -> int:
    return 0 if layout.recipe.edges is None else layout.recipe.settings.frequency.size


def _time(layout: Layout) -> np.ndarray:
    return np.arange(layout.plan.grid.steps // layout.plan.grid.every + 1) / layout.plan.rate


def _summary(layout: Layout, levels: tuple[float, ...], found: Reduced) -> EnsembleSummary:
    expected = None
    if _bins(layout) and layout.linear is not None:
        spectra = [linear_spectrum(layout.task_of(i), layout.recipe.settings) for i in range(layout.points)]
        expected = np.stack([np.asarray(spectrum.power, float) for spectrum in spectra])
    failed: Int[np.ndarray, "failed 2"] = np.array(sorted(found.failed), int).reshape(-1, 2)
    about = _about(layout) | ({} if layout.whole else {"cells_per_quantile": CELLS})
    return summarised(found.tally, layout.task, (len(layout.seeds), _bins(layout)), _time(layout), levels,
                      layout.recipe.settings, expected, failed, about)  # fmt: skip


def _loaded(path: Path, blank: EnsembleSummary) -> EnsembleSummary:
    """The summary in a complete store."""
    import zarr

    group: Any = zarr.open_group(path, mode="r")
    failed = np.array(json.loads(attributes_of(path)["failed"]), int).reshape(-1, 2)
    return blank.with_arrays({name: np.asarray(group[name][...]) for name in blank.arrays()}, failed)


def _about(layout: Layout) -> dict[str, Any]:
    """What was run, as attributes."""
    plan, labels = layout.plan, layout.task.labels if isinstance(layout.task, Sweep) else ()
    made = run_attributes(layout.task_of(0), plan.rate, plan.grid.dt, plan.grid.substeps, plan.sampling, labels)
    return made | {"precision": str(jax.numpy.result_type(float))}


def settings_of(layout: Layout) -> dict[str, Any]:
    """All that the numbers depend on, for a store that is resumed to be compared with."""
    task, plan = layout.task_of(0), layout.plan
    numbers = layout.task.task if isinstance(layout.task, Sweep) else as_numbers(layout.task)
    everything = _digest(str(jax.tree.structure(numbers)), *jax.tree.leaves(numbers))
    seeds = layout.seeds
    given = f"0 to {len(seeds) - 1}" if isinstance(seeds, range) else f"{len(seeds)}, digest {_digest(seeds)}"
    parameters = {name: float(value) for name, value in as_numbers(task.parameters).items()}
    return {
        "task": type(task).__name__, "muscle": type(task.muscle).__name__, "noise": type(task.noise).__name__,
        "points": layout.points, "parameters": parameters, "inputs and everything else": everything,
        "key": np.asarray(jax.random.key_data(layout.key)).ravel().tolist(), "seeds": given, "duration": layout.duration,
        "dt": plan.grid.dt, "rate": plan.rate, "substeps": plan.grid.substeps, "sampling": plan.sampling,
        "spectrum": task.settings.to_dict(), "control": layout.linear is not None, "chunk": layout.width,
        "points at once": layout.together, "precision": str(jax.numpy.result_type(float)),
        "versions": {name: versions()[name] for name in ("jaxmuscle", "jax")},
    }  # fmt: skip


def _digest(*values: Any) -> str:
    found = hashlib.sha256()
    for value in values:
        found.update(value.encode() if isinstance(value, str) else np.asarray(value).tobytes())
    return found.hexdigest()[:16]
