"""Recordings in files: every format, one column or all of them."""

import contextlib
import gzip
import os
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Unpack, overload

from jaxmuscle._common.arguments import check_options, require
from jaxmuscle._common.inputs import BEYOND, looked_at, most, read_bytes
from jaxmuscle._common.text import choices

from ._apart import read_apart
from ._file_kinds import BOOKS, KINDS, LOOK, ROWS, look_at
from ._perturbed import PerturbedRecording
from ._recording import Recording
from ._recording_choice import Reading, ReadingOptions, perturbed_of, recording_of, signals
from ._recording_csv import read_csv
from ._recording_table import Table, channels_table, find
from ._recording_time import clock
from ._text_tables import holds_text
from .dialects._dialects import EXPORTS


class _Options(ReadingOptions, total=False):
    """Of two channels, too."""

    band: Sequence[float] | None


@overload
def load_recording(
    path: str | os.PathLike[str] | Table, *, force: None = None, **options: Any
) -> Recording: ...
@overload
def load_recording(
    path: str | os.PathLike[str] | Table, *, force: str | int, **options: Any
) -> PerturbedRecording: ...
def load_recording(  # pyright: ignore[reportInconsistentOverload]
    path: str | os.PathLike[str] | Table,
    *,
    force: str | int | None = None,
    displacement: str | int | None = None,
    displacement_units: str | None = None,
    positive: str | None = None,
    delay: float | int = 0.0,
    skip_rows: int = 0,
    sheet: str | int | None = None,
    **options: Unpack[_Options],
) -> Recording | PerturbedRecording:
    """Load a recording from text, Excel, MATLAB, NumPy, C3D, EDF, TDMS, AcqKnowledge or Spike2
    files.

        recording = jm.load_recording("trial.csv", column="force", rate=2048, units="N")
        result = jm.fit(jm.Isometric(), recording.steady())

    Text, whatever its ending, also packed (.gz): delimiter, header, a row of units and decimal
    commas are detected, `#` starts a comment. What programs of laboratories write is
    understood. MATLAB: variables by name, `trial.force` for a field of a struct, `Data:74` for a
    column of a table, **counted from 0** as in `Data[:, 74]`. C3D: points, and analog channels.

    The time is a column called time, t, Zeit ..., one with a unit of time, one of clock times
    (`10:00:00.001`, with a date or without), or a first one that rises nearly evenly. It gives the
    rate and counts from its first row. Uneven times are brought to even ones, missing rows are
    gaps, and at a pause the recording is cut, each with a notice.

    Points have three columns, as `finger_x, finger_y, finger_z` or `finger:0` to `finger:2`.
    `axis="principal"` is the direction in which the point, minus reference, moves most; it is
    positive along its largest component.

    A file of a perturbation experiment has two channels. Name both, `force` and `displacement`, to
    get a `PerturbedRecording`, in N and m, lengthening positive.

    **Arguments:**

    - `path`: the file; its suffix says the format. Or what `jaxmuscle.data.read_table` read of it.
    - `column`: name (case and unit may be left out) or number from 0; needed if there are several.
    - `force`, `displacement`: instead of `column`, the two channels of a perturbation experiment.
    - `rate` [Hz]: needed if the file does not state it.
    - `units`: as in `Recording`; by default what the file or the column's name states. A force of
      unknown unit is in a.u. Nothing is converted but a torque with a `lever_arm`.
    - `axis`: which coordinate of the point `column`: x, y, z or principal.
    - `reference`: a column or point to subtract (finger minus stand).
    - `time`: the column that holds the time, if it is not found by itself; `"none"` leaves the
      times out: the rows are even at `rate`.
    - `skip_rows`: lines of a text, or rows of a sheet, to leave out at the top.
    - `sheet`: of a workbook, its name or number from 0; needed if several hold a signal.
    - `max_gap` [s]: gaps (NaN, empty, missing rows, C3D residual below 0) up to this long are
      closed by straight lines, with a notice. Where rows are missing for longer, the recording is
      cut.
    - `outliers`: samples that cannot be (marks as -9999, single spikes) are named in a notice and
      kept (`"keep"`), or count as gaps (`"mask"`).
    - `displacement_units`: m, cm, mm, um, deg or rad; by default what the file states. `units` is
      that of the force.
    - `lever_arm` [m]: from the joint's axis to the point where the force acts. A torque is divided
      by it and becomes a force in N; of two channels, an angle is multiplied by it and becomes a
      displacement. Without it torque and angle stay such.
    - `positive`, `delay` [s], `band` (low, high) [Hz]: of two channels, see
      `PerturbedRecording.from_array`.
    - `quantity`, `baseline`, `detrend`: as in `Recording`; `baseline` also as a text, "0:1".

    **Raises:** `ValueError` naming file, line or argument, and the remedy; `ImportError` that says
    what to install.
    """
    check_options(load_recording, _Options, options)
    given: dict[str, Any] = dict(options)
    band = given.pop("band", None)
    reading = Reading(**given)
    both = {
        "displacement_units": displacement_units,
        "positive": positive,
        "delay": delay,
        "band": band,
    }
    if force is None or displacement is None:
        remedy = "belongs to recordings of two channels; give `force` and `displacement`"
        strange = {"force": force, "displacement": displacement, **both, "delay": delay or None}
    else:
        remedy = "leave it out: `force` and `displacement` name the columns"
        strange = {name: options.get(name) for name in ("column", "axis", "reference", "quantity")}
    for name, value in strange.items():
        require(value is None, name, value, remedy)
    table = read_table(path, skip_rows, sheet)
    if force is None or displacement is None:
        return recording_of(Recording, table, reading)
    columns = {"force": force, "displacement": displacement}
    return perturbed_of(PerturbedRecording.from_array, table, reading, columns, **both)


