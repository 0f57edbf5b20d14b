"""How steady a held force is: a report of one recording or of several trials, without any model."""

import math
from collections.abc import Iterable
from os import PathLike
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import versions
from jaxmuscle._common.files import nulled, write_json
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import choices, folded, probability, rounded, squared
from jaxmuscle.spectra._bin_law import ENOUGH
from jaxmuscle.spectra._fluctuations import BANDS, dfa, variance_spectrum
from jaxmuscle.spectra._measures import regularity
from jaxmuscle.spectra._peak_test import bins_around, find_peaks, measure_peak
from jaxmuscle.spectra._settings import SpectrumSettings, require

from ._measure import Measure, likelier_error, log_interval, logit_interval, student_interval
from ._recording import AS_RECORDED, RECORDED, SEGMENTS, SHORTEST, Recording, notices_of, unlike

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

ALL = "all"
PARTS, SLOWEST = 4, 4  # parts of a recording; ordinates that say how sure its mean is
ALIKE = 1.2  # longest trial over shortest
# Hz, where a tremor is looked for; what moves shows it over a wider band than a held force
TREMOR_BANDS = {"displacement": (3.0, 20.0), "acceleration": (3.0, 20.0)}
TREMOR_BAND = (6.0, 12.0)
LEVEL = 0.01  # of the test for a tremor
NEXT, WANDERS = 12, 0.05  # ordinates; level of the test whether the slowest of them stand out
RANGES = {name.removeprefix("band"): edges for name, edges in BANDS.items()} | {
    "_above_12": (12.0, math.inf)
}
FAST = 0.5  # Hz
CUT_OFF = RECORDED.filter_cutoff or math.inf  # Hz, of the low-pass before everything
SIGNED = ("mean", "dfa_exponent")  # all else is 0 or more
VARIATION = "coefficient_of_variation"
REGULARITY = ("approximate_entropy", "sample_entropy", "dfa_exponent")
WORDS = {
    "mean": "mean",
    "standard_deviation": "standard deviation",
    VARIATION: "coefficient of variation",
    f"{VARIATION}_without_drift": "  without a straight drift",
    f"{VARIATION}_above_{FAST:g}": f"  of what is above {FAST:g} Hz",
    "approximate_entropy": "approximate entropy",
    "sample_entropy": "sample entropy",
    "dfa_exponent": "DFA exponent",
}
TREMOR = {
    "tremor_p": "tremor, {:g} to {:g} Hz",
    "tremor_frequency": "  frequency",
    "tremor_size": "  size{}",
    "tremor_detectable": "  size that would show",
}
PEAK = (
    "A tremor is stated if the spectrum has a peak that at most 1 in 100 smooth spectra would show"
    " by chance (p <= 0.01). A tremor of the size that would show is seen in nine of ten such"
    " recordings; a smaller one may be there unseen."
)


