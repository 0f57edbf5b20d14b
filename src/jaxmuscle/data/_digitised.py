"""Figures digitised with WebPlotDigitizer: its project (.json, .tar) or its CSV of several
datasets, as columns.

A project keeps pixels and four calibration points; data follow from them as in WebPlotDigitizer
itself, which ignores the stored values too: (x, y) = A (px, py) + c with A mapping the pixel steps
X1 → X2 and Y1 → Y2 to the steps of the axis values, in log10 on a logarithmic axis.
"""

from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.documents import parsed
from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.text import choices

from ._target_fields import Columns, check_columns, is_number
from ._text_tables import cells_of, lines_of, number_in

Axis = Literal["linear", "log-log"]
AXES: tuple[str, ...] = ("linear", "log-log")
LABELS = ["X", "Y"]
# Calibration lines that meet at a smaller angle [rad] do not span the figure.
SMALLEST_ANGLE = 1e-3
FURTHEST = 1e100  # of a pixel, and of a value on an axis
EXPORT = "export the points as CSV instead (View Data, Download .CSV)"


class Points(NamedTuple):
    """Points as read off a figure; on a logarithmic axis x, y are log10 of the values."""

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, " points"]
    places: tuple[str, ...]
    log_x: bool = False
    log_y: bool = False
    dataset: str | None = None


def read_project(text: str, file: str, dataset: str | None) -> Points:
    """The points of one dataset of a WebPlotDigitizer project, versions 3 and 4.

    **Raises:** `TargetError` naming file and dataset, point or axes.
    """
    project = parsed(text, file, "JSON", TargetError)
    axes, datasets = _collections(project, file)
    names = [str(_get(entry, "name", str, file)) for entry in datasets]
    filled = [
        i
        for i, entry in enumerate(datasets)
        if _get(entry, "data", list, f"{file}, dataset {names[i]!r}")
    ]
    chosen = datasets[_choose(dataset, names, filled, file)]
    name, axes_name = str(chosen["name"]), chosen.get("axesName")
    where = f"{file}, dataset {name!r}"
    found = [entry for entry in axes if isinstance(entry, dict) and entry.get("name") == axes_name]
    if len(found) != 1:
        problem = f"{where}: belongs to axes {axes_name!r}, of which the project has {len(found)}"
        raise TargetError(
            f"{problem}; choose the axes of the dataset in WebPlotDigitizer and save again"
        )
    places = tuple(f"dataset {name!r}, point {i}" for i in range(1, len(chosen["data"]) + 1))
    pixels = [
        [_number(p, key, f"{file}, {at}") for key in ("x", "y")]
        for p, at in zip(chosen["data"], places, strict=True)
    ]
    matrix, offset, logs = _calibration(found[0], f"{file}, axes {axes_name!r}")
    x, y = matrix @ np.array(pixels).T + offset[:, None]
    return Points(x, y, places, *logs, name)


def read_datasets(text: str, file: str, dataset: str | None) -> Points | None:
    """The points of one dataset of the CSV that "Export All Data" writes; `None` if the text is no
    such CSV.

    Names stand in the first line, each over two columns X, Y; shorter datasets end in empty cells.

    **Raises:** `TargetError` naming file and line.
    """
    lines = [(line.place, line.body) for line in lines_of(text) if line.body.strip()]
    if len(lines) < 2:
        return None
    delimiter = next((sign for sign in "\t;" if sign in lines[1][1]), ",")
    header, labels, *rows = (cells_of(line, delimiter) for _, line in lines)
    starts = [i for i in range(len(labels) - 1) if labels[i : i + 2] == LABELS]
    if not starts:
        return None
    header += [""] * (len(labels) - len(header))
    if len(header) > len(labels):
        problem = f"{file}, {lines[0][0]}: {len(header)} cells above {len(labels)} columns"
        raise TargetError(
            f"{problem}; a comma in a dataset's name does this: rename it and export again"
        )
    places = [place for place, _ in lines[2:]]
    parts = [_part(rows, places, start, delimiter, file) for start in starts]
    names = [header[start] for start in starts]
    chosen = _choose(dataset, names, [i for i, (_, found) in enumerate(parts) if found], file)
    values, found = parts[chosen]
    return Points(*np.array(values).T, places=tuple(found), dataset=names[chosen])


