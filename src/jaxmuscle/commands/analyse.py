"""`jaxmuscle analyse`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .console import absent, csv_text, err, out, plain, record, reporting, save_figure, writable
from .options import Force, Json, Output, Window
from .recordings import read, reads_recordings

if TYPE_CHECKING:
    from jaxmuscle import Recording


@reads_recordings
def analyse(
    path: Annotated[str, typer.Argument(metavar="RECORDING", help="Text, .xlsx, .mat, .npy, .npz, .c3d, .edf, ... file.")],
    *,
    window: Window = None,
    output: Output = Path("out"),
    save_target: Annotated[Path | None, typer.Option(metavar="FILE", help="Save the target for `jaxmuscle fit`.")] = None,
    force: Force = False,
    as_json: Json = False,
    reading: dict[str, Any],
) -> None:
    """Analyse a recording: level, variability, regularity, spectrum.

    Writes DIR/analysis.json, DIR/spectrum.csv and DIR/analysis.png.

    Examples:

        jaxmuscle analyse trial.csv --column force --rate 2048 --window 8:25 --save-target trial.toml

        jaxmuscle analyse trial.c3d --column finger --axis principal --reference stand --window all
    """
    with reporting(as_json):
        if save_target is not None and save_target.suffix.lower() != ".toml":
            raise ValueError(f"--save-target {save_target}: a target is saved as TOML; give a name that ends in .toml")
        if save_target is not None:
            absent(save_target, force=force)
        writable(output, "analysis.json", force=force)
        recording = read(path, reading, window)
        _write(recording, output, save_target)


def _write(recording: "Recording", folder: Path, save_target: Path | None) -> None:
    from rich.table import Table

    from jaxmuscle._common.files import write_json, write_text

    spectrum, summary = recording.spectrum(), recording.summary()
    proportional = spectrum.power / spectrum.power.sum()
    columns = {"frequency_hz": spectrum.frequency, "power": spectrum.power, "proportional_power": proportional}
    facts = {key: getattr(recording, key) for key in ("name", "source", "unit", "rate", "window", "notices")}
    found = {"recording": facts, "summary": summary.to_dict(), "settings": spectrum.settings.to_dict(),
             "spectrum": {key: values.tolist() for key, values in columns.items()}}  # fmt: skip
    if save_target is not None:
        target = recording.target(save_target.stem)
        save_target.parent.mkdir(parents=True, exist_ok=True)
    else:
        target = None
    save_figure(recording.plot(), folder / "analysis.png")
    write_text(folder / "spectrum.csv", csv_text(columns))
    write_json(folder / "analysis.json", found)
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
    record(found)
    out.print(f"Written: {', '.join(written)}", highlight=False)
