"""`jaxmuscle design`."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm

from .console import out, plain_lines, record, reporting, say_written, writable
from .options import Force, Formats, Json, Output, Seed, band_of, formats_of, names_in

HOW_TO_RECORD = (
    "- Play the motion for {played:g} s: motor.csv holds one period of {period:g} s, to be repeated"
    " without a gap. Its first lines, which begin with #, say what it is. Let the motor move to its"
    " first value slowly. Its largest acceleration is {acceleration:.2g} m/s². If that is too much"
    " for your motor, design again and say how much it can do (--acceleration). If the person"
    " tires, record several shorter trials instead.",
    "- Record force and displacement. Fit both channels from {begin:g} to {end:g} s, together with"
    " what you have already: the errors above include that. Give each held trial with --hold, and"
    " an earlier moved record as a second file. In --window, give the window of the new record"
    " first, then one auto for each other file. For three held trials that is --window"
    " {begin:g}:{end:g},auto,auto,auto:",
    "    jaxmuscle fit RECORD.csv --hold HOLD.csv --window {begin:g}:{end:g},auto --out out/both",
    "- Without other recordings:",
    "    jaxmuscle fit RECORD.csv --task prescribed-length --window {begin:g}:{end:g} --out"
    " out/moved",
)


def design(
    source: Annotated[
        str,
        typer.Argument(
            metavar="FIT", help="A fit.json of your muscle, or a bundled preset or preset file."
        ),
    ],
    quantity: Annotated[
        str,
        typer.Option(
            metavar="NAMES", help="Quantities that you want to know; put commas between names."
        ),
    ] = "K_w0",
    rms: Annotated[
        float,
        typer.Option(metavar="MM", help="Largest root mean square of the displacement in mm."),
    ] = 1.0,
    band: Annotated[
        str,
        typer.Option(
            metavar="A:B",
            help=(
                "Lowest and highest frequency of the motion in Hz; slower motions meet drift of the"
                " force."
            ),
        ),
    ] = "0.5:5",
    seconds: Annotated[
        float, typer.Option(metavar="S", help="Length of the record and period of the motion in s.")
    ] = 60.0,
    rate: Annotated[
        float, typer.Option(metavar="HZ", help="Sampling rate of the motor's signal in Hz.")
    ] = 1000.0,
    peak: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Largest displacement to either side in mm: half of the motor's travel.",
        ),
    ] = None,
    speed: Annotated[
        float | None, typer.Option(metavar="MM/S", help="Largest speed of the motor in mm/s.")
    ] = None,
    acceleration: Annotated[
        float | None,
        typer.Option(metavar="M/S2", help="Largest acceleration of the motor in m/s²."),
    ] = None,
    spread: Annotated[
        float,
        typer.Option(
            metavar="SHARE",
            help="Share of the motion, 0 to 1, that is spread evenly over the band.",
        ),
    ] = 0.1,
    error: Annotated[
        float | None,
        typer.Option(
            metavar="PERCENT",
            help="Say how long to record for a standard error of so many percent.",
        ),
    ] = None,
    seed: Seed = 0,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design the motion of a motor that tells most about the stiffness or damping of the muscle.

    Lengths are in mm here (in Python in m). Writes the signal for your motor, DIR/motor.csv, and a
    figure, DIR/design.png. DIR/design.json has the errors that you can expect from one record,
    beside those of a motion that is even over the band.

    Examples:

        jaxmuscle design fit.json --quantity K_w0 --rms 1 --band 0.5:5 --seconds 60 --out out/design

        jaxmuscle design fit.json --quantity K_w0,K_z0 --error 10
    """
    with reporting(as_json):
        from jaxmuscle._common.figures import write_figure
        from jaxmuscle._common.text import folded

        for option, given, unit in (
            ("--rms", rms, "mm"),
            ("--peak", peak, "mm"),
            ("--speed", speed, "mm/s"),
            ("--acceleration", acceleration, "m/s²"),
            ("--seconds", seconds, "s"),
        ):
            if given is not None and not 0 < given < float("inf"):
                raise ValueError(f"{option} {given:g}: give a number of {unit} above 0")
        if error is not None and not 0 < error < 100:
            raise ValueError(
                f"--error {error:g}: give a percentage between 0 and 100, as --error 10"
            )
        writable(
            output,
            "motor.csv",
            "design.json",
            beside=(),
            figures=["design"],
            reads=[source],
            force=force,
        )
        found = jm.uncertainty.design_input(
            _source(source),
            names_in(quantity, "--quantity") or (),
            rms=rms / 1e3,
            band=band_of(band),
            seconds=seconds,
            rate=rate,
            peak=None if peak is None else peak / 1e3,
            speed=None if speed is None else speed / 1e3,
            acceleration=acceleration,
            spread=spread,
            key=seed,
            error=None if error is None else error / 100,
        )
        found.save(output / "motor.csv")
        found.save(output / "design.json")
        figures = write_figure(found.plot(), output, "design", formats_of(formats))
        record(output / "design.json")
        out.print(plain_lines(found), soft_wrap=True)
        say_written(output, "motor.csv", "design.json", *figures)
        begin, end = found.window
        about = {
            "begin": begin,
            "end": end,
            "played": found.played,
            "period": found.lengthening.seconds,
            "acceleration": found.acceleration,
        }
        for words in HOW_TO_RECORD:
            said = words.format(**about)
            # a command is copied, so that it keeps its line
            line = said if said.startswith(" ") else folded([said])
            out.print(line, soft_wrap=True)


def _source(name: str) -> Any:
    if name in jm.list_targets():
        raise ValueError(
            f"{name}: is a spectrum; a motion is designed for the muscle that was fitted to it. Fit"
            f" first: jaxmuscle fit {name} --out out/fit, then jaxmuscle design out/fit/fit.json"
        )
    return jm.load_result(name) if Path(name).suffix == ".json" else jm.load_preset(name)
