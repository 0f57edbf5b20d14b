"""Recordings as text: columns separated by comma, semicolon, tab or blanks, with or without a header."""

import functools

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.files import text_of

from ._recording_table import Table, time_name, unit_in
from ._text_tables import SIGNS, Line, cells_of, is_number, lines_of, number_in

MISSING = ("", "nan", "-nan", "na", "n/a", "null", "none")


def read_csv(data: bytes, file: str) -> Table:
    """The columns of a text file; `#` starts a comment.

    The delimiter is that of most lines: tab, semicolon, comma or blanks. Decimal commas are read where it is not the
    comma. A first line with anything but numbers is the header; the last comment before the data is one as well if it
    has a name for each column and one of them is the time (as `numpy.savetxt` writes it).

    **Raises:** `ValueError` naming file and line.
    """
    lines = lines_of(text_of(data, file))
    rows = [(line.number, line.body) for line in lines if line.body.strip()]
    if not rows:
        raise ValueError(f"{file}: holds no data, only comments")
    delimiter = _delimiter([body for _, body in rows])
    cells = [cells_of(body, delimiter) for _, body in rows]
    if delimiter is None and all(len(row) == 1 for row in cells[1:]) and '"' not in rows[0][1]:
        cells[0] = [rows[0][1].strip()]
    numbers = [number for number, _ in rows]
    if all(len(row) > 1 and not row[-1] for row in cells):
        cells = [row[:-1] for row in cells]
    header = None
    if not all(cell.casefold() in MISSING or is_number(cell, delimiter) for cell in cells[0]):
        header, place = cells.pop(0), numbers.pop(0)
        if not cells:
            raise ValueError(f"{file}: holds a header (line {place}) but no data")
    width = len(cells[0]) if header is None else len(header)
    for number, row in zip(numbers, cells, strict=True):
        if len(row) != width:
            raise ValueError(f"{file}, line {number}: {len(row)} of {width} columns found; {_remedy(delimiter)}")
    names = header or _commented(lines[: numbers[0] - 1], delimiter, width)
    return _table(file, names, cells, tuple(numbers), delimiter)


def _table(
    file: str, names: list[str] | None, cells: list[list[str]], lines: tuple[int, ...], delimiter: str | None
) -> Table:
    columns = {}
    for index in range(len(cells[0])):
        name = names[index] if names else str(index)
        if name in columns:
            raise ValueError(f"{file}: column {name!r} appears twice; rename one")
        columns[name or str(index)] = functools.partial(_column, file, name, cells, index, lines, delimiter)
    units = {name: unit for name in columns if (unit := unit_in(name)) is not None}
    return Table(file, columns, names is not None, {}, units, lines)


def _delimiter(bodies: list[str]) -> str | None:
    """Tab, semicolon or comma, the first that is in most lines; `None` for blanks or a single column."""
    return next((sign for sign in SIGNS if sum(sign in body for body in bodies) > len(bodies) / 2), None)


def _number(cell: str, delimiter: str | None) -> float:
    if cell.casefold() in MISSING:
        return float("nan")
    return number_in(cell, delimiter)


def _commented(lines: list[Line], delimiter: str | None, width: int) -> list[str] | None:
    """The header in the last comment, if it looks like one."""
    notes = [line.note for line in lines if line.note is not None]
    names = cells_of(notes[-1], delimiter) if notes else []
    fits = len(names) == width == len(set(names)) and time_name(Table("", dict.fromkeys(names, np.zeros)))  # pyright: ignore
    return names if fits else None


def _remedy(delimiter: str | None) -> str:
    if delimiter == ",":
        return "decimal commas need a semicolon or tab between the columns, lines that are no data a # before them"
    return "write a # before lines that are no data"


def _column(
    file: str, name: str, cells: list[list[str]], index: int, lines: tuple[int, ...], delimiter: str | None
) -> Float[np.ndarray, " rows"]:
    column = np.empty(len(cells))
    for i, row in enumerate(cells):
        try:
            column[i] = _number(row[index], delimiter)
        except ValueError:
            problem = f"{file}, line {lines[i]}: {name or index} {row[index]!r} is not a number"
            raise ValueError(f"{problem}; leave it empty if it is not known") from None
    return column
