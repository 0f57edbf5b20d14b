"""Targets in files: a bundled name or a path to the fields and columns of a TOML, CSV or
WebPlotDigitizer file."""

import contextlib
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args

import msgspec
import numpy as np
from jaxtyping import Float, Int

from jaxmuscle._common.bundled import bundled_text, list_targets
from jaxmuscle._common.documents import Table, checked, parsed, says
from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.files import text_of
from jaxmuscle._common.inputs import read_bytes
from jaxmuscle._common.text import choices, printable
from jaxmuscle.spectra._settings import SpectrumSettings

from ._apart import read_apart
from ._digitised import AXES, Points, columns_of, read_datasets, read_project
from ._target_csv import merge_duplicates, read_csv
from ._target_fields import (
    CHECKS,
    GRID_TOLERANCE,
    PIXEL_OF_LOG,
    PIXEL_TOLERANCE,
    Columns,
    Provenance,
    Quantity,
    check_columns,
    metadata,
    numbers_of,
)
from ._text_tables import TEXT

REQUIRED = ("name", "quantity", "provenance", "source", "frequency_hz", "proportional_power")
METADATA = (
    "segments",
    "coefficient_of_variation",
    "mvc_fraction",
    "mean",
    "unit",
    "recorded_at",
    "dispersion",
    "reason",
    "notices",
)
KEYS = (*REQUIRED, "sigma", *METADATA, "trial_power", "stiffness", "measured", "settings")
QUANTITIES, PROVENANCES = ("one of " + ", ".join(get_args(kind)) for kind in (Quantity, Provenance))
POSITIVES = "numbers, each above 0"
# In bins: as far beyond the first and the last frequency the power of a bin is that of the end; and
# how far apart frequencies may be if the powers of all bins between them are to follow.
REACH, COARSE = 0.1, 1.1


class Raw(NamedTuple):
    """What a file says: its name for messages, its fields other than the columns, the columns,
    notices.

    `digitised` points carry the error of a pixel; `log_frequency` says that their frequency axis is
    logarithmic.
    """

    file: str
    fields: dict[str, Any]
    columns: Columns
    notices: list[str]
    digitised: bool = False
    log_frequency: bool = False


def read_target(
    name_or_path: str | os.PathLike[str], dataset: str | None = None, axis: str = "linear"
) -> Raw:
    """Read a bundled target, a .toml or .csv file or a digitised figure; the columns are checked,
    the other fields not yet.

    **Raises:** `TargetError` naming file and line or key.
    """
    if axis not in AXES:
        raise TargetError(f"unknown axis {axis!r}; {choices(str(axis), AXES)}")
    file, kind, text = _read(name_or_path)
    if kind == ".json":
        return _digitised(
            read_project(text, file, dataset),
            file,
            axis,
            f"WebPlotDigitizer project {Path(file).name}",
        )
    if kind == ".csv" and (points := read_datasets(text, file, dataset)) is not None:
        return _digitised(points, file, axis, f"WebPlotDigitizer export {Path(file).name}")
    if dataset is not None:
        raise TargetError(
            f"{file}: has no named datasets; leave dataset={dataset!r} (--dataset) out"
        )
    return _parse_csv(text, file, axis) if kind == ".csv" else _parse_toml(text, file, axis)


def _read(name_or_path: str | os.PathLike[str]) -> tuple[str, str, str]:
    """What messages call the target, ".toml", ".csv" or ".json" (a tar holds one), and the text."""
    if not isinstance(name_or_path, str | os.PathLike):
        raise TargetError(f"target {name_or_path!r}: give the name of a bundled target or a path")
    given, names = os.fspath(name_or_path), list_targets()
    if isinstance(name_or_path, str) and given in names:
        return given, ".toml", bundled_text(given)
    path = Path(given)
    is_path = (
        isinstance(name_or_path, os.PathLike)
        or path.suffix
        or len(path.parts) > 1
        or os.path.exists(given)
    )
    if not given or not is_path:
        raise TargetError(
            f"no bundled target {given!r}; {choices(given, names)} (`jaxmuscle targets`); or give a"
            " path"
        )
    with contextlib.suppress(RuntimeError):
        path = path.expanduser()
    hint = f"; the bundled target is called {path.stem!r}" if path.stem in names else ""
    instead, kind = "a .toml or .csv file, or a digitised .json or .tar", path.suffix.lower()
    data = read_bytes(path, TargetError, instead=instead, hint=hint) if kind != ".tar" else b""
    if kind == ".tar":
        kind, data = ".json", read_apart(path, kind, TargetError, instead=instead, hint=hint)
    kind = ".csv" if kind in TEXT else kind
    if kind not in (".toml", ".csv", ".json"):
        problem = f"{path}: a target is a .toml or .csv file, not {kind or 'one without ending'}"
        raise TargetError(f"{problem}; a WebPlotDigitizer project ends in .json or .tar")
    return str(path), kind, text_of(data, str(path), TargetError)


