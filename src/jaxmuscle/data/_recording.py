"""Recordings: what was measured (force, torque, motion), its steady part, its spectra, and the
target it gives."""

import itertools
import math
from collections.abc import Sequence
from fractions import Fraction
from typing import Any, Unpack, get_args

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arguments import check_options, is_real, require
from jaxmuscle._common.cards import Card, Shown, facts
from jaxmuscle._common.text import choices
from jaxmuscle.spectra._measures import peaks, regularity
from jaxmuscle.spectra._settings import SpectrumSettings
from jaxmuscle.spectra._welch import Spectrum, lowpass, spectrum_of

from ._measured import AS_RECORDED, FLOATING, MOTIONS, RECORDED, measure_signals
from ._recording_choice import About, Reading, ReadingOptions, recording_of
from ._recording_outliers import OUTLIERS, OUTSIDE, Burst, find_bursts
from ._recording_quality import (
    AT_REST,
    Baseline,
    RecordingSummary,
    checked,
    clipping,
    find_rest,
    plateau,
    running_median,
    without_rest,
)
from ._recording_table import frame_table
from ._target import Target
from ._target_fields import Quantity
from ._units import UNITS, known_unit

LOWEST_RATE = 10.0  # Hz; half of it lies above what is slow in a force
SEGMENTS = 2  # a steady part holds at least this many
SHORTEST = (RECORDED.length + (SEGMENTS - 1) * RECORDED.step) / RECORDED.rate  # s, which these take
DRIFT = 0.5  # share of the variance
UNLIKE = 1.1  # ratio of the means of two trials
APART = 3.0  # standard deviations within, by which means of one person and condition hardly differ
SEVERAL = " If these are several people or conditions, write a table (docs/study.md)"
UNRAMPED = "steady part: no ramp found, so all of the recording is used"
BURST = "the force leaves its level"
FOUND = "steady part found automatically: "


