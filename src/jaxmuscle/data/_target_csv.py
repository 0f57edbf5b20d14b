"""Targets as CSV: columns of frequency, power and sigma, with or without a header."""

import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.text import choices

from ._target_fields import Columns
from ._text_tables import SIGNS, cells_of, is_number, lines_of, number_in

NAMES: tuple[str, ...] = ("frequency_hz", "proportional_power", "sigma")
# How programs call the columns of a spectrum, without unit and scale
_FREQUENCY = re.compile(r"f|hz|freq\w*|frequen[zc]\w*")
_POWER = re.compile(r"pow(?:ers?)?|pxx|pyy|psd|spectrum|density|leistung(?:sdichte)?")
FURTHEST = 1e4  # of a logarithm or of decibels
# What a scale makes of its numbers. Decibels are of a power: 10 log10.
_SCALES = {"dB": lambda x: 10 ** (x / 10), "log10": lambda x: 10.0**x, "ln": np.exp}


class Sheet(NamedTuple):
    """A CSV file: its columns, whether it names them, its comments as one text, and notices."""

    columns: Columns
    has_header: bool
    comment: str
    notices: list[str]


def read_csv(text: str, file: str) -> Sheet:
    """Read `frequency_hz,proportional_power[,sigma]`, or two columns without a header.

    Other names of the two are understood, as `f`, `Pxx`, `PSD`, also with a unit; of the power `dB`
    and `log10` too. Columns are separated by comma, semicolon, tab or blanks; but for the first the
    decimal sign may be a comma. `#` starts a comment. A row at 0 Hz is left out.

    **Raises:** `TargetError` naming file and line.
    """
    lines = lines_of(text)
    rows = [(line.place, line.body) for line in lines if line.body.strip()]
    comment = " ".join(line.note.strip() for line in lines if line.note and line.note.strip())
    if not rows:
        raise TargetError(f"{file}: holds no data; expected lines of {NAMES[0]},{NAMES[1]}")
    delimiter = _delimiter(*rows[0], file)
    cells = [(place, cells_of(body, delimiter)) for place, body in rows]
    has_header = not is_number(cells[0][1][0], delimiter)
    names, scale = _header(*cells.pop(0), file) if has_header else (list(NAMES[:2]), "")
    if not cells:
        raise TargetError(f"{file}: holds a header but no data")
    table = np.array([_numbers(place, row, names, delimiter, file) for place, row in cells])
    kept = table[:, names.index(NAMES[0])] != 0
    column = dict(zip(names, table[kept].T.copy(), strict=True))
    places = tuple(place for (place, _), keep in zip(cells, kept, strict=True) if keep)
    notices = [] if np.all(kept) else ["the row at 0 Hz is the mean, and is left out"]
    power = column[NAMES[1]]
    if has_header and not scale and np.any(power < 0):
        at = int(np.argmax(power < 0))
        raise TargetError(
            f"{file}, {places[at]}: power {power[at]:g} must be larger than 0. If it is in dB or a"
            " logarithm, name the column power_dB, log10_power or ln_power"
        )
    if scale:
        power = _unscaled(power, scale, places, file)
        notices.append(f"the powers are in {scale}, and were converted")
    columns = Columns(column[NAMES[0]], power, column.get(NAMES[2]), places)
    return Sheet(columns, has_header, comment, notices)


def _unscaled(
    values: Float[np.ndarray, " rows"], scale: str, places: tuple[str, ...], file: str
) -> Float[np.ndarray, " rows"]:
    """Powers of which decibels or logarithms are given, relative to the largest: the unit of a
    power does not matter."""
    wrong = np.flatnonzero(~(np.abs(values) < FURTHEST))
    if wrong.size:
        raise TargetError(
            f"{file}, {places[wrong[0]]}: {values[wrong[0]]:g} is no power in {scale}"
        )
    return _SCALES[scale](values - np.max(values, initial=-FURTHEST))


