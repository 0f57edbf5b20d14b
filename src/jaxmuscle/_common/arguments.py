"""Numbers that a caller gives, checked: an error names the argument, its value and what is
right."""

import importlib.util
import inspect
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .text import choices

# of the extras that are asked for before the work begins
EXTRAS = {"posterior": ("blackjax", "arviz_stats"), "dask": ("dask", "distributed")}


def require(holds: bool | np.bool, name: str, value: object, remedy: str) -> None:
    """Raises the `ValueError` of a wrong argument: its name, its value, and what would be right."""
    if not holds:
        raise ValueError(f"{name}={value!r}: {remedy}")


def is_real(value: Any) -> bool:
    """Whether a value is a number, a finite one: no switch, no text, no array of several."""
    if isinstance(value, bool | np.bool_ | str | bytes) or np.ndim(value):
        return False
    try:
        return math.isfinite(value)
    except (TypeError, ValueError, OverflowError):
        return False


def require_extra(extra: str) -> None:
    """Raise an `ImportError` that says what to install, unless the modules of an extra of the
    package are there."""
    missing = [module for module in EXTRAS[extra] if importlib.util.find_spec(module) is None]
    if missing:
        needed = " and ".join(missing).replace("_", "-")
        raise ImportError(f'{extra} needs {needed}: pip install "jaxmuscle[{extra}]"')


def check_options(caller: Callable[..., Any], known: Any, given: Mapping[str, Any]) -> None:
    """Raise `TypeError` for a keyword of a function that is not of the `known` ones, a
    `TypedDict`."""
    own = [
        p.name for p in inspect.signature(caller).parameters.values() if p.default is not p.empty
    ]
    for name in given:
        if name not in known.__optional_keys__:
            ones = choices(name, sorted([*known.__optional_keys__, *own]))
            raise TypeError(f"{caller.__name__}() has no option {name!r}: {ones}")


def positive(name: str, value: Any, *, zero: bool = False) -> None:
    """Raise a `ValueError` unless the value is a finite number above 0, or with `zero` 0 itself."""
    if not (is_real(value) and (value > 0 or (zero and value == 0))):
        raise ValueError(
            f"{name} = {value!r}: give a finite number {'of at least' if zero else 'above'} 0"
        )


def count(name: str, value: Any, least: int, most: int | None = None) -> None:
    """Raise a `ValueError` unless the value is a whole number in the range."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool | np.bool_)
    if (
        not whole
        or operator.index(value) < least
        or (most is not None and operator.index(value) > most)
    ):
        upper = "" if most is None else f" to {most}"
        raise ValueError(
            f"{name} = {value!r}: give a whole number {'from' if upper else 'of at least'}"
            f" {least}{upper}"
        )
