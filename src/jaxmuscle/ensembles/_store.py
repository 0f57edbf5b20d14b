"""Ensembles as zarr stores: folders that are written chunk by chunk, and described in one place."""

import contextlib
import json
import os
import shutil
import tempfile
import threading
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmuscle._common.errors import StoreError
from jaxmuscle._common.files import replacing, to_disk

from ._integrity import ROOT, Document, keys_of_array, require_intact, stamped

SETTINGS = "settings"
PROGRESS = "progress"
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

    @staticmethod
    def whole(dims: tuple[str, ...], values: np.ndarray, units: str) -> "Variable":
        """In one chunk."""
        return Variable(dims, values.shape, values.shape, values.dtype, units, values)


def folder_of(store: str | Path) -> Path:
    """The folder of a store. **Raises:** `ValueError` for what is none."""
    if not isinstance(store, str | Path) or "://" in str(store):
        raise ValueError(f"store = {str(store)!r}: give the path of a folder")
    return Path(store)


def create(
    path: Path,
    variables: Mapping[str, Variable],
    coordinates: list[str],
    attributes: dict[str, Any],
) -> None:
    """A new, incomplete store, which appears whole or not at all. For the only writer."""
    with writing(path), _beside(path) as folder:
        _build(folder / "new", variables, coordinates, attributes)
        to_disk([folder, *folder.rglob("*")])
        os.rename(folder / "new", path)
        to_disk([path.parent])


def clear(path: Path) -> None:
    """Remove a store: in one step, since what is half removed has another name."""
    with writing(path), _beside(path) as folder:
        os.rename(path, folder / "old")


@contextlib.contextmanager
def _beside(path: Path) -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix=_prefix(path), dir=path.parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _prefix(path: Path) -> str:
    return f".{path.name}.new-"


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


def _arrays(path: Path, names: Iterable[str]) -> dict[str, Any]:
    """Arrays of a store, which write every chunk: that one is not there must mean that it was
    lost."""
    import zarr

    with OPENING, zarr.config.set({"array.write_empty_chunks": True}):
        group: Any = zarr.open_group(path, mode="r+")
        return {name: group[name] for name in names}


def text_of(document: Document) -> bytes:
    """A description as it is kept."""
    return json.dumps(document, indent=2, allow_nan=False).encode()


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """What the system refuses (a full disk, a folder without permission) becomes an error with the
    way on."""
    try:
        yield
    except OSError as error:
        remedy = (
            "what is complete stays: make room, or permission, and resume (--resume, resume=True)"
        )
        raise OSError(error.errno, f"{error.strerror or error}; {remedy}", str(path)) from error


def attributes_of(path: str | Path) -> dict[str, Any] | None:
    """Attributes of the store at `path`, a folder; None if nothing is there.

        jm.ensembles.attributes_of("runs.zarr")["complete"]

    **Raises:** `StoreError` if something else is there.
    """
    folder = folder_of(path)
    return description_of(folder)["attributes"] if os.path.lexists(folder) else None


def _document(path: Path) -> Document:
    try:
        document = json.loads((path / ROOT).read_bytes())
        if not isinstance(document["attributes"], dict):
            raise ValueError("no attributes")
        return document
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise StoreError(
            f"{path}: is not a store that jaxmuscle wrote, or its {ROOT} is damaged"
            f" ({error}); give another name"
        ) from None


def state_of(path: Path, wanted: dict[str, Any], *, begin: str) -> str:
    """Whether a store of these attributes is "absent", to be "overwritten", "begun" or "complete".

    **Raises:** `StoreError` if it is there and not to be resumed, or was made with other settings
    (named).
    """
    if not os.path.lexists(path):
        return "absent"
    if begin == "new":
        raise StoreError(
            f"{path}: exists already; resume it (--resume, resume=True), overwrite it"
            " (--force, overwrite=True), or give another name"
        )
    if begin == "overwrite":
        _require_ensemble(path, _document(path)["attributes"])
        return "overwritten"
    found = require_settings(path, wanted[SETTINGS])
    return "complete" if found["complete"] else "begun"


def require_settings(path: Path, wanted: str) -> dict[str, Any]:
    """The attributes of a store that was made with the settings that are wanted. **Raises:**
    `StoreError`."""
    found = description_of(path)["attributes"]
    there, here = json.loads(found[SETTINGS]), json.loads(wanted)
    different = differences(there, here)
    if different:
        raise StoreError(
            f"{path}: was made with other settings: {'; '.join(different)}. Repeat them, or"
            " give another name"
        )
    return found


def description_of(path: Path) -> Document:
    """The whole description of an ensemble's store. **Raises:** `StoreError` if it is something
    else, or damaged."""
    document = _document(path)
    _require_ensemble(path, document["attributes"])
    if "random numbers" not in document["attributes"][SETTINGS]:
        raise StoreError(
            f"{path}: was begun by an earlier version of jaxmuscle, whose seeds have other"
            " noise. So it cannot go on: begin it anew (--force, overwrite=True), or give another"
            " name"
        )
    require_intact(path, document)
    return document


def _require_ensemble(path: Path, attributes: dict[str, Any]) -> None:
    if SETTINGS not in attributes or "complete" not in attributes:
        raise StoreError(
            f"{path}: is not an ensemble that can be resumed (no settings in it); give another name"
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


def write_region(path: Path, region: Any, values: Mapping[str, np.ndarray]) -> None:
    """Write part of some arrays; the region cuts their leading dimensions."""
    with writing(path):
        for name, array in _arrays(path, values).items():
            array[region] = values[name]


def read_arrays(path: Path, names: Iterable[str], region: Any = ...) -> dict[str, np.ndarray]:
    """Some arrays, or the same part of each."""
    import zarr

    group: Any = zarr.open_group(path, mode="r")
    return {name: np.asarray(group[name][region]) for name in names}


def write_arrays(path: Path, values: Mapping[str, np.ndarray]) -> None:
    """Write whole arrays, which are on disk afterwards."""
    write_region(path, ..., values)
    document = description_of(path)
    settle(path, [key for name in values for key in keys_of_array(document, name)])


def settle(path: Path, keys: Iterable[str]) -> None:
    """Wait until these files are on disk, and the folders that hold them."""
    files = [path / key for key in keys]
    above = {folder for file in files for folder in file.parents}
    with writing(path):
        to_disk([*files, *(above - set(path.parents))])


def replace(path: Path, key: str, data: bytes) -> None:
    """Replace a file of a store in one step; it is on disk afterwards."""
    file = path / key
    with writing(path):
        with replacing(file) as unfinished:
            unfinished.write_bytes(data)
            to_disk([unfinished])
        to_disk([file.parent, path])


def describe(path: Path, attributes: dict[str, Any]) -> None:
    """Set attributes of a store."""
    document = description_of(path)
    found = document | {"attributes": document["attributes"] | attributes}
    replace(path, ROOT, text_of(stamped(found)))


def forget(path: Path) -> None:
    """Remove what was needed to resume a store, and what processes that were killed left. For the
    only writer."""
    with writing(path):
        shutil.rmtree(path / PROGRESS, ignore_errors=True)
        for unfinished in [*path.rglob("*.partial"), *path.rglob(".zarr-*.json")]:  # zarr's, ours
            unfinished.unlink(missing_ok=True)
        for built in path.parent.iterdir():
            if built.name.startswith(_prefix(path)):
                shutil.rmtree(built)
