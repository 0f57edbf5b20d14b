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


def fixed_values(pairs: list[str]) -> dict[str, float]:
    fixed: dict[str, float] = {}
    for pair in pairs:
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


Output = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")]
Seed = Annotated[int, typer.Option(help="Seed of all random numbers.")]


class TaskName(StrEnum):
    isometric = "isometric"
    motion = "prescribed-motion"
    force = "prescribed-force"


Preset = Annotated[str, typer.Argument(help="Bundled preset (see `jaxmuscle presets`), preset file or fit.json.")]
