"""The numbers of a recording: level, variability, regularity, spectral peaks."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxmuscle._common.arguments import require
from jaxmuscle._common.cards import Printed
from jaxmuscle._common.files import nulled
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import digits
from jaxmuscle.spectra._measures import Peaks

if TYPE_CHECKING:
    import pandas


class RecordingSummary(Printed, eqx.Module):
    """Numbers of a window.

    Its `duration` [s] and Welch `segments`; `mean` and `standard_deviation` in `unit`; without unit
    `coefficient_of_variation`, its inverse `signal_to_noise`, `approximate_entropy` and
    `sample_entropy` (m = 2, r = 0.2 σ); `peaks` of the spectrum: its `maximum`, and its
    `local_maxima` by rising frequency.
    """

    unit: str
    duration: float
    segments: int
    mean: float
    standard_deviation: float
    coefficient_of_variation: float
    signal_to_noise: float
    approximate_entropy: float
    sample_entropy: float
    peaks: Peaks

    def rows(self) -> list[tuple[str, str]]:
        """Name and value of every number, as tables print them."""
        variation, top = self.coefficient_of_variation, self.peaks.maximum
        local = ", ".join(f"{peak.interpolated:.3f}" for peak in self.peaks.local_maxima) or "none"
        return [
            ("window (s)", f"{self.duration:.2f}"),
            ("Welch segments", f"{self.segments}"),
            (f"mean ({self.unit})", digits(self.mean, 4)),
            (f"standard deviation ({self.unit})", digits(self.standard_deviation, 4)),
            (
                "coefficient of variation (%)",
                "none, the mean is gravity or offset"
                if math.isnan(variation)
                else digits(100 * variation)
                if variation < 10
                else "none, the mean is near zero",
            ),
            (
                "mean over SD (signal-to-noise)",
                "none" if math.isnan(variation) else digits(self.signal_to_noise, 4),
            ),
            ("approximate entropy", f"{self.approximate_entropy:.4f}"),
            ("sample entropy", f"{self.sample_entropy:.4f}"),
            ("maximum of the spectrum (Hz)", f"{top.interpolated:.3f}"),
            ("power in its bin (%)", digits(100 * top.power)),
            ("local maxima (Hz)", local),
        ]

    def __str__(self) -> str:
        return "\n".join(f"{name:<32}{value}" for name, value in self.rows())

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each number:

        `quantity`, `value`, `unit`; of the peaks the frequency of the maximum, called `maximum`.
        """
        units = {
            "duration": "s",
            "mean": self.unit,
            "standard_deviation": self.unit,
            "maximum": "Hz",
        }
        numbers = {
            field.name: getattr(self, field.name) for field in dataclasses.fields(self)[1:-1]
        }
        numbers["maximum"] = self.peaks.maximum.interpolated
        return frame(
            [
                {"quantity": n, "value": float(v), "unit": units.get(n, "1")}
                for n, v in numbers.items()
            ]
        )

    def to_dict(self) -> dict[str, Any]:
        """The same for JSON, with `None` for what is not finite."""
        return nulled(dataclasses.asdict(self))


# A flat run at an extreme counts as clipped from this long on [s], and from this many samples on.
FLAT = (0.02, 5)
RAMP, BAND, SHARE, SMOOTH = 0.2, 0.1, 0.5, 1.0
# Of rest: the least time [s] that shows it; how far, over the height of the ramp, it goes before it
# is left; the share of it that is looked at, away from the ramp.
SHORT, LEFT, KEPT = 0.3, 0.05, 0.75
# It is subtracted if it scatters by less than this times the hold, and both ends agree within that
# much of the height. Below that share of the height, or that many of its deviations, it is zero.
QUIET, AGREE, NOTHING, NOISE = 0.1, 0.02, 0.01, 2.0

AT_REST = "at rest "
MAINS = 50.0  # Hz

Baseline = str | Sequence[float | int] | None


def runs(mask: Bool[np.ndarray, " times"]) -> Int[np.ndarray, "runs 2"]:
    """First and last-plus-one index of every run of `True`."""
    steps = np.diff(np.concatenate(([False], mask, [False])).astype(int))
    return np.stack((np.flatnonzero(steps == 1), np.flatnonzero(steps == -1)), axis=1)


