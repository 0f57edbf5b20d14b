"""What stands out of a recording: marks for missing values, single spikes, and a cough or a slip in
a held force."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from ._recording_quality import runs

# what is done with them, and what the notice says of it
OUTLIERS = {
    "keep": ". They are kept: --outliers mask treats them as missing (Python: outliers='mask')",
    "mask": ". They count as missing",
}
OUTSIDE = "far outside"
NINES = (99.0, 999.0, 9999.0, 99999.0, 999999.0, 999.99, 9999.99, 99.99)
# of converters of 16, 24 and 32 bits, and what no sensor reads
RAILS = tuple(2.0 ** (bits - 1) for bits in (16, 17, 24, 25, 32, 33))
HUGE = 1e9
FAR = 3.0  # times as large as the rest: a value that repeats, and is no usual mark
NEIGHBOURS, FEW, APART = 11, 5, 25  # samples: of a running median, of a spike, between two
# shares of the distances that are their tail, at least so many of so many: the smaller one sees
# smaller spikes, the larger one more of them
TOPS, LEAST_TOP, FEWEST = (0.01, 0.05), 20, 200
SHAPE = 0.15  # of the tail of normal distances; less is no tail
CHANCE = math.log(1000)  # one false alarm in so many records
ALONE = 3.0  # times as far as all about it
STEEP = 0.4  # of its height by which a spike rises, and falls, within one sample
# the same for stretches
BURST_CHANCE = math.log(30)
NAMED = 5  # of many
# s: a stretch of a cough or slip, the longest one, what is slow; stretches that are enough
STRETCH, LONGEST, SLOW, FEWEST_STRETCHES = 0.5, 3.0, 3.0, 24


def find_outliers(
    signal: Float[np.ndarray, "rows columns"], time: Float[np.ndarray, " rows"]
) -> tuple[Bool[np.ndarray, " rows"], list[str]]:
    """Rows in which a sample cannot be, and a sentence for each kind.

    **Marks** are the lowest or highest value of all, where it lies further from the next value than
    the largest absolute value of the rest: -9999, 1e30, the rail of a converter; any other value if
    it stands there more than once and is `FAR` times as far.

    **Spikes** are up to 5 samples that leave their neighbourhood at once. With d = |x - m|, m the
    median of 11 samples about x, the k largest distances, from u on (a hundredth of all, or a
    twentieth), say how their tail falls: d > u with probability (d / u)^(-1/γ), where γ is the
    median of ln(d / u) over ln 2, at least that of normal noise. By chance a record holds a
    larger distance than

        u exp(γ (ln k + ln 1000))

    once in a thousand. Noise with heavy tails and bursts have a large γ, a tremor and quantised
    signals a large u, and on a ramp d is 0, since the median of what rises is its middle. A spike
    also rises and falls within one sample by 0.4 of its height d; within 25 samples there is
    nothing a third as large, and m changes by less than d.
    """
    odd, words = np.zeros(len(signal), bool), []
    for x in signal.T:
        there = np.flatnonzero(np.isfinite(x) & ~odd)
        for value in _marks(x[there]):
            found = there[x[there] == value]
            odd[found] = True
            are = "sample is" if len(found) == 1 else "samples are"
            words.append(
                f"{len(found)} {are} {value:.6g}, {OUTSIDE} the rest (a mark for a missing value?),"
                f" {_at(found, time)}"
            )
        there = there[~odd[there]]
        found = there[_spikes(x[there])]
        odd[found] = True
        if len(found):
            what = (
                f"sample lies {OUTSIDE} what its"
                if len(found) == 1
                else (f"samples lie {OUTSIDE} what their")
            )
            words.append(f"{len(found)} {what} neighbours allow (spikes), {_at(found, time)}")
    return odd, words


def _at(rows: Int[np.ndarray, " found"], time: Float[np.ndarray, " rows"]) -> str:
    """When: the first times, those of neighbours as one."""
    groups = np.split(time[rows], np.flatnonzero(np.diff(rows) > 1) + 1)
    spans = [" to ".join(f"{edge:.3f}" for edge in dict.fromkeys((g[0], g[-1]))) for g in groups]
    more = f" and {len(spans) - NAMED} more times" if len(spans) > NAMED else ""
    return f"at {', '.join(spans[:NAMED])} s{more}"


def _marks(x: Float[np.ndarray, " there"]) -> list[float]:
    """Values that stand for something else than a measurement."""
    low, high = (float(np.min(x)), float(np.max(x))) if x.size else (0.0, 0.0)
    rest = x[(x != low) & (x != high)]
    if rest.size < max(x.size / 2, 8) or np.ptp(rest) == 0:
        return []
    size = float(np.max(np.abs(rest)))
    marks = []
    for end, near in ((low, np.min(rest)), (high, np.max(rest))):
        usual = _is_usual(end)
        far = abs(end - near) > (size if usual else FAR * size)
        if far and (usual or np.sum(x == end) > 1):
            marks.append(end)
    # behind them may be others: -9999 beside -99
    return marks + _marks(x[~np.isin(x, marks)]) if marks else []


def _is_usual(value: float) -> bool:
    """Whether a value is one by which programs mark what is missing, or a converter's last."""
    size = abs(value)
    return size >= HUGE or size in NINES or size in RAILS or size + 1 in RAILS