class Recording(Shown, eqx.Module):
    """A recording of one signal at a fixed rate, with the window that is to be analysed.

    **Arguments:**

    - `samples`: the signal [`unit`], shape `(times,)`.
    - `rate`: samples per second [Hz], at least 10; for a spectrum at least 24, so that bin 30 lies
      below half of it.
    - `unit`: N, mN, kN, kgf, gf, lbf, % MVC (force); N m, mN m, N cm, N mm, kgf m, lbf ft, lbf in
      (torque); m, cm, mm, um (displacement); deg, rad (angle); m/s^2, mm/s^2, g, mg (acceleration;
      g is 9.81 m/s^2); deg/s, rad/s (angular velocity); V, mV, uV, a.u.
    - `quantity`: what was measured, if the unit (V, mV, uV, a.u.) does not say it.
    - `baseline`: what is subtracted as the level at rest: the mean of a part (a, b) [s], or "none";
      by default what `find_rest` finds, if it is quiet (`docs/recordings.md`, A sensor that is not
      zero at rest).
    - `detrend`: whether `steady` subtracts the straight line through the steady part.
    - `name`, `source`: how reports call it and where it comes from.
    - `start`: time of the first sample [s]; other than 0 if the file begins with a gap.
    - `window`: (start, stop) [s] of the part that is analysed, or all of it.
    - `notices`: what was done to the samples, in sentences.
    - `recorded_at` [Hz]: the rate before the samples were resampled, by default `rate`. What lay
      above half of it has folded to lower frequencies; a target states it, and its fit expects it.
    - `others`: recordings before and after a pause, of which `steady` takes the one that holds the
      window.

    `whole` holds all samples, since filters run before the window is cut; `samples` and `time` are
    the window's.

    **Raises:** `ValueError` naming the argument, its value and the remedy; also for a constant
    signal.
    """

    whole: Float[np.ndarray, " all"]
    rate: float = eqx.field(static=True)
    unit: str = eqx.field(static=True)
    quantity: str | None = eqx.field(static=True)
    detrend: bool = eqx.field(static=True)
    name: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    start: float = eqx.field(static=True)
    window: tuple[float, float] | None = eqx.field(static=True)
    notices: tuple[str, ...] = eqx.field(static=True)
    recorded_at: float = eqx.field(static=True)
    others: tuple["Recording", ...]

    def __init__(
        self,
        samples: Any,
        rate: float | int,
        *,
        unit: str = "N",
        quantity: str | None = None,
        baseline: Baseline = None,
        detrend: bool = False,
        recorded_at: float | int | None = None,
        **about: Unpack[About],
    ):
        check_options(Recording, About, about)
        self.name = about.get("name", "recording")
        self.source = about.get("source", "given by the user")
        self.rate, self.start = _rate(rate), float(about.get("start", 0.0))
        self.recorded_at = self.rate if recorded_at is None else _rate(recorded_at)
        spelled = known_unit(unit)
        require(spelled is not None, "unit", unit, choices(unit, UNITS))
        self.unit, self.detrend = str(spelled), detrend
        known = tuple(dict.fromkeys(filter(None, UNITS.values())))
        remedy = choices(quantity, known)
        require(quantity in (None, *known), "quantity", quantity, remedy)
        self.quantity = UNITS[self.unit] or quantity
        remedy = f"the unit {unit} is that of another quantity ({self.quantity}); give `units`"
        require(quantity in (None, self.quantity), "quantity", quantity, remedy)
        given = checked(samples, self.rate, self.start)
        self.others, notices = tuple(about.get("others", ())), tuple(about.get("notices", ()))
        if baseline is None and self.quantity in MOTIONS:
            baseline = "none"
        self.whole, said = without_rest(given, self.rate, self.start, self.unit, baseline)
        self.whole.setflags(write=False)
        marked = any(OUTSIDE in notice for notice in notices)
        own = [*([] if marked else clipping(self.whole, self.rate, self.start)), *said]
        if self.rate < RECORDED.rate:
            own.append(f"recorded at {self.rate:g} Hz: holds nothing above {self.rate / 2:g} Hz")
        self.notices = tuple(dict.fromkeys((*notices, *own)))
        window = about.get("window")
        self.window = None if window is None else self._checked(window)

    @classmethod
    def from_dataframe(
        cls, frame: Any, *, name: str = "recording", **options: Unpack[ReadingOptions]
    ) -> "Recording":
        """A recording from a pandas table, by the rules for tables in files.

        **Arguments:** `frame`, a `pandas.DataFrame`. Its times are a column, or the index: numbers
        in s, a `DatetimeIndex` or a `TimedeltaIndex`. `name` as in `Recording`; the `options` are
        those of `load_recording` for one column: `column`, `rate`, `units`, `axis`, `reference`,
        `time`, `max_gap`, `lever_arm`, `outliers`, `quantity`, `baseline`, `detrend`.

        **Raises:** `ValueError` naming column, row or argument, and the remedy.
        """
        check_options(cls.from_dataframe, ReadingOptions, options)
        return recording_of(cls, frame_table(frame), Reading(**options), name)

    def _checked(self, window: Any) -> tuple[float, float]:
        try:
            a, b = (float(edge) for edge in window)
        except (TypeError, ValueError):
            raise ValueError(f"window={window!r}: give two times in s, as (8, 25)") from None
        parts = [f", or {part.start:g} <= ... <= {part.stop:g} s" for part in self.others]
        remedy = (
            f"give times with {self.start:g} <= start < stop <= {self.stop:g} s, the"
            f" recording's own{''.join(parts)}"
        )
        near = 0.5 / self.rate
        require(
            self.start - near <= a < b <= self.stop + near, f"{self.name}: window", window, remedy
        )
        return a, b

    def holds(self, window: Any) -> bool:
        """Whether a window lies in it."""
        try:
            self._checked(window)
        except ValueError:
            return False
        return True

    def span(self, rate: float | int) -> tuple[int, int]:
        """The window as sample numbers at a rate."""
        a, b = (self.start, self.stop) if self.window is None else self.window
        return max(round((a - self.start) * rate), 0), round((b - self.start) * rate)

    def _with(self, **changed: Any) -> "Recording":
        """The recording with other arguments; its level at rest is subtracted already."""
        # parts beyond a pause are parts of the file, not of what is made of one of them
        kept = {key: value for key, value in vars(self).items() if key not in ("whole", "others")}
        return Recording(**{"samples": self.whole, "baseline": "none"} | kept | changed)

    @property
    def stop(self) -> float:
        """End of the recording [s]: one sampling interval after its last sample."""
        return self.start + self.whole.size / self.rate

    @property
    def samples(self) -> Float[np.ndarray, " times"]:
        """The samples in the window [`unit`], as recorded."""
        return self.whole[slice(*self.span(self.rate))]

    @property
    def time(self) -> Float[np.ndarray, " times"]:
        """Times of `samples` [s]."""
        return self.start + np.arange(self.whole.size)[slice(*self.span(self.rate))] / self.rate

    @property
    def duration(self) -> float:
        """Length of the window [s]."""
        return self.samples.size / self.rate

    def resampled(self, rate: float | int = 100.0) -> "Recording":
        """The recording at another rate: `scipy.signal.resample_poly`, which low-passes against
        aliases.

        The ratio of the rates is taken as the nearest fraction with a denominator of at most
        10 000. Beyond the ends the straight line from the first to the last sample is assumed
        (`padtype="line"`).

        **Raises:** `ValueError` if no such fraction is within 0.01 % of the ratio.
        """
        rate = _rate(rate)
        ratio = Fraction(rate / self.rate).limit_denominator(10_000)
        close = math.isclose(float(ratio), rate / self.rate, rel_tol=1e-4)
        require(
            close,
            "rate",
            rate,
            f"is too far from the {self.rate:g} Hz recorded; give a rate nearer to it",
        )
        if ratio == 1:
            return self
        samples = scipy.signal.resample_poly(
            self.whole, ratio.numerator, ratio.denominator, padtype="line"
        )
        return self._with(samples=samples, rate=rate)

    def steady(self, window: Sequence[float | int] | str | None = None) -> "Recording":
        """The recording with its steady part as window: the one that is given, or the plateau of a
        ramp-and-hold.

        The plateau is the longest stretch in which the running median over 1 s differs from the
        level by at most a tenth of the height from rest to level. Rest is that extreme of the
        running median which is nearer to zero, the peak is the other one, and the level is the
        median of what lies more than half-way from rest to peak. The plateau has to hold at least
        half of the time spent beyond half-way; one second is taken off at the ramps. Without a ramp
        (running median within a fifth of its largest value) all of it is steady. So is an
        acceleration or an angular velocity, which holds no level.

        With `detrend` the straight line through the window is subtracted from the recording, and
        its mean in the window kept.

        **Arguments:** `window` (start, stop) [s], in the recording's own time, or "all".

        **Raises:** `ValueError` if no plateau is found, and if the window is shorter than two Welch
        segments (3.84 s).
        """
        if isinstance(window, str) and window == "all":
            return self._straight()
        if window is None:
            part = self._hold()
            what = f"its steady part of {part.duration:.3g} s"
        else:
            for part in self.others:
                if part.holds(window):
                    return part.steady(window)
            part = self._with(window=self._checked(window))
            what = f"window={part.window!r}"
        count = part.segments()
        if count < SEGMENTS:
            raise ValueError(
                f"{self.name}: {what} holds {count} of the {SEGMENTS} Welch segments needed; give"
                f" at least {SHORTEST:g} s"
            )
        return part._straight()

    def _hold(self) -> "Recording":
        """The recording with the plateau of its ramp-and-hold as window, see `steady`."""
        even = self.resampled(RECORDED.rate)
        everything = found = (0, even.whole.size)
        if self.quantity not in FLOATING:
            rest = find_rest(even.whole, even.rate)
            level = rest.level if rest is not None and rest.quiet else 0.0
            found = plateau(even.whole - level, even.rate)
        if found is None:
            resting = "".join(f". {said}" for said in self.notices if said.startswith(AT_REST))
            raise ValueError(
                f"{self.name}: no steady part was found: the signal must stay within 10 % of"
                " one level for at least half of the time under load, and longer than 2 s. Is"
                " it the right column? Then give the part yourself: --window a:b (in Python"
                f" steady((a, b))), between {self.start:g} and {self.stop:g} s{resting}"
            )
        a, b = (min(self.start + edge / even.rate, self.stop) for edge in found)
        said = UNRAMPED if found == everything else f"{FOUND}{a:.2f} s to {b:.2f} s"
        return self._with(window=(a, b), notices=(*self.notices, said))

    def _straight(self) -> "Recording":
        """The recording without the straight line through its window, if it is to be so; with the
        mean that it has there."""
        if not self.detrend:
            return self
        slope = float(np.polyfit(self.time, self.samples, 1)[0])
        every = self.start + np.arange(self.whole.size) / self.rate
        level = self.whole - slope * (every - np.mean(self.time))
        said = (
            f"the straight line through {self.window_in_words} was subtracted and the mean kept:"
            f" {slope:.3g} {self.unit} in 1 s, {slope * self.duration:.3g} {self.unit} in all"
        )
        return self._with(samples=level, notices=(*self.notices, said), detrend=False)

    def segments(self, settings: SpectrumSettings | str | None = None) -> int:
        """Number of whole Welch segments in the window."""
        settings = recorded_settings(settings)
        first, stop = self.span(settings.rate)
        return settings.segments(stop - first)

    def filtered(
        self, settings: SpectrumSettings | str | None = None
    ) -> Float[np.ndarray, " times"]:
        """What the spectra are made of [`unit`]: resampled to `settings.rate`, low-passed as a
        whole, cut to the window."""
        settings = recorded_settings(settings)
        even = self.resampled(settings.rate)
        with jax.enable_x64(True):
            signal = np.asarray(lowpass(even.whole, settings))
        return signal[slice(*even.span(settings.rate))]

    def spectrum(self, settings: SpectrumSettings | str | None = None) -> Spectrum:
        """Welch spectrum of the window, in float64: resampled and low-passed before it is cut.

        **Arguments:** `settings`, by default the standard ones filtered both ways; or a name
        (`SpectrumSettings.named`).

        **Raises:** `ValueError` if the window is constant or below one segment, or bins lie above
        half the recorded rate.
        """
        settings = recorded_settings(settings)
        highest = float(settings.frequency[-1])
        remedy = (
            f"half of it lies below the last bin, {highest:g} Hz, of a spectrum. `jaxmuscle"
            " steadiness` takes this recording; for its spectrum record faster, or choose a lower"
            " last_bin in the settings"
        )
        require(highest < self.rate / 2, "rate", self.rate, remedy)
        self._require_change()
        even = self.resampled(settings.rate)
        first, stop = even.span(settings.rate)
        window = (first / settings.rate, stop / settings.rate)
        with jax.enable_x64(True):
            power = np.asarray(spectrum_of(even.whole, settings, window).power)
        return Spectrum(settings.frequency, power, settings, self.unit)

    def fft_spectrum(self, settings: SpectrumSettings | str | None = None) -> Spectrum:
        """The same with the whole window as one segment (periodogram), in the frequency range of
        the settings."""
        settings = recorded_settings(settings)
        first, stop = self.span(settings.rate)
        low, high = (float(settings.frequency[i]) * (stop - first) / settings.rate for i in (0, -1))
        require(
            stop - first >= 8 and high >= 1,
            "window",
            self.window,
            "is too short for a spectrum; give a longer one",
        )
        bins = {"first_bin": math.ceil(low - 1e-9), "last_bin": math.floor(high + 1e-9)}
        return self.spectrum(settings.replace(length=stop - first, **bins))

    def _require_change(self) -> None:
        if np.ptp(self.samples) <= 1e-12 * np.max(np.abs(self.samples)):
            raise ValueError(
                f"{self.name}: is constant in the window {self.window}; choose another window or"
                " column"
            )

    def summary(self, settings: SpectrumSettings | str | None = None) -> RecordingSummary:
        """Level, variability, regularity and spectral peaks of the window, after resampling and
        low-pass.

        **Returns:** a `RecordingSummary`; it prints as a table.
        """
        settings = recorded_settings(settings)
        self._require_change()
        x = self.filtered(settings)
        mean, deviation = float(np.mean(x)), float(np.std(x))
        approximate, sample = regularity(x)
        varies = deviation / abs(mean) if mean else math.inf
        # what is near zero says so itself
        floats = self.quantity in FLOATING and varies < 10
        return RecordingSummary(
            unit=self.unit,
            duration=x.size / settings.rate,
            segments=self.segments(settings),
            mean=mean,
            standard_deviation=deviation,
            coefficient_of_variation=math.nan if floats else varies,
            signal_to_noise=math.nan if floats else mean / deviation,
            approximate_entropy=approximate,
            sample_entropy=sample,
            peaks=peaks(self.spectrum(settings)),
        )

    def target(
        self,
        name: str | None = None,
        *,
        quantity: str | None = None,
        provenance: str = "measured",
        mvc: float | int | None = None,
        settings: SpectrumSettings | str | None = None,
    ) -> Target:
        """The window's proportional power as a `Target` for `jaxmuscle.fit`.

        It states the Welch segments, the settings, and for a force or torque the mean and the
        coefficient of variation of what the low-pass lets through, which fixes the scale of the
        noise; and says so if most of that is a straight drift. Several recordings of one condition
        give one target: `Trials.target`.

        **Arguments:**

        - `name`: or that of the recording
        - `quantity`: or that of the unit
        - `provenance`
        - `mvc` [`unit`]: the maximal voluntary contraction, for the level (a recording in % MVC
          needs none)
        - `settings`: as for `spectrum`

        **Raises:** `ValueError` if the unit (V, a.u.) does not say what was measured, and as
        `spectrum` does.
        """
        settings = recorded_settings(settings)
        return pooled_target(
            (self,), self.name if name is None else name, quantity, provenance, mvc, settings
        )

    @property
    def window_in_words(self) -> str:
        """The window, or that there is none."""
        return (
            "all of it"
            if self.window is None
            else f"window {self.window[0]:g} s to {self.window[1]:g} s"
        )

    def plot(self, settings: SpectrumSettings | str | None = None, ax: Any = None) -> Any:
        """Draw the trace with its window, and the spectra (Welch, FFT); returns the figure."""
        return plot.recording(self, settings, ax)

    def _card(self) -> Card:
        what = "recording" if self.quantity is None else self.quantity
        known = [
            ("source", self.source),
            ("time", f"{self.start:g} s to {self.stop:g} s; {self.window_in_words}"),
            ("range", f"{np.min(self.samples):.4g} to {np.max(self.samples):.4g} {self.unit}"),
            *(("notice", notice) for notice in self.notices),
        ]
        return facts(
            f"{self.name}: {what} [{self.unit}], {self.whole.size} samples at {self.rate:g} Hz",
            known,
        )


