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


class ReflexName(StrEnum):
    auto = "auto"
    none = "none"
    linear = "linear"


class Increments(StrEnum):
    gaussian = "gaussian"
    weak = "weak"


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


Output = Annotated[
    Path,
    typer.Option("--out", metavar="DIR", help="Folder for the results, made if it is not there."),
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite the results of an earlier run.")]
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object, for scripts, instead of text.")
]
Formats = Annotated[
    list[FormatName] | None,
    typer.Option(
        "--format",
        help="Format of the figures, png by default; give it again for another.",
        show_default=False,
    ),
]
Seed = Annotated[
    int,
    typer.Option(
        min=0,
        max=2**32 - 1,
        help="Seed of the random numbers: the same seed gives the same result.",
    ),
]
Preset = Annotated[
    str,
    typer.Argument(
        help=(
            "A muscle in a task: a bundled preset (see `jaxmuscle presets`), a preset file or a"
            " fit.json."
        )
    ),
]
OtherTask = Annotated[TaskName | None, typer.Option(help="Put the same muscle into this task.")]
Observe = Annotated[
    Observed | None,
    typer.Option(
        help="In the task prescribed-force: whether the output is displacement or acceleration."
    ),
]
TargetTask = Annotated[
    TaskName | None,
    typer.Option(
        help="What is held in the experiment; by default it follows from what was measured."
    ),
]
Noise = Annotated[
    NoiseName | None,
    typer.Option(
        help=(
            "Colour of the noise, band-limited by default. If you give it, richer models are tried"
            " only with --rungs."
        )
    ),
]
Free = Annotated[
    str | None,
    typer.Option(
        metavar="NAMES",
        help=(
            "Fit these parameters instead of the usual ones; put commas between names. Then"
            " `jaxmuscle fit` tries no richer model, unless you give --rungs."
        ),
    ),
]
Fix = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help="Hold a parameter at a value; give it again for another parameter.",
    ),
]
Segments = Annotated[
    int | None,
    typer.Option(
        min=1,
        max=10**9,
        help="How many Welch segments were averaged. This number says how much each bin scatters.",
    ),
]
Quantity = Annotated[
    str | None,
    typer.Option(help="What was measured: force, torque, displacement, acceleration, ..."),
]
Mvc = Annotated[
    float | None,
    typer.Option(
        metavar="FORCE",
        help=(
            "Maximal voluntary contraction, in the unit of the recording and counted from rest;"
            " gives the level in % MVC."
        ),
    ),
]
Quantities = Annotated[
    str | None,
    typer.Option(
        metavar="NAMES",
        help="Quantities of a study that are compared; put commas between names.",
    ),
]
Window = Annotated[
    str | None,
    typer.Option(
        metavar="A:B",
        help=(
            "Part to analyse: A:B (from A to B in s), all, or auto (default: the program finds the"
            " steady part). For several files, one each: A:B,auto (not in a study)."
        ),
    ),
]
Holds = Annotated[
    list[str] | None,
    typer.Option(
        metavar="FILE",
        help=(
            "For a moved insertion: a recording of the same person with the insertion held, fitted"
            " together with it. Give the option again for a further trial."
        ),
    ),
]
Recordings = Annotated[
    list[str],
    typer.Argument(
        metavar="RECORDING...",
        help=(
            "Files of your sensor, one for each trial: text, .xlsx, .mat, .npy, .npz, .c3d,"
            " .edf, ..."
        ),
    ),
]
_Name = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=(
            "Column, or motion-capture point, that holds the signal. Data:74 is column 74 of the"
            " table Data, counted from 0. all: every column is a trial (not in a study)."
        ),
    ),
]
_Rate = Annotated[
    float | None,
    typer.Option(metavar="HZ", help="Sampling rate in Hz, if the file does not state it."),
]
_Units = Annotated[
    str | None,
    typer.Option(
        metavar="U", help="Unit of the signal: N, Nm, mm, m/s^2, % MVC, ...; by default the file's."
    ),
]
_Reference = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Column or point that is subtracted from the signal."),
]
_Time = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=(
            "Column that holds the time, if the program does not find it; none: leave the times"
            " out, the rows are even at --rate."
        ),
    ),
]
_Sheet = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help=(
            "Sheet of a workbook: its name, or its number from 0. By default the one that holds a"
            " signal; several alike are trials."
        ),
    ),
]
_Arm = Annotated[
    float | None,
    typer.Option(
        metavar="M",
        help=(
            "Distance in m from the joint's axis to the point where the force acts. A torque is"
            " divided by it and becomes a force in N; an angle becomes a displacement."
        ),
    ),
]
_Baseline = Annotated[
    str | None,
    typer.Option(
        metavar="A:B",
        help=(
            "Part in which the signal rests, from A to B in s: its mean is subtracted; or none. By"
            " default it is found, and subtracted if it is quiet."
        ),
    ),
]
_Detrend = Annotated[
    bool,
    typer.Option("--detrend", help="Subtract the straight line through the part that is analysed."),
]
# how a recording is read: annotation and default of each option
READING: dict[str, tuple[Any, Any]] = {
    "column": (_Name, None),
    "rate": (_Rate, None),
    "units": (_Units, None),
    "axis": (
        Annotated[
            str | None,
            typer.Option(
                help=(
                    "Direction of a motion-capture point: x, y, z, or principal for its largest"
                    " motion."
                )
            ),
        ],
        None,
    ),
    "reference": (_Reference, None),
    "time": (_Time, None),
    "skip_rows": (
        Annotated[
            int,
            typer.Option(
                min=0, metavar="N", help="How many lines to leave out at the top of the file."
            ),
        ],
        0,
    ),
    "sheet": (_Sheet, None),
    "max_gap": (
        Annotated[
            float,
            typer.Option(
                metavar="S",
                help="Longest gap in the recording, in s, that is filled by a straight line.",
            ),
        ],
        0.2,
    ),
    "lever_arm": (_Arm, None),
    "outliers": (
        Annotated[
            str,
            typer.Option(
                metavar="keep|mask",
                help=(
                    "Samples that cannot be, as -9999 or single spikes: keep them, with a notice,"
                    " or mask them as gaps."
                ),
            ),
        ],
        "keep",
    ),
    "quantity": (Quantity, None),
    "baseline": (_Baseline, None),
    "detrend": (_Detrend, False),
}
_Force = Annotated[
    str | None, typer.Option(metavar="NAME", help="For a moved insertion: the column of the force.")
]
_Displacement = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="For a moved insertion: the column of its displacement."),
]
_Moved = Annotated[
    str | None,
    typer.Option(
        metavar="U",
        help="Unit of the displacement: m, cm, mm, um, deg or rad; by default the file's.",
    ),
]
_Positive = Annotated[
    str | None,
    typer.Option(
        help=(
            "What a positive displacement is: lengthening or shortening; by default found from the"
            " data."
        )
    ),
]
PERTURBED: dict[str, tuple[Any, Any]] = {  # the same for a file of force and displacement
    "force_column": (_Force, None),
    "displacement": (_Displacement, None),
    "displacement_units": (_Moved, None),
    "positive": (_Positive, None),
    "delay": (
        Annotated[
            float,
            typer.Option(
                metavar="S",
                help="Delay in s of the force channel behind the displacement. It is corrected.",
            ),
        ],
        0.0,
    ),
}
SAME_NAME = (
    *READING,
    *PERTURBED,
    "force",
    "window",
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
        raise ValueError(
            f"{option} {given!r}: name at least one; put commas between several, as {option}"
            " k_w,c_w"
        )
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
            raise ValueError(
                f"--fix {pair!r}: write NAME=VALUE with a number, for example --fix k_w=500000"
            )
        if name.strip() in fixed:
            raise ValueError(f"--fix {pair!r}: {name.strip()} is fixed twice; give one value")
        fixed[name.strip()] = number
    return fixed


def band_of(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    try:
        return float(low), float(high)
    except ValueError:
        raise ValueError(
            f"--band {text}: give lowest and highest frequency in Hz, as --band 0.5:5"
        ) from None
