"""Which columns of a file are the force and the displacement of a perturbation experiment."""

import os
import re
from collections.abc import Sequence
from typing import Any

from jaxmuscle._common.arguments import require

from ._file_kinds import are_recordings
from ._perturbed import PerturbedRecording
from ._recording_choice import (
    FORCE,
    MEASURED,
    Movement,
    Reading,
    movement_of,
    perturbed_of,
    signals,
)
from ._recording_files import read_table, read_tables
from ._recording_table import Table, bare, find, listed

CALLED = {
    "force": FORCE,
    "displacement": re.compile(
        r"disp(lacement)?|length|position|pos|angle|way|weg|auslenkung|winkel|x_z"
    ),
}


def movement(
    path: str | os.PathLike[str] | Table, displacement: str | int, *, skip_rows: int = 0
) -> Movement:
    """How much a displacement or an angle moves in the middle half of a recording.

        channels = jaxmuscle.data.two_channels(path)
        print(jaxmuscle.data.movement(path, channels["displacement"]))

    A dynamometer records the angle of a held joint, too. With a standard deviation below 0.03 mm,
    or 0.1 degrees, the insertion counts as held. One of unknown unit rests if it does not change at
    all.

    **Arguments:** `path`, `skip_rows` as in `load_recording`; `displacement`, the column.

    **Raises:** `ValueError` as `load_recording` does.
    """
    table = read_table(path, skip_rows)
    name = find(table, displacement, "displacement")
    return movement_of(table, name)


def two_channels(
    path: str | os.PathLike[str] | Table,
    force: str | int | None = None,
    displacement: str | int | None = None,
    *,
    time: str | int | None = None,
    skip_rows: int = 0,
) -> dict[str, str]:
    """The columns of a recording that are the force, or torque, and the displacement, or angle, of
    a moved insertion.

        jaxmuscle.load_recording(path, **two_channels(path))

    A column is found by its name (`force_N`, `Torque [Nm]`; `displacement_mm`, `length`,
    `position`, `angle_deg`), or by its unit.

    **Arguments:** `path`, `time`, `skip_rows` as in `load_recording`; `force`, `displacement`, a
    column that is known.

    **Returns:** their names by role; nothing where the file does not hold both.

    **Raises:** `ValueError` that names the columns where several may be meant, and as
    `load_recording` does.
    """
    return _found_in(read_table(path, skip_rows), force, displacement, time)


def _found_in(
    table: Table, force: str | int | None, displacement: str | int | None, time: str | int | None
) -> Any:
    others, found = signals(table, time), dict[str, list[str]]()
    for role, given in (("force", force), ("displacement", displacement)):
        named = [name for name in others if CALLED[role].fullmatch(bare(name))]
        meant = [name for name in others if table.measured_in(name) in MEASURED[role]]
        found[role] = (
            [find(table, given, role)]
            if given is not None
            else named
            if len(named) == 1
            else meant or named
        )
    if not all(found.values()):
        return {}
    for role, names in found.items():
        remedy = f"{table.file} holds several that may be meant; give `{role}`, the name of one"
        require(len(names) == 1, f"{role} columns", listed(names), remedy)
    return {role: names[0] for role, names in found.items()}


def perturbed_recordings(
    given: Any, *, files: bool, held: bool = False
) -> tuple[PerturbedRecording, ...]:
    """Perturbed recordings: one, several, or with `files` the paths of such, their steady parts
    found; none of else.

    `held`: nor of files in which the insertion rests.
    """
    several = given if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    if len(several) > 0 and all(isinstance(one, PerturbedRecording) for one in several):
        return tuple(several)
    if not files or not are_recordings(several):
        return ()
    tables = [table for one in several for table in read_tables(one)]
    channels = [_found_in(table, None, None, None) for table in tables]
    if not channels or not all(channels):
        return ()
    if held and all(
        movement(table, names["displacement"]).rests
        for table, names in zip(tables, channels, strict=True)
    ):
        return ()
    found = (
        perturbed_of(PerturbedRecording.from_array, table, Reading(), names, None)
        for table, names in zip(tables, channels, strict=True)
    )
    return tuple(recording.steady() for recording in found)
