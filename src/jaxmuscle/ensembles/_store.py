"""Ensembles as zarr stores: written chunk by chunk by one or many processes, resumed, never complete before they are."""

import contextlib
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmuscle._common.errors import StoreError
from jaxmuscle._common.files import replacing, write_json

from ._running_moments import RunningMoments, merged

Begin = Literal["new", "resume", "overwrite"]
SETTINGS = "settings"
DONE, TALLY = "progress-", "tally-"


class Variable(NamedTuple):
    """An array of a store: its dimensions and shape, how it is cut, and what is known of it at the start (NaN if None)."""

    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: Any
    units: str
    values: np.ndarray | None = None


def create(path: Path, variables: Mapping[str, Variable], coordinates: list[str], attributes: dict[str, Any]) -> None:
    """A new, incomplete store, which appears whole or not at all."""
    import zarr

    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
        try:
            labels = [name for name in coordinates if variables[name].dims != (name,)]
            group = zarr.open_group(temporary, mode="w", zarr_format=3)
            group.attrs.update(attributes | ({"coordinates": " ".join(labels)} if labels else {}) | {"complete": False})
            for name, v in variables.items():
                fill = np.nan if np.issubdtype(np.dtype(v.dtype), np.floating) else None
                dtype = "string" if np.dtype(v.dtype).kind == "U" else v.dtype  # fixed width is not in the specification
                array = group.create_array(name, shape=v.shape, chunks=v.chunks, dtype=dtype, dimension_names=v.dims,
                                           fill_value=fill, attributes={"units": v.units} if v.units else {})  # fmt: skip
                if v.values is not None:
                    array[...] = v.values
            _consolidate(temporary)
            temporary.chmod(0o755)
            os.rename(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def _consolidate(path: Path) -> None:
    """Keep a copy of all arrays' metadata at the root, where xarray looks for it first."""
    import zarr

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Consolidated metadata is currently not part", category=UserWarning)
        zarr.consolidate_metadata(path)


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """What the system refuses (a full disk, a folder without permission) becomes an error with the way on."""
    try:
        yield
    except OSError as error:
        remedy = "what is complete stays: make room, or permission, and resume (--resume, resume=True)"
        raise OSError(error.errno, f"{error.strerror or error}; {remedy}", str(path)) from error


def attributes_of(path: Path) -> dict[str, Any]:
    """Attributes of the store at `path`. **Raises:** `StoreError` if there is none."""
    try:
        return json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
    except (OSError, ValueError, KeyError) as error:
        raise StoreError(f"{path}: is not a store that jaxmuscle wrote ({error}); give another name") from None


def state_of(path: Path, settings: dict[str, Any], *, begin: Begin) -> str:
    """Whether a store is "absent", "begun" or "complete"; one that is to be overwritten is removed.

    **Raises:** `StoreError` if it is there and not to be resumed, or was made with other settings (named).
    """
    if not (path.exists() or path.is_symlink()):
        return "absent"
    if begin == "new":
        raise StoreError(f"{path}: exists already; resume it (--resume, resume=True), overwrite it (--force, "
                         "overwrite=True), or give another name")  # fmt: skip
    attributes = attributes_of(path)
    if SETTINGS not in attributes or "complete" not in attributes:
        raise StoreError(f"{path}: is not an ensemble that can be resumed (no settings in it); give another name")
    if begin == "overwrite":
        with writing(path):
            shutil.rmtree(path)
        return "absent"
    different = differences(json.loads(attributes[SETTINGS]), settings)
    if different:
        raise StoreError(f"{path}: was made with other settings: {'; '.join(different)}. Repeat them, or give another name")
    return "complete" if attributes["complete"] else "begun"


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


def write_region(path: Path, region: Any, values: Mapping[str, np.ndarray]) -> None:
    """Write part of some arrays; the region cuts their leading dimensions."""
    import zarr

    with writing(path):
        group = zarr.open_group(path, mode="r+")
        for name, part in values.items():
            array: Any = group[name]
            array[region] = part


def begin_log(path: Path, rank: int) -> None:
    """Start, or go on with, the log of the chunks that this process completes; ends a line that a full disk has cut."""
    _append(path, rank, b"\n")


def log_chunk(path: Path, rank: int, chunk: int, failed: list[list[int]]) -> None:
    """A chunk has been written, with these failed (point, seed)."""
    _append(path, rank, json.dumps({"chunk": chunk, "failed": failed}).encode() + b" ok\n")


def _append(path: Path, rank: int, line: bytes) -> None:
    with writing(path), (path / f"{DONE}{rank}.txt").open("ab") as file:
        file.write(line)
        file.flush()
        os.fsync(file.fileno())


def logged(path: Path) -> dict[int, list[list[int]]]:
    """Complete chunks of a store of trajectories, with the (point, seed) that failed in them."""
    found = {}
    for file in sorted(path.glob(f"{DONE}*.txt")):
        for line in file.read_bytes().split(b"\n"):
            if line.endswith(b" ok"):
                entry = json.loads(line[:-3])
                found[entry["chunk"]] = entry["failed"]
    return found


class Reduced(NamedTuple):
    """A tally, the chunks in it, and the (point, seed) that failed in them."""

    tally: RunningMoments
    chunks: frozenset[int]
    failed: list[list[int]]


def write_moments(path: Path, name: str, reduced: Reduced) -> None:
    """Keep what was reduced so far; replaces the file in one step."""
    with writing(path), replacing(path / f"{TALLY}{name}.npz") as temporary, temporary.open("wb") as file:
        np.savez(file, chunks=np.array(sorted(reduced.chunks), int), failed=np.array(reduced.failed, int).reshape(-1, 2),
                 **reduced.tally._asdict())  # fmt: skip


def read_tallies(path: Path, whole: Reduced) -> Reduced:
    """All tallies of a store, added to `whole`; those that a later one contains are not counted twice."""
    for file in sorted(path.glob(f"{TALLY}*.npz"), reverse=True):
        with np.load(file) as data:
            chunks = frozenset(data["chunks"].tolist())
            if chunks & whole.chunks:
                continue
            part = RunningMoments(*(data[name] for name in RunningMoments._fields))
            whole = Reduced(merged(whole.tally, part), whole.chunks | chunks, whole.failed + data["failed"].tolist())
    return whole


def tally_files(path: Path) -> list[Path]:
    """Files that hold tallies."""
    return sorted(path.glob(f"{TALLY}*.npz"))


def complete(path: Path, attributes: dict[str, Any]) -> None:
    """Say that a store is complete, then drop what was needed to resume it."""
    with writing(path):
        document = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
        document["attributes"] |= attributes | {"complete": True}
        write_json(path / "zarr.json", document)
        for file in (*path.glob(f"{DONE}*.txt"), *tally_files(path)):
            file.unlink(missing_ok=True)
