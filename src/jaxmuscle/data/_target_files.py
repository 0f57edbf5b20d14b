"""Targets in files: a bundled name or a path to the fields and columns of a TOML or CSV file, and
those on the bins of the settings."""

import contextlib
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from jaxmuscle._common.bundled import bundled_text, list_targets
from jaxmuscle._common.documents import parsed
from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.files import text_of
from jaxmuscle._common.inputs import read_bytes
from jaxmuscle._common.text import choices

from ._target_csv import AXES, GRID_TOLERANCE, check_linear, no_datasets, read_csv
from ._target_fields import (
    Columns,
    Raw,
    Rows,
    check_columns,
    fields_of,
    numbers_of,
    powers,
    settings_of,
)
from ._text_tables import TEXT

# In bins: digitised frequencies are up to two pixels off where 12 Hz are 600 pixels wide,
PIXEL_TOLERANCE = 0.1
# or, as a fraction of the frequency, one pixel where a decade is 230 pixels wide.
PIXEL_OF_LOG = 0.01
# In bins: as far beyond the first and the last frequency the power of a bin is that of the end; and
# how far apart frequencies may be if the powers of all bins between them are to follow.
REACH, COARSE = 0.1, 1.1
# What to do with other files of spectra, by their ending
PROJECT = ". Export the points of a WebPlotDigitizer project as CSV (View Data, Download .CSV)"
INSTEAD = {
    ".tar": PROJECT,
    ".json": f"{PROJECT}. `jaxmuscle compare` takes the spectrum of a fit.json",
}


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
    if kind == ".csv":
        return read_csv(text, file, dataset, axis)
    if dataset is not None:
        raise no_datasets(file, dataset)
    check_linear(axis, file)
    return _parse_toml(text, file)


def _read(name_or_path: str | os.PathLike[str]) -> tuple[str, str, str]:
    """What messages call the target, ".toml" or ".csv", and the text."""
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
    kind = path.suffix.lower()
    data = read_bytes(path, TargetError, instead="a .toml or .csv file", hint=hint)
    kind = ".csv" if kind in TEXT else kind
    if kind not in (".toml", ".csv"):
        raise TargetError(
            f"{path}: a target is a .toml or .csv file, not {kind or 'one without ending'}"
            f"{INSTEAD.get(kind, '')}"
        )
    return str(path), kind, text_of(data, str(path), TargetError)


def _parse_toml(text: str, file: str) -> Raw:
    fields = fields_of(parsed(text, file, "TOML", TargetError), file)
    lists = {
        key: numbers_of(key, fields.pop(key), file, empty="stiffness" in fields)
        for key in ("frequency_hz", "proportional_power", "sigma")
        if key in fields
    }
    frequency = lists["frequency_hz"]
    for key, values in lists.items():
        if values.size != frequency.size:
            raise TargetError(
                f"{file}: {key} has {values.size} entries, frequency_hz {frequency.size}; make them"
                " equal"
            )
    places = tuple(f"entry {i}" for i in range(1, frequency.size + 1))
    columns = Columns(frequency, lists["proportional_power"], lists.get("sigma"), places)
    check_columns(columns, file, ordered=True)
    stated = fields.get("settings", {})
    settings = fields["settings"] = settings_of(stated, f"{file}: [settings]")
    if "rate" in stated and frequency.size and frequency[-1] > settings.rate / 2:
        raise TargetError(
            f"{file}, {places[-1]}: frequency {frequency[-1]:g} Hz is above {settings.rate / 2:g}"
            " Hz, half of the rate in [settings]; make one of both right"
        )
    return Raw(file, fields, columns, [])


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
    away = np.abs(position - bins)
    first, last = settings.first_bin, settings.last_bin
    if np.all(away <= tolerance) and np.unique(bins).size == bins.size:
        points, notices = _inside(raw, bins, (bins >= first) & (bins <= last), away)
    elif trials is not None:
        raise TargetError("trial_power: needs frequencies that lie on the bins of the settings")
    else:
        points, notices = _interpolated(raw, position, np.maximum(tolerance, REACH))
    alone = "stiffness" in raw.fields and not columns.frequency.size
    if points.bins.size < 2 and not alone:
        raise TargetError(
            f"covers {points.bins.size} of the bins {first} to {last} ({settings.frequency[0]:.4g}"
            f" to {settings.frequency[-1]:.4g} Hz), at least 2 are needed; frequencies are in Hz"
        )
    return points, notices


def _inside(
    raw: Raw, bins: Int[np.ndarray, " rows"], inside: Any, away: Rows
) -> tuple[OnBins, list[str]]:
    """The rows that lie on bins of the settings, as they are."""
    _, power, sigma, _ = raw.columns
    settings, trials, notices = raw.fields["settings"], raw.fields.get("trial_power"), []
    if trials is not None:
        wanted = f"rows of {inside.size} numbers, as many as proportional_power has"
        trials = powers("trial_power", trials, (None, inside.size), wanted)[:, inside]
    if (off := np.max(away[inside], initial=0)) > GRID_TOLERANCE:
        notices.append(
            f"some frequencies lie up to {off:.2g} bins beside a bin, and count as that bin: a"
            " figure cannot be read more finely"
        )
    if lost := int(np.sum(~inside)):
        rows, are = ("1 row lies", "is") if lost == 1 else (f"{lost} rows lie", "are")
        notices.append(
            f"{rows} outside bins {settings.first_bin} to {settings.last_bin} and {are} left out"
        )
    return OnBins(
        bins[inside], power[inside], None if sigma is None else sigma[inside], trials
    ), notices


def _interpolated(raw: Raw, position: Rows, reach: Rows) -> tuple[OnBins, list[str]]:
    """The log powers of the bins between the rows, by straight lines."""
    frequency, power, sigma, _ = raw.columns
    settings, notices = raw.fields["settings"], []
    every = np.arange(settings.first_bin, settings.last_bin + 1)
    covered, lost = _between(every, position, reach)
    if lost:
        notices.append(
            f"{lost} bins lie farther than half a bin from any frequency, between two that"
            f" are more than {COARSE:g} bins apart: they are left out, as interpolated powers"
            " are no measurements"
        )
    # on a logarithmic axis the points of a figure are joined as they are seen
    at, known = (np.log(x) if raw.log_frequency else x for x in (covered, position))
    gap, scale = np.max(np.diff(frequency), initial=0), " over log frequency" * raw.log_frequency
    notices.append(
        f"the frequencies are not those of the bins, so the log power was interpolated{scale}"
        f" (widest gap {gap:.3g} Hz)"
    )
    columns = (values for values in (power, sigma) if values is not None)
    return OnBins(covered, *(np.exp(np.interp(at, known, np.log(x))) for x in columns)), notices


def _between(
    every: Int[np.ndarray, " bins"], position: Rows, reach: Rows
) -> tuple[Int[np.ndarray, " covered"], int]:
    """The bins between the first and the last frequency, and how many of them were left out because
    no frequency is near: one number is not to count as two."""
    bins = every[(every >= position[0] - reach[0]) & (every <= position[-1] + reach[-1])]
    right = np.clip(np.searchsorted(position, bins), 1, max(position.size - 1, 1))
    low, high = position[right - 1], position[np.minimum(right, position.size - 1)]
    known = (high - low <= COARSE) | (np.minimum(np.abs(bins - low), np.abs(bins - high)) <= 0.5)
    return bins[known], int(np.sum(~known))
