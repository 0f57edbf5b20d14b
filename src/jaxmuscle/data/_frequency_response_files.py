"""Published frequency responses in files: gain, phase and coherence as columns of a text or a
sheet."""

import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arguments import require
from jaxmuscle._common.text import choices, printable

from ._frequency_response import COLUMNS, FrequencyResponse
from ._recording_files import read_table
from ._recording_table import Table

STIFFNESS = {"n/m": 1.0, "n/cm": 1e2, "n/mm": 1e3, "kn/m": 1e3, "mn/mm": 1.0}
ROTATION = {"nm/rad": 1.0, "nm/deg": 180 / np.pi, "mnm/rad": 1e-3, "mnm/deg": 0.18 / np.pi}
UNITS: dict[str, tuple[str, ...]] = {  # of each column, the first being that of a name without unit
    "frequency": ("hz",),
    "gain": (*STIFFNESS, *ROTATION, "db"),
    "phase": ("deg", "rad"),
    "coherence": ("",),
    "stderr": (*STIFFNESS, *ROTATION),
}
FITTED = ("frequency_hz", "real", "imaginary", "stderr")  # of stiffness.csv
_HEADER = re.compile(
    r"(frequency|freq|f|gain|phase|coherence|stderr)(?:[ _/]*[\[(]?([^\[\]()]*?)[\])]?)"
)


def load_frequency_response(
    path: str | os.PathLike[str],
    *,
    segments: Any = None,
    lever_arm: float | int | None = None,
    name: str | None = None,
    source: str | None = None,
) -> FrequencyResponse:
    """Load a dynamic stiffness over frequency, as published figures show it, from a text (.csv,
    ...) or a sheet (.xlsx).

        response = jm.load_frequency_response("response.csv", segments=30)
        result = jm.fit(jm.PrescribedLength(), response)

        frequency_hz,gain_N/mm,phase_deg,coherence
        0.5,4.1,3,0.92

    The columns are found by their names, in any order: `frequency`, `gain`, `phase`, and
    `coherence` or `stderr` or both. A unit may follow: `gain` in N/m (without unit), N/cm, N/mm,
    kN/m, in Nm/rad or Nm/deg with a lever arm, or in dB above 1 N/m; `phase` in deg (without unit)
    or rad; `stderr`, of the gain, in the gain's unit. Phase and gain are those of force over
    *lengthening*: the phase is near 0 at low frequency. `FrequencyResponse.save` writes such a
    file. `stiffness.csv`, which `jaxmuscle fit` writes, is read as well: its columns `real`,
    `imaginary` and `stderr` [N/m], not what was fitted.

    **Arguments:**

    - `path`: the file
    - `segments`: the number of independent averages, one or one for each frequency, needed without
      `stderr`
    - `lever_arm` [m]: which turns torque over angle into force over displacement
    - `name`: by default that of the file
    - `source`

    **Raises:** `ValueError` naming file, line and column, and the remedy.
    """
    table = read_table(path, 0)
    file = Path(table.file)
    if {*FITTED} <= {*table.columns}:
        frequency, real, imaginary, error = (_numbers(table, name, name) for name in FITTED)
        gain, phase = np.hypot(real, imaginary), np.degrees(np.arctan2(imaginary, real))
        column, scales = {"frequency": frequency, "stderr": error}, {"stderr": 1.0}
    else:
        found = _columns(table)
        column = {role: _numbers(table, name, role) for role, (name, _) in found.items()}
        scales = {
            role: _scale(table, *found[role], lever_arm)
            for role in ("gain", "stderr")
            if role in found
        }
        gain = (
            10 ** (column["gain"] / 20)
            if found["gain"][1] == "db"
            else column["gain"] * scales["gain"]
        )
        phase = np.degrees(column["phase"]) if found["phase"][1] == "rad" else column["phase"]
    _rising(table, column["frequency"])
    stderr = None if "stderr" not in column else column["stderr"] * scales["stderr"]
    try:
        return FrequencyResponse.from_gain(
            column["frequency"],
            gain,
            phase,
            coherence=column.get("coherence"),
            segments=segments,
            stderr=stderr,
            name=printable(file.stem) if name is None else name,
            source=printable(file.name) if source is None else source,
        )
    except ValueError as error:
        raise ValueError(f"{table.file}: {_at_its_line(str(error), table)}") from None


def is_response(names: Iterable[str]) -> bool:
    """Whether columns of these names are those of a frequency response."""
    names = {*names}
    found = {match[1] for name in names if (match := _HEADER.fullmatch(name))}
    return {*FITTED} <= names or (
        {"gain", "phase"} <= found and bool(found & {"frequency", "freq", "f"})
    )


def _columns(table: Table) -> dict[str, tuple[str, str]]:
    """Name and unit of the column of each role."""
    found: dict[str, tuple[str, str]] = {}
    # it takes the gain's unit
    for name in sorted(table.columns, key=lambda name: name.casefold().startswith("stderr")):
        match = _HEADER.fullmatch(name.strip().casefold())
        role = None if match is None else match[1] if match[1] not in ("freq", "f") else "frequency"
        if match is None or role is None:
            raise ValueError(f"{table.file}: unknown column {name!r}; {choices(name, COLUMNS)}")
        if role in found:
            raise ValueError(
                f"{table.file}: the columns {found[role][0]!r} and {name!r} are both the {role};"
                " keep one"
            )
        unit = "".join(
            c for c in (match[2] or table.units.get(name, "")).casefold() if c not in " ·*."
        )
        unit = unit or (
            found["gain"][1] if role == "stderr" and "gain" in found else UNITS[role][0]
        )
        if unit not in UNITS[role]:
            raise ValueError(
                f"{table.file}: column {name!r}: unknown unit {unit!r};"
                f" {choices(unit, UNITS[role])}"
            )
        found[role] = name, unit
    for role in ("frequency", "gain", "phase"):
        if role not in found:
            raise ValueError(f"{table.file}: no column {role!r}; expected {', '.join(COLUMNS)}")
    return found


def _numbers(table: Table, name: str, role: str) -> Float[np.ndarray, " rows"]:
    values = table.columns[name]()
    wrong = np.flatnonzero(~np.isfinite(values) & ~((role == "stderr") & (values == np.inf)))
    if wrong.size:
        where = f"{table.file}, {table.place(int(wrong[0]))}"
        raise ValueError(
            f"{where}: {name} is missing or not finite; leave the row out if it is not known"
        )
    return values


def _scale(table: Table, name: str, unit: str, lever_arm: float | int | None) -> float:
    if unit == "db":
        return 1.0
    if unit in STIFFNESS:
        return STIFFNESS[unit]
    remedy = f"{table.file}: {name} is torque over angle: give the lever arm in m, as lever_arm=0.1"
    require(lever_arm is not None and 0 < lever_arm < np.inf, "lever_arm", lever_arm, remedy)
    return ROTATION[unit] / float(lever_arm or 1.0) ** 2


def _rising(table: Table, frequency: Float[np.ndarray, " rows"]) -> None:
    wrong = np.flatnonzero(np.diff(frequency) <= 0)
    if wrong.size:
        where = f"{table.file}, {table.place(int(wrong[0]) + 1)}"
        raise ValueError(
            f"{where}: frequency {frequency[wrong[0] + 1]:g} Hz does not rise; sort, one row per"
            " frequency"
        )


def _at_its_line(message: str, table: Table) -> str:
    """The place in the file instead of the number of an entry."""
    return re.sub(r"entry (\d+)", lambda entry: table.place(int(entry[1]) - 1), message)
