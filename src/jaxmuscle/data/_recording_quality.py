"""The numbers of a recording: level, variability, regularity, spectral peaks."""

import dataclasses
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxmuscle._common.cards import Printed
from jaxmuscle._common.files import nulled
from jaxmuscle._common.tables import frame
from jaxmuscle.spectra._measures import Peaks
from jaxmuscle.spectra._settings import require

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
            (f"mean ({self.unit})", f"{self.mean:.4g}"),
            (f"standard deviation ({self.unit})", f"{self.standard_deviation:.4g}"),
            (
                "coefficient of variation (%)",
                f"{100 * variation:.3g}" if variation < 10 else "none, the mean is near zero",
            ),
            ("mean over SD (signal-to-noise)", f"{self.signal_to_noise:.4g}"),
            ("approximate entropy", f"{self.approximate_entropy:.4f}"),
            ("sample entropy", f"{self.sample_entropy:.4f}"),
            ("maximum of the spectrum (Hz)", f"{top.interpolated:.3f}"),
            ("power in its bin (%)", f"{100 * top.power:.3g}"),
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
                f"flat at its {word} value {extreme:.6g} for {100 * share:.2g} % of the samples,"
                f" first at {first:.3f} s: clipped by the amplifier?"
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
