"""The table of a study: which file is which trial of whom, in which group and condition, and how
files are read."""

import contextlib
import math
import os
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from msgspec import Meta

from jaxmuscle._common.arguments import is_real, require
from jaxmuscle._common.documents import Table, checked, parsed, says
from jaxmuscle._common.environment import one_thread
from jaxmuscle._common.executors import AnyExecutor, results_of
from jaxmuscle._common.files import expanded
from jaxmuscle._common.inputs import looked_at, read_text
from jaxmuscle._common.progress import Tell, nothing
from jaxmuscle._common.text import choices
from jaxmuscle.spectra._settings import NAMED

from ._file_kinds import STUDY
from ._recording import FOUND, Recording
from ._recording_choice import Reading
from ._recording_files import load_recording
from ._target import Target
from ._text_tables import cells_of, delimiter_in, lines_of, number_in
from ._trials import Trials

TABLES = "the table of a study (.csv, .tsv, .txt or .toml)"
LABELS = (*STUDY, "group", "condition", "trial")
# of `load_recording`, of `Trials.target`
FILES, SPECTRA = (*Reading._fields, "skip_rows", "sheet"), ("spectrum", "mvc")
EDGES = ("window_start", "window_stop")
STEADY = "`window` of the study.toml, else its steady part; an error beside the other edge"
NUMBERS = ("rate", "max_gap", "lever_arm", "skip_rows", "mvc", *EDGES)
ANSWERS = {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}
COLUMNS = (*LABELS, *FILES, *SPECTRA, *EDGES)
READING = (*FILES, *SPECTRA, "window")
ORDERS = ("groups", "conditions")
OPTIONS = (*READING, "rung", "noise", "quantities", "alpha", "correction", *ORDERS)
BITS = 200  # of a recording in a small figure


# what a key may hold where it may also be missing
Text = str | None
Name = str | int | None
Above0 = Annotated[float, Meta(gt=0)] | None
NotBelow0 = Annotated[float, Meta(ge=0)] | None


class ReadingTable(Table, kw_only=True):
    """How a recording is read."""

    column: Annotated[
        Name,
        says(
            "Column of the force: its name, or its number from 0. Or NAME of a"
            " [point](../recordings.md#what-is-read), if its coordinates are the columns NAME_x,"
            " NAME_y, NAME_z",
            missing=(
                "the only one besides the time, or the only force or torque by its name or unit;"
                " else an error"
            ),
        ),
    ] = None
    rate: Annotated[
        Above0,
        says("Sampling rate [Hz]", missing="as the file says; an error if it does not"),
    ] = None
    units: Annotated[
        Text,
        says(
            "Unit of the column",
            missing="as file or name say; of a point an error",
        ),
    ] = None
    axis: Annotated[
        Text,
        says(
            "Of a point: x, y, z, or principal, along which it moves most",
            missing="the column is not a point",
        ),
    ] = None
    reference: Annotated[
        Name,
        says("Column or point that is subtracted from it", missing="nothing is subtracted"),
    ] = None
    time: Annotated[
        Name,
        says(
            "Column of the time; none leaves the times out",
            missing="found by its name or unit; or a first column that rises evenly",
        ),
    ] = None
    max_gap: Annotated[NotBelow0, says("Longest gap that is closed [s]", missing="0.2")] = None
    outliers: Annotated[
        Literal["keep", "mask"] | None,
        says(
            "Samples that cannot be, as -9999 or single spikes: `keep` or `mask` (as gaps)",
            missing="keep",
        ),
    ] = None
    lever_arm: Annotated[
        Above0,
        says(
            "From the axis to where the force acts [m]: turns a torque into N",
            missing="a torque stays a torque",
        ),
    ] = None
    quantity: Annotated[
        Text,
        says("What was measured", missing="follows from the unit, else from the column's name"),
    ] = None
    baseline: Annotated[
        str | tuple[float, float] | None,
        says(
            "Part in which the signal rests, as 0:1 [s]: its mean is subtracted; or none",
            missing="found, and subtracted if it is quiet",
        ),
    ] = None
    detrend: Annotated[
        bool | None,
        says("Whether the straight line through the steady part is subtracted", missing="false"),
    ] = None
    skip_rows: Annotated[
        Annotated[int, Meta(ge=0)] | None, says("Lines to leave out at the top", missing="0")
    ] = None
    sheet: Annotated[
        Name,
        says(
            "Sheet of a workbook: its name, or its number from 0",
            missing="the only one with a signal; else an error",
        ),
    ] = None
    spectrum: Annotated[
        Text,
        says(
            "standard, slow (resolves what is below 1 Hz), multitaper or pwelch; the same for all",
            missing="standard",
        ),
    ] = None
    mvc: Annotated[
        Above0,
        says(
            "Maximal voluntary contraction, in the recording's unit",
            missing="level unknown, if the unit is not % MVC",
        ),
    ] = None


