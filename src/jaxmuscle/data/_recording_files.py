"""Recordings in files: every format, one column or all of them."""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, overload

from jaxmuscle._common.inputs import looked_at, read_bytes
from jaxmuscle._common.text import printable
from jaxmuscle.spectra._settings import require

from ._apart import read_apart
from ._perturbed import PerturbedRecording
from ._recording import Recording
from ._recording_choice import Reading, perturbed_of, recording_of, signals
from ._recording_csv import read_csv
from ._recording_quality import Baseline
from ._recording_table import Table, channels_table, find
from ._text_tables import TEXT

KINDS = (*TEXT, ".xlsx", ".mat", ".npy", ".npz", ".c3d", ".edf", ".bdf", ".tdms", ".acq", ".smr")


@overload
def load_recording(
    path: str | os.PathLike[str] | Table, *, force: None = None, **options: Any
) -> Recording: ...
@overload
def load_recording(
    path: str | os.PathLike[str] | Table, *, force: str | int, **options: Any
) -> PerturbedRecording: ...
def load_recording(  # noqa: PLR0913 (public options)  # pyright: ignore[reportInconsistentOverload]
    path: str | os.PathLike[str] | Table,
    *,
    column: str | int | None = None,
    force: str | int | None = None,
    displacement: str | int | None = None,
    rate: float | int | None = None,
    units: str | None = None,
    axis: str | None = None,
    reference: str | int | None = None,
    time: str | int | None = None,
    skip_rows: int = 0,
    max_gap: float | int = 0.2,
    displacement_units: str | None = None,
    lever_arm: float | int | None = None,
    positive: str | None = None,
    delay: float | int = 0.0,
    quantity: str | None = None,
    baseline: Baseline = None,
    detrend: bool = False,
) -> Recording | PerturbedRecording:
    """Load a recording from text, Excel, MATLAB, NumPy, C3D, EDF, TDMS, AcqKnowledge or Spike2
    files.

        recording = jm.load_recording("trial.csv", column="force", rate=2048, units="N")
        result = jm.fit(jm.Isometric(), recording.steady())

    Text (.csv, .tsv, .txt, .dat, .asc): delimiter, header, a row of units and decimal commas are
    detected, `#` starts a comment. Headers of LabChart, Spike2, AcqKnowledge and DIAdem are
    understood. MATLAB: variables by name, `trial.force` for a field of a struct, `Data:74` for a
    column of a table, **counted from 0** as in `Data[:, 74]`. C3D: points, and analog channels.

    The time is a column called time, t, Zeit ..., one with a unit of time, one of clock times
    (`10:00:00.001`, with a date or without), or a first one that rises evenly. It gives the rate,
    has to be even, and counts from its first row.

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
    - `time`: the column that holds the time, if it is not found by itself.
    - `skip_rows`: lines of a text, or rows of a sheet, to leave out at the top.
    - `max_gap` [s]: gaps (NaN, empty, C3D residual below 0) up to this long are closed by straight
      lines, with a notice.
    - `displacement_units`: m, cm, mm, um, deg or rad; by default what the file states. `units` is
      that of the force.
    - `lever_arm` [m]: from the joint's axis to the point where the force acts. A torque is divided
      by it and becomes a force in N; of two channels, an angle is multiplied by it and becomes a
      displacement.
    - `positive`, `delay` [s]: of two channels, see `PerturbedRecording.from_array`.
    - `quantity`, `baseline`, `detrend`: as in `Recording`; `baseline` also as a text, "0:1".

    **Raises:** `ValueError` naming file, line or argument, and the remedy; `ImportError` that says
    what to install.
    """
    reading = Reading(
        column,
        rate,
        units,
        axis,
        reference,
        time,
        max_gap,
        lever_arm,
        quantity=quantity,
        baseline=baseline,
        detrend=detrend,
    )
    options = {"displacement_units": displacement_units, "positive": positive, "delay": delay}
    if force is None or displacement is None:
        given = {"force": force, "displacement": displacement, **options, "delay": delay or None}
        for name, value in given.items():
            require(
                value is None,
                name,
                value,
                "belongs to recordings of two channels; give `force` and `displacement`",
            )
        return recording_of(Recording, read_table(path, skip_rows), reading)
    for name in ("column", "axis", "reference", "quantity"):
        value = getattr(reading, name)
        require(
            value is None, name, value, "leave it out: `force` and `displacement` name the columns"
        )
    columns = {"force": force, "displacement": displacement}
    table = read_table(path, skip_rows)
    return perturbed_of(
        PerturbedRecording.from_array, table, reading, columns, lever_arm=lever_arm, **options
    )


def load_columns(
    path: str | os.PathLike[str] | Table,
    columns: Iterable[str | int] | None = None,
    *,
    time: str | int | None = None,
    skip_rows: int = 0,
    **options: Any,
) -> list[Recording]:
    """A recording `FILE COLUMN` of each of the columns, by default of all with numbers but the
    time.

    `time`, `skip_rows` and the other options are those of `load_recording`.
    """
    table = read_table(path, skip_rows)
    names = (
        signals(table, time)
        if columns is None
        else [find(table, column, "columns") for column in columns]
    )
    require(
        columns is None or len(names) > 0,
        "columns",
        columns,
        "give the names of the columns that are recordings",
    )
    if not names:
        raise ValueError(f"{table.file}: holds no column with numbers besides the time")
    stem = printable(Path(table.file).stem)
    return [
        recording_of(Recording, table, Reading(name, time=time, **options), f"{stem} {name}")
        for name in names
    ]


def read_table(path: str | os.PathLike[str] | Table, skip_rows: int = 0) -> Table:
    """The columns of the file of a recording, for who must see them before they know what it holds.

        table = jaxmuscle.data.read_table("trial.csv")
        recording = jaxmuscle.load_recording(table, **jaxmuscle.data.two_channels(table))

    `load_recording`, `load_recordings` and `two_channels` take a table in place of the path: the
    file is read once.

    **Arguments:** `path`, `skip_rows` as in `load_recording`; a table is given back as it is.

    **Raises:** `ValueError` naming file and line, and the remedy; `ImportError` that says what to
    install.
    """
    if isinstance(path, Table):
        return path
    require(isinstance(path, str | os.PathLike), "path", path, "give the path of a recording")
    file = Path(path)
    with contextlib.suppress(RuntimeError):
        file = file.expanduser()
    kind = file.suffix.lower()
    require(
        isinstance(skip_rows, int) and skip_rows >= 0,
        "skip_rows",
        skip_rows,
        "give a number of lines",
    )
    rows = kind in (*TEXT, ".xlsx")
    require(skip_rows == 0 or rows, "skip_rows", skip_rows, f"leave it out: {kind} has no lines")
    instead = f"a recording ({', '.join(KINDS)})"
    if kind not in KINDS:
        looked_at(file, instead=instead)
        raise ValueError(
            f"{file}: a recording is one of {', '.join(KINDS)}, not {kind or 'one without ending'}"
        )
    if kind in TEXT:
        return read_csv(read_bytes(file, instead=instead), str(file), skip_rows)
    found = read_apart(file, kind, instead=instead)
    if isinstance(found, bytes):
        return read_csv(found, str(file), skip_rows)
    return channels_table(str(file), found, named=kind != ".npy")
