"""Tables of columns, whatever they came from: find a column, or a point of three columns."""

import difflib
import functools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.text import printable

from ._recording_channels import Channel, numbers
from ._units import name_and_unit, quantity_of, seconds

TRIPLES = [[f"{sign}{axis}" for axis in "xyz"] for sign in ("_", ".", " ", ":", "")] + [
    [":0", ":1", ":2"]
]
AXES = ("x", "y", "z")
_COORDINATE = re.compile(r"[_.: ][xyz]$", re.IGNORECASE)


class Table(NamedTuple):
    """Columns of a file by name.

    `columns` are functions, so that only those that are asked for are read; `named` is false where
    names are only numbers; `rates` [Hz] and `units` by column, where the file states them; `words`
    are columns that hold no signals; `place` is how messages call a row; `notices` say what the
    reader decided; `clocks` are the columns of times that belong to others, by these; `aliases` are
    further names of columns; `sheet` is that of a workbook with several.
    """

    file: str
    columns: Mapping[str, Callable[[], Float[np.ndarray, " rows"]]]
    named: bool = True
    rates: Mapping[str, float] = {}
    units: Mapping[str, str] = {}
    words: frozenset[str] = frozenset()
    place: Callable[[int], str] = "sample {}".format
    notices: tuple[str, ...] = ()
    clocks: Mapping[str, str] = {}
    aliases: Mapping[str, str] = {}
    sheet: str = ""

    def measured_in(self, name: str) -> str | None:
        """What a column holds by its unit: force, torque, displacement, angle, ...; `None` for an
        unknown one."""
        return quantity_of(self.units.get(name, ""), name)

    @property
    def name(self) -> str:
        """What a recording of it is called: the file, and the sheet of several."""
        stem = Path(self.file.removesuffix(self.of_sheet)).stem
        return printable(f"{stem} {self.sheet}".strip())

    @property
    def of_sheet(self) -> str:
        """What stands behind the name of the file in messages."""
        return f", sheet {self.sheet}" if self.sheet else ""


def channels_table(file: str, channels: Sequence[Channel], *, named: bool = True) -> Table:
    """The channels that a reader found in a file."""
    # a struct that states no rate may hold its times beside the signals
    times: dict[str, str] = {}
    for channel in channels:
        struct, _, last = channel.name.rpartition(".")
        if struct and last.casefold() in ("time", "t"):
            times[struct] = channel.name
    clocks = {
        channel.name: time
        for channel in channels
        if channel.rate is None
        and (time := times.get(channel.name.rpartition(".")[0])) not in (None, channel.name)
    }
    return Table(
        file,
        {each.name: functools.partial(np.asarray, each.samples, dtype=float) for each in channels},
        named,
        {channel.name: channel.rate for channel in channels if channel.rate is not None},
        {channel.name: channel.unit for channel in channels if channel.unit},
        clocks=clocks,
        aliases={channel.alias: channel.name for channel in channels if channel.alias},
    )


def merged(file: str, tables: Sequence[Table]) -> Table:
    """The tables of a file as one: columns that several have are told apart by the block."""
    if len(tables) == 1:
        return tables[0]
    often = [name for table in tables for name in table.columns]
    columns: dict[str, Any] = {}
    rates, units, clocks = dict[str, float](), dict[str, str](), dict[str, str]()
    words: set[str] = set()
    for block, table in enumerate(tables, 1):
        new = {
            name: name if often.count(name) == 1 else f"{name}, block {block}"
            for name in table.columns
        }
        times = [name for name in new if seconds(table.units.get(name)) is not None]
        own = table.clocks or {name: time for time in times[:1] for name in new if name != time}
        columns |= {new[name]: column for name, column in table.columns.items()}
        rates |= {new[name]: rate for name, rate in table.rates.items()}
        units |= {new[name]: unit for name, unit in table.units.items()}
        clocks |= {new[name]: new[time] for name, time in own.items()}
        words |= {new[name] for name in table.words}
    said = tuple(dict.fromkeys(notice for table in tables for notice in table.notices))
    return Table(file, columns, True, rates, units, frozenset(words), notices=said, clocks=clocks)


def frame_table(frame: Any) -> Table:
    """The columns of a pandas table, its index before them if that is more than a counter; times
    become seconds.

    **Raises:** `ValueError` if it is no such table.
    """
    if not hasattr(frame, "columns"):
        raise ValueError(
            f"frame={type(frame).__name__}: give a pandas DataFrame, a single column as"
            " frame.to_frame()"
        )
    if frame.empty:
        raise ValueError("the table is empty")
    index, keys = frame.index, [key if isinstance(key, tuple) else (key,) for key in frame.columns]
    given = [(" ".join(map(str, key)), frame.iloc[:, i]) for i, key in enumerate(keys)]
    if index.dtype.kind in "fmM" or index.name is not None:
        given.insert(0, (str(index.name or "time"), index))
    columns = dict(given)
    if len(columns) < len(given):
        names = [name for name, _ in given]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the table has two columns {twice!r}; rename one")
    kinds = {name: column.dtype.kind for name, column in given}
    return Table(
        "the table",
        {name: lambda column=column: numbers(column.to_numpy()) for name, column in given},
        units=units_of(columns) | {name: "s" for name, kind in kinds.items() if kind in "mM"},
        words=frozenset(name for name, kind in kinds.items() if kind not in "iufbmM"),
        place="row {}".format,
    )