def recorded_settings(settings: SpectrumSettings | str | None) -> SpectrumSettings:
    """As given, or those of a name, by default the standard; named ones filter and sample as
    recordings are."""
    if isinstance(settings, SpectrumSettings):
        return settings
    return SpectrumSettings.named(settings or "standard").replace(**AS_RECORDED)


def _rate(rate: Any) -> float:
    """The rate as a number. **Raises:** `ValueError` for one that is none, or too low."""
    require(is_real(rate) and rate > 0, "rate", rate, "give samples per second [Hz], above 0")
    remedy = (
        f"too slow: half of it lies below what is to be seen of a force; record at {LOWEST_RATE:g}"
        " Hz or more"
    )
    require(rate >= LOWEST_RATE, "rate", rate, remedy)
    return float(rate)


def pooled_target(
    recordings: Sequence[Recording],
    name: str,
    quantity: str | None,
    provenance: str,
    mvc: float | int | None,
    settings: SpectrumSettings,
) -> Target:
    """The target of one or more recordings of the same unit, see `Trials.target`."""
    unit = recordings[0].unit
    quantity = recordings[0].quantity if quantity is None else quantity
    if quantity is None:
        raise ValueError(
            f"`quantity`: the unit {unit} does not say what was measured. If it is a force, give"
            " `quantity`, as quantity=force; an EMG cannot be fitted. Is it the right column?"
        )
    if quantity not in get_args(Quantity):
        article = "an" if quantity[0] in "aeiou" else "a"
        raise ValueError(
            f"`quantity`: {article} {quantity} cannot be fitted, no task of the model has one as"
            " its output. `jaxmuscle steadiness` and `jaxmuscle analyse` take it"
        )
    rows = np.stack([np.asarray(recording.spectrum(settings).power) for recording in recordings])
    segments = [recording.segments(settings) for recording in recordings]
    signals = [recording.filtered(settings) for recording in recordings]
    held = signals if settings == RECORDED else [r.filtered(RECORDED) for r in recordings]
    means = [abs(float(np.mean(x))) for x in signals]
    # a mean of 0 has a variation beyond any bound, and no warning
    variations = [float(np.std(x)) / max(m, 1e-300) for x, m in zip(signals, means, strict=True)]
    mean = abs(float(np.mean([np.mean(x) for x in signals])))
    full = 100.0 if mvc is None and unit == "% MVC" else mvc
    remedy = f"give a force above the mean, {mean:.4g}"
    require(full is None or 0 < mean <= full < math.inf, "mvc", mvc, remedy)
    varying = quantity in ("force", "torque") and max(variations) <= 1
    power = np.average(rows, axis=0, weights=segments)
    each = "; ".join(dict.fromkeys(f"{r.source}, {r.window_in_words}" for r in recordings))
    return Target(
        name,
        power / np.sum(power),
        quantity=str(quantity),
        provenance=provenance,
        source=each if len(rows) == 1 else f"{len(rows)} trials: {each}",
        segments=segments,
        coefficient_of_variation=variations if varying else None,
        mvc_fraction=None if full is None else mean / full,
        mean=means if varying else None,
        unit=unit,
        recorded_at=_rate_of_all(recordings, segments),
        trial_power=rows if len(rows) > 1 else None,
        settings=settings,
        measured=measure_signals(held, unit, quantity)[1],
        signals=held,
        notices=notices_of(recordings, signals, settings.rate, quantity, drift=varying),
    )


