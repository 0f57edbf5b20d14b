"""`jaxmuscle reproduce`."""

from pathlib import Path
from typing import Annotated

import typer

from jaxmuscle import paper

from .console import out, record, reporting, say_written, writable
from .options import Force, Json, Output

FIGURES = ["fig2", "fig3", "fig4a", "fig4b", "fig5", "fig6a", "fig6b", "fig7", "fig8", "readings"]


def reproduce(
    output: Output = Path("out/reproduce"),
    recording: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help=(
                "Recording of a person for Figures 7 and 8; give it three times, for three people."
            ),
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Draw the figures of the paper and check what its text states.

    The paper is that of Zagrodny, Wojnicz, Ludwicki and Barański, from which the model is. Writes
    DIR/index.html (open it in a browser), DIR/fig2 ... fig8 as .png and .pdf, and DIR/claims.json.

    Examples:

        jaxmuscle reproduce --out out/reproduce

        jaxmuscle reproduce --recording anna.csv --recording ben.csv --recording chris.csv
    """
    with reporting(as_json):
        writable(
            output,
            "claims.json",
            beside=["index.html"],
            figures=FIGURES,
            reads=recording or (),
            force=force,
        )
        given = paper.given_recordings(recording) if recording else None
        _reproduce(output, given)


def _reproduce(folder: Path, given) -> None:
    rows = paper.check(paper.reproduce(folder, given, progress=True))
    record({"summary": paper.counted(rows), "claims": [row._asdict() for row in rows]})
    out.print(paper.counted(rows))
    for row in rows:
        if row.verdict == "does not agree":
            says = f"does not agree ({row.kind}): {row.says} ({row.source}): {row.ours}"
            out.print(says, markup=False)
    say_written(folder, "index.html", "fig2 to fig8 (.png, .pdf)", "claims.json")
