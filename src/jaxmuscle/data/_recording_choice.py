"""From a table to a recording: choose a column or a point, find rate and unit, close short gaps."""

import contextlib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arguments import is_real, require
from jaxmuscle._common.text import choices, printable

from ._recording_outliers import OUTLIERS, find_outliers
from ._recording_quality import Baseline, filled
from ._recording_table import AXES, Table, bare, find, listed, points, triple, values
from ._recording_time import Clock, Part, Sampling, clock, sampling
from ._units import (
    SCALELESS,
    UNITS,
    known_unit,
    named_quantity,
    quantity_of,
    scale_to_si,
    units_for,
)

# what a column of force is called, by decomposition programs the signal of reference
FORCE = re.compile(r"force|torque|moment|kraft|drehmoment|f_?[xyz]?|ref_?signal")
UNSCALED = (
    "no unit stated: numbers are relative to the mean, and nothing is in newtons. If it is in N,"
    ' give --units N (Python: units="N")'
)
MEASURED = {"force": ("force", "torque"), "displacement": ("displacement", "angle")}
# Standard deviations below which the insertion was held: it moves no force that one could see. In
# mm, and in degrees.
STILL = {"mm": 0.03, "deg": 0.1}
_NUMBER = re.compile(r" \d+$")  # of columns of one name


class Movement(NamedTuple):
    """By how much the insertion moves: standard deviation `size` in `unit`. It `rests` if that is
    as good as nothing."""

    size: float
    unit: str
    rests: bool

    def __str__(self) -> str:
        # rounding error is no movement
        return f"{round(self.size, 9):.3g} {self.unit}".rstrip() + " rms"


class _Choice(NamedTuple):
    """The columns that are read, what they are called together, and what to say where they were
    chosen among several."""

    name: str
    columns: list[str]
    notice: str = ""


class Origin(TypedDict, total=False):
    """How reports call what was measured: its name, where it comes from, what was done to it."""

    name: str
    source: str
    notices: Iterable[str]


class About(Origin, total=False):
    """What is known of a recording besides its samples, see `Recording`."""

    start: float | int
    window: Sequence[float | int] | None
    others: Iterable[Any]


class ReadingOptions(TypedDict, total=False):
    """The arguments of `load_recording` by which a recording is found in a table."""

    column: str | int | None
    rate: float | int | None
    units: str | None
    axis: str | None
    reference: str | int | None
    time: str | int | None
    max_gap: float | int
    lever_arm: float | int | None
    outliers: str
    quantity: str | None
    baseline: Baseline
    detrend: bool


class Reading(NamedTuple):
    """How a recording is found in a table: the arguments of `load_recording`."""

    column: str | int | None = None
    rate: float | int | None = None
    units: str | None = None
    axis: str | None = None
    reference: str | int | None = None
    time: str | int | None = None
    max_gap: float | int = 0.2
    lever_arm: float | int | None = None
    outliers: str = "keep"
    quantity: str | None = None
    baseline: Baseline = None
    detrend: bool = False


def _sampled(
    table: Table, signal: np.ndarray, name: str, times: Clock | None, reading: Reading
) -> tuple[Sampling, np.ndarray]:
    """How columns are sampled, and what to say of it; the columns, without outliers if that is
    asked for."""
    longest, choice = reading.max_gap, reading.outliers
    require(is_real(longest) and longest >= 0, "max_gap", longest, "give a time in s")
    require(choice in OUTLIERS, "outliers", choice, "choose keep or mask")
    found = sampling(table, name, times, len(signal), reading.rate, float(longest))
    seconds = np.arange(len(signal)) / found.rate if found.time is None else found.time
    odd, words = find_outliers(signal, seconds)
    if choice == "mask":
        signal = np.where(odd[:, None], np.nan, signal)
    said = [each + OUTLIERS[choice] for each in words]
    return found._replace(notices=[*found.notices, *said]), signal


