"""The time in a table: which column holds it, whether it is even, the rate that follows."""

import math
import re
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxmuscle.spectra._settings import require

from ._recording_table import Table, bare, find
from ._units import name_and_unit, seconds

_TIME = re.compile(
    r"(?:(?:elapsed[ _]?)?time|t|timestamp|zeit|temps|tiempo|tempo|tijd|tid|seconds)["
    r" _]*(s|sec|ms|msec|us)?"
)
RATE_TOLERANCE = 5e-3
JITTER = 0.25  # of a sampling interval


class Clock(NamedTuple):
    """The column that holds the time, how many seconds its unit has, and whether both are only
    guessed."""

    name: str
    scale: float
    guessed: bool


def clock(table: Table, asked: str | int | None = None, column: str | None = None) -> Clock | None:
    """The column that is asked for, or has the times of the `column`, or is called time, or has a
    unit of time; else a first one that rises evenly."""
    if asked is not None:
        name = find(table, asked, "time")
        return Clock(name, _scale(table, name) or 1.0, False)
    own = table.clocks.get(column or "")
    if own is not None:
        return Clock(own, _scale(table, own) or 1.0, False)
    called = [name for name in table.columns if _TIME.fullmatch(bare(name))]
    timed = [
        *called,
        *(name for name in table.columns if seconds(table.units.get(name)) is not None),
    ]
    if timed:
        return Clock(timed[0], _scale(table, timed[0]) or 1.0, False)
    first = next(iter(table.columns))
    if table.rates or len(table.columns) < 2 or first in (*table.units, *table.words):
        return None
    time = table.columns[first]()
    if time.size < 3 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
        return None
    even, interval, _ = _departure(time)
    return Clock(first, 1.0, True) if even and interval != 1 else None  # steps of 1 are a counter


def _scale(table: Table, name: str) -> float | None:
    found = _TIME.fullmatch(bare(name))
    return seconds(table.units.get(name) or name_and_unit(name)[1] or (found and found[1]))


def sampling(
    table: Table, name: str, time: Clock | None, rows: int, rate: float | int | None
) -> tuple[float, list[str]]:
    """Rate [Hz] of a column and notices: the rate given, else that of the time, else what the file
    states.

    **Raises:** `ValueError` if there is none, and if the rate given contradicts the times.
    """
    if rate is not None:
        number = isinstance(rate, int | float | np.number) and not isinstance(rate, bool)
        require(
            number and 0 < rate < math.inf, "rate", rate, "give samples per second [Hz], above 0"
        )
    stated = table.rates.get(name)
    measured = None if time is None or time.name == name else _rate(table, time, rows)
    if time is not None and measured is not None:
        found, begin, uncertainty = measured
        words, unit = [], "s"
        if (
            rate is not None
            and time.guessed
            and abs(rate / (1000 * found) - 1) <= RATE_TOLERANCE + uncertainty
        ):
            found, begin, unit = 1000 * found, begin / 1000, "ms"
        if rate is not None and abs(rate / found - 1) > RATE_TOLERANCE + uncertainty:
            raise ValueError(
                f"{table.file}: rate={rate:g} Hz contradicts the time column {time.name!r}, which"
                f" has {found:.6g} Hz; leave `rate` out, or rename the column (times are in s, or"
                " in ms if its name says so)"
            )
        if time.guessed:
            words.append(f"column {time.name} rises evenly and is taken as the time in {unit}")
        if abs(begin) >= 1.5 / found:
            words.append(
                f"the time column begins at {begin:g} s; here times count from the first sample"
            )
        return float(rate or _rounded(found)), words
    if rate is None and stated is None:
        raise ValueError(
            f"{table.file}: does not state its rate (no time column found); give `rate` in Hz, as"
            " rate=1000"
        )
    if rate is not None and stated is not None and abs(rate / stated - 1) > RATE_TOLERANCE:
        return float(rate), [f"rate {rate:g} Hz as asked; the file states {stated:g} Hz"]
    return float(rate or stated or 0.0), []


def _rounded(rate: float) -> float:
    """A whole number of samples per second, if it is one but for the rounding of the times."""
    return float(round(rate)) if abs(rate - round(rate)) < 1e-6 * rate else rate


@np.errstate(over="ignore", invalid="ignore")  # of times that no recording has: they are refused
def _rate(table: Table, clock: Clock, rows: int) -> tuple[float, float, float] | None:
    """Rate [Hz], first time [s] and relative uncertainty of the rate from the time column; `None`
    for another length.

    A column of times rounded to a fixed number of decimals is even if the exact times would be.

    **Raises:** `ValueError` naming line and times where the time is missing, does not rise or is
    not even.
    """
    name, time = clock.name, table.columns[clock.name]() * clock.scale
    if time.size != rows or rows < 2:
        return None
    for wrong, what in (
        (~np.isfinite(time), "holds no number"),
        (np.diff(time, prepend=time[0]) < 0, "runs backwards"),
    ):
        if np.any(wrong):
            raise ValueError(
                f"{table.file}, {table.place(int(np.argmax(wrong)))}: time column {name!r} {what}"
            )
    if not time[-1] > time[0]:
        raise ValueError(f"{table.file}: time column {name!r} stands still at {time[0]:g}")
    even, interval, rounding = _departure(time)
    if not even:
        at = int(np.argmax(np.diff(time)))
        raise ValueError(
            f"{table.file}: time column {name!r} is not uniform: after {time[at]:.6g} s"
            f" ({table.place(at)}) comes {time[at + 1]:.6g} s, on average {interval:.6g} s lie"
            " between two; resample it evenly, or leave the column out and give `rate`"
        )
    return 1 / interval, float(time[0]), rounding / (time[-1] - time[0])


def _departure(time: Float[np.ndarray, " rows"]) -> tuple[bool, float, float]:
    """Whether the times are even, the mean interval, and the unit of their last decimal."""
    interval = float(time[-1] - time[0]) / (time.size - 1)
    rounding = next(
        (10.0**-d for d in range(9) if np.max(np.abs(time - np.round(time, d))) <= 1e-12), 0.0
    )
    steps = np.diff(time)
    uneven = np.sum(np.abs(steps - np.median(steps)) > rounding / 2)
    # One or two odd steps are lost samples, and a step as coarse as many intervals is no rounding
    # either.
    rounding = rounding if uneven > 2 and rounding <= 5 * interval else 0.0
    departure = np.max(np.abs(time - time[0] - interval * np.arange(time.size)))
    return bool(departure <= JITTER * interval + rounding), interval, rounding
