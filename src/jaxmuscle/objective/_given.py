"""What a caller gives a fit by the names of parameters, and as further data, checked."""

import math
from collections.abc import Iterable, Mapping
from typing import Any

from jaxmuscle._common.arguments import is_real


def check_named(free: Any, fix: Any, bounds: Any, priors: Any) -> None:
    """Raise a `ValueError` naming the argument and the parameter whose value is none."""
    if free is not None and (isinstance(free, str) or not isinstance(free, Iterable)):
        raise ValueError(f"free = {free!r}: give a list of names, as ['k_w']")
    if isinstance(free, list | tuple) and not all(isinstance(name, str) for name in free):
        raise ValueError(f"free = {free!r}: names are texts")
    for name, value in _entries("fix", fix):
        if not is_real(value):
            raise ValueError(f"fix[{name!r}] = {value!r}: give a finite number")
    for name, pair in _entries("bounds", bounds):
        low, high = pair if isinstance(pair, tuple | list) and len(pair) == 2 else (None, None)
        ends = (is_real(low) or low == -math.inf) and (is_real(high) or high == math.inf)
        if low is None or high is None or not ends or not low < high:
            raise ValueError(f"bounds[{name!r}] = {pair!r}: give two numbers, the lower first")
    for name, sd in _entries("priors", priors):
        if sd is not None and not (is_real(sd) and sd > 0):
            raise ValueError(
                f"priors[{name!r}] = {sd!r}: give a standard deviation above 0, or None for a flat"
                " prior"
            )


def check_data(coefficient_of_variation: Any, mean_force: Any) -> None:
    """Raise a `ValueError` for what does not say whether and which further data there are."""
    if not isinstance(coefficient_of_variation, bool):
        raise ValueError(
            f"coefficient_of_variation = {coefficient_of_variation!r}: give True or False, whether"
            " it is data"
        )
    if mean_force is None or mean_force is False:
        return
    pair = (
        mean_force
        if isinstance(mean_force, tuple | list) and len(mean_force) == 2
        else (math.nan, math.nan)
    )
    if not (is_real(pair[0]) and is_real(pair[1]) and pair[1] > 0):
        raise ValueError(
            f"mean_force = {mean_force!r}: give the mean and its standard error [N], as (20.0,"
            " 0.4), or False"
        )


def _entries(argument: str, given: Any) -> Iterable[tuple[str, Any]]:
    if given is None:
        return ()
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise ValueError(f"{argument} = {given!r}: give a dictionary by the names of parameters")
    return given.items()
