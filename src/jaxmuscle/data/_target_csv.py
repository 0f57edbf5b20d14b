"""Targets in texts: columns of frequency, power and sigma with names; or the points of a figure,
as WebPlotDigitizer exports them, one curve or several."""

import re
from pathlib import Path

import numpy as np

from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.text import choices, printable
from jaxmuscle.spectra._settings import SpectrumSettings

from ._target_fields import Columns, Raw, Rows, check_columns
from ._text_tables import cells_of, delimiter_in, is_number, lines_of, number_in

NAMES: tuple[str, ...] = ("frequency_hz", "proportional_power", "sigma")
EXPECTED = f"{NAMES[0]},{NAMES[1]}[,sigma]"
AXES = ("linear", "log-log")
LABELS = ["X", "Y"]  # of the columns of each dataset
# How programs call the columns of a spectrum, without unit and scale
_FREQUENCY = re.compile(r"f|hz|freq\w*|frequen[zc]\w*")
_POWER = re.compile(r"pow(?:ers?)?|pxx|pyy|psd|spectrum|density|leistung(?:sdichte)?")
FURTHEST = 1e4  # of a logarithm or of decibels
# What a scale makes of its numbers. Decibels are of a power: 10 log10.
_SCALES = {"dB": lambda x: 10 ** (x / 10), "log10": lambda x: 10.0**x, "ln": np.exp}
GRID_TOLERANCE = 0.02  # of a bin: frequencies rounded to two decimals are still those of the bins

Cells = list[tuple[str, list[str]]]  # of each line, with its place


def read_csv(text: str, file: str, dataset: str | None, axis: str) -> Raw:
    """Read columns with a header, `frequency_hz,proportional_power[,sigma]`; two columns without,
    the points of a figure; or the CSV of several datasets of a figure, of which `dataset` is taken.

    Other names of the two are understood, as `f`, `Pxx`, `PSD`, also with a unit; of the power `dB`
    and `log10` too. Columns are separated by comma, semicolon, tab or blanks; but for the first the
    decimal sign may be a comma. `#` starts a comment. A row at 0 Hz is left out. With the `axis`
    "log-log" points are log10 of frequency and power.

    **Raises:** `TargetError` naming file and line.
    """
    lines = lines_of(text)
    rows = [(line.place, line.body) for line in lines if line.body.strip()]
    comment = " ".join(line.note.strip() for line in lines if line.note and line.note.strip())
    if not rows:
        raise TargetError(f"{file}: holds no data; expected lines of {NAMES[0]},{NAMES[1]}")
    delimiter = delimiter_in(rows[min(1, len(rows) - 1)][1]) or ","
    cells = [(place, cells_of(body, delimiter)) for place, body in rows]
    if len(rows) > 1 and LABELS in _pairs(cells[1][1]):
        return _of_dataset(cells, delimiter, file, dataset, axis)
    if dataset is not None:
        raise no_datasets(file, dataset)
    delimiter = _delimiter(*rows[0], file)
    cells = [(place, cells_of(body, delimiter)) for place, body in rows]
    if is_number(cells[0][1][0], delimiter):
        source = comment or Path(file).name
        return _digitised(cells, list(NAMES[:2]), delimiter, file, axis, "no header", source)
    check_linear(axis, file)
    names, scale = _header(*cells.pop(0), file)
    if not cells:
        raise TargetError(f"{file}: holds a header but no data")
    columns, notices = _columns(cells, names, delimiter, file)
    places, power = columns.places, columns.power
    if scale:
        columns = columns._replace(power=_unscaled(power, scale, places, file))
        notices.append(f"the powers are in {scale}, and were converted")
    elif np.any(power < 0):
        at = int(np.argmax(power < 0))
        raise TargetError(
            f"{file}, {places[at]}: power {power[at]:g} must be larger than 0. If it is in dB or a"
            " logarithm, name the column power_dB, log10_power or ln_power"
        )
    check_columns(columns, file, ordered=True)
    path = Path(file)
    fields = {
        "name": printable(path.stem),
        "source": comment or printable(path.name),
        "settings": SpectrumSettings(),
    }
    return Raw(file, fields, columns, notices)


