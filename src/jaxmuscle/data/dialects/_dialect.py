"""What a dialect is, and what the readers of several need."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .._recording_channels import Channel
from .._text_tables import Line, is_number, number_in
from .._units import seconds

if TYPE_CHECKING:
    from .._recording_table import Table

Content = Mapping[
    str, Any
]  # of a .mat file: numbers, texts, lists of them, and structs as mappings


class Head(NamedTuple):
    """Names and units of the columns, as far as a header has them; the `rate` [Hz] of all columns,
    or the `rates` of each; `counters`, the columns that only count; `counts` rows follow that are
    none."""

    names: Sequence[str] | None = None
    units: Sequence[str] = ()
    rate: float | None = None
    counts: int = 0
    rates: Sequence[float | None] = ()
    counters: Sequence[int] = ()
    notices: tuple[str, ...] = ()


class Above(NamedTuple):
    """What stands above the numbers: all `lines`; the `rows` that are not empty, and their `cells`,
    the last ones those of the first row of numbers, in line `first`. A text has `length` lines."""

    lines: list[Line]
    rows: list[tuple[int, str]]
    cells: list[list[str]]
    width: int
    delimiter: str | None
    first: int
    length: int
    file: str

    def padded(self, row: int) -> list[str]:
        """The cells of a row, as many as there are columns."""
        return [*self.cells[row], *[""] * self.width][: self.width]


class Block(NamedTuple):
    """A part of a text that is a table of its own, behind so many `lines`, and its header."""

    data: bytes
    lines: int
    head: Callable[[Above], Head | None]


class Dialect(NamedTuple):
    """How a program writes recordings.

    - `head`: the header of a text, where it stands above the numbers like any other
    - `blocks`: the parts of a text
    - `table`: a text that is in no rows; it gets the reader of those that are
    - `mat`: the channels of a .mat file, and the variables that are thereby understood

    Each gives `None` for what the program did not write.
    """

    head: Callable[[Above], Head | None] | None = None
    blocks: Callable[[bytes], Sequence[Block] | None] | None = None
    table: "Callable[[bytes, str, Callable[[bytes, str], Table]], Table | None] | None" = None
    mat: Callable[[Content], tuple[list[Channel], Iterable[str]] | None] | None = None


def rate_of(step: str, unit: str | None, file: str) -> float:
    """The rate [Hz] that follows from the time between two samples."""
    interval = number_in(step, None) * (seconds(unit) or 1.0) if is_number(step, None) else 0.0
    if not 1e-12 < interval < 1e12:
        raise ValueError(
            f"{file}: its header says {step!r} where the time between two samples belongs;"
            " correct it"
        )
    return 1 / interval


def frequency(cell: str) -> float | None:
    """The rate [Hz] in a cell, `None` where it holds none."""
    found = number_in(cell, None) if is_number(cell, None) else 0.0
    return found if 0 < found < math.inf else None


def first_columns(data: bytes, sign: bytes, count: int) -> bytes:
    """The rows of a text cut behind so many columns: what stands beside these few rows have."""
    row = b"(?m)^((?:[^S\n]*S){%d}[^S\n]*)S[^\n]*$" % (count - 1)
    return re.sub(row.replace(b"S", re.escape(sign)), rb"\1", data)


def below_groups(
    names: Sequence[str], groups: Sequence[str], joined: Callable[[int], bool]
) -> list[str]:
    """Names of columns behind the device or point whose name stands above the first of its columns,
    of those columns for which they are to be `joined`."""
    group, found = "", []
    for j, (name, above) in enumerate(zip(names, groups, strict=True)):
        group = above or group
        found.append(f"{group} {name}".strip() if joined(j) else name)
    return found


def upright(values: object) -> np.ndarray:
    """An array with its samples along the first of two dimensions, which is the longer one."""
    array = np.asarray(values)
    array = array.reshape(-1, 1) if array.ndim < 2 else array
    return array.T if array.shape[0] < array.shape[1] else array


def triples(names: Iterable[str]) -> list[str]:
    """The columns of points."""
    return [f"{name} {axis}" for name in names for axis in "XYZ"]


def texts(value: Any) -> list[str]:
    """The texts of a .mat: one, the rows of an array of letters, or the cells of a cell."""
    if isinstance(value, str):
        return [value.strip()]
    if isinstance(value, np.ndarray) and value.dtype.kind not in "OU":
        return []
    cells = list(value.reshape(-1) if isinstance(value, np.ndarray) else value or ())
    cells = ["" if np.size(cell) == 0 else cell for cell in cells]
    return [str(cell).strip() for cell in cells] if all(isinstance(c, str) for c in cells) else []


def columns_of(
    variable: str,
    columns: Sequence[np.ndarray],
    rate: float | None,
    names: Sequence[str],
    units: Sequence[str],
) -> list[Channel]:
    """The channels in the columns of a variable of a .mat, which are also found as `Data:3`."""
    aliases = [f"{variable}:{i}" for i in range(len(columns))] if len(columns) > 1 else [variable]
    rows = zip(names, columns, units, aliases, strict=True)
    return [Channel(name, column, rate, unit, alias) for name, column, unit, alias in rows]


def number(value: Any) -> float | None:
    """The finite number of a .mat, `None` for anything else."""
    array = np.asarray(value) if isinstance(value, int | float | np.number | np.ndarray) else None
    single = array is not None and array.size == 1 and array.dtype.kind in "iuf"
    return float(array.item()) if single and np.isfinite(array).all() else None  # pyright: ignore


def per_second(step: Any, unit: str | None = "s") -> float | None:
    """The rate [Hz] of a time between two samples in a .mat."""
    found, scale = number(step), seconds(unit)
    return 1 / (found * scale) if found and found > 0 and scale else None