def filled(
    values: Float[np.ndarray, "times parts"], rate: float, longest: float
) -> tuple[Float[np.ndarray, "kept parts"], float, list[str]]:
    """Gaps (rows with NaN) closed by straight lines, those at both ends cut off.

    **Arguments:** `values`; sampling `rate` [Hz]; the `longest` gap that is closed [s].

    **Returns:** the rows without gaps, the time of the first one [s] (0 if nothing was cut off),
    what was done in sentences.

    **Raises:** `ValueError` if nothing is there or a gap is longer, naming its times.
    """
    missing = np.any(np.isnan(values), axis=1)
    there = np.flatnonzero(~missing)
    if there.size == 0:
        raise ValueError("holds no number, only gaps (NaN or empty)")
    first, last = int(there[0]), int(there[-1]) + 1
    values, gaps, notices = values[first:last].copy(), runs(missing[first:last]), []
    cut, begin = missing.size - values.shape[0], first / rate
    if cut:
        notices.append(f"{cut} samples without a number at the ends cut off ({cut / rate:.3g} s)")
    too_long = gaps[(gaps[:, 1] - gaps[:, 0]) / rate > longest]
    if len(too_long):
        spans = [f"{begin + a / rate:.3f} s to {begin + b / rate:.3f} s" for a, b in too_long[:5]]
        more = f" and {len(too_long) - 5} more" if len(too_long) > 5 else ""
        raise ValueError(
            f"gaps longer than max_gap={longest:g} s at {', '.join(spans)}{more}; "
            "cut the recording there, or allow more with `max_gap`"
        )
    if len(gaps):
        hole, index = missing[first:last], np.arange(last - first)
        for part in values.T:
            part[hole] = np.interp(index[hole], index[~hole], part[~hole])
        widest = np.max(gaps[:, 1] - gaps[:, 0]) / rate
        plural = "s" if len(gaps) > 1 else ""
        notices.append(
            f"{len(gaps)} gap{plural} ({hole.sum()} samples, longest {widest:.3g} s) closed by"
            " straight lines"
        )
    return values, begin, notices


def clipping(x: Float[np.ndarray, " times"], rate: float, start: float) -> list[str]:
    """A sentence for each extreme at which the signal stays flat for 20 ms and 5 samples or
    more."""
    shortest, notices = max(FLAT[0] * rate, FLAT[1]), []
    for word, extreme in (("highest", x.max()), ("lowest", x.min())):
        flat = runs(x == extreme)
        flat = flat[flat[:, 1] - flat[:, 0] >= shortest]
        if len(flat):
            share = np.mean(x == extreme)
            first = start + flat[0, 0] / rate
            notices.append(
                f"flat at its {word} value {extreme:.6g} for {digits(100 * share, 2)} % of the"
                f" samples, first at {first:.3f} s: clipped by the amplifier?"
            )
    return notices


def running_median(x: Float[np.ndarray, " times"], rate: float) -> Float[np.ndarray, " times"]:
    """The running median over 1 s."""
    return scipy.ndimage.median_filter(x, _size(x, rate), mode="nearest")


def _size(x: Float[np.ndarray, " times"], rate: float) -> int:
    return min(round(SMOOTH * rate), x.size)


def plateau(x: Float[np.ndarray, " times"], rate: float) -> tuple[int, int] | None:
    """The steady part of a ramp-and-hold, as the index of its first sample and of the first one
    after it.

    s is the running median over 1 s; rest is the extreme of s nearer to zero, and the level L is
    the median of s where it is more than half-way from rest to the other extreme. The plateau is
    the longest stretch with |s - L| <= 0.1 |L - rest|, if it makes up at least half of the time
    beyond half-way (a slow ramp, a sine or several holds do not); one second is taken off where it
    borders on something else. If s ranges over no more than 0.2 of its largest absolute value there
    is no ramp, and all of it is steady.

    **Returns:** the two indices, or `None` if there is no such stretch.
    """
    s, size = running_median(x, rate), _size(x, rate)
    low, high = float(s.min()), float(s.max())
    if high - low <= RAMP * max(abs(low), abs(high)):
        return 0, x.size
    rest, far = (low, high) if abs(low) <= abs(high) else (high, low)
    beyond = (s - rest) / (far - rest) > 0.5
    level = float(np.median(s[beyond]))
    found = runs(np.abs(s - level) <= BAND * abs(level - rest))
    if not len(found):
        return None
    start, stop = (int(i) for i in found[np.argmax(found[:, 1] - found[:, 0])])
    if stop - start < SHARE * np.sum(beyond):
        return None
    start, stop = start + size * (start > 0), stop - size * (stop < x.size)
    return (start, stop) if stop > start else None