class Steadiness(Printed, Result, eqx.Module):
    """What `steadiness` found; `print` shows it as a table, `found["sample_entropy"]` is one
    `Measure`.

    `measures` of all trials together, by name; `trials`, the measures of each by its name, and
    their `durations` [s]; the `unit` and `quantity` of the signal; the `band` [Hz] in which a
    tremor was looked for; `notices`, sentences on what was done and what to mind.
    """

    measures: dict[str, Measure]
    trials: dict[str, dict[str, Measure]]
    durations: dict[str, float]
    unit: str
    quantity: str | None
    band: tuple[float, float]
    notices: tuple[str, ...]

    def __getitem__(self, name: str) -> Measure:
        require(name in self.measures, "name", name, choices(name, self.measures))
        return self.measures[name]

    def to_dict(self) -> dict[str, Any]:
        """The same for JSON, with `None` for what does not exist."""
        each = {
            name: {"duration_s": self.durations[name], "measures": _plain(own)}
            for name, own in self.trials.items()
        }
        return {
            "unit": self.unit,
            "quantity": self.quantity,
            "tremor_band_hz": list(self.band),
            "measures": _plain(self.measures),
            "trials": each,
            "notices": list(self.notices),
            "versions": versions(),
        }

    def save(self, path: str | PathLike[str]) -> None:
        """Write `to_dict()` as JSON."""
        write_json(str(path), self.to_dict())

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row per trial and quantity, then those of all trials together, whose `trial` is "all".

        Columns `trial`, `duration_s`, `quantity`, `value`, `stderr`, `low` and `high` (ends of the
        95 % interval), `unit`, `error_from`.
        """
        lasted = self.durations | {ALL: sum(self.durations.values())}
        rows = [
            {"trial": name, "duration_s": lasted[name], "quantity": quantity, **m.row()}
            for name, own in (self.trials | {ALL: self.measures}).items()
            for quantity, m in own.items()
        ]
        return frame(rows)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Draw power by band, coefficients of variation and regularity, every trial as a dot;
        returns the figure."""
        return plot.steadiness(self, ax)

    def __str__(self) -> str:
        count, seconds = len(self.trials), sorted(self.durations.values())
        long = f"{seconds[0]:.3g} s" + (
            f" to {seconds[-1]:.3g} s each" if seconds[-1] > 1.01 * seconds[0] else ""
        )
        what = f"{count} trials" if count > 1 else next(iter(self.trials))
        lines = [_line(words, name, self.measures[name]) for name, words in WORDS.items()]
        bands = [
            [
                _line(f"  {_range(*edges)}", f"{kind}{name}", self.measures[f"{kind}{name}"])
                for name, edges in RANGES.items()
            ]
            for kind in ("power", "share")
        ]
        square = squared(self.unit).replace("^2", "²")
        lines[5:5] = [f"power by band [{square}]", *bands[0], "share of the variance", *bands[1]]
        head = f"Steadiness of {what}: {self.quantity or 'signal'} [{self.unit}], {long}"
        columns = f"{'':<28}{'value ± standard error':<25} 95 % interval"
        return folded(
            [
                head,
                columns,
                *lines,
                *self._tremor_lines(),
                _of_errors(count),
                PEAK,
                *(f"notice: {notice}" for notice in self.notices),
            ]
        )

    def _tremor_lines(self) -> list[str]:
        """Whether there is one; its frequency and size; the size that would have shown."""
        p, seen = self.measures["tremor_p"].value, self.measures["tremor_size"]
        first = TREMOR["tremor_p"].format(*self.band)
        here = math.isfinite(seen.value)
        lines = [f"{first:<28}{'seen' if here else 'none seen'}, {probability(p)}"]
        of = " over the mean" * (self.measures["tremor_detectable"].unit == "1")
        for name in list(TREMOR)[1 if here else 3 :]:
            lines.append(_line(TREMOR[name].format(of), name, self.measures[name]))
        return lines


def _of_errors(count: int) -> str:
    """What the errors contain."""
    if count < ENOUGH:
        return (
            f"± is the standard error. It is estimated within {'the' if count == 1 else 'each'}"
            " recording: for entropies and DFA from its four parts, for the tremor from its Welch"
            " segments, for all else from its spectrum. So it does not say how the next recording"
            " differs: between trials of one person we saw about twice as much."
        )
    return (
        f"± is the standard error, from the scatter between the {count} trials. A fit states larger"
        " errors of mean and variation: it takes at least the scatter by chance within the trials,"
        " and stretches the error of few trials so that ± 1.96 of it is a 95 % interval."
    )


def _plain(measures: dict[str, Measure]) -> dict[str, Any]:
    return {name: nulled(vars(m)) for name, m in measures.items()}


def _range(low: float, high: float) -> str:
    return f"{low:g} to {min(high, CUT_OFF):g} Hz"


