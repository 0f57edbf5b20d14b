"""Recordings as text: columns separated by comma, semicolon, tab or blanks, below headers of many
kinds."""

import functools
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from ._recording_body import Body, is_value
from ._recording_channels import numbered
from ._recording_headers import head_of
from ._recording_table import Table, listed, merged, units_of
from ._recording_time import clock
from ._text_tables import SIGNS, Line, cells_of, lines_of
from ._units import name_and_unit, seconds
from .dialects._dialect import Above, Block, Head
from .dialects._dialects import DIALECTS

HEAD = 1 << 16  # bytes in which the first rows of numbers are expected
WIDEST = 20_000  # columns
NUMBERED = "columns of one name are numbered: "
_TIME_OF = re.compile(r" *(?:time series|time|\[?x\]?) *")


def read_csv(data: bytes, file: str, skip_rows: int = 0) -> Table:
    """The columns of a text file; `#` starts a comment.

    The delimiter is that of most lines: tab, semicolon, comma or blanks. Decimal commas are read
    where it is not the comma. What stands above the first row of numbers is the header: names,
    rows of units and rates, or what the programs of `dialects` write. The last comment before
    the data is one as well if it has a name for each column and one of them is the time (as
    `numpy.savetxt` writes it).

    **Raises:** `ValueError` naming file and line.
    """
    data = _plain(data, file)
    for dialect in DIALECTS:
        table = dialect.table and dialect.table(data, file, read_csv)
        if table:
            return table
        blocks = dialect.blocks and dialect.blocks(data)
        if blocks:
            # "Frame#" is the name of a column
            parts = [each._replace(data=each.data.replace(b"#", b"")) for each in blocks]
            return merged(file, [_block(each, file, skip_rows) for each in parts])
    return _block(Block(data, 0, head_of), file, skip_rows)


