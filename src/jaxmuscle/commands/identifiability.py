"""`jaxmuscle identifiability`."""

from pathlib import Path
from typing import Annotated

import typer

import jaxmuscle as jm

from .console import (
    REACHED,
    fit_into,
    fit_unless_taken_up,
    out,
    plain,
    plain_lines,
    record,
    reporting,
    say_written,
    writable,
)
from .options import Force, Formats, Json, Output, Quantity, Seed, Segments, TargetTask, formats_of


def identifiability(
    target: Annotated[
        str,
        typer.Argument(
            help="A fit.json, a bundled spectrum, or the file of a spectrum or recording."
        ),
    ],
    task: TargetTask = None,
    segments: Segments = None,
    quantity: Quantity = None,
    seed: Seed = 0,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Say what your data determine, and what further measurements would determine.

    Fits first (unless given a fit.json). The further measurements are the usual ones: the mean
    force, the displacement under a load, a moved insertion, another force level, a longer
    recording. Writes DIR/identifiability.json, DIR/identifiability.png and DIR/fit.json.

    Examples:

        jaxmuscle identifiability out/fit/fit.json --out out/next

        jaxmuscle identifiability my-spectrum.csv --segments 12 --out out/next
    """
    with reporting(as_json):
        from jaxmuscle._common.figures import write_figure

        writable(
            output,
            *fit_unless_taken_up(output, target),
            "identifiability.json",
            beside=[REACHED],
            figures=["identifiability"],
            reads=[target],
            force=force,
        )
        asked = {"task": task, "noise": None, "free": None, "fix": None}
        found = jm.identifiability(
            fit_into(output, target, {"segments": segments, "quantity": quantity}, asked, seed)
        )
        found.save(output / "identifiability.json")
        figures = write_figure(found.plot(), output, "identifiability", formats_of(formats))
        record(output / "identifiability.json")
        out.print(plain_lines(found), soft_wrap=True)
        say_written(output, "identifiability.json", *figures, "fit.json")
        stiffness = found.present.quantities.get("K_w0")
        if stiffness is not None and not stiffness.determined:
            fitted = plain(output / "fit.json")
            out.print(
                "How long must a record with a moved insertion be? For a standard error of 10 %,"
                f" beginning with a flat motion, ask: jaxmuscle design {fitted} --quantity"
                " K_w_tangent --error 10 --spread 1. Its errors hold if m_z is about what the"
                " motor will move: first fit with your estimate in kg (--fix m_z=2.3, say), if you"
                " have not done so",
                soft_wrap=True,
            )
