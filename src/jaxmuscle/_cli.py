"""The `jaxmuscle` command."""

import contextlib
import csv
import io
import os
import sys
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from ._bundled import describe_presets, describe_targets

if TYPE_CHECKING:
    from ._result import FitResult
    from ._task import AbstractTask

CONVERGED, NOT_CONVERGED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="A stochastic rheological muscle: simulate its force, fit it to measured force spectra.",
)
out = Console(soft_wrap=False)
err = Console(stderr=True, soft_wrap=True)


class TaskName(StrEnum):
    isometric = "isometric"
    motion = "prescribed-motion"
    force = "prescribed-force"


class NoiseName(StrEnum):
    white = "white"
    band_limited = "band-limited"
    ornstein_uhlenbeck = "ornstein-uhlenbeck"


class MethodName(StrEnum):
    linear = "linear"
    montecarlo = "montecarlo"


class ResidualName(StrEnum):
    log = "log"
    linear = "linear"
    cumulative = "cumulative"


@contextlib.contextmanager
def _reporting() -> Iterator[None]:
    """Turn a user's mistake into one line and exit code 2, a numerical failure into 1, an interruption into 130."""
    from ._simulate import SimulationError

    try:
        yield
    except (ValueError, OSError) as error:
        err.print(f"[bold red]error:[/] {_plain(_words(error))}", highlight=False)
        raise typer.Exit(BAD_INPUT) from None
    except SimulationError as error:
        err.print(f"[bold red]failed:[/] {_plain(error)}", highlight=False)
        raise typer.Exit(NOT_CONVERGED) from None
    except KeyboardInterrupt:
        err.print("interrupted")
        raise typer.Exit(INTERRUPTED) from None


def _words(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _plain(text: object) -> str:
    return str(text).replace("[", r"\[")


@app.command()
def fit(
    target: Annotated[
        list[str], typer.Argument(help="Bundled target (see `jaxmuscle targets`) or path of a .toml or .csv.")
    ],
    task: Annotated[TaskName | None, typer.Option(help="Default: follows from what the target measured.")] = None,
    method: Annotated[
        MethodName, typer.Option(help="Spectrum in linear response, then corrected; or simulated.")
    ] = MethodName.linear,
    noise: Annotated[NoiseName, typer.Option(help="Colour of the noise.")] = NoiseName.band_limited,
    residual: Annotated[ResidualName, typer.Option(help="What is compared.")] = ResidualName.log,
    free: Annotated[str | None, typer.Option(metavar="NAMES", help="Comma-separated; replaces the default set.")] = None,
    fix: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Set a parameter and keep it; repeatable.")
    ] = None,
    starts: Annotated[
        int | None, typer.Option(min=1, help="Starting points; 100, or 8 where there is no linear response.")
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Noise paths; 32, or 48 where there is no linear response.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    segments: Annotated[int | None, typer.Option(min=1, help="Welch segments behind the target.")] = None,
    quantity: Annotated[str | None, typer.Option(help="force, torque or displacement.")] = None,
    output: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("out"),
) -> None:
    """Fit the muscle to a target spectrum.

    Writes DIR/fit.json, DIR/fit.png and DIR/spectrum.csv (several targets: DIR/TARGET/...), prints a table.

    Examples:

        jaxmuscle fit vastus-lateralis-26mvc --out out/fit

        jaxmuscle fit my-spectrum.csv --segments 12 --noise ornstein-uhlenbeck

        jaxmuscle fit fdi-abduction-45mvc --fix m_w=0.1 --free c_w,noise_K_w
    """
    with _reporting():
        from ._cache import keep_compiled_programs
        from ._target import load_target

        keep_compiled_programs()
        fixed = _fixed(fix or [])
        names = None if free is None else [name.strip() for name in free.split(",") if name.strip()]
        targets = [load_target(t, quantity=quantity, segments=segments) for t in target]
        folders = [output] if len(targets) == 1 else [output / t.name for t in targets]
        if len(set(folders)) < len(folders):
            raise ValueError("two targets have the same name and would share a folder: rename one")
        options = {"free": names, "fix": fixed, "noise": str(noise), "method": str(method), "residual": str(residual),
                   "starts": starts, "seeds": seeds, "key": seed}  # fmt: skip
        converged = [_fit_one(t, task, folder, options) for t, folder in zip(targets, folders, strict=True)]
    raise typer.Exit(CONVERGED if all(converged) else NOT_CONVERGED)


def _fit_one(target: Any, task: TaskName | None, folder: Path, options: dict[str, Any]) -> bool:
    from ._fit import FitInterrupted, task_for
    from ._fit import fit as fit_task
    from ._task import TASKS

    model = task_for(target) if task is None else TASKS[task](settings=target.settings)
    _writable(folder)
    for notice in target.notices:
        err.print(f"[yellow]notice:[/] {_plain(notice)}", highlight=False)
    try:
        with _progress(f"fitting {target.name}") as tell:
            result = fit_task(model, target, progress=tell, **options)
    except FitInterrupted as stop:
        _write_fit(stop.result, folder)
        err.print(f"interrupted: what had been reached is in {folder}")
        raise typer.Exit(INTERRUPTED) from None
    _write_fit(result, folder)
    _show_fit(result, folder)
    return result.success


def _fixed(pairs: list[str]) -> dict[str, float]:
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


def _writable(folder: Path) -> None:
    """Fail before the long work, not after it."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {folder}: is a file, give a folder")
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"--out {folder}: cannot be written to")


@contextlib.contextmanager
def _progress(title: str) -> Iterator[Any]:
    """A progress bar on a terminal, nothing elsewhere."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.fields[title]}"), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=err, transient=True, disable=not err.is_terminal) as bar:
        row = bar.add_task("starting", total=1.0, title=title)
        yield lambda text, share: bar.update(row, description=text, completed=share)


