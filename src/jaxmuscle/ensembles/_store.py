"""Ensembles as zarr stores: written chunk by chunk by one or many processes, resumed, never complete before they are."""

import contextlib
import io
import json
import warnings
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmuscle._common.errors import StoreError

from ._places import PROGRESS, ROOT, AbstractPlace, place_of
from ._running_moments import RunningMoments, merged

Begin = Literal["new", "resume", "overwrite", "part"]
SETTINGS, PARTS, CHUNKS = "settings", "parts", "chunks"
DONE, TALLY = f"{PROGRESS}/chunk-", f"{PROGRESS}/tally-"


class Variable(NamedTuple):
    """An array of a store: its dimensions and shape, how it is cut, and what is known of it at the start (NaN if None)."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: Any
    units: str
    values: np.ndarray | None = None


def create(
    place: AbstractPlace, variables: Mapping[str, Variable], coordinates: list[str], attributes: dict[str, Any]
) -> bool:
    """A new, incomplete store, which appears whole or not at all; False if another process was faster.

    **Raises:** `StoreError` if another has begun it with other settings.
    """
    with writing(place):
        _refuse(place, json.loads(place.claim(attributes[SETTINGS])), json.loads(attributes[SETTINGS]))
        with place.building() as folder:
            _build(folder, variables, coordinates, attributes)
            return place.put(folder)


def _build(folder: Path, variables: Mapping[str, Variable], coordinates: list[str], attributes: dict[str, Any]) -> None:
    import zarr

    labels = [name for name in coordinates if variables[name].dims != (name,)]
    group = zarr.open_group(folder, mode="w", zarr_format=3)
    group.attrs.update(attributes | ({"coordinates": " ".join(labels)} if labels else {}) | {"complete": False})
    for name, v in variables.items():
        fill = np.nan if np.issubdtype(np.dtype(v.dtype), np.floating) else None
        dtype = "string" if np.dtype(v.dtype).kind == "U" else v.dtype  # fixed width is not in the specification
        array = group.create_array(name, shape=v.shape, chunks=v.chunks, dtype=dtype, dimension_names=v.dims,
                                   fill_value=fill, attributes={"units": v.units} if v.units else {})  # fmt: skip
        if v.values is not None:
            array[...] = v.values
    with warnings.catch_warnings():
        # A copy of all arrays' metadata at the root, where xarray looks for it first.
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part", category=UserWarning)
        zarr.consolidate_metadata(folder)


@contextlib.contextmanager
def writing(place: AbstractPlace) -> Iterator[None]:
    """What the system refuses (a full disk, a folder without permission) becomes an error with the way on."""
    try:
        yield
    except OSError as error:
        remedy = "what is complete stays: make room, or permission, and resume (--resume, resume=True)"
        raise OSError(error.errno, f"{error.strerror or error}; {remedy}", place.name) from error


def attributes_of(path: str | Path) -> dict[str, Any] | None:
    """Attributes of the store at `path`, a folder or a URL; None if nothing is there.

        jm.ensembles.attributes_of("runs.zarr")["complete"]

    **Raises:** `StoreError` if something else is there, or if the URL cannot be used.
    """
    place = place_of(path)
    return attributes_at(place) if place.exists() else None


def attributes_at(place: AbstractPlace) -> dict[str, Any]:
    """Attributes of a store. **Raises:** `StoreError` if there is none."""
    try:
        root = place.read(ROOT)
        if root is None:
            raise ValueError(f"no {ROOT}")
        return json.loads(root)["attributes"]
    except (OSError, ValueError, KeyError) as error:
        raise StoreError(f"{place.name}: is not a store that jaxmuscle wrote ({error}); give another name") from None


def state_of(place: AbstractPlace, wanted: dict[str, Any], *, begin: Begin) -> str:
    """Whether a store of these attributes is "absent", "begun" or "complete"; one that is to be overwritten is removed.

    **Raises:** `StoreError` if it is there and not to be resumed, was made with other settings (named) or in other parts.
    """
    if not place.exists():
        return "absent"
    if begin == "new":
        raise StoreError(f"{place.name}: exists already; resume it (--resume, resume=True), overwrite it (--force, "
                         "overwrite=True), or give another name")  # fmt: skip
    found = ensemble_at(place)
    if begin == "overwrite":
        with writing(place):
            place.clear()
        return "absent"
    _refuse(place, json.loads(found[SETTINGS]), json.loads(wanted[SETTINGS]))
    if found["complete"]:
        return "complete"
    there = found.get(PARTS)
    if there != wanted.get(PARTS):
        made, remedy = ("without parts", "resume it without --part, part=") if there is None else (
            f"in {there} parts", f"run each with --part I/{there}, part=(i, {there}), then merge them (jaxmuscle merge)"
        )  # fmt: skip
        raise StoreError(f"{place.name}: is being made {made}: {remedy}, or give another name")
    return "begun"


def ensemble_at(place: AbstractPlace) -> dict[str, Any]:
    """Attributes of an ensemble's store. **Raises:** `StoreError` if it is something else."""
    attributes = attributes_at(place)
    if SETTINGS not in attributes or "complete" not in attributes:
        raise StoreError(f"{place.name}: is not an ensemble that can be resumed (no settings in it); give another name")
    return attributes


