"""`jaxmuscle design`."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm

from .console import out, plain, record, reporting, writable
from .options import Force, Formats, Json, Output, Seed, formats_of, names_in


def design(
    source: Annotated[str, typer.Argument(metavar="FIT", help="A fit.json, or a bundled preset or preset file.")],
    quantity: Annotated[str, typer.Option(metavar="NAMES", help="What is to be known, comma-separated.")] = "K_w0",
    rms: Annotated[float, typer.Option(metavar="MM", help="Root mean square of the displacement, at most.")] = 1.0,
    band: Annotated[str, typer.Option(metavar="A:B", help="Frequencies of the motion [Hz].")] = "0.1:5",
    seconds: Annotated[float, typer.Option(metavar="S", help="Length of the record, and period of the motion.")] = 60.0,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Sampling rate of the motor's signal.")] = 1000.0,
    peak: Annotated[float | None, typer.Option(metavar="MM", help="Largest displacement to either side.")] = None,
    speed: Annotated[float | None, typer.Option(metavar="MM/S", help="Largest speed.")] = None,
    spread: Annotated[float, typer.Option(metavar="SHARE", help="Share of the motion that is even over the band.")] = 0.1,
    seed: Seed = 0,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Design the motion of a motor from which stiffness or damping of the muscle become best known.

    Lengths are in mm here (in Python in m). Writes DIR/motor.csv (the signal), DIR/design.json (what one record of it is
    expected to tell, beside a motion of even density) and DIR/design.png.

    Example:

        jaxmuscle design out/fit.json --quantity K_w0 --rms 1 --band 0.1:5 --seconds 60 --out out/design
    """
    with reporting(as_json):
        from jaxmuscle._common.environment import keep_compiled_programs
        from jaxmuscle._common.figures import write_figure

        keep_compiled_programs()
        writable(output, "motor.csv", "design.json", force=force)
        found = jm.design_input(
            _source(source), names_in(quantity, "--quantity") or (), rms=rms / 1e3, band=_band(band), seconds=seconds,
            rate=rate,
            peak=None if peak is None else peak / 1e3, speed=None if speed is None else speed / 1e3, spread=spread, key=seed,
        )  # fmt: skip
        found.save(output / "motor.csv")
        found.save(output / "design.json")
        figures = write_figure(found.plot(), output, "design", formats_of(formats))
        record(output / "design.json")
        out.print(plain(found), highlight=False, soft_wrap=True)
        out.print(f"Written: {output}/{', '.join(['motor.csv', 'design.json', *figures])}", highlight=False)


def _source(name: str) -> Any:
    return jm.load_result(name) if Path(name).suffix == ".json" else jm.load_preset(name)


def _band(text: str) -> tuple[float, float]:
    low, _, high = text.partition(":")
    try:
        return float(low), float(high)
    except ValueError:
        raise ValueError(f"--band {text}: give lowest and highest frequency in Hz, 0.1:5 say") from None
