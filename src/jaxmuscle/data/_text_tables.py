"""Text that holds a table: lines with comments, cells between delimiters, numbers with decimal
commas."""

import csv
import re
from typing import NamedTuple

SIGNS = ("\t", ";", ",")
TEXT = (".csv", ".tsv", ".txt", ".dat", ".asc")  # files that hold one
LOOK_AT = 100  # cells of a line


class Line(NamedTuple):
    """A line of a file: its number, what is before the `#`, and the comment behind it, None without
    one."""

    number: int
    body: str
    note: str | None

    @property
    def place(self) -> str:
        """What an error calls it."""
        return f"line {self.number}"


def lines_of(text: str) -> list[Line]:
    """All lines, whatever system wrote them."""
    parts = (
        line.partition("#") for line in text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    )
    return [
        Line(number, body, note if sign else None)
        for number, (body, sign, note) in enumerate(parts, 1)
    ]


def delimiter_in(body: str, usual: str | None = None) -> str | None:
    """The sign between the cells of a line: tab, semicolon or comma, the first that is there."""
    return next((sign for sign in SIGNS if sign in body), usual)


def cells_of(body: str, delimiter: str | None) -> list[str]:
    """What stands between the delimiters (None: blanks), without blanks about it; quotes keep a
    delimiter as text."""
    if '"' not in body:
        cells = body.split(delimiter)
    else:
        try:
            cells = next(
                csv.reader([body.strip(" ")], delimiter=delimiter or " ", skipinitialspace=True)
            )
        except csv.Error:
            return [body]
    return [cell.strip() for cell in cells]


def number_in(cell: str, delimiter: str | None) -> float:
    """The number of a cell; its decimal sign may be a comma unless that is the delimiter. Raises
    `ValueError`."""
    if "_" in cell:  # Python would take it as one between digits
        raise ValueError(f"{cell!r} is not a number")
    return float(cell if delimiter == "," else cell.replace(",", "."))


def is_number(cell: str, delimiter: str | None) -> bool:
    """Whether a cell holds a number."""
    try:
        number_in(cell, delimiter)
    except ValueError:
        return False
    return True


def width_remedy(delimiter: str | None) -> str:
    """What helps where a line has another number of columns than the rest."""
    remedy = "write a # before lines that are no data, or leave them out with `skip_rows`"
    return (
        f"decimal commas need a semicolon or tab between the columns; {remedy}"
        if delimiter == ","
        else remedy
    )


def holds_text(begin: bytes) -> bool:
    """Whether what a file begins with is text with rows of numbers, whatever its ending says."""
    wide = begin[:2] in (b"\xff\xfe", b"\xfe\xff")
    text = begin.decode("utf-16" if wide else "latin-1", errors="replace")
    return "\0" not in text and any(map(_is_row, text.splitlines()))


def _is_row(line: str) -> bool:
    cells = re.split(r"[\t;, ]+", line.strip('\t;, "'))
    numbers = sum(is_number(cell, ",") for cell in cells[:LOOK_AT])
    return numbers > 0 and 2 * numbers >= len(cells[:LOOK_AT])