def _make_parts(
    make: Callable[..., Any], found: Sampling, signal: np.ndarray, reading: Reading, place: str
) -> Any:
    """What `make` makes of the longest part, gaps closed; the others beside it, those that can be
    read. An error begins with the `place`."""

    def make_part(part: Part, **more: Any) -> Any:
        even = part.on_grid(signal)
        whole, begin, closed = filled(even, found.rate, float(reading.max_gap))
        return make(
            whole,
            found.rate,
            start=part.start + begin,
            notices=(*found.notices, *closed),
            baseline=reading.baseline,
            detrend=reading.detrend,
            **more,
        )

    longest, *pauses = found.parts
    others = []
    for part in pauses:
        with contextlib.suppress(ValueError):
            others.append(make_part(part))
    try:
        return make_part(longest, others=others)
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None


def recording_of(
    make: Callable[..., Any], table: Table, reading: Reading, name: str | None = None
) -> Any:
    """What `make`, the class of a recording, makes of a column, called `name` or as its file."""
    axis, reference = reading.axis, reading.reference
    require(axis in (None, *AXES, "principal"), "axis", axis, "choose one of x, y, z, principal")
    times = clock(table, reading.time)
    chosen = _chosen(table, reading, None if times is None else times.name)
    times = clock(table, reading.time, chosen.columns[0]) if table.clocks else times
    signal = values(table, chosen.columns)
    if reference is not None:
        signal = signal - values(table, _reference(table, reference, axis, len(signal)))
    found, signal = _sampled(table, signal, chosen.columns[0], times, reading)
    notices = [*table.notices, *filter(None, [chosen.notice]), *found.notices]
    unit, quantity = _unit(table, chosen, reading, notices)
    if reading.lever_arm is not None:
        signal, unit = _as_force(table, chosen.name, signal, unit, reading.lever_arm, notices)
        quantity = None
    what = f"column {chosen.name}" if axis is None else f"point {chosen.name}, axis {axis}"
    minus = "" if reference is None else f", minus {reference}"
    source = printable(f"{Path(table.file).name}, {what}{minus}, {found.rate:.6g} Hz")

    def make_one(whole: np.ndarray, rate: float, **more: Any) -> Any:
        one = whole[:, 0] if whole.shape[1] == 1 else _principal(whole)
        called = name or table.name
        return make(one, rate, unit=unit, quantity=quantity, name=called, source=source, **more)

    found = found._replace(notices=notices)
    return _make_parts(make_one, found, signal, reading, f"{table.file}: column {chosen.name}")


def perturbed_of(
    make: Callable[..., Any],
    table: Table,
    reading: Reading,
    columns: Mapping[str, str | int],
    displacement_units: str | None,
    **options: Any,
) -> Any:
    """What `make` makes of the columns of force and displacement, by name of the role; gaps are
    closed in both alike."""
    names = {role: find(table, column, role) for role, column in columns.items()}
    times = clock(table, reading.time, names["force"])
    for role, name in names.items():
        if times is not None and name == times.name:
            others = listed(_others(table, name))
            raise ValueError(
                f"{table.file}: {role}={columns[role]!r} is the time; choose one of {others}"
            )
    force, displacement = names.values()
    if force == displacement or table.rates.get(force) != table.rates.get(displacement):
        fault = "are one column" if force == displacement else "have different rates; resample one"
        raise ValueError(
            f"{table.file}: force={columns['force']!r} and displacement={columns['displacement']!r}"
            f" {fault}"
        )
    found, signal = _sampled(table, values(table, names.values()), force, times, reading)
    notices = [*table.notices, *found.notices]
    units, _ = _unit(table, _Choice(force, [force]), reading, notices)
    if units in SCALELESS:
        raise ValueError(
            f"{table.file}: does not say in which unit {force} is; give `units`, as units='N'"
        )
    moved = table.units.get(displacement) if displacement_units is None else displacement_units
    if moved is None:
        raise ValueError(
            f"{table.file}: does not say in which unit {displacement} is; give"
            " `displacement_units`, as displacement_units='mm'; or, if nothing moved the"
            " insertion, the force alone, as `column`"
        )
    source = f"{Path(table.file).name}, columns {force} and {displacement}, {found.rate:.6g} Hz"
    options |= {"units": units, "displacement_units": moved, "lever_arm": reading.lever_arm}

    def make_one(whole: np.ndarray, rate: float, **more: Any) -> Any:
        named = {"name": table.name, "source": printable(source)}
        return make(*whole.T, rate, **named, **options, **more)

    return _make_parts(make_one, found._replace(notices=notices), signal, reading, table.file)


