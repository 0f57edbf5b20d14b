"""LabVIEW's measurement file (.lvm): a header, and one for each packet of samples."""

import functools
import itertools
import math
import re

from .._text_tables import cells_of, is_number, number_in
from ._dialect import Above, Block, Dialect, Head, first_columns, frequency, per_second

_END = re.compile(rb"^\*\*\*End_of_Header\*\*\*[^\n]*\n", re.MULTILINE)
_AGAIN = re.compile(rb"^Channels[\t,]", re.MULTILINE)


def _blocks(data: bytes) -> list[Block] | None:
    """The packets; as one where their own times say how they follow one another."""
    if not data.startswith((b"LabVIEW Measurement", b'"LabVIEW Measurement')):
        return None
    ends = list(_END.finditer(data))
    if not ends:
        return None
    starts = [ends[0].end()] if len(ends) == 1 else [match.end() for match in ends[1:]]
    begins = [match.start() for match in _AGAIN.finditer(data, starts[0])]
    stops = [next((b for b in begins if b > start), len(data)) for start in starts]
    headers = [
        data[begin:start] for begin, start in zip([ends[0].end(), *stops], starts, strict=False)
    ]
    stated = [_stated(header) for header in headers]
    parts = [_without_comments(data[start:stop]) for start, stop in zip(starts, stops, strict=True)]
    names = [part.lstrip(b"\n\t ").partition(b"\n")[0] for part in parts]
    times = [_first_time(part) for part in parts]
    if len(set(names)) == 1 and all(a < b for a, b in itertools.pairwise(times)):
        # what stands between the packets becomes empty lines, so that lines keep their numbers
        rows = [parts[0]]
        for k in range(1, len(parts)):
            between = data.count(b"\n", stops[k - 1], starts[k])
            head, _, rest = parts[k].partition(names[k])
            rows.append(b"\n" * (between + head.count(b"\n")) + rest)
        return [
            Block(
                b"".join(rows), data.count(b"\n", 0, starts[0]), functools.partial(_head, stated[0])
            )
        ]
    return [
        Block(part, data.count(b"\n", 0, start), functools.partial(_head, entries))
        for part, start, entries in zip(parts, starts, stated, strict=True)
    ]


def _first_time(part: bytes) -> float:
    """The first cell below the names; NaN where it is empty."""
    lines = part.lstrip(b"\n\t ").split(b"\n", 2)
    cell = re.split(rb"[\t,;]", lines[1])[0].decode("utf-8", "replace") if len(lines) > 1 else ""
    return number_in(cell, None) if is_number(cell, None) else math.nan


def _stated(header: bytes) -> dict[str, list[str]]:
    lines = header.decode("utf-8", "replace").splitlines()
    rows = [cells_of(line, "\t" if "\t" in line else ",") for line in lines]
    return {row[0]: row[1:] for row in rows if row}


def _without_comments(part: bytes) -> bytes:
    """The rows without the column of comments at their end, which few rows have."""
    line = part.lstrip(b"\n\t ").partition(b"\n")[0]
    sign = b"\t" if b"\t" in line else b","
    cells = line.rstrip(sign).split(sign)
    if cells[-1].strip(b'" ') != b"Comment" or len(cells) < 2:
        return part
    return first_columns(part, sign, len(cells) - 1)


def _head(stated: dict[str, list[str]], above: Above) -> Head | None:
    """`X_Value` is the time; it is empty where `Delta_X` alone says how far apart the samples
    are."""
    if len(above.cells) < 2 or len(above.cells[-2]) != above.width:
        return None
    names, first = above.cells[-2], above.cells[-1]
    times = [j for j, name in enumerate(names) if name.startswith("X_Value")]
    # what is stated is stated of the signals in turn
    rows = [
        iter([*stated.get(key, ()), *[""] * above.width])
        for key in ("Delta_X", "Y_Unit_Label", "X_Dimension")
    ]
    said = [("", "", "") if j in times else tuple(map(next, rows)) for j in range(above.width)]
    steps, units, dimensions = map(list, zip(*said, strict=True))
    for j in times:
        units[j] = "s" if first[j] and {"Time", ""} & {*dimensions} else ""
    rates = [per_second(frequency(step)) for step in steps]
    return Head(names, units, rates=rates, counters=[j for j in times if not first[j]])


LABVIEW = Dialect(blocks=_blocks)
