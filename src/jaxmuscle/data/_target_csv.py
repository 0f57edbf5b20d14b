"""Targets as CSV: columns of frequency, power and sigma, with or without a header."""

from typing import NamedTuple

import numpy as np

from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.text import choices

from ._target_fields import Columns
from ._text_tables import SIGNS, cells_of, is_number, lines_of, number_in

NAMES: tuple[str, ...] = ("frequency_hz", "proportional_power", "sigma")


class Sheet(NamedTuple):
    """A CSV file: its columns, whether it names them, and its comments as one text."""

    columns: Columns
    has_header: bool
    comment: str


def read_csv(text: str, file: str) -> Sheet:
    """Read `frequency_hz,proportional_power[,sigma]`, or two columns without a header.

    Columns are separated by comma, semicolon, tab or blanks; but for the first the decimal sign may
    be a comma. `#` starts a comment.

    **Raises:** `TargetError` naming file and line.
    """
    lines = lines_of(text)
    rows = [(line.place, line.body) for line in lines if line.body.strip()]
    comment = " ".join(line.note.strip() for line in lines if line.note and line.note.strip())
    if not rows:
        raise TargetError(f"{file}: holds no data; expected lines of {NAMES[0]},{NAMES[1]}")
    delimiter = _delimiter(*rows[0], file)
    cells = [(place, cells_of(body, delimiter)) for place, body in rows]
    has_header = not is_number(cells[0][1][0], delimiter)
    names = _header(*cells.pop(0), file) if has_header else list(NAMES[:2])
    if not cells:
        raise TargetError(f"{file}: holds a header but no data")
    table = np.array([_numbers(place, row, names, delimiter, file) for place, row in cells])
    column = dict(zip(names, table.T.copy(), strict=True))
    places = tuple(place for place, _ in cells)
    columns = Columns(column[NAMES[0]], column[NAMES[1]], column.get(NAMES[2]), places)
    return Sheet(columns, has_header, comment)


def merge_duplicates(columns: Columns, tolerance: float) -> Columns:
    """Sort by frequency and average rows that are within `tolerance` [Hz] of the first of their
    group."""
    order = np.lexsort((columns.power, columns.frequency))
    groups: list[list[int]] = []
    for row in order:
        if groups and columns.frequency[row] - columns.frequency[groups[-1][0]] <= tolerance:
            groups[-1].append(row)
        else:
            groups.append([row])
    frequency = np.array([columns.frequency[group].mean() for group in groups])
    power = np.array([columns.power[group].mean() for group in groups])
    return Columns(frequency, power, None, tuple(columns.places[group[0]] for group in groups))


def _delimiter(place: str, body: str, file: str) -> str | None:
    if "\t" in body.strip() and ";" in body:
        raise TargetError(
            f"{file}, {place}: holds tabs and semicolons; use one of them between the columns"
        )
    found = next((sign for sign in SIGNS if sign in body.strip()), None)
    if found is None and len(body.split()) < 2:
        raise TargetError(
            f"{file}, {place}: one column; separate frequency and power by comma, semicolon, tab or"
            " blanks"
        )
    return found


def _header(place: str, row: list[str], file: str) -> list[str]:
    names = [cell.lower() for cell in row]
    if not any(name.startswith(("freq", "prop", "power", "sigma")) for name in names):
        raise TargetError(
            f"{file}, {place}: the columns are {', '.join(row)}; a spectrum has"
            f" {NAMES[0]},{NAMES[1]}[,sigma]. Is this a recording? Then give it to `jaxmuscle"
            " analyse`, or read it with jaxmuscle.load_recording"
        )
    for name in names:
        if name not in NAMES:
            raise TargetError(f"{file}, {place}: unknown column {name!r}; {choices(name, NAMES)}")
        if names.count(name) > 1:
            raise TargetError(f"{file}, {place}: column {name!r} appears twice; keep one")
    for name in NAMES[:2]:
        if name not in names:
            raise TargetError(
                f"{file}, {place}: no column {name!r}; expected {NAMES[0]},{NAMES[1]}[,sigma]"
            )
    return names


def _numbers(
    place: str, row: list[str], names: list[str], delimiter: str | None, file: str
) -> list[float]:
    if len(row) != len(names):
        remedy = (
            "decimal commas need a semicolon or tab between the columns"
            if delimiter == ","
            else "check it"
        )
        remedy = (
            "a third column needs a header naming it sigma, or " + remedy
            if len(row) == 3
            else remedy
        )
        raise TargetError(f"{file}, {place}: {len(row)} of {len(names)} columns found; {remedy}")
    for name, cell in zip(names, row, strict=True):
        if not is_number(cell, delimiter):
            raise TargetError(f"{file}, {place}: {name} {cell!r} is not a number")
    return [number_in(cell, delimiter) for cell in row]
