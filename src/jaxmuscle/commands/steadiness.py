"""`jaxmuscle steadiness`."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm

from .analyse import _edges
from .console import out, plain, reporting, save_figure, writable
from .options import Output


def steadiness(
    paths: Annotated[list[str], typer.Argument(metavar="RECORDING...", help="Trials of one condition of one person.")],
    column: Annotated[str | None, typer.Option(metavar="NAME", help="Column, point, or Data:74 (counted from 0).")] = None,
    rate: Annotated[float | None, typer.Option(metavar="HZ", help="Sampling rate, if the file does not state it.")] = None,
    units: Annotated[str | None, typer.Option(metavar="U", help="N, Nm, m, mm, % MVC, ...; by default the file's.")] = None,
    axis: Annotated[str | None, typer.Option(help="Of a point: x, y, z or principal.")] = None,
    reference: Annotated[str | None, typer.Option(metavar="NAME", help="Column or point to subtract.")] = None,
    window: Annotated[
        str | None, typer.Option(metavar="A:B", help="Steady part in s, or `all`; found by itself if left out.")
    ] = None,
    output: Output = Path("out"),
) -> None:
    """How steady is a force? Variability, power by band, regularity of one or several trials, without a model.

    Writes DIR/steadiness.json, DIR/steadiness.csv (a row per trial and quantity) and DIR/steadiness.png.

    Example:

        jaxmuscle steadiness trial1.csv trial2.csv trial3.csv --column force --rate 2048 --window 8:25
    """
    with reporting():
        edges = _edges(window)
        writable(output)
        asked: Any = {"column": column, "rate": rate, "units": units, "axis": axis, "reference": reference}
        try:
            recordings = [jm.load_recording(path, **asked) for path in paths]
        except ImportError as error:
            raise ValueError(str(error)) from None
        found = jm.steadiness(recordings if edges == "all" else [recording.steady(edges) for recording in recordings])

        from jaxmuscle._common.files import write_text

        found.save(output / "steadiness.json")
        table = found.to_dataframe().to_csv(index=False, float_format="%.8g", lineterminator="\n")
        write_text(output / "steadiness.csv", table)
        save_figure(found.plot(), output / "steadiness.png")
        out.print(plain(found), highlight=False, soft_wrap=True)
        out.print(f"Written: {output}/steadiness.json, steadiness.csv, steadiness.png", highlight=False)
