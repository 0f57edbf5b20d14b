"""`jaxmuscle posterior`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from jaxmuscle._common.progress import progress

from .console import CONVERGED, NOT_CONVERGED, err, out, plain, reporting, save_figure, writable
from .options import NoiseName, Output, Seed, TaskName, fixed_values

if TYPE_CHECKING:
    from jaxmuscle.fits._result import FitResult
    from jaxmuscle.uncertainty._posterior_result import Posterior


def posterior(
    target: Annotated[str, typer.Argument(help="Bundled target, path of a target file, or a fit.json that is taken up.")],
    task: Annotated[TaskName | None, typer.Option(help="Default: follows from what the target measured.")] = None,
    noise: Annotated[NoiseName, typer.Option(help="Colour of the noise.")] = NoiseName.band_limited,
    free: Annotated[str | None, typer.Option(metavar="NAMES", help="Comma-separated; replaces the default set.")] = None,
    fix: Annotated[
        list[str] | None, typer.Option(metavar="NAME=VALUE", help="Set a parameter and keep it; repeatable.")
    ] = None,
    segments: Annotated[int | None, typer.Option(min=1, help="Welch segments behind the target.")] = None,
    quantity: Annotated[str | None, typer.Option(help="force, torque or displacement.")] = None,
    chains: Annotated[int, typer.Option(min=2, help="Chains, from dispersed starts.")] = 4,
    draws: Annotated[int, typer.Option(min=100, help="Draws of each chain.")] = 1000,
    warmup: Annotated[int, typer.Option(min=1, help="Steps of each chain before its draws.")] = 500,
    seed: Seed = 0,
    output: Output = Path("out"),
) -> None:
    """Draw from the posterior of the muscle's parameters: how sure is the fit.

    Fits first (unless given a fit.json), then runs NUTS chains with the exact law of the Welch bins. Writes DIR/fit.json,
    DIR/posterior.nc (for ArviZ), DIR/posterior.json, corner.png, predictive.png and chains.png. Exit code 1 if the fit
    failed or the chains did not mix: then there is no summary.

    Examples:

        jaxmuscle posterior vastus-lateralis-26mvc --out out/posterior

        jaxmuscle posterior out/fit/fit.json --draws 4000

        jaxmuscle posterior my-spectrum.csv --segments 12 --noise ornstein-uhlenbeck
    """
    with reporting():
        from jaxmuscle._common.environment import keep_compiled_programs

        keep_compiled_programs()
        writable(output)
        asked = {"task": task, "noise": str(noise), "free": free, "fix": fix}
        result = _fitted(target, {"segments": segments, "quantity": quantity}, asked, seed)
        if not result.success:
            err.print(f"[bold red]failed:[/] the fit did not converge: {plain(result.message)}", highlight=False)
            raise typer.Exit(NOT_CONVERGED)
        result.save(output / "fit.json")
        try:
            with progress(f"posterior of {result.target.name}") as tell:
                from jaxmuscle.uncertainty._posterior import posterior as draw_posterior

                found = draw_posterior(result, key=seed, chains=chains, draws=draws, warmup=warmup, progress=tell)
        except ImportError as error:
            raise ValueError(str(error)) from None
        _write(found, output)
        _show(found, output)
    raise typer.Exit(CONVERGED if found.success else NOT_CONVERGED)


def _fitted(target: str, read: dict[str, Any], asked: dict[str, Any], seed: int) -> "FitResult":
    from jaxmuscle.data._target import load_target
    from jaxmuscle.fits._fit import fit
    from jaxmuscle.fits._result import load_result
    from jaxmuscle.model._tasks import TASKS
    from jaxmuscle.objective._arguments import task_for

    path = Path(target)
    if path.suffix == ".json" and path.is_file() and "task_table" in json.loads(path.read_text(encoding="utf-8")):
        if any(v is not None for v in read.values()) or any(asked[n] is not None for n in ("task", "free", "fix")):
            raise ValueError(f"{target}: is a fit; its task, parameters and target stay as they are, so leave out --task, "
                             "--free, --fix, --segments and --quantity")  # fmt: skip
        return load_result(path)
    loaded = load_target(target, **read)  # pyright: ignore[reportArgumentType]
    for notice in loaded.notices:
        err.print(f"[yellow]notice:[/] {plain(notice)}", highlight=False)
    if loaded.segments is None and loaded.sigma is None:
        raise ValueError(f"{target}: states neither segments nor sigma, so nothing says how much it scatters: give "
                         "--segments, the number of Welch segments that were averaged, or a third column sigma")  # fmt: skip
    task, free = asked["task"], asked["free"]
    model = task_for(loaded) if task is None else TASKS[task](settings=loaded.settings)
    names = None if free is None else [name.strip() for name in free.split(",") if name.strip()]
    with progress(f"fitting {loaded.name}") as tell:
        return fit(model, loaded, free=names, fix=fixed_values(asked["fix"] or []), noise=asked["noise"], key=seed,
                   progress=tell)  # fmt: skip


def _write(found: "Posterior", folder: Path) -> None:
    found.save(folder / "posterior.nc")
    found.save(folder / "posterior.json")
    save_figure(found.plot_chains(), folder / "chains.png")
    if found.success:
        save_figure(found.plot(), folder / "corner.png")
        save_figure(found.plot_predictive().figure, folder / "predictive.png")


def _show(found: "Posterior", folder: Path) -> None:
    if not found.success:
        err.print(f"[bold red]failed:[/] {plain(found.message)}; the chains are in {folder}", highlight=False)
        return
    table = Table(title=f"Posterior of {found.target.name}", title_justify="left")
    for column in ("quantity", "median", "95 % from", "to", "R-hat", "unit"):
        table.add_column(column, justify="left" if column in ("quantity", "unit") else "right")
    summary = found.summary()
    for name in summary.rows:
        row, unit = summary[name], found.unit(name)
        if name == next(iter(found.derived)):
            table.add_section()
        known = name in found.determined
        cells = (name, f"{summary.rows[name][2]:.4g}", f"{row['low']:.4g}", f"{row['high']:.4g}", f"{row['r_hat']:.3f}")
        table.add_row(*cells, "" if unit == "1" else unit, style=None if known else "dim")
    out.print(table)
    out.print("Dim: not determined by the data, the prior keeps it where it is", highlight=False)
    for line in str(found).splitlines()[1:]:
        out.print(plain(line.strip()), highlight=False)
    out.print(f"written to {folder}", highlight=False)