def _line(words: str, name: str, m: Measure) -> str:
    """The ends of the interval have as many places as value and error."""
    percent = name.startswith((VARIATION, "share")) or (name in TREMOR and m.unit == "1")
    bare = m.unit == "1" or name.startswith("power")
    scale, unit = (
        (100.0, " %") if percent else (1.0, "" if bare else f" {m.unit.replace('^2', '²')}")
    )
    said, ends = f"{scale * m.value:.3g}{unit}", ""
    if math.isnan(m.value):
        said = "none"
    if m.stderr is not None and m.interval is not None:
        said = " ± ".join(rounded(scale * m.value, scale * m.stderr)) + unit
        ends = " to ".join(rounded(scale * end, scale * m.stderr)[0] for end in m.interval)
    return f"{words:<28}{said:<25} {ends}".rstrip()


def steadiness(
    recordings: Recording | Iterable[Recording], *, band: tuple[float, float] | None = None
) -> Steadiness:
    """How steady a force, torque or displacement is held: variability, power by band, regularity.
    No model is fitted.

        print(jm.steadiness(jm.load_recordings(["trial1.csv", "trial2.csv"]).steady()))

    Everything is computed of the window of each recording (`steady()` finds it), as
    `Recording.filtered` gives it: resampled to 100 Hz and low-passed at 30 Hz.

    | name | what it is |
    |---|---|
    | `mean`, `standard_deviation` | μ and σ [unit]; σ² divides by the number of samples |
    | `coefficient_of_variation` | σ / abs(μ), a fraction; NaN where σ exceeds abs(μ) |
    | `..._without_drift` | the same about the least-squares line, over abs(μ) |
    | `..._above_0.5` | the same without what is slower than 0.5 Hz: √(Σ of the powers above) / abs(μ) |
    | `power_0_0.5` ... `power_8_12`, `power_above_12` | power in the bands of the fits' `band_...`, and from 12 to 30 Hz |
    | `share_0_0.5` ... | the same over σ², a fraction |
    | `approximate_entropy`, `sample_entropy` | of templates of 2 samples, within 0.2 σ |
    | `dfa_exponent` | slope of detrended fluctuations, windows from 0.04 s to a tenth of the recording, order 1 |
    | `tremor_p` | how often a smooth spectrum shows a peak in the band as clear as the clearest one here |
    | `tremor_frequency` | of that peak, if p is at most 0.01 [Hz]; else NaN |
    | `tremor_size` | √(power of the peak) / abs(μ), a fraction; where there is no variation √power [unit] |
    | `tremor_detectable` | the size, in the same unit, that nine of ten such recordings would show |

    **Power by band** is the sum of `jaxmuscle.spectra.variance_spectrum` over low ≤ f < high. It
    takes the whole window, of length T, at once, resolves 1/(2T), and loses nothing: the seven
    powers add up to σ². A drift is in the lowest band. The shares of a fit (`band_0_0.5`) are of
    the 30 bins from 0.39 to 11.72 Hz only, and so are larger above 0.5 Hz.

    **The tremor** is the clearest peak of the Welch spectrum (2.56 s, bins of 0.39 Hz) in `band`,
    tested against smooth spectra, see `jaxmuscle.spectra.find_peaks`. That of several trials is of
    their mean spectrum.

    **Several trials** count alike: any other value is the mean of the trials' values.

    **Standard errors**, by the number of trials:

    - Three or more, "trials": the standard deviation between the trials over √n; of the tremor, the
      jackknife over trials. A fit takes the larger of this scatter and of what trials of this
      length scatter by chance: five may happen to agree.
    - One or two, "spectrum": the ordinates of the spectrum are taken as independent, the variance
      of each as 2/3 of its square, as in a stationary Gaussian signal; of the mean, from the four
      slowest. What is slower than the recording is not in it: where the level wanders, the mean of
      the next trial differs by more.
    - One or two, "parts" (entropies, DFA exponent): the standard deviation of the values of the
      four quarters over 2; "segments" (tremor): the jackknife over Welch segments.

    **95 % intervals**, value ± t errors, with Student's t of ν degrees of freedom, cut where no
    value can lie (below 0; of a share above 1): "trials" ν = n - 1; "parts" 3n; "segments" their
    number less 1; the mean 4n. For if the spectrum is flat up to 2/T, the squared error of the mean
    is the mean of 4n squares of normal numbers, which are independent of the mean. What else is
    from the "spectrum": value · exp(± 1.96 error / value); of a share p the same of its odds p /
    (1 - p). How often they hold the expected value stands in `docs/recordings.md`.

    **Arguments:** `recordings`, one or several trials of one condition of one person, in one unit;
    `band` (low, high) [Hz] in which a tremor is looked for, by default 6 to 12 Hz in a force, 3 to
    20 Hz in a displacement or an acceleration.

    **Returns:** a `Steadiness`; it prints, plots and saves itself.

    **Raises:** `ValueError` for no recordings, different units, a window that is constant or
    shorter than 3.84 s.
    """  # noqa: E501 (a row of a table is one line)
    each = [recordings] if isinstance(recordings, Recording) else list(recordings)
    require(len(each) > 0, "recordings", each, "give at least one Recording")
    for recording in each:
        require(
            isinstance(recording, Recording),
            "recordings",
            recording,
            "load_recording(...) reads a file",
        )
        recording._require_change()
        remedy = f"{recording.name} lasts {recording.duration:.3g} s; give at least {SHORTEST:g} s"
        require(recording.segments() >= SEGMENTS, "window", recording.window, remedy)
    _same_unit(each)
    names = [recording.name for recording in each]
    names = [
        name if [*names, ALL].count(name) == 1 else f"{name} {i}"
        for i, name in enumerate(names, start=1)
    ]
    durations = {name: recording.duration for name, recording in zip(names, each, strict=True)}
    signals = [recording.filtered() for recording in each]
    usual = TREMOR_BANDS.get(each[0].quantity or "", TREMOR_BAND)
    band = usual if band is None else (float(band[0]), float(band[1]))
    settings = _settings_for_band(band)
    segments = [_segments(x, settings) for x in signals]
    own = [_own(x, each[0].unit) for x in signals]
    trials = {
        name: _stated(m | _measure_tremor([s], settings, band, m), 1, len(s))
        for name, m, s in zip(names, own, segments, strict=True)
    }
    together = {name: _together([m[name] for m in own]) for name in own[0]}
    together |= _measure_tremor(segments, settings, band, together)
    together = _stated(together, len(each), sum(map(len, segments)))
    said = notices_of(each, signals, float(RECORDED.rate), [()] * len(each), each[0].quantity)
    if (
        len(each) < ENOUGH
        and each[0].quantity in ("force", "torque")
        and unlike(names, signals, each[0].unit)
    ):
        said = (
            *said,
            "the errors do not contain how much two trials differ: for that give three or more",
        )
    if len(each) < ENOUGH:
        said = (*said, *_notice_wandering(signals))
    notices = (*said, *_mind(durations, together, own))
    unit, quantity = each[0].unit, each[0].quantity
    return Steadiness(together, trials, durations, unit, quantity, band, notices)