def columns_of(points: Points, axis: str, file: str) -> tuple[Columns, bool]:
    """Frequency [Hz] and power of the points, unsorted, and whether the frequency axis is
    logarithmic.

    **Raises:** `TargetError` naming file and point.
    """
    if axis == "log-log":
        if points.log_x or points.log_y:
            raise TargetError(
                f"{file}: is calibrated with a logarithmic axis already; leave axis='log-log' out"
            )
        points = points._replace(log_x=True, log_y=True)
    columns = [_power_of_ten(points, "x", file) if points.log_x else points.x]
    columns.append(_power_of_ten(points, "y", file) if points.log_y else points.y)
    try:
        result = Columns(columns[0], columns[1], None, points.places)
        check_columns(result, file, ordered=False)
    except TargetError as error:
        hint = (
            "; if the columns hold log10 of both, give axis='log-log' (--axis log-log); if the"
            " power alone is in dB or a logarithm, say so in a first line frequency_hz,power_dB or"
            " frequency_hz,log10_power"
        )
        hint = hint if np.any(points.x < 0) or np.all(points.y <= 0) else ""
        raise TargetError(f"{error}{hint}") from None
    return result, points.log_x


def _power_of_ten(points: Points, name: str, file: str) -> Float[np.ndarray, " points"]:
    exponents = getattr(points, name)
    wrong = np.flatnonzero(~(np.abs(exponents) <= 100))
    if wrong.size:
        what, value = "frequency" if name == "x" else "power", exponents[wrong[0]]
        raise TargetError(
            f"{file}, {points.places[wrong[0]]}: log10 of the {what} is {value:g}; expected -100"
            " to 100"
        )
    return 10.0**exponents


def _choose(dataset: str | None, names: list[str], filled: list[int], file: str) -> int:
    """The position of the dataset asked for, or of the only one with points."""
    if dataset is None:
        if len(filled) == 1:
            return filled[0]
        if not filled:
            raise TargetError(
                f"{file}: holds no points; add points in WebPlotDigitizer and save again"
            )
        known = ", ".join(repr(names[i]) for i in filled)
        raise TargetError(
            f"{file}: holds several datasets, choose one with dataset= (--dataset): {known}"
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


def _collections(project: Any, file: str) -> tuple[list[Any], list[Any]]:
    """Axes and datasets in the form of version 4."""
    if isinstance(project, dict) and isinstance(project.get("wpd"), dict):
        old = project["wpd"]
        _check_version(old, 3, file)
        parameters = _get(old, "axesParameters", dict, file)
        kind, points = old.get("axesType"), _get(old, "calibration", list, file)
        axes = {**parameters, "name": "XY", "type": kind, "calibrationPoints": points}
        datasets = [
            {**_table(entry, file), "axesName": "XY"}
            for entry in _get(old, "dataSeries", list, file)
        ]
        return [axes], datasets
    if isinstance(project, dict) and "target_table" in project:
        raise TargetError(
            f"{file}: is the result of a fit, and a spectrum is needed. `jaxmuscle compare` takes"
            " the spectrum of a fit.json; else give the file that was fitted"
        )
    if not isinstance(project, dict) or "axesColl" not in project:
        raise TargetError(f"{file}: is not a WebPlotDigitizer project (it has no axesColl)")
    _check_version(project, 4, file)
    datasets = [_table(entry, file) for entry in _get(project, "datasetColl", list, file)]
    return _get(project, "axesColl", list, file), datasets


def _check_version(table: dict[str, Any], major: int, file: str) -> None:
    version = table.get("version")
    if not isinstance(version, list) or version[:1] != [major]:
        raise TargetError(
            f"{file}: project version {version!r} is not known (3 and 4 are); {EXPORT}"
        )


def _calibration(
    axes: dict[str, Any], where: str
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, " 2"], tuple[bool, bool]]:
    """Matrix and offset from pixels to axis values, and which of the axes (x, y) are in log10."""
    if axes.get("type") != "XYAxes":
        raise TargetError(
            f"{where}: of type {axes.get('type')!r}; calibrate the figure as '2D (X-Y) Plot'"
        )
    points = _get(axes, "calibrationPoints", list, where)
    if len(points) != 4:
        raise TargetError(
            f"{where}: {len(points)} calibration points, 4 are needed (X1, X2, Y1, Y2)"
        )
    logs = (axes.get("isLogX") is True, axes.get("isLogY") is True)
    named = list(
        zip(points, ("X1", "X2", "Y1", "Y2"), ("dx", "dx", "dy", "dy"), (0, 0, 1, 1), strict=True)
    )
    X1, X2, Y1, Y2 = (
        np.array([_number(p, k, f"{where}, {at}") for k in ("px", "py")]) for p, at, _, _ in named
    )
    x1, x2, y1, y2 = (_axis_value(p, key, logs[i], f"{where}, {at}") for p, at, key, i in named)
    steps = np.stack([X2 - X1, Y2 - Y1], axis=1)
    values = np.array([x2 - x1, y2 - y1])
    if np.any(values == 0):
        raise TargetError(
            f"{where}: two calibration points of an axis have the same value; they must differ"
        )
    lengths = np.linalg.norm(steps, axis=0)
    if not abs(np.linalg.det(steps)) > SMALLEST_ANGLE * lengths[0] * lengths[1]:
        raise TargetError(
            f"{where}: the calibration points coincide or lie on one line; calibrate the axes again"
        )
    if axes.get("noRotation") is True:
        steps = _upright(steps)
    matrix = values[:, None] * np.linalg.inv(steps)
    return matrix, np.array([x1 - matrix[0] @ X1, y1 - matrix[1] @ Y1]), logs


