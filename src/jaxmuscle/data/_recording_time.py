"""The time in a table: which column holds it, its unit, whether it is even, the rate that follows,
and where each row lies."""

import itertools
import math
import re
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxmuscle._common.arguments import is_real, require
from jaxmuscle._common.text import listed

from ._recording_table import Table, bare, find
from ._units import name_and_unit, seconds

_TIME = re.compile(
    r"(?:(?:(?:elapsed|host|sensor|unix|system|sample)[ _]?)?time(?:[ _]?stamp)?|t|elapsed"
    r"|zeit(?:stempel)?|temps|tiempo|tempo|tijd|tid|seconds|(milli|micro)s)"
    r"[ _]*(s|sec|ms|msec|us|ns)?"
)
RATE_TOLERANCE = 5e-3
JITTER = 0.25  # of a sampling interval
LOOSE = 0.05  # by how much a rate that is asked for may differ from that of uneven times
# days are those of spreadsheets
READINGS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "days": 86400.0}
SLOWEST, FASTEST = 24.0, 20_000.0  # Hz, between which the times of a recording are read
LASTS = 3 * 3600.0  # s, a recording of a sample each second, or of ten, hardly lasts longer
EPOCH = 1e9, 4.2e9  # s since 1970: the years 2001 to 2103
RARE = 0.05  # share of odd steps
TOGETHER, PACKETS = 0.1, 0.25  # of an interval: rows of one packet; share of such rows
WIDE = 2.5  # intervals that are no jitter any more
SEEN = 5  # packets before and after a lost one
FIGURES = 12  # of numbers in messages
_REMEDY = "give time='none' and `rate`, if the rows are even without these times"


class Clock(NamedTuple):
    """The column that holds the time, how many seconds its unit has (`None`: none is stated),
    whether it is only guessed, and whether its times are used."""

    name: str
    scale: float | None
    guessed: bool = False
    used: bool = True


class Part(NamedTuple):
    """Rows between two pauses: which, when the first one is [s], and how many intervals after it
    each one lies.

    `position` is `None` for even rows, whole for rows of which some are missing, else uneven.
    """

    start: float
    rows: slice
    position: Int[np.ndarray, " rows"] | Float[np.ndarray, " rows"] | None = None

    def on_grid(
        self, signal: Float[np.ndarray, "all columns"]
    ) -> Float[np.ndarray, "even columns"]:
        """The signal at even times, NaN where rows are missing.

        Rows on the grid keep their values. Between uneven ones is a cubic spline: at a jitter of
        half an interval it keeps the power up to an eighth of the rate within 1 %, of which
        straight lines lose 15 %.
        """
        x, at = signal[self.rows], self.position
        if at is None:
            return x
        even = np.full((int(at[-1]) + 1, x.shape[1]), np.nan)
        if at.dtype.kind == "i":
            even[at] = x
            return even
        grid = np.arange(len(even))
        for column, found in zip(x.T, even.T, strict=True):
            there = ~np.isnan(column)
            t, y = _merged(at[there], column[there])
            if len(t) >= 2:
                after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
                near = t[after] - t[after - 1] <= WIDE
                found[near] = scipy.interpolate.CubicSpline(t, y, extrapolate=False)(grid[near])
        return even


class Sampling(NamedTuple):
    """How a column is sampled: `rate` [Hz], what to say of it, its parts, the longest first, and
    the seconds of its rows (`None`: even)."""

    rate: float
    notices: list[str]
    parts: list[Part]
    time: Float[np.ndarray, " rows"] | None = None


