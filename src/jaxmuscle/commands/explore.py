"""`jaxmuscle explore`."""

import tempfile
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm
from jaxmuscle import explorer

from .console import absent, aim_of, out, plain, record, reporting, spare, task_of
from .options import Force, Json, Segments, TargetTask, TaskName


def explore(
    what: Annotated[
        str | None,
        typer.Argument(
            metavar="[TARGET]",
            help=(
                "What to begin with: a spectrum, a recording, a fit.json or a preset; by default"
                " the usual muscle."
            ),
        ),
    ] = None,
    task: TargetTask = None,
    segments: Segments = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="Write the page to this .html; by default to a temporary one.",
        ),
    ] = None,
    force: Force = False,
    browser: Annotated[
        bool,
        typer.Option("--open/--no-open", help="Open the page in the browser, or only write it."),
    ] = True,
    as_json: Json = False,
) -> None:
    """Explore the model with sliders in the browser.

    Writes one HTML file that holds everything and needs no network. You can send it to others.

    Examples:

        jaxmuscle explore vastus-lateralis-26mvc

        jaxmuscle explore out/fit/fit.json --out fit.html --no-open
    """
    with reporting(as_json):
        from jaxmuscle._common.files import write_text

        if output is not None:
            spare([what] if what else [], [output])
        model, target = _content(what, task, segments)
        text = explorer.page(model, target)
        path = _place(output, force=force)
        write_text(path, text)
        record({"page": str(path)})
        out.print(f"Written: {plain(path)}", soft_wrap=True)
        if browser and not webbrowser.open(path.resolve().as_uri()):
            out.print("No browser was found. Open the file yourself.")


def _content(what: str | None, task: TaskName | None, segments: int | None) -> tuple[Any, Any]:
    """The task to begin with, and the target over it if there is one."""
    if what is None:
        return (None if task is None else jm.model.TASKS[task]()), None
    table = {} if what in jm.list_presets() else _table(Path(what).expanduser())
    if "starts" in table and task is None:
        result = jm.load_result(Path(what).expanduser())
        if len(result.targets) > 1:
            raise ValueError(
                f"{what} is a fit of several targets, and the page shows one: give the fit.json of"
                " one of them"
            )
        return result.task, result.target
    if what in jm.list_presets() or "task_table" in table:
        return task_of(what, task), None
    target, model = aim_of(what, task, {"segments": segments})
    return model, target


def _table(path: Path) -> dict[str, Any]:
    """What a JSON or TOML file holds, to see if it is a preset or a fit; nothing of what is not one
    of these."""
    if path.suffix not in (".json", ".toml") or not path.is_file():
        return {}
    from jaxmuscle._common.documents import parsed
    from jaxmuscle._common.inputs import read_text

    return parsed(read_text(path), str(path), path.suffix[1:].upper())


def _place(output: Path | None, *, force: bool) -> Path:
    """Where the page is written: as asked, else a file of its own in the folder for temporary
    files."""
    if output is None:
        return Path(tempfile.mkdtemp(prefix="jaxmuscle-")) / "explorer.html"
    if output.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"--out {output}: the page is one file; give a name that ends in .html")
    absent(output, force=force)
    output.parent.mkdir(parents=True, exist_ok=True)
    return output
