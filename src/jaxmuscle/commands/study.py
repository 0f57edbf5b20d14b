"""`jaxmuscle study`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxmuscle as jm

from .cluster import Scheduler, Workers, workers_of
from .console import (
    CONVERGED,
    NOT_CONVERGED,
    out,
    plain_lines,
    record,
    reporting,
    say_notice,
    say_written,
    writable,
)
from .options import (
    READING,
    Force,
    Formats,
    Json,
    NoiseName,
    Output,
    Quantities,
    Seed,
    SpectrumName,
    Window,
    formats_of,
    names_in,
)
from .recordings import edges_of, reads_recordings

if TYPE_CHECKING:
    from jaxmuscle.fits import StudyResult


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
                "Model for all people: 0 slow part + regular rhythm, 1 with twitch, 2 slow part +"
                " twitch + resonance, 3 with two resonances; or auto: the one with the lowest AIC."
                " By default 3 where everybody has five trials in every condition, else 2."
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
    quantities: Quantities = None,
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
    workers: Workers = None,
    scheduler: Scheduler = None,
    force: Force = False,
    as_json: Json = False,
    reading: dict[str, Any],
) -> None:
    """Compare groups and conditions: Table 1, tests, figures, one model for all people, methods.

    Prints Table 1 (mean and SD of what is measured, by group and condition), then what differs,
    then the model. `jaxmuscle steadiness` with the same table does the first part alone.

    The table has a line for each recording. It needs the columns file and person, and may have
    group, condition and trial. The trials of a person in a condition are averaged. Options such as
    --column say how files are read. A column of the same name in the table has priority. Writes
    DIR/table1.csv, people.csv, differences.csv, trials.csv, study.json, spectra.png,
    quantities.png, trials.png, methods.txt and report.html, all at the end.

    Examples:

        jaxmuscle study study.csv --out out/study

        jaxmuscle study study.toml --correction fdr --quantities mean,tremor_frequency

        jaxmuscle study study.csv --workers 8 --out out/study
    """
    with reporting(as_json):
        span = edges_of(window)
        _writable(output, table, force=force)
        with workers_of(workers, scheduler) as executor:
            found = jm.run_study(
                table,
                rung=int(rung) if rung is not None and rung.isdigit() else rung,
                noise=None if noise is None else str(noise),
                quantities=names_in(quantities, "--quantities"),
                alpha=alpha,
                correction=correction,
                key=seed,
                progress=True,
                executor=executor,
                window=span,
                spectrum=None if spectrum is None else str(spectrum),
                **_given(reading),
            )
        write_study(found, output, formats_of(formats))
    raise typer.Exit(CONVERGED if found.success else NOT_CONVERGED)


def write_study(found: "StudyResult", output: Path, formats: list[str]) -> None:
    """Say what is to be noticed of its recordings, write it, and print it."""
    from jaxmuscle.reports import REPORT, study_notices, study_report

    for notice in study_notices(found):
        say_notice(notice)
    found.save(output, formats)
    study_report(found, output)
    record(output / "study.json")
    out.print(plain_lines(found), soft_wrap=True)
    files = {path.name for path in output.iterdir()} - {REPORT}
    say_written(output, REPORT, *sorted(files))


def measured_study(
    table: str,
    window: str | None,
    quantities: list[str] | None,
    reading: dict[str, Any],
    output: Path,
    *,
    force: bool,
) -> "StudyResult":
    """A study without any model."""
    span = edges_of(window)
    _writable(output, table, force=force)
    return jm.run_study(
        table,
        fit=False,
        quantities=quantities,
        progress=True,
        window=span,
        **_given(reading),
    )


def _writable(output: Path, table: str | Path, *, force: bool) -> None:
    from jaxmuscle.reports import REPORT

    beside = ["table1.csv", "people.csv", "differences.csv", "trials.csv", "methods.txt", REPORT]
    writable(
        output,
        "study.json",
        beside=beside,
        figures=["spectra", "quantities", "trials"],
        reads=jm.data.files_of_study(table),
        force=force,
    )


def _given(reading: dict[str, Any]) -> dict[str, Any]:
    """The options of reading that were given."""
    return {name: value for name, value in reading.items() if value != READING[name][1]}
