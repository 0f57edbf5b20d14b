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
from jaxmuscle._common.text import digits, listed
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
        varies, above = digits(100 * variation), digits(self.signal_to_noise, 4)
        if math.isnan(variation):
            varies, above = "none, the mean is gravity or offset", "none"
        elif variation >= 10:
            varies = "none, the mean is near zero"
        local = ", ".join(f"{peak.interpolated:.3f}" for peak in self.peaks.local_maxima)
        return [
            ("window (s)", f"{self.duration:.2f}"),
            ("Welch segments", f"{self.segments}"),
            (f"mean ({self.unit})", digits(self.mean, 4)),
            (f"standard deviation ({self.unit})", digits(self.standard_deviation, 4)),
            ("coefficient of variation (%)", varies),
            ("mean over SD (signal-to-noise)", above),
            ("approximate entropy", f"{self.approximate_entropy:.4f}"),
            ("sample entropy", f"{self.sample_entropy:.4f}"),
            ("maximum of the spectrum (Hz)", f"{top.interpolated:.3f}"),
            ("power in its bin (%)", digits(100 * top.power)),
            ("local maxima (Hz)", local or "none"),
        ]

    def __str__(self) -> str:
        return "\n".join(f"{name:<32}{value}" for name, value in self.rows())

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each number:

        `quantity`, `value`, `unit`; of the peaks the frequency of the maximum, called `maximum`.
        """
        units = {"duration": "s", "maximum": "Hz"}
        units |= dict.fromkeys(("mean", "standard_deviation"), self.unit)
        numbers = vars(self) | {"maximum": self.peaks.maximum.interpolated}
        return frame(
            [
                {"quantity": name, "value": float(value), "unit": units.get(name, "1")}
                for name, value in numbers.items()
                if name not in ("unit", "peaks")
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
    kept, begin = slice(there[0], there[-1] + 1), float(there[0] / rate)
    values, hole, notices = values[kept].copy(), missing[kept], []
    cut = missing.size - hole.size
    if cut:
        notices.append(f"{cut} samples without a number at the ends cut off ({cut / rate:.3g} s)")
    gaps = runs(hole) / rate
    if not len(gaps):
        return values, begin, notices
    lengths = gaps[:, 1] - gaps[:, 0]
    spans = [f"{begin + a:.3f} s to {begin + b:.3f} s" for a, b in gaps[lengths > longest]]
    if spans:
        raise ValueError(
            f"gaps longer than max_gap={longest:g} s at {listed(spans, 5)};"
            " cut the recording there, or allow more with `max_gap`"
        )
    index = np.arange(hole.size)
    for part in values.T:
        part[hole] = np.interp(index[hole], index[~hole], part[~hole])
    count = f"{len(gaps)} gap{'s' if len(gaps) > 1 else ''}"
    notices.append(
        f"{count} ({hole.sum()} samples, longest {np.max(lengths):.3g} s) closed by straight lines"
    )
    return values, begin, notices


def clipping(x: Float[np.ndarray, " times"], rate: float, start: float) -> list[str]:
    """A sentence for each extreme at which the signal stays flat for 20 ms and 5 samples or
    more."""
    shortest, notices = max(FLAT[0] * rate, FLAT[1]), []
    for word, extreme in (("highest", x.max()), ("lowest", x.min())):
        flat = x == extreme
        first = next((a for a, b in runs(flat) if b - a >= shortest), None)
        if first is not None:
            notices.append(
                f"flat at its {word} value {extreme:.6g} for {digits(100 * np.mean(flat), 2)} % of"
                f" the samples, first at {start + first / rate:.3f} s: clipped by the amplifier?"
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
    rest, far = sorted((float(s.min()), float(s.max())), key=abs)
    if abs(far - rest) <= RAMP * abs(far):
        return 0, x.size
    beyond = (s - rest) / (far - rest) > 0.5
    level = float(np.median(s[beyond]))
    found = runs(np.abs(s - level) <= BAND * abs(level - rest))
    start, stop = max(found.tolist(), key=lambda run: run[1] - run[0], default=(0, 0))
    if stop - start < SHARE * np.sum(beyond):
        return None
    # the median over 1 s knows of a ramp one half of it away; the other half is for a slow foot
    start, stop = start + size * (start > 0), stop - size * (stop < x.size)
    return (start, stop) if stop > start else None


class _Level(NamedTuple):
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
    after = _first_level(even[::-1], rate, height)
    if after is not None:  # which was found in time that runs backwards
        long = even.size / rate
        after = after._replace(begin=long - after.end, end=long)
    ends = [end for end in (_first_level(even, rate, height), after) if end is not None]
    if not ends:
        return None
    best = min(ends, key=lambda end: end.scatter)
    same = [end for end in ends if abs(end.level - best.level) <= BAND * height]
    levels = [end.level for end in same]
    scatter = _scatter_of_hold(even - best.level, s - best.level, rate)
    far = max((float(s.min()), float(s.max())), key=lambda edge: abs(edge - best.level))
    return Rest(
        float(np.mean(levels)),
        max(end.scatter for end in same) / scatter if scatter > 0 else math.inf,
        same[0].begin,
        same[0].end,
        abs(best.level) <= max(NOTHING * height, NOISE * best.scatter),
        float(np.ptp(levels)) <= AGREE * height,
        len(same) > 1 or abs(best.level) < abs(far),
    )


def _scatter_of_hold(
    above: Float[np.ndarray, " times"], smooth: Float[np.ndarray, " times"], rate: float
) -> float:
    """The standard deviation of a signal and its running median above rest, while it is held."""
    found = plateau(above, rate)
    if found not in (None, (0, above.size)):
        return float(np.std(scipy.signal.detrend(above[slice(*found)])))
    beyond = above[np.abs(smooth) > 0.5 * np.max(np.abs(smooth))]
    size = _size(above, rate)
    pieces = beyond[: beyond.size // size * size].reshape(-1, size)
    return float(np.median(np.std(pieces, axis=1))) if pieces.size else 0.0


def _first_level(x: Float[np.ndarray, " times"], rate: float, height: float) -> _Level | None:
    """The level with which a signal begins, if it leaves it."""
    least = max(round(SHORT * rate), 2)
    smooth = scipy.ndimage.median_filter(x, max(round(0.1 * rate), 1), mode="nearest")
    away = np.flatnonzero(np.abs(smooth - np.median(x[:least])) > LEFT * height)
    count = int(KEPT * away[0]) if away.size else 0
    if count < least:
        return None
    still = x[:count]
    slope = float(np.polyfit(np.arange(count), still, 1)[0])
    if abs(slope) * count > 0.65 * LEFT * height:  # a slow ramp
        return None
    return _Level(float(np.mean(still)), float(np.std(still)), 0.0, count / rate)


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
    begin, end = (f"{round(start + edge, 2):g}" for edge in (rest.begin, rest.end))
    said = f"{AT_REST}({begin} s to {end} s) the signal is {rest.level:.4g} {unit}, not 0"
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
    return x, [
        f"{said}. This was not subtracted: {why}. If it is the sensor's zero, give --baseline"
        f" {begin}:{end} (in Python baseline = ({begin}, {end})); if not, --baseline none"
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


def signal_of(name: str, values: Any) -> Float[np.ndarray, " all"]:
    """The numbers of an argument as a copy. **Raises:** `ValueError` if they are no signal."""
    try:
        x = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: give real numbers, one for each time") from None
    remedy = "give one signal of 2 samples or more"
    require(x.ndim == 1 and x.size >= 2, f"{name} shape", x.shape, remedy)
    return x


def checked(samples: Any, rate: float, start: float) -> Float[np.ndarray, " all"]:
    """The samples as a copy that cannot be changed. **Raises:** `ValueError` if they are no
    signal."""
    x = signal_of("samples", samples)
    # what is larger is no measurement either, and its square is none
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