def _as_force(
    table: Table, name: str, signal: Any, unit: str, lever_arm: Any, notices: list[str]
) -> tuple[Any, str]:
    """A torque over its lever arm, in N."""
    try:
        remedy = f"leave it out: it turns a torque into a force, and column {name} is in {unit}"
        require(quantity_of(unit) == "torque", "lever_arm", lever_arm, remedy)
        scale, _ = scale_to_si(unit, "units", "force", lever_arm)
    except ValueError as error:
        raise ValueError(f"{table.file}: {error}") from None
    notices.append(
        f"the torque in {unit} was divided by the lever arm of {float(lever_arm):g} m: a force in N"
    )
    return scale * signal, "N"


def signals(table: Table, time: str | int | None) -> list[str]:
    """All columns with numbers besides the time."""
    times = clock(table, time)
    return _others(table, None if times is None else times.name)


def _chosen(table: Table, reading: Reading, time: str | None) -> _Choice:
    """The column, or the columns of the point of which an axis is asked."""
    others = _others(table, time)
    if reading.axis is not None:
        return _point(table, reading, others)
    if reading.column is not None:
        name = find(table, reading.column)
        if name == time and len(table.columns) > 1:
            raise ValueError(
                f"{table.file}: column {reading.column!r} is the time; choose one of"
                f" {listed(others)}"
            )
        return _Choice(name, [name])
    if reading.reference is not None:
        beside = find(table, reading.reference, "reference")
        others = [name for name in others if name != beside]
    if len(others) == 1:
        return _Choice(others[0], others)
    forces = [name for name in others if table.measured_in(name) in MEASURED["force"]]
    if len(forces) != 1:
        called = forces or others
        forces = [name for name in called if FORCE.fullmatch(_NUMBER.sub("", bare(name)))]
    if len(forces) != 1:
        raise ValueError(
            f"{table.file}: holds {len(others)} columns besides the time; choose one with `column`:"
            f" {listed(others) or 'none'}"
        )
    (force,) = forces
    taken = f"column {force} taken, of {listed(others)}{_moved(table, others, force)}"
    return _Choice(force, forces, taken)


def _others(table: Table, time: str | None) -> list[str]:
    none = {time, *table.words, *table.clocks.values()}
    return [name for name in table.columns if name not in none]