class RecordingTable(ReadingTable, kw_only=True):
    """Which recording: a row of a study.csv, or an entry of `[[recordings]]`."""

    file: Annotated[
        str,
        says(
            "Path, from the folder of the study.csv, or of the study.toml where the recordings"
            " stand in it"
        ),
    ]
    person: Annotated[str | int, says("Name of the person")]
    group: Annotated[
        Name,
        says("Group of the person; all recordings have one, or none", missing="no groups"),
    ] = None
    condition: Annotated[
        Name,
        says("Condition of the recording; all have one, or none", missing="no conditions"),
    ] = None
    trial: Annotated[
        Name,
        says(
            "Which of several trials in a condition",
            missing="no name; a person may have several trials without one",
        ),
    ] = None
    window_start: Annotated[
        float | None, says("Where the part to analyse begins [s]", missing=STEADY)
    ] = None
    window_stop: Annotated[float | None, says("Where it ends [s]", missing=STEADY)] = None


class StudyFile(ReadingTable, kw_only=True):
    """What else a study.toml may say."""

    table: Annotated[
        Text,
        says(
            "Path of a study.csv, from the folder of the study.toml", missing="needs `recordings`"
        ),
    ] = None
    recordings: Annotated[
        list[RecordingTable] | None, says("The recordings themselves", missing="needs a `table`")
    ] = None
    window: Annotated[
        tuple[float, float] | Literal["all"] | None,
        says(
            "Part to analyse: begin and end [s]; or 'all' in place of both",
            missing="the steady parts are looked for",
        ),
    ] = None
    rung: Annotated[
        Name,
        says(
            "Model of all people: 0 to 3, or auto",
            missing="3 where everybody has five trials in every condition, else 2",
        ),
    ] = None
    noise: Annotated[
        Text,
        says(
            "Colour of the noise: white, band-limited, ornstein-uhlenbeck or pink",
            missing="band-limited",
        ),
    ] = None
    quantities: Annotated[
        list[str] | None,
        says(
            "Quantities that are compared",
            missing="eight measured ones and the frequencies of the two resonances",
        ),
    ] = None
    alpha: Annotated[float | None, says("Level of the tests, between 0 and 1", missing="0.05")] = (
        None
    )
    correction: Annotated[
        Text, says("Correction for many comparisons: holm, fdr or none", missing="holm")
    ] = None
    groups: Annotated[
        list[str] | None,
        says(
            "All groups, in the order in which they are shown and compared (second less first)",
            missing="as the table first names them",
        ),
    ] = None
    conditions: Annotated[
        list[str] | None,
        says("All conditions, in their order", missing="as the table first names them"),
    ] = None


class Row(NamedTuple):
    """A recording of a study: `place`, what an error calls it; its `file`, and as the table has
    `named` it; whose it is; `reading`, how the file is read."""

    place: str
    file: Path
    named: str
    person: str
    group: str
    condition: str
    trial: str
    reading: dict[str, Any]


class StudyTable(NamedTuple):
    """The recordings of a study, in order; the `options` that its file states; its `source`, and
    the `files` that say all this."""

    rows: tuple[Row, ...]
    options: dict[str, Any]
    source: str
    files: tuple[Path, ...] = ()


