"""What variables of a .mat or .npz say of others beside them: rates, names and units."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from .._recording_channels import Channel
from ._dialect import number, per_second, texts

_RATE = re.compile(
    r"(?:sampl(?:e|ing)|acq(?:uisition)?)_?(?:rate|freq|frequency)|rate"
    r"|f_?s(?:amp|ample|amples)?|s_?freq|s_?rate|sr"
)
_STEP = re.compile(
    r"(?:(?:sampl(?:e|ing)|time)_?)?interval|(?:sampl(?:e|ing)|time)_?(?:step|period)"
    r"|dt|ts|delta_?t|isi"
)
_IN = re.compile(r"(.+)_(k?hz|s|sec|ms|us)")
_TIME = ("time", "t")
LABELS = ("labels", "titles", "channels", "channelnames", "channel_names", "names")
UNITS = ("units", "unit", "channelunits", "channel_units", "unittext")


def stated(variables: Mapping[str, Any], columns: Mapping[str, Sequence[Channel]]) -> list[Channel]:
    """The columns of every array, with what the variables beside it in its struct, or above it,
    say."""
    rates, others = _rates(variables, columns)
    common = set(rates.values())
    found = []
    for name, channels in columns.items():
        scopes = _scopes(name)
        rate = next((rates[scope] for scope in scopes if scope in rates), None)
        rate = next(iter(common)) if rate is None and len(common) == 1 else rate
        rate = others.get(name, rate)
        labels = _beside(variables, columns, name, LABELS) if len(channels) > 1 else []
        units = _beside(variables, columns, name, UNITS)
        for i, channel in enumerate(channels):
            alias = channel.name if labels else ""
            label, unit = labels[i] if labels else "", units[i] if units else ""
            found.append(Channel(label or channel.name, channel.samples, rate, unit, alias))
    return found


def _scopes(name: str) -> list[str]:
    """The structs that a variable is in, the innermost first, as `a.b.`; the last is the file."""
    parts = name.split(".")[:-1]
    return ["".join(f"{part}." for part in parts[:n]) for n in range(len(parts), -1, -1)]


def _rates(
    variables: Mapping[str, Any], arrays: Mapping[str, Any]
) -> tuple[dict[str, float], dict[str, float]]:
    """Rates [Hz] by the struct that they hold for, and by the array after which they are named."""
    scopes: dict[str, float] = {}
    own: dict[str, float] = {}
    for name, value in variables.items():
        found = number(value)
        if found is None or found <= 0:
            continue
        units = [
            text for key in ("units", "unit") for text in texts(variables.get(f"{name}_{key}"))
        ]
        scope, short = _scopes(name)[0], name.rpartition(".")[2].casefold()
        rate = _rate(short, found, *units[:1])
        if rate is not None:
            scopes[scope] = rate
            continue
        for array in arrays:
            last = array.rpartition(".")[2].casefold()
            word = short.removeprefix(f"{last}_").removesuffix(f"_{last}")
            rate = _rate(word, found, *units[:1]) if word != short else None
            if rate is not None and _scopes(array)[0] == scope:
                own[array] = rate
    return scopes, own


def _rate(word: str, value: float, unit: str = "") -> float | None:
    """The rate that a variable of this name states; a time between samples is in s, that of `isi`
    only where it says so."""
    measured = None if _RATE.fullmatch(word) else _IN.fullmatch(word)
    word, unit = (measured[1], measured[2]) if measured else (word, unit.casefold())
    if _RATE.fullmatch(word) and unit in ("", "hz", "khz"):
        return value * (1e3 if unit == "khz" else 1.0)
    rate = per_second(value, unit or ("" if word == "isi" else "s"))
    # a step of 10 is none in s
    return rate if _STEP.fullmatch(word) and rate is not None and rate >= 1 else None


def _beside(
    variables: Mapping[str, Any],
    columns: Mapping[str, Sequence[Channel]],
    name: str,
    keys: Sequence[str],
) -> list[str]:
    """The texts beside an array, one for each of its columns, where they cannot be of another."""
    scope, short = _scopes(name)[0], name.rpartition(".")[2].casefold()
    alike = [
        other
        for other, found in columns.items()
        if len(found) == len(columns[name])
        and _scopes(other)[0] == scope
        and other.rpartition(".")[2].casefold() not in _TIME
    ]
    for key in variables:
        last = key.rpartition(".")[2].casefold()
        word = last.removeprefix(f"{short}_")
        if _scopes(key)[0] == scope and word in keys and (word != last or alike == [name]):
            found = texts(variables[key])
            if len(found) == len(columns[name]):
                return found
    return []
