"""What a target is made of: each field with its check and what it means in a file; the value in its
stored form, or an error that says what is right."""

import math
from collections.abc import Callable, Mapping
from numbers import Integral, Real
from typing import Annotated, Any, Literal, NamedTuple, get_args

import msgspec
import numpy as np
from jaxtyping import Float, Int

from jaxmuscle._common.arguments import is_real
from jaxmuscle._common.documents import Table, checked, says
from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.text import choices, listed
from jaxmuscle.spectra._settings import FASTEST, SpectrumSettings

from ._measure import Measure

Quantity = Literal["force", "torque", "displacement", "acceleration"]
Provenance = Literal["measured", "digitised", "reconstructed", "user"]
Rows = Float[np.ndarray, " rows"]

MOST_SEGMENTS = 10**9  # of a trial
MEASURED = ("value", "stderr", "low", "high", "unit", "error_from")


class Columns(NamedTuple):
    """Columns of equal length; `places` says for messages where each row stands ("line 7", "entry
    7")."""

    frequency: Rows
    power: Rows
    sigma: Rows | None
    places: tuple[str, ...]


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


def check_columns(columns: Columns, file: str, *, ordered: bool) -> None:
    """Refuse values that no spectrum has and, where `ordered`, frequencies that do not increase.

    **Raises:** `TargetError` naming file and row.
    """
    frequency, power, sigma, places = columns
    for i, (f, place) in enumerate(zip(frequency, places, strict=True)):
        where = f"{file}, {place}"
        if not (math.isfinite(f) and f >= 0):
            raise TargetError(f"{where}: frequency {f:g} must be finite and not negative [Hz]")
        if f > FASTEST / 2:
            raise TargetError(
                f"{where}: frequency {f:g} Hz is above {FASTEST / 2:g} Hz, half of the fastest rate"
            )
        for name, values, remedy in (
            ("proportional_power", power, "leave the row out if the power is not known"),
            ("sigma", sigma, "leave sigma out altogether if it is not known"),
        ):
            if values is not None and not _usable(values[i]):
                raise TargetError(
                    f"{where}: {name} {values[i]:g} must be finite and larger than 0; {remedy}"
                )
        if ordered and i > 0 and f <= frequency[i - 1]:
            fault = "appears twice" if f in frequency[:i] else "is out of order"
            raise TargetError(f"{where}: frequency {f:g} Hz {fault}; sort, one row per frequency")


def _usable(value: Any) -> Any:
    """Finite and positive, with room for sums and ratios in float64."""
    return (value > 1e-100) & (value < 1e100)


