"""`jaxmuscle ensemble`."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxmuscle as jm
from jaxmuscle._common.progress import told

from .console import NOT_CONVERGED, err, out, plain, record, reporting, spare, task_of
from .options import Force, Increments, Json, Observe, OtherTask, Preset, Seed

if TYPE_CHECKING:
    from jaxmuscle.ensembles import Pace, PartReport
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
            help="Where the store is written: a folder, or a URL such as s3://...",
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
    part: Annotated[
        str | None,
        typer.Option(
            metavar="I/N",
            help="Simulate only part I of N, as 3/64, for a job array; then `jaxmuscle merge`.",
        ),
    ] = None,
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
    coordinator: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT", help="For several processes of one run: where process 0 listens."
        ),
    ] = None,
    processes: Annotated[
        int | None, typer.Option(min=1, help="How many processes share the run.")
    ] = None,
    process_id: Annotated[
        int | None, typer.Option(help="Number of this process, counted from 0.")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Simulate any number of recordings (seeds) on all cores, into a zarr store; an interrupted run
    can be continued.

    The store is a folder that xarray reads. It has the dimensions seed, time and frequency (and
    point with --vary). Its attribute `complete` is set last.

    On a cluster use --part: each process adds its part to the store, in any order. The parts need
    not run at the same time. If a part is killed, give the same command again. At the end,
    `jaxmuscle merge` puts the parts together. Under SLURM or Open MPI, or with --coordinator,
    several processes can share one run instead.

    Examples:

        jaxmuscle ensemble zagrodny-slifkin --seeds 10000 --out out/runs.zarr

        jaxmuscle ensemble fit.json --seeds 1000000 --reduce --resume --out out/moments.zarr

        jaxmuscle ensemble fit.json --seeds 1000000 --reduce --out out/parts.zarr --part 3/64
    """
    with alone_or_together(coordinator, processes, as_json):
        if states and reduce:
            raise ValueError(
                "--states keeps trajectories and --reduce throws them away: leave out one of them"
            )
        together = any(given is not None for given in (coordinator, processes, process_id))
        if part is not None and together:
            raise ValueError(
                f"--part {part}: a part is a process of its own: leave out --coordinator,"
                " --processes and --process-id"
            )
        use(precision)
        if part is None and (together or jm.ensembles.launched()):
            jm.ensembles.join(coordinator, processes, process_id)
        if force:
            spare([preset], [Path(output.removeprefix("file://"))])
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
            "threads": cores(coordinator, processes) if threads is None else threads,
            **({} if part is None else {"part": numbers_of(part)}),
        }
        if not run(model, swept(model, vary or []), seeds, seed, output, settings, reduce=reduce):
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

    first, part = jax.process_index() == 0, settings.get("part")
    there = jm.ensembles.attributes_of(output) if settings["resume"] else None
    before = there is not None and there.get("complete")
    if settings["resume"] and part is None and first and not before:
        doing = "there is no store yet, starting one" if there is None else "resuming"
        err.print(f"{plain(output)}: {doing}", highlight=False)
    begun = time.monotonic()
    with watching(f"{seeds} seeds", first=first) as tell:
        kept: Any = {"reduce": True} if reduce else {}
        try:
            found: Any = jm.ensemble(
                model if sweep is None else sweep,
                jax.random.key(seed),
                seeds=seeds,
                store=output,
                progress=jm.ensembles.Watch(tell),
                **kept,
                **settings,
            )
        except KeyboardInterrupt:
            again = (
                "the same command again" if part is not None else "the same command with --resume"
            )
            err.print(
                f"what is complete stays in {plain(output)}: {again} goes on",
                highlight=False,
                soft_wrap=True,
            )
            raise
    elapsed = time.monotonic() - begun
    about = {"event": "done", "out": output, "seeds": seeds, "elapsed_s": round(elapsed, 3)}
    if part is not None:
        record(about | found._asdict() | {"failed": found.failed.tolist()})
        return say_part(found, output, elapsed)
    failed = json.loads((jm.ensembles.attributes_of(output) or {})["failed"])
    if not first:
        return not failed
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


def say_part(found: "PartReport", output: str, elapsed: float) -> bool:
    """What one part did; whether every seed stayed finite."""
    if found.complete:
        said = f"{output}: was complete, nothing to do"
    else:
        said = (
            f"Part {found.number} of {found.parts}: {found.seeds} seeds in {elapsed:.1f} s. When"
            f" all parts are done: jaxmuscle merge {output}"
        )
    say_failed(found.failed.tolist())
    out.print(plain(said), highlight=False, soft_wrap=True)
    return found.success


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


def merge(
    store: Annotated[
        str, typer.Argument(help="The store that the parts have made: a folder or a URL.")
    ],
    as_json: Json = False,
) -> None:
    """Make one ensemble of the parts that `jaxmuscle ensemble --part` has put into a store.

    Checks that every piece of every part is there, computes the averages if --reduce was given, and
    marks the store as complete. If something is missing, the message names the parts to run again.
    You may repeat this command.

    Example:

        jaxmuscle merge out/parts.zarr
    """
    with reporting(as_json):
        before = (jm.ensembles.attributes_of(store) or {}).get("complete")
        found = jm.ensembles.merge(store)
        failed = json.loads(found.attrs["failed"])
        record({"event": "done", "out": store, "failed": failed})
        say_store("", found, failed)
        out.print(
            plain(f"{store}: was complete, nothing to do" if before else f"Merged: {store}"),
            highlight=False,
            soft_wrap=True,
        )
        if failed:
            raise typer.Exit(NOT_CONVERGED)


def numbers_of(part: str) -> tuple[int, int]:
    """I and N of I/N."""
    number, slash, count = part.partition("/")
    if not (slash and number.strip().isdigit() and count.strip().isdigit()):
        raise ValueError(
            f"--part {part}: write I/N with whole numbers, as --part 1/4 for the first of four"
        )
    return int(number), int(count)


@contextmanager
def watching(title: str, *, first: bool) -> Iterator[Callable[["Pace"], None]]:
    """As `told`; nothing from the second process on."""
    if not first:
        yield lambda pace: None
    else:
        with told(True, title) as tell:
            yield lambda pace: tell(str(pace), pace.done / pace.total)


@contextmanager
def alone_or_together(
    coordinator: str | None, processes: int | None, as_json: bool
) -> Iterator[None]:
    """As `reporting`; one of several processes that fails ends at once, so that the others
    notice."""
    from jaxmuscle._common.errors import ProcessLostError

    try:
        with reporting(as_json):
            try:
                yield
            except ProcessLostError as error:
                err.print(
                    f"[bold red]failed:[/] {error}. What is complete stays: start all processes"
                    " again with --resume"
                )
                raise typer.Exit(NOT_CONVERGED) from None
    except typer.Exit as stop:
        if stop.exit_code and (
            jm.ensembles.launched() or (coordinator is not None and processes not in (None, 1))
        ):
            jm.ensembles.leave(stop.exit_code)
        raise


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


def cores(coordinator: str | None, processes: int | None) -> int | None:
    """How many cores of a CPU are used: None for all that this process may, which processes of one
    machine share."""
    from jaxmuscle._common.environment import usable_cores

    host = (coordinator or "").partition(":")[0]
    if host not in ("127.0.0.1", "localhost") or not processes:
        return None
    return max(1, usable_cores() // processes)


def use(precision: Precision) -> None:
    """Set the precision before JAX starts."""
    import jax

    jax.config.update("jax_enable_x64", precision is Precision.double)