def column_role(name: str) -> tuple[str | None, str]:
    """Which of `NAMES` a column is by its name, `None` if none, and the scale that the name
    states: `dB`, `log10`, `ln` or none."""
    words = re.findall(r"[^\W_]+", name.casefold())
    scale = next((each for each in _SCALES if each.casefold() in words), "")
    rest = [word for word in words if word != scale.casefold()]
    if rest[:1] == ["sigma"]:
        return NAMES[2], scale
    if rest and _FREQUENCY.fullmatch(rest[0]):
        return NAMES[0], scale
    power = any(_POWER.fullmatch(word) for word in rest) or (scale == "dB" and not rest)
    return (NAMES[1] if power else None), scale


def merge_duplicates(columns: Columns, tolerance: float) -> Columns:
    """Sort by frequency and average rows that are within `tolerance` [Hz] of the first of their
    group."""
    order = np.lexsort((columns.power, columns.frequency))
    groups: list[list[int]] = []
    for row in order:
        if groups and columns.frequency[row] - columns.frequency[groups[-1][0]] <= tolerance:
            groups[-1].append(row)
        else:
            groups.append([row])
    frequency = np.array([columns.frequency[group].mean() for group in groups])
    power = np.array([columns.power[group].mean() for group in groups])
    return Columns(frequency, power, None, tuple(columns.places[group[0]] for group in groups))


def _delimiter(place: str, body: str, file: str) -> str | None:
    if "\t" in body.strip() and ";" in body:
        raise TargetError(
            f"{file}, {place}: holds tabs and semicolons; use one of them between the columns"
        )
    found = next((sign for sign in SIGNS if sign in body.strip()), None)
    if found is None and len(body.split()) < 2:
        raise TargetError(
            f"{file}, {place}: one column; separate frequency and power by comma, semicolon, tab or"
            " blanks"
        )
    return found


def _header(place: str, row: list[str], file: str) -> tuple[list[str], str]:
    """Which column is what, and the scale of the power."""
    roles = [column_role(cell) for cell in row]
    names, where = [role or "" for role, _ in roles], f"{file}, {place}"
    if not any(names):
        raise TargetError(
            f"{where}: the columns are {', '.join(row)}; a spectrum has"
            f" {NAMES[0]},{NAMES[1]}[,sigma]. Is this a recording? Then give it to `jaxmuscle"
            " analyse`, or read it with jaxmuscle.load_recording"
        )
    for name, cell, (_, scale) in zip(names, row, roles, strict=True):
        words = set(re.findall(r"[^\W_]+", cell.casefold()))
        if words & {"amplitude", "magnitude", "asd"}:
            raise TargetError(
                f"{where}: column {cell!r}: a power is asked for. If these are amplitudes, square"
                f" them and name the column {NAMES[1]}; if they are powers, rename it"
            )
        if words & {"log", "rad", "khz"} or (scale and name != NAMES[1]):
            raise TargetError(
                f"{where}: column {cell!r}: give frequencies in Hz ({NAMES[0]}), and the power as"
                f" it is ({NAMES[1]}), in dB (power_dB) or as its logarithm (log10_power, ln_power)"
            )
        if not name:
            raise TargetError(f"{where}: unknown column {cell!r}; {choices(cell, NAMES)}")
        if names.count(name) > 1:
            raise TargetError(f"{where}: column {name!r} appears twice, here as {cell!r}; keep one")
    for name in NAMES[:2]:
        if name not in names:
            raise TargetError(
                f"{where}: no column {name!r}; expected {NAMES[0]},{NAMES[1]}[,sigma]"
            )
    scale = roles[names.index(NAMES[1])][1]
    if scale and NAMES[2] in names:
        raise TargetError(f"{where}: sigma belongs to a power as it is, not in {scale}; convert it")
    return names, scale


def _numbers(
    place: str, row: list[str], names: list[str], delimiter: str | None, file: str
) -> list[float]:
    if len(row) != len(names):
        remedy = (
            "decimal commas need a semicolon or tab between the columns"
            if delimiter == ","
            else "check it"
        )
        remedy = (
            "a third column needs a header naming it sigma, or " + remedy
            if len(row) == 3
            else remedy
        )
        raise TargetError(f"{file}, {place}: {len(row)} of {len(names)} columns found; {remedy}")
    for name, cell in zip(names, row, strict=True):
        if not is_number(cell, delimiter):
            raise TargetError(f"{file}, {place}: {name} {cell!r} is not a number")
    return [number_in(cell, delimiter) for cell in row]