def _is_number(value: Any) -> bool:
    """Whether the value is a real number that a float can hold; `True` and `False` are not numbers
    here."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        return False
    try:
        float(value)
    except OverflowError:
        return False
    return True


def numbers_of(key: str, values: Any, file: str, *, empty: bool = False) -> Rows:
    """A list of numbers as an array, which may be `empty` or not. Raises `TargetError` naming the
    entry that is none."""
    if not isinstance(values, list | tuple | np.ndarray) or not (empty or len(values)):
        raise TargetError(f"{file}: {key} must be a list of numbers")
    for i, value in enumerate(values, 1):
        if not _is_number(value):
            raise TargetError(f"{file}, entry {i}: {key} {value!r} is not a number")
    return np.array(values, float)


Check = Callable[[str, Any], Any]


def _only(kind: Callable[[Any], Any], holds: Callable[[Any], Any], remedy: str) -> Check:
    """A check of one value: it must hold, and is stored as its kind."""

    def check(name: str, value: Any) -> Any:
        if not holds(value):
            raise TargetError(f"{name} {value!r}: give {remedy}")
        return kind(value)

    return check


def _one_of(literal: Any) -> Check:
    options = get_args(literal)

    def check(name: str, value: Any) -> str:
        if value not in options:
            raise TargetError(f"unknown {name} {value!r}; {choices(str(value), options)}")
        return value

    return check


def _each(check: Check, *, empty: bool = False) -> Check:
    def check_each(name: str, value: Any) -> tuple[Any, ...]:
        values = value.tolist() if isinstance(value, np.ndarray) else value
        entries = values if isinstance(values, list | tuple) else [values]
        if not (entries or empty):
            raise TargetError(f"{name} is an empty list; leave it out if it is not known")
        return tuple(check(name, entry) for entry in entries)

    return check_each


def _is_whole(value: Any) -> bool:
    return (
        isinstance(value, Integral)
        and not isinstance(value, bool)
        and 1 <= int(value) <= MOST_SEGMENTS
    )


_text = _only(str, lambda value: isinstance(value, str) and value.strip(), "a text")
_count = _only(int, _is_whole, "whole numbers of at least 1")
_fraction = _only(
    float,
    lambda value: _is_number(value) and 0 < value <= 1,
    "a fraction above 0, at most 1, such as 0.0133 for 1.33 %",
)
_positive = _only(
    float, lambda value: _is_number(value) and _usable(float(value)), "a finite number above 0"
)


def _format(name: str, value: Any) -> int:
    if type(value) is not int or value != 1:
        raise TargetError(f"{name} = {value!r}: this version of jaxmuscle reads format 1")
    return value


class MeasureTable(Table):
    """A measured number as a table; what does not exist is missing."""

    unit: str
    error_from: str
    value: float = math.nan
    stderr: float = math.nan
    low: float = math.nan
    high: float = math.nan


def _measures(name: str, value: Any) -> tuple[tuple[Any, ...], ...]:
    """Measures by name as rows (name, value, standard error, ends of the interval, unit, error
    from), None for what does not exist."""
    if isinstance(value, tuple):  # as stored
        return value
    if not isinstance(value, Mapping):
        raise TargetError(f"{name} {value!r}: give a table for each quantity, by its name")
    rows = []
    for quantity, given in value.items():
        where = f"{name}.{quantity}"
        if not isinstance(given, Measure | Mapping):
            raise TargetError(f"{where}: needs a table with the keys {', '.join(MEASURED)}")
        said = dict(given.row() if isinstance(given, Measure) else given)
        row = msgspec.structs.asdict(checked(said, MeasureTable, where, TargetError))
        if is_real(row["low"]) != is_real(row["high"]):
            raise TargetError(f"{where}: give both low and high, or neither")
        # NaN is what does not exist
        known = (v if isinstance(v, str) or is_real(v) else None for v in map(row.get, MEASURED))
        rows.append((quantity, *known))
    return tuple(rows)


def measured_table(rows: tuple[tuple[Any, ...], ...]) -> dict[str, dict[str, Any]]:
    """The reverse: what a file holds, without what does not exist."""
    return {
        name: {key: value for key, value in zip(MEASURED, row, strict=True) if value is not None}
        for name, *row in rows
    }


class Field(NamedTuple):
    """A key of a target's table: its check where it is checked alone, what it means, its type, and
    what its absence says, of one that may be missing."""

    check: Check | None
    meaning: str
    kind: str
    missing: str | None = None


_POSITIVES = "numbers, each above 0"
FIELDS = {
    "name": Field(_text, "How reports call it", "text"),
    "quantity": Field(
        _one_of(Quantity), "What was recorded", f"one of {', '.join(get_args(Quantity))}"
    ),
    "provenance": Field(
        _one_of(Provenance),
        "From where the numbers are",
        f"one of {', '.join(get_args(Provenance))}",
    ),
    "source": Field(_text, "Article, figure, recording", "text"),
    "frequency_hz": Field(
        None,
        "Frequencies [Hz], rising; empty if there is a stiffness, but no spectrum",
        "list of numbers, each at least 0",
    ),
    "proportional_power": Field(
        None,
        "Power at each frequency, of any scale; empty if there is no spectrum",
        f"list of {_POSITIVES}",
    ),
    "sigma": Field(
        None,
        "Standard error of each averaged power, in the unit of the power",
        f"list of {_POSITIVES}",
        "errors follow from `segments`",
    ),
    "segments": Field(
        _each(_count),
        "Welch segments that were averaged, of each trial; one number means one recording",
        "whole number from 1, or a list of them",
        "errors follow from `sigma`; without it they are unknown, and so is chi²",
    ),
    "coefficient_of_variation": Field(
        _each(_fraction),
        "Standard deviation over mean, of each trial",
        "number above 0, at most 1, or a list of them",
        "unknown",
    ),
    "mvc_fraction": Field(
        _fraction,
        "Mean level as a share of the maximum",
        "number above 0, at most 1",
        "unknown",
    ),
    "mean": Field(
        _each(_positive),
        "Mean force or torque of each trial, in `unit`",
        "number above 0, or a list of them",
        "unknown",
    ),
    "unit": Field(_text, "Unit of `mean`", "text", "unknown: `mean` fixes no scale of force"),
    "recorded_at": Field(
        _positive,
        "Rate of the recording [Hz], before it was resampled; its aliases are expected if"
        " `sampling` in `settings` is filtered",
        "number above 0",
        "no aliases are expected",
    ),
    "dispersion": Field(
        _each(_positive),
        "Dispersion of the trials (1 if they are alike), and its error",
        f"list of two {_POSITIVES}",
        "follows from `trial_power`; else unknown",
    ),
    "reason": Field(
        _text, "What was assumed", "text", "nothing; an error if `provenance` is reconstructed"
    ),
    "notices": Field(
        _each(_text, empty=True), "What was done to the numbers", "list of texts", "no notices"
    ),
    "trial_power": Field(
        None,
        "Spectrum of each trial: a row for each of `segments`, with a power for each of"
        " `frequency_hz`, in one unit. Weighted with `segments`, their mean has the shape of"
        " `proportional_power`",
        f"list of rows, each a list of {_POSITIVES}",
        "unknown",
    ),
    "stiffness": Field(
        None, "Dynamic stiffness measured beside it", "table, see below", "not measured"
    ),
    "measured": Field(
        _measures,
        "What `jaxmuscle steadiness` measures of the recordings: for each quantity a table with"
        " `value`, `stderr`, `low` and `high` (ends of the 95 % interval), `unit`, `error_from`",
        "table of tables",
        "measured of the bins",
    ),
    "settings": Field(
        None,
        "How the spectrum was estimated: the fields of `SpectrumSettings`",
        "table",
        "their defaults",
    ),
}
# which are checked alone and kept as they are stated
ALONE = [key for key, field in FIELDS.items() if field.check and key not in ("notices", "measured")]
_FORMAT = Field(_format, "Version of the format", "1", "1")
_KEYS: Any = [
    (
        key,
        Annotated[Any, says(field.meaning, missing=field.missing, kind=field.kind)],
        *(() if field.missing is None else (None,)),
    )
    for key, field in ({"format": _FORMAT} | FIELDS).items()
]
TargetFile = msgspec.defstruct(
    "TargetFile",
    _KEYS,
    bases=(Table,),
    kw_only=True,
    module=__name__,
    namespace={"__doc__": "A target: in a .toml, and as `target_table` in a fit.json."},
)


def metadata(name: str, value: Any) -> Any:
    """The value of the field `name` in its stored form: lists as tuples, `None` where it may be
    missing."""
    field = FIELDS[name]
    if field.check is None or (value is None and field.missing is not None):
        return value
    return field.check(name, value)


def fields_of(table: Mapping[str, Any], file: str, *, whole: bool = False) -> dict[str, Any]:
    """The keys of a target's table, those that are checked alone in their stored form; of a `whole`
    table, as in fit.json, none may be missing, though it may be None.

    **Raises:** `TargetError` for a key that is unknown, missing or wrong.
    """
    checked(dict(table), TargetFile, file, TargetError)
    missing = [key for key in FIELDS if key not in table]
    if whole and missing:
        raise TargetError(
            f"{file}: the key {missing[0]!r} is missing; needed are {', '.join(FIELDS)}"
        )
    try:
        _format("format", table.get("format", 1))
        return {key: metadata(key, table[key]) for key in FIELDS if key in table}
    except TargetError as error:
        raise TargetError(f"{file}: {error}") from None


def settings_of(table: Any, where: str, *, whole: bool = False) -> SpectrumSettings:
    """Spectrum settings of a target's table. Raises `TargetError`."""
    if not isinstance(table, dict):
        raise TargetError(
            f"{where}: settings must be a table: a line [settings], then one setting per line"
        )
    if misplaced := [key for key in table if key in FIELDS]:
        raise TargetError(
            f"{where}: {', '.join(misplaced)}: of the target, not of its settings. Move this above"
            " the line [settings]: below it everything counts as a setting"
        )
    try:
        return SpectrumSettings.from_dict(table, whole=whole)
    except ValueError as error:
        raise TargetError(f"{where}: {error}") from None