def _write_fit(result: "FitResult", folder: Path) -> None:
    from ._store import write_text

    result.save(folder / "fit.json")
    columns = {"frequency_hz": result.frequency_hz, "target": result.target.proportional_power, "fitted": result.fitted,
               "harmonic_share": result.harmonic_share, "residual_sd": result.residual}  # fmt: skip
    write_text(folder / "spectrum.csv", _csv(columns))
    _save_figure(result.plot(), folder / "fit.png")


def _csv(columns: dict[str, Any]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([f"{value:.8g}" for value in row] for row in zip(*columns.values(), strict=True))
    return text.getvalue()


def _save_figure(figure: Any, path: Path) -> None:
    import matplotlib.pyplot as plt

    from ._store import replacing

    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150)
    plt.close(figure)


def _show_fit(result: "FitResult", folder: Path) -> None:
    table = Table(title=f"{result.target.name}: {type(result.task).__name__}, {type(result.task.noise).__name__}",
                  title_justify="left")  # fmt: skip
    for column, justify in (("parameter", "left"), ("value", "right"), ("std. error", "right"), ("unit", "left")):
        table.add_column(column, justify=justify)  # pyright: ignore[reportArgumentType]
    free = [(name, p) for name, p in result.parameters.items() if p.free]
    for name, p in [*free, *result.derived.items()]:
        if name == next(iter(result.derived), None):
            table.add_section()
        error = p.error_in_words() if p.stderr is not None else f"[dim]{p.error_in_words()}[/]"
        table.add_row(name, f"{p.value:.4g}", error, "" if p.unit == "1" else p.unit)
    out.print(table)
    if result.chi2_per_bin is not None:
        out.print(f"chi² per bin {result.chi2_per_bin:.2f}, rms log error {result.rms_log_error:.2f}", highlight=False)
    for sentence in result.remarks:
        out.print(_plain(sentence[0].upper() + sentence[1:]), highlight=False)
    if result.undetermined:
        out.print("Not determined by the data (kept near the default by the prior):", highlight=False)
        for sentence in result.undetermined:
            out.print(f"  - {_plain(sentence)}", highlight=False)
    for notice in result.notices:
        if notice not in result.target.notices:
            out.print(f"[yellow]notice:[/] {_plain(notice)}", highlight=False)
    word = "[green]converged[/]" if result.success else "[bold red]failed[/]"
    out.print(f"{word}: {_plain(result.message)}", highlight=False)
    out.print(f"Written: {folder}/fit.json, fit.png, spectrum.csv", highlight=False)