def no_datasets(file: str, dataset: str) -> TargetError:
    """The error of a dataset asked of what holds none."""
    return TargetError(f"{file}: has no named datasets; leave dataset={dataset!r} (--dataset) out")


def check_linear(axis: str, file: str) -> None:
    """Refuse logarithmic axes of what states frequency and power."""
    if axis != "linear":
        raise TargetError(
            f"{file}: states frequency in Hz and power; leave axis={axis!r} (--axis) out"
        )


def _columns(
    cells: Cells, names: list[str], delimiter: str | None, file: str, *, log: bool = False
) -> tuple[Columns, list[str]]:
    """The numbers of all rows but one at 0 Hz, and a notice of that; `log`: they are logarithms, of
    which 0 is a value like others."""
    table = np.array([_numbers(row, names, delimiter, f"{file}, {place}") for place, row in cells])
    column = dict(zip(names, table.T, strict=True))
    frequency, power = (column[name] for name in (NAMES if NAMES[0] in names else LABELS)[:2])
    kept = (frequency != 0) | log
    places = tuple(place for (place, _), keep in zip(cells, kept, strict=True) if keep)
    sigma = column[NAMES[2]][kept] if NAMES[2] in column else None
    notices = [] if np.all(kept) else ["the row at 0 Hz is the mean, and is left out"]
    return Columns(frequency[kept], power[kept], sigma, places), notices


def _numbers(row: list[str], names: list[str], delimiter: str | None, where: str) -> list[float]:
    if len(row) != len(names):
        remedy = (
            "decimal commas need a semicolon or tab between the columns"
            if delimiter == ","
            else "check it"
        )
        named = "a third column needs a header naming it sigma, or " * (len(row) == 3)
        raise TargetError(f"{where}: {len(row)} of {len(names)} columns found; {named}{remedy}")
    return [_number(cell, name, delimiter, where) for name, cell in zip(names, row, strict=True)]


def _number(cell: str, name: str, delimiter: str | None, where: str) -> float:
    try:
        return number_in(cell, delimiter)
    except ValueError:
        raise TargetError(f"{where}: {name} {cell!r} is not a number") from None


def _unscaled(values: Rows, scale: str, places: tuple[str, ...], file: str) -> Rows:
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


def _delimiter(place: str, body: str, file: str) -> str | None:
    if "\t" in body.strip() and ";" in body:
        raise TargetError(
            f"{file}, {place}: holds tabs and semicolons; use one of them between the columns"
        )
    found = delimiter_in(body.strip())
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
            f"{where}: the columns are {', '.join(row)}; a spectrum has {EXPECTED}. Is this a"
            " recording? Then give it to `jaxmuscle analyse`, or read it with"
            " jaxmuscle.load_recording"
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
            raise TargetError(f"{where}: no column {name!r}; expected {EXPECTED}")
    scale = roles[names.index(NAMES[1])][1]
    if scale and NAMES[2] in names:
        raise TargetError(f"{where}: sigma belongs to a power as it is, not in {scale}; convert it")
    return names, scale


def _of_dataset(cells: Cells, delimiter: str, file: str, dataset: str | None, axis: str) -> Raw:
    """The points of one dataset of the CSV that WebPlotDigitizer's "Export All Data" writes.

    Names stand in the first line, each over two columns X, Y; shorter datasets end in empty cells.
    """
    (first, header), (_, labels), *rows = cells
    if len(header) > len(labels):
        raise TargetError(
            f"{file}, {first}: {len(header)} cells above {len(labels)} columns; a comma in a"
            " dataset's name does this: rename it and export again"
        )
    header += [""] * (len(labels) - len(header))
    starts = [i for i, pair in enumerate(_pairs(labels)) if pair == LABELS]
    points = [
        [(place, pair) for place, row in rows if any(pair := [*row[i : i + 2], "", ""][:2])]
        for i in starts
    ]
    names = [header[i] for i in starts]
    chosen = _choose(dataset, names, points, file)
    origin = f"dataset {names[chosen]!r}"
    source = f"WebPlotDigitizer export {Path(file).name}, {origin}"
    return _digitised(points[chosen], LABELS, delimiter, file, axis, origin, source)


