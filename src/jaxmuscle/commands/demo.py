"""`jaxmuscle demo`."""

from pathlib import Path
from typing import Annotated

import typer

from .console import out, plain, record, reporting, say_written, writable
from .options import Force, Json


def demo(
    output: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Folder for the recordings, made if missing."),
    ] = Path("demo"),
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write simulated recordings to try the other commands on: a study, and a moved limb.

    Six simulated people hold a force, rested and tired, three times each. Writes DIR/study.csv, the
    recordings that it lists, DIR/moved.csv (a motor moves the limb of a person who holds a force)
    and DIR/README.txt (what is in the files, and what is true). Nobody was measured.

    Example:

        jaxmuscle demo --out demo
    """
    with reporting(as_json):
        from .simulated import MOVED, README, TABLE, trials, write_demo

        writable(output, TABLE, MOVED, README, *trials(), beside=(), reads=(), force=force)
        written = write_demo(output, try_it("demo"))
        record({"folder": str(output), "files": written})
        say_written(output, TABLE, MOVED, README, f"and {len(trials())} recordings")
        out.print(f"All of it is simulated. Now try:\n\n{try_it(plain(output))}", soft_wrap=True)


def try_it(folder: str) -> str:
    """Commands to try on the recordings in a folder."""
    return f"""\
    jaxmuscle steadiness {folder}/sim01_rest_*.csv --out out/sim01
    jaxmuscle steadiness {folder}/study.csv --out out/table1
    jaxmuscle study {folder}/study.csv --out out/study
    jaxmuscle analyse {folder}/moved.csv --out out/moved
    jaxmuscle fit {folder}/sim01_tired_*.csv --out out/fit"""