def _refuse(place: AbstractPlace, there: dict[str, Any], here: dict[str, Any]) -> None:
    if "random numbers" not in there:
        raise StoreError(f"{place.name}: was begun by an earlier version of jaxmuscle, whose seeds have other noise. So it "
                         "cannot go on: begin it anew (--force, overwrite=True), or give another name")  # fmt: skip
    different = differences(there, here)
    if different:
        raise StoreError(
            f"{place.name}: was made with other settings: {'; '.join(different)}. Repeat them, or give another name"
        )


def differences(there: Any, here: Any, name: str = "") -> list[str]:
    """What differs between two tables of settings, one line each."""
    if isinstance(there, dict) and isinstance(here, dict):
        keys = [*there, *(key for key in here if key not in there)]
        return [
            line for key in keys for line in differences(there.get(key), here.get(key), f"{name}.{key}" if name else key)
        ]
    return [] if there == here else [f"{name} = {_short(there)} there, {_short(here)} here"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def write_region(place: AbstractPlace, region: Any, values: Mapping[str, np.ndarray]) -> None:
    """Write part of some arrays; the region cuts their leading dimensions."""
    import zarr

    with writing(place):
        group = zarr.open_group(place.opened(), mode="r+")
        for name, part in values.items():
            array: Any = group[name]
            array[region] = part


def log_chunk(place: AbstractPlace, chunk: int, failed: list[list[int]]) -> None:
    """A chunk has been written, with these failed (point, seed)."""
    with writing(place):
        place.write(f"{DONE}{chunk:08d}.json", json.dumps(failed).encode())


def logged(place: AbstractPlace, among: Iterable[int] | None = None) -> dict[int, list[list[int]]]:
    """Complete chunks of a store of trajectories, all or `among` these, with the (point, seed) that failed in them."""
    keys = {int(key.removeprefix(DONE)[:8]): key for key in place.progress() if key.startswith(DONE)}
    numbers = sorted(keys.keys() if among is None else keys.keys() & set(among))
    with ThreadPoolExecutor() as pool:  # an object store takes tens of milliseconds for each
        found = pool.map(lambda number: place.read(keys[number]), numbers)
        return {number: json.loads(data) for number, data in zip(numbers, found, strict=True) if data is not None}


class Reduced(NamedTuple):
    """A tally, the chunks in it, and the (point, seed) that failed in them."""

    tally: RunningMoments
    chunks: frozenset[int]
    failed: list[list[int]]


def write_tally(place: AbstractPlace, key: str, reduced: Reduced) -> None:
    """Keep what was reduced so far; replaces the key in one step."""
    data = io.BytesIO()
    np.savez(data, chunks=np.array(sorted(reduced.chunks), int), failed=np.array(reduced.failed, int).reshape(-1, 2),
             **reduced.tally._asdict())  # fmt: skip
    with writing(place):
        place.write(key, data.getvalue())


def read_tally(place: AbstractPlace, key: str) -> Reduced | None:
    """What was kept under a key, None if there is nothing."""
    kept = place.read(key)
    if kept is None:
        return None
    with np.load(io.BytesIO(kept)) as data:
        tally = RunningMoments(*(data[name] for name in RunningMoments._fields))
        return Reduced(tally, frozenset(data["chunks"].tolist()), data["failed"].tolist())


def read_tallies(place: AbstractPlace) -> Reduced | None:
    """All tallies of a store together, None if there is none; those that a later one contains are not counted twice."""
    whole = None
    for key in reversed(tally_keys(place)):
        part = read_tally(place, key)
        if part is None or whole is None:
            whole = part or whole
        elif not part.chunks & whole.chunks:
            whole = Reduced(merged(whole.tally, part.tally), whole.chunks | part.chunks, whole.failed + part.failed)
    return whole


def tally_keys(place: AbstractPlace) -> list[str]:
    """Keys that hold tallies."""
    return [key for key in place.progress() if key.startswith(TALLY)]


def tally_key(generation: int, rank: int) -> str:
    """Key of a process's tally; one of a later generation contains those of the earlier ones that it shares a chunk with."""
    return f"{TALLY}{generation:06d}-{rank:06d}.npz"


def generation_of(key: str) -> int:
    """Generation of a tally."""
    return int(key.removeprefix(TALLY)[:6])


def complete(place: AbstractPlace, attributes: dict[str, Any]) -> None:
    """Say that a store is complete, then drop what was needed to resume it."""
    with writing(place):
        document = json.loads(place.read(ROOT) or b"")
        document["attributes"] |= attributes | {"complete": True}
        place.write(ROOT, (json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode())
        place.forget()
