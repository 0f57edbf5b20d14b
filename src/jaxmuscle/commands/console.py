"""What commands share: the terminal, exit codes, errors in one line, files that are written."""

import contextlib
import csv
import io
import itertools
import json
import os
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console

import jaxmuscle as jm
from jaxmuscle._common.files import expanded
from jaxmuscle._common.names import file_names
from jaxmuscle._common.progress import told
from jaxmuscle._common.tables import harmless

from .options import SAME_NAME, Observed, TaskName, fixed_values, names_in
from .signals import BAD_INPUT, interrupted, stays

if TYPE_CHECKING:
    from jaxmuscle.fits import FitInterrupted, FitResult


CONVERGED, NOT_CONVERGED = 0, 1
REACHED = "reached.toml"
VERDICT = "MODEL"

out = Console(soft_wrap=False, highlight=False)
# a message is one line of a log
err = Console(stderr=True, soft_wrap=not sys.stderr.isatty(), highlight=False)


def say_notice(text: object) -> None:
    """Say what people should know beside the result."""
    err.print(f"[yellow]notice:[/] {plain(text)}")


def say_failure(text: object, what: str = "failed") -> None:
    """Say in red what failed, and why."""
    err.print(f"[bold red]{what}:[/] {plain(text)}")


def task_of(preset: str, task: TaskName | None, observe: Observed | None = None) -> Any:
    """The task of a preset, its muscle put into another task if one is named; what it observes, if
    that is."""
    model = jm.load_preset(preset)
    if task is not None and type(model) is not jm.model.TASKS[task]:
        model = model.as_task(jm.model.TASKS[task])
    if observe is None:
        return model
    if not isinstance(model, jm.PrescribedForce):
        raise ValueError(
            f"--observe {observe}: the output of {type(model).__name__} is no motion; add --task"
            " prescribed-force"
        )
    return model.with_parts(observe=str(observe))


def aim_of(name: str, task: TaskName | None, read: dict[str, Any]) -> tuple[Any, Any]:
    """The target of that name or file, its notices said, and the task to fit to it: by default what
    the target measured.

    A recording's steady part is found by itself.
    """
    recorded = jm.data.kind_of_file(name) == "recording"
    return aimed(jm.data.as_target(name, **({} if recorded else read)), task)


def aimed(target: Any, task: TaskName | None) -> tuple[Any, Any]:
    """The target, its notices said, and the task to fit to it."""
    for notice in target.notices:
        say_notice(notice)
    return target, target.task(None if task is None else jm.model.TASKS[task])


@contextlib.contextmanager
def reporting(as_json: bool = False) -> Iterator[None]:
    """Turn a user's mistake into one line and exit code 2, a numerical failure into 1, an
    interruption into 130 (or 143).

    With `as_json` the text for people stays away from stdout, which is for `record` alone.
    """
    from jaxmuscle._common.errors import SimulationError, WorkersLostError

    out.quiet = as_json
    try:
        yield
    except (ValueError, OSError, ImportError) as error:
        say_failure(_words(error), "error")
        raise typer.Exit(BAD_INPUT) from None
    except (SimulationError, WorkersLostError) as error:
        say_failure(error)
        raise typer.Exit(NOT_CONVERGED) from None
    except KeyboardInterrupt:
        err.print("interrupted")
        raise typer.Exit(interrupted()) from None
    finally:
        out.quiet = False


def record(found: Any) -> None:
    """With --json print what a command found as one JSON object, on one line; a path stands for
    what was written there."""
    if out.quiet:
        from jaxmuscle._common.files import nulled

        table = (
            json.loads(found.read_text(encoding="utf-8"))
            if isinstance(found, Path)
            else nulled(found)
        )
        print(json.dumps(table, allow_nan=False), flush=True)