def _pairs(row: list[str]) -> list[list[str]]:
    return [row[i : i + 2] for i in range(len(row) - 1)]


def _choose(dataset: str | None, names: list[str], points: list[Cells], file: str) -> int:
    """The position of the dataset asked for, or of the only one with points."""
    filled = [i for i, found in enumerate(points) if found]
    if dataset is None:
        if len(filled) == 1:
            return filled[0]
        known = ", ".join(repr(names[i]) for i in filled)
        raise TargetError(
            f"{file}: holds several datasets, choose one with dataset= (--dataset): {known}"
            if filled
            else f"{file}: holds no points; add points in WebPlotDigitizer and export again"
        )
    if dataset not in names:
        raise TargetError(f"{file}: no dataset {dataset!r}; {choices(dataset, names)}")
    if names.count(dataset) > 1:
        raise TargetError(
            f"{file}: {names.count(dataset)} datasets are called {dataset!r}; rename them"
        )
    if names.index(dataset) not in filled:
        raise TargetError(f"{file}: dataset {dataset!r} holds no points")
    return names.index(dataset)


def _digitised(
    cells: Cells,
    names: list[str],
    delimiter: str | None,
    file: str,
    axis: str,
    origin: str,
    source: str,
) -> Raw:
    """Points of a figure: in Hz and power, sorted, near-duplicates averaged."""
    log = axis == "log-log"
    columns, notices = _columns(cells, names, delimiter, file, log=log)
    read, what = columns, "frequency in Hz and proportional power"
    if log:
        frequency, power = (_power_of_ten(columns, name, file) for name in ("frequency", "power"))
        read = Columns(frequency, power, None, columns.places)
        what = "log10 of frequency in Hz and of power"
    try:
        check_columns(read, file, ordered=False)
    except TargetError as error:
        # what no frequency is, and no power of all, a logarithm may be
        likely = np.any(columns.frequency < 0) or np.all(columns.power <= 0)
        hint = (
            "; if the columns hold log10 of both, give axis='log-log' (--axis log-log); if the"
            " power alone is in dB or a logarithm, say so in a first line frequency_hz,power_dB or"
            " frequency_hz,log10_power"
        )
        raise TargetError(f"{error}{hint * bool(likely and not log)}") from None
    settings = SpectrumSettings()
    merged = _merge_duplicates(read, GRID_TOLERANCE * settings.resolution)
    averaged = len(read.places) - len(merged.places)
    notice = f"{origin}: read as points of a figure, {what}, sorted by frequency"
    notice += f", {averaged} near-duplicates averaged" * bool(averaged)
    fields = {
        "name": printable(Path(file).stem),
        "provenance": "digitised",
        "source": printable(source),
        "settings": settings,
    }
    return Raw(file, fields, merged, [notice, *notices], True, log)


def _power_of_ten(columns: Columns, name: str, file: str) -> Rows:
    exponents = getattr(columns, name)
    wrong = np.flatnonzero(~(np.abs(exponents) <= 100))
    if wrong.size:
        raise TargetError(
            f"{file}, {columns.places[wrong[0]]}: log10 of the {name} is {exponents[wrong[0]]:g};"
            " expected -100 to 100"
        )
    return 10.0**exponents


def _merge_duplicates(columns: Columns, tolerance: float) -> Columns:
    """Sort by frequency and average rows that are within `tolerance` [Hz] of the first of their
    group."""
    order = np.lexsort((columns.power, columns.frequency))
    groups: list[list[int]] = []
    for row in order:
        if groups and columns.frequency[row] - columns.frequency[groups[-1][0]] <= tolerance:
            groups[-1].append(row)
        else:
            groups.append([row])
    frequency, power = (
        np.array([values[group].mean() for group in groups]) for values in columns[:2]
    )
    return Columns(frequency, power, None, tuple(columns.places[group[0]] for group in groups))
