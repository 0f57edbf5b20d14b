"""Recordings in files: choose a column or a point, find the rate, close short gaps."""

import contextlib
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle.spectra._settings import require

from ._recording import Recording, known_unit
from ._recording_csv import read_csv
from ._recording_formats import read_c3d, read_mat, read_npy, read_npz
from ._recording_quality import filled
from ._recording_table import (
    AXES,
    RATE_TOLERANCE,
    Table,
    clock,
    find,
    listed,
    points,
    time_name,
    triple,
    unnamed_time,
    values,
)

TEXT = (".csv", ".tsv", ".txt")
READERS = {".mat": read_mat, ".npy": read_npy, ".npz": read_npz}
KINDS = (*TEXT, *READERS, ".c3d")


def load_recording(
    path: str | os.PathLike[str],
    *,
    column: str | int | None = None,
    rate: float | int | None = None,
    units: str | None = None,
    axis: str | None = None,
    reference: str | int | None = None,
    max_gap: float | int = 0.2,
) -> Recording:
    """Load a force, torque, displacement or acceleration from CSV or TSV text, MATLAB (.mat), NumPy (.npy, .npz) or C3D.

    Text: delimiter, header and decimal commas are detected, `#` starts a comment. A column called time, t, `time (ms)`
    ... gives the rate; it has to be even, and times count from its first row. MATLAB: variables by name, `trial.force`
    for a field of a struct, `Data:74` for a column of a table, **counted from 0** as in `Data[:, 74]`. C3D: points, and
    analog channels.

    Points have three columns, as `finger_x, finger_y, finger_z` or `finger:0` to `finger:2`. `axis="principal"` is the
    direction in which the point, minus reference, moves most; it is positive along its largest component.

    **Arguments:**

    - `path`: the file; its suffix says the format.
    - `column`: name (case and a unit in brackets may be left out) or number from 0; needed if there are several.
    - `rate` [Hz]: needed if the file does not state it.
    - `units`: as in `Recording`; by default what the file states, else N. Nothing is converted.
    - `axis`: which coordinate of the point `column`: x, y, z or principal.
    - `reference`: a column or point to subtract (finger minus stand).
    - `max_gap` [s]: gaps (NaN, empty, C3D residual below 0) up to this long are closed by straight lines, with a notice.

    **Raises:** `ValueError` naming file, line or argument, and the remedy; `ImportError` without ezc3d for C3D.
    """
    table = _read(path)
    require(axis in (None, *AXES, "principal"), "axis", axis, "choose one of x, y, z, principal")
    require(isinstance(max_gap, int | float) and 0 <= max_gap < math.inf, "max_gap", max_gap, "give a time in s")
    by_name = time_name(table)
    time = by_name or unnamed_time(table)
    chosen = _chosen(table, column, axis, reference, time)
    signal = values(table, chosen.columns)
    if reference is not None:
        signal = signal - values(table, _reference(table, reference, axis, signal.shape))
    own = table.rates.get(chosen.columns[0])
    found, notices = _sampling(table, chosen.columns[0], time, signal.shape[0], rate, own)
    if time is not None and by_name is None:
        notices.append(f"no header: column {time} rises evenly and is taken as the time in s")
    unit = _unit(table, chosen, units, axis, notices)
    words = [Path(table.file).name, f"column {chosen.name}" if axis is None else f"point {chosen.name}, axis {axis}"]
    words += [f"minus {reference}"] * (reference is not None) + [f"{found:.6g} Hz"]
    try:
        whole, start, closed = filled(signal, found, float(max_gap))
        samples = whole[:, 0] if whole.shape[1] == 1 else _principal(whole)
        recording = Recording(samples, found, unit=unit, name=Path(table.file).stem, source=", ".join(words),
                              start=start, notices=(*notices, *closed))  # fmt: skip
    except ValueError as error:
        raise ValueError(f"{table.file}: column {chosen.name}: {error}") from None
    return recording


def load_columns(
    path: str | os.PathLike[str], columns: Iterable[str | int] | None = None, **options: Any
) -> list[Recording]:
    """One recording of each column of a file, of all but the time by default; `options` as in `load_recording`."""
    table = _read(path)
    names = _others(table, time_name(table) or unnamed_time(table)) if columns is None else list(columns)
    return [load_recording(path, column=name, **options) for name in names]


class _Choice(NamedTuple):
    name: str
    columns: list[str]


def _read(path: str | os.PathLike[str]) -> Table:
    require(isinstance(path, str | os.PathLike), "path", path, "give the path of a recording")
    file = Path(path)
    with contextlib.suppress(RuntimeError):
        file = file.expanduser()
    kind = file.suffix.lower()
    try:
        if file.is_dir():
            raise ValueError(f"{file}: is a folder; give a recording ({', '.join(KINDS)})")
        data = file.read_bytes()
    except FileNotFoundError:
        raise ValueError(f"{file}: no such file") from None
    except OSError as error:
        raise ValueError(f"{file}: cannot be read: {error.strerror or error}") from None
    if kind not in KINDS:
        raise ValueError(f"{file}: a recording is one of {', '.join(KINDS)}, not {kind or 'one without ending'}")
    if not data:
        raise ValueError(f"{file}: is empty")
    if kind in TEXT:
        return read_csv(data, str(file))
    try:
        return read_c3d(str(file)) if kind == ".c3d" else READERS[kind](data, str(file))
    except ImportError:
        raise
    except Exception as error:  # damaged files make the libraries fail in any way
        raise ValueError(f"{file}: cannot be read as {kind}: {str(error) or type(error).__name__}") from None