class Trial(NamedTuple):
    """What was analysed of a recording: which `column` of which `file`, as the table names it; its
    `rate` [Hz]; the part from `start` to `stop` [s], which is `chosen` as "found", "given" or
    "all".

    `time` [s] and `signal` are the least and the greatest of every bit of the whole recording, for
    a small figure.
    """

    file: str
    trial: str
    column: str
    rate: float
    start: float
    stop: float
    chosen: str
    time: Float[np.ndarray, " bits"]
    signal: Float[np.ndarray, " bits"]


class Cell(NamedTuple):
    """One person in one condition: the `recordings`, the `target` that they make, and the `power`
    of this in each bin over the squared mean [1/Hz], None where a mean says nothing."""

    person: str
    group: str
    condition: str
    recordings: tuple[Trial, ...]
    target: Target
    power: Float[np.ndarray, " bins"] | None = None

    @property
    def trials(self) -> int:
        """How many recordings."""
        return len(self.recordings)


def read_study(study: "str | os.PathLike[str] | Iterable[Mapping[str, Any]]") -> StudyTable:
    """The table of a study from a .csv, .tsv or .txt, from a .toml that names one or has
    `[[recordings]]`, or from rows.

    **Raises:** `ValueError` naming file, line and column, and the remedy.
    """
    if not isinstance(study, str | os.PathLike):
        places = ((f"row {number}", dict(row)) for number, row in enumerate(study, 1))
        return StudyTable(_checked(places, Path(), "the table"), {}, "a table in memory")
    path = expanded(study)
    if path.suffix.lower() != ".toml":
        return StudyTable(_checked(_lines(path), path.parent, str(path)), {}, path.name, (path,))
    stated = parsed(read_text(path, instead=TABLES), str(path), "TOML")
    checked(stated, StudyFile, str(path))
    options = {name: value for name, value in stated.items() if name in OPTIONS}
    if ("table" in stated) == ("recordings" in stated):
        raise ValueError(
            f'{path}: give either table = "study.csv" or [[recordings]], each with file and person'
        )
    if "table" in stated:
        table = path.parent / expanded(stated["table"])
        rows = _checked(_lines(table), table.parent, str(table))
        return StudyTable(rows, options, path.name, (path, table))
    places = (
        (f"{path}: recording {number}", dict(row))
        for number, row in enumerate(stated["recordings"], 1)
    )
    return StudyTable(_checked(places, path.parent, str(path)), options, path.name, (path,))


def files_of_study(path: str | os.PathLike[str]) -> list[Path]:
    """All files that the study at `path` reads: its own, the table that this one names, the
    recordings.

        jm.data.files_of_study("study.toml")

    **Raises:** `ValueError` naming file, line and column, for a table that is no study.
    """
    found = read_study(path)
    return [*found.files, *(row.file for row in found.rows)]


class _Asked(NamedTuple):
    """A recording of a cell: its row, how its file is read, in which window."""

    row: Row
    reading: dict[str, Any]
    window: Any


class _Wanted(NamedTuple):
    """What makes a cell: its trials, the settings of their spectra, the mvc."""

    trials: tuple[_Asked, ...]
    settings: str
    mvc: float | None