def bin_numbers(values: Any, settings: SpectrumSettings) -> Int[np.ndarray, " bins"]:
    """Increasing bin numbers within the range of the settings."""
    bins, (first, last) = np.array(values), (settings.first_bin, settings.last_bin)
    whole = bins.ndim == 1 and np.issubdtype(bins.dtype, np.integer)
    if not whole or np.any(np.diff(bins) < 1) or np.any((bins < first) | (bins > last)):
        raise TargetError(
            f"bins {listed(bins.ravel())}: give increasing whole numbers from {first} to {last}"
        )
    return bins.astype(int)


def powers(name: str, values: Any, shape: tuple[int | None, ...], wanted: str) -> np.ndarray:
    """Finite numbers above 0 of a shape, in which `None` is any number from 2 on; what is `wanted`
    in words."""
    try:
        # the layout decides the last digit of sums, by which a target read back would differ
        array = np.array(values, dtype=float, order="C")
    except (TypeError, ValueError):
        raise TargetError(f"{name}: give numbers, {wanted}") from None
    fits = len(shape) == array.ndim and all(
        found >= 2 and size in (None, found) for size, found in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise TargetError(f"{name} has shape {array.shape}; give {wanted}")
    if not np.all(_usable(array)):
        raise TargetError(
            f"{name}: every value must be finite and larger than 0; leave out bins that are not"
            " known"
        )
    return array


def bin_powers(name: str, values: Any, size: int) -> Float[np.ndarray, " bins"]:
    """One finite number above 0 for each bin."""
    return powers(name, values, (size,), f"one number for each of at least 2 bins ({size} here)")


def trial_powers(values: Any, segments: tuple[int, ...] | None, power: np.ndarray) -> np.ndarray:
    """Spectra of trials, one row each, whose mean, weighted with their segments, has the shape of
    `power`."""
    bins, known = (
        power.size,
        "no segments are stated" if segments is None else f"segments names {len(segments)} trials",
    )
    wanted = f"2 rows or more, one for each entry of segments, of {bins} bins each ({known})"
    rows = powers("trial_power", values, (len(segments or ()), bins), wanted)
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
