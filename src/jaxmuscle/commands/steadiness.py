"""`jaxmuscle steadiness`."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm

from .console import out, plain, record, reporting, writable
from .options import Force, Formats, Json, Output, Recordings, Window, band_of, formats_of
from .recordings import read_trials, reads_recordings


@reads_recordings
def steadiness(
    paths: Recordings,
    *,
    window: Window = None,
    band: Annotated[
        str | None,
        typer.Option(
            metavar="LOW:HIGH",
            help=(
                "Frequencies [Hz] between which a tremor is looked for. By default 6:12; of a"
                " displacement or an acceleration 3:20."
            ),
        ),
    ] = None,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
    reading: dict[str, Any],
) -> None:
    """How steady is a force? Variability, power by band, regularity of one or several trials,
    without a model.

    Give the trials of one person in one condition. Prints every value with its standard error and
    95 % interval. From three trials on, they follow from how much the trials differ. Writes
    DIR/steadiness.json, DIR/steadiness.csv (a row per trial and quantity) and DIR/steadiness.png.

    Example:

        jaxmuscle steadiness trial1.csv trial2.csv --column force --rate 2048 --window 8:25
    """
    with reporting(as_json):
        from jaxmuscle._common.figures import write_figure
        from jaxmuscle._common.files import write_text

        writable(output, "steadiness.json", force=force)
        searched = None if band is None else band_of(band)
        found = jm.steadiness(read_trials(paths, reading, window), band=searched)
        found.save(output / "steadiness.json")
        table = found.to_dataframe().to_csv(index=False, float_format="%.8g", lineterminator="\n")
        write_text(output / "steadiness.csv", table)
        figures = write_figure(found.plot(), output, "steadiness", formats_of(formats))
        record(output / "steadiness.json")
        out.print(plain(found), highlight=False, soft_wrap=True)
        out.print(
            f"Written: {output}/{', '.join(['steadiness.json', 'steadiness.csv', *figures])}",
            highlight=False,
        )