def load_columns(
    path: str | os.PathLike[str] | Table,
    columns: Iterable[str | int] | None = None,
    *,
    skip_rows: int = 0,
    sheet: str | int | None = None,
    **options: Unpack[ReadingOptions],
) -> list[Recording]:
    """A recording `FILE COLUMN` of each of the columns, by default of all with numbers but the
    time; of several sheets of a workbook one `FILE SHEET` each, if no columns are named.

    `skip_rows`, `sheet` and the other options are those of `load_recording`.
    """
    tables, reading = read_tables(path, skip_rows, sheet), Reading(**options)
    if columns is None and len(tables) > 1:
        return [recording_of(Recording, table, reading) for table in tables]
    asked = None if columns is None else list(columns)
    require(asked != [], "columns", asked, "give the names of the columns that are recordings")
    found: list[Recording] = []
    for table in tables:
        names = asked or signals(table, reading.time)
        if not names:
            raise ValueError(f"{table.file}: holds no column with numbers besides the time")
        for name in (find(table, each, "columns") for each in names):
            own = reading._replace(column=name)
            found.append(recording_of(Recording, table, own, f"{table.name} {name}"))
    return found


def read_table(
    path: str | os.PathLike[str] | Table, skip_rows: int = 0, sheet: str | int | None = None
) -> Table:
    """The columns of the file of a recording, for who must see them before they know what it holds.

        table = jaxmuscle.data.read_table("trial.csv")
        recording = jaxmuscle.load_recording(table, **jaxmuscle.data.two_channels(table))

    `load_recording`, `load_recordings` and `two_channels` take a table in place of the path: the
    file is read once.

    **Arguments:** `path`, `skip_rows`, `sheet` as in `load_recording`; a table is given back as it
    is.

    **Raises:** `ValueError` naming file and line, and the remedy; `ImportError` that says what to
    install.
    """
    table, *others = read_tables(path, skip_rows, sheet)
    if others:
        names = [each.sheet for each in (table, *others)]
        raise ValueError(
            f"{os.fspath(path)}: holds {len(names)} sheets with signals, {', '.join(names)}; choose"  # pyright: ignore
            f" one with `sheet`, as sheet={names[0]!r}; load_recordings takes all as trials"
        )
    return table


