"""Options that several commands have."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class NoiseName(StrEnum):
    white = "white"
    band_limited = "band-limited"
    ornstein_uhlenbeck = "ornstein-uhlenbeck"
    pink = "pink"


class AxisName(StrEnum):
    linear = "linear"
    log_log = "log-log"


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


class TaskName(StrEnum):
    isometric = "isometric"
    motion = "prescribed-motion"
    force = "prescribed-force"


Output = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]
Preset = Annotated[str, typer.Argument(help="Bundled preset (see `jaxmuscle presets`), preset file or fit.json.")]
OtherTask = Annotated[TaskName | None, typer.Option(help="Put the same muscle into another task.")]
TargetTask = Annotated[TaskName | None, typer.Option(help="Default: follows from what the target measured.")]
Noise = Annotated[
    NoiseName | None, typer.Option(help="Colour of the noise (band-limited); if it is given, no richer model is tried.")
]
Free = Annotated[str | None, typer.Option(metavar="NAMES", help="Comma-separated; replaces the default set.")]
Fix = Annotated[list[str] | None, typer.Option(metavar="NAME=VALUE", help="Set a parameter and keep it; repeatable.")]
Segments = Annotated[int | None, typer.Option(min=1, help="Welch segments behind the target.")]
Quantity = Annotated[str | None, typer.Option(help="force, torque or displacement.")]


def names_in(free: str | None) -> list[str] | None:
    """The names of --free, or None for the usual ones."""
    return None if free is None else [name.strip() for name in free.split(",") if name.strip()]


def fixed_values(pairs: list[str] | None) -> dict[str, float]:
    """The values of every --fix."""
    fixed: dict[str, float] = {}
    for pair in pairs or ():
        name, equals, value = pair.partition("=")
        try:
            number = float(value)
        except ValueError:
            number = None
        if not (name.strip() and equals) or number is None:
            raise ValueError(f"--fix {pair!r}: write NAME=VALUE with a number, --fix k_w=500000 say")
        if name.strip() in fixed:
            raise ValueError(f"--fix {pair!r}: {name.strip()} is fixed twice")
        fixed[name.strip()] = number
    return fixed
