"""Rows of numbers in a text: read quickly, and slowly where a line is wrong, to say which."""

import array
import dataclasses
import io
import itertools
import math
import re
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ._text_tables import cells_of, is_number, number_in, width_remedy

MISSING = ("", "nan", "-nan", "na", "n/a", "null", "none")
_WRITTEN = sorted(
    {change(word) for word in MISSING for change in (str, str.upper, str.title)} | {"NaN", "-NaN"}
)
_MOMENT = re.compile(
    r"(?:\d{4}-\d\d-\d\d[T ]|\d\d?[./]\d\d?[./]\d{4}"
    r" )?(\d\d?):(\d\d):(\d\d(?:[.,]\d+)?)(?:Z|[+-]\d\d:?\d\d)?"
)
_ROWS = 1 << 16


def is_value(cell: str, delimiter: str | None) -> bool:
    """Whether a cell holds a number, a time of day, or a word for a missing number."""
    return (
        cell.casefold() in MISSING
        or is_number(cell, delimiter)
        or _MOMENT.fullmatch(cell) is not None
    )


@dataclasses.dataclass(frozen=True)
class Body:
    """The rows of a text from byte `start` on, which is in line `first`.

    Each has `width` cells, `trailing` if another delimiter ends it; `sample` is the first one.
    """

    data: bytes
    start: int
    file: str
    first: int
    delimiter: str | None
    width: int
    trailing: bool
    sample: list[str]

    @property
    def moments(self) -> list[int]:
        """Columns of times of day, read as seconds from the first one; a date before them only says
        that it is one."""
        return [j for j in range(self.width) if _MOMENT.fullmatch(self.sample[j])]

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        """Line number and cells of every row."""
        stream = io.BytesIO(self.data)
        stream.seek(self.start)
        for number, line in enumerate(stream, self.first):
            if line.strip():
                yield (
                    number,
                    cells_of(line.decode("utf-8", errors="replace").rstrip("\n"), self.delimiter),
                )

    def place(self, row: int) -> str:
        """What messages call a row."""
        return f"line {next(itertools.islice(self.rows(), row, None))[0]}"

    def check(self) -> None:
        """**Raises:** `ValueError` for a line with another number of columns."""
        if not self._uneven_line().search(self.data, self.start):
            return
        # such a line, or one with a delimiter in quotes
        for number, cells in self.rows():
            found = len(cells) - (len(cells) == self.width + 1 and not cells[-1])
            if found != self.width:
                begun = self.data.startswith(b"Interval=") and cells[0].startswith("Interval=")
                remedy = "a second block begins there; save each block on its own"
                remedy = remedy if begun else width_remedy(self.delimiter)
                raise ValueError(
                    f"{self.file}, line {number}: {found} of {self.width} columns found; {remedy}"
                )

    def _uneven_line(self) -> re.Pattern[bytes]:
        """A line that is not empty and has more or fewer delimiters than the others."""
        if self.delimiter is None:
            even = rb"[^\S\n]*+(?:\S++[^\S\n]++){%d}\S++[^\S\n]*+" % (self.width - 1)
        else:
            sign = self.delimiter.encode()
            count = self.width - 1 + self.trailing
            even = b"[^%b\n]*+(?:%b[^%b\n]*+){%d}" % (sign, sign, sign, count)
        return re.compile(b"(?m)^(?!%b$).+" % even)

    def column(self, index: int, name: str) -> Float[np.ndarray, " rows"]:
        """One column as numbers, NaN where it has none.

        **Raises:** `ValueError` naming line and cell.
        """
        if index in self.moments:
            time = self._slowly(index, name)
            # past midnight
            time = time + 86400 * np.cumsum(np.diff(time, prepend=time[0]) < -43200)
            return time - time[0]
        try:
            return self._quickly(index)
        except (ValueError, OverflowError):
            # a cell that is no number, or written in another way than the rest
            return self._slowly(index, name)

    def _quickly(self, index: int) -> Float[np.ndarray, " rows"]:
        import pandas

        stream = io.BytesIO(self.data)
        stream.seek(self.start)
        comma = self.delimiter != "," and any("," in cell for cell in self.sample)
        # Before pandas 3.1 the last bit may be wrong unless it is asked for; from then on to ask is
        # deprecated.
        older = tuple(map(int, pandas.__version__.split(".")[:2])) < (3, 1)
        parts = pandas.read_csv(
            stream,
            sep=self.delimiter or r"\s+",
            header=None,
            names=range(self.width + self.trailing),
            usecols=[index],
            index_col=False,
            dtype=float,
            na_values=_WRITTEN,
            keep_default_na=False,
            skipinitialspace=True,
            decimal="," if comma else ".",
            chunksize=_ROWS,
            encoding_errors="replace",
            float_precision="round_trip" if older else None,
        )
        return np.concatenate([part[index].to_numpy() for part in parts])

    def _slowly(self, index: int, name: str) -> Float[np.ndarray, " rows"]:
        values, number_of = array.array("d"), _moment if index in self.moments else number_in
        for number, cells in self.rows():
            place = f"{self.file}, line {number}: "
            # a quotation mark that is not closed hides the delimiters behind it
            if len(cells) <= index:
                found = f"{len(cells)} of {self.width} columns found"
                raise ValueError(f'{place}{found}; a quotation mark (") may be open')
            cell = cells[index]
            try:
                missing = cell.casefold() in MISSING
                values.append(math.nan if missing else number_of(cell, self.delimiter))
            except ValueError:
                problem = f"{place}{name} {cell!r} is not a number"
                raise ValueError(f"{problem}; leave it empty if it is not known") from None
        return np.frombuffer(values).copy()


def _moment(cell: str, delimiter: str | None) -> float:
    """The time of day in a cell [s]."""
    found = _MOMENT.fullmatch(cell)
    if found is None:
        raise ValueError
    hours, minutes, seconds = found.groups()
    return 3600 * float(hours) + 60 * float(minutes) + float(seconds.replace(",", "."))
