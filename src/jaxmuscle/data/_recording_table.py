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

TRIPLES = (
    ("_x", "_y", "_z"),
    (".x", ".y", ".z"),
    (" x", " y", " z"),
    (":x", ":y", ":z"),
    ("x", "y", "z"),
    (":0", ":1", ":2"),
)
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
    columns = {
        channel.name: functools.partial(np.asarray, channel.samples, dtype=float)
        for channel in channels
    }
    rates = {channel.name: channel.rate for channel in channels if channel.rate is not None}
    # of a struct that states no rate
    times = {
        stem: name
        for name in columns
        for stem, _, last in [name.rpartition(".")]
        if stem and last.casefold() in ("time", "t")
    }
    clocks = {
        name: time
        for name in columns
        if name not in rates and (time := times.get(name.rpartition(".")[0])) not in (None, name)
    }
    return Table(
        file,
        columns,
        named,
        rates,
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
    index = frame.index
    counter = index.dtype.kind not in "fmM" and index.name is None
    given = [] if counter else [(str(index.name or "time"), index)]
    given += [
        (" ".join(map(str, key)) if isinstance(key, tuple) else str(key), frame.iloc[:, i])
        for i, key in enumerate(frame.columns)
    ]
    names = [name for name, _ in given]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None or frame.empty:
        raise ValueError(
            "the table is empty"
            if frame.empty
            else f"the table has two columns {twice!r}; rename one"
        )
    columns = {name: lambda column=column: numbers(column.to_numpy()) for name, column in given}
    kinds = {name: column.dtype.kind for name, column in given}
    units = units_of(names) | {name: "s" for name, kind in kinds.items() if kind in "mM"}
    words = frozenset(name for name, kind in kinds.items() if kind not in "iufbmM")
    return Table("the table", columns, True, {}, units, words, "row {}".format)


def bare(name: str) -> str:
    """A column's name in small letters, without a unit."""
    return name_and_unit(name)[0]


def units_of(names: Iterable[str]) -> dict[str, str]:
    """The units that names of columns hold."""
    return {name: unit for name in names if (unit := name_and_unit(name)[1]) is not None}


def measured_in(table: Table, name: str) -> str | None:
    """What a column holds by its unit: force, torque, displacement, angle, ...; `None` for an
    unknown one."""
    return quantity_of(table.units.get(name, ""), name)


def listed(names: Iterable[str]) -> str:
    """Names for a message: columns 0 to n of one variable as a range, and not more than 30; those
    of points last, of which there are many."""
    groups: dict[str, list[str]] = {}
    for name in sorted(names, key=lambda name: _COORDINATE.search(name) is not None):
        stem, _, index = name.rpartition(":")
        groups.setdefault(stem if stem and index.isdigit() else name, []).append(name)
    groups = {stem: [repr(n) if ", " in n else n for n in group] for stem, group in groups.items()}
    short = [
        group[0] if len(group) == 1 else f"{group[0]} to {group[-1]}" for group in groups.values()
    ]
    return ", ".join(short[:30]) + (f" ... ({len(short)} in all)" if len(short) > 30 else "")


def find(table: Table, column: str | int, argument: str = "column") -> str:
    """The name of the column that is meant: by name (case and bracketed unit may be left out) or
    number from 0.

    **Raises:** `ValueError` with the nearest name and all names.
    """
    names = list(table.columns)
    exact = _find(names, column)
    if exact is None and table.aliases:
        exact = _find(list(table.aliases), column)
        exact = None if exact is None else table.aliases[exact]
    if exact is not None:
        return exact
    stem = str(column).casefold()
    if triple(table, str(column)) is not None:
        raise ValueError(
            f"{table.file}: {argument}={column!r} is a point of three columns; give axis='x', 'y',"
            " 'z' or 'principal'"
        )
    if any(name.casefold() == f"{stem}:0" for name in (*names, *table.aliases)):
        raise ValueError(
            f"{table.file}: {argument}={column!r} has several columns; choose one, as {column}:0"
            " (counted from 0)"
        )
    near = difflib.get_close_matches(str(column), names, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"{table.file}: no {argument} {column!r}; {hint}Known: {listed(names)}")


def _find(names: list[str], column: str | int) -> str | None:
    if isinstance(column, str):
        if column in names:
            return column
        loose = [name for name in names if bare(name) == bare(column)]
        if len(loose) == 1:
            return loose[0]
        stem, _, index = column.rpartition(":")
        mine = [name for name in names if name.rpartition(":")[0] == stem and stem]
        if mine and re.fullmatch(r"-\d+", index) and int(index) >= -len(mine):
            return mine[int(index)]
    if isinstance(column, int) or re.fullmatch(r"-?\d+", column):
        index = int(column)
        return names[index] if -len(names) <= index < len(names) else None
    return None


def triple(table: Table, stem: str) -> list[str] | None:
    """The three columns of the point with that name, if there are such."""
    known = {bare(name): name for name in table.columns}
    for suffixes in TRIPLES:
        wanted = [f"{stem}{suffix}".casefold() for suffix in suffixes]
        # Four columns NAME:0 to NAME:3 are a table.
        if all(name in known for name in wanted) and f"{stem}:3".casefold() not in known:
            return [known[name] for name in wanted]
    return None


def points(table: Table) -> list[str]:
    """Names of all points: what three columns have in common."""
    found: dict[str, None] = {}
    for name in map(bare, table.columns):
        for first, _, _ in TRIPLES:
            stem = name.removesuffix(first)
            # NAME_x ends in x as well, but its point is NAME.
            if (
                stem != name
                and stem[-1:] not in ("", "_", ".", ":", " ")
                and triple(table, stem) is not None
            ):
                found[stem] = None
    return list(found)


def values(table: Table, names: Iterable[str]) -> Float[np.ndarray, "rows columns"]:
    """The columns side by side.

    **Raises:** `ValueError` for unequal lengths, and an infinite value with its place.
    """
    names = list(names)
    parts = [table.columns[name]() for name in names]
    for name, part in zip(names, parts, strict=True):
        if part.size != parts[0].size:
            sizes = f"{names[0]} has {parts[0].size} samples, {name} {part.size}"
            raise ValueError(f"{table.file}: {sizes}; give columns of one length")
        wrong = np.flatnonzero(np.isinf(part))
        if wrong.size:
            raise ValueError(
                f"{table.file}, {table.place(int(wrong[0]))}: {name} is infinite; leave it empty if"
                " it is not known"
            )
    return np.stack(parts, axis=1)
