"""Preset files: saved tasks, scaled to the mean force that the file states."""

import math
import os
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import tomli_w

from jaxmuscle._common.bundled import bundled_text, list_presets
from jaxmuscle._common.documents import Table, checked, parsed, says
from jaxmuscle._common.errors import PresetError
from jaxmuscle._common.files import expanded, write_text
from jaxmuscle._common.inputs import read_text
from jaxmuscle._common.text import choices
from jaxmuscle._common.units import NEWTONS
from jaxmuscle.model._task_tables import task_from_table, task_to_table
from jaxmuscle.model._tasks import AbstractTask

FORMAT = 2  # of a preset
FIT_FORMAT = 6  # of a fit.json


def load_preset(name_or_path: str | Path) -> AbstractTask:
    """The task of a bundled preset, of a preset file (.toml), or of a `fit.json`: `name_or_path`.

        task = jm.load_preset("zagrodny-slifkin")

    A preset file may state the mean force of a person, above its `[task_table]`:

        mean = 40.5
        unit = "N"          # or "mN", "kN", "kgf", "gf", "lbf"

    Then the task is scaled to that force by `task.at_force`: P_w and F_ext, masses, stiffness and
    damping are multiplied by one number. Proportional power and the coefficient of variation stay.
    A fit that starts from the task has its priors centred on the new values. A file of
    `task.save` and a `fit.json` hold the final numbers and state no mean.

    **Raises:** `PresetError` naming the file or the nearest bundled name, and what is wrong: also a
    unit that is not one of these, a mean of zero or of the other sign, and a task whose output is
    not a force.
    """
    if not isinstance(name_or_path, str | os.PathLike):
        raise PresetError(f"preset {name_or_path!r}: give the name of a bundled preset or a path")
    name = os.fspath(name_or_path)
    if name in list_presets():
        return _task_of(_checked(bundled_text(name, "presets"), name, "TOML"), name)
    path = expanded(name)
    if not path.suffix and not path.exists():
        raise PresetError(
            f"unknown preset {name!r}: {choices(name, list_presets())}; or give a path"
        )
    kind = "JSON" if path.suffix.lower() == ".json" else "TOML"
    text = read_text(path, PresetError, instead="a preset (.toml) or a fit.json")
    return _task_of(_checked(text, str(path), kind), str(path))


class PresetFile(Table, kw_only=True):
    """A saved task."""

    format: Annotated[Literal[2], says("Version of the format", missing="format 2")] = FORMAT
    description: Annotated[str, says("What the task is", missing="not described")] = ""
    mean: Annotated[
        Any,
        says(
            "Mean force to which the task is scaled when it is loaded",
            missing="not scaled; an error beside `unit`",
            kind="number, not 0",
        ),
    ] = None
    unit: Annotated[
        Any,
        says(
            "Unit of `mean`: N, mN, kN, kgf, gf or lbf",
            missing="not scaled; an error beside `mean`",
            kind="text",
        ),
    ] = None
    fit: Annotated[
        Any, says("How it was fitted: a note for the reader, not used", missing="no note")
    ] = None
    task_table: Annotated[dict[str, Any], says("The task, every number of it")]


class _InFit(NamedTuple):
    """What a `fit.json` says about its task; the rest is read by `load_result`."""

    task_table: dict[str, Any]
    mean: None = None
    unit: None = None


def _checked(text: str, file: str, kind: str) -> PresetFile | _InFit:
    """What a preset file or a fit.json says, its keys and types checked, the task table not yet."""
    table = parsed(text, file, kind, PresetError)
    if not isinstance(table.get("task_table"), dict):
        several = " It is the fit of several targets: give that of one." if "parts" in table else ""
        raise PresetError(f"{file}: has no [task_table]: is it a preset or a fit.json?{several}")
    if kind == "JSON" and "success" in table:  # a fit.json leaves nothing out
        formats = table.get("format")
        if type(formats) is not int or formats != FIT_FORMAT:
            raise PresetError(
                f"{file}: format = {formats!r}: is not a fit.json of format {FIT_FORMAT}"
            )
        return _InFit(table["task_table"])
    return checked(table, PresetFile, file, PresetError)


def _task_of(said: PresetFile | _InFit, file: str) -> AbstractTask:
    try:
        task = task_from_table(said.task_table)
        return (
            task
            if said.mean is None and said.unit is None
            else _carried(task, said.mean, said.unit)
        )
    except ValueError as error:
        raise PresetError(f"{file}: {error}") from None


def _carried(task: AbstractTask, mean: Any, unit: Any) -> AbstractTask:
    """The task at the mean force that a file states."""
    if mean is None or unit is None:
        missing = "mean" if mean is None else "unit"
        raise PresetError(
            f'{missing} is missing: give both, as in mean = 40.5 and unit = "N", or neither'
        )
    if unit not in list(NEWTONS):
        raise PresetError(
            f"unit = {unit!r}: the parameters of a task are in newtons; give the mean force in "
            f"{', '.join(NEWTONS)}, or leave mean and unit out"
        )
    if isinstance(mean, bool) or not isinstance(mean, int | float) or not math.isfinite(mean):
        raise PresetError(f"mean = {mean!r}: give the mean force in {unit} as one number")
    try:
        return task.at_force(NEWTONS[unit] * mean)
    except ValueError as error:
        raise PresetError(f"mean = {mean} {unit}: {error}") from None


def save_preset(
    path: str | Path, task: AbstractTask, description: str, fit: dict[str, Any] | None
) -> None:
    """See `AbstractTask.save`."""
    table: dict[str, Any] = {"format": FORMAT, "description": description} | (
        {"fit": fit} if fit else {}
    )
    write_text(path, tomli_w.dumps(table | {"task_table": task_to_table(task)}))
