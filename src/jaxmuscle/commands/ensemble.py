"""`jaxmuscle ensemble`."""

import json
import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxmuscle as jm
from jaxmuscle._common.progress import told

from .cluster import Scheduler, Workers, workers_of
from .console import NOT_CONVERGED, err, out, plain, record, reporting, spare, task_of
from .options import Force, Increments, Json, Observe, OtherTask, Preset, Seed

if TYPE_CHECKING:
    from jaxmuscle.model import AbstractTask


Threads = Annotated[
    int | None,
    typer.Option(min=1, max=1024, help="How many cores of a CPU to use; all by default."),
]


class Precision(StrEnum):
    single = "float32"
    double = "float64"


class Generator(StrEnum):
    hash = "hash"
    threefry = "threefry"


def ensemble(
    preset: Preset,
    seeds: Annotated[
        int, typer.Option(help="How many recordings to simulate, each with its own noise.")
    ],
    output: Annotated[
        str,
        typer.Option(
            "--out",
            metavar="FILE.zarr",
            help="The folder where the store is written.",
        ),
    ],
    task: OtherTask = None,
    observe: Observe = None,
    seed: Seed = 0,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUES",
            help=(
                "Simulate several values of a parameter, as k_w=4e5,5e5; give it again for a grid."
            ),
        ),
    ] = None,
    duration: Annotated[float, typer.Option(help="Length of each recording in s.")] = 15.0,
    dt: Annotated[float, typer.Option(help="Time step of the noise in s.")] = 1e-3,
    reduce: Annotated[
        bool,
        typer.Option(
            "--reduce",
            help="Keep means, variances, quantiles and the mean spectrum, not the trajectories.",
        ),
    ] = False,
    states: Annotated[
        bool, typer.Option("--states", help="Also keep positions and velocities of the masses.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue a store that was interrupted.")
    ] = False,
    precision: Annotated[
        Precision, typer.Option(help="Precision of the simulation.")
    ] = Precision.single,
    increments: Annotated[
        Increments,
        typer.Option(
            help=(
                "Random numbers: gaussian, or weak (cheaper and faster, good for means and spectra,"
                " not for single "
                "traces). weak needs --reduce."
            )
        ),
    ] = Increments.gaussian,
    generator: Annotated[
        Generator,
        typer.Option(help="Generator of the random numbers; threefry is that of JAX, and slower."),
    ] = Generator.hash,
    chunk: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=2**32,
            help="How many recordings are simulated at once; chosen for you by default.",
        ),
    ] = None,
    threads: Threads = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Simulate any number of recordings (seeds) on all cores, into a zarr store; an interrupted run
    can be continued.

    The store is a folder that xarray reads. It has the dimensions seed, time and frequency (and
    point with --vary). Its attribute `complete` is set last.

    On a cluster, the workers of a Dask scheduler share the work (--scheduler). A worker may come,
    go or be killed at any time: the result is the same.

    Examples:

        jaxmuscle ensemble zagrodny-slifkin --seeds 10000 --out out/runs.zarr

        jaxmuscle ensemble fit.json --seeds 1000000 --reduce --resume --out out/moments.zarr

        jaxmuscle ensemble fit.json --seeds 1000000 --out out/many.zarr --scheduler file.json
    """
    with reporting(as_json):
        if states and reduce:
            raise ValueError(
                "--states keeps trajectories and --reduce throws them away: leave out one of them"
            )
        use(precision)
        if force:
            spare([preset], [Path(output)])
        model = task_of(preset, task, observe)
        settings = {
            "duration": duration,
            "dt": dt,
            "chunk": chunk,
            "resume": resume,
            "overwrite": force,
            "states": states,
            "increments": increments.value,
            "generator": generator.value,
            "threads": threads,
        }
        sweep = swept(model, vary or [])
        with workers_of(workers, scheduler) as executor:
            settings["executor"] = executor
            finite = run(model, sweep, seeds, seed, output, settings, reduce=reduce)
        if not finite:
            raise typer.Exit(NOT_CONVERGED)


def run(
    model: "AbstractTask",
    sweep: Any,
    seeds: int,
    seed: int,
    output: str,
    settings: dict,
    *,
    reduce: bool,
) -> bool:
    """Simulate and say how it went; whether every seed stayed finite."""
    import jax

    there = jm.ensembles.attributes_of(output) if settings["resume"] else None
    before = there is not None and there.get("complete")
    if settings["resume"] and not before:
        doing = "there is no store yet, starting one" if there is None else "resuming"
        err.print(f"{plain(output)}: {doing}", highlight=False)
    begun = time.monotonic()
    with told(True, f"{seeds} seeds") as tell:
        kept: Any = {"reduce": True} if reduce else {}
        try:
            found: Any = jm.ensemble(
                model if sweep is None else sweep,
                jax.random.key(seed),
                seeds=seeds,
                store=output,
                progress=jm.ensembles.Watch(lambda pace: tell(str(pace), pace.done / pace.total)),
                **kept,
                **settings,
            )
        except KeyboardInterrupt:
            err.print(
                f"what is complete stays in {plain(output)}: the same command with --resume goes"
                " on",
                highlight=False,
                soft_wrap=True,
            )
            raise
    elapsed = time.monotonic() - begun
    failed = json.loads((jm.ensembles.attributes_of(output) or {})["failed"])
    about = {"event": "done", "out": output, "seeds": seeds, "elapsed_s": round(elapsed, 3)}
    record(about | {"failed": failed})
    if reduce:
        out.print(str(found), highlight=False)
    else:
        say_store(f"{type(model).__name__}: ", found, failed)
    said = (
        f"{output}: was complete, nothing to do"
        if before
        else f"Written: {output} in {elapsed:.1f} s"
    )
    out.print(plain(said), highlight=False, soft_wrap=True)
    return not failed


def say_store(title: str, found: Any, failed: list) -> None:
    """What is in a store, and what failed."""
    sizes = ", ".join(f"{name} {size}" for name, size in found.sizes.items())
    out.print(f"{title}{', '.join(map(str, found.data_vars))} ({sizes})", highlight=False)
    say_failed(failed)


def say_failed(failed: list) -> None:
    """Which seeds did not stay finite, if any."""
    from jaxmuscle._common.text import listed

    if failed:
        shown = listed([seed for _, seed in failed])
        err.print(
            f"[bold red]failed:[/] {len(failed)} seed(s) did not stay finite ({shown}): lower the"
            " noise amplitude or --dt"
        )


def swept(model: "AbstractTask", vary: list[str]) -> Any:
    """The grid that --vary asks for, or None."""
    values = {}
    for entry in vary:
        name, _, text = entry.partition("=")
        try:
            values[name.strip()] = [float(number) for number in text.split(",")]
        except ValueError:
            raise ValueError(
                f"--vary {entry}: give a name and numbers, as --vary k_w=4e5,5e5"
            ) from None
    return jm.ensembles.Sweep.grid(model, **values) if values else None


def use(precision: Precision) -> None:
    """Set the precision before JAX starts."""
    import jax

    jax.config.update("jax_enable_x64", precision is Precision.double)
