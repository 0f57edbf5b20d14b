"""Checks of what a target is made of: the value in its stored form, or an error that says what is
right."""

import math
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Int

from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.text import choices, listed
from jaxmuscle.spectra._settings import FASTEST, SpectrumSettings

from ._measure import Measure

Quantity = Literal["force", "torque", "displacement", "acceleration"]
Provenance = Literal["measured", "digitised", "reconstructed", "user"]

# In bins: frequencies rounded to two decimals still count as on the default grid,
GRID_TOLERANCE = 0.02
# digitised ones up to two pixels off where 12 Hz are 600 pixels wide,
PIXEL_TOLERANCE = 0.1
# or, as a fraction of the frequency, one pixel where a decade is 230 pixels wide.
PIXEL_OF_LOG = 0.01
MOST = 10**9  # segments of a trial
MEASURED = ("value", "stderr", "low", "high", "unit", "error_from")


class Columns(NamedTuple):
    """Columns of equal length; `places` says for messages where each row stands ("line 7", "entry
    7")."""

    frequency: Float[np.ndarray, " rows"]
    power: Float[np.ndarray, " rows"]
    sigma: Float[np.ndarray, " rows"] | None
    places: tuple[str, ...]


def check_columns(columns: Columns, file: str, *, ordered: bool) -> None:
    """Refuse values that no spectrum has and, where `ordered`, frequencies that do not increase.

    **Raises:** `TargetError` naming file and row.
    """
    frequency, power, sigma, places = columns
    for i, place in enumerate(places):
        where = f"{file}, {place}"
        if not (math.isfinite(frequency[i]) and frequency[i] >= 0):
            raise TargetError(
                f"{where}: frequency {frequency[i]:g} must be finite and not negative [Hz]"
            )
        if frequency[i] > FASTEST / 2:
            raise TargetError(
                f"{where}: frequency {frequency[i]:g} Hz is above {FASTEST / 2:g} Hz, half of the"
                " fastest rate"
            )
        if not _usable(power[i]):
            problem = f"{where}: proportional_power {power[i]:g} must be finite and larger than 0"
            raise TargetError(f"{problem}; leave the row out if the power is not known")
        if sigma is not None and not _usable(sigma[i]):
            problem = f"{where}: sigma {sigma[i]:g} must be finite and larger than 0"
            raise TargetError(f"{problem}; leave sigma out altogether if it is not known")
        if ordered and i > 0 and frequency[i] <= frequency[i - 1]:
            fault = "appears twice" if frequency[i] in frequency[:i] else "is out of order"
            raise TargetError(
                f"{where}: frequency {frequency[i]:g} Hz {fault}; sort, one row per frequency"
            )


def _usable(value: Any) -> Any:
    """Finite and positive, with room for sums and ratios in float64."""
    return (value > 1e-100) & (value < 1e100)


