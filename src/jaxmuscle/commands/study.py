"""`jaxmuscle study`."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm

from .console import CONVERGED, NOT_CONVERGED, err, out, plain, record, reporting, show, writable
from .options import (
    READING,
    Force,
    Formats,
    Json,
    NoiseName,
    Output,
    Seed,
    SpectrumName,
    Window,
    formats_of,
    names_in,
)
from .recordings import edges_of, reads_recordings


@reads_recordings
def study(
    table: Annotated[
        Path,
        typer.Argument(
            help="Table of the recordings (.csv), or a .toml with the table and options."
        ),
    ],
    *,
    rung: Annotated[
        str | None,
        typer.Option(
            help=(
                "Model for all people: 0 base, 1 with activation, 2 with tremor (default), 3 with a"
                " second resonance; or "
                "auto: the one with the lowest AIC."
            )
        ),
    ] = None,
    noise: Annotated[
        NoiseName | None,
        typer.Option(help="Colour of the noise on stiffness, band-limited by default."),
    ] = None,
    window: Window = None,
    spectrum: Annotated[
        SpectrumName | None,
        typer.Option(
            help="How spectra are estimated, as in `jaxmuscle analyse`; the same for all."
        ),
    ] = None,
    quantities: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES", help="Quantities that are compared; put commas between names."
        ),
    ] = None,
    alpha: Annotated[
        float | None,
        typer.Option(help="Level of the tests, 0.05 by default; intervals are those of 1 - alpha."),
    ] = None,
    correction: Annotated[
        str | None,
        typer.Option(help="How p is corrected for many comparisons: holm (default), fdr or none."),
    ] = None,
    seed: Seed = 0,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
    reading: dict[str, Any],
) -> None:
    """Compare groups and conditions: fit all recordings of a study with one model, write tables,
    figures and methods.

    The table has a line for each recording. It needs the columns file and person, and may have
    group, condition and trial. The trials of a person in a condition are averaged. Options such as
    --column say how files are read. A column of the same name in the table has priority. Writes
    DIR/people.csv, differences.csv, study.json, spectra.png, quantities.png, methods.txt and
    report.html, all at the end.

    Examples:

        jaxmuscle study study.csv --out out/study

        jaxmuscle study study.toml --correction fdr --quantities tremor_frequency,tremor_share
    """
    with reporting(as_json):
        from jaxmuscle._common.environment import keep_compiled_programs
        from jaxmuscle.reports import study_report

        keep_compiled_programs()
        span = edges_of(window)
        writable(output, "study.json", force=force)
        found = jm.run_study(
            table,
            rung=int(rung) if rung is not None and rung.isdigit() else rung,
            noise=None if noise is None else str(noise),
            quantities=names_in(quantities, "--quantities"),
            alpha=alpha,
            correction=correction,
            key=seed,
            progress=True,
            window=span,
            spectrum=None if spectrum is None else str(spectrum),
            **{name: value for name, value in reading.items() if value != READING[name][1]},
        )
        whose: dict[str, list[str]] = {}
        for cell in found.cells:
            for notice in cell.target.notices:
                whose.setdefault(notice, []).append(cell.target.name)
        for notice, names in whose.items():
            said = "all" if len(names) == len(found.cells) else "; ".join(names)
            err.print(f"[yellow]notice:[/] {plain(said)}: {plain(notice)}", highlight=False)
        found.save(output, formats_of(formats))
        study_report(found, output)
        record(output / "study.json")
        show(found, success=found.success)
        files = ", ".join(sorted(path.name for path in output.iterdir()))
        out.print(f"Written: {output}/{files}", highlight=False, soft_wrap=True)
    raise typer.Exit(CONVERGED if found.success else NOT_CONVERGED)