def _merged(t: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows that lie closer than a tenth of an interval as one: a spline between them would swing
    with their noise."""
    first = np.flatnonzero(np.diff(t, prepend=-math.inf) >= TOGETHER)
    counts = np.diff(first, append=len(t))
    if len(first) in (0, len(t)):
        return t, y
    return np.add.reduceat(t, first) / counts, np.add.reduceat(y, first) / counts


def clock(table: Table, asked: str | int | None = None, column: str | None = None) -> Clock | None:
    """The column that is asked for, or has the times of the `column`, or is called time, or has a
    unit of time; else a first one that rises nearly evenly. `none` leaves the times out."""
    if str(asked).casefold() == "none" and asked not in (None, *table.columns):
        found = clock(table, None, column)
        return None if found is None else found._replace(used=False)
    own = table.clocks.get(column or "") if asked is None else find(table, asked, "time")
    called = (name for name in table.columns if _TIME.fullmatch(bare(name)))
    timed = (name for name in table.columns if seconds(table.units.get(name)) is not None)
    name = own or next(itertools.chain(called, timed), None)
    if name is not None:
        return Clock(name, _scale(table, name))
    first = next(iter(table.columns))
    if table.rates or len(table.columns) < 2 or first in (*table.units, *table.words):
        return None
    time = table.columns[first]()
    if time.size < 3 or not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0):
        return None
    steps = np.diff(time)
    usual = float(np.median(steps))
    even = _departure(time)[0] or np.mean(np.abs(steps - usual) < 0.5 * usual) > 0.9
    return Clock(first, None, guessed=True) if even and usual != 1 else None  # 1: a counter


def _scale(table: Table, name: str) -> float | None:
    found = _TIME.fullmatch(bare(name))
    small = {"milli": "ms", "micro": "us"}.get(str(found and found[1]))
    return seconds(table.units.get(name) or name_and_unit(name)[1] or (found and found[2]) or small)


def sampling(
    table: Table,
    name: str,
    time: Clock | None,
    rows: int,
    rate: float | int | None,
    longest: float,
) -> Sampling:
    """How a column is sampled: at the rate given, else that of the time, else what the file states.

    Times that are not even are brought to a grid; at gaps longer than `longest` [s] the rows are
    cut into parts.

    **Raises:** `ValueError` if there is no rate, and if the rate given contradicts the times.
    """
    if rate is not None:
        remedy = "give samples per second [Hz], above 0"
        require(is_real(rate) and rate > 0, "rate", rate, remedy)
    stated = table.rates.get(name)
    words: list[str] = []
    if time is not None and time.name != name:
        if not time.used:
            words = [f"the times in column {time.name} are left out as asked: rows count as even"]
        elif table.columns[time.name]().size == rows >= 2:
            return _timed(table, time, rate, longest)
    if rate is None and stated is None:
        why = "time='none' leaves the times out" if words else "no time column found"
        raise ValueError(
            f"{table.file}: does not state its rate ({why}); give `rate` in Hz, as rate=1000"
        )
    if rate is not None and stated is not None and abs(rate / stated - 1) > RATE_TOLERANCE:
        words.append(f"rate {rate:g} Hz as asked; the file states {stated:g} Hz")
    return Sampling(float(rate or stated or 0.0), words, [Part(0.0, slice(0, rows))])


@np.errstate(over="ignore", invalid="ignore")  # of times that no recording has: they are refused
def _timed(table: Table, clock: Clock, rate: float | int | None, longest: float) -> Sampling:
    """The same by the times of a column.

    **Raises:** `ValueError` naming line and times where the time is missing, runs backwards, or is
    no time.
    """
    raw = table.columns[clock.name]()
    _check_rising(table, clock, raw)
    usual = _usual(raw)
    unit, words = _unit_of(table, clock, raw, usual, rate)
    if unit is None:
        return Sampling(float(rate or 0.0), words, [Part(0.0, slice(0, raw.size))])
    # An epoch needs all digits for its seconds.
    begin, time = float(raw[0]) * unit, (raw - raw[0]) * unit
    fine = 1e-12 + 4 * np.finfo(float).eps * unit * float(np.max(np.abs(raw[[0, -1]])))
    even, interval, rounding = _departure(time, fine)
    parts, slack = [Part(0.0, slice(0, raw.size))], RATE_TOLERANCE + rounding / time[-1]
    if not even:
        interval, parts, more = _placed(table, clock, time, rounding, longest)
        words += more
    found, uneven = _rounded(1 / interval), _is_uneven(parts)
    slack = LOOSE if uneven else slack
    if rate is not None and abs(rate * interval - 1) > slack:
        raise ValueError(
            f"{table.file}: rate={rate:g} Hz contradicts the time column {clock.name!r}, which"
            f" has {found:.6g} Hz; leave `rate` out, or give time='none' as well: then the rows"
            " count as even (times are in s unless the name or a unit says another)"
        )
    if uneven:
        found = float(rate or _simple(found))
        steps = np.diff(time)
        words.append(
            f"the times are uneven (steps of {np.min(steps):.3g} to"
            f" {np.max(steps[steps <= longest + interval]):.3g} s, on average {interval:.4g} s):"
            f" the signal was brought to {found:g} Hz by cubic splines"
        )
        parts = [p._replace(position=np.asarray(p.position) * interval * found) for p in parts]
    if abs(begin) >= 1.5 * interval:
        words.append(
            f"the time column begins at {begin:g} s; here times count from the first sample"
        )
    parts.sort(key=lambda part: part.rows.start - part.rows.stop)
    return Sampling(float(rate or found), words, parts, None if even else time)


def _is_uneven(parts: list[Part]) -> bool:
    return any(part.position is not None and part.position.dtype.kind == "f" for part in parts)


def _usual(time: Float[np.ndarray, " rows"]) -> float:
    """The usual interval, in whatever unit: gaps do not count, nor how rows come in packets."""
    lag = min(256, max(1, time.size // 4))
    return float(np.median(time[lag:] - time[:-lag])) / lag


def _check_rising(table: Table, clock: Clock, raw: Float[np.ndarray, " rows"]) -> None:
    """**Raises:** `ValueError` naming the line of a time that is none, or before the last one."""
    lost, back = ~np.isfinite(raw), np.diff(raw, prepend=raw[0]) < 0
    at = int(np.argmax(lost if np.any(lost) else back))
    if back[at]:
        begin, before, now = raw[0], raw[at - 1], raw[at]
        fault = f"runs backwards, from {before:.{FIGURES}g} to {now:.{FIGURES}g}; "
        if now <= begin + 0.1 * (before - begin):
            fault += "a second recording may begin there: save each on its own. Or "
        raise _fault(table, clock, at, fault)
    if lost[at]:
        raise _fault(table, clock, at, "holds no number; ")
    if not raw[-1] > raw[0]:
        raise ValueError(
            f"{table.file}: time column {clock.name!r} stands still at {raw[0]:g}; {_REMEDY}"
        )


def _fault(table: Table, clock: Clock, row: int, words: str) -> ValueError:
    """What is wrong with the time in a row."""
    return ValueError(
        f"{table.file}, {table.place(row)}: time column {clock.name!r} {words}{_REMEDY}"
    )


def _unit_of(
    table: Table,
    clock: Clock,
    raw: Float[np.ndarray, " rows"],
    usual: float,
    rate: float | int | None,
) -> tuple[float | None, list[str]]:
    """Seconds in the unit of the times, and what to say of it; `None` where they only count rows.

    Without a stated unit a rate decides, then a date (seconds since 1970), then the size: in one of
    ms, us, ns and days at most they have a rate from 24 Hz to 20 kHz; s are taken from 10 Hz on.
    Whole equal steps that are small may also count rows or ticks.
    """
    if clock.scale is not None:
        return clock.scale, []
    rates = {unit: 1 / (scale * usual) if usual > 0 else 0.0 for unit, scale in READINGS.items()}
    whole = np.all(raw == np.round(raw)) and usual == round(usual) and usual < 2 * SLOWEST
    counts = bool(whole and np.all(np.diff(raw) % usual == 0))
    by_rate = [unit for unit in rates if rate and abs(rates[unit] / rate - 1) <= LOOSE]
    begin, end = EPOCH
    dated = [u for u in rates if begin <= raw[0] * READINGS[u] <= end and rates[u] >= 1]
    small = [u for u in rates if u != "s" and SLOWEST <= rates[u] <= FASTEST]
    as_seconds = 10 <= rates["s"] <= 1e6
    unit = [*by_rate, *([] if as_seconds else dated + small), "s"][0]
    if not by_rate and rate and usual == 1 and counts:
        return None, [f"column {clock.name} counts the rows: their rate is {rate:g} Hz as asked"]
    asks = counts or (rates["s"] >= 1 and (raw[-1] - raw[0]) <= LASTS)
    if unit != "s" and not by_rate and not dated and rate is None and asks:
        look = f"{unit} or row numbers" if usual == 1 else unit
        named = f"name the column {clock.name}_{unit} or " * table.named
        raise ValueError(
            f"{table.file}: column {clock.name}: times look like {look} ({raw.size} rows, step"
            f" {usual:g}): {named}give rate={float(f'{rates[unit]:.6g}'):g}"
        )
    words = f"column {clock.name} rises evenly and is taken as the time in {unit}"
    if not clock.guessed:
        words = f"column {clock.name} states no unit and is taken as {unit} (step {usual:.6g})"
    return READINGS[unit], [words] * (clock.guessed or unit != "s")


def _placed(
    table: Table,
    clock: Clock,
    time: Float[np.ndarray, " rows"],
    rounding: float,
    longest: float,
) -> tuple[float, list[Part], list[str]]:
    """Where rows lie whose times are not even: the interval, the parts between pauses, and what to
    say.

    **Raises:** `ValueError` for times that stand twice, and for those of no regular sampling.
    """
    steps, usual = np.diff(time), _usual(time)
    coarse = next((10.0**-d for d in range(9) if np.allclose(time, np.round(time, d), 0, 1e-9)), 0)
    if np.mean(steps < TOGETHER * usual) >= PACKETS:
        found = _in_packets(time, usual, longest)
        if found is not None:
            return found
    # Rounding brings two rows together where the times are uneven, not where all others are even.
    elif np.any(steps == 0) and (
        coarse < TOGETHER * usual or np.mean(np.abs(steps - usual) > JITTER * usual) < RARE
    ):
        words = "has the time of the row before again; if the row stands there twice, take one out."
        raise _fault(table, clock, int(np.argmax(steps == 0)) + 1, f"{words} Or ")
    interval, near = float(np.median(steps)), steps[steps <= longest + usual]
    for _ in range(2):  # the second round counts the rows in long gaps rightly
        interval = float(np.sum(near) / max(np.sum(np.round(near / interval)), 1))
    if not np.mean(np.abs(steps / interval - 1) <= 0.6) > 0.5:
        at = int(np.argmax(steps))
        raise ValueError(
            f"{table.file}: time column {clock.name!r} is not uniform: after {time[at]:.6g} s"
            f" ({table.place(at)}) comes {time[at + 1]:.6g} s, on average {interval:.6g} s lie"
            f" between two; {_REMEDY}"
        )
    parts = []
    tolerance = min(JITTER + rounding / interval, 0.45)
    for rows in _slices(steps - interval > max(longest, 0.75 * interval)):
        start = float(time[rows.start])
        position = (time[rows] - start) / interval
        # the first row may itself be late: the grid lies where most rows are
        whole = np.round(position - np.median(position - np.round(position))).astype(int)
        even = np.ptp(position - whole) <= 2 * tolerance and np.all(np.diff(whole) >= 1)
        parts.append(Part(start, rows, whole - whole[0] if even else position))
    if _is_uneven(parts):  # steps are no multiples, so none can be counted
        interval = float(np.mean(steps[np.abs(steps - usual) < 0.5 * usual]))
        parts = [p._replace(position=(time[p.rows] - p.start) / interval) for p in parts]
    return interval, parts, _words_of(parts, time)


def _slices(ends: np.ndarray) -> list[slice]:
    """The rows of the parts, of which these steps are the ends."""
    edges = [0, *(np.flatnonzero(ends) + 1).tolist(), ends.size + 1]
    return [slice(a, b) for a, b in itertools.pairwise(edges)]


def _words_of(parts: list[Part], time: Float[np.ndarray, " rows"]) -> list[str]:
    """What to say of missing rows and of pauses."""
    words, missing, first = [], 0, math.inf
    least = WIDE if _is_uneven(parts) else 1
    for part in parts:
        steps = np.diff(np.asarray(part.position))
        holes = np.flatnonzero(steps > least)
        if holes.size:
            missing += round(float(np.sum(np.round(steps[holes]) - 1)))
            first = min(first, time[part.rows.start + holes[0]])
    if missing:
        are = "row is" if missing == 1 else "rows are"
        words.append(f"{missing} {are} missing in the times, the first after {first:.3f} s")
    if len(parts) > 1:
        spans = [f"{time[p.rows.start]:.6g}:{time[p.rows.stop - 1]:.6g}" for p in parts]
        words.append(
            f"the times pause: the recording is cut into the parts {listed(spans, 5)} s."
            " The longest is taken, unless the window lies in another"
        )
    return words


def _in_packets(
    time: Float[np.ndarray, " rows"], usual: float, longest: float
) -> tuple[float, list[Part], list[str]] | None:
    """The same of rows that come several at a time: they are even, and the times are those of their
    arrival.

    A packet is lost where all later ones come late by more than half a packet: the earliest of the
    next ones against the earliest of those before. `None` if the rows do not fit such times.
    """
    ends = np.append(np.flatnonzero(np.diff(time) >= TOGETHER * usual), time.size - 1)
    arrival, counts = time[ends], np.diff(ends, prepend=-1)
    if len(ends) < 2 * SEEN:
        return None
    size, lost, interval = float(np.median(counts)), np.zeros(len(ends), int), usual
    for _ in range(3):
        late = arrival - interval * ends
        for j in np.flatnonzero(np.diff(arrival) > interval * (counts[1:] + max(0.5 * size, 1.5))):
            before, after = late[max(0, j - SEEN) : j + 1], late[j + 1 : j + 1 + SEEN]
            rows = (np.min(after) - np.min(before)) / interval
            lost[j + 1] = round(rows) if rows > 0.5 * size else 0
        kept = lost * interval <= longest
        interval = float(
            (arrival[-1] - arrival[0] - np.sum(interval * lost[~kept]))
            / (ends[-1] - ends[0] + np.sum(lost[kept]))
        )
    late = arrival - interval * (ends + np.cumsum(lost))
    if np.diff(np.quantile(late, (0.05, 0.95))) > 1.5 * size * interval:
        return None
    sure = float(np.ptp(late)) / float(arrival[-1] - arrival[0])
    whole = max(round(1 / interval), 1)
    interval = 1 / whole if abs(whole * interval - 1) < sure else interval
    missing = np.zeros(time.size, int)
    missing[ends - counts + 1] = lost
    position = np.arange(time.size) + np.cumsum(missing)
    parts = [
        Part(float(position[rows.start] * interval), rows, position[rows] - position[rows.start])
        for rows in _slices(missing[1:] * interval > longest)
    ]
    head = f"rows come {size:g} at a time: they count as even, at {_rounded(1 / interval):.6g} Hz"
    return interval, parts, [head, *_words_of(parts, position * interval)]


def _rounded(rate: float) -> float:
    """A whole number of samples per second, if it is one but for the rounding of the times."""
    return float(round(rate)) if abs(rate - round(rate)) < 1e-6 * rate else rate


def _simple(rate: float) -> float:
    """A rate of two figures, if there is one within 1 %, else a whole one."""
    short = float(f"{rate:.2g}")
    return short if abs(short / rate - 1) <= 0.01 else float(round(rate) or rate)


def _departure(time: Float[np.ndarray, " rows"], fine: float = 1e-12) -> tuple[bool, float, float]:
    """Whether the times are even, the mean interval, and the unit of their last decimal."""
    interval = float(time[-1] - time[0]) / (time.size - 1)
    decimals = (d for d in range(9) if np.max(np.abs(time - np.round(time, d))) <= fine)
    rounding = next((10.0**-d for d in decimals), 0.0)
    steps = np.diff(time)
    uneven = np.flatnonzero(np.abs(steps - np.median(steps)) > rounding / 2)
    # One or two odd steps are lost samples, and so are more, if all are long and they come now and
    # then: those of rounding come regularly. A step as coarse as many intervals is no rounding
    # either.
    rare = uneven.size < RARE * steps.size and np.all(steps[uneven] > interval)
    lost = uneven.size <= 2 or (rare and np.ptp(np.diff(uneven)) > 2)
    rounding = 0.0 if lost or rounding > 5 * interval else rounding
    departure = np.max(np.abs(time - time[0] - interval * np.arange(time.size)))
    return bool(departure <= JITTER * interval + rounding), interval, rounding