def _notice_wandering(signals: list[np.ndarray]) -> tuple[str, ...]:
    """What to say where the spectrum still rises towards the slowest ordinates, which say how sure
    the mean is.

    If it is flat there, each ordinate is s χ²(1), and the ratio of the mean of the first 4 to that
    of the next 8, of n recordings together, has an F distribution of 4n and 8n degrees of freedom.
    """
    power = np.mean([variance_spectrum(x, 1.0)[1][:NEXT] for x in signals], axis=0)
    ratio = float(np.mean(power[:SLOWEST]) / np.mean(power[SLOWEST:]))
    count = len(signals)
    if scipy.special.fdtrc(SLOWEST * count, (NEXT - SLOWEST) * count, ratio) > WANDERS:
        return ()
    return (
        f"the level wanders: the slowest fluctuations have {ratio:.2g} times the power of the next"
        " ones. Then the mean of another recording may differ by more than the interval of the mean"
        " says. Three trials or more show by how much",
    )


def _same_unit(each: list[Recording]) -> None:
    units = {recording.unit: recording.name for recording in reversed(each)}
    told = ", ".join(f"{name} in {unit}" for unit, name in units.items())
    remedy = (
        "convert them to one unit (Recording(1e-3 * samples, rate, unit=...)), or report on each"
        " unit by itself"
    )
    if len(units) > 1:
        raise ValueError(f"recordings: units differ ({told}); {remedy}")


