"""Stores of which something was damaged or lost: it is said, taken back, and made again."""

import logging
from collections.abc import Iterable, Mapping

import numpy as np

from ._integrity import chunk_of_key, damaged, described, in_words, keys_of_chunk, wrong
from ._layout import Layout
from ._places import ROOT, AbstractPlace
from ._store import describe, description_of, done_key, say_done, text_of, write_arrays, writing

LOG = logging.getLogger("jaxmuscle")


def drop_damaged(place: AbstractPlace, chunks: Iterable[int]) -> None:
    """Of these chunks of a store of trajectories, take back those that are damaged or missing."""
    document = description_of(place)
    keys = {key: chunk for chunk in chunks for key in keys_of_chunk(document, chunk)}
    bad = damaged(place, keys)
    if bad:
        LOG.warning("notice: %s: %s: to be computed again", place.name, in_words(bad))
        with writing(place):
            place.remove(*{done_key(keys[key]) for key in bad}, *bad)


def mend(place: AbstractPlace, known: Mapping[str, np.ndarray]) -> list[str]:
    """Write again what is damaged of the descriptions of single arrays, and of arrays whose values
    are known.

    **Returns:** the keys of what else is damaged or missing, if the store is complete.
    """
    document = description_of(place)
    bad = wrong(place, document, None if document["attributes"]["complete"] else known)
    lost = [key for key in bad if not key.endswith(f"/{ROOT}") and key.split("/")[0] not in known]
    mended = [key for key in bad if key not in lost]
    if mended:
        LOG.warning("notice: %s: %s: written again", place.name, in_words(mended))
        names = {key: key.split("/")[0] for key in mended}
        with writing(place):
            place.write(
                {
                    key: text_of(described(document)[name])
                    for key, name in names.items()
                    if key.endswith(ROOT)
                }
            )
            place.remove(*(key for key in mended if not key.endswith(ROOT)))
        write_arrays(place, {name: known[name] for name in names.values() if name in known})
    return lost


def reopen(place: AbstractPlace, layout: Layout, lost: list[str], failed: list[list[int]]) -> None:
    """Make a complete store, of which these keys are lost, one to be resumed: all other chunks are
    done.

    Of a reduced store none is, since what is reduced cannot be taken apart.
    """
    LOG.warning("notice: %s: %s: to be computed again", place.name, in_words(lost))
    document = description_of(place)
    chunks = {chunk_of_key(document, key) for key in lost}
    if None not in chunks:
        done: dict[int, list[list[int]]] = {
            number: [] for number in range(layout.chunks) if number not in chunks
        }
        columns = {int(seed): column for column, seed in enumerate(layout.seeds)}
        for point, seed in failed:
            done.get(layout.chunk_of(point, columns[seed]), []).append([point, seed])
        say_done(place, done)
    describe(place, {"complete": False})
    with writing(place):
        place.remove(*lost)
