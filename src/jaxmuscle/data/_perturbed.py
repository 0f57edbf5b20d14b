"""Recordings of two channels: the insertion is moved, the force that answers is read; the target
that they give: fluctuations of the force beside its response, and the dynamic stiffness.

See docs/perturbed.md for the mathematics.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Unpack

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Bool, Complex, Float

from jaxmuscle import plot
from jaxmuscle._common.arguments import check_options, is_real, require
from jaxmuscle._common.cards import Card, Shown, facts
from jaxmuscle._common.names import name_of_all
from jaxmuscle._common.units import LEVER_ARM
from jaxmuscle.spectra._cross_spectrum import LEAST_INPUT, Response, response_of
from jaxmuscle.spectra._settings import SpectrumSettings

from ._frequency_response import JOINT, FrequencyResponse
from ._measure import Measure, normal_interval
from ._recording import FOUND, Recording, pooled_target, recorded_settings
from ._recording_choice import About
from ._recording_quality import Baseline, running_median, runs, signal_of
from ._second_order import UNITS, SecondOrder, lateness, lengthens, second_order_fit
from ._target import Target
from ._units import quantity_of, scale_to_si

SIGN_FOUND = 4.0  # standard errors from which on the sign of the displacement is found
# Of the displacement, and of the angle of a joint: unit in texts, how many of it.
SHOWN = {False: ("mm", 1e3), True: ("deg", float(np.degrees(1.0)))}
MOVED = {"mm": (0.005, 100.0), "deg": (0.02, 30.0)}  # rms: what motors move
# of the response: Hz, by default and at most; times the rate of the recording
HIGHEST, MOST, BELOW = 30.0, 45.0, 0.4
TURNED = (
    "the mean {0} is negative: its sign is turned, since the pull of a muscle counts as positive."
    " Then the sign of the displacement is found"
)
NEGATIVE = (
    "the mean force is negative: count the muscle's pull as positive, or the stiffness has the"
    " wrong sign"
)
CUT = 0.1  # s
# Where the insertion moves: at how many Hz that is looked at; from which share of the usual
# standard deviation on. For which share of the time a force without a level pulls either way.
WATCHED, STILL_SHARE, BOTH = 100.0, 0.3, 0.1
SHORTER = (
    "of the window from {:.4g} to {:.4g} s the fit uses {:.4g} to {:.4g} s: it needs {:g} s of the"
    " recording before and after what it uses. If you can, record that much longer"
)
MARGIN = 2.0  # s before and after the window, where the muscle forgets what is not known
TAPER = 0.1  # share of the window that is tapered
LOWEST, LEAST_PERIODS = 0.05, 2.5  # Hz; periods of the lowest frequency in the window
# of a group of frequencies: relative to it; at least, at most [Hz]
WIDTH, NARROWEST, WIDEST = 0.12, 0.05, 0.4
EXCITED = 1e-6  # of the largest density of the displacement: below is the sensor's noise
# over which range the density of the fluctuations is averaged: relative; at least [Hz]
AROUND, FEWEST = 0.25, 0.1
NODES = 600
HALF_STEPS = 10  # of the nonlinear muscle in a sampling interval
LINEAR = (
    "the response to the movement was taken off as a linear one, since that of the nonlinear muscle"
    " could not be computed. If the motion was large, a part of it is left in the fluctuations"
)
# Of the share of the nonlinear response that is there: standard errors from 1 from which on it is
# that which is seen, standard errors from 0 within which none is seen. A notice comes from so many
# standard errors and such a difference from 1 on; of a reflex, so many standard errors from 0.
FROM_ALL, FROM_NONE, SURELY, DIFFERENT = 2.5, 2.0, 4.0, 0.2
ONE_WAY = (
    "the reflex answers lengthening more than shortening: {:.0f} ± {:.0f} %, where 0 % is both"
    " alike and 100 % is lengthening alone. Its answer was taken off the force accordingly (at 100"
    " % {:.2g} N rms more than that of a linear reflex)"
)
UNLIKE = (
    "the force answers the movement {} nonlinearly than the muscle of the model. The nonlinear part"
    " of the model's answer is {:.2g} N rms; the recording shows {:.0f} ± {:.0f} % of it. The fit"
    " subtracted {} from the force. What to do: do not report K_w0, which rests on the model's"
    " nonlinearity. Report tangent_stiffness, and K_w_tangent if it is determined. Compare them"
    " with a fit of the response alone (jaxmuscle fit stiffness.csv)"
)

Times = Float[np.ndarray, " times"]
Kept = Float[np.ndarray, " kept"]
Frequencies = Float[np.ndarray, " frequencies"]
Ordinates = Complex[np.ndarray, " frequencies"]
Stiffness = Callable[[Frequencies], Ordinates]
Motion = Float[np.ndarray, "3 steps"]


class _Options(About, total=False):
    """Those of `Recording` that two channels have, too."""

    baseline: Baseline
    detrend: bool
    band: Sequence[float] | None


class PerturbedRecording(Shown, eqx.Module):
    """A recording of two channels: the force of a muscle while its insertion is moved a little.

    The displacement counts *lengthening* as positive. The dynamic stiffness H(f) = force /
    lengthening then has a positive real part at low frequency. In the model's coordinates the
    lengthening is -x_z.

    A joint has a torque in N m and an angle in rad instead, and all that is made of it is in N m
    and rad: H in N m/rad.

    **Arguments:**

    - `force`: a `Recording` in N (or N m), positive where the muscle pulls.
    - `displacement`: a `Recording` in m (or rad), of the same rate, start, window and number of
      samples.
    - `lever_arm` [m]: with which force and displacement were made of a torque and an angle.
    - `band` (low, high) [Hz] of the response; by default as far as the motion excites, at most to
      30 Hz.
    - `name`, `source`: by default those of the force.
    - `notices`: what was done to the channels, in sentences; those of both channels are added.
    - `others`: recordings before and after a pause, as in `Recording`.

    `jaxmuscle.load_recording(path, force=..., displacement=...)` reads one from a file, and
    converts units and sign.

    **Raises:** `ValueError` naming the argument, its value and the remedy.
    """

    force: Recording
    displacement: Recording
    lever_arm: float | None = eqx.field(static=True)
    band: tuple[float, float] | None = eqx.field(static=True)
    name: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    notices: tuple[str, ...] = eqx.field(static=True)
    others: tuple["PerturbedRecording", ...]

    def __init__(
        self,
        force: Recording,
        displacement: Recording,
        *,
        lever_arm: float | None = None,
        band: tuple[float, float] | None = None,
        name: str | None = None,
        source: str | None = None,
        notices: Iterable[str] = (),
        others: Iterable["PerturbedRecording"] = (),
    ):
        instead = "or use PerturbedRecording.from_array"
        for argument, given in (("force", force), ("displacement", displacement)):
            require(isinstance(given, Recording), argument, given, f"give a Recording, {instead}")
        units = ("N m", "rad") if force.unit == "N m" else ("N", "m")
        for argument, given, unit in zip(
            ("force", "displacement"), (force, displacement), units, strict=True
        ):
            remedy = f"give it in {unit}, {instead}, which converts"
            require(given.unit == unit, f"{argument}.unit", given.unit, remedy)
        for field in ("rate", "start", "window"):
            same, other = getattr(force, field), getattr(displacement, field)
            remedy = f"that of the force is {same}; give both alike"
            require(same == other, f"displacement.{field}", other, remedy)
        _check_length(force.whole.size, displacement.whole.size)
        self.force, self.displacement, self.others = force, displacement, tuple(others)
        self.lever_arm, self.band = lever_arm, band
        self.name = force.name if name is None else name
        self.source = force.source if source is None else source
        moved = [
            f"displacement: {words}" for words in displacement.notices if words not in force.notices
        ]
        self.notices = tuple(dict.fromkeys((*notices, *force.notices, *moved)))

    @classmethod
    def from_array(
        cls,
        force: Any,
        displacement: Any,
        rate: float | int,
        *,
        units: str = "N",
        displacement_units: str = "m",
        lever_arm: float | int | None = None,
        positive: str | None = None,
        delay: float | int = 0.0,
        **options: Unpack[_Options],
    ) -> "PerturbedRecording":
        """A recording from two arrays of one length.

        Torque and angle of a joint stay such, in N m and rad. With a lever arm they become

            force = torque / lever_arm,   displacement = lever_arm · angle

        **Arguments:**

        - `force`, `displacement`, shape `(times,)`, in `units` (N, mN, kN, kgf, gf, lbf; N m, N cm,
          N mm) and `displacement_units` (m, cm, mm, um; deg, rad); `rate` [Hz].
        - `lever_arm` [m]: from the axis to the insertion; needed for a torque without an angle, and
          for an angle without a torque.
        - `positive`: what the displacement counts as positive, `"lengthening"` or `"shortening"`.
          `None`: found from the data. If a spring, a damper and a mass describe the response better
          with the other sign, that of the displacement is turned, and a notice says so. A force
          with a negative mean is turned first, since muscles pull.
        - `delay` [s]: by which the force channel lags behind the displacement channel; the
          displacement is shifted by it.
        - `options`: `name`, `source`, `start`, `window`, `notices`, `others`, as in `Recording`;
          `baseline`, `detrend` too, of the force; `band`, as in `PerturbedRecording`.

        **Raises:** `ValueError` naming the argument, its value and the remedy.
        """
        check_options(cls.from_array, _Options, options)
        band = _checked_band(options.pop("band", None), float(rate))
        known = positive in (None, "lengthening", "shortening")
        require(known, "positive", positive, "choose lengthening or shortening")
        rotates = (quantity_of(units), quantity_of(displacement_units)) == ("torque", "angle")
        joint = rotates and lever_arm is None
        arm = 1.0 if joint else lever_arm
        scale, turned = scale_to_si(units, "units", "force", arm)
        reach, swung = scale_to_si(displacement_units, "displacement_units", "displacement", arm)
        si = ("N m", "rad") if joint else ("N", "m")
        remedy = f"leave it out: {units} and {displacement_units} need none"
        require(lever_arm is None or turned or swung, "lever_arm", lever_arm, remedy)
        pull, moved = signal_of("force", force), signal_of("displacement", displacement)
        _check_length(pull.size, moved.size)
        if np.isfinite(moved).all() and _is_constant(moved):
            raise ValueError(
                f"displacement: constant at {reach * moved[0] + 0.0:g} {si[1]}, so nothing moved"
                " the muscle. Take the force alone, as a hold, or choose another column"
            )
        pull, moved, begin, said = _shifted(scale * pull, reach * moved, float(rate), delay)
        notices, others = options.pop("notices", ()), options.pop("others", ())
        options["start"] = float(options.get("start", 0.0)) + begin
        words = {key: value for key, value in options.items() if key in About.__optional_keys__}
        pulled = _recording("force", pull, rate, {**options, "unit": si[0]})
        given = _recording("displacement", moved, rate, words | {"unit": si[1]})
        more = []
        if np.mean(pulled.whole) < 0 and positive is None:
            pulled = pulled._with(samples=-pulled.whole)
            more.append(TURNED.format(pulled.quantity))
        elif np.mean(pulled.whole) < 0:
            more.append(NEGATIVE)
        turn, found = _sign(pulled, given, positive)
        more += found
        (shown, many), small = SHOWN[joint], si[1]
        size, (least, most) = many * float(np.std(given.whole)), MOVED[shown]
        if not least < size < most:
            odd, other = ("much", shown) if size > most else ("little", small)
            more.append(
                f"the {given.quantity} is {size:.3g} {shown} rms, which is {odd} for a motor. If"
                f" its column is in {other}, give --displacement-units {other} (Python:"
                " displacement_units=)"
            )
        lengthening = _recording("displacement", turn * moved, rate, words | {"unit": si[1]})
        arm = float(lever_arm) if rotates and lever_arm is not None else None
        said = (*notices, *said, *more)
        return cls(pulled, lengthening, lever_arm=arm, band=band, notices=said, others=others)

    @property
    def rate(self) -> float:
        """Samples per second [Hz]."""
        return self.force.rate

    @property
    def window(self) -> tuple[float, float] | None:
        """(start, stop) [s] of the part that is analysed, or `None` for all of it."""
        return self.force.window

    @property
    def of_joint(self) -> bool:
        """Whether it is in N m and rad."""
        return self.force.unit == "N m"

    @property
    def stiffness_unit(self) -> str:
        """Of its response: N/m, or N m/rad of a joint."""
        return JOINT if self.of_joint else "N/m"

    def at_lever_arm(self, arm: float) -> "PerturbedRecording":
        """The torque and the angle of a joint as force and displacement at a distance [m] from its
        axis."""
        require(self.of_joint, "force.unit", self.force.unit, "only a torque has a lever arm")
        require(is_real(arm) and arm > 0, "arm", arm, "give a distance above 0 m")
        force = self.force._with(samples=self.force.whole / arm, unit="N", quantity=None)
        whole = self.displacement.whole * arm
        moved = self.displacement._with(samples=whole, unit="m", quantity=None)
        return self._of(force, moved, lever_arm=float(arm))

    def _of(self, force: Recording, moved: Recording, **changed: Any) -> "PerturbedRecording":
        """With other channels."""
        names = ("lever_arm", "band", "name", "source", "notices")
        same = {name: getattr(self, name) for name in names}
        return PerturbedRecording(force, moved, **same | changed)

    def steady(self, window: Sequence[float | int] | str | None = None) -> "PerturbedRecording":
        """The recording with the part as window in which the mean force is held: given, or found as
        by `Recording.steady`.

        Where a weak force answers with more than a tenth of itself, so that none is found, it is
        looked for in what is left of the force without the answer of a spring, a damper and a mass.
        If that shows none either, as where a reflex answers, the longest stretch is taken in which
        the insertion moves (its standard deviation over 2 s is above 0.3 of the usual one) and the
        rest of the force, the median over 1 s, is within half of its level; with any force if that
        pulls either way for a tenth of the time. It has to be half of the time with motion. Both
        channels are cut alike.

        **Raises:** `ValueError` as `Recording.steady`.
        """
        for part in self.others if window is not None else ():
            if part.force.holds(window):
                return part.steady(window)
        force = self.force
        try:
            steady = force.steady(window)
        except ValueError:
            if window is not None:
                raise
            rest = self._without_answer()
            try:
                found = rest.steady()
            except ValueError:
                found = self._while_moved(rest)
                if found is None:
                    raise
            steady = force._with(window=found.window, notices=found.notices)._straight()
        moved = self.displacement.steady("all" if steady.window is None else steady.window)
        return self._of(steady, moved)

    def _without_answer(self) -> Recording:
        """The force less `K x + B x' + I x''` of the displacement, by least squares over all of the
        recording."""
        x = self.displacement.whole - np.mean(self.displacement.whole)
        speed = np.gradient(x, 1 / self.rate)
        columns = np.stack([np.ones_like(x), x, speed, np.gradient(speed, 1 / self.rate)], axis=1)
        columns /= np.linalg.norm(columns, axis=0)
        sizes = np.linalg.lstsq(columns, self.force.whole, rcond=None)[0]
        return self.force._with(samples=self.force.whole - columns[:, 1:] @ sizes[1:], window=None)

    def _while_moved(self, rest: Recording) -> Recording | None:
        """What is left of the force, with the part as window in which the insertion moves and it
        has one level."""
        rate = WATCHED
        moved, left = self.displacement.resampled(rate).whole, rest.resampled(rate).whole
        size = round(2 * rate)
        mean, square = (scipy.ndimage.uniform_filter1d(moved**n, size) for n in (1, 2))
        scatter = np.sqrt(np.maximum(square - mean**2, 0.0))
        moves = scatter > STILL_SHARE * np.quantile(scatter, 0.75)
        held, level = running_median(left, rate), float(np.median(left[moves]))
        if not BOTH < np.mean(held[moves] > 0) < 1 - BOTH:
            inside = moves & (np.abs(held - level) < abs(level) / 2)
            said = "and the force stays within half of its level"
        else:
            inside, said = moves, "the force having no level of its own"
        longest = max(runs(inside).tolist(), key=lambda run: run[1] - run[0], default=[0, 0])
        if longest[1] - longest[0] < 0.5 * np.sum(moves):
            return None
        # a second is left for the ramps
        start, stop = (
            longest[0] + round(rate) * (longest[0] > 0),
            longest[1] - round(rate) * (longest[1] < moved.size),
        )
        a, b = (min(rest.start + edge / rate, rest.stop) for edge in (start, stop))
        if (b - a) * rate < size:
            return None
        words = f"{FOUND}{a:.2f} s to {b:.2f} s, where the insertion moves, {said}"
        return rest._with(window=(a, b), notices=(*rest.notices, words))

    def frequency_response(
        self, settings: SpectrumSettings | str | None = None
    ) -> FrequencyResponse:
        """The dynamic stiffness H(f) by Welch's segments: what of the force follows the
        displacement.

            H_k = Σ X* F / Σ |X|²,   γ²_k = |Σ X* F|² / (Σ |X|² Σ |F|²)

        summed over the segments of the window. Both channels are resampled and filtered alike, so
        the filters cancel. Bins in which the displacement has less than 1e-4 of its largest density
        are left out. The standard errors are those that the rest of the force (what does not follow
        the displacement) leaves, given the displacement as it was. The overlap of segments is in
        them. Neighbouring bins share errors (with the Hann window about 0.45).

        The bins are those of the `band`; those of `SpectrumSettings`, if such are given.

        **Arguments:** `settings`, as for `Recording.spectrum`, or a name.

        **Raises:** `ValueError` if the window has fewer than three segments, or bins lie above half
        the recorded rate.
        """
        return self._as_frequency_response(self._response(settings))

    def _as_frequency_response(self, found: Response) -> FrequencyResponse:
        return FrequencyResponse(
            found.frequency,
            found.value,
            found.stderr,
            found.coherence,
            name=self.name,
            source=f"{self.source}, {self.force.window_in_words}",
            notices=self.notices,
            unit=self.stiffness_unit,
            lever_arm=self.lever_arm,
        )

    def _response(self, settings: SpectrumSettings | str | None) -> Response:
        if not isinstance(settings, SpectrumSettings):
            settings = self._to_band(recorded_settings(settings))
        return _response(self.force, self.displacement, settings)

    def _to_band(self, settings: SpectrumSettings) -> SpectrumSettings:
        """The settings with the bins of the band; without low-pass, which cancels."""
        low, high = self.band or (0.0, max(self.highest, float(settings.frequency[-1])))
        bins = {
            "first_bin": max(settings.first_bin, math.ceil(low / settings.resolution - 1e-9)),
            "last_bin": math.floor(high / settings.resolution + 1e-9),
        }
        return settings.replace(filter_cutoff=None, **bins)

    @property
    def highest(self) -> float:
        """Up to where the response is estimated [Hz]."""
        return min(HIGHEST, BELOW * self.rate) if self.band is None else self.band[1]

    def second_order(self, settings: SpectrumSettings | str | None = None) -> dict[str, Measure]:
        """The classical description of the response by a spring, a damper and a mass.

            H(f) = K + iωB - ω²I,   ω = 2πf

        Least squares, weighted with the errors of the response. If the response has another shape,
        the errors are multiplied by √(chi² / its expectation): the muscle is more than a spring, a
        damper and a mass.

        **Returns:** `{"K": ..., "B": ..., "I": ...}` [N/m, N s/m, kg; of a joint N m/rad,
        N m s/rad, kg m²], each a `Measure` with `interval`.

        **Source:** Kearney & Hunter 1990, Crit Rev Biomed Eng 18(1):55-87.
        """
        value, stderr, *_ = self._second_order(settings)
        rows = zip(value.tolist(), stderr.tolist(), UNITS[self.stiffness_unit], strict=True)
        measures = (
            Measure(number, error, unit, "spectrum", normal_interval(number, error))
            for number, error, unit in rows
        )
        return dict(zip("KBI", measures, strict=True))

    def second_order_of_joint(
        self, settings: SpectrumSettings | str | None = None
    ) -> dict[str, Measure]:
        """The same about the axis, in N m/rad, N m s/rad and kg m², where torque and angle were
        converted with a lever arm; else nothing."""
        if self.lever_arm is None:
            return {}
        square = self.lever_arm**2
        units = zip(self.second_order(settings).items(), UNITS[JOINT], strict=True)
        return {name: one.times(square, unit) for (name, one), unit in units}

    def second_order_misfit(
        self, settings: SpectrumSettings | str | None = None
    ) -> tuple[float, float]:
        """How many times as large as expected chi² of `second_order` is, and how probable one so
        large is: about 1 where that is the shape of the response."""
        found = self._second_order(settings)
        return found.chi2, found.p

    def _second_order(self, settings: Any, *, delayed: bool = False) -> SecondOrder:
        return second_order_fit(self._response(settings), delayed)

    def delay(self, settings: SpectrumSettings | str | None = None) -> tuple[float, float]:
        """How long the force channel lags behind the displacement channel [s], and the standard
        error: an estimate.

            H(f) = (K + iωB - ω²I) e^{-iωτ}

        is fitted to the response. The phase alone does not tell a delay from the muscle's own
        phase. So τ is the delay beyond that of a spring, a damper and a mass, which have the least
        phase that their gain allows. It is the delay of the channels (a filter in one of them, a
        converter that reads them in turn) only if the muscle is near to that shape in the band. A
        muscle of two parts in series is not quite: compare τ with its error, and with what the
        devices state. `load_recording(..., delay=)` takes a known delay out.

        **Returns:** τ and its standard error; positive if the force comes later.
        """
        found = self._second_order(settings, delayed=True)
        return float(found.value[3]), float(found.stderr[3])

    def late(self, settings: SpectrumSettings | str | None = None) -> list[str]:
        """Notices if the force is surely later or earlier than a spring, a damper and a mass
        explain, and if the imaginary part of the response is surely negative, as of nothing that is
        passive."""
        try:
            response = self._response(settings)
        except ValueError:
            # too short or too slow for a response, which says so itself where one is asked for
            return []
        return [*lateness(response), *self._as_frequency_response(response).activity]

    def target(
        self,
        name: str | None = None,
        *,
        stiffness: Stiffness | None = None,
        provenance: str = "measured",
        settings: SpectrumSettings | str | None = None,
    ) -> Target:
        """A `Target` of both: the dynamic stiffness, and the spectrum of the force that does not
        follow the displacement.

        `jaxmuscle.fit(task, recording)` makes it with the response of the muscle that it fits. By
        default the response is the nonparametric one (`frequency_response`), which takes some of
        the fluctuations with it.

        **Arguments:** `stiffness`, the dynamic stiffness H [N/m] as a function of frequencies [Hz]:
        with a muscle's own, `lambda f: jaxmuscle.response.dynamic_stiffness(task, f)`; others as in
        `Recording.target`.

        **Raises:** `ValueError` if the window, without the first and the last 2 s of the recording,
        is shorter than 8 s.
        """
        answer = None if stiffness is None else Answer(stiffness)
        return perturbed_target((self,), answer, name, settings=settings, provenance=provenance)

    def plot(self, settings: SpectrumSettings | str | None = None, ax: Any = None) -> Any:
        """Draw both channels with the window, and gain, phase and coherence with their errors;
        returns the figure."""
        return plot.perturbed(self, settings, ax)

    def _card(self) -> Card:
        force, pull, moved = self.force, self.force.samples, self.displacement.samples
        unit, (shown, many) = force.unit, SHOWN[self.of_joint]
        size, largest = many * np.std(moved), many * np.max(np.abs(moved - np.mean(moved)))
        scatter = f"standard deviation {np.std(pull):.3g} {unit}"
        known = [
            ("source", self.source),
            ("time", f"{force.start:g} s to {force.stop:g} s; {force.window_in_words}"),
            (str(force.quantity), f"mean {np.mean(pull):.4g} {unit}, {scatter}"),
            ("moved", f"{size:.3g} {shown} rms, at most {largest:.3g} {shown}"),
            *(("notice", notice) for notice in self.notices),
        ]
        count = f"{force.whole.size} samples at {self.rate:g} Hz"
        what = f"{force.quantity} [{unit}] and lengthening [{self.displacement.unit}]"
        return facts(f"{self.name}: {what}, {count}", known)


def _check_length(force: int, moved: int) -> None:
    remedy = f"the force has {force}; give one length"
    require(force == moved, "displacement", f"{moved} samples", remedy)


def _is_constant(x: Times) -> bool:
    return bool(np.ptp(x) <= 1e-12 * np.max(np.abs(x), initial=0.0))


def _recording(kind: str, samples: Times, rate: float | int, words: dict[str, Any]) -> Recording:
    try:
        return Recording(samples, rate, **words)
    except ValueError as error:
        raise ValueError(f"{kind}: {error}") from None


def _shifted(
    force: Times, moved: Times, rate: float, delay: Any
) -> tuple[Kept, Kept, float, list[str]]:
    """Both channels with the displacement later by `delay` [s] (a spline of order 5), the time of
    the first, a notice."""
    short = is_real(delay) and abs(delay) < force.size / 2 / rate
    require(short, "delay", delay, "give a time in s, shorter than half of the recording")
    if not delay:
        return force, moved, 0.0, []
    at = np.arange(force.size) - float(delay) * rate
    inside = (at >= 0) & (at <= force.size - 1)
    shifted = scipy.interpolate.make_interp_spline(np.arange(force.size), moved, k=5)(at[inside])
    words = f"the force lags by {1e3 * delay:g} ms as stated: the displacement is shifted by that"
    return force[inside], shifted, float(np.argmax(inside)) / rate, [words]


def _response(force: Recording, displacement: Recording, settings: SpectrumSettings) -> Response:
    highest = float(settings.frequency[-1])
    remedy = f"half of it lies below the last bin, {highest:g} Hz; choose a lower last_bin"
    require(highest < force.rate / 2, "rate", force.rate, remedy)
    given = displacement.filtered(settings)
    if _is_constant(given):
        raise ValueError(
            f"{displacement.name}: the displacement is constant in the window; choose another"
            " window"
        )
    return response_of(given, force.filtered(settings), settings)


def _sign(
    force: Recording, displacement: Recording, positive: str | None
) -> tuple[float, list[str]]:
    """1 or -1, so that the displacement counts lengthening as positive, and a notice: as a passive
    body would move."""
    if positive is not None:
        return {"lengthening": 1.0, "shortening": -1.0}[positive], []
    try:
        found = lengthens(_response(force, displacement, SpectrumSettings(filter_cutoff=None)))
    except ValueError as error:
        return 1.0, [f"the sign of the displacement is not checked: {error}"]
    if abs(found) < SIGN_FOUND**2:
        return 1.0, [
            "the sign of the displacement is not found, since the force hardly follows it:"
            " lengthening is taken as positive. If you know the sign, give --positive lengthening"
            " or --positive shortening (Python: positive=)"
        ]
    if found < 0:
        return -1.0, ["the displacement counts shortening as positive: its sign is turned"]
    return 1.0, []


class Answer(NamedTuple):
    """How the force answers the lengthening l: linearly, h * l by the `stiffness` H(f) [N/m] of a
    vector of frequencies, and `beside` that.

    `beside`, at the samples [N]: a function of l, its velocity and acceleration [m, m/s, m/s²] at
    `HALF_STEPS` times a sample, so far apart [s], and of h * l [N]; not used where it is not
    finite. `one_way`, whether it is what a reflex to lengthening alone does beside its linear part,
    else it is what a nonlinear muscle does.
    """

    stiffness: Stiffness
    beside: Callable[[Motion, float, Times], Times] | None = None
    one_way: bool = False


class _Moved(NamedTuple):
    """One recording at the rate of the settings: force, lengthening about its mean in the window,
    and what the force does when it follows that: linearly, and by how much differently in the
    nonlinear muscle (nothing where that is unknown).
    """

    force: Times
    length: Times
    reply: Times
    bend: Times
    exact: bool
    inside: slice

    def transform(self, x: Times) -> Ordinates:
        """Of what lies in the window, tapered."""
        here = x[self.inside] - np.mean(x[self.inside])
        return np.fft.rfft(scipy.signal.windows.tukey(len(here), TAPER) * here)

    def frequency(self, rate: float) -> Frequencies:
        """Of the ordinates [Hz]."""
        return np.fft.rfftfreq(self.inside.stop - self.inside.start, 1 / rate)


def perturbed_target(
    recordings: Sequence[PerturbedRecording],
    answer: Answer | None = None,
    name: str | None = None,
    *,
    settings: SpectrumSettings | str | None = None,
    provenance: str = "measured",
) -> Target:
    """Force fluctuations beside the response to the perturbation, and the dynamic stiffness, of
    trials of one condition.

    With the lengthening l, its response `h * l` by the `stiffness` H and the transform X_j = Σ_m
    w_m x_m e^(-2πi f_j m Δ) of a whole window (w a cosine taper over its first and last 5 %), the
    rest e = F - h * l - β q gives

        Ĥ_g = H(f_g) + Σ_j w_j L_j* E_j / Σ_j w_j |L_j|²
        sd² = 1 / (2 Σ_j w_j |L_j|²)   (of each part)

    over the ordinates j of a group g, about 0.12 f wide, with w_j = 1 / S_E(f_j) and f_g their mean
    frequency, so weighted; real and imaginary part of Ĥ have the same sd. The response is computed
    through the whole recording, so neither window nor leakage of the input biases Ĥ; where H is the
    muscle's own, e is its fluctuation alone. Its spectrum, mean and coefficient of variation are
    the target's. S_E is the measured density of e. q is what the answer has beside h * l, and β
    the share of q that the recordings show (`_share_shown`).

    **Arguments:**

    - `recordings` with their windows
    - `answer`, by default the nonparametric response (`PerturbedRecording.frequency_response`)
    - others as in `Recording.target`
    """
    settings, recordings = recorded_settings(settings), _in_newtons(recordings)
    first = recordings[0]
    for one in recordings[1:]:
        remedy = f"the first has {first.lever_arm}: one fit has one lever arm, and one band"
        same = (one.lever_arm, one.band) == (first.lever_arm, first.band)
        require(same, f"{one.name}: lever_arm", one.lever_arm, remedy)
    each = [
        _nonparametric(recording, settings) if answer is None else answer
        for recording in recordings
    ]
    moved = [
        _moved(recording, own, settings.rate)
        for recording, own in zip(recordings, each, strict=True)
    ]
    share, said = _share_shown(moved, settings, one_way=each[0].one_way)
    pieces = [
        _fluctuation(*pair, share, said, settings.rate)
        for pair in zip(recordings, moved, strict=True)
    ]
    name = name_of_all([recording.name for recording in recordings]) if name is None else name
    target = pooled_target(pieces, name, "force", provenance, None, settings)
    response = _pooled(moved, pieces, each[0].stiffness, _band(recordings), settings.rate)
    words = {"name": name, "source": target.source, "lever_arm": first.lever_arm}
    return target.with_stiffness(FrequencyResponse(*response, **words))


def halves(recordings: Sequence[PerturbedRecording]) -> list[tuple[PerturbedRecording, ...]]:
    """The first and the second half of every window; none where one is too short to be fitted."""
    found = []
    for one in recordings:
        start, stop = one.window or (one.force.start, one.force.stop)
        low, high = max(start, one.force.start + MARGIN), min(stop, one.force.stop - MARGIN)
        middle = 0.5 * (low + high)
        if middle - low <= 4 * MARGIN + 1 / one.rate:
            return []
        found.append([one.steady(pair) for pair in ((low, middle), (middle, high))])
    return list(zip(*found, strict=True))


def explained_power(
    recordings: Sequence[PerturbedRecording],
    answer: Answer,
    band: tuple[float, float],
    shown_by: Sequence[PerturbedRecording] | None = None,
) -> Float[np.ndarray, "2"]:
    """Of the power of the force in a band [Hz] what its answer to the motion explains, Σ |F|² - Σ
    |F - H L - β Q|², over the ordinates in the band and the recordings, and Σ |F|²; β as other
    recordings show it, or these."""
    settings = recorded_settings(None)
    rate, found = settings.rate, np.zeros(2)
    moved = [_moved(one, answer, rate) for one in _in_newtons(recordings)]
    others = [_moved(one, answer, rate) for one in _in_newtons(shown_by or ())]
    share, _ = _share_shown(others or moved, settings, one_way=answer.one_way)
    for one in moved:
        f = one.frequency(rate)
        inside = (band[0] <= f) & (f <= band[1])
        whole, left = (
            float(np.sum(np.abs(one.transform(x)[inside]) ** 2))
            for x in (one.force, one.force - one.reply - share * one.bend)
        )
        found += [whole - left, whole]
    return found


def _in_newtons(recordings: Sequence[PerturbedRecording]) -> list[PerturbedRecording]:
    return [one.at_lever_arm(LEVER_ARM) if one.of_joint else one for one in recordings]


def _nonparametric(recording: PerturbedRecording, settings: SpectrumSettings) -> Answer:
    """The response that was measured, held beyond its ends: that makes no odds, since nothing moves
    there."""
    found = recording._response(recording._to_band(settings))
    return Answer(
        lambda f: (
            np.interp(f, found.frequency, np.real(found.value))
            + 1j * np.interp(f, found.frequency, np.imag(found.value))
        )
    )


def _moved(recording: PerturbedRecording, answer: Answer, rate: float) -> _Moved:
    force, moved = (x.resampled(rate).whole for x in (recording.force, recording.displacement))
    margin, (first, stop) = round(MARGIN * rate), recording.force.span(rate)
    first, stop = max(first, margin), min(stop, force.size - margin)
    remedy = (
        f"holds less than {4 * MARGIN:g} s besides {MARGIN:g} s before and after it; record longer"
    )
    require(stop - first > 4 * margin, "window", recording.window, remedy)
    length = moved - np.mean(moved[first:stop])
    return _Moved(force, length, *_reply(length, answer, rate), slice(first, stop))


def _share_shown(
    moved: list[_Moved], settings: SpectrumSettings, *, one_way: bool
) -> tuple[float, tuple[str, ...]]:
    """Which share β of the response q beside the linear one the recordings show, and what is to be
    said of it.

    With the transforms E of F - h * l and Q of q, both without what in each group of frequencies is
    in proportion to L,

        β = Σ Re(Q* E) / S_E  /  Σ |Q|² / S_E,     sd² = 1 / (2 Σ |Q|² / S_E)

    Of the nonlinear muscle's, 1 of a muscle as the model's, 0 of a linear one. So β = 1 unless the
    recordings contradict that by 2.5 errors: a linear limb would have an H that is wrong by the
    part of q that is in proportion to L, and that is of the size of the rest of q. Of a reflex, 1
    of one to lengthening alone, 0 of a linear one. So β = 0 unless the recordings contradict that
    by four errors. The sums go as far as the spectrum, and as far as the motion.
    """
    shown = weight = 0.0
    for one in moved:
        f = one.frequency(settings.rate)
        signals = (one.length, one.force - one.reply, one.bend)
        length, *others = (one.transform(x) for x in signals)
        density, motion = (_smooth(f, np.abs(x) ** 2) for x in (others[0], length))
        highest = min(float(f[motion >= LEAST_INPUT * motion.max()][-1]), HIGHEST)
        highest = max(highest, float(settings.frequency[-1]))
        grouped = _grouped(f, _groups([f], (0.0, highest)))
        sums = (grouped / density) @ (np.conj(length) * [length, *others]).T
        # a linear response that is somewhat wrong would be taken for a share of the nonlinear one
        slopes = sums[:, 1:] / np.maximum(np.real(sums[:, :1]), 1e-300)
        rest, bend = others - length * (slopes.T @ grouped)
        inverse = grouped.any(axis=0) / density
        shown += float(np.real(np.conj(bend) * rest) @ inverse)
        weight += float(np.abs(bend) ** 2 @ inverse)
    if weight <= 0:
        return 1.0, ()
    share, error = shown / weight, float(1 / np.sqrt(2 * weight))
    size = float(np.std(np.concatenate([one.bend[one.inside] for one in moved])))
    if one_way:
        seen = share > SURELY * error
        return (share, (ONE_WAY.format(100 * share, 100 * error, size),)) if seen else (0.0, ())
    if abs(share - 1) <= FROM_ALL * error:
        return 1.0, ()
    told = abs(share - 1) > max(SURELY * error, DIFFERENT)
    which, taken = "less" if share < 1 else "more", "that share"
    words = UNLIKE.format(which, size, 100 * share, 100 * error, taken)
    if abs(share) <= FROM_NONE * error:
        words, share = UNLIKE.format(which, size, 100 * share, 100 * error, "none of it"), 0.0
    return share, (words,) * told


def _fluctuation(
    recording: PerturbedRecording, moved: _Moved, share: float, said: tuple[str, ...], rate: float
) -> Recording:
    """What is left of the force without its response."""
    start = recording.force.start
    ends, asked = (
        tuple(start + end / rate for end in pair)
        for pair in ((moved.inside.start, moved.inside.stop), recording.force.span(rate))
    )
    cut = max(abs(a - b) for a, b in zip(asked, ends, strict=True)) >= CUT
    notices = (*recording.notices, *recording.late())
    notices += (SHORTER.format(*asked, *ends, MARGIN),) * cut + (LINEAR,) * (not moved.exact) + said
    return recording.force._with(
        samples=moved.force - moved.reply - share * moved.bend,
        rate=rate,
        window=ends,
        notices=notices,
        name=recording.name,
        source=recording.source,
        detrend=False,
    )


def _reply(length: Times, answer: Answer, rate: float) -> tuple[Times, Times, bool]:
    """What the force does when it follows the lengthening linearly, right from the margin on; what
    it does beside that; and whether that is known."""
    edge = round(0.5 * MARGIN * rate)
    ramp = np.sin(0.5 * np.pi * (np.arange(edge) + 0.5) / edge) ** 2
    tapered = length.copy()
    tapered[:edge] *= ramp
    tapered[-edge:] *= ramp[::-1]
    f = np.fft.rfftfreq(len(length), 1 / rate)
    where, density = scipy.signal.welch(tapered, rate, nperseg=min(1024, len(length)))
    excited = np.interp(f, where, density) >= EXCITED * np.max(density)
    moved = np.where(excited, np.fft.rfft(tapered), 0.0)
    # the stiffness costs a solution of the model for each frequency, and is smooth: at nodes that
    # are close together where it bends most, with splines between them
    nodes = np.sinh(np.linspace(0.0, 6.0, NODES)) / np.sinh(6.0) * rate / 2
    smooth = scipy.interpolate.CubicSpline(nodes, answer.stiffness(nodes))(f)
    reply = np.fft.irfft(smooth * moved, len(length))
    if answer.beside is not None:
        fine, turn = HALF_STEPS * len(length), 2j * np.pi * f
        motion = np.stack(
            [HALF_STEPS * np.fft.irfft(turn**order * moved, fine) for order in (0, 1, 2)]
        )
        motion = np.append(motion, motion[:, :1], axis=1)  # which is periodic
        bend = answer.beside(motion, 1 / (HALF_STEPS * rate), reply)
        if np.all(np.isfinite(bend)):
            return reply, bend, True
    return reply, np.zeros_like(reply), answer.beside is None


def _checked_band(band: Any, rate: float) -> tuple[float, float] | None:
    if band is None:
        return None
    highest = min(MOST, BELOW * rate)
    remedy = f"give lowest and highest frequency, at least 0 and at most {highest:g} Hz"
    try:
        low, high = (float(edge) for edge in band)
    except (TypeError, ValueError):
        low = high = math.nan
    require(0 <= low < high <= highest, "band", band, remedy)
    return low, high


def _band(recordings: Sequence[PerturbedRecording]) -> tuple[float, float]:
    """The frequencies of their response [Hz]."""
    low = 0.0 if recordings[0].band is None else recordings[0].band[0]
    return low, min(one.highest for one in recordings)


def _groups(each: list[Frequencies], band: tuple[float, float]) -> Float[np.ndarray, " edges"]:
    """Edges of groups of frequencies in the band, from where every window holds some periods on."""
    lowest = max(LOWEST, band[0], LEAST_PERIODS * max(float(f[1]) for f in each))
    edges = [LOWEST]
    while edges[-1] < band[1]:
        widest = max(WIDEST, edges[-1] / 30)
        edges.append(edges[-1] + np.clip(WIDTH * edges[-1], NARROWEST, widest))
    return np.array([edge for edge in edges if edge >= lowest])


def _grouped(
    f: Frequencies, edges: Float[np.ndarray, " edges"]
) -> Bool[np.ndarray, "groups ordinates"]:
    """Which ordinates belong to which group."""
    return np.digitize(f, edges) - 1 == np.arange(len(edges) - 1)[:, None]


def _pooled(
    moved: list[_Moved],
    pieces: list[Recording],
    stiffness: Stiffness,
    band: tuple[float, float],
    rate: float,
) -> tuple[Frequencies, Ordinates, Frequencies]:
    """The stiffness in groups of frequencies that the motion excites, those of all trials together
    with weights by their errors: frequencies, values and standard errors."""
    edges = _groups([one.frequency(rate) for one in moved], band)
    sums = np.zeros((len(edges) - 1, 3), complex)
    power = np.zeros(len(edges) - 1)
    for one, piece in zip(moved, pieces, strict=True):
        f, length, rest = (
            one.frequency(rate),
            one.transform(one.length),
            one.transform(piece.whole),
        )
        square = np.abs(length) ** 2
        columns = np.stack([square, np.conj(length) * rest, f * square], axis=1)
        grouped = _grouped(f, edges)
        sums += grouped / _smooth(f, np.abs(rest) ** 2) @ columns
        power += grouped @ square / np.maximum(grouped.sum(axis=1), 1)
    weight, change, middle = sums[power >= max(LEAST_INPUT * power.max(), 1e-300)].T
    weight, frequency = np.real(weight), np.real(middle / weight)
    return frequency, stiffness(frequency) + change / weight, 1 / np.sqrt(2 * weight)


def _smooth(f: Frequencies, power: Frequencies) -> Frequencies:
    """Mean power over a quarter of each frequency to both sides, at least 0.1 Hz; without the
    mean's."""
    reach = np.maximum(np.rint(np.maximum(AROUND * f, FEWEST) / f[1]).astype(int), 3)
    summed, n = np.cumsum(np.append(0.0, power)), len(power)
    i = np.arange(n)
    low, high = np.maximum(i - reach, 1), np.minimum(i + reach + 1, n)
    return (summed[high] - summed[low]) / (high - low)