def movement_of(table: Table, name: str) -> Movement:
    """How much a column moves in the middle half of a recording, see `movement`."""
    samples = values(table, [name])[:, 0]
    middle = samples[samples.size // 4 : samples.size - samples.size // 4]
    middle = middle[np.isfinite(middle)]
    size = float(np.std(middle)) if middle.size else math.nan
    unit, measured = table.units.get(name, ""), table.measured_in(name)
    if measured not in MEASURED["displacement"]:
        return Movement(size, unit, size == 0)
    scale, _ = scale_to_si(unit, "displacement_units", "displacement", 1.0)
    shown, many = ("deg", 180 / math.pi) if measured == "angle" else ("mm", 1e3)
    size *= scale * many
    return Movement(size, shown, size < STILL[shown])


def _moved(table: Table, others: list[str], force: str) -> str:
    """What to say where a column is a displacement: the answer to a motor is no fluctuation of a
    hold."""
    kinds = {name: table.measured_in(name) for name in others}
    moving = next((name for name in others if kinds[name] in MEASURED["displacement"]), None)
    if moving is None:
        return ""
    moves = movement_of(table, moving)
    if moves.rests:
        return f". {moving} rests: it moves by {moves}"
    arm = " --lever-arm METRES" if (kinds[force] == "torque") != (kinds[moving] == "angle") else ""
    return (
        f". {moving} moves by {moves}, so `jaxmuscle fit` takes it for a record of a moved"
        " insertion. If a motor moved the muscle, give both channels: --force-column"
        f" {force!r} --displacement {moving!r}{arm} (Python: force=, displacement=). Else the"
        " answer to the motor counts as unsteadiness"
    )


def _point(table: Table, reading: Reading, others: list[str]) -> _Choice:
    """The columns of the point that is asked for, or of the only one."""
    known, axis, column = points(table), str(reading.axis), reading.column
    if column is None:
        beside = str(reading.reference).casefold()
        stems = [stem for stem in known if reading.reference is None or stem != beside]
        if not known and len(others) == 3:
            return _Choice("the three columns", _axis(others, axis))
        if len(stems) != 1:
            raise ValueError(
                f"{table.file}: holds {len(stems)} points; choose one with `column`:"
                f" {listed(stems) or 'none'}"
            )
        column = stems[0]
    columns = triple(table, str(column))
    if columns is None:
        have = f"known are the points {listed(known)}" if known else "there are no points"
        raise ValueError(
            f"{table.file}: axis={axis!r} needs a point, three columns as {column}_x, {column}_y,"
            f" {column}_z; {have}"
        )
    return _Choice(str(column), _axis(columns, axis))


def _axis(columns: list[str], axis: str) -> list[str]:
    return columns if axis == "principal" else [columns[AXES.index(axis)]]


def _reference(table: Table, reference: str | int, axis: str | None, rows: int) -> list[str]:
    """The columns that are subtracted."""
    if axis is None:
        names = [find(table, reference, "reference")]
    elif (columns := triple(table, str(reference))) is not None:
        names = _axis(columns, axis)
    else:
        have = listed(points(table)) or "none"
        raise ValueError(f"{table.file}: no point {reference!r} as reference; known points: {have}")
    own = len(values(table, names))
    if own != rows:
        raise ValueError(
            f"{table.file}: reference={reference!r} has {own} samples, the column {rows}"
        )
    return names


def _unit(
    table: Table, chosen: _Choice, reading: Reading, notices: list[str]
) -> tuple[str, str | None]:
    """The unit of a column, and what it measures: by the unit, else by the name; a column of
    unknown unit whose name says nothing else is a force."""
    name = chosen.columns[0]
    stated, named = table.units.get(name), named_quantity(name)
    asked = stated if reading.units is None else reading.units
    unit = None if asked is None else known_unit(asked, name)
    if reading.units is not None:
        require(unit is not None, "units", reading.units, choices(reading.units, UNITS))
        if stated is not None and known_unit(stated, name) not in (None, unit):
            notices.append(f"unit {reading.units} as asked; the file says {stated}")
    if unit is None and (stated or reading.axis or named not in (None, "force")):
        raise ValueError(f"{table.file}: {_without_unit(chosen.name, stated, named, reading.axis)}")
    if unit is None:
        notices.append(UNSCALED)
        meant = "force"
    else:
        meant = UNITS[unit] or (named if named in UNITS.values() else None)
        if unit != known_unit(str(asked)):
            notices.append(f"{asked} of {name} is taken as {unit}, since it is a {named}")
    return unit or "a.u.", meant if reading.quantity is None else reading.quantity


def _without_unit(name: str, stated: str | None, named: str | None, axis: str | None) -> str:
    """What to say of a column whose unit is needed and not known."""
    likely = units_for("displacement" if axis is not None and named is None else named)
    fault = (
        f"column {name}: unknown unit {stated!r}"
        if stated is not None
        else f"does not say in which unit {name} is"
    )
    relative = "units='a.u.' if numbers relative to the mean are enough"
    if named is None and not likely:
        return f"{fault}; give `units`, {relative}; {choices(stated, UNITS)}"
    if not likely:
        return f"{fault}; give `units`: of a {named} none is known here, so {relative}"
    first, *others = (unit for unit in likely if unit not in SCALELESS)
    return f"{fault}; give `units`, as units={first!r} (or {', '.join(others)}), or {relative}"


def _principal(xyz: Float[np.ndarray, "times 3"]) -> Any:
    """The coordinate along the direction of the largest variance."""
    centred = xyz - xyz.mean(axis=0)
    direction = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return xyz @ (direction * np.sign(direction[np.argmax(np.abs(direction))]))
