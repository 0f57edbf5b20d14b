"""`jaxmuscle compare`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import jaxmuscle as jm
from jaxmuscle._common.progress import told

from .console import CONVERGED, NOT_CONVERGED, aim_of, csv_text, out, plain, record, reporting, writable
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
    fixed_values,
    formats_of,
    names_in,
)

if TYPE_CHECKING:
    from jaxmuscle.comparison import Comparison


def compare(
    target: Annotated[
        str,
        typer.Argument(help="A bundled spectrum (see `jaxmuscle targets`), or the file of one (.toml, .csv, .json, .tar)."),
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
    """Which noise? Fit one spectrum with each colour of noise and with richer models, and say which can be told apart.

    Each colour is fitted with and without a harmonic (a regular rhythm). The richer models have activation or tremor. Writes
    DIR/compare.csv, DIR/compare.json and DIR/compare.png, and prints the table. A model that the task cannot carry is left
    out, and you are told why.

    Examples:

        jaxmuscle compare vastus-lateralis-26mvc --out out/compare

        jaxmuscle compare my-spectrum.csv --segments 45 --fix k_w=450000 --fix c_w=55

        jaxmuscle compare my-displacement.csv --quantity displacement --segments 12
    """
    with reporting(as_json):
        from jaxmuscle._common.environment import keep_compiled_programs

        keep_compiled_programs()
        fixed = fixed_values(fix)
        names = names_in(free)
        aim, model = aim_of(target, task, {"quantity": quantity, "segments": segments})
        writable(output, "compare.json", force=force)
        with told(True, f"comparing models on {aim.name}") as tell:
            found = jm.compare_noise(model, aim, free=names, fix=fixed, key=seed, progress=tell)
        files = _write(found, output, formats_of(formats))
        record(output / "compare.json")
        _show(found, f"{output}/{', '.join(files)}")
    raise typer.Exit(CONVERGED if found.success else NOT_CONVERGED)


def _write(found: "Comparison", folder: Path, formats: list[str]) -> list[str]:
    from jaxmuscle._common.figures import write_figure
    from jaxmuscle._common.files import write_text

    rows = found.table()
    write_text(folder / "compare.csv", csv_text({name: [row[name] for row in rows] for name in rows[0]}))
    found.save(folder / "compare.json")
    return ["compare.csv", "compare.json", *write_figure(found.plot(), folder, "compare", formats)]


def _show(found: "Comparison", files: str) -> None:
    out.print(plain(found), highlight=False, soft_wrap=True)
    if not found.success:
        out.print(
            "[bold red]failed:[/] not every model was fitted to the end: fix a parameter (--fix), or fit fewer (--free)",
            highlight=False,
        )
    out.print(f"Written: {files}", highlight=False)