def _rate_of_all(recordings: Sequence[Recording], segments: Sequence[int]) -> float:
    """The rate [Hz] whose aliases, in proportion to its inverse square, are the mean of theirs."""
    rates = np.array([recording.recorded_at for recording in recordings])
    first = rates[0]
    return float(first / np.sqrt(np.average((first / rates) ** 2, weights=segments)))


def notices_of(
    recordings: Sequence[Recording],
    signals: Sequence[np.ndarray],
    rate: float,
    quantity: str | None,
    *,
    drift: bool = False,
) -> tuple[str, ...]:
    """What to mind of recordings of one condition, whose windows hold these low-passed signals;
    with `drift` also where most of one is a straight line."""
    unit, held = recordings[0].unit, quantity in ("force", "torque")
    bursts = find_bursts(signals, rate) if held else []
    each = [list(recording.notices) for recording in recordings]
    for i, (own, signal) in enumerate(zip(each, signals, strict=True)):
        # outliers that are kept make a burst, and are named already
        named = any(notice.endswith(OUTLIERS["keep"]) for notice in own)
        mine = [burst for burst in bursts if burst.signal == i and not named]
        events = _events(recordings[i], mine)
        # a slip of a second looks like another level
        own += events or (_ramped(signal, rate, unit) if held else ())
        own += _drift(signal) if drift else ()
    names = [recording.name for recording in recordings]
    said = _with_names(each, names)
    if held:
        return (*said, *unlike(names, signals, unit))
    unclear = (
        f"the unit {unit} does not say what was measured: is it the right column? A coefficient of"
        " variation makes sense only of a signal that is zero without force, and in proportion"
        " to it"
    )
    return (*said, unclear) if quantity is None else said


