"""Vicon Nexus: blocks of devices, trajectories and model outputs, below one another."""

import functools
import re

from ._dialect import Above, Block, Dialect, Head, below_groups

_BLOCK = re.compile(
    rb'^"?(devices|analog|trajectories|model outputs|joints|segments|force plates|events)"?'
    rb'[,;\t]*\n"?([\d.]+)"?[,;\t]*(?:hz)?[,;\t]*\n',
    re.IGNORECASE | re.MULTILINE,
)
_COUNTERS = ("frame", "sub frame", "sample", "field")
POINTS = (b"trajectories", b"joints", b"segments", b"model outputs")


def _blocks(data: bytes) -> list[Block] | None:
    found = list(_BLOCK.finditer(data))
    if not found or data[: found[0].start()].strip(b',;\t\n "'):
        return None
    stops = [*(match.start() for match in found[1:]), len(data)]
    return [
        Block(
            _without_empty_lines(data[match.end() : stop]),
            data.count(b"\n", 0, match.end()),
            functools.partial(_head, float(match[2]), match[1].lower() in POINTS),
        )
        for match, stop in zip(found, stops, strict=True)
        if match[1].lower() != b"events"
    ]


def _without_empty_lines(data: bytes) -> bytes:
    """The block without the lines of delimiters that end it."""
    end = len(data)
    while (line := data.rfind(b"\n", 0, end)) >= 0 and not data[line:end].strip(b",;\t\n "):
        end = line
    return data[:end]


def _head(rate: float, points: bool, above: Above) -> Head | None:
    """A row of devices or points, one of names, one of units; the name of a device is needed where
    two have a column of one name."""
    rows = [above.padded(i) for i in range(len(above.cells) - 1)]
    at = next((i for i, row in enumerate(rows) if row[0].casefold() in _COUNTERS), None)
    if at is None:
        return None
    names = rows[at]
    counters = [j for j, name in enumerate(names) if name.casefold() in _COUNTERS]
    whole = below_groups(
        names,
        rows[at - 1] if at else [""] * above.width,
        lambda j: j not in counters and (points or names.count(names[j]) > 1),
    )
    units = rows[at + 1] if at + 1 < len(rows) else []
    units = ["" if j in counters else unit for j, unit in enumerate(units)]
    return Head(whole, units, rate, counters=counters)


VICON = Dialect(blocks=_blocks)