def is_number(value: Any) -> bool:
    """Whether the value is a real number that a float can hold; `True` and `False` are not numbers
    here."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


def numbers_of(
    key: str, values: Any, file: str, *, empty: bool = False
) -> Float[np.ndarray, " rows"]:
    """A list of numbers as an array, which may be `empty` or not. Raises `TargetError` naming the
    entry that is none."""
    if not isinstance(values, list | tuple | np.ndarray) or not (empty or len(values)):
        raise TargetError(f"{file}: {key} must be a list of numbers")
    for i, value in enumerate(values, 1):
        if not is_number(value):
            raise TargetError(f"{file}, entry {i}: {key} {value!r} is not a number")
    return np.array([float(value) for value in values])


def metadata(name: str, value: Any) -> Any:
    """The value of the field `name` in its stored form: lists as tuples, `None` where it may be
    missing."""
    return None if value is None and name in OPTIONAL else CHECKS[name](name, value)


def _text(name: str, value: Any) -> str:
    if not isinstance(value, str) or not value.strip():
        raise TargetError(f"{name} {value!r}: give a text")
    return value


def _one_of(literal: Any) -> Callable[[str, Any], str]:
    options = get_args(literal)

    def check(name: str, value: Any) -> str:
        if value not in options:
            raise TargetError(f"unknown {name} {value!r}; {choices(str(value), options)}")
        return value

    return check


def _count(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, Integral) or not 1 <= int(value) <= MOST:
        raise TargetError(f"{name} {value!r}: give whole numbers of at least 1")
    return int(value)


def _fraction(name: str, value: Any) -> float:
    if not (is_number(value) and 0 < value <= 1):
        raise TargetError(
            f"{name} {value!r}: give a fraction above 0, at most 1, such as 0.0133 for 1.33 %"
        )
    return float(value)


def _positive(name: str, value: Any) -> float:
    if not (is_number(value) and _usable(float(value))):
        raise TargetError(f"{name} {value!r}: give a finite number above 0")
    return float(value)


def _each(
    check: Callable[[str, Any], Any], *, empty: bool = False
) -> Callable[[str, Any], tuple[Any, ...]]:
    def check_each(name: str, value: Any) -> tuple[Any, ...]:
        values = value.tolist() if isinstance(value, np.ndarray) else value
        entries = values if isinstance(values, list | tuple) else [values]
        if not (entries or empty):
            raise TargetError(f"{name} is an empty list; leave it out if it is not known")
        return tuple(check(name, entry) for entry in entries)

    return check_each


def _measures(name: str, value: Any) -> tuple[tuple[Any, ...], ...]:
    """Measures by name as rows (name, value, standard error, ends of the interval, unit, error
    from), None for what does not exist."""
    if isinstance(value, tuple):  # as stored
        return value
    rows = []
    for quantity, given in value.items() if isinstance(value, Mapping) else [(value, None)]:
        row: Any = given.row() if isinstance(given, Measure) else given
        fits = (
            isinstance(row, Mapping)
            and row.keys() <= {*MEASURED}
            and {"unit", "error_from"} <= row.keys()
        )
        if not (isinstance(quantity, str) and fits):
            raise TargetError(
                f"{name}: {quantity!r} needs a table with the keys {', '.join(MEASURED)}; the"
                " numbers may be missing"
            )
        numbers = [row.get(key) for key in MEASURED[:4]]
        for key, number in zip(MEASURED, numbers, strict=False):
            if number is not None and not is_number(number):
                raise TargetError(f"{name}.{quantity}: {key} {number!r} is not a number")
        known = [None if n is None or not math.isfinite(n) else float(n) for n in numbers]
        if (known[2] is None) != (known[3] is None):
            raise TargetError(f"{name}.{quantity}: give both low and high, or neither")
        words = (_text(f"{name}.{quantity}: {key}", row[key]) for key in MEASURED[4:])
        rows.append((quantity, *known, *words))
    return tuple(rows)


def measured_table(rows: tuple[tuple[Any, ...], ...]) -> dict[str, dict[str, Any]]:
    """The reverse: what a file holds, without what does not exist."""
    return {
        name: {key: value for key, value in zip(MEASURED, row, strict=True) if value is not None}
        for name, *row in rows
    }


CHECKS: dict[str, Callable[[str, Any], Any]] = {
    "name": _text,
    "quantity": _one_of(Quantity),
    "provenance": _one_of(Provenance),
    "source": _text,
    "segments": _each(_count),
    "coefficient_of_variation": _each(_fraction),
    "mvc_fraction": _fraction,
    "mean": _each(_positive),
    "unit": _text,
    "recorded_at": _positive,
    "dispersion": _each(_positive),
    "reason": _text,
    "measured": _measures,
    "notices": _each(_text, empty=True),
}
OPTIONAL = (
    "segments",
    "coefficient_of_variation",
    "mvc_fraction",
    "mean",
    "unit",
    "recorded_at",
    "dispersion",
    "reason",
    "measured",
)


def bin_numbers(values: Any, settings: SpectrumSettings) -> Int[np.ndarray, " bins"]:
    """Increasing bin numbers within the range of the settings."""
    bins, (first, last) = np.array(values), (settings.first_bin, settings.last_bin)
    whole = bins.ndim == 1 and np.issubdtype(bins.dtype, np.integer)
    if not whole or np.any(np.diff(bins) < 1) or np.any(bins < first) or np.any(bins > last):
        raise TargetError(
            f"bins {listed(bins.ravel())}: give increasing whole numbers from {first} to {last}"
        )
    return bins.astype(int)


def positive(name: str, values: Any, size: int) -> Float[np.ndarray, " bins"]:
    """One finite number above 0 for each bin."""
    try:
        array = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise TargetError(f"{name}: give numbers, one for each bin") from None
    if array.shape != (size,) or size < 2:
        raise TargetError(
            f"{name} has shape {array.shape}; give one number for each of at least 2 bins ({size}"
            " here)"
        )
    if not np.all(_usable(array)):
        raise TargetError(
            f"{name}: every value must be finite and larger than 0; leave out bins that are not"
            " known"
        )
    return array


def trial_powers(
    values: Any, bins: int, segments: tuple[int, ...] | None, power: np.ndarray
) -> np.ndarray:
    """Spectra of trials, one row each, whose mean, weighted with their segments, has the shape of
    `power`."""
    try:
        rows = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise TargetError("trial_power: give a row for each trial, a number for each bin") from None
    if segments is None or rows.shape != (len(segments), bins) or len(rows) < 2:
        known = (
            "no segments are stated"
            if segments is None
            else f"segments names {len(segments)} trials"
        )
        raise TargetError(
            f"trial_power has shape {rows.shape}, and {known}; give 2 rows or more, one for each"
            f" entry of segments, of {bins} bins each"
        )
    if not np.all(_usable(rows)):
        raise TargetError("trial_power: every value must be finite and larger than 0")
    mean = np.average(rows, axis=0, weights=segments)
    if not np.allclose(mean / mean.sum(), power / power.sum(), rtol=1e-6):
        raise TargetError(
            "trial_power: its mean over the trials, weighted with their segments, is not"
            " proportional_power; leave one of both out or make it right"
        )
    return frozen(rows)


def frozen(values: np.ndarray) -> np.ndarray:
    """The array, made read-only."""
    values.setflags(write=False)
    return values