@app.command()
def simulate(
    preset: Annotated[str, typer.Argument(help="Bundled preset (see `jaxmuscle presets`), preset file or fit.json.")],
    task: Annotated[TaskName | None, typer.Option(help="Put the same muscle into another task.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Noise paths.")] = 50,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    output: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("out"),
) -> None:
    """Simulate a saved task.

    Writes DIR/trajectories.nc, DIR/spectrum.csv and DIR/simulate.png.

    Examples:

        jaxmuscle simulate zagrodny-slifkin --seeds 200 --out out/simulate

        jaxmuscle simulate out/fit/fit.json --task prescribed-force
    """
    with _reporting():
        from ._cache import keep_compiled_programs
        from ._preset import load_preset
        from ._task import TASKS

        keep_compiled_programs()
        model = load_preset(preset)
        if task is not None and type(model) is not TASKS[task]:
            model = model.as_task(TASKS[task])
        _writable(output)
        _simulate(model, seeds, seed, output)


def _simulate(model: "AbstractTask", seeds: int, seed: int, folder: Path) -> None:
    import jax
    import numpy as np

    from . import plot
    from ._metrics import peaks
    from ._simulate import ensemble
    from ._store import replacing, write_text

    runs = ensemble(model, jax.random.key(seed), seeds=seeds, progress=err.is_terminal)
    spectra = runs.spectrum()
    estimate = runs.mean_spectrum()
    mean = estimate.spectrum
    dataset = runs.to_xarray().assign_attrs(seed=seed)
    with replacing(folder / "trajectories.nc") as temporary:
        dataset.to_netcdf(temporary, engine="h5netcdf")
    low, high = np.quantile(np.asarray(spectra.proportional), [0.05, 0.95], axis=0)
    columns = {"frequency_hz": np.asarray(mean.frequency), "power": np.asarray(mean.power), "power_stderr": estimate.stderr,
               "proportional_power": np.asarray(mean.proportional), "quantile_05": low, "quantile_95": high}  # fmt: skip
    write_text(folder / "spectrum.csv", _csv(columns))
    _save_figure(plot.simulation(runs), folder / "simulate.png")
    held = np.asarray(runs.between())
    found = peaks(mean)
    unit = model.output_unit
    out.print(f"{type(model).__name__}, {seeds} seeds of {runs.time[-1]:g} s: {model.output_name} "
              f"{held.mean():.4g} {unit}, coefficient of variation "
              f"{100 * np.mean(held.std(axis=1) / np.abs(held.mean(axis=1))):.3g} %", highlight=False)  # fmt: skip
    locals_ = ", ".join(f"{p.frequency:.3f}" for p in found.local_maxima) or "none"
    out.print(f"Spectrum: maximum at {found.maximum.frequency:.3f} Hz, local maxima at {locals_} Hz", highlight=False)
    out.print(f"Written: {folder}/trajectories.nc, spectrum.csv, simulate.png", highlight=False)


@app.command()
def targets() -> None:
    """List the bundled targets."""
    table = Table(title="Bundled targets", title_justify="left")
    for column in ("name", "provenance", "quantity", "source"):
        table.add_column(column, overflow="fold", no_wrap=column == "name")
    for entry in describe_targets():
        table.add_row(entry.name, entry.provenance, entry.quantity, _plain(entry.source.partition(". ")[0]))
    out.print(table)


@app.command()
def presets() -> None:
    """List the bundled presets (saved tasks)."""
    table = Table(title="Bundled presets", title_justify="left")
    for column in ("name", "task", "description"):
        table.add_column(column, overflow="fold", no_wrap=column != "description")
    for entry in describe_presets():
        table.add_row(entry.name, entry.task, _plain(entry.description))
    out.print(table)


def main() -> None:
    """Entry point of the console script."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    app(prog_name="jaxmuscle")


if __name__ == "__main__":
    sys.exit(main())
