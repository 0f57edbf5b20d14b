"""Preset files: saved tasks, carried to the mean force that the file states."""

import json
import math
import tomllib
from pathlib import Path
from typing import Any

import tomli_w

from jaxmuscle._common.bundled import bundled_text, list_presets
from jaxmuscle._common.errors import PresetError
from jaxmuscle._common.files import write_text
from jaxmuscle._common.text import choices
from jaxmuscle._common.units import NEWTONS
from jaxmuscle.model._task_tables import task_from_table, task_to_table
from jaxmuscle.model._tasks import AbstractTask

from ._scaling import at_force


def load_preset(name_or_path: str | Path) -> AbstractTask:
    """The task of a bundled preset, of a preset file (.toml), or of a `fit.json`: `name_or_path`.

        task = jm.load_preset("zagrodny-slifkin")

    A preset file may state the mean force of a person, above its `[task_table]`:

        mean = 40.5
        unit = "N"          # or "mN", "kN"

    Then the task is carried to that force by `at_force`: P_w and F_ext, masses, stiffness and damping are multiplied by one
    number. The spectrum and the coefficient of variation stay. A fit that starts from the task has its priors in ratio to
    the new values. A file of `save_preset` and a `fit.json` hold the final numbers and state no mean.

    **Raises:** `PresetError` naming the file or the nearest bundled name, and what is wrong: also a unit that is not one of
    the three, a mean of zero or of the other sign, and a task whose output is not a force.
    """
    name = str(name_or_path)
    path = Path(name).expanduser()
    if name in list_presets():
        table = tomllib.loads(bundled_text(name, "presets"))
    elif not path.suffix and not path.exists():
        raise PresetError(f"unknown preset {name!r}: {choices(name, list_presets())}; or give a path")
    else:
        table = _read(path)
    if not isinstance(table.get("task_table"), dict):
        raise PresetError(f"{path}: has no [task_table]: is it a preset or a fit.json?")
    try:
        task = task_from_table(table["task_table"])
        stated = {key: table[key] for key in ("mean", "unit") if key in table}
        return _carried(task, **stated) if stated else task
    except ValueError as error:
        raise PresetError(f"{path}: {error}") from None


def _carried(task: AbstractTask, mean: Any = None, unit: Any = None) -> AbstractTask:
    """The task at the mean force that a file states."""
    if mean is None or unit is None:
        missing = "mean" if mean is None else "unit"
        raise PresetError(f'{missing} is missing: give both, as in mean = 40.5 and unit = "N", or neither')
    if unit not in list(NEWTONS):
        raise PresetError(f"unit = {unit!r}: the parameters of a task are in newtons; give the mean force in "
                          f"{', '.join(NEWTONS)}, or leave mean and unit out")  # fmt: skip
    if isinstance(mean, bool) or not isinstance(mean, int | float) or not math.isfinite(mean):
        raise PresetError(f"mean = {mean!r}: give the mean force in {unit} as one number")
    try:
        return at_force(task, NEWTONS[unit] * mean)
    except ValueError as error:
        raise PresetError(f"mean = {mean} {unit}: {error}") from None


def _read(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        table = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except OSError as error:
        raise PresetError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise PresetError(f"{path}: is not valid {'JSON' if path.suffix == '.json' else 'TOML'}: {error}") from None
    if not isinstance(table, dict):
        raise PresetError(f"{path}: is not a preset or a fit.json: it holds no table")
    return table


def save_preset(path: str | Path, task: AbstractTask, *, description: str = "", fit: dict[str, Any] | None = None) -> None:
    """Write a task to `path` as a preset: TOML with a description, the fit that made it and the task table.

        jm.save_preset("mine.toml", jm.Isometric(k_w=4e5))
        task = jm.load_preset("mine.toml")

    `load_preset` reads it back equal.
    """
    table: dict[str, Any] = {"description": description} | ({"fit": fit} if fit else {})
    write_text(path, tomli_w.dumps(table | {"task_table": task_to_table(task)}))
