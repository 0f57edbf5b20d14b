"""Stores that a job array makes in parts, and what makes any store complete."""

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from jaxmuscle._common.errors import StoreError

from ._integrity import in_words, others, wrong
from ._locks import WHOLE
from ._mending import drop_damaged
from ._places import AbstractPlace, place_of
from ._store import (
    CHUNKS,
    PARTS,
    SETTINGS,
    attributes_at,
    complete,
    description_of,
    ensemble_at,
    logged,
    write_arrays,
    writing,
)
from ._summary import computed
from ._tallies import read_tallies

if TYPE_CHECKING:
    import xarray


class Part(NamedTuple):
    """Part `number` (from 1) of so many: a run of neighbouring chunks, so that few points of a
    sweep are cut."""

    number: int
    of: int

    @staticmethod
    def checked(part: tuple[int, int], *, store: bool, overwrite: bool) -> "Part":
        """**Raises:** `ValueError` for numbers out of range, and for what does not go with a
        part."""
        if (
            not isinstance(part, tuple | list)
            or len(part) != 2
            or not all(type(n) is int for n in part)
        ):
            raise ValueError(
                f"part = {part!r}: give the number of the part and their count, as (1, 4)"
            )
        number, count = part
        if not 1 <= number <= count:
            raise ValueError(
                f"part = {number}/{count}: parts are numbered from 1 to their count, as 1/4 to 4/4"
            )
        if not store:
            raise ValueError("a part of an ensemble belongs to a store: give store=")
        if overwrite:
            raise ValueError(
                "a part adds to the store of all parts, it cannot overwrite it: remove the store"
                " first"
            )
        if jax.process_count() > 1:
            raise ValueError(
                "a part is a process of its own: leave out the part, or jax.distributed"
            )
        return Part(number, count)

    def chunks(self, total: int) -> range:
        """Those chunks of all that are this part's."""
        return range(total * (self.number - 1) // self.of, total * self.number // self.of)


class PartReport(NamedTuple):
    """What one part of an ensemble did.

    `number` of `parts`; `seeds` that are its own (points times seeds in a sweep); `failed`, rows
    (point, seed) of those that did not stay finite. `complete`, whether the store had been merged
    before: then `failed` are those of the whole store.
    """

    number: int
    parts: int
    seeds: int
    failed: Int[np.ndarray, "failed 2"]
    complete: bool

    @property
    def success(self) -> bool:
        """Whether every seed stayed finite."""
        return len(self.failed) == 0


def merge(path: str | Path) -> "xarray.Dataset":
    """Make one ensemble of the parts in a store: checks that all chunks are there, adds up what
    `reduce` kept.

        runs = jm.ensembles.merge("runs.zarr")

    A store that is complete is checked and opened, as by `open_store`, so a repetition does no
    harm.

    **Arguments:** `path`, the store's folder or URL.

    **Returns:** the opened `xarray.Dataset`. Its attribute `failed` lists (point, seed) of what did
    not stay finite.

    **Raises:** `StoreError` that names the missing parts and how to run them; for a store that is
    not complete and has no parts; for what is no ensemble's store.
    """
    import xarray

    place = place_of(path)
    if not place.exists():
        raise StoreError(f"{place.name}: there is no store; give the one that the parts have made")
    attributes = ensemble_at(place)
    if attributes["complete"]:
        return open_store(path)
    if PARTS not in attributes:
        raise StoreError(
            f"{place.name}: is not made in parts; resume it instead (--resume, resume=True)"
        )
    with contextlib.ExitStack() as locks:
        with writing(place):
            locks.enter_context(place.locked(WHOLE))
        if not ensemble_at(place)["complete"]:
            finish(place, attributes[CHUNKS])
    return xarray.open_zarr(place.opened())


def open_store(path: str | Path) -> "xarray.Dataset":
    """Open a complete store after every chunk of it has been compared with its checksum.

        runs = jm.ensembles.open_store("runs.zarr")

    `xarray.open_zarr` compares chunks when they are read, and takes one that is missing for NaN.

    **Arguments:** `path`, the store's folder or URL.

    **Returns:** the opened `xarray.Dataset`.

    **Raises:** `StoreError` that says what to do for a store that is not complete, or of which a
    chunk or a description is damaged or missing; for what is no ensemble's store.
    """
    import xarray

    place = place_of(path)
    if not place.exists():
        raise StoreError(f"{place.name}: there is no store; give the folder or the URL of one")
    document = description_of(place)
    if not document["attributes"]["complete"]:
        raise StoreError(
            f"{place.name}: is not complete: resume it (--resume, resume=True), or merge its parts"
            " (jaxmuscle merge). xarray.open_zarr opens it as it is"
        )
    bad = wrong(place, document)
    if bad:
        raise StoreError(
            f"{place.name}: {in_words(bad)}. Resume the ensemble with the arguments that it had"
            " (--resume, resume=True): what is damaged is computed again"
        )
    return xarray.open_zarr(place.opened())


def finish(place: AbstractPlace, chunks: int) -> None:
    """Make a store complete: tallies become moments.

    **Raises:** `StoreError` if not all `chunks` are there, or if anything is not as it was written.
    """
    document = description_of(place)
    attributes = document["attributes"]
    if json.loads(attributes[SETTINGS])["kind"] == "reduced":
        found = read_tallies(place)
        _require(
            place, set() if found is None else set(found.chunks), chunks, attributes.get(PARTS)
        )
        assert found is not None
        write_arrays(place, _moments(place, found.tally))
        failed = sorted(found.failed)
    else:
        drop_damaged(place, logged(place))
        there = logged(place)
        _require(place, set(there), chunks, attributes.get(PARTS))
        failed = [entry for number in sorted(there) for entry in there[number]]
    bad = wrong(place, document, others(document))
    if bad:
        way = "resume it" if PARTS not in attributes else "run any part again, then merge"
        raise StoreError(f"{place.name}: {in_words(bad)}: {way}, and they are written again")
    complete(place, {"failed": json.dumps(failed)})


def failed_in(place: AbstractPlace) -> list[list[int]]:
    """The (point, seed) that failed in a complete store."""
    return json.loads(attributes_at(place)["failed"])


def _require(place: AbstractPlace, there: set[int], chunks: int, parts: int | None) -> None:
    missing = set(range(chunks)) - there
    if missing and parts is None:
        raise StoreError(
            f"{place.name}: {len(missing)} of {chunks} chunks are missing although all processes"
            " are done: is the folder the same for all of them? Resume on a shared file system"
        )
    if missing and parts is not None:
        numbers = [
            number
            for number in range(1, parts + 1)
            if missing & set(Part(number, parts).chunks(chunks))
        ]
        raise StoreError(
            f"{place.name}: {len(missing)} of {chunks} chunks are missing: parts {_ranges(numbers)}"
            f" of {parts} are not done. Run each of them again, with the arguments that it had:"
            f" jaxmuscle ensemble ... --out {place.name} --part {numbers[0]}/{parts}"
        )


def _ranges(numbers: list[int]) -> str:
    """Ascending numbers as `sbatch --array=` takes them: 3,17,20-31."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1][1:] = [number]
        else:
            runs.append([number])
    return ",".join("-".join(map(str, run)) for run in runs)


def _moments(place: AbstractPlace, tally: Any) -> dict[str, np.ndarray]:
    """What a tally says, as the arrays of its store have it."""
    import zarr

    group: Any = zarr.open_group(place.opened(), mode="r")
    levels = tuple(float(level) for level in group["quantile"][...])
    expected = np.atleast_2d(group["power_expected"][...]) if "power_expected" in group else None
    arrays = computed(tally, levels, expected)
    return (
        arrays if group["mean"].ndim == 2 else {name: values[0] for name, values in arrays.items()}
    )