def _upright(steps: Float[np.ndarray, "2 2"]) -> Float[np.ndarray, "2 2"]:
    """The steps without what leads across the image's edges, as WebPlotDigitizer does on
    request."""
    straight = abs(steps[0, 0] * steps[1, 1]) > abs(steps[0, 1] * steps[1, 0])
    return np.where(np.eye(2, dtype=bool) == straight, steps, 0.0)


def _axis_value(point: Any, key: str, log: bool, where: str) -> float:
    value = _number(point, key, where)
    if log and not value > 0:
        raise TargetError(
            f"{where}: value {value:g} on a logarithmic axis; it must be larger than 0"
        )
    return float(np.log10(value)) if log else value


def _number(table: Any, key: str, where: str) -> float:
    """A finite number; as a text too, as WebPlotDigitizer stores what was typed."""
    value: Any = table.get(key) if isinstance(table, dict) else None
    try:
        number = float(value) if isinstance(value, str) or is_number(value) else np.nan
    except ValueError:
        number = np.nan
    if not abs(number) < FURTHEST:
        raise TargetError(
            f"{where}: {key} {value!r} is not a number; write 0.001 or 1e-3, with a decimal point"
        )
    return number


def _table(value: Any, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise TargetError(f"{where}: is damaged: {value!r} should be a table; {EXPORT}")
    return value


def _get(table: Any, key: str, kind: type, where: str) -> Any:
    value = _table(table, where).get(key)
    if not isinstance(value, kind):
        raise TargetError(
            f"{where}: is damaged: {key!r} is missing or no {kind.__name__}; {EXPORT}"
        )
    return value


def _part(
    rows: list[list[str]], places: list[str], start: int, delimiter: str, file: str
) -> tuple[list[list[float]], list[str]]:
    """Numbers and places of the rows that have something in the two columns from `start`."""
    values, found = [], []
    for row, place in zip(rows, places, strict=True):
        pair = [*row[start : start + 2], "", ""][:2]
        if any(pair):
            values.append(
                [
                    _cell(cell, label, delimiter, f"{file}, {place}")
                    for cell, label in zip(pair, LABELS, strict=True)
                ]
            )
            found.append(place)
    return values, found


def _cell(cell: str, label: str, delimiter: str, where: str) -> float:
    try:
        return number_in(cell, delimiter)
    except ValueError:
        raise TargetError(f"{where}: {label} {cell!r} is not a number") from None