def _block(block: Block, file: str, skip_rows: int) -> Table:
    data, before = block.data, block.lines
    skip_rows -= before
    notes = [line for line in lines_of(_text(data[:HEAD])) if line.number > skip_rows]
    data = re.sub(rb"[\t ]*#[^\n]*", b"", data) if b"#" in data else data
    lines = [line for line in _first_lines(data) if line.number > skip_rows]
    rows = [(line.number + before, line.body) for line in lines if line.body.strip()]
    if not rows:
        raise ValueError(f"{file}: holds no data, only comments")
    delimiter = _delimiter([body for _, body in rows[len(rows) // 2 :]])
    cells = [cells_of(body, delimiter) for _, body in rows]
    later = cells[len(cells) // 2 :]
    if delimiter is None and all(len(row) == 1 for row in later):
        cells = [[body.strip().strip('"')] for _, body in rows]
    width = _width(cells[len(cells) // 2 :])
    if width > WIDEST:
        raise ValueError(
            f"{file}, line {rows[-1][0]}: has {width} columns; a recording has at most {WIDEST}"
        )
    trailing = width > 1 and all(not row[-1] for row in cells if len(row) == width)
    if trailing:
        cells, width = [row[:-1] if len(row) == width else row for row in cells], width - 1
    at = _start(cells, width, delimiter)
    if at is None:
        raise ValueError(f"{file}: holds a header (line {rows[0][0]}) but no data")
    length = block.data.count(b"\n")
    above = Above(
        notes, rows[:at], cells[: at + 1], width, delimiter, rows[at][0] - before, length, file
    )
    head = block.head(above) or head_of(above)
    at += head.counts
    start = 0
    for _ in range(rows[at][0] - before - 1):
        start = data.index(b"\n", start) + 1
    body = Body(data, start, file, rows[at][0], delimiter, width, trailing, cells[at])
    names = head.names or _commented(notes, rows[at][0] - before, delimiter, width)
    return _table(file, names, head, body, _words(cells[at:], width, delimiter))


def _plain(data: bytes, file: str) -> bytes:
    """The text in an encoding in which digits are ASCII, with \\n at the ends of lines and nothing
    on blank ones."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        data = data.decode("utf-16", errors="replace").encode()
    if not re.search(rb"\S", data):
        raise ValueError(f"{file}: is empty")
    if b"\0" in data:
        raise ValueError(
            f"{file}: is not UTF-8 text (a binary file, or saved with another encoding)"
        )
    data = data.removeprefix(b"\xef\xbb\xbf")
    data = data if b"\r" not in data else data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    blank = data[:1] in b" \t" or b"\n " in data or b"\n\t" in data
    return re.sub(rb"(?m)^[ \t]+$", b"", data) if blank else data


def _text(data: bytes) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        # The end may be within a letter; other letters are those of Windows.
        cut = error.start > len(data) - 4
        return (
            data[: error.start].decode("utf-8") if cut else data.decode("cp1252", errors="replace")
        )


def _first_lines(data: bytes) -> list[Line]:
    end = len(data) if len(data) <= HEAD else data.rfind(b"\n", 0, HEAD)
    return lines_of(_text(data[: end if end > 0 else len(data)]))


def _delimiter(bodies: list[str]) -> str | None:
    """Tab, semicolon or comma, the first that is in most lines; `None` for blanks or a single
    column."""
    return next(
        (sign for sign in SIGNS if sum(sign in body for body in bodies) >= len(bodies) / 2), None
    )


def _width(cells: list[list[str]]) -> int:
    widths = [len(row) for row in cells]
    return max(dict.fromkeys(widths), key=widths.count)


def _start(cells: list[list[str]], width: int, delimiter: str | None) -> int | None:
    """The first row with a number in each column that has numbers further on, or in the first of
    them below names."""
    later = [row for row in cells[len(cells) // 2 :] if len(row) == width]
    numeric = [
        j for j in range(width) if any(row[j] and is_value(row[j], delimiter) for row in later)
    ]
    for i, row in enumerate(cells):
        if len(row) != width or not numeric:
            continue
        there = [is_value(row[j], delimiter) for j in numeric]
        below = (
            i > 0
            and len(cells[i - 1]) == width
            and not any(is_value(cell, delimiter) for cell in cells[i - 1] if cell)
        )
        if (all(there) and any(row[j] for j in numeric)) or (
            below and there[0] and row[numeric[0]]
        ):
            return i
    return None


def _words(cells: list[list[str]], width: int, delimiter: str | None) -> list[int]:
    """Columns in which nothing is a number; empty ones only beside two others."""
    rows = [row for row in cells if len(row) == width]
    there = [[row[j] for row in rows if row[j]] for j in range(width)]
    empty = [j for j in range(width) if not there[j]]
    words = [
        j
        for j in range(width)
        if there[j] and not any(is_value(cell, delimiter) for cell in there[j])
    ]
    return words + empty * (width - len(words) - len(empty) >= 2)


def _commented(
    lines: list[Line], first: int, delimiter: str | None, width: int
) -> list[str] | None:
    """The header in the last comment before the data, if it looks like one."""
    notes = [line.note for line in lines if line.note is not None and line.number < first]
    # a single column may be called by several words
    names = cells_of(notes[-1], "\t" if width == 1 else delimiter) if notes else []
    if not len(names) == width == len(set(names)):
        return None
    columns: Any = dict.fromkeys(names, list)
    units = units_of(names)
    return names if units or clock(Table("", columns, True, {"": 1.0}, units)) else None


def _table(
    file: str, names: Sequence[str] | None, head: Head, body: Body, words: list[int]
) -> Table:
    given = [(names[j] if names else "") or str(j) for j in range(body.width)]
    known = numbered(given)
    body.check()
    units = units_of(known) | {
        name: unit for name, unit in zip(known, head.units, strict=False) if unit
    }
    units |= {known[index]: "s" for index in body.moments}
    clocks = _clocks(given, known, units)
    columns = {
        name: functools.partial(_column, body, known, clocks.get(name), name) for name in known
    }
    said = () if known == given else (f"{NUMBERED}{listed(_twice(given))}",)
    table = Table(
        file,
        columns,
        names is not None,
        {},
        units,
        frozenset(known[j] for j in {*words, *head.counters}),
        body.place,
        said,
        {name: time for name, time in clocks.items() if name != time},
    )
    rates = dict(zip(known, head.rates or [head.rate] * len(known), strict=False))
    rates = {name: rate for name, rate in rates.items() if rate is not None}
    # what a program states is its rate; a line of words gives way to times
    if not rates or (head.notices and clock(table) is not None):
        return table
    return table._replace(rates=rates, notices=(*said, *head.notices))


def _twice(names: Sequence[str]) -> list[str]:
    return [name for name in dict.fromkeys(names) if names.count(name) > 1]


def _column(
    body: Body, known: list[str], time: str | None, name: str
) -> Float[np.ndarray, " rows"]:
    """A column, which ends where times of its own do: other columns may be longer."""
    values = body.column(known.index(name), name)
    if time is None:
        return values
    there = np.flatnonzero(np.isfinite(body.column(known.index(time), time)))
    return values[: there[-1] + 1] if there.size else values


def _clocks(given: list[str], known: list[str], units: Mapping[str, str]) -> dict[str, str]:
    """The time of every column where there are several columns of times, each before its own: they
    have one name, or that of what follows, or are all called a time."""
    bare_names = [name_and_unit(name)[0] for name in given]
    times = [
        j
        for j, name in enumerate(known)
        if seconds(units.get(name)) is not None or bare_names[j] in ("time", "t")
    ]
    if len(times) < 2 or times[0] != 0:
        return {}
    bares = [bare_names[j] for j in times]
    own = [_TIME_OF.sub("", bare_names[j]) == "".join(bare_names[j + 1 : j + 2]) for j in times]
    followed = all("time" in name for name in bares) and all(
        j + 1 < len(known) and j + 1 not in times for j in times
    )
    if len(set(bares)) > 1 and not all(own) and not followed:
        return {}
    return {name: known[max(t for t in times if t <= j)] for j, name in enumerate(known)}