def _mind(
    durations: dict[str, float], together: dict[str, Measure], own: list[dict[str, Measure]]
) -> Iterable[str]:
    short, long = min(durations.values()), max(durations.values())
    if long > ALIKE * short:
        yield (
            f"the trials last {short:.3g} s to {long:.3g} s: what is slow (variation, power below"
            " 0.5 Hz, DFA exponent) grows with the length, so choose windows of one length"
        )
    if math.isnan(together[VARIATION].value):
        yield "the mean is near zero: there is no coefficient of variation"
    likelier = (
        {name: likelier_error([m[f"power{name}"] for m in own]) for name in RANGES}
        if len(own) >= ENOUGH
        else {}
    )
    if told := [
        f"± {error:.2g} from {_range(*RANGES[name])}"
        for name, error in likelier.items()
        if error is not None
    ]:
        yield (
            "in some bands the trials happen to agree much better than recordings of this length"
            f" do: {', '.join(told)} is a more likely error of the power than the one in the table"
        )


def _own(x: Float[np.ndarray, " times"], unit: str) -> dict[str, Measure]:
    """The measures of one recording but the peak."""
    rate = float(RECORDED.rate)
    f, power = variance_spectrum(x, rate)
    _, level = variance_spectrum(scipy.signal.detrend(x), rate)
    mean, variance = float(np.mean(x)), float(np.sum(power))
    sure = float(np.sqrt(np.mean(power[:SLOWEST])))
    found = {
        "mean": _measure(mean, sure, unit),
        "standard_deviation": _measure(
            math.sqrt(variance), _error(power) / (2 * math.sqrt(variance)), unit
        ),
        VARIATION: _variation(power, mean, sure),
        f"{VARIATION}_without_drift": _variation(level, mean, sure),
        f"{VARIATION}_above_{FAST:g}": _variation(power[f >= FAST], mean, sure),
    }
    shares = {}
    for name, (low, high) in RANGES.items():
        inside = (f >= low) & (f < high)
        share = float(np.sum(power[inside])) / variance
        found[f"power{name}"] = _measure(share * variance, _error(power * inside), squared(unit))
        shares[f"share{name}"] = _measure(share, _error(power * (inside - share)) / variance, "1")
    regular = {}
    whole, *parts = [(*regularity(part), dfa(part)) for part in (x, *np.array_split(x, PARTS))]
    for name, value, each in zip(REGULARITY, whole, zip(*parts, strict=True), strict=True):
        error = (
            float(np.std(each, ddof=1)) / math.sqrt(PARTS)
            if np.all(np.isfinite(each))
            else math.nan
        )
        regular[name] = _measure(value, error, "1", "parts")
    return found | shares | regular


def _measure(value: float, error: float, unit: str, error_from: str = "spectrum") -> Measure:
    known = math.isfinite(value) and math.isfinite(error)
    return Measure(float(value), float(error) if known else None, unit, error_from)


def _error(power: Float[np.ndarray, " frequencies"]) -> float:
    """Standard error of a sum: an ordinate is s χ²(1), its variance 2 s², and the mean of its
    square 3 s²."""
    return math.sqrt(2 / 3 * float(np.sum(power**2)))


def _variation(power: Float[np.ndarray, " frequencies"], mean: float, sure: float) -> Measure:
    deviation = math.sqrt(float(np.sum(power)))
    if not deviation <= abs(mean):
        return _measure(math.nan, math.nan, "1")
    error = math.hypot(_error(power) / (2 * deviation * mean), deviation * sure / mean**2)
    return _measure(deviation / abs(mean), error, "1")


