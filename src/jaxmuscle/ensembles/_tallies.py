"""Tallies in a store: what is reduced so far, and which chunks are in it."""

import io
import logging
from typing import NamedTuple

import numpy as np

from ._integrity import sealed, unsealed
from ._places import PROGRESS, AbstractPlace
from ._running_moments import RunningMoments, merged
from ._store import writing

LOG = logging.getLogger("jaxmuscle")
TALLY = f"{PROGRESS}/tally-"


class Reduced(NamedTuple):
    """A tally, the chunks in it, and the (point, seed) that failed in them."""

    tally: RunningMoments
    chunks: frozenset[int]
    failed: list[list[int]]


def write_tally(place: AbstractPlace, key: str, reduced: Reduced) -> None:
    """Keep what was reduced so far; replaces the key in one step."""
    data = io.BytesIO()
    np.savez(
        data,
        chunks=np.array(sorted(reduced.chunks), int),
        failed=np.array(reduced.failed, int).reshape(-1, 2),
        **reduced.tally._asdict(),
    )
    with writing(place):
        place.write({key: sealed(data.getvalue())})


def read_tally(place: AbstractPlace, key: str) -> Reduced | None:
    """What was kept under a key, None if there is nothing; what is damaged is removed, and that is
    said."""
    kept = place.read(key)
    content = None if kept is None else unsealed(kept)
    if content is None:
        if kept is not None:
            LOG.warning(
                "notice: %s: %s is damaged; what it held is computed again", place.name, key
            )
            place.remove(key)
        return None
    with np.load(io.BytesIO(content)) as data:
        tally = RunningMoments(*(data[name] for name in RunningMoments._fields))
        return Reduced(tally, frozenset(data["chunks"].tolist()), data["failed"].tolist())


def read_tallies(place: AbstractPlace) -> Reduced | None:
    """All tallies of a store together, None if there is none; those that a later one contains are
    not counted twice."""
    whole = None
    for key in reversed(tally_keys(place)):
        part = read_tally(place, key)
        if part is None or whole is None:
            whole = part or whole
        elif not part.chunks & whole.chunks:
            whole = Reduced(
                merged(whole.tally, part.tally),
                whole.chunks | part.chunks,
                whole.failed + part.failed,
            )
    return whole


def tally_keys(place: AbstractPlace) -> list[str]:
    """Keys that hold tallies."""
    return [key for key in place.progress() if key.startswith(TALLY)]


def tally_key(generation: int, rank: int) -> str:
    """Key of a process's tally; one of a later generation contains those of the earlier ones that
    it shares a chunk with."""
    return f"{TALLY}{generation:06d}-{rank:06d}.npz"


def generation_of(key: str) -> int:
    """Generation of a tally."""
    return int(key.removeprefix(TALLY)[:6])
