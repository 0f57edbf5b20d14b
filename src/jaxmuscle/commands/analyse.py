"""`jaxmuscle analyse`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxmuscle as jm

from .console import csv_text, err, out, plain, reporting, save_figure, writable
from .options import Output

if TYPE_CHECKING:
    from jaxmuscle import Recording


def analyse(
    path: Annotated[str, typer.Argument(metavar="RECORDING", help="CSV, TSV, .mat, .npy, .npz or .c3d file.")],
    column: Annotated[str | None, typer.Option(metavar="NAME", help="Column, point, or Data:74 (counted from 0).")] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Sampling rate, if the file does not state it.")] = None,
    units: Annotated[str | None, typer.Option(metavar="U", help="N, Nm, m, mm, % MVC, ...; by default the file's.")] = None,
    axis: Annotated[str | None, typer.Option(help="Of a point: x, y, z or principal.")] = None,
    reference: Annotated[str | None, typer.Option(metavar="NAME", help="Column or point to subtract.")] = None,
    window: Annotated[
        str | None, typer.Option(metavar="A:B", help="Steady part in s, or `all`; found by itself if left out.")
    ] = None,
    output: Output = Path("out"),
    save_target: Annotated[Path | None, typer.Option(metavar="FILE", help="Save the target for `jaxmuscle fit`.")] = None,
) -> None:
    """Analyse a recording: level, variability, regularity, spectrum.

    Writes DIR/analysis.json, DIR/spectrum.csv and DIR/analysis.png.

    Examples:

        jaxmuscle analyse trial.csv --column force --rate 2048 --window 8:25 --save-target trial.toml

        jaxmuscle analyse trial.c3d --column finger --axis principal --reference stand --window all
    """
    with reporting():
        edges = edges_of(window)
        if save_target is not None and save_target.suffix.lower() != ".toml":
            raise ValueError(f"--save-target {save_target}: a target is saved as TOML; give a name that ends in .toml")
        writable(output)

        try:
            asked: Any = {"column": column, "rate": rate, "units": units, "axis": axis, "reference": reference}
            recording = jm.load_recording(path, **asked)
        except ImportError as error:
            raise ValueError(str(error)) from None
        if edges != "all":
            recording = recording.steady(edges)
        _write(recording, output, save_target)


def edges_of(window: str | None) -> Any:
    if window is None or window == "all":
        return window
    start, colon, stop = window.partition(":")
    try:
        if colon:
            return float(start), float(stop)
    except ValueError:
        pass
    raise ValueError(f"--window {window}: give start and end in s, as 8:25, or all")


def _write(recording: "Recording", folder: Path, save_target: Path | None) -> None:
    from rich.table import Table

    from jaxmuscle._common.files import write_json, write_text

    spectrum, summary = recording.spectrum(), recording.summary()
    proportional = spectrum.power / spectrum.power.sum()
    columns = {"frequency_hz": spectrum.frequency, "power": spectrum.power, "proportional_power": proportional}
    facts = {key: getattr(recording, key) for key in ("name", "source", "unit", "rate", "window", "notices")}
    record = {"recording": facts, "summary": summary.to_dict(), "settings": spectrum.settings.to_dict(),
              "spectrum": {key: values.tolist() for key, values in columns.items()}}  # fmt: skip
    if save_target is not None:
        target = recording.target(save_target.stem)
        save_target.parent.mkdir(parents=True, exist_ok=True)
    else:
        target = None
    save_figure(recording.plot(), folder / "analysis.png")
    write_text(folder / "spectrum.csv", csv_text(columns))
    write_json(folder / "analysis.json", record)
    for notice in recording.notices if target is None else target.notices:
        err.print(f"[yellow]notice:[/] {plain(notice)}", highlight=False)
    table = Table(title=plain(recording.source), title_justify="left", show_header=False)
    for name, value in summary.rows():
        table.add_row(name, plain(value))
    out.print(table)
    written = [f"{folder}/analysis.json, spectrum.csv, analysis.png"]
    if target is not None and save_target is not None:
        target.save(save_target)
        written.append(str(save_target))
    out.print(f"Written: {', '.join(written)}", highlight=False)