def _events(recording: Recording, bursts: Sequence[Burst]) -> tuple[str, ...]:
    """What to say of a cough or a slip in a window."""
    begin = recording.start if recording.window is None else recording.window[0]
    return tuple(
        f"{BURST} from {begin + b.start:.1f} to {begin + b.stop:.1f} s, {b.times:.2g} times as much"
        " as usual (a cough, a slip?). Give a window without it, or leave this trial out"
        for b in bursts
    )


def _ramped(x: Float[np.ndarray, " times"], rate: float, unit: str) -> tuple[str, ...]:
    """What to say where a window holds more than one level: a ramp is in it, or rest."""
    if plateau(x, rate) == (0, x.size):
        return ()
    level = running_median(x, rate)
    return (
        (
            f"the level goes from {level.min():.3g} to {level.max():.3g} {unit} within this window:"
            " it holds more than the steady part, and a ramp counts as unsteadiness. Give a window"
            " of one level; without --window (in Python steady()) it is looked for"
        ),
    )


def _with_names(each: Sequence[Sequence[str]], names: Sequence[str]) -> tuple[str, ...]:
    """The notices of every trial, each once, with the names of the trials unless all say so; the
    steady parts in one."""
    said = [(notice, name) for own, name in zip(each, names, strict=True) for notice in own]
    windows = [
        f"{notice.removeprefix(FOUND)} in {name}"
        for notice, name in said
        if notice.startswith(FOUND)
    ]
    together = FOUND + ", ".join(windows)
    whose: dict[str, list[str]] = {}
    for notice, name in said:
        joined = len(windows) > 1 and notice.startswith(FOUND)
        whose.setdefault(together if joined else notice, []).append(name)
    return tuple(
        notice
        if notice == together or len(trials) == len(names)
        else f"{', '.join(trials)}: {notice}"
        for notice, trials in whose.items()
    )