class _Rest(NamedTuple):
    """A level at an end of a signal, before the first ramp or after the last: from `begin` to `end`
    [s after the first sample]; its `scatter` is a standard deviation."""

    level: float
    scatter: float
    begin: float
    end: float


class Rest(NamedTuple):
    """The level of a signal at rest, and how much it scatters there, over the scatter of the hold.
    `begin`, `end` [s after the first sample]; `zero`, whether it is as good as none;
    `agree`, whether it is the same before and after; `likely`, whether it is on both sides, or
    nearer to zero than the hold."""

    level: float
    share: float
    begin: float
    end: float
    zero: bool
    agree: bool
    likely: bool

    @property
    def quiet(self) -> bool:
        """Whether only the sensor is seen there, and no person."""
        return self.share < QUIET and self.agree


def find_rest(x: Float[np.ndarray, " times"], rate: float) -> Rest | None:
    """Where a signal rests before its first ramp or after its last one; `None` where it has none.

    A stretch at an end is a candidate if the signal, smoothed over 0.1 s, leaves its level by 5 %
    of the height of the signal; the quarter next to the ramp is not looked at. Of two candidates
    the one that scatters less is rest, and the other one too if it has the same level within a
    tenth of the height. All is averaged over 20 ms, in which mains hum vanishes. The hold is the
    `plateau` above that level; without one its scatter is the median of that in pieces of 1 s more
    than half-way to the peak.
    """
    k = max(round(rate / MAINS), 1)
    even, rate = x[: x.size // k * k].reshape(-1, k).mean(axis=1), rate / k
    if even.size < 2:
        return None
    s = running_median(even, rate)
    height = float(np.ptp(s))
    ends = [
        end
        for turned in (False, True)
        if (end := _end(even[::-1] if turned else even, rate, height, turned)) is not None
    ]
    if not ends:
        return None
    best = min(ends, key=lambda end: end.scatter)
    same = [end for end in ends if abs(end.level - best.level) <= BAND * height]
    above = even - best.level
    found = plateau(above, rate)
    if found not in (None, (0, even.size)):
        hold = scipy.signal.detrend(above[slice(*found)])
        scatter = float(np.std(hold))
    else:
        beyond = np.abs(s - best.level) > 0.5 * np.max(np.abs(s - best.level))
        size = _size(even, rate)
        pieces = even[beyond][: np.sum(beyond) // size * size].reshape(-1, size)
        scatter = float(np.median(np.std(pieces, axis=1))) if pieces.size else 0.0
    far = max((float(s.min()), float(s.max())), key=lambda edge: abs(edge - best.level))
    spread = float(np.ptp([end.level for end in same]))
    most = max(end.scatter for end in same)
    return Rest(
        float(np.mean([end.level for end in same])),
        most / scatter if scatter > 0 else math.inf,
        same[0].begin,
        same[0].end,
        abs(best.level) <= max(NOTHING * height, NOISE * best.scatter),
        spread <= AGREE * height,
        len(same) > 1 or abs(best.level) < abs(far),
    )


def _end(x: Float[np.ndarray, " times"], rate: float, height: float, turned: bool) -> _Rest | None:
    """The level with which a signal begins, if it leaves it; `turned`: of one that runs
    backwards."""
    least = max(round(SHORT * rate), 2)
    smooth = scipy.ndimage.median_filter(x, max(round(0.1 * rate), 1), mode="nearest")
    away = np.flatnonzero(np.abs(smooth - np.median(x[:least])) > LEFT * height)
    count = int(KEPT * away[0]) if away.size else 0
    if count < least:
        return None
    slope = float(np.polyfit(np.arange(count), x[:count], 1)[0])
    if abs(slope) * count > 0.65 * LEFT * height:  # a slow ramp
        return None
    span = ((x.size - count) / rate, x.size / rate) if turned else (0.0, count / rate)
    return _Rest(float(np.mean(x[:count])), float(np.std(x[:count])), *span)


def without_rest(
    x: Float[np.ndarray, " times"], rate: float, start: float, unit: str, baseline: Baseline
) -> tuple[Float[np.ndarray, " times"], list[str]]:
    """The signal less its level at rest, and what is to be said of it.

    With `baseline` (a, b) that is the mean from a to b [s]; "none" subtracts nothing. By default it
    is `find_rest`, and subtracted only if it is quiet: if it scatters less than a tenth as much as
    the hold does, so that it is the sensor's zero and not a weight that is held, and if it is the
    same before and after. Within 1 % of the height, or two of its own deviations, it is zero.
    """
    if baseline == "none":
        return x, []
    if baseline is not None:
        a, b = _span(baseline, start, start + x.size / rate)
        part = x[round((a - start) * rate) : round((b - start) * rate)]
        require(part.size > 0, "baseline", baseline, "give a longer part")
        level = float(np.mean(part))
        words = f"the mean from {a:g} s to {b:g} s, {level:.4g} {unit}, was subtracted as asked"
        return x - level, [words]
    rest = find_rest(x, rate)
    if rest is None or rest.zero:
        return x, []
    when = ":".join(f"{round(start + edge, 2):g}" for edge in (rest.begin, rest.end))
    said = (
        f"{AT_REST}({when.replace(':', ' s to ')} s) the signal is {rest.level:.4g} {unit}, not 0"
    )
    if rest.quiet:
        keep = '--baseline none keeps it (in Python baseline = "none")'
        return x - rest.level, [f"{said}. This was subtracted; {keep}"]
    if rest.share >= 1 or not rest.likely:
        return x, []
    why = (
        f"it scatters {rest.share:.2g} times as much as in the hold, so it may be a force"
        if rest.agree
        else "it differs before and after the hold"
    )
    edges = when.replace(":", ", ")
    return x, [
        f"{said}. This was not subtracted: {why}. If it is the sensor's zero, give --baseline"
        f" {when} (in Python baseline = ({edges})); if not, --baseline none"
    ]


def _span(baseline: Any, start: float, stop: float) -> tuple[float, float]:
    edges = baseline.split(":") if isinstance(baseline, str) else baseline
    try:
        a, b = (float(edge) for edge in edges)
    except (TypeError, ValueError):
        a, b = math.nan, math.nan
    remedy = (
        f"give a part in which the signal rests, two times between {start:g} and {stop:g} s as"
        " 0:1 (in Python also (0, 1)), or none"
    )
    require(start - 1e-9 <= a < b <= stop + 1e-9, "baseline", baseline, remedy)
    return a, b


def checked(samples: Any, rate: float, start: float) -> Float[np.ndarray, " all"]:
    """The samples as a copy that cannot be changed. **Raises:** `ValueError` if they are no
    signal."""
    try:
        x = np.array(samples, dtype=float)
    except (TypeError, ValueError):
        raise ValueError("samples: give real numbers, one for each time") from None
    require(
        x.ndim == 1 and x.size >= 2,
        "samples shape",
        x.shape,
        "give one signal of 2 samples or more",
    )
    wrong = np.flatnonzero(~(np.abs(x) < 1e100))
    if wrong.size:
        first = f"the first at {start + wrong[0] / rate:.3f} s ({x[wrong[0]]:g})"
        raise ValueError(
            f"samples: {wrong.size} are no finite numbers, {first}; `load_recording` closes short"
            " gaps of NaN"
        )
    if np.ptp(x) <= 1e-12 * np.max(np.abs(x)):
        raise ValueError(
            f"samples: constant at {x[0]:g}; is this the right column, was the sensor connected?"
        )
    x.setflags(write=False)
    return x
