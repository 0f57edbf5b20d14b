"""`jaxmuscle compare`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxmuscle as jm
from jaxmuscle._common.progress import told

from .console import (
    CONVERGED,
    NOT_CONVERGED,
    aim_of,
    aimed,
    csv_text,
    out,
    plain,
    plain_lines,
    record,
    reporting,
    say_written,
    writable,
)
from .options import (
    Fix,
    Force,
    Formats,
    Free,
    Json,
    Output,
    Quantity,
    Seed,
    Segments,
    TargetTask,
    TaskName,
    fixed_values,
    formats_of,
    names_in,
)

if TYPE_CHECKING:
    from jaxmuscle.comparison import Comparison


FIT = "fit.json"


def compare(
    target: Annotated[
        str,
        typer.Argument(
            help=(
                "A bundled spectrum (see `jaxmuscle targets`), the file of one (.toml, .csv), or"
                " the fit.json of a fit, whose spectrum is taken."
            )
        ),
    ],
    task: TargetTask = None,
    free: Free = None,
    fix: Fix = None,
    seed: Seed = 0,
    segments: Segments = None,
    quantity: Quantity = None,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Fit one spectrum with each colour of noise and with richer models, and compare them.

    Each colour is fitted with and without a harmonic (a regular rhythm). The richer models have
    activation or resonance. Writes DIR/compare.csv, DIR/compare.json and DIR/compare.png, and
    prints the table. A model that is impossible in this task is left out, and you are told why.

    Examples:

        jaxmuscle compare vastus-lateralis-26mvc --out out/compare

        jaxmuscle compare my-spectrum.csv --segments 45 --fix k_w=450000 --fix c_w=55

        jaxmuscle compare out/fit/fit.json --out out/compare

        jaxmuscle compare my-displacement.csv --quantity displacement --segments 12
    """
    with reporting(as_json):
        fixed = fixed_values(fix)
        names = names_in(free)
        read = {"quantity": quantity, "segments": segments}
        aim, model = (
            _of_a_fit(target, task, read)
            if Path(target).name == FIT
            else aim_of(target, task, read)
        )
        writable(
            output,
            "compare.json",
            beside=["compare.csv"],
            figures=["compare"],
            reads=[target],
            force=force,
        )
        with told(True, f"comparing models on {aim.name}") as tell:
            found = jm.comparison.compare_noise(
                model, aim, free=names, fix=fixed, key=seed, progress=tell
            )
        files = _write(found, output, formats_of(formats))
        record(output / "compare.json")
        _show(found)
        say_written(output, *files)
    raise typer.Exit(CONVERGED if found.success else NOT_CONVERGED)


def _of_a_fit(path: str, task: TaskName | None, read: dict[str, Any]) -> tuple[Any, Any]:
    """The spectrum of a fit of one target, and the task for it."""
    given = [name for name, value in read.items() if value is not None]
    if given:
        raise ValueError(
            f"--{given[0]}: the spectrum of a fit states this already; leave the option out"
        )
    targets = list(jm.load_result(path).targets.values())
    if len(targets) > 1:
        raise ValueError(
            f"{path}: is a fit of {len(targets)} spectra; give the file of one of them"
        )
    return aimed(targets[0], task)


def _write(found: "Comparison", folder: Path, formats: list[str]) -> list[str]:
    from jaxmuscle._common.figures import write_figure
    from jaxmuscle._common.files import write_text

    rows = found.table()
    write_text(
        folder / "compare.csv", csv_text({name: [row[name] for row in rows] for name in rows[0]})
    )
    found.save(folder / "compare.json")
    return ["compare.csv", "compare.json", *write_figure(found.plot(), folder, "compare", formats)]


def _unsettled(found: "Comparison") -> str:
    """Whose search did not come to its end, and what may help: holding a parameter that the data
    say little about."""
    rows = [row for row in found.rows if not row.success]
    words = (
        f"the search did not converge for {'; '.join(row.label for row in rows)}. Do not use these"
        " rows"
    )
    tasks = [found.tasks[row.noise, row.harmonic] for row in rows]
    common = set[str].intersection(*(set(task.parameter_names) for task in tasks))
    name = "resonance_width" if "resonance_width" in common else "c_z"
    value = float(tasks[0][name])
    return (
        f"{words}. To help the search, fix a parameter of these models, for example --fix"
        f" {name}={value:.2g}, or leave that parameter out of --free"
    )


def _show(found: "Comparison") -> None:
    out.print(plain_lines(found), soft_wrap=True)
    if not found.success:
        out.print(f"[bold red]failed:[/] {plain(_unsettled(found))}", soft_wrap=True)
