"""Recordings as text: columns separated by comma, semicolon, tab or blanks, below headers of many
kinds."""

import functools
import re
from typing import Any

from ._recording_body import Body, is_value
from ._recording_headers import Head, diadem, head_of, spike2
from ._recording_table import Table, units_of
from ._recording_time import clock
from ._text_tables import SIGNS, Line, cells_of, lines_of

HEAD = 1 << 16  # bytes in which the first rows of numbers are expected
WIDEST = 20_000  # columns


def read_csv(data: bytes, file: str, skip_rows: int = 0) -> Table:
    """The columns of a text file; `#` starts a comment.

    The delimiter is that of most lines: tab, semicolon, comma or blanks. Decimal commas are read
    where it is not the comma. What stands above the first row of numbers is the header: names, a
    row of units, or what LabChart, Spike2, AcqKnowledge and DIAdem write. The last comment before
    the data is one as well if it has a name for each column and one of them is the time (as
    `numpy.savetxt` writes it).

    **Raises:** `ValueError` naming file and line.
    """
    data = _plain(data, file)
    found = spike2(data, file) or diadem(data, file, read_csv)
    if found is not None:
        return found
    notes = [line for line in lines_of(_text(data[:HEAD])) if line.number > skip_rows]
    data = re.sub(rb"[\t ]*#[^\n]*", b"", data) if b"#" in data else data
    lines = [line for line in _first_lines(data) if line.number > skip_rows]
    rows = [(line.number, line.body) for line in lines if line.body.strip()]
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
    head = head_of(lines, rows[:at], cells[: at + 1], width, delimiter, data.count(b"\n"), file)
    at += head.counts
    start = 0
    for _ in range(rows[at][0] - 1):
        start = data.index(b"\n", start) + 1
    body = Body(data, start, file, rows[at][0], delimiter, width, trailing, cells[at])
    names = head.names or _commented(notes, rows[at][0], delimiter, width)
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
    names = cells_of(notes[-1], delimiter) if notes else []
    if not len(names) == width == len(set(names)):
        return None
    columns: Any = dict.fromkeys(names, list)
    return names if clock(Table("", columns, True, {"": 1.0}, units_of(names))) else None


def _table(file: str, names: list[str] | None, head: Head, body: Body, words: list[int]) -> Table:
    known: list[str] = []
    for index in range(body.width):
        name = (names[index] if names else "") or str(index)
        if name in known:
            raise ValueError(f"{file}: column {name!r} appears twice; rename one")
        known.append(name)
    body.check()
    columns = {
        name: functools.partial(body.column, index, name) for index, name in enumerate(known)
    }
    units = units_of(known) | {
        name: unit for name, unit in zip(known, head.units, strict=False) if unit
    }
    units |= {known[index]: "s" for index in body.moments}
    rates = {} if head.rate is None else dict.fromkeys(known, head.rate)
    return Table(
        file,
        columns,
        names is not None,
        rates,
        units,
        frozenset(known[j] for j in words),
        body.place,
    )
