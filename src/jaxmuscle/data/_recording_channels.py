"""Channels of a file as the readers hand them over. Light to import: the process that reads needs
nothing else."""

import itertools
import re
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

# in which samples are handed over
TYPES = ("|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f4", "<f8")

_UNIT = re.compile(r"\s*[\[(][^\[\]()]*[\])]\s*$")


class TooLarge(ValueError):
    """A file holds, or says that it holds, more than may be read."""


class Channel(NamedTuple):
    """A channel: its name, samples (numbers, one dimension), rate [Hz] and unit, as far as the file
    states them; and what it is called where a label is not looked at."""

    name: str
    samples: np.ndarray
    rate: float | None = None
    unit: str = ""
    alias: str = ""


def distinct(channels: Iterable[Channel]) -> Iterator[Channel]:
    """The channels with names of their own: `NAME 2` where NAME is there already, `channel 2` for a
    third without one."""
    known: set[str] = set()
    for number, channel in enumerate(channels):
        name = str(channel.name).strip() or f"channel {number}"
        while name in known:
            name = f"{name} {number}"
        known.add(name)
        yield channel._replace(name=name, unit=str(channel.unit).strip())


def numbered(names: Iterable[str]) -> list[str]:
    """Names of their own: `NAME 2` where NAME is there already, `NAME 2 [N]` where NAME [N] is."""
    found: dict[str, None] = {}
    for name in names:
        stem, unit = _UNIT.split(name, 1)[0], "".join(_UNIT.findall(name)[:1])
        others = (f"{stem} {number}{unit}" for number in itertools.count(2))
        found[next(other for other in itertools.chain([name], others) if other not in found)] = None
    return list(found)


def numbers(column: Any) -> np.ndarray:
    """A column as numbers: dates and times of day become seconds from the first one."""
    array = np.asarray(column)
    if array.dtype.kind in "mM":
        since = (array - array[0]) if array.size else array.astype("m8[ns]")
        return np.where(np.isnat(since), np.nan, since / np.timedelta64(1, "s"))
    try:
        return array.astype(float)
    except (TypeError, ValueError):
        raise ValueError(
            "a column holds words, not numbers; choose another one with `column`"
        ) from None