def read_tables(
    path: str | os.PathLike[str] | Table, skip_rows: int = 0, sheet: str | int | None = None
) -> list[Table]:
    """What `read_table` gives of a file; of a workbook of trials one table for each.

        tables = jaxmuscle.data.read_tables("trials.xlsx")
        trials = jaxmuscle.load_recordings(tables)

    **Arguments:** `path`, `skip_rows`, `sheet` as in `read_table`.

    **Raises:** as `read_table`; but not for several sheets of the same columns.
    """
    if isinstance(path, Table):
        return [path]
    require(isinstance(path, str | os.PathLike), "path", path, "give the path of a recording")
    file, kind, text, _ = look_at(path)
    whole = isinstance(skip_rows, int) and skip_rows >= 0
    require(whole, "skip_rows", skip_rows, "give a number of lines")
    instead = f"a recording ({', '.join(KINDS)})"
    book = kind in BOOKS and not text
    rows = text or book or kind == ".gz"
    require(skip_rows == 0 or rows, "skip_rows", skip_rows, f"leave it out: {kind} has no lines")
    require(sheet is None or book, "sheet", sheet, f"leave it out: {file.name} has no sheets")
    if text:
        return [read_csv(read_bytes(file, instead=instead), str(file), skip_rows)]
    if kind == ".gz":
        return [read_csv(_unpacked(file, instead), str(file), skip_rows)]
    if kind not in KINDS:
        looked_at(file, instead=instead)
        export = f"; {EXPORTS[kind]}" if kind in EXPORTS else ""
        raise ValueError(
            f"{file}: a recording is one of {', '.join(KINDS)}, not"
            f" {kind or 'one without ending'}{export}"
        )
    found = read_apart(file, kind, instead=instead)
    if isinstance(found, dict):
        return _sheets(file, found, skip_rows, sheet)
    return [channels_table(str(file), found, named=kind != ".npy")]


def _unpacked(file: Path, instead: str) -> bytes:
    """The text in a file that gzip has packed."""
    looked_at(file, instead=instead)
    try:
        with gzip.open(file) as stream:
            data = stream.read(most() + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"{file}: cannot be unpacked: {error}") from None
    if len(data) > most():
        allowed = most() / 2**30
        raise ValueError(f"{file}: it holds more than {allowed:.3g} GiB{BEYOND}")
    if not holds_text(data[:LOOK]):
        raise ValueError(f"{file}: holds no text with rows of numbers; unpack it (gunzip) first")
    return data


def _sheets(
    file: Path, sheets: dict[str, bytes], skip_rows: int, asked: str | int | None
) -> list[Table]:
    """The sheet that is asked for, or those with a signal, of one layout."""
    names = list(sheets)
    filled = [text for text in sheets.values() if text.strip()]
    if asked is None and len(filled) == 1:
        return [read_csv(filled[0], str(file), skip_rows)]

    def read(name: str) -> Table:
        table = read_csv(sheets[name], f"{file}, sheet {name}", skip_rows)
        return table._replace(sheet=name)

    if asked is not None:
        return [read(_asked(file, names, asked))]
    found: list[Table] = []
    for name, text in sheets.items():
        with contextlib.suppress(ValueError):  # what is no table of numbers holds no signal
            if text.count(b"\n") >= ROWS and signals(table := read(name), None):
                found.append(table)
    if not _are_alike(found):  # a table of results has no times
        found = [each for each in found if each.rates or clock(each) is not None] or found
    which = ", ".join(table.sheet for table in found) or "none"
    if not found or not _are_alike(found):
        first = found[0].sheet if found else names[0]
        raise ValueError(
            f"{file}: holds the sheets {', '.join(names)}; with {ROWS} rows of numbers or more:"
            f" {which}. Choose one with `sheet`, as sheet={first!r}"
        )
    what = f"sheet {which} taken" if len(found) == 1 else "the sheets are trials"
    notice = f"{what}{':' if len(found) == len(names) else ', of'} {', '.join(names)}"
    return [table._replace(notices=(notice, *table.notices)) for table in found]


def _are_alike(tables: list[Table]) -> bool:
    return len({tuple(table.columns) for table in tables}) <= 1


def _asked(file: Path, names: list[str], sheet: str | int) -> str:
    known = {name.casefold(): name for name in names}
    wanted = str(sheet).strip().casefold()
    if isinstance(sheet, str) and wanted in known:
        return known[wanted]
    if wanted.isdecimal() and int(wanted) < len(names):
        return names[int(wanted)]
    raise ValueError(f"{file}: sheet={sheet!r}: {choices(str(sheet), names)}")
