"""`jaxmuscle reproduce`."""

from pathlib import Path

from jaxmuscle import paper

from .console import out, record, reporting, say_written, writable
from .options import Force, Json, Output

FIGURES = ["fig2", "fig3", "fig4a", "fig4b", "fig5", "fig6a", "fig6b", "fig7", "fig8", "readings"]


def reproduce(
    output: Output = Path("out/reproduce"),
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Draw the figures of the paper and check what its text states.

    The paper is that of Zagrodny, Wojnicz, Ludwicki and Barański, from which the model is. Writes
    DIR/index.html (open it in a browser), DIR/fig2 ... fig8 as .png and .pdf, and DIR/claims.json.

    Example:

        jaxmuscle reproduce --out out/reproduce
    """
    with reporting(as_json):
        writable(
            output, "claims.json", beside=["index.html"], figures=FIGURES, reads=(), force=force
        )
        _reproduce(output)


def _reproduce(folder: Path) -> None:
    rows = paper.check(paper.reproduce(folder, progress=True))
    record({"summary": paper.counted(rows), "claims": [row._asdict() for row in rows]})
    out.print(paper.counted(rows))
    for row in rows:
        if row.verdict == "does not agree":
            says = f"does not agree ({row.kind}): {row.says} ({row.source}): {row.ours}"
            out.print(says, markup=False)
    say_written(folder, "index.html", "fig2 to fig8 (.png, .pdf)", "claims.json")
