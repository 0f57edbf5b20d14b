"""The `jaxmuscle` command."""

import gc
import logging
import os
import sys
from typing import Annotated

import typer
from rich.table import Table

from jaxmuscle.__about__ import __version__
from jaxmuscle._common.bundled import describe_presets, describe_targets

from .analyse import analyse
from .compare import compare
from .console import out, plain, record, reporting
from .demo import demo
from .design import design
from .ensemble import ensemble
from .explore import explore
from .fit import fit
from .identifiability import identifiability
from .options import Json
from .posterior import posterior
from .reproduce import reproduce
from .simulate import simulate
from .speed import speed
from .steadiness import steadiness
from .study import study

MEASURE, MODEL, SIMULATE = "Measure a force", "Fit the model", "Simulate, and more"

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown", pretty_exceptions_enable=False)


for measure in (demo, analyse, steadiness, study):
    app.command(rich_help_panel=MEASURE)(measure)
app.command("analyze", hidden=True)(analyse)
for model in (fit, identifiability, design, posterior, compare, explore):
    app.command(rich_help_panel=MODEL)(model)
for other in (simulate, ensemble, reproduce, speed):
    app.command(rich_help_panel=SIMULATE)(other)


def show_version(wanted: bool) -> bool:
    if wanted:
        out.print(f"jaxmuscle {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def common(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=show_version, help="Print the version and end."
        ),
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose",
            "-v",
            help="Also say which compiled programs are stored on disk and loaded again.",
        ),
    ] = False,
) -> None:
    """How steady is a force, where does it tremble, and how stiff is the muscle?

    `jaxmuscle COMMAND --help` explains a command and its options.

    Examples:

        jaxmuscle demo

        jaxmuscle steadiness trial1.csv trial2.csv trial3.csv --units N
    """
    logging.basicConfig(format="%(message)s", stream=sys.stderr)
    logging.getLogger("jaxmuscle").setLevel(
        logging.WARNING if quiet else logging.DEBUG if verbose else logging.INFO
    )


@app.command(rich_help_panel=MODEL)
def targets(as_json: Json = False) -> None:
    """List the bundled targets: the spectra that `jaxmuscle fit` knows by name.

    Example:

        jaxmuscle targets
    """
    found = describe_targets()
    table = Table(title="Bundled targets", title_justify="left")
    for column in ("name", "provenance", "quantity", "source"):
        table.add_column(column, overflow="fold", no_wrap=column == "name")
    for entry in found:
        first = entry.source.replace("Fig. ", "Fig.\N{NO-BREAK SPACE}").partition(". ")[0]
        table.add_row(entry.name, entry.provenance, entry.quantity, plain(first))
    with reporting(as_json):
        record({"targets": [entry._asdict() for entry in found]})
        out.print(table)


@app.command(rich_help_panel=SIMULATE)
def presets(as_json: Json = False) -> None:
    """List the bundled presets: muscles in a task that `jaxmuscle simulate` knows by name.

    Example:

        jaxmuscle presets
    """
    found = describe_presets()
    table = Table(title="Bundled presets", title_justify="left")
    for column in ("name", "task", "description"):
        table.add_column(column, overflow="fold", no_wrap=column != "description")
    for entry in found:
        table.add_row(entry.name, entry.task, plain(entry.description))
    with reporting(as_json):
        record({"presets": [entry._asdict() for entry in found]})
        out.print(table)


def main() -> None:
    """The command; `jaxmuscle.__main__` calls it and hears signals."""
    os.environ.setdefault("MPLBACKEND", "Agg")
    # XLA's remarks on slow compilation are not for users
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    # Tracing makes many objects that stay: a tenth of a command would go into looking for cycles
    # among them.
    gc.set_threshold(200_000, 10, 10)
    app(prog_name="jaxmuscle")
