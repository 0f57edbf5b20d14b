"""Options that several commands have."""

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer


class NoiseName(StrEnum):
    white = "white"
    band_limited = "band-limited"
    ornstein_uhlenbeck = "ornstein-uhlenbeck"
    pink = "pink"


class MethodName(StrEnum):
    linear = "linear"
    montecarlo = "montecarlo"


class ResidualName(StrEnum):
    log = "log"
    linear = "linear"
    cumulative = "cumulative"


class SpectrumName(StrEnum):
    standard = "standard"
    slow = "slow"
    multitaper = "multitaper"
    pwelch = "pwelch"


class FormatName(StrEnum):
    png = "png"
    pdf = "pdf"
    svg = "svg"


class TaskName(StrEnum):
    isometric = "isometric"
    motion = "prescribed-motion"
    force = "prescribed-force"
    length = "prescribed-length"


class Observed(StrEnum):
    displacement = "displacement"
    acceleration = "acceleration"


Output = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")]
Force = Annotated[bool, typer.Option("--force", help="Overwrite an earlier result.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object instead of text.")]
Formats = Annotated[
    list[FormatName] | None, typer.Option("--format", help="Format of the figures (png); repeatable.", show_default=False)
]
Seed = Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of all random numbers.")]
Preset = Annotated[str, typer.Argument(help="Bundled preset (see `jaxmuscle presets`), preset file or fit.json.")]
OtherTask = Annotated[TaskName | None, typer.Option(help="Put the same muscle into another task.")]
Observe = Annotated[Observed | None, typer.Option(help="What is observed of the motion in prescribed-force.")]
TargetTask = Annotated[TaskName | None, typer.Option(help="Default: follows from what the target measured.")]
Noise = Annotated[
    NoiseName | None, typer.Option(help="Colour of the noise (band-limited); if it is given, no richer model is tried.")
]
Free = Annotated[
    str | None, typer.Option(metavar="NAMES", help="Parameters to fit instead of the usual ones, comma-separated.")
]
Fix = Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE", help="Set a parameter and keep it; repeatable.")]
Segments = Annotated[int | None, typer.Option(min=1, max=10**9, help="How many Welch segments were averaged.")]
Quantity = Annotated[str | None, typer.Option(help="force, torque, displacement or acceleration.")]
Window = Annotated[
    str | None, typer.Option(metavar="A:B", help="Part to analyse [s], or `all`; by default the steady part.")
]
Recordings = Annotated[
    list[str], typer.Argument(metavar="RECORDING...", help="Text, .xlsx, .mat, .npy, .npz, .c3d, .edf, ... files of trials.")
]
_Name = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Column or point. Data:74 counts from 0. all: a trial in each (no study)."),
]
_Rate = Annotated[float | None, typer.Option(metavar="HZ", help="Sampling rate, if the file does not state it.")]
_Units = Annotated[str | None, typer.Option(metavar="U", help="N, Nm, mm, m/s^2, % MVC, ...; by default the file's.")]
_Reference = Annotated[str | None, typer.Option(metavar="NAME", help="Column or point that is subtracted.")]
_Time = Annotated[str | None, typer.Option(metavar="NAME", help="Column that holds the time, if it is not found.")]
READING: dict[str, tuple[Any, Any]] = {  # how a recording is read: annotation and default of each option
    "column": (_Name, None),
    "rate": (_Rate, None),
    "units": (_Units, None),
    "axis": (Annotated[str | None, typer.Option(help="Of a point: x, y, z or principal.")], None),
    "reference": (_Reference, None),
    "time": (_Time, None),
    "skip_rows": (Annotated[int, typer.Option(min=0, metavar="N", help="Lines to leave out at the top.")], 0),
    "max_gap": (Annotated[float, typer.Option(metavar="S", help="Longest gap in s that is closed.")], 0.2),
}
_Force = Annotated[str | None, typer.Option(metavar="NAME", help="Perturbed insertion: the column of the force.")]
_Displacement = Annotated[str | None, typer.Option(metavar="NAME", help="Perturbed insertion: that of its displacement.")]
_Moved = Annotated[str | None, typer.Option(metavar="U", help="m, cm, mm, um, deg or rad; by default the file's.")]
_Arm = Annotated[float | None, typer.Option(metavar="M", help="Lever arm in m, for a torque and for an angle.")]
_Positive = Annotated[str | None, typer.Option(help="lengthening or shortening; by default found from the data.")]
PERTURBED: dict[str, tuple[Any, Any]] = {  # the same for a file of force and displacement
    "force_column": (_Force, None),
    "displacement": (_Displacement, None),
    "displacement_units": (_Moved, None),
    "lever_arm": (_Arm, None),
    "positive": (_Positive, None),
    "delay": (Annotated[float, typer.Option(metavar="S", help="By which the force lags behind the displacement.")], 0.0),
}
SAME_NAME = (
    *READING,
    *PERTURBED,
    "force",
    "window",
    "quantity",
    "segments",
)  # arguments in messages that are options of the same name


def formats_of(given: list[FormatName] | None) -> list[str]:
    """The formats of every --format, png where there is none."""
    return [str(name) for name in given or [FormatName.png]]


def names_in(given: str | None, option: str = "--free") -> list[str] | None:
    """The names that an option lists, or None for the usual ones."""
    if given is None:
        return None
    names = [name.strip() for name in given.split(",") if name.strip()]
    if not names:
        raise ValueError(f"{option} {given!r}: name at least one, several with commas between them")
    return names


def fixed_values(pairs: list[str] | None) -> dict[str, float]:
    """The values of every --fix."""
    fixed: dict[str, float] = {}
    for pair in pairs or ():
        name, equals, value = pair.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = None
        if not (name.strip() and equals) or number is None or not math.isfinite(number):
            raise ValueError(f"--fix {pair!r}: write NAME=VALUE with a number, --fix k_w=500000 say")
        if name.strip() in fixed:
            raise ValueError(f"--fix {pair!r}: {name.strip()} is fixed twice")
        fixed[name.strip()] = number
    return fixed
