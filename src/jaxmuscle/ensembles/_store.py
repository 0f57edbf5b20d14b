"""Ensembles as zarr stores: written chunk by chunk by one or many processes, resumed, never
complete before they are."""

import contextlib
import json
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmuscle._common.errors import StoreError

from ._integrity import (
    CHECKSUM,
    Document,
    keys_of_array,
    keys_of_chunk,
    require_intact,
    sealed,
    stamped,
    unsealed,
)
from ._places import PROGRESS, ROOT, AbstractPlace, place_of

Begin = Literal["new", "resume", "overwrite", "part"]
SETTINGS, PARTS, CHUNKS = "settings", "parts", "chunks"
DONE = f"{PROGRESS}/chunk-"
LOG_EVERY = 1.0  # seconds between two moments at which chunks are on disk, and said to be
OPENING = threading.Lock()  # of what changes settings of the whole process for a moment


class Variable(NamedTuple):
    """An array of a store: its dimensions and shape, how it is cut, and what is known of it at the
    start (NaN if None)."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: Any
    units: str
    values: np.ndarray | None = None


def create(
    place: AbstractPlace,
    variables: Mapping[str, Variable],
    coordinates: list[str],
    attributes: dict[str, Any],
) -> bool:
    """A new, incomplete store, which appears whole or not at all; False if another process was
    faster.

    **Raises:** `StoreError` if another has begun it with other settings.
    """
    with writing(place):
        _refuse(
            place, json.loads(place.claim(attributes[SETTINGS])), json.loads(attributes[SETTINGS])
        )
        with place.building() as folder:
            _build(folder, variables, coordinates, attributes)
            return place.put(folder)


def _build(
    folder: Path,
    variables: Mapping[str, Variable],
    coordinates: list[str],
    attributes: dict[str, Any],
) -> None:
    import zarr
    from zarr.codecs import Crc32cCodec, ZstdCodec

    labels = [name for name in coordinates if variables[name].dims != (name,)]
    group = zarr.open_group(folder, mode="w", zarr_format=3)
    group.attrs.update(
        attributes | ({"coordinates": " ".join(labels)} if labels else {}) | {"complete": False}
    )
    for name, v in variables.items():
        fill = np.nan if np.issubdtype(np.dtype(v.dtype), np.floating) else None
        # fixed width is not in the specification
        dtype = "string" if np.dtype(v.dtype).kind == "U" else v.dtype
        group.create_array(
            name,
            shape=v.shape,
            chunks=v.chunks,
            dtype=dtype,
            dimension_names=v.dims,
            fill_value=fill,
            compressors=(ZstdCodec(), Crc32cCodec()),
            attributes={"units": v.units} if v.units else {},
        )
    with OPENING, warnings.catch_warnings():
        # A copy of all arrays' metadata at the root, where xarray looks for it first.
        warnings.filterwarnings(
            "ignore", "Consolidated metadata is currently not part", category=UserWarning
        )
        zarr.consolidate_metadata(folder)
    for name, array in _arrays(
        folder, [name for name, v in variables.items() if v.values is not None]
    ).items():
        array[...] = variables[name].values
    document = json.loads((folder / ROOT).read_text(encoding="utf-8"))
    (folder / ROOT).write_bytes(text_of(stamped(document)))


def _arrays(opened: Any, names: Iterable[str]) -> dict[str, Any]:
    """Arrays of a store, which write every chunk: that one is not there must mean that it was
    lost."""
    import zarr

    with OPENING, zarr.config.set({"array.write_empty_chunks": True}):
        group: Any = zarr.open_group(opened, mode="r+")
        return {name: group[name] for name in names}


def text_of(document: Document) -> bytes:
    """A description as it is kept."""
    return json.dumps(document, indent=2, allow_nan=False).encode()


@contextlib.contextmanager
def writing(place: AbstractPlace) -> Iterator[None]:
    """What the system refuses (a full disk, a folder without permission) becomes an error with the
    way on."""
    try:
        yield
    except OSError as error:
        remedy = (
            "what is complete stays: make room, or permission, and resume (--resume, resume=True)"
        )
        raise OSError(error.errno, f"{error.strerror or error}; {remedy}", place.name) from error


def attributes_of(path: str | Path) -> dict[str, Any] | None:
    """Attributes of the store at `path`, a folder or a URL; None if nothing is there.

        jm.ensembles.attributes_of("runs.zarr")["complete"]

    **Raises:** `StoreError` if something else is there, or if the URL cannot be used.
    """
    place = place_of(path)
    return attributes_at(place) if place.exists() else None


def attributes_at(place: AbstractPlace) -> dict[str, Any]:
    """Attributes of a store. **Raises:** `StoreError` if there is none, or if they are damaged."""
    document = _document(place)
    if CHECKSUM in document["attributes"]:
        require_intact(place, document)
    return document["attributes"]


def _document(place: AbstractPlace) -> Document:
    try:
        root = place.read(ROOT)
        if root is None:
            raise ValueError(f"no {ROOT}")
        document = json.loads(root)
        if not isinstance(document["attributes"], dict):
            raise ValueError("no attributes")
        return document
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(
            f"{place.name}: is not a store that jaxmuscle wrote, or its {ROOT} is damaged"
            f" ({error}); give another name"
        ) from None


def state_of(place: AbstractPlace, wanted: dict[str, Any], *, begin: Begin) -> str:
    """Whether a store of these attributes is "absent", to be "overwritten", "begun" or "complete".

    **Raises:** `StoreError` if it is there and not to be resumed, was made with other settings
    (named) or in other parts.
    """
    if not place.exists():
        return "absent"
    if begin == "new":
        raise StoreError(
            f"{place.name}: exists already; resume it (--resume, resume=True), overwrite it"
            " (--force, overwrite=True), or give another name"
        )
    if begin == "overwrite":
        _require_ensemble(place, _document(place)["attributes"])
        return "overwritten"
    found = ensemble_at(place)
    _refuse(place, json.loads(found[SETTINGS]), json.loads(wanted[SETTINGS]))
    if found["complete"]:
        return "complete"
    there = found.get(PARTS)
    if there != wanted.get(PARTS):
        made, remedy = (
            ("without parts", "resume it without --part, part=")
            if there is None
            else (
                f"in {there} parts",
                (
                    f"run each with --part I/{there}, part=(i, {there}), then merge them (jaxmuscle"
                    " merge)"
                ),
            )
        )
        raise StoreError(f"{place.name}: is being made {made}: {remedy}, or give another name")
    return "begun"


def ensemble_at(place: AbstractPlace) -> dict[str, Any]:
    """Attributes of an ensemble's store. **Raises:** `StoreError` if it is something else, or
    damaged."""
    return description_of(place)["attributes"]


def description_of(place: AbstractPlace) -> Document:
    """The whole description of an ensemble's store. **Raises:** `StoreError` if it is something
    else, or damaged."""
    document = _document(place)
    _require_ensemble(place, document["attributes"])
    if "random numbers" in document["attributes"][SETTINGS]:
        require_intact(place, document)
    return document


def _require_ensemble(place: AbstractPlace, attributes: dict[str, Any]) -> None:
    if SETTINGS not in attributes or "complete" not in attributes:
        raise StoreError(
            f"{place.name}: is not an ensemble that can be resumed (no settings in it); give"
            " another name"
        )


def _refuse(place: AbstractPlace, there: dict[str, Any], here: dict[str, Any]) -> None:
    if "random numbers" not in there:
        raise StoreError(
            f"{place.name}: was begun by an earlier version of jaxmuscle, whose seeds have other"
            " noise. So it cannot go on: begin it anew (--force, overwrite=True), or give another"
            " name"
        )
    different = differences(there, here)
    if different:
        raise StoreError(
            f"{place.name}: was made with other settings: {'; '.join(different)}. Repeat them, or"
            " give another name"
        )


def differences(there: Any, here: Any, name: str = "") -> list[str]:
    """What differs between two tables of settings, one line each."""
    if isinstance(there, dict) and isinstance(here, dict):
        keys = [*there, *(key for key in here if key not in there)]
        return [
            line
            for key in keys
            for line in differences(there.get(key), here.get(key), f"{name}.{key}" if name else key)
        ]
    return [] if there == here else [f"{name} = {_short(there)} there, {_short(here)} here"]


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def write_region(place: AbstractPlace, region: Any, values: Mapping[str, np.ndarray]) -> None:
    """Write part of some arrays; the region cuts their leading dimensions."""
    with writing(place):
        for name, array in _arrays(place.opened(), values).items():
            array[region] = values[name]


def write_arrays(place: AbstractPlace, values: Mapping[str, np.ndarray]) -> None:
    """Write whole arrays, which are on disk afterwards."""
    document = _document(place)
    write_region(place, ..., values)
    with writing(place):
        place.settle(key for name in values for key in keys_of_array(document, name))


Log = Callable[[int, list[list[int]]], None]


@contextlib.contextmanager
def chunk_log(place: AbstractPlace) -> Iterator[Log]:
    """What is called with every chunk that has been written, and the (point, seed) that failed in
    it.

    The chunks are put on disk, then said to be there, together every second and at the end: one by
    one it takes far longer.
    """
    document, waiting, due = _document(place), {}, 0.0

    def commit() -> None:
        with writing(place):
            place.settle(key for chunk in waiting for key in keys_of_chunk(document, chunk))
        say_done(place, waiting)
        waiting.clear()

    def log(chunk: int, failed: list[list[int]]) -> None:
        nonlocal due
        waiting[chunk] = failed
        if time.monotonic() >= due:
            commit()
            due = time.monotonic() + LOG_EVERY

    try:
        yield log
    finally:
        commit()


def done_key(chunk: int) -> str:
    """The key that says that a chunk is on disk."""
    return f"{DONE}{chunk:08d}.json"


def say_done(place: AbstractPlace, chunks: Mapping[int, list[list[int]]]) -> None:
    """These chunks are on disk, and these (point, seed) failed in them."""
    with writing(place):
        place.write(
            {
                done_key(chunk): sealed(json.dumps(failed).encode())
                for chunk, failed in chunks.items()
            }
        )


def logged(place: AbstractPlace, among: Iterable[int] | None = None) -> dict[int, list[list[int]]]:
    """Complete chunks of a store of trajectories, all or `among` these, with the (point, seed) that
    failed in them."""
    keys = {
        int(key.removeprefix(DONE)[:8]): key for key in place.progress() if key.startswith(DONE)
    }
    numbers = sorted(keys.keys() if among is None else keys.keys() & set(among))
    with ThreadPoolExecutor() as pool:  # an object store takes tens of milliseconds for each
        found = pool.map(lambda number: unsealed(place.read(keys[number]) or b""), numbers)
        return {
            number: json.loads(data)
            for number, data in zip(numbers, found, strict=True)
            if data is not None
        }


def complete(place: AbstractPlace, attributes: dict[str, Any]) -> None:
    """Say that a store is complete, then drop what was needed to resume it."""
    describe(place, attributes | {"complete": True})
    with writing(place):
        place.forget()


def describe(place: AbstractPlace, attributes: dict[str, Any]) -> None:
    """Set attributes of a store."""
    document = description_of(place)
    with writing(place):
        place.write(
            {ROOT: text_of(stamped(document | {"attributes": document["attributes"] | attributes}))}
        )