def unlike(names: Sequence[str], signals: Sequence[np.ndarray], unit: str) -> tuple[str, ...]:
    """What to say of trials that are the same, or whose means differ by more than a tenth."""
    said = [
        f"{one} and {other} hold the same numbers: give each trial once, or the errors come"
        " out too small"
        for (one, x), (other, y) in itertools.combinations(zip(names, signals, strict=True), 2)
        if np.array_equal(x, y)
    ]
    means = {abs(float(np.mean(x))): name for x, name in zip(signals, names, strict=True)}
    low, high = min(means), max(means)
    if high > UNLIKE * low:
        far = high - low > APART * max(float(np.std(x)) for x in signals)
        said.append(
            f"the means of the trials reach from {low:.4g} {unit} ({means[low]}) to"
            f" {high:.4g} {unit} ({means[high]}): are they of one condition, and did the"
            f" person tire?{SEVERAL * far}"
        )
    return tuple(said)


def _drift(x: Float[np.ndarray, " times"]) -> tuple[str, ...]:
    """What to say where a straight line makes more than half of the variance; the model has
    none."""
    before, after = np.std(x), np.std(scipy.signal.detrend(x))
    if after**2 > DRIFT * before**2:
        return ()
    mean = abs(float(np.mean(x)))
    return (
        (
            f"a straight drift makes {100 * (1 - (after / before) ** 2):.0f} % of the variance. The"
            f" coefficient of variation is {before / mean:.3g} with the drift, {after / mean:.3g}"
            " without. The model has no drift: --detrend (Python: detrend=True) subtracts it;"
            " or choose a steadier window"
        ),
    )
