"""`jaxmuscle speed`."""

import os
from typing import Annotated

import typer

import jaxmuscle as jm

from .console import out, record, reporting, task_of
from .ensemble import Precision, Threads, use
from .options import Json, OtherTask


def speed(
    preset: Annotated[
        str | None,
        typer.Argument(help="A preset or a fit.json; by default the usual isometric task."),
    ] = None,
    task: OtherTask = None,
    seeds: Annotated[
        int, typer.Option(min=1, help="How many recordings to simulate, each with its own noise.")
    ] = 2048,
    duration: Annotated[float, typer.Option(help="Length of each recording in s.")] = 15.0,
    precision: Annotated[
        Precision, typer.Option(help="Precision of the simulation.")
    ] = Precision.single,
    threads: Threads = None,
    as_json: Json = False,
) -> None:
    """Measure the speed of this machine: compile time, steps per second, real-time factor, memory.

    It simulates as `jaxmuscle ensemble --reduce` does, but without the linear model beside it
    (control variate). The real-time factor is simulated time over elapsed time. The numbers are
    medians of three calls.

    Example:

        jaxmuscle speed --seeds 4096
    """
    with reporting(as_json):
        # compile time is what it takes, not what loading takes
        os.environ["JAXMUSCLE_CACHE"] = "off"
        use(precision)
        model = (
            task_of(preset, task)
            if preset is not None
            else jm.Isometric()
            if task is None
            else jm.model.TASKS[task]()
        )
        found = jm.ensembles.measure(model, seeds, duration, threads)
        record(found)
        for name, value in found.items():
            shown = f"{value:.4g}" if isinstance(value, float) else str(value)
            out.print(f"{name.replace('_', ' '):<28}{shown}")