def cells_of_study(
    rows: Iterable[Row],
    defaults: Mapping[str, Any],
    executor: AnyExecutor | None = None,
    tell: Tell = nothing,
) -> list[Cell]:
    """The trials of every person in every condition made one target, each in its own or the
    `defaults`' window, or steady; files are read on an `executor`, if there is one.

    **Raises:** `ValueError` naming the line of a file that cannot be read or has no steady part, of
    a spectrum or a unit that is not that of the others, and of an mvc that is not that of the same
    person in the same condition.
    """
    together: dict[tuple[str, str, str], list[_Asked]] = defaultdict(list)
    stated: dict[Any, tuple[Row, Any]] = {}

    def as_before(row: Row, key: Any, name: str, value: Any, remedy: str) -> None:
        """Remember what the first row says; refuse a row that says something else."""
        first, before = stated.setdefault(key, (row, value))
        if before != value:
            raise ValueError(f"{name} = {value!r} here, {before!r} at {first.place}: {remedy}")

    for row in rows:
        reading = {**defaults, **row.reading}
        window, spectrum, mvc = (reading.pop(name, None) for name in ("window", *SPECTRA))
        whose = row.person, row.group, row.condition
        with _named(row.place):
            require(spectrum in (None, *NAMED), "spectrum", spectrum, choices(str(spectrum), NAMED))
            remedy = "give a number in the unit of the recording"
            require(mvc is None or isinstance(mvc, int | float), "mvc", mvc, remedy)
            remedy = "give all rows the same, to compare like with like"
            as_before(row, "spectrum", "spectrum", spectrum or "standard", remedy)
            remedy = "give all trials of a person in a condition the same mvc, or none"
            as_before(row, whose, "mvc", mvc, remedy)
        # a worker may be in another folder
        there = row if executor is None else row._replace(file=row.file.absolute())
        together[whose].append(_Asked(there, reading, window))
    wanted = [
        _Wanted(tuple(trials), stated["spectrum"][1], stated[whose][1])
        for whose, trials in together.items()
    ]
    each = (
        ((w, _cell(w)) for w in wanted) if executor is None else results_of(executor, _cell, wanted)
    )
    cells = []
    for number, (cell_wanted, (units, cell)) in enumerate(each, 1):
        for trial, unit in zip(cell_wanted.trials, units, strict=True):
            with _named(trial.row.place):
                remedy = "give all in one unit, with the column units or by converting the files"
                as_before(trial.row, "unit", "unit", unit, remedy)
        cells.append(cell)
        tell("reading recordings", number / len(wanted))
    return cells


def _cell(wanted: _Wanted) -> tuple[list[str], Any]:
    """The units of a cell's recordings, and the cell; None if they are not the same."""
    recordings, first = [], wanted.trials[0].row
    with one_thread:  # so that any machine gives the same bits
        for row, reading, _ in wanted.trials:
            with _named(row.place):
                recordings.append(load_recording(row.file, **reading))
        units = [recording.unit for recording in recordings]
        if len(set(units)) > 1:
            return units, None
        for i, (row, _, window) in enumerate(wanted.trials):
            with _named(row.place):
                recordings[i] = recordings[i].steady(window)
        name = ", ".join(filter(None, (first.person, first.condition)))
        with _named(f"{first.place}: {name}"):
            trials = Trials(recordings)
            target = trials.target(name, mvc=wanted.mvc, settings=wanted.settings)
        power = None
        if target.mean is not None:
            power = np.asarray(trials.spectrum(wanted.settings).power) / np.mean(target.mean) ** 2
    read = (_analysed(r, a) for r, a in zip(recordings, wanted.trials, strict=True))
    return units, Cell(first.person, first.group, first.condition, tuple(read), target, power)


def _analysed(recording: Recording, asked: _Asked) -> Trial:
    """What was analysed of a recording, and a small picture of it."""
    start, stop = recording.window or (recording.start, recording.stop)
    found = any(notice.startswith(FOUND) for notice in recording.notices)
    chosen = "found" if found else "all" if asked.window in (None, "all") else "given"
    # "trial.csv, column force, 1000 Hz"
    column = recording.source.removeprefix(f"{asked.row.file.name}, ").rpartition(", ")[0]
    column = column.removeprefix("column ")
    edges = np.linspace(0, recording.whole.size, BITS + 1).astype(int)[:-1]
    signal = np.stack([f.reduceat(recording.whole, edges) for f in (np.minimum, np.maximum)])
    time = recording.start + np.repeat(edges, 2) / recording.rate
    whose = asked.row.named, asked.row.trial, column
    return Trial(*whose, recording.rate, start, stop, chosen, time, signal.T.ravel())


