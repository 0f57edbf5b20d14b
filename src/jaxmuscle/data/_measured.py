"""What is measured of held signals and of spectra, without any model: variability, power by band,
tremor, regularity."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle._common.text import squared
from jaxmuscle.spectra._bin_law import ENOUGH, bin_statistics
from jaxmuscle.spectra._fluctuations import BANDS, dfa, in_bands, variance_spectrum
from jaxmuscle.spectra._measures import regularity
from jaxmuscle.spectra._peak_test import PeakTest, bins_around, bins_in, find_peaks, measure_peak
from jaxmuscle.spectra._settings import SpectrumSettings

from ._measure import Measure, log_interval, logit_interval, student_interval

AS_RECORDED: dict[str, Any] = {"filter_direction": "both", "sampling": "filtered"}
RECORDED = SpectrumSettings(**AS_RECORDED)
PARTS, SLOWEST = 4, 4  # parts of a recording; ordinates that say how sure its mean is
# Hz, where a tremor is looked for; what moves shows it over a wider band than a held force
# Quantities of what moves, whose mean is where the sensor lies, gravity or an offset.
MOTIONS = ("displacement", "angle", "acceleration", "angular velocity")
FLOATING = MOTIONS[2:]
MOTION_BAND = (3.0, 20.0)
TREMOR_BAND = (6.0, 12.0)
LEVEL = 0.01  # of the test for a tremor
RANGES = {name.removeprefix("band"): edges for name, edges in BANDS.items()} | {
    "_above_12": (12.0, math.inf)
}
FAST = 0.5  # Hz
NARROWEST = 1.0  # Hz; a band in which a tremor can be seen
SEEN = 0.9  # share of half the rate up to which the resampling leaves a spectrum as it is
DRAWN = 200  # spectra, for errors where only the spectrum is known
SIGNED = ("mean", "dfa_exponent")  # all else is 0 or more
LEVEL_NAME = "level"
MEAN, VARIATION, MEDIAN = "mean", "coefficient_of_variation", "median_frequency"
REGULARITY = ("approximate_entropy", "sample_entropy", "dfa_exponent")
Measures = dict[str, Measure]
Times = Float[np.ndarray, " times"]
Power = Float[np.ndarray, " frequencies"]
# names of all that is measured of recordings
MEASURES = (
    MEAN,
    "standard_deviation",
    VARIATION,
    f"{VARIATION}_without_drift",
    f"{VARIATION}_above_{FAST:g}",
    *(f"{kind}{name}" for kind in ("power", "relative_power", "share") for name in RANGES),
    MEDIAN,
    *REGULARITY,
    "tremor_p",
    "tremor_frequency",
    "tremor_size",
    "tremor_detectable",
)


def tremor_band(quantity: str | None) -> tuple[float, float]:
    """The band [Hz] in which a tremor is looked for in a recording of this quantity."""
    return MOTION_BAND if quantity in MOTIONS else TREMOR_BAND


def is_recorded(measures: Measures) -> bool:
    """Whether they are of recordings, and not of a spectrum alone."""
    return "standard_deviation" in measures


def can_be_tested(target: Any, band: tuple[float, float]) -> bool:
    """Whether a target has what a test for a peak in a band needs: all bins about it, and
    segments."""
    f = target.settings.frequency
    return (
        len(target.bins) == len(f)
        and target.segments is not None
        and len(bins_in(band, target.settings)) > 0
    )


def measure_signals(
    signals: Sequence[Float[np.ndarray, " _"]],
    unit: str,
    quantity: str | None,
    band: tuple[float, float] | None = None,
    highest: float = math.inf,
) -> tuple[Iterator[Measures], Measures]:
    """The measures that `steadiness` lists, of each of several signals, whose tremor is looked for
    when they are asked for, and of all together.

    The signals are those of one person in one condition, sampled and low-passed as `RECORDED` says.
    They hold nothing above `highest` [Hz]: bands that reach above it are left out, and no tremor is
    looked for near it. The mean of what floats says nothing, and nothing is related to it.
    """
    band = searched_band(quantity, highest) if band is None else band
    settings = _settings_for_band(band, highest)
    segments = [_segments(x, settings) for x in signals]
    own = [_own(x, unit, quantity, highest) for x in signals]
    each = (
        _stated(m | _measure_tremor([s], settings, band, m), 1, len(s))
        for m, s in zip(own, segments, strict=True)
    )
    together = {name: _together([m[name] for m in own]) for name in own[0]}
    together |= _measure_tremor(segments, settings, band, together)
    return each, _stated(together, len(signals), sum(map(len, segments)))


def _own(x: Times, unit: str, quantity: str | None = None, highest: float = math.inf) -> Measures:
    """The measures of one signal but the tremor."""
    f, power = variance_spectrum(x, float(RECORDED.rate))
    _, level = variance_spectrum(scipy.signal.detrend(x), float(RECORDED.rate))
    mean, variance = float(np.mean(x)), float(np.sum(power))
    sure = float(np.sqrt(np.mean(power[:SLOWEST])))
    deviation = math.sqrt(variance)
    found = {
        MEAN: _measure(mean, sure, unit),
        "standard_deviation": _measure(deviation, _error(power) / (2 * deviation), unit),
    }
    # about the mean of what floats, nothing varies
    centre = math.nan if quantity in FLOATING else mean
    for name, part in (
        ("", power),
        ("_without_drift", level),
        (f"_above_{FAST:g}", power[f >= FAST]),
    ):
        found[f"{VARIATION}{name}"] = _variation(part, centre, sure)
    square = mean**2 if math.isfinite(found[VARIATION].value) else math.nan
    kinds: dict[str, Measures] = {"power": found, "relative_power": {}, "share": {}}
    for name, (low, high) in RANGES.items():
        inside = (f >= low) & (f < high)
        shown = (high if math.isfinite(high) else low) <= highest
        share = float(np.sum(power[inside])) / variance if shown else math.nan
        within, error = share * variance, _error(power * inside)
        related = math.hypot(error, 2 * within * sure / mean) / square
        of_share = _error(power * (inside - share)) / variance
        kinds["power"][f"power{name}"] = _measure(within, error, squared(unit))
        kinds["relative_power"][f"relative_power{name}"] = _measure(within / square, related, "1")
        kinds["share"][f"share{name}"] = _measure(share, of_share, "1")
    regular = {}
    whole, *parts = [(*regularity(part), dfa(part)) for part in (x, *np.array_split(x, PARTS))]
    for name, value, each in zip(REGULARITY, whole, zip(*parts, strict=True), strict=True):
        regular[name] = _measure(value, _error_of_mean(each), "1", "parts")
    return (
        found | kinds["relative_power"] | kinds["share"] | _median(_segments(x, RECORDED)) | regular
    )


def _median(segments: Float[np.ndarray, "segments bins"]) -> Measures:
    """The median frequency of the mean of segments, its error by leaving out one after another."""
    count = len(segments)
    left_out = (np.sum(segments, axis=0) - segments) / max(count - 1, 1)
    error = math.sqrt((count - 1) * np.var([median_frequency(p, RECORDED) for p in left_out]))
    value = median_frequency(np.mean(segments, axis=0), RECORDED)
    return {MEDIAN: _measure(value, error if count > 1 else math.nan, "Hz", "segments")}


def median_frequency(power: Float[np.ndarray, " bins"], settings: SpectrumSettings) -> float:
    """Below which half of the power in the bins lies [Hz], if it is even within each bin."""
    edges = np.append(settings.frequency, settings.frequency[-1] + settings.resolution)
    below = np.append(0.0, np.cumsum(power))
    return float(np.interp(0.5 * below[-1], below, edges - 0.5 * settings.resolution))


def _measure(value: float, error: float, unit: str, error_from: str = "spectrum") -> Measure:
    known = math.isfinite(value) and math.isfinite(error)
    return Measure(float(value), float(error) if known else None, unit, error_from)


def _error_of_mean(values: Sequence[float]) -> float:
    """By the scatter of the values; NaN where one does not exist."""
    known = np.all(np.isfinite(values))
    return float(np.std(values, ddof=1)) / math.sqrt(len(values)) if known else math.nan


def _error(power: Power) -> float:
    """Standard error of a sum: an ordinate is s χ²(1), its variance 2 s², and the mean of its
    square 3 s²."""
    return math.sqrt(2 / 3 * float(np.sum(power**2)))


def _variation(power: Power, mean: float, sure: float) -> Measure:
    deviation = math.sqrt(float(np.sum(power)))
    if not deviation <= abs(mean):
        return _measure(math.nan, math.nan, "1")
    error = math.hypot(_error(power) / (2 * deviation * mean), deviation * sure / mean**2)
    return _measure(deviation / abs(mean), error, "1")


def _stated(measures: Measures, trials: int, segments: int) -> Measures:
    """The measures with their 95 % intervals."""
    degrees = {
        "trials": trials - 1,
        "spectrum": SLOWEST * trials,
        "parts": (PARTS - 1) * trials,
        "segments": segments - 1,
        "bins": 0,  # has no Student's t
    }
    return {
        name: Measure(
            m.value, m.stderr, m.unit, m.error_from, _interval(name, m, degrees[m.error_from])
        )
        for name, m in measures.items()
    }


def _interval(name: str, m: Measure, degrees: int) -> tuple[float, float] | None:
    """Student's t, cut where no value can lie; but of what the spectrum says besides the mean in
    the logarithm or logit."""
    if m.stderr is None:
        return None
    share = name.startswith("share")
    if m.error_from in ("spectrum", "bins") and name != MEAN:
        return (logit_interval if share else log_interval)(m.value, m.stderr)
    low, high = student_interval(m.value, m.stderr, degrees)
    return low if name in SIGNED else max(low, 0.0), min(high, 1.0) if share else high


def _together(each: list[Measure]) -> Measure:
    """The mean over the trials; its error from their scatter, or of few trials from their own
    errors."""
    first, value = each[0], float(np.mean([m.value for m in each]))
    if len(each) >= ENOUGH:
        error = _error_of_mean([m.value for m in each])
        return _measure(
            value, error, first.unit, "trials" if math.isfinite(value) else first.error_from
        )
    error = math.hypot(*(math.nan if m.stderr is None else m.stderr for m in each)) / len(each)
    return _measure(value, error, first.unit, first.error_from)


def widen_errors(
    measures: Measures,
    signals: Sequence[Float[np.ndarray, " _"]],
    widening: float,
    common: float,
) -> Measures:
    """The measures of signals whose fluctuations change their size, with the errors that follow.

        s² -> w² s² + a² v x²

    s is the error of a value x, w the `widening`, v, `common`, the relative variance of the mean
    power by which all frequencies change together (`jaxmuscle.spectra._whitened`); a = 1 of a
    power, 1/2 of a standard deviation or variation, and 0 of a share or a median, from which what
    is common cancels. That is done where an error assumes a steady signal. What stands on the
    scatter of trials or parts, the tremor, which is tested by itself, and the mean, whose error
    slow ordinates give, stay as they are.
    """
    wider = dict(measures)
    for name, m in measures.items():
        assumed = m.error_from in ("spectrum", "segments") and name != MEAN
        if m.stderr is None or not assumed or name.startswith("tremor"):
            continue
        power = 1.0 if "power" in name else 0.0 if name.startswith(("share", MEDIAN)) else 0.5
        error = math.hypot(widening * m.stderr, power * math.sqrt(common) * m.value)
        wider[name] = Measure(m.value, error, m.unit, m.error_from)
    settings = _settings_for_band(TREMOR_BAND)
    stated = _stated(wider, len(signals), sum(settings.segments(len(x)) for x in signals))
    return {n: stated[n] if m is not measures[n] else m for n, m in wider.items()}


def searched_band(quantity: str | None, highest: float) -> tuple[float, float]:
    """The band [Hz] in which a tremor is looked for in what holds nothing above `highest`."""
    low, high = tremor_band(quantity)
    high = min(high, SEEN * highest)
    return low, high if high >= low + NARROWEST else low


def _settings_for_band(band: tuple[float, float], highest: float = math.inf) -> SpectrumSettings:
    """Those of recordings, with the bins that say what is smooth about a band."""
    first, last = bins_around(band, RECORDED)
    seen = int(min(SEEN * highest / RECORDED.resolution, last))
    first = first if seen == last else max(1, int(first * seen / last))
    return SpectrumSettings(**AS_RECORDED, first_bin=first, last_bin=max(seen, first))


def _segments(x: Times, settings: SpectrumSettings) -> Float[np.ndarray, "segments bins"]:
    """The spectrum of every Welch segment."""
    length, bins = settings.length, slice(settings.first_bin, settings.last_bin + 1)
    _, _, power = scipy.signal.spectrogram(x, settings.rate, "hann", length, length - settings.step)
    return power.T[:, bins]


def _measure_tremor(
    segments: list[Float[np.ndarray, "_ bins"]],  # of each trial
    settings: SpectrumSettings,
    band: tuple[float, float],
    measures: Measures,
) -> Measures:
    """The clearest peak of the mean of all segments; its errors by leaving out one trial after
    another, or of few trials one segment."""
    counts, whole = tuple(map(len, segments)), np.concatenate(segments)
    many = len(segments) >= ENOUGH
    groups, error_from = (segments, "trials") if many else ([*whole[:, None]], "segments")
    mean, varies = measures[MEAN], math.isfinite(measures[VARIATION].value)
    scale, unit = (1 / abs(mean.value), "1") if varies else (1.0, mean.unit)
    left_out = (
        np.mean(np.concatenate(groups[:i] + groups[i + 1 :]), axis=0) for i in range(len(groups))
    )
    tested = PeakTest(math.nan, (), math.nan)  # where the band is empty
    if band[1] > band[0]:
        tested = find_peaks(np.mean(whole, axis=0), settings, counts, band, LEVEL)
    return _tremor(
        tested,
        (measure_peak(power, settings, counts, band) for power in left_out),
        math.sqrt(len(groups) - 1),  # of the jackknife
        lambda power: scale * math.sqrt(power),
        unit,
        error_from,
    )


def _tremor(
    tested: PeakTest,
    again: Iterable[tuple[float, float]],
    spread: float,
    size_of: Callable[[float], float],
    unit: str,
    error_from: str,
) -> Measures:
    """The clearest peak that was found; its errors by so many times the spread of frequency and
    power when it is measured again, which is done only where there is one."""
    (frequency, size), errors = (math.nan, math.nan), (math.nan, math.nan)
    if tested.peaks:
        frequency, size = tested.peaks[0].frequency, size_of(tested.peaks[0].power)
        errors = spread * np.std([(f, size_of(power)) for f, power in again], axis=0)
    return {
        "tremor_p": Measure(tested.p, None, "1", error_from),
        "tremor_frequency": _measure(frequency, errors[0], "Hz", error_from),
        "tremor_size": _measure(size, errors[1], unit, error_from),
        "tremor_detectable": Measure(size_of(tested.detectable), None, unit, error_from),
    }


def measure_spectrum(target: Any) -> Measures:
    """What a target without recordings tells: mean and coefficient of variation as it states them;
    of its bins shares by band, median frequency and tremor.

    A share is of the power in the bins, of bins at the edges the part that lies inside; bands of
    which the bins cover less than half are left out. Errors follow from the law of the bins: that
    of a share s = Σ a_k p_k is √(g' C g), g_k = p_k (a_k - s), with C the covariance of the log
    powers; those of the median and of the tremor from spectra that are drawn about the bins, normal
    in the logarithm with that covariance. The tremor is looked for in what the bins cover of its
    band, where all bins are there and their segments are known. Its size is √(share of the peak)
    times the coefficient of variation.
    """
    found = {}
    stated = {
        MEAN: (target.mean, target.unit or "a.u."),
        VARIATION: (target.coefficient_of_variation, "1"),
    }
    for name, (values, unit) in stated.items():
        if values is not None:
            error = _error_of_mean(values) if len(values) >= ENOUGH else math.nan
            found[name] = _measure(float(np.mean(values)), error, unit, "trials")
    found |= _of_bins(target) if len(target.bins) else {}
    return _stated(found, len(target.mean or ()), 0)


def _of_bins(target: Any) -> Measures:
    p, settings, found = target.proportional_power, target.settings, {}
    statistics = bin_statistics(target)
    covariance = statistics.covariance if statistics.known else np.full(2 * (len(p),), np.nan)
    covers = in_bands(target.frequency, settings.resolution)
    for (name, (low, high)), inside in zip(BANDS.items(), covers, strict=True):
        if np.sum(inside) * settings.resolution >= 0.5 * (high - low):
            share = float(inside @ p)
            slope = p * (inside - share)
            error = math.sqrt(slope @ covariance @ slope)
            found[f"share{name.removeprefix('band')}"] = _measure(share, error, "1", "bins")
    if len(p) < len(settings.frequency):  # some bins are missing
        return found
    root = np.linalg.cholesky(covariance) if statistics.known else covariance
    drawn = p * np.exp(np.random.default_rng(0).standard_normal((DRAWN, len(p))) @ root.T)
    error = float(np.std([median_frequency(row, settings) for row in drawn]))
    found[MEDIAN] = _measure(median_frequency(p, settings), error, "Hz", "bins")
    band = tremor_band(target.quantity)
    if can_be_tested(target, band):
        about, varied = (settings, target.segments, band), target.coefficient_of_variation
        scale = math.nan if varied is None else float(np.mean(varied))
        found |= _tremor(
            find_peaks(p, *about, LEVEL),
            (measure_peak(power / np.sum(power), *about) for power in drawn),
            1.0,
            lambda power: scale * math.sqrt(power / settings.resolution),
            "1",
            "bins",
        )
    return found