def _parse_csv(text: str, file: str, axis: str) -> Raw:
    (columns, has_header, comment, notices), path = read_csv(text, file), Path(file)
    if not has_header:
        points = Points(columns.frequency, columns.power, columns.places)
        raw = _digitised(points, file, axis, comment or path.name)
        return raw._replace(notices=[*raw.notices, *notices])
    _linear(axis, file)
    check_columns(columns, file, ordered=True)
    fields = {
        "name": printable(path.stem),
        "source": comment or printable(path.name),
        "settings": SpectrumSettings(),
    }
    return Raw(file, fields, columns, notices)


def _linear(axis: str, file: str) -> None:
    if axis != "linear":
        raise TargetError(
            f"{file}: states frequency in Hz and power; leave axis={axis!r} (--axis) out"
        )


def _digitised(points: Points, file: str, axis: str, source: str) -> Raw:
    """Points of a figure: in Hz and power, sorted, near-duplicates averaged."""
    columns, log_frequency = columns_of(points, axis, file)
    settings = SpectrumSettings()
    merged = merge_duplicates(columns, GRID_TOLERANCE * settings.resolution)
    averaged = len(columns.places) - len(merged.places)
    origin = "no header" if points.dataset is None else f"dataset {points.dataset!r}"
    what = (
        "log10 of frequency in Hz and of power"
        if axis == "log-log"
        else "frequency in Hz and proportional power"
    )
    notice = f"{origin}: read as points of a figure, {what}, sorted by frequency"
    notice += f", {averaged} near-duplicates averaged" if averaged else ""
    source = source if points.dataset is None else f"{source}, dataset {points.dataset!r}"
    fields = {
        "name": printable(Path(file).stem),
        "provenance": "digitised",
        "source": printable(source),
        "settings": settings,
    }
    return Raw(file, fields, merged, [notice], True, log_frequency)


def _parse_toml(text: str, file: str, axis: str) -> Raw:
    _linear(axis, file)
    fields = fields_of(parsed(text, file, "TOML", TargetError), file)
    keys = [key for key in ("frequency_hz", "proportional_power", "sigma") if key in fields]
    lists = [numbers_of(key, fields.pop(key), file, empty="stiffness" in fields) for key in keys]
    for key, values in zip(keys, lists, strict=True):
        if values.size != lists[0].size:
            raise TargetError(
                f"{file}: {key} has {values.size} entries, frequency_hz {lists[0].size}; make them"
                " equal"
            )
    places = tuple(f"entry {i}" for i in range(1, lists[0].size + 1))
    columns = Columns(lists[0], lists[1], lists[2] if len(lists) > 2 else None, places)
    check_columns(columns, file, ordered=True)
    stated = fields.get("settings", {})
    settings = fields["settings"] = settings_of(stated, f"{file}: [settings]")
    if "rate" in stated and columns.frequency.size and columns.frequency[-1] > settings.rate / 2:
        said = (
            f"{file}, {places[-1]}: frequency {columns.frequency[-1]:g} Hz is above"
            f" {settings.rate / 2:g} Hz"
        )
        raise TargetError(f"{said}, half of the rate in [settings]; make one of both right")
    return Raw(file, fields, columns, [])