def _stated(measures: dict[str, Measure], trials: int, segments: int) -> dict[str, Measure]:
    """The measures with their 95 % intervals."""
    degrees = {
        "trials": trials - 1,
        "spectrum": SLOWEST * trials,
        "parts": (PARTS - 1) * trials,
        "segments": segments - 1,
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
    if m.error_from == "spectrum" and name != "mean":
        return (logit_interval if share else log_interval)(m.value, m.stderr)
    low, high = student_interval(m.value, m.stderr, degrees)
    return low if name in SIGNED else max(low, 0.0), min(high, 1.0) if share else high


def _together(each: list[Measure]) -> Measure:
    """The mean over the trials; its error from their scatter, or of few trials from their own
    errors."""
    values, first, count = [m.value for m in each], each[0], len(each)
    if not np.all(np.isfinite(values)):
        return _measure(math.nan, math.nan, first.unit, first.error_from)
    if count >= ENOUGH:
        error = float(np.std(values, ddof=1)) / math.sqrt(count)
        return _measure(float(np.mean(values)), error, first.unit, "trials")
    error = math.hypot(*(math.nan if m.stderr is None else m.stderr for m in each)) / count
    return _measure(float(np.mean(values)), error, first.unit, first.error_from)


def _settings_for_band(band: tuple[float, float]) -> SpectrumSettings:
    """Those of recordings, with the bins that say what is smooth about a band."""
    first, last = bins_around(band, RECORDED)
    return SpectrumSettings(**AS_RECORDED, first_bin=first, last_bin=last)


def _segments(
    x: Float[np.ndarray, " times"], settings: SpectrumSettings = RECORDED
) -> Float[np.ndarray, "segments bins"]:
    """The spectrum of every Welch segment."""
    length, bins = settings.length, slice(settings.first_bin, settings.last_bin + 1)
    _, _, power = scipy.signal.spectrogram(x, settings.rate, "hann", length, length - settings.step)
    return power.T[:, bins]


def _measure_tremor(
    segments: list[Float[np.ndarray, "_ bins"]],  # of each trial
    settings: SpectrumSettings,
    band: tuple[float, float],
    measures: dict[str, Measure],
) -> dict[str, Measure]:
    """The clearest peak of the mean of all segments; its errors by leaving out one trial after
    another, or of few trials one segment."""
    counts, whole = tuple(map(len, segments)), np.concatenate(segments)
    many = len(segments) >= ENOUGH
    groups, error_from = (segments, "trials") if many else ([*whole[:, None]], "segments")
    mean, varies = measures["mean"], math.isfinite(measures[VARIATION].value)
    scale, unit = (1 / abs(mean.value), "1") if varies else (1.0, mean.unit)

    def measured(power: Float[np.ndarray, " bins"]) -> tuple[float, float]:
        frequency, excess = measure_peak(power, settings, counts, band)
        return frequency, scale * math.sqrt(excess)

    found = find_peaks(np.mean(whole, axis=0), settings, counts, band, LEVEL)
    values, errors = (math.nan, math.nan), (math.nan, math.nan)
    if found.peaks:
        peak = found.peaks[0]
        values = peak.frequency, scale * math.sqrt(peak.power)
        left_out = [
            measured(np.mean(np.concatenate(groups[:i] + groups[i + 1 :]), axis=0))
            for i in range(len(groups))
        ]
        errors = np.sqrt((len(groups) - 1) * np.var(left_out, axis=0))
    return {
        "tremor_p": Measure(found.p, None, "1", error_from),
        "tremor_frequency": _measure(values[0], float(errors[0]), "Hz", error_from),
        "tremor_size": _measure(values[1], float(errors[1]), unit, error_from),
        "tremor_detectable": Measure(scale * math.sqrt(found.detectable), None, unit, error_from),
    }