def _spikes(x: Float[np.ndarray, " there"]) -> Bool[np.ndarray, " there"]:
    """Which samples are spikes."""
    odd = np.zeros(x.size, bool)
    if x.size < FEWEST:
        return odd
    away = x - scipy.ndimage.median_filter(x, NEIGHBOURS, mode="nearest")
    distance = np.abs(away)
    level = min(tail_level(distance, max(LEAST_TOP, round(top * x.size))) for top in TOPS)
    hits = np.flatnonzero(distance > level)
    for group in np.split(hits, np.flatnonzero(np.diff(hits) > APART) + 1):
        odd[group] = 0 < len(group) <= FEW and _is_alone(x, away, group)
    return odd


def _is_alone(
    x: Float[np.ndarray, " there"],
    away: Float[np.ndarray, " there"],
    group: Int[np.ndarray, " found"],
) -> bool:
    """Whether samples leave a calm neighbourhood at once, and come back."""
    a, b = int(group[0]), int(group[-1])
    peak = a + int(np.argmax(np.abs(away[a : b + 1])))
    height, up = abs(away[peak]), np.sign(away[peak])
    sides = up * np.diff(x[max(a - 1, 0) : peak + 1]), -up * np.diff(x[peak : b + 2])
    steep = all(np.max(side) >= STEEP * height for side in sides if side.size)
    about = slice(max(a - FEW, 0), b + FEW + 1)
    calm = np.ptp(x[about] - away[about]) <= height
    # what a filter leaves of a spike in the next two samples is its own
    own = np.unique(group[:, None] + np.arange(-2, 3))
    others = np.setdiff1d(np.arange(max(a - APART, 0), min(b + APART, x.size)), own)
    return bool(steep and calm and height >= ALONE * np.max(np.abs(away[others])))


def tail_level(sizes: Float[np.ndarray, " n"], top: int, chance: float = CHANCE) -> float:
    """What the largest of sizes exceeds by chance once in a thousand, by the tail of their `top`
    largest (see `find_outliers`)."""
    tail = np.partition(sizes, sizes.size - top)[sizes.size - top :]
    least = float(np.min(tail))
    if least == 0:  # of a signal that rests, or has few values
        least = float(np.min(tail[tail > 0], initial=math.inf))
        if least == math.inf:
            return least
    # the median, and not the mean: outliers in the tail itself must not widen it
    shape = float(np.median(np.log(np.maximum(tail, least) / least))) / math.log(2)
    return least * math.exp(max(shape, SHAPE) * (math.log(top) + chance))


class Burst(NamedTuple):
    """A stretch of one of several signals that fluctuates far more than all others: which signal,
    from when to when in it [s], and how many times as large as usual."""

    signal: int
    start: float
    stop: float
    times: float


def find_bursts(signals: Sequence[Float[np.ndarray, " _"]], rate: float) -> list[Burst]:
    """Stretches in which a held signal leaves its level as by a cough or a slip.

    Each signal less its running median over 3 s is cut into stretches of 0.5 s. The root mean
    square of a stretch is far beyond those of all other stretches of all signals where it exceeds
    what the tail of the largest quarter of them allows, by the rule of `find_outliers`, once in 30
    records (in simulated Gaussian ones with corners from 0.3 to 3 Hz: once in 300). Nothing is said
    where that is so for longer, for a tenth of the time, or at the ends of a signal: that is no
    single event, or a ramp.
    """
    size, found = max(round(STRETCH * rate), 1), []
    wandering = round(SLOW * rate) | 1
    rests = [x - scipy.ndimage.median_filter(x, wandering, mode="nearest") for x in signals]
    cut = [rest[: len(rest) // size * size].reshape(-1, size) for rest in rests]
    each = [np.sqrt(np.mean(parts**2, axis=1)) for parts in cut]
    sizes = np.concatenate(each)
    if sizes.size < FEWEST_STRETCHES:
        return []
    level = tail_level(sizes, max(sizes.size // 4, 6), BURST_CHANCE)
    if np.mean(sizes > level) > 0.1:
        return []
    usual = float(np.median(sizes))
    for which, own in enumerate(each):
        for a, b in runs(own > level):
            if a > 0 and b < own.size and (b - a) * STRETCH <= LONGEST:
                times = float(np.max(own[a:b])) / usual
                found.append(Burst(which, a * size / rate, b * size / rate, times))
    return found