def _chosen(
    table: Table, column: str | int | None, axis: str | None, reference: str | int | None, time: str | None
) -> _Choice:
    """The column, or the columns of the point of which an axis is asked."""
    if axis is not None:
        return _point(table, column, axis, reference, time)
    if column is not None:
        name = find(table, column)
        if name == time and len(table.columns) > 1:
            raise ValueError(f"{table.file}: column {column!r} is the time; choose one of {listed(_others(table, time))}")
        return _Choice(name, [name])
    others = _others(table, time)
    if reference is not None:
        others = [name for name in others if name != find(table, reference, "reference")]
    if len(others) != 1:
        which = listed(others) or "none"
        raise ValueError(f"{table.file}: holds {len(others)} columns besides the time; choose one with column: {which}")
    return _Choice(others[0], others)


def _others(table: Table, time: str | None) -> list[str]:
    return [name for name in table.columns if name != time]


def _point(table: Table, column: str | int | None, axis: str, reference: str | int | None, time: str | None) -> _Choice:
    known, others = points(table), _others(table, time)
    if column is None:
        stems = [stem for stem in known if reference is None or stem != str(reference).casefold()]
        if not known and len(others) == 3:
            return _Choice("the three columns", _axis(others, axis))
        if len(stems) != 1:
            raise ValueError(f"{table.file}: holds {len(stems)} points; choose one with column: {listed(stems) or 'none'}")
        column = stems[0]
    columns = triple(table, str(column))
    if columns is None:
        have = f"known are the points {listed(known)}" if known else "there are no points"
        raise ValueError(
            f"{table.file}: axis={axis!r} needs a point, three columns as {column}_x, {column}_y, {column}_z; {have}"
        )
    return _Choice(str(column), _axis(columns, axis))


def _axis(columns: list[str], axis: str) -> list[str]:
    return columns if axis == "principal" else [columns[AXES.index(axis)]]


def _reference(table: Table, reference: str | int, axis: str | None, shape: tuple[int, ...]) -> list[str]:
    columns = None if axis is None else triple(table, str(reference))
    if columns is not None and axis is not None:
        names = _axis(columns, axis)
    elif axis is None:
        names = [find(table, reference, "reference")]
    else:
        have = listed(points(table)) or "none"
        raise ValueError(f"{table.file}: no point {reference!r} as reference; known points: {have}")
    rows = values(table, names).shape[0]
    if rows != shape[0]:
        raise ValueError(f"{table.file}: reference={reference!r} has {rows} samples, the column {shape[0]}")
    return names


def _sampling(
    table: Table, name: str, time: str | None, rows: int, rate: float | int | None, stated: float | None
) -> tuple[float, list[str]]:
    """Rate [Hz] and notices: the rate given, else of the time column, else what the file states."""
    if rate is not None:
        number = isinstance(rate, int | float | np.number) and not isinstance(rate, bool)
        require(number and 0 < rate < math.inf, "rate", rate, "give samples per second [Hz], above 0")
    measured = None if time is None or time == name else clock(table, time, rows)
    if measured is not None:
        found, begin, uncertainty = measured
        if rate is not None and abs(rate / found - 1) > RATE_TOLERANCE + uncertainty:
            raise ValueError(
                f"{table.file}: rate={rate:g} Hz contradicts the time column {time!r}, which has {found:.6g} Hz; leave "
                "rate out, or rename the column (times are in s, or in ms if its name says so)"
            )
        from_zero = abs(begin) < 1.5 / found
        words = [] if from_zero else [f"the time column begins at {begin:g} s; here times count from the first sample"]
        return float(rate or _rounded(found)), words
    if rate is None and stated is None:
        raise ValueError(f"{table.file}: does not state its rate (no time column found); give rate in Hz, as rate=1000")
    if rate is not None and stated is not None and abs(rate / stated - 1) > RATE_TOLERANCE:
        return float(rate), [f"rate {rate:g} Hz as asked; the file states {stated:g} Hz"]
    return float(rate or stated or 0.0), []


def _rounded(rate: float) -> float:
    """A whole number of samples per second, if it is one but for the rounding of the times."""
    return float(round(rate)) if abs(rate - round(rate)) < 1e-6 * rate else rate


def _unit(table: Table, chosen: _Choice, units: str | None, axis: str | None, notices: list[str]) -> str:
    stated = table.units.get(chosen.columns[0])
    if units is not None:
        if stated is not None and known_unit(stated) not in (None, known_unit(units)):
            notices.append(f"unit {units} as asked; the file says {stated}")
        return units
    if stated is not None and known_unit(stated) is not None:
        return stated
    if axis is not None:
        raise ValueError(f"{table.file}: does not say in which unit {chosen.name} is; give units, as units='mm'")
    if stated is not None:
        raise ValueError(f"{table.file}: column {chosen.name}: unknown unit {stated!r}; give units, as units='N'")
    notices.append("no unit stated: taken as N")
    return "N"


def _principal(xyz: Float[np.ndarray, "times 3"]) -> Any:
    """The coordinate along the direction of the largest variance."""
    centred = xyz - xyz.mean(axis=0)
    direction = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return xyz @ (direction * np.sign(direction[np.argmax(np.abs(direction))]))
