"""Published frequency responses in files: gain, phase and coherence as columns of a text or a
sheet."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arguments import require
from jaxmuscle._common.text import choices, printable

from ._frequency_response import COLUMNS, FITTED, HEADER, JOINT, FrequencyResponse
from ._recording_choice import Origin
from ._recording_files import read_table
from ._recording_table import Table

STIFFNESS = {"n/m": 1.0, "n/cm": 1e2, "n/mm": 1e3, "kn/m": 1e3, "mn/mm": 1.0}
ROTATION = {"nm/rad": 1.0, "nm/deg": 180 / np.pi, "mnm/rad": 1e-3, "mnm/deg": 0.18 / np.pi}
# Of each column, with what one of it is; the first is that of a name without unit.
UNITS: dict[str, dict[str, float]] = {
    "frequency": {"hz": 1.0},
    "gain": STIFFNESS | ROTATION | {"db": 1.0},
    "phase": {"deg": 1.0, "rad": 180 / np.pi},
    "coherence": {"": 1.0},
    "stderr": STIFFNESS | ROTATION,
}


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

        response = jm.data.load_frequency_response("response.csv", segments=30)
        result = jm.fit(jm.PrescribedLength(), response)

        frequency_hz,gain_N/mm,phase_deg,coherence
        0.5,4.1,3,0.92

    The columns are found by their names, in any order: `frequency`, `gain`, `phase`, and
    `coherence` or `stderr` or both. A unit may follow: `gain` in N/m (without unit), N/cm, N/mm,
    kN/m, in Nm/rad or Nm/deg of a joint, or in dB above 1 N/m; `phase` in deg (without unit)
    or rad; `stderr`, of the gain, in the gain's unit. Phase and gain are those of force over
    *lengthening*: the phase is near 0 at low frequency. `FrequencyResponse.save` writes such a
    file. `stiffness.csv`, which `jaxmuscle fit` writes, is read as well: its columns `real`,
    `imaginary` and `stderr` [N/m], not what was fitted.

    **Arguments:**

    - `path`: the file
    - `segments`: the number of independent averages, one or one for each frequency, needed without
      `stderr`
    - `lever_arm` [m]: which turns torque over angle into force over displacement, else it stays
      such; of `stiffness.csv` that of the fit
    - `name`: by default that of the file
    - `source`

    **Raises:** `ValueError` naming file, line and column, and the remedy.
    """
    table = read_table(path, 0)
    file = Path(table.file)
    words: Origin = {
        "name": printable(file.stem) if name is None else name,
        "source": printable(file.name) if source is None else source,
    }
    try:
        if {*FITTED} <= {*table.columns}:
            frequency, real, imaginary, stderr = (_numbers(table, name, name) for name in FITTED)
            value = real + 1j * imaginary
            return FrequencyResponse(frequency, value, stderr, lever_arm=lever_arm, **words)
        column = {}
        for role, (heading, unit) in _columns(table).items():
            column[role] = _numbers(table, heading, role) * UNITS[role][unit]
            if unit == "db":
                column[role] = 10 ** (column[role] / 20)
        found = _columns(table)
        joint = found["gain"][1] in ROTATION
        if "stderr" in found and (found["stderr"][1] in ROTATION) != joint:
            raise ValueError("gain and stderr: one is torque over angle, give both alike")
        unit = JOINT if joint else "N/m"
        response = FrequencyResponse.from_gain(**column, segments=segments, unit=unit, **words)
        if lever_arm is None:
            return response
        remedy = f"leave it out: the gain is in {found['gain'][1]}"
        require(joint, "lever_arm", lever_arm, remedy)
        return response.at_lever_arm(_lever_arm(lever_arm))
    except ValueError as error:
        # the place in the file instead of the number of an entry
        place = re.sub(r"entry (\d+)", lambda at: table.place(int(at[1]) - 1), str(error))
        raise ValueError(f"{table.file}: {place}") from None


def _columns(table: Table) -> dict[str, tuple[str, str]]:
    """Name and unit of the column of each role."""
    found: dict[str, tuple[str, str]] = {}
    # the errors come last: without a unit they have that of the gain
    for name in sorted(table.columns, key=lambda name: name.casefold().startswith("stderr")):
        match = HEADER.fullmatch(name.strip().casefold())
        if match is None:
            raise ValueError(f"unknown column {name!r}; {choices(name, COLUMNS)}")
        role = "frequency" if match[1] in ("freq", "f") else match[1]
        if role in found:
            raise ValueError(
                f"the columns {found[role][0]!r} and {name!r} are both the {role}; keep one"
            )
        unit = re.sub(r"[ ·*.]", "", (match[2] or table.units.get(name, "")).casefold())
        of_gain = role == "stderr" and "gain" in found
        unit = unit or (found["gain"][1] if of_gain else next(iter(UNITS[role])))
        if unit not in UNITS[role]:
            raise ValueError(
                f"column {name!r}: unknown unit {unit!r}; {choices(unit, UNITS[role])}"
            )
        found[role] = name, unit
    for role in ("frequency", "gain", "phase"):
        if role not in found:
            raise ValueError(f"no column {role!r}; expected {', '.join(COLUMNS)}")
    return found


def _numbers(table: Table, name: str, role: str) -> Float[np.ndarray, " rows"]:
    values = table.columns[name]()
    wrong = np.flatnonzero(~np.isfinite(values) & ~((role == "stderr") & (values == np.inf)))
    if wrong.size:
        raise ValueError(
            f"entry {wrong[0] + 1}: {name} is missing or not finite; leave the row out if it is not"
            " known"
        )
    return values


def _lever_arm(given: float | int) -> float:
    require(0 < given < np.inf, "lever_arm", given, "give the lever arm in m, as lever_arm=0.1")
    return float(given)
