"""Recordings in commands: the options with which they are read, the same for every command that
does."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jaxmuscle as jm
from jaxmuscle._common.inputs import looked_at
from jaxmuscle._common.units import NEWTONS

from .console import say_notice
from .options import PERTURBED, READING, band_of

if TYPE_CHECKING:
    from jaxmuscle.data import PerturbedRecording, Table, Trials


NO_MOTION = (
    "--hold belongs to records of a moved insertion, with a column of force and one of"
    " displacement: fit a hold alone as `jaxmuscle fit HOLD`"
)


def reads_recordings(
    command: Callable[..., None], options: Mapping[str, tuple[Any, Any]] = READING
) -> Callable[..., None]:
    """Give a command options, by default those of `READING`; it gets their values together, as its
    argument `reading`.

    An option of that name which the command has itself serves both.
    """

    @functools.wraps(command)
    def with_options(**given: Any) -> None:
        reading = {name: given.get(name) for name in options}
        command(**{name: value for name, value in given.items() if name in kept}, reading=reading)

    signature = inspect.signature(command)
    own = [parameter for name, parameter in signature.parameters.items() if name != "reading"]
    kept = {parameter.name for parameter in own}
    keyword = inspect.Parameter.KEYWORD_ONLY
    added = [
        inspect.Parameter(name, keyword, default=default, annotation=annotation)
        for name, (annotation, default) in options.items()
        if name not in kept
    ]
    parameters = [parameter.replace(kind=keyword) for parameter in own] + added
    setattr(with_options, "__signature__", signature.replace(parameters=parameters))  # noqa: B010
    with_options.__annotations__ = {
        parameter.name: parameter.annotation for parameter in parameters
    }
    return with_options


def reads_perturbed(command: Callable[..., None]) -> Callable[..., None]:
    """The same with the options of `PERTURBED` as well."""
    return reads_recordings(command, READING | PERTURBED)


def unused(reading: dict[str, Any], *used: str, window: str | None = None, what: str) -> None:
    """Raise a `ValueError` for an option that is given and of no use here."""
    given = [
        name
        for name, value in reading.items()
        if name not in used and value != (READING | PERTURBED)[name][1]
    ]
    if window is not None:
        given.append("window")
    if given:
        raise ValueError(f"--{given[0].replace('_', '-')} belongs to {what}: leave this option out")


def perturbed(reading: dict[str, Any]) -> bool:
    """Whether the options name the two channels of a perturbation experiment."""
    return reading["force_column"] is not None or reading["displacement"] is not None


def moved_by_motor(paths: Sequence[str], reading: dict[str, Any]) -> bool:
    """Whether no column is named, and a file holds force and a displacement that moves; said if
    so."""
    if reading["column"] is not None:
        return False
    for table in tables_of(paths, reading):
        try:
            found = channels(table, reading)
        except ValueError:  # several may be meant: then the force alone is looked for
            continue
        if not found or (moves := jm.data.movement(table, found["displacement"])).rests:
            continue
        of_torque = table.measured_in(found["force"]) == "torque"
        if (moves.unit == "deg") != of_torque and reading["lever_arm"] is None:  # has a notice
            continue
        say_notice(
            f"{found['displacement']} moves by {moves}, so the recording is treated as one of a"
            f" motor-driven limb. The force alone: --column '{found['force']}'"
        )
        return True
    return False


def read_recordings(
    paths: Sequence[str], reading: dict[str, Any], window: str | None, task: str | None
) -> "list[PerturbedRecording] | Trials":
    """The recordings of one condition: of force and displacement, by the options, else by the task
    and the columns."""
    tables = tables_of(paths, reading)
    if perturbed(reading):
        return read_perturbed(tables, reading, windows_of(window, len(tables)))
    if task not in (None, "prescribed-length") or reading["column"] is not None:
        return read_trials(tables, reading, window)
    found = [channels(table, reading) for table in tables]
    both = all(found)
    if task is None and both and _held(tables, found):
        called = {names["force"] for names in found}
        return read_trials(
            tables, reading | {"column": called.pop() if len(called) == 1 else None}, window
        )
    if task == "prescribed-length" and not both:
        raise ValueError(
            f"{paths[0]}: no displacement was found beside the force, and --task prescribed-length"
            " fits both: name the columns with --force-column and --displacement; a hold is fitted"
            " with --task isometric"
        )
    if both:
        return read_perturbed(tables, reading, windows_of(window, len(tables)))
    return read_trials(tables, reading, window)


def _held(tables: "Sequence[Table]", found: Sequence[dict[str, Any]]) -> bool:
    """Whether the insertion rests in all files, though they have a column of where it is; said if
    so."""
    moves = [
        jm.data.movement(table, names["displacement"])
        for table, names in zip(tables, found, strict=True)
    ]
    if not any(each.rests for each in moves):
        return False
    least, most = moves.index(min(moves)), moves.index(max(moves))
    if not all(each.rests for each in moves):
        raise ValueError(
            f"{tables[least].file}: its column {found[least]['displacement']} rests (it moves by"
            f" {moves[least]}), and that of {tables[most].file} moves by {moves[most]}. Give the"
            " files of a moved insertion first, and those of a held one with --hold"
        )
    say_notice(
        f"{found[most]['displacement']} rests (it moves by {moves[most]}), so the force is fitted"
        " as that of a hold. If a motor moved it, give --task prescribed-length"
    )
    return True


def read_with_holds(
    paths: Sequence[str], holds: Sequence[str], reading: dict[str, Any], window: str | None
) -> "tuple[list[PerturbedRecording], Trials]":
    """Records of a moved insertion and those of the same person with the insertion held, which have
    the force alone."""
    from jaxmuscle._common.units import LEVER_ARM

    tables, held_tables = tables_of(paths, reading), tables_of(holds, reading)
    windows = windows_of(window, len(tables) + len(held_tables))
    for table in tables:
        if not perturbed(reading) and not channels(table, reading):
            raise ValueError(
                f"{table.file}: no displacement was found beside the force. Name the columns with"
                " --force-column and --displacement. Or are the files swapped? Moved records come"
                " first, --hold takes the holds"
            )
    moved = read_perturbed(tables, reading, windows[: len(tables)])
    if moved[0].of_joint:
        reading = reading | {"lever_arm": LEVER_ARM}
    held = jm.data.Trials(
        [
            _hold(table, reading, edges)
            for table, edges in zip(held_tables, windows[len(tables) :], strict=True)
        ]
    )
    for recording in held:
        if recording.unit == "a.u.":
            raise ValueError(
                f"--hold {recording.name}: has no unit. Give --units N if all files are in newtons"
            )
        if recording.unit not in NEWTONS:
            remedy = (
                "Give --lever-arm"
                if recording.quantity == "torque"
                else f"Give the hold in {', '.join(NEWTONS)}"
            )
            raise ValueError(
                f"--hold {recording.name}: is in {recording.unit}, and a moved record is fitted in"
                f" N. {remedy}"
            )
    return moved, held


def _hold(table: "Table", reading: dict[str, Any], edges: Any) -> Any:
    """The force in a file, in the column that it has in the moved records, if there is one."""
    named = reading["force_column"]
    if both := channels(table, reading | {"force_column": None, "displacement": None}):
        moves = jm.data.movement(table, both["displacement"])
        if not moves.rests:
            raise ValueError(
                f"--hold {table.file}: its column {both['displacement']} moves by {moves}, and in a"
                " hold the insertion rests. Name this file among the moved records, before --hold"
            )
    options = {name: reading[name] for name in READING} | {"reference": None}
    options["column"] = named if named in table.columns else None
    # in newtons, also where the moved records are torques
    as_it_is = read(table, options | {"lever_arm": None}, edges)
    return as_it_is if as_it_is.quantity != "torque" else read(table, options, edges)


def channels(table: "Table", reading: dict[str, Any]) -> dict[str, Any]:
    """The columns of force and displacement; nothing where there are not both."""
    named = {"force": reading["force_column"], "displacement": reading["displacement"]}
    return jm.data.two_channels(table, **named, time=reading["time"])


def read_perturbed(
    paths: "Sequence[str | Table]", reading: dict[str, Any], windows: Sequence[Any]
) -> "list[PerturbedRecording]":
    """The recordings of force and displacement in files, each with its window of `windows_of`."""
    options = {
        name: value
        for name, value in reading.items()
        if name not in ("force_column", "displacement")
    }
    if options["band"] is not None:
        options["band"] = band_of(options["band"])
    named = {"force": reading["force_column"], "displacement": reading["displacement"]}
    each = zip(tables_of(paths, reading), windows, strict=True)
    return [
        read(table, options | (channels(table, reading) or named), edges) for table, edges in each
    ]


def read_trials(
    paths: "Sequence[str | Table]", reading: dict[str, Any], window: str | None = None
) -> "Trials":
    """The recordings of one condition, each with its steady part: several files, or all columns of
    one (`--column all`)."""
    tables = tables_of(paths, reading)
    options = {name: reading[name] for name in READING}
    if len(tables) > 1 or reading["column"] != "all":
        each = zip(tables, windows_of(window, len(tables)), strict=True)
        return jm.data.Trials([read(table, options, edges) for table, edges in each])
    (edges,) = windows_of(window, 1)
    del options["column"], options["reference"]
    trials = jm.load_recordings(tables[0], **options)
    return trials.steady(edges)


def read(table: "Table", reading: dict[str, Any], edges: Any) -> Any:
    """A recording, its steady part as window: the one that is given, `all`, or None to find it."""
    return jm.load_recording(table, **reading).steady(edges)


def tables_of(paths: "Sequence[str | Table]", reading: dict[str, Any]) -> "list[Table]":
    """The columns of files, which are read here alone; of a workbook those of every trial."""
    how = reading["skip_rows"], reading["sheet"]
    return [table for path in paths for table in jm.data.read_tables(path, *how)]


def require_files(names: Sequence[str]) -> None:
    """Raise a `ValueError` for a folder, and for what looks like a file and is not there."""
    for name in names:
        path = Path(name).expanduser()
        if path.is_dir() and name not in jm.list_targets():
            raise ValueError(
                f"{name}: is a folder; give the files in it that are trials of one person in one"
                f" condition, as {path / '*.csv'}. Of several people: a table of them for jaxmuscle"
                " study (docs/study.md)"
            )
        if path.suffix:
            looked_at(path)


def windows_of(window: str | None, recordings: int) -> list[Any]:
    """The window of every recording: one of --window for all, or one for each, in their order."""
    each = [None] if window is None else [edges_of(part.strip()) for part in window.split(",")]
    if len(each) not in (1, recordings):
        whose = "one recording" if recordings == 1 else f"{recordings} recordings"
        raise ValueError(
            f"--window {window}: {len(each)} windows for {whose}. Give one for all, or one for each"
            " in the order of the files, as --window 8:25,4:21 or --window 8:25,auto"
        )
    return each * recordings if len(each) == 1 else each


def edges_of(window: str | None) -> Any:
    """The window of --window in s, `all`, or None where it is to be found."""
    if window is None or window == "all":
        return window
    if window == "auto":
        return None
    start, colon, stop = window.partition(":")
    try:
        if colon:
            return float(start), float(stop)
    except ValueError:
        pass
    raise ValueError(
        f"--window {window}: give start and end in s, as --window 8:25, or --window all"
    )