@contextlib.contextmanager
def _named(place: str) -> Iterator[None]:
    """An error begins with the place."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}: {error}") from None


def _lines(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Place and cells of every row of a text table; empty cells left out."""
    lines = [line for line in lines_of(read_text(path, instead=TABLES)) if line.body.strip()]
    if not lines:
        raise ValueError(f"{path}: holds no data, only comments")
    (head, *body), found = lines, []
    delimiter = delimiter_in(head.body) or ","
    names, place = [n.casefold() for n in cells_of(head.body, delimiter)], f"{path}: {head.place}"
    for name in STUDY:
        if name not in names:
            others = ", ".join(other for other in names if other not in COLUMNS)
            raise ValueError(
                f"{place}: needs a column {name}{f' (found: {others})' * bool(others)}; the header"
                f" has file and person, and may have {', '.join(COLUMNS[2:])}"
            )
    for name in names:
        _check_column(name, place)
        if names.count(name) > 1:
            raise ValueError(f"{place}: two columns are called {name}: leave one out")
    for line in body:
        cells, place = cells_of(line.body, delimiter), f"{path}: {line.place}"
        if len(cells) != len(names):
            raise ValueError(f"{place}: has {len(cells)} cells, the header {len(names)} columns")
        named = [(name, cell) for name, cell in zip(names, cells, strict=True) if cell]
        found.append((place, {name: _value(name, cell, delimiter, place) for name, cell in named}))
    return found


def _check_column(name: str, place: str) -> None:
    if name not in COLUMNS:
        raise ValueError(f"{place}: unknown column {name!r}; {choices(name, COLUMNS)}")


def _value(name: str, cell: str, delimiter: str, place: str) -> Any:
    """What a cell of the column `name` says."""
    if name == "detrend":
        answer = ANSWERS.get(cell.casefold())
        require(answer is not None, f"{place}: detrend", cell, "write true or false")
        return answer
    if name not in NUMBERS:
        return cell
    whole = name == "skip_rows"
    try:
        number = int(cell) if whole else number_in(cell, delimiter)
    except ValueError:
        number = math.nan
    if not is_real(number):
        raise ValueError(f"{place}: {name} = {cell!r} is not a {'whole ' * whole}number")
    return number


def _checked(
    places: Iterable[tuple[str, dict[str, Any]]], folder: Path, source: str
) -> tuple[Row, ...]:
    """The rows, and that together they are a study."""
    rows = tuple(_row(place, given, folder) for place, given in places)
    known: dict[Any, Row] = {}
    for row in rows:
        for label in ("group", "condition"):
            if not getattr(row, label) and any(getattr(other, label) for other in rows):
                raise ValueError(
                    f"{row.place}: has no {label}, others do; give every recording one, or none"
                )
        first = known.setdefault(row.person, row)
        if first.group != row.group:
            raise ValueError(
                f"{row.place}: {row.person} is in group {row.group} here and in group {first.group}"
                f" at {first.place}; a person has one group (what changes within people: a"
                " condition)"
            )
        same = known.setdefault((row.file, repr(row.reading)), row)
        if same is not row:
            raise ValueError(f"{row.place}: the same recording as at {same.place}: leave one out")
        twin = known.setdefault((row.person, row.condition, row.trial), row) if row.trial else row
        if twin is not row:
            raise ValueError(
                f"{row.place}: trial {row.trial} of {row.person} is there already, at {twin.place}"
            )
    people = len({row.person for row in rows})
    if people < 2:
        raise ValueError(
            f"{source}: holds {people} people; a study needs at least 2 (of one: jaxmuscle fit"
            " TRIALS)"
        )
    return rows


def _row(place: str, given: dict[str, Any], folder: Path) -> Row:
    for name in given:
        _check_column(name, place)
    filled = {name: value for name, value in given.items() if value is not None}
    texts = {name: str(filled.get(name, "")).strip() for name in LABELS}
    for name in STUDY:
        if not texts[name]:
            raise ValueError(f"{place}: no {name}; every recording needs a file and a person")
    window = tuple(given.get(name) for name in EDGES)
    if window.count(None) == 1:
        raise ValueError(f"{place}: give window_start and window_stop, or neither")
    file = folder / expanded(str(given["file"]))
    with _named(place):
        looked_at(file, instead="a recording")
    reading = {name: filled[name] for name in (*FILES, *SPECTRA) if name in filled}
    if None not in window:
        reading["window"] = window
    named, person, group, condition, trial = texts.values()
    return Row(place, file, named, person, group, condition, trial, reading)
