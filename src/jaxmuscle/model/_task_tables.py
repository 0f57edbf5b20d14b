"""Tasks as tables: one holds the muscle, its perturbation, the inputs and the spectrum settings,
every number of them."""

import dataclasses
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import equinox as eqx
import numpy as np

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.documents import converted
from jaxmuscle._common.errors import PresetError
from jaxmuscle._common.text import choices
from jaxmuscle.spectra._settings import SpectrumSettings

from . import (
    _activation,
    _muscle,
    _noise,
    _pink_noise,
    _reflex,
    _resonant_noise,
    _signals,
    _tasks,
    _white_noise,
)
from ._tasks import TASKS, AbstractTask

ABSENT = "none"  # what stands for a part that a task does not have: TOML has no null
LARGEST = 1e50  # of any number, whatever its unit: what is larger overflows in the equations

_BASES = (
    _muscle.AbstractMuscle,
    _muscle.AbstractLaw,
    _noise.AbstractNoise,
    _signals.AbstractSignal,
)
_PARTS = (*_BASES, _activation.Activation, _reflex.Reflex, _signals.Harmonic, AbstractTask)
_KINDS: dict[str, type] = {
    kind.__name__: kind
    for module in (
        _activation,
        _muscle,
        _noise,
        _pink_noise,
        _reflex,
        _resonant_noise,
        _signals,
        _tasks,
        _white_noise,
    )
    for kind in vars(module).values()
    if isinstance(kind, type)
    and issubclass(kind, _PARTS)
    and not kind.__name__.startswith("Abstract")
}
_NAMES = {kind: name for name, kind in TASKS.items()}


def task_to_table(task: AbstractTask) -> dict[str, Any]:
    """A task as nested tables of numbers and strings. Raises `PresetError` for a class that is not
    jaxmuscle's."""
    return (
        {"task": _NAMES[type(task)]} | _fields_to_table(as_numbers(task))
        if type(task) in _NAMES
        else _refuse(task)
    )


def _known() -> dict[str, type]:
    """Classes by name: jaxmuscle's, and those of the user's that have been imported."""
    return {kind.__name__: kind for base in _BASES for kind in _below(base)} | _KINDS


def _below(kind: type) -> list[type]:
    return [each for child in kind.__subclasses__() for each in (child, *_below(child))]


def _refuse(value: Any) -> dict[str, Any]:
    raise PresetError(
        f"{type(value).__name__} is not one of jaxmuscle's own classes and cannot be saved: keep"
        " the code that makes it"
    )


def _fields_to_table(module: eqx.Module) -> dict[str, Any]:
    return {
        field.name: _to_table(getattr(module, field.name)) for field in dataclasses.fields(module)
    }


def _to_table(value: Any) -> Any:
    if value is None:
        return ABSENT
    if isinstance(value, SpectrumSettings):
        return value.to_dict()
    if isinstance(value, eqx.Module):
        if _known().get(type(value).__name__) is not type(value):
            _refuse(value)
        return {"type": type(value).__name__} | _fields_to_table(value)
    if isinstance(value, np.ndarray | np.floating):
        return value.tolist()
    return [_to_table(each) for each in value] if isinstance(value, tuple) else value


def task_from_table(table: dict[str, Any]) -> AbstractTask:
    """The task of a table. Raises `PresetError` naming the key that is missing, unknown or wrong:
    nothing gets a default."""
    table = dict(table)
    name = table.pop("task", None)
    if not isinstance(name, str) or name not in TASKS:
        raise PresetError(f"task = {name!r}: {choices(str(name), TASKS)}")
    return _build(TASKS[name], table, "task")


def _build(kind: type, table: dict[str, Any], where: str) -> Any:
    fields = {field.name: field for field in dataclasses.fields(kind)}
    for key in table:
        if key not in fields:
            raise PresetError(f"unknown key {where}.{key}: {choices(key, fields)}")
    values = {}
    for name, field in fields.items():
        if name not in table:
            raise PresetError(
                f"{where} has no key {name!r}: give it; a number that is not there gets no default"
            )
        values[name] = _value(kind, field, table[name], f"{where}.{name}")
    if kind in (
        _white_noise.OrnsteinUhlenbeckNoise,
        _resonant_noise.ResonantNoise,
        _pink_noise.PinkNoise,
    ):
        values["std"] = values.pop("amplitude")
    try:
        return kind(**values)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise PresetError(f"{where}: {error}") from None


def _value(kind: type, field: Any, value: Any, where: str) -> Any:
    """That of a field: a part, several, numbers, a switch or a word, as the class declares it."""
    options = (
        get_args(field.type) if get_origin(field.type) in (Union, UnionType) else (field.type,)
    )
    if NoneType in options and value == ABSENT:
        return None
    meant = options[0]
    if meant is SpectrumSettings:
        return _settings(converted(value, dict, where, PresetError), where)
    if get_origin(meant) is tuple:
        inner = get_args(meant)[0]
        entries = [
            (each, f"{where}[{i}]")
            for i, each in enumerate(converted(value, list, where, PresetError))
        ]
        return tuple(
            _part(inner, each, at) if _is_part(inner) else _number(each, at) for each, at in entries
        )
    if _is_part(meant):
        return _part(meant, value, where)
    # one for each input, or what a user's class has
    several = "converter" in field.metadata or kind not in _KINDS.values()
    if hasattr(meant, "dims") and (float not in options or (several and isinstance(value, list))):
        return _numbers(meant, value, where)
    return (
        _number(value, where) if float in options else converted(value, meant, where, PresetError)
    )


def _settings(table: dict[str, Any], where: str) -> SpectrumSettings:
    try:
        return SpectrumSettings.from_dict(table, whole=True)
    except ValueError as error:
        raise PresetError(f"{where}: {error}") from None


def _is_part(kind: Any) -> bool:
    return isinstance(kind, type) and issubclass(kind, eqx.Module)


def _part(kind: type, value: Any, where: str) -> Any:
    table = converted(value, dict, where, PresetError)
    name, known = table.get("type"), _known()
    if not isinstance(name, str) or name not in known:
        raise PresetError(
            f"{where}.type = {name!r}: {choices(str(name), known)}; a class of your own must be"
            " imported first"
        )
    if not issubclass(known[name], kind):
        raise PresetError(
            f"{where}.type = {name!r} is of the wrong kind: give"
            f" {kind.__name__.removeprefix('Abstract')}"
        )
    return _build(known[name], {k: v for k, v in table.items() if k != "type"}, where)


def _number(value: Any, where: str) -> float:
    number = converted(value, float, where, PresetError)
    if abs(number) > LARGEST:
        raise PresetError(
            f"{where} = {number:g} is out of range: numbers are below {LARGEST:g}, in SI units"
        )
    return number


def _numbers(kind: Any, value: Any, where: str) -> np.ndarray:
    """An array of as many dimensions as the field has."""
    rows = converted(value, list, where, PresetError)
    nested = any(isinstance(row, list) for row in rows)
    rows = converted(rows, list[list[float]] if nested else list[float], where, PresetError)
    if nested and len({len(row) for row in rows}) > 1:
        raise PresetError(f"{where}: its rows differ in length")
    array = np.array(rows, dtype=float)
    if kind.index_variadic is None and array.ndim != len(kind.dims):
        raise PresetError(f"{where} has {array.ndim} dimensions, {len(kind.dims)} belong there")
    if not np.all(np.abs(array) <= LARGEST):
        raise PresetError(
            f"{where} holds a number out of range: numbers are below {LARGEST:g}, in SI units"
        )
    return array