def bare(name: str) -> str:
    """A column's name in small letters, without a unit."""
    return name_and_unit(name)[0]


def units_of(names: Iterable[str]) -> dict[str, str]:
    """The units that names of columns hold."""
    return {name: unit for name in names if (unit := name_and_unit(name)[1]) is not None}


def listed(names: Iterable[str]) -> str:
    """Names for a message: columns 0 to n of one variable as a range, and not more than 30; those
    of points last, of which there are many."""
    groups: dict[str, list[str]] = {}
    for name in sorted(names, key=lambda name: _COORDINATE.search(name) is not None):
        stem, _, index = name.rpartition(":")
        quoted = repr(name) if ", " in name else name
        groups.setdefault(stem if stem and index.isdigit() else name, []).append(quoted)
    short = [" to ".join(dict.fromkeys((group[0], group[-1]))) for group in groups.values()]
    return ", ".join(short[:30]) + (f" ... ({len(short)} in all)" if len(short) > 30 else "")


def find(table: Table, column: str | int, argument: str = "column") -> str:
    """The name of the column that is meant: by name (case and bracketed unit may be left out) or
    number from 0.

    **Raises:** `ValueError` with the nearest name and all names.
    """
    names, fault = list(table.columns), f"{table.file}: {argument}={column!r}"
    found = _find(names, column) or table.aliases.get(_find(list(table.aliases), column) or "")
    if found is not None:
        return found
    if triple(table, str(column)) is not None:
        raise ValueError(
            f"{fault} is a point of three columns; give axis='x', 'y', 'z' or 'principal'"
        )
    first = f"{column}:0"
    if any(name.casefold() == first.casefold() for name in (*names, *table.aliases)):
        raise ValueError(f"{fault} has several columns; choose one, as {first} (counted from 0)")
    near = difflib.get_close_matches(str(column), names, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"{table.file}: no {argument} {column!r}; {hint}Known: {listed(names)}")


def _find(names: list[str], column: str | int) -> str | None:
    if column in names:
        return str(column)
    if isinstance(column, str):
        loose = [name for name in names if bare(name) == bare(column)]
        if len(loose) == 1:
            return loose[0]
        stem, _, index = column.rpartition(":")
        mine = [name for name in names if name.rpartition(":")[0] == stem and stem]
        if mine and re.fullmatch(r"-\d+", index) and int(index) >= -len(mine):
            return mine[int(index)]
        if not re.fullmatch(r"-?\d+", column):
            return None
    return names[int(column)] if -len(names) <= int(column) < len(names) else None


def triple(table: Table, stem: str) -> list[str] | None:
    """The three columns of the point with that name, if there are such."""
    known = {bare(name): name for name in table.columns}
    if f"{stem}:3".casefold() in known:  # a table of four columns or more
        return None
    each = ([f"{stem}{suffix}".casefold() for suffix in suffixes] for suffixes in TRIPLES)
    return next(([known[n] for n in wanted] for wanted in each if known.keys() >= {*wanted}), None)


def points(table: Table) -> list[str]:
    """Names of all points: what three columns have in common."""
    ends = tuple(first for first, _, _ in TRIPLES)
    stems = dict.fromkeys(
        name.removesuffix(end)
        for name in map(bare, table.columns)
        for end in ends
        if name.endswith(end)
    )
    # NAME_x ends in x as well, but its point is NAME.
    return [
        stem
        for stem in stems
        if stem and stem[-1] not in "_.: " and triple(table, stem) is not None
    ]


def values(table: Table, names: Iterable[str]) -> Float[np.ndarray, "rows columns"]:
    """The columns side by side.

    **Raises:** `ValueError` for unequal lengths, and an infinite value with its place.
    """
    parts = {name: table.columns[name]() for name in names}
    first, rows = next((name, part.size) for name, part in parts.items())
    for name, part in parts.items():
        if part.size != rows:
            raise ValueError(
                f"{table.file}: {first} has {rows} samples, {name} {part.size}; give columns of one"
                " length"
            )
        wrong = np.flatnonzero(np.isinf(part))
        if wrong.size:
            raise ValueError(
                f"{table.file}, {table.place(int(wrong[0]))}: {name} is infinite; leave it empty if"
                " it is not known"
            )
    return np.stack([*parts.values()], axis=1)
