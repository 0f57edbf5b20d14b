"""A store, made or found, for the process or processes that write it."""

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxmuscle._common.errors import StoreError

from ._integrity import wrong
from ._layout import Layout
from ._locks import WHOLE
from ._mending import mend, reopen
from ._parts import Part, failed_in
from ._places import AbstractPlace
from ._processes import agreed, rank_and_count
from ._store import Begin, Variable, create, description_of, state_of, writing


@contextlib.contextmanager
def opened(
    layout: Layout,
    place: AbstractPlace,
    variables: dict[str, Variable],
    coordinates: list[str],
    attributes: dict[str, Any],
    *,
    begin: Begin,
    part: Part | None,
) -> Iterator[bool]:
    """Make or find the store, as process 0 sees it; whether there is work left. All processes raise
    the same error.

    As long as there is, nobody else may write it, but other parts beside a part.
    """
    said, failure, rank = "", None, rank_and_count()[0]
    with contextlib.ExitStack() as locks:
        if rank == 0:
            try:
                said = _begun(
                    locks, layout, place, variables, coordinates, attributes, begin=begin, part=part
                )
            except (ValueError, OSError) as error:
                said, failure = f"error: {error}", error
        said = agreed(said)
        if failure is not None:
            raise failure
        if said.startswith("error: "):
            raise StoreError(said.removeprefix("error: "))
        if not place.exists():
            raise StoreError(
                f"{place.name}: process {rank} does not see what process 0 made: give a folder that"
                " all processes share"
            )
        if rank > 0 and said != "complete":
            locks.enter_context(place.locked(f"process-{rank}"))
        yield said != "complete"


def _begun(
    locks: contextlib.ExitStack,
    layout: Layout,
    place: AbstractPlace,
    variables: dict[str, Variable],
    coordinates: list[str],
    attributes: dict[str, Any],
    *,
    begin: Begin,
    part: Part | None,
) -> str:
    """Whether the store is "begun", with its lock among `locks`, or "complete" and intact."""
    said = state_of(place, attributes, begin=begin)
    if said == "complete" and (
        part is not None or not (wrong(place, description_of(place)) or place.progress())
    ):
        return said
    with writing(place):
        locks.enter_context(place.locked(WHOLE if part is None else f"part-{part.number}"))
    said = state_of(place, attributes, begin=begin)
    if said == "overwritten":
        with writing(place):
            place.clear()
    if said in ("absent", "overwritten") and create(place, variables, coordinates, attributes):
        return "begun"
    if said == "absent":  # another part was faster
        said = state_of(place, attributes, begin="new" if part is None else "part")
    known: dict[str, np.ndarray] = {
        name: v.values for name, v in variables.items() if v.values is not None
    }
    lost = mend(place, known)
    if said == "complete" and not lost:
        with writing(place):
            place.forget()
        return said
    if said == "complete":
        reopen(place, layout, lost, failed_in(place))
    return "begun"
