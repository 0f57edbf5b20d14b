"""`jaxmuscle fit` with several targets."""

import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jaxmuscle as jm
from jaxmuscle._common.inputs import read_text
from jaxmuscle._common.names import file_names
from jaxmuscle._common.progress import told
from jaxmuscle.reports import REPORT, cohort_report

from .console import (
    BAD_INPUT,
    CONVERGED,
    NOT_CONVERGED,
    REACHED,
    csv_text,
    fit_files,
    out,
    plain_lines,
    record,
    say_failure,
    say_notice,
    say_written,
    writable,
    write_fit,
)
from .options import TaskName

if TYPE_CHECKING:
    from jaxmuscle.fits import CohortResult


FILES = ("cohort.csv", "differences.csv", "cohort.png", "cohort.pdf", "cohort.svg", REPORT)


def fit_together(
    names: list[str],
    read: dict[str, Any],
    task: TaskName | None,
    groups: Path | None,
    folder: Path,
    options: dict[str, Any],
    formats: list[str],
    *,
    force: bool,
) -> int:
    """Fit and write all targets that can be read; the exit code says whether some could not be, or
    did not converge."""
    grouped = {} if groups is None else _groups(groups)
    targets, failed = [], {}
    for name in names:
        try:
            targets.append(jm.load_target(name, **read))
        except (ValueError, OSError) as error:
            failed[name] = str(error)
    starts = {} if options["starts"] is None else {"starts": options["starts"]}
    options = {name: value for name, value in options.items() if name != "starts"} | starts
    if not targets:
        raise ValueError(f"none of the targets can be read: {_reasons(failed)}")
    places = {
        name: folder / place
        for name, place in file_names((t.name for t in targets), taken=FILES).items()
    }
    fits = [f"{place.name}/fit.json" for place in places.values()]
    beside = [
        f"{place.name}/{file}" for place in places.values() for file in (REACHED, *fit_files(place))
    ]
    reads = names if groups is None else [*names, groups]
    writable(folder, "cohort.csv", *fits, beside=[*FILES, *beside], reads=reads, force=force)
    with told(True, f"fitting {len(targets)} targets") as tell:
        found = jm.fit_cohort(
            targets,
            groups=grouped,
            task=None if task is None else jm.model.TASKS[task],
            progress=tell,
            **options,
        )
    failed |= found.failed
    if not found.results:
        raise ValueError(f"none of the targets can be fitted: {_reasons(failed)}")
    cohort = jm.fits.CohortResult(found.results, found.groups, failed)
    _write(cohort, folder, places, formats)
    _show(cohort, folder, places)
    return BAD_INPUT if failed else CONVERGED if cohort.success else NOT_CONVERGED


def _reasons(failed: dict[str, str]) -> str:
    return "; ".join(f"{name}: {why}" for name, why in failed.items())


def _groups(path: Path) -> dict[str, str]:
    """The groups that a CSV with the columns target and group names."""
    text = read_text(path, instead="a CSV with the columns target and group")
    try:
        rows = list(csv.DictReader(io.StringIO(text, newline="")))
    except csv.Error as error:
        raise ValueError(f"{path}: is not CSV: {error}") from None
    if not rows or not {"target", "group"} <= set(rows[0]):
        raise ValueError(
            f"{path}: has no columns target and group; write them as the first line, then a line"
            " for each target"
        )
    found: dict[str, str] = {}
    for number, row in enumerate(rows, start=2):
        name, group = (row["target"] or "").strip(), (row["group"] or "").strip()
        if not name or not group:
            raise ValueError(f"{path}: line {number}: a cell is empty; give a target and its group")
        if found.get(name, group) != group:
            raise ValueError(
                f"{path}: line {number}: {name} is in group {found[name]} already; give each target"
                " one group"
            )
        found[name] = group
    return found


def _write(
    cohort: "CohortResult", folder: Path, places: dict[str, Path], formats: list[str]
) -> None:
    from jaxmuscle._common.figures import remove_figures, write_figure
    from jaxmuscle._common.files import remove, write_text

    remove(folder, "differences.csv")  # an earlier cohort may have had them
    remove_figures(folder, "cohort")
    for name, result in cohort.results.items():
        write_fit(result, places[name], formats)
    write_text(folder / "cohort.csv", csv_text(_columns(cohort.table())))
    differences = [_row(d) for d in cohort.differences()]
    if differences:
        write_text(folder / "differences.csv", csv_text(_columns(differences)))
    if any(row["stderr"] is not None for row in cohort.table()):
        figure = jm.plot.groups(cohort) if len(set(cohort.groups.values())) > 1 else cohort.plot()
        cohort_report(cohort, figure, folder)
        write_figure(figure, folder, "cohort", formats)
    else:
        cohort_report(cohort, None, folder)
    fits = {name: str(places[name] / "fit.json") for name in cohort.results}
    record(
        {
            "success": cohort.success,
            "verdict": cohort.verdict,
            "table": cohort.table(),
            "differences": differences,
            "failed": cohort.failed,
            "fits": fits,
        }
    )


def _row(difference: Any) -> dict[str, Any]:
    row = {
        name: getattr(difference, name)
        for name in ("quantity", "a", "b", "difference", "low", "high", "unit", "basis")
    }
    members = {"members_a": difference.members[0], "members_b": difference.members[1]}
    return row | members | {"left_out": difference.left_out}


def _columns(rows: list[dict[str, Any]]) -> dict[str, list[Any]]:
    return {name: [row[name] for row in rows] for name in rows[0]}


def _show(cohort: "CohortResult", folder: Path, places: dict[str, Path]) -> None:
    out.print(plain_lines(cohort), soft_wrap=True)
    for name, why in cohort.failed.items():
        say_failure(f"{name}: {why}", "not fitted")
    for name in cohort.results:
        if places[name].name != name:
            say_notice(f"{name}: cannot be the name of a folder here; its fit is in {places[name]}")
    say_written(folder, REPORT, "cohort.csv and a folder for each target")
