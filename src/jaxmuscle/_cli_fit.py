"""`jaxmuscle fit`."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from ._console import (
    CONVERGED,
    INTERRUPTED,
    NOT_CONVERGED,
    Output,
    Seed,
    TaskName,
    csv_text,
    err,
    out,
    plain,
    progress,
    reporting,
    save_figure,
    writable,
)

if TYPE_CHECKING:
    from ._result import FitResult


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


def fit(
    target: Annotated[
        list[str], typer.Argument(help="Bundled target (see `jaxmuscle targets`) or path of a .toml, .csv, .json, .tar.")
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
    seed: Seed = 0,
    segments: Annotated[int | None, typer.Option(min=1, help="Welch segments behind the target.")] = None,
    quantity: Annotated[str | None, typer.Option(help="force, torque or displacement.")] = None,
    dataset: Annotated[str | None, typer.Option(metavar="NAME", help="Which dataset of a digitised figure.")] = None,
    axis: Annotated[
        AxisName, typer.Option(help="log-log: a digitised figure's points are log10 of Hz and of power.")
    ] = AxisName.linear,
    groups: Annotated[
        Path | None, typer.Option(metavar="FILE", help="CSV with the columns target, group (several targets).")
    ] = None,
    output: Output = Path("out"),
) -> None:
    """Fit the muscle to a target spectrum, or to those of many people together.

    Prints a table and writes DIR/fit.json, DIR/fit.png and DIR/spectrum.csv. Several targets: DIR/TARGET/... and
    DIR/cohort.csv, cohort.png (and differences.csv with groups); fitted in linear response, without its last checks.

    Examples:

        jaxmuscle fit vastus-lateralis-26mvc --out out/fit

        jaxmuscle fit my-spectrum.csv --segments 12 --noise ornstein-uhlenbeck

        jaxmuscle fit fdi-abduction-45mvc --fix m_w=0.1 --free c_w,noise_K_w

        jaxmuscle fit people/*.csv --groups groups.csv --out out/cohort

        jaxmuscle fit figure.tar --dataset "95 MVC" --segments 6
    """
    with reporting():
        from ._cache import keep_compiled_programs
        from ._target import load_target

        keep_compiled_programs()
        fixed = fixed_values(fix or [])
        names = None if free is None else [name.strip() for name in free.split(",") if name.strip()]
        read = {"quantity": quantity, "segments": segments, "dataset": dataset, "axis": str(axis)}
        options = {
            "free": names,
            "fix": fixed,
            "noise": str(noise),
            "residual": str(residual),
            "starts": starts,
            "key": seed,
        }
        if len(target) > 1:
            from ._cli_cohort import fit_together

            if method != MethodName.linear or seeds is not None:
                raise ValueError("several targets are fitted together in linear response: leave out --method and --seeds, "
                                 "or fit them one at a time")  # fmt: skip
            raise typer.Exit(fit_together(target, read, task, groups, output, options))
        if groups is not None:
            raise ValueError("--groups needs several targets")
        options |= {"method": str(method), "seeds": seeds}
        converged = _fit_one(load_target(target[0], **read), task, output, options)  # pyright: ignore[reportArgumentType]
    raise typer.Exit(CONVERGED if converged else NOT_CONVERGED)


def _fit_one(target: Any, task: TaskName | None, folder: Path, options: dict[str, Any]) -> bool:
    from ._fit import FitInterrupted, task_for
    from ._fit import fit as fit_task
    from ._task import TASKS

    model = task_for(target) if task is None else TASKS[task](settings=target.settings)
    writable(folder)
    for notice in target.notices:
        err.print(f"[yellow]notice:[/] {plain(notice)}", highlight=False)
    try:
        with progress(f"fitting {target.name}") as tell:
            result = fit_task(model, target, progress=tell, **options)
    except FitInterrupted as stop:
        write_fit(stop.result, folder)
        err.print(f"interrupted: what had been reached is in {folder}")
        raise typer.Exit(INTERRUPTED) from None
    write_fit(result, folder)
    _show_fit(result, folder)
    return result.success


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


def write_fit(result: "FitResult", folder: Path) -> None:
    """fit.json, spectrum.csv and fit.png, each whole or not there."""
    from ._store import write_text

    result.save(folder / "fit.json")
    columns = {"frequency_hz": result.frequency_hz, "target": result.target.proportional_power, "fitted": result.fitted,
               "harmonic_share": result.harmonic_share, "residual_sd": result.residual}  # fmt: skip
    write_text(folder / "spectrum.csv", csv_text(columns))
    save_figure(result.plot(), folder / "fit.png")


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
        out.print(plain(sentence[0].upper() + sentence[1:]), highlight=False)
    if result.undetermined:
        out.print("Not determined by the data (kept near the default by the prior):", highlight=False)
        for sentence in result.undetermined:
            out.print(f"  - {plain(sentence)}", highlight=False)
    for notice in result.notices:
        if notice not in result.target.notices:
            out.print(f"[yellow]notice:[/] {plain(notice)}", highlight=False)
    word = "[green]converged[/]" if result.success else "[bold red]failed[/]"
    out.print(f"{word}: {plain(result.message)}", highlight=False)
    out.print(f"Written: {folder}/fit.json, fit.png, spectrum.csv", highlight=False)