class TargetFile(Table, kw_only=True):
    """A target: in a .toml, and as `target_table` in a fit.json."""

    format: Annotated[Any, says("Version of the format", missing="1", kind="1")] = 1
    name: Annotated[Any, says("How reports call it", kind="text")]
    quantity: Annotated[Any, says("What was recorded", kind=QUANTITIES)]
    provenance: Annotated[Any, says("From where the numbers are", kind=PROVENANCES)]
    source: Annotated[Any, says("Article, figure, recording", kind="text")]
    frequency_hz: Annotated[
        Any,
        says(
            "Frequencies [Hz], rising; empty if there is a stiffness, but no spectrum",
            kind="list of numbers, each at least 0",
        ),
    ]
    proportional_power: Annotated[
        Any,
        says(
            "Power at each frequency, of any scale; empty if there is no spectrum",
            kind=f"list of {POSITIVES}",
        ),
    ]
    sigma: Annotated[
        Any,
        says(
            "Standard error of each averaged power, in the unit of the power",
            missing="errors follow from `segments`",
            kind=f"list of {POSITIVES}",
        ),
    ] = None
    segments: Annotated[
        Any,
        says(
            "Welch segments that were averaged, of each trial; one number means one recording",
            missing="errors follow from `sigma`; without it they are unknown, and so is chi²",
            kind="whole number from 1, or a list of them",
        ),
    ] = None
    coefficient_of_variation: Annotated[
        Any,
        says(
            "Standard deviation over mean, of each trial",
            missing="unknown",
            kind="number above 0, at most 1, or a list of them",
        ),
    ] = None
    mvc_fraction: Annotated[
        Any,
        says(
            "Mean level as a share of the maximum",
            missing="unknown",
            kind="number above 0, at most 1",
        ),
    ] = None
    mean: Annotated[
        Any,
        says(
            "Mean force or torque of each trial, in `unit`",
            missing="unknown",
            kind="number above 0, or a list of them",
        ),
    ] = None
    unit: Annotated[
        Any, says("Unit of `mean`", missing="unknown: `mean` fixes no scale of force", kind="text")
    ] = None
    recorded_at: Annotated[
        Any,
        says(
            "Rate of the recording [Hz], before it was resampled; its aliases are expected if"
            " `sampling` in `settings` is filtered",
            missing="no aliases are expected",
            kind="number above 0",
        ),
    ] = None
    dispersion: Annotated[
        Any,
        says(
            "Dispersion of the trials (1 if they are alike), and its error",
            missing="follows from `trial_power`; else unknown",
            kind=f"list of two {POSITIVES}",
        ),
    ] = None
    reason: Annotated[
        Any,
        says(
            "What was assumed",
            missing="nothing; an error if `provenance` is reconstructed",
            kind="text",
        ),
    ] = None
    notices: Annotated[
        Any, says("What was done to the numbers", missing="no notices", kind="list of texts")
    ] = None
    trial_power: Annotated[
        Any,
        says(
            "Spectrum of each trial: a row for each of `segments`, with a power for each of"
            " `frequency_hz`, in one unit. Weighted with `segments`, their mean has the shape of"
            " `proportional_power`",
            missing="unknown",
            kind=f"list of rows, each a list of {POSITIVES}",
        ),
    ] = None
    stiffness: Annotated[
        Any,
        says(
            "Dynamic stiffness measured beside it", missing="not measured", kind="table, see below"
        ),
    ] = None
    measured: Annotated[
        Any,
        says(
            "What `jaxmuscle steadiness` measures of the recordings: for each quantity a table with"
            " `value`, `stderr`, `low` and `high` (ends of the 95 % interval), `unit`,"
            " `error_from`",
            missing="measured of the bins",
            kind="table of tables",
        ),
    ] = None
    settings: Annotated[
        Any,
        says(
            "How the spectrum was estimated: the fields of `SpectrumSettings`",
            missing="their defaults",
            kind="table",
        ),
    ] = None


def fields_of(table: Mapping[str, Any], file: str, needed: Iterable[str] = ()) -> dict[str, Any]:
    """The keys of a target's table, those that are checked alone in their stored form; what is not
    stated may be None.

    **Raises:** `TargetError` for a key that is unknown, missing or wrong.
    """
    checked(dict(table), TargetFile, file, TargetError)
    for key in needed:
        if key not in table:
            raise TargetError(f"{file}: the key {key!r} is missing; needed are {', '.join(needed)}")
    if type(table.get("format", 1)) is not int or table.get("format", 1) != 1:
        raise TargetError(
            f"{file}: format = {table['format']!r}: this version of jaxmuscle reads format 1"
        )
    try:
        fields = {
            key: metadata(key, value) if key in CHECKS else value
            for key, value in table.items()
            if key != "format"
        }
    except TargetError as error:
        raise TargetError(f"{file}: {error}") from None
    return fields


def settings_of(table: Any, where: str, needed: Iterable[str] = ()) -> SpectrumSettings:
    """Spectrum settings of a target's table. Raises `TargetError`."""
    if not isinstance(table, dict):
        raise TargetError(
            f"{where}: settings must be a table: a line [settings], then one setting per line"
        )
    own = {field.encode_name for field in msgspec.structs.fields(TargetFile)}
    if misplaced := [key for key in table if key in own]:
        said = f"{where}: {', '.join(misplaced)}: of the target, not of its settings"
        raise TargetError(
            f"{said}. Move this above the line [settings]: below it everything counts as a setting"
        )
    try:
        return SpectrumSettings.from_dict(table, needed=needed)
    except ValueError as error:
        raise TargetError(f"{where}: {error}") from None