def _words(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    # A cell of a damaged file may be as long as the file.
    return _as_options(re.sub(r"(?s)(\S{200})\S{200,}", r"\1...", str(error)))


def _as_options(message: str) -> str:
    """A message as it reads at the command line: the arguments `rate` and `rate=20` are the options
    --rate and --rate 20."""
    names = "|".join(SAME_NAME)
    message = re.sub(rf"(?<![\w.-])({names})=(?=\S)", lambda found: f"`{found[1]}` ", message)
    message = message.replace("`force`", "`force_column`")  # --force overwrites
    return re.sub(rf"`({names})`", lambda found: "--" + found[1].replace("_", "-"), message)


def plain(text: object) -> str:
    """Text without markup, on one line: each control character and half character as its escape,
    since a file may be called anything."""
    whole = (
        str(text).encode("utf-8", "backslashreplace").decode().replace("\N{NO-BREAK SPACE}", " ")
    )
    shown = "".join(
        sign if sign.isprintable() else sign.encode("unicode_escape").decode() for sign in whole
    )
    return shown.replace("[", r"\[")


def plain_lines(text: object) -> str:
    """`plain` text of several lines."""
    return "\n".join(map(plain, str(text).split("\n")))


def say_written(folder: Path, *names: str) -> None:
    """Say which files a command has put into its folder."""
    out.print(f"Written: {plain(folder)}/{', '.join(map(plain, names))}", soft_wrap=True)


def show(result: object, *, success: bool) -> None:
    """A result as it prints itself; the line of its verdict, else its first one, in colour."""
    lines = str(result).splitlines()
    verdict = next((i for i, line in enumerate(lines) if line.startswith(VERDICT)), 0)
    for i, line in enumerate(lines):
        colour = f"[{'green' if success else 'bold red'}]" * (i == verdict)
        out.print(f"{colour}{plain(line)}{'[/]' * bool(colour)}", soft_wrap=True)


SPECTRUM = "spectrum.csv"  # of several commands


def writable(
    folder: Path,
    *results: str,
    beside: Iterable[str],
    figures: Iterable[str] = (),
    reads: Iterable[str | Path],
    force: bool,
) -> None:
    """Fail before the long work, not after it: also where one of the results is there already,
    unless it may go.

    `beside`: all other files that the command replaces or removes; `figures`: those in any format,
    by their names. What it `reads` is none of these.
    """
    from jaxmuscle._common.figures import figure_files

    for path in (folder, *folder.parents):
        if path.is_symlink() and not path.exists():
            raise ValueError(
                f"--out {folder}: {path} is a link to {path.readlink()}, which is not there; make"
                " that folder, or give another"
            )
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"--out {folder}: is a file; give the name of a folder")
    spare(reads, (folder / name for name in (*results, *beside, *figure_files(*figures))))
    absent(*(folder / name for name in results), force=force)
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(
            f"--out {folder}: you may not write there; give another folder, or change its"
            " permissions"
        )


def spare(reads: Iterable[str | Path], paths: Iterable[Path]) -> None:
    """Raise a `ValueError` if a path that is to be replaced is one of the files that are read, or a
    folder around one."""
    replaced = {_identity(path) for path in paths} - {None}
    for name in reads:
        given = Path(os.path.realpath(expanded(name)))
        if given.exists() and not replaced.isdisjoint(map(_identity, (given, *given.parents))):
            raise ValueError(
                f"the result would replace {name}, an input: write it to another place"
            )


def _identity(path: Path) -> tuple[int, int] | None:
    """What tells a file from all others, by whatever name; None where there is none."""
    with contextlib.suppress(OSError, ValueError):
        found = path.stat()
        return found.st_dev, found.st_ino
    return None


def absent(*results: Path, force: bool) -> None:
    """Raise a `ValueError` for a result that is there already, unless it may be overwritten."""
    for path in results:
        if path.exists() and not force:
            raise ValueError(
                f"{path}: is there already; overwrite it with --force, or give another name"
            )


def keep_other_spectrum(folder: Path, columns: Iterable[str]) -> None:
    """Give the spectrum.csv of another command, which has other columns, a name of its own, and say
    so."""
    path = folder / SPECTRUM
    with contextlib.suppress(FileNotFoundError):
        with path.open(encoding="utf-8", errors="replace") as file:
            if file.readline().strip() == ",".join(columns):
                return
        numbers = itertools.chain([""], (f"-{n}" for n in itertools.count(2)))
        kept = next(
            name for n in numbers if not (name := folder / f"spectrum-other{n}.csv").exists()
        )
        path.rename(kept)
        say_notice(f"{path} was there, from another command. It is kept as {kept}.")


