"""A store, made or found, for its only writer; what was damaged in it is made again."""

import contextlib
import errno
import json
import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import filelock
import numpy as np

from jaxmuscle._common.errors import StoreError

from ._integrity import ROOT, described, in_words, wrong
from ._store import (
    PROGRESS,
    Variable,
    clear,
    create,
    describe,
    description_of,
    folder_of,
    forget,
    replace,
    state_of,
    text_of,
    write_arrays,
    writing,
)

if TYPE_CHECKING:
    import xarray

LOG = logging.getLogger("jaxmuscle")
WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Be the only writer of a store, whether it is there or not. The system ends the lock with the
    process; its file, which is empty, stays.

    **Raises:** `StoreError` if another process writes it.
    """
    with contextlib.ExitStack() as held:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = path.parent / f".{path.name}.lock"
            held.enter_context(filelock.FileLock(lock, timeout=0))
        except filelock.Timeout:
            raise StoreError(
                f"{path}: another process is writing it: wait until it has ended, or end it"
            ) from None
        except (OSError, NotImplementedError) as error:
            if isinstance(error, OSError) and error.errno not in WITHOUT_LOCKS:
                with writing(path):
                    raise
            LOG.warning(
                "notice: %s: this file system has no locks. See to it that no other process writes"
                " it",
                path,
            )
        yield


@contextlib.contextmanager
def opened(
    path: Path,
    variables: dict[str, Variable],
    coordinates: list[str],
    attributes: dict[str, Any],
    *,
    begin: str,
) -> Iterator[str]:
    """Make or find the store: "new", "begun", or "" where no work is left. As long as there is,
    nobody else may write it."""
    said = state_of(path, attributes, begin=begin)
    left = (path / PROGRESS).exists()  # of a process that was killed after all was done
    if said == "complete" and not left and not wrong(path, description_of(path)):
        yield ""
        return
    with locked(path):
        said = state_of(path, attributes, begin=begin)  # now that nobody else can change it
        if said == "overwritten":
            clear(path)
        if said in ("absent", "overwritten"):
            create(path, variables, coordinates, attributes)
            yield "new"
            return
        known = {name: v.values for name, v in variables.items() if v.values is not None}
        lost = _mend(path, known)
        if said == "complete" and not lost:
            forget(path)
        elif said == "complete":
            describe(path, {"complete": False})
            take_back(path, lost)
        yield "begun" if lost or said == "begun" else ""


def take_back(path: Path, keys: list[str]) -> None:
    """Remove files of computed arrays that are damaged, and say so."""
    LOG.warning("notice: %s: %s: to be computed again", path, in_words(keys))
    with writing(path):
        for key in keys:
            (path / key).unlink(missing_ok=True)


def _mend(path: Path, known: Mapping[str, np.ndarray]) -> list[str]:
    """Write again what is damaged of the descriptions of single arrays, and of arrays whose values
    are known.

    **Returns:** the keys of what else is damaged or missing, if the store is complete.
    """
    document = description_of(path)
    bad = wrong(path, document, None if document["attributes"]["complete"] else known)
    names = {key: key.split("/")[0] for key in bad}
    descriptions = [key for key in bad if key.endswith(f"/{ROOT}")]
    values = {name: known[name] for name in names.values() if name in known}
    lost = [key for key in bad if key not in descriptions and names[key] not in known]
    if len(lost) < len(bad):
        mended = [key for key in bad if key not in lost]
        LOG.warning("notice: %s: %s: written again", path, in_words(mended))
        for key in descriptions:
            replace(path, key, text_of(described(document)[names[key]]))
        write_arrays(path, values)
    return lost


def finish(path: Path, failed: list[list[int]]) -> None:
    """Say that a store is complete, and which (point, seed) failed; all chunks are on disk."""
    describe(path, {"failed": json.dumps(sorted(failed)), "complete": True})
    forget(path)


def open_store(path: str | Path) -> "xarray.Dataset":
    """Open a complete store after every chunk of it has been compared with its checksum.

        runs = jm.ensembles.open_store("runs.zarr")

    `xarray.open_zarr` compares chunks when they are read, and takes one that is missing for NaN.

    **Arguments:** `path`, the store's folder.

    **Returns:** the opened `xarray.Dataset`.

    **Raises:** `StoreError` that says what to do for a store that is not complete, or of which a
    chunk or a description is damaged or missing; for what is no ensemble's store.
    """
    import xarray

    folder = folder_of(path)
    if not folder.exists():
        raise StoreError(f"{folder}: there is no store; give the folder of one")
    document = description_of(folder)
    if not document["attributes"]["complete"]:
        raise StoreError(
            f"{folder}: is not complete: resume it (--resume, resume=True). xarray.open_zarr opens"
            " it as it is"
        )
    bad = wrong(folder, document)
    if bad:
        raise StoreError(
            f"{folder}: {in_words(bad)}. Resume the ensemble with the arguments that it had"
            " (--resume, resume=True): what is damaged is computed again"
        )
    return xarray.open_zarr(folder)
