"""`jaxmuscle speed`."""

import os
from typing import Annotated

import typer

import jaxmuscle as jm

from .console import out, record, reporting, task_of
from .ensemble import Precision, Threads, use
from .options import Json, OtherTask


def speed(
    preset: Annotated[str | None, typer.Argument(help="Preset or fit.json; the default isometric task without.")] = None,
    task: OtherTask = None,
    seeds: Annotated[int, typer.Option(min=1, help="Noise paths.")] = 2048,
    duration: Annotated[float, typer.Option(help="Simulated time [s].")] = 15.0,
    precision: Annotated[Precision, typer.Option(help="Of the simulation.")] = Precision.single,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Measure this machine: compile time, steps/s, real-time factor, memory.

    Reduces an ensemble as `jaxmuscle ensemble --reduce` does, without control variate; medians of three calls.
    """
    with reporting(as_json):
        os.environ["JAXMUSCLE_CACHE"] = "off"  # compile time is what it takes, not what loading takes
        use(precision)
        model = task_of(preset, task) if preset is not None else jm.Isometric() if task is None else jm.model.TASKS[task]()
        found = jm.ensembles.measure(model, seeds, duration, threads)
        record(found)
        for name, value in found.items():
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            out.print(f"{name.replace('_', ' '):<28}{shown}", highlight=False)
