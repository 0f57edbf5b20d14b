"""Tasks as tables: one holds the muscle, its perturbation, the inputs and the spectrum settings."""

import dataclasses
from typing import Any, Literal, get_args, get_origin

import equinox as eqx
import numpy as np

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.errors import PresetError
from jaxmuscle._common.text import choices
from jaxmuscle.spectra._settings import SpectrumSettings

from . import _activation, _muscle, _noise, _pink_noise, _resonant_noise, _signals, _tasks, _white_noise
from ._tasks import TASKS, AbstractTask

_KINDS: dict[str, type] = {
    kind.__name__: kind
    for module in (_activation, _muscle, _noise, _pink_noise, _resonant_noise, _signals, _tasks, _white_noise)
    for kind in vars(module).values()
    if isinstance(kind, type) and issubclass(kind, eqx.Module) and not kind.__name__.startswith("Abstract")
}
_BASES = (_muscle.AbstractMuscle, _muscle.AbstractLaw, _noise.AbstractNoise, _signals.AbstractSignal)
_NAMES = {kind: name for name, kind in TASKS.items()}


def task_to_table(task: AbstractTask) -> dict[str, Any]:
    """A task as nested tables of numbers and strings. Raises `PresetError` for a class that is not jaxmuscle's."""
    return {"task": _NAMES[type(task)]} | _fields_to_table(as_numbers(task)) if type(task) in _NAMES else _refuse(task)


def _known() -> dict[str, type]:
    """Classes by name: jaxmuscle's, and those of the user's that have been imported."""
    return {kind.__name__: kind for base in _BASES for kind in _below(base)} | _KINDS


def _below(kind: type) -> list[type]:
    return [each for child in kind.__subclasses__() for each in (child, *_below(child))]


def _refuse(value: Any) -> dict[str, Any]:
    raise PresetError(
        f"{type(value).__name__} is not one of jaxmuscle's own classes and cannot be saved: keep the code that makes it"
    )


def _fields_to_table(module: eqx.Module) -> dict[str, Any]:
    values = {field.name: getattr(module, field.name) for field in dataclasses.fields(module)}
    return {name: _to_table(value) for name, value in values.items() if value is not None}


def _to_table(value: Any) -> Any:
    if isinstance(value, SpectrumSettings):
        return value.to_dict()
    if isinstance(value, eqx.Module):
        if _known().get(type(value).__name__) is not type(value):
            _refuse(value)
        return {"type": type(value).__name__} | _fields_to_table(value)
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_to_table(each) for each in value] if isinstance(value, tuple) else value


def task_from_table(table: dict[str, Any]) -> AbstractTask:
    """The task of a table. Raises `PresetError` for one that is not whole."""
    table = dict(table)
    name = table.pop("task", None)
    if name not in TASKS:
        raise PresetError(f"task = {name!r}: {choices(str(name), TASKS)}")
    return _build(TASKS[name], table, "task")


def _build(kind: type, table: dict[str, Any], where: str) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    values = {}
    for key, value in table.items():
        if key not in fields:
            raise PresetError(f"unknown key {where}.{key}: {choices(key, fields)}")
        values[key] = _from_table(key, value, f"{where}.{key}")
        if not _fits(fields[key].type, values[key]):
            raise PresetError(f"{where}.{key} = {value!r} is of the wrong kind")
    if kind in (_white_noise.OrnsteinUhlenbeckNoise, _resonant_noise.ResonantNoise, _pink_noise.PinkNoise):
        values["std"] = values.pop("amplitude", None)
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise PresetError(f"{where}: {error}") from None


def _fits(kind: Any, value: Any) -> bool:
    """Whether a value can be that of a field: a module where one is meant, else a switch, a word, or numbers."""
    if type(None) in get_args(kind):
        kind = get_args(kind)[0]
    if isinstance(kind, type) and issubclass(kind, eqx.Module):
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return isinstance(value, kind) or (kind is _signals.AbstractSignal and number)
    if kind is bool or isinstance(value, bool):
        return kind is bool and isinstance(value, bool)
    return isinstance(value, str) == (get_origin(kind) is Literal) and not isinstance(value, eqx.Module)


def _from_table(key: str, value: Any, where: str) -> Any:
    if key == "settings" and isinstance(value, dict):
        return SpectrumSettings.from_dict(value)
    if isinstance(value, dict):
        kind = value.get("type")
        known = _known()
        if kind not in known:
            raise PresetError(
                f"{where}.type = {kind!r}: {choices(str(kind), known)}; a class of your own must be imported first"
            )
        return _build(known[kind], {k: v for k, v in value.items() if k != "type"}, where)
    if isinstance(value, list) and any(isinstance(each, dict) for each in value):
        return tuple(_from_table(key, each, f"{where}[{i}]") for i, each in enumerate(value))
    if isinstance(value, list):
        return tuple(value) if key == "initial" else np.array(value, dtype=float)
    return value
