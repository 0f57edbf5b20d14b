"""`jaxmuscle steadiness`."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm

from .console import out, plain_lines, record, reporting, say_written, writable
from .options import (
    Force,
    Formats,
    Json,
    Mvc,
    Output,
    Quantities,
    Recordings,
    Window,
    band_of,
    formats_of,
    names_in,
)
from .recordings import read_trials, reads_recordings, require_files
from .study import measured_study, write_study


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
    mvc: Mvc = None,
    quantities: Quantities = None,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
    reading: dict[str, Any],
) -> None:
    """Measure how steady a force is, without a model: variability, power by band, tremor.

    Give the trials of one person in one condition. Prints every value with its standard error and
    95 % interval. From three trials on, they follow from how much the trials differ. Writes
    DIR/steadiness.json, DIR/steadiness.csv (a row per trial and quantity) and DIR/steadiness.png.

    Or give the table of a study (`jaxmuscle study --help` says what it holds). Prints Table 1 of a
    paper, mean and SD by group and condition, and what differs. Writes what `jaxmuscle study`
    writes, but for the fits.

    Examples:

        jaxmuscle steadiness trial1.csv trial2.csv --column force --rate 2048 --window 8:25

        jaxmuscle steadiness study.csv --out out/study
    """
    with reporting(as_json):
        if mvc is not None:
            from jaxmuscle._common.arguments import positive

            positive("--mvc", mvc)
        is_study = len(paths) == 1 and (
            # no recording is a .toml: what is wrong with one is said as of a study
            paths[0].lower().endswith(".toml") or jm.data.kind_of_file(paths[0]) == "study"
        )
        if is_study:
            if band is not None:
                raise ValueError(
                    "--band: of a study leave it out; the band is that of the quantity"
                )
            if mvc is not None:
                raise ValueError("--mvc: of a study give the column mvc in its table")
            compared = names_in(quantities, "--quantities")
            found = measured_study(paths[0], window, compared, reading, output, force=force)
            write_study(found, output, formats_of(formats))
            return
        if quantities is not None:
            raise ValueError(
                "--quantities: is for the table of a study; of recordings all are printed"
            )
        require_files(paths)
        from jaxmuscle._common.figures import write_figure
        from jaxmuscle._common.files import write_text
        from jaxmuscle._common.tables import csv_of

        writable(
            output,
            "steadiness.json",
            beside=["steadiness.csv"],
            figures=["steadiness"],
            reads=paths,
            force=force,
        )
        searched = None if band is None else band_of(band)
        found = jm.data.steadiness(read_trials(paths, reading, window), band=searched, mvc=mvc)
        found.save(output / "steadiness.json")
        write_text(output / "steadiness.csv", csv_of(found.to_dataframe()))
        figures = write_figure(found.plot(), output, "steadiness", formats_of(formats))
        record(output / "steadiness.json")
        out.print(plain_lines(found), soft_wrap=True)
        say_written(output, "steadiness.json", "steadiness.csv", *figures)
