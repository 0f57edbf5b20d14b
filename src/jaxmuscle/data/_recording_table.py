"""Tables of columns, whatever file they came from: find a column, a point of three columns, the time, the rate."""

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

TRIPLES = (
    ("_x", "_y", "_z"),
    (".x", ".y", ".z"),
    (" x", " y", " z"),
    (":x", ":y", ":z"),
    ("x", "y", "z"),
    (":0", ":1", ":2"),
)
AXES = ("x", "y", "z")
_TIME = re.compile(r"(?:(?:elapsed[ _]?)?time|t|timestamp|seconds)[ _]*[\[(]?(s|sec|secs|seconds|ms|msec|us|µs)?[\])]?")
_SECONDS = {"ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6}
_UNIT = re.compile(r"(.+?)\s*[\[(]([^\[\]()]+)[\])]\s*")
RATE_TOLERANCE = 5e-3
JITTER = 0.25  # of a sampling interval


class Table(NamedTuple):
    """Columns of a file by name.

    `columns` are functions, so that only those that are asked for are read; `named` is false where names are only
    numbers; `rates` [Hz] and `units` by column, where the file states them; `lines` are those of the rows, if it has any.
    """

    file: str
    columns: Mapping[str, Callable[[], Float[np.ndarray, " rows"]]]
    named: bool = True
    rates: Mapping[str, float] = {}
    units: Mapping[str, str] = {}
    lines: tuple[int, ...] = ()

    def place(self, row: int) -> str:
        """How messages call a row."""
        return f"line {self.lines[row]}" if self.lines else f"sample {row}"


def bare(name: str) -> str:
    """A column's name in small letters, without a unit in brackets."""
    found = _UNIT.fullmatch(name)
    return (found[1] if found else name).strip().casefold()


def unit_in(name: str) -> str | None:
    """The unit that a column's name holds in brackets."""
    found = _UNIT.fullmatch(name)
    return found[2].strip() if found else None


def listed(names: Iterable[str]) -> str:
    """Names for a message: columns 0 to n of one variable as a range, and not more than 30."""
    groups: dict[str, list[str]] = {}
    for name in names:
        stem, _, index = name.rpartition(":")
        groups.setdefault(stem if stem and index.isdigit() else name, []).append(name)
    short = [group[0] if len(group) == 1 else f"{group[0]} to {group[-1]}" for group in groups.values()]
    return ", ".join(short[:30]) + (f" ... ({len(short)} in all)" if len(short) > 30 else "")


def find(table: Table, column: str | int, argument: str = "column") -> str:
    """The name of the column that is meant: by name (case and bracketed unit may be left out) or number from 0.

    **Raises:** `ValueError` with the nearest name and all names.
    """
    names = list(table.columns)
    exact = _find(names, column)
    if exact is not None:
        return exact
    stem = str(column).casefold()
    if triple(table, str(column)) is not None:
        raise ValueError(
            f"{table.file}: {argument}={column!r} is a point of three columns; give axis='x', 'y', 'z' or 'principal'"
        )
    if any(name.casefold() == f"{stem}:0" for name in names):
        raise ValueError(
            f"{table.file}: {argument}={column!r} has several columns; choose one, as {column}:0 (counted from 0)"
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
            if stem != name and stem[-1:] not in ("", "_", ".", ":", " ") and triple(table, stem) is not None:
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
                f"{table.file}, {table.place(int(wrong[0]))}: {name} is infinite; leave it empty if it is not known"
            )
    return np.stack(parts, axis=1)


def time_name(table: Table) -> str | None:
    """The column that holds the time, by its name."""
    return next((name for name in table.columns if _TIME.fullmatch(name.strip().casefold())), None)


def unnamed_time(table: Table) -> str | None:
    """The first of several nameless columns, if it rises evenly from row to row, other than by 1 (a counter)."""
    first = next(iter(table.columns))
    if table.named or len(table.columns) < 2:
        return None
    time = table.columns[first]()
    if time.size < 3 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
        return None
    even, interval, _ = _departure(time)
    return first if even and interval != 1 else None


def clock(table: Table, name: str, rows: int) -> tuple[float, float, float] | None:
    """Rate [Hz], first time [s] and relative uncertainty of the rate from the time column; `None` for another length.

    A column of times rounded to a fixed number of decimals is even if the exact times would be.

    **Raises:** `ValueError` naming line and times where the time is missing, does not rise or is not even.
    """
    found = _TIME.fullmatch(name.strip().casefold())
    time = table.columns[name]() * _SECONDS.get((found[1] or "s") if found else "s", 1.0)
    if time.size != rows or rows < 2:
        return None
    for wrong, what in ((~np.isfinite(time), "holds no number"), (np.diff(time, prepend=time[0]) < 0, "runs backwards")):
        if np.any(wrong):
            raise ValueError(f"{table.file}, {table.place(int(np.argmax(wrong)))}: time column {name!r} {what}")
    if not time[-1] > time[0]:
        raise ValueError(f"{table.file}: time column {name!r} stands still at {time[0]:g}")
    even, interval, rounding = _departure(time)
    if not even:
        at = int(np.argmax(np.diff(time)))
        raise ValueError(
            f"{table.file}: time column {name!r} is not uniform: after {time[at]:.6g} s ({table.place(at)}) comes "
            f"{time[at + 1]:.6g} s, on average {interval:.6g} s lie between two; resample it evenly, or leave the "
            "column out and give rate"
        )
    return 1 / interval, float(time[0]), rounding / (time[-1] - time[0])


def _departure(time: Float[np.ndarray, " rows"]) -> tuple[bool, float, float]:
    """Whether the times are even, the mean interval, and the unit of their last decimal."""
    interval = float(time[-1] - time[0]) / (time.size - 1)
    rounding = next((10.0**-d for d in range(9) if np.allclose(time, np.round(time, d), rtol=0, atol=1e-12)), 0.0)
    steps = np.diff(time)
    uneven = np.sum(np.abs(steps - np.median(steps)) > rounding / 2)
    # One or two odd steps are lost samples, and a step as coarse as many intervals is no rounding either.
    rounding = rounding if uneven > 2 and rounding <= 5 * interval else 0.0
    departure = np.max(np.abs(time - time[0] - interval * np.arange(time.size)))
    return bool(departure <= JITTER * interval + rounding), interval, rounding