def csv_text(columns: dict[str, Any]) -> str:
    """Columns as CSV; numbers with eight digits, None as an empty field."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(
        [_field(value) for value in row] for row in zip(*columns.values(), strict=True)
    )
    return text.getvalue()


def _field(value: Any) -> str:
    if value is None or isinstance(value, str | bool):
        return "" if value is None else harmless(str(value))
    return f"{value:.8g}"


def write_reached(stop: "FitInterrupted", folder: Path) -> None:
    """Where an interrupted fit stood, a preset: to report the fit may take longer than a signal can
    wait."""
    stop.tasks[0].save(folder / REACHED, description="where a fit stood when it was interrupted")
    stays(f"the best parameters so far are in {folder / REACHED}")


def fit_unless_taken_up(folder: Path, target: str) -> list[str]:
    """fit.json as a result of `fit_into`; nothing where the target is that file, which then
    stays."""
    there = _identity(folder / "fit.json")
    return [] if there is not None and there == _identity(Path(target)) else ["fit.json"]


def fit_into(
    folder: Path, target: str, read: dict[str, Any], asked: dict[str, Any], seed: int
) -> "FitResult":
    """The fit of that file, or of a target that is fitted now, which is saved as fit.json. Exit
    code 1 if it failed."""
    from jaxmuscle._common.files import remove

    try:
        result = _fitted(target, read, asked, seed)
    except jm.fits.FitInterrupted as stop:
        write_reached(stop, folder)
        stop.result.save(folder / "fit.json")
        remove(folder, REACHED)
        err.print(f"the fit is not finished; what it had reached is in {plain(folder)}/fit.json")
        raise
    if not result.success:
        say_failure(f"the fit did not converge: {result.message}")
        raise typer.Exit(NOT_CONVERGED)
    if fit_unless_taken_up(folder, target):
        result.save(folder / "fit.json")
    remove(folder, REACHED)
    return result


def _fitted(target: str, read: dict[str, Any], asked: dict[str, Any], seed: int) -> "FitResult":
    path = Path(target)
    if path.suffix == ".json" and path.is_file() and b'"task_table"' in path.read_bytes():
        if given := [f"--{name}" for name, value in (asked | read).items() if value is not None]:
            raise ValueError(
                f"{target}: is a fit; its task, parameters and target stay as they are, so leave"
                f" out {', '.join(given)}"
            )
        return jm.load_result(path)
    loaded, model = aim_of(target, asked["task"], read)
    if loaded.segments is None and loaded.sigma is None:
        raise ValueError(
            f"{target}: does not say how much its bins scatter: give --segments, the number of"
            " Welch segments that were averaged, or a third column sigma"
        )
    names = names_in(asked["free"])
    with told(True, f"fitting {loaded.name}") as tell:
        return jm.fit(
            model,
            loaded,
            free=names,
            fix=fixed_values(asked["fix"]),
            noise=asked["noise"],
            key=seed,
            progress=tell,
        )


def write_fit(
    result: "FitResult", folder: Path, formats: Iterable[str] = (), *, report: bool = False
) -> list[str]:
    """fit.json, fit in each of the formats, tables, a report if it is wanted, each whole or not
    there; their names."""
    from jaxmuscle._common.figures import write_figure
    from jaxmuscle._common.files import remove, write_text
    from jaxmuscle.reports import REPORT, fit_report

    tables = fit_tables(result)
    keep_other_spectrum(folder, next(iter(result.parts.values())).columns())
    remove(folder, *fit_files(folder, result.parts))
    result.save(folder / "fit.json")
    remove(folder, REACHED)
    for name, columns in tables.items():
        if columns:
            write_text(folder / name, csv_text(columns))
    written = ["fit.json", *(name for name, columns in tables.items() if columns)]
    if formats:
        figure = result.plot()
        if report:
            fit_report(result, figure, folder)
            written.append(REPORT)
        written[1:1] = write_figure(figure, folder, "fit", formats)
    return written


def fit_files(folder: Path, parts: Iterable[str] = ()) -> list[str]:
    """The files, beside fit.json, of a fit of these targets (where they are several) and of an
    earlier one."""
    from jaxmuscle._common.figures import figure_files
    from jaxmuscle.reports import REPORT

    called = ["", *(f"-{name}" for name in file_names(parts).values())]
    called += [f"-{name}" for name in parts_of(folder / "fit.json")]
    tables = [f"{table}{which}.csv" for which in called for table in ("spectrum", "stiffness")]
    return [*tables, REPORT, *figure_files("fit")]


def parts_of(path: Path) -> list[str]:
    """What the targets of an earlier result are called in the names of its files; nothing where
    there is none."""
    from jaxmuscle._common.documents import parsed
    from jaxmuscle._common.inputs import read_text

    try:
        return list(file_names(parsed(read_text(path), str(path), "JSON")["parts"]).values())
    except (ValueError, KeyError, TypeError):
        return []


def fit_tables(result: "FitResult") -> dict[str, dict[str, Any]]:
    """The tables of a fit by file, those without rows being empty: spectrum.csv, or
    spectrum-TARGET.csv of several."""
    tables: dict[str, dict[str, Any]] = {"spectrum.csv": {}, "stiffness.csv": {}}
    called = file_names(result.parts)
    for name, part in result.parts.items():
        which = f"-{called[name]}" * (len(result.parts) > 1)
        tables[f"spectrum{which}.csv"] = part.columns() if part.fitted.size else {}
        tables[f"stiffness{which}.csv"] = part.stiffness_columns()
    return tables
