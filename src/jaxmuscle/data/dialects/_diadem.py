"""DIAdem (National Instruments): a header of channels, whose values are text or binary."""

import functools
import re
from collections.abc import Callable
from pathlib import Path, PureWindowsPath
from typing import TYPE_CHECKING

import numpy as np

from jaxmuscle._common.inputs import read_bytes

from .._text_tables import is_number, number_in
from ._dialect import Dialect, rate_of

if TYPE_CHECKING:
    from .._recording_table import Table

_TYPES = {
    "REAL64": "<f8",
    "REAL32": "<f4",
    "INT16": "<i2",
    "INT32": "<i4",
    "WORD16": "<u2",
    "WORD8": "u1",
}


def _table(data: bytes, file: str, read: "Callable[[bytes, str], Table]") -> "Table | None":
    """DIAdem: a header of channels, each with its number of an entry (200 name, 202 unit, 211 file,
    241 step), and their values behind it or in the file that it names."""
    if b"#BEGINCHANNELHEADER" not in data[: 1 << 16]:
        return None
    from .._recording_table import Table

    *heads, rest = re.split(rb"#ENDCHANNELHEADER[^\n]*\n?", data)
    if not heads:
        raise ValueError(f"{file}: its header has no #ENDCHANNELHEADER; save the file again")
    texts = [
        head.partition(b"#BEGINCHANNELHEADER")[2].decode("cp1252", errors="replace")
        for head in heads
    ]
    channels = [
        dict(line.split(",", 1) for line in text.splitlines() if "," in line) for text in texts
    ]
    channels = [
        {key.strip(): value.strip() for key, value in channel.items()} for channel in channels
    ]
    steps = [c for c in channels if c.get("210", "").startswith("IMPLI")]
    rate = next((rate_of(c.get("241", ""), c.get("202"), file) for c in steps), None)
    held = [channel for channel in channels if channel not in steps]
    # The last part of its name alone: the values lie beside the header, and no header points
    # anywhere else.
    sources = {
        Path(file).parent / PureWindowsPath(channel["211"]).name
        for channel in held
        if channel.get("211")
    }
    if Path(file) in sources:
        raise ValueError(
            f"{file}: its header names the file itself for the values; give the file that holds"
            " them"
        )
    if len(sources) == 1 and held[0].get("214", "ASCII") in _TYPES:
        found = [_binary(channel, len(held), next(iter(sources)), file) for channel in held]
        place, columns = (
            "sample {}".format,
            [functools.partial(np.asarray, column) for column in found],
        )
    else:
        text = _bytes(next(iter(sources)), file) if len(sources) == 1 else rest
        table = read(text, str(next(iter(sources))) if sources else file)
        place, columns = table.place, list(table.columns.values())
    if len(columns) != len(held):
        raise ValueError(
            f"{file}: its header has {len(held)} channels with values, but there are {len(columns)}"
            " columns"
        )
    names = [channel.get("200", str(i)) for i, channel in enumerate(held)]
    units = {
        name: unit
        for name, channel in zip(names, held, strict=True)
        if (unit := channel.get("202", "").strip("[] "))
    }
    rates = {} if rate is None else dict.fromkeys(names, rate)
    return Table(file, dict(zip(names, columns, strict=True)), True, rates, units, place=place)


def _bytes(source: Path, file: str) -> bytes:
    if not source.exists():
        raise ValueError(f"{file}: its values are in {source.name}, which is not beside it")
    return read_bytes(source, instead="the file that holds the values")


def _binary(channel: dict[str, str], count: int, source: Path, file: str) -> np.ndarray:
    """The values of a channel: one of several in every row (BLOCK), or all behind one another
    (CHANNEL)."""
    kind, data = np.dtype(_TYPES.get(channel.get("214", ""), "<f8")), _bytes(source, file)
    raw = np.frombuffer(data, kind, len(data) // kind.itemsize)
    stated = [
        channel.get(key) or usual
        for key, usual in (("221", "1"), ("220", "0"), ("241", "1"), ("240", "0"))
    ]
    if not all(is_number(entry, None) for entry in stated):
        raise ValueError(
            f"{file}: its header has {', '.join(stated)} where first row, length, factor and offset"
            " belong"
        )
    first, size, factor, offset = (number_in(entry, None) for entry in stated)
    if not (1 <= first <= max(raw.size, 1) and 0 <= size <= raw.size):
        raise ValueError(
            f"{file}: its header asks for {size:g} values from {first:g} on, {source.name} has"
            f" {raw.size}"
        )
    start = int(first) - 1
    return (
        raw[start::count] if channel.get("213") == "BLOCK" else raw[start : start + int(size)]
    ) * factor + offset


DIADEM = Dialect(table=_table)