class OnBins(NamedTuple):
    """Powers of the bins that a file covers."""

    bins: np.ndarray
    proportional_power: np.ndarray
    sigma: np.ndarray | None = None
    trial_power: Any = None


def on_grid(raw: Raw) -> tuple[OnBins, list[str]]:
    """The rows on the bins they cover: as they are if all lie on bins, else interpolated in log
    power; and notices.

    Raises `TargetError` if fewer than 2 bins are covered, and for spectra of trials that are off
    the bins.
    """
    columns, settings, trials = raw.columns, raw.fields["settings"], raw.fields.get("trial_power")
    with np.errstate(over="ignore"):
        position = np.minimum(columns.frequency / settings.resolution, 2.0**53)
    tolerance = np.full(position.size, PIXEL_TOLERANCE if raw.digitised else GRID_TOLERANCE)
    if raw.log_frequency:
        tolerance = np.maximum(tolerance, PIXEL_OF_LOG * position)
    bins = np.rint(position).astype(int)
    first, last = settings.first_bin, settings.last_bin
    aligned = np.all(np.abs(position - bins) <= tolerance) and np.unique(bins).size == bins.size
    notices = []
    if aligned:
        inside = (bins >= first) & (bins <= last)
        sigma = None if columns.sigma is None else columns.sigma[inside]
        points = OnBins(
            bins[inside],
            columns.power[inside],
            sigma,
            None if trials is None else _columns(trials, inside),
        )
        if (off := np.max(np.abs(position - bins)[inside], initial=0)) > GRID_TOLERANCE:
            notices.append(
                f"some frequencies lie up to {off:.2g} bins beside a bin, and count as that bin: a"
                " figure cannot be read more finely"
            )
        if not np.all(inside):
            rows, are = (
                ("1 row lies", "is")
                if np.sum(~inside) == 1
                else (f"{np.sum(~inside)} rows lie", "are")
            )
            notices.append(f"{rows} outside bins {first} to {last} and {are} left out")
    elif trials is not None:
        raise TargetError("trial_power: needs frequencies that lie on the bins of the settings")
    else:
        every = np.arange(first, last + 1)
        covered, lost = _between(every, position, np.maximum(tolerance, REACH))
        if lost:
            notices.append(
                f"{lost} bins lie farther than half a bin from any frequency, between two that"
                f" are more than {COARSE:g} bins apart: they are left out, as interpolated powers"
                " are no measurements"
            )
        logs = [np.log(values) for values in (columns.power, columns.sigma) if values is not None]
        at, known = (
            (np.log(covered), np.log(position)) if raw.log_frequency else (covered, position)
        )
        points = OnBins(covered, *(np.exp(np.interp(at, known, log)) for log in logs))
        gap, scale = (
            f"{np.max(np.diff(columns.frequency), initial=0):.3g}",
            " over log frequency" * raw.log_frequency,
        )
        notices.append(
            f"the frequencies are not those of the bins, so the log power was interpolated{scale}"
            f" (widest gap {gap} Hz)"
        )
    alone = "stiffness" in raw.fields and not columns.frequency.size
    if points.bins.size < 2 and not alone:
        raise TargetError(
            f"covers {points.bins.size} of the bins {first} to {last} ({settings.frequency[0]:.4g}"
            f" to {settings.frequency[-1]:.4g} Hz), at least 2 are needed; frequencies are in Hz"
        )
    return points, notices


def _between(
    every: Int[np.ndarray, " bins"],
    position: Float[np.ndarray, " rows"],
    reach: Float[np.ndarray, " rows"],
) -> tuple[Int[np.ndarray, " covered"], int]:
    """The bins between the first and the last frequency, and how many of them were left out because
    no frequency is near: one number is not to count as two."""
    bins = every[(every >= position[0] - reach[0]) & (every <= position[-1] + reach[-1])]
    right = np.clip(np.searchsorted(position, bins), 1, max(position.size - 1, 1))
    low, high = position[right - 1], position[np.minimum(right, position.size - 1)]
    known = (high - low <= COARSE) | (np.minimum(np.abs(bins - low), np.abs(bins - high)) <= 0.5)
    return bins[known], int(np.sum(~known))


def _columns(rows: Any, inside: np.ndarray) -> list[list[float]]:
    """The trials' spectra on the bins that are kept."""
    if not isinstance(rows, list) or any(
        not isinstance(row, list) or len(row) != inside.size for row in rows
    ):
        raise TargetError(
            f"trial_power: every trial needs {inside.size} numbers, as many as"
            " proportional_power has"
        )
    return [[value for value, kept in zip(row, inside, strict=True) if kept] for row in rows]
