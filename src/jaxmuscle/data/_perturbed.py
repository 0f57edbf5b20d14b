"""Recordings of two channels: the insertion is moved, the force that answers is read; the target
that they give: fluctuations of the force beside its response, and the dynamic stiffness.

See docs/perturbed.md for the mathematics.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxmuscle import plot
from jaxmuscle._common.arguments import require
from jaxmuscle._common.cards import Printed
from jaxmuscle._common.names import name_of_all
from jaxmuscle._common.text import folded
from jaxmuscle.spectra._cross_spectrum import Response, response_of
from jaxmuscle.spectra._settings import SpectrumSettings

from ._frequency_response import FrequencyResponse
from ._measure import Measure, normal_interval
from ._recording import Recording, pooled_target, recorded_settings
from ._recording_quality import Baseline
from ._second_order import SecondOrder, lateness, lengthens, second_order_fit
from ._target import Target
from ._units import scale_to_si

SIGN_FOUND = 4.0  # standard errors from which on the sign of the displacement is found
UNITS = ("N/m", "N s/m", "kg", "s")
LEAST_MOVED, MOST_MOVED = 0.005, 100.0  # mm rms: what motors move
NEGATIVE = (
    "the mean force is negative: count the muscle's pull as positive, or the stiffness has the"
    " wrong sign"
)
NEGATIVE_TURNED = (
    ". With this force the displacement seems to count shortening as positive, so its sign was"
    " turned. It will not be once the force is right"
)
CUT = 0.1  # s
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
# told, standard errors from 0 within which none is seen; a difference from 1 that gets a notice.
FROM_ALL, FROM_NONE, DIFFERENT = 4.0, 2.0, 0.2
UNLIKE = (
    "the force answers the movement {} nonlinearly than the muscle of the model. The nonlinear part"
    " of the model's answer is {:.2g} N rms; the recording shows {:.0f} ± {:.0f} % of it. The fit"
    " subtracted {} from the force. What to do: do not report K_w0, which rests on the model's"
    " nonlinearity. Report tangent_stiffness, and K_w_tangent if it is determined. Compare them"
    " with a fit of the response alone (jaxmuscle fit stiffness.csv)"
)

Stiffness = Callable[[Float[np.ndarray, " frequencies"]], Complex[np.ndarray, " frequencies"]]
Motion = Float[np.ndarray, "3 times"]
Reply = Float[np.ndarray, " steps"]


class PerturbedRecording(Printed, eqx.Module):
    """A recording of two channels: the force of a muscle while its insertion is moved a little.

    The displacement counts *lengthening* as positive. The dynamic stiffness H(f) = force /
    lengthening then has a positive real part at low frequency. In the model's coordinates the
    lengthening is -x_z.

    **Arguments:**

    - `force`: a `Recording` in N, positive where the muscle pulls.
    - `displacement`: a `Recording` in m, of the same rate, start, window and number of samples.
    - `name`, `source`: by default those of the force.
    - `notices`: what was done to the channels, in sentences; those of both channels are added.
    - `others`: recordings before and after a pause, as in `Recording`.

    `jaxmuscle.load_recording(path, force=..., displacement=...)` reads one from a file, and
    converts units and sign.

    **Raises:** `ValueError` naming the argument, its value and the remedy.
    """

    force: Recording
    displacement: Recording
    name: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    notices: tuple[str, ...] = eqx.field(static=True)
    others: tuple["PerturbedRecording", ...]

    def __init__(
        self,
        force: Recording,
        displacement: Recording,
        *,
        name: str | None = None,
        source: str | None = None,
        notices: Iterable[str] = (),
        others: Iterable["PerturbedRecording"] = (),
    ):
        for argument, given, unit in (("force", force, "N"), ("displacement", displacement, "m")):
            require(
                isinstance(given, Recording),
                argument,
                given,
                "give a Recording, or use PerturbedRecording.from_array",
            )
            remedy = f"give it in {unit}, or use PerturbedRecording.from_array, which converts"
            require(given.unit == unit, f"{argument}.unit", given.unit, remedy)
        for field in ("rate", "start", "window"):
            same, other = getattr(force, field), getattr(displacement, field)
            require(
                same == other,
                f"displacement.{field}",
                other,
                f"that of the force is {same}; give both alike",
            )
        sizes = force.whole.size, displacement.whole.size
        require(
            sizes[0] == sizes[1],
            "displacement",
            f"{sizes[1]} samples",
            f"the force has {sizes[0]}; give one length",
        )
        self.force, self.displacement, self.others = force, displacement, tuple(others)
        self.name, self.source = (
            force.name if name is None else name,
            force.source if source is None else source,
        )
        moved = [
            f"displacement: {words}" for words in displacement.notices if words not in force.notices
        ]
        self.notices = tuple(dict.fromkeys((*notices, *force.notices, *moved)))

    @classmethod
    def from_array(  # noqa: PLR0913 (options of a public call)
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
        name: str = "recording",
        source: str = "given by the user",
        start: float | int = 0.0,
        window: Sequence[float | int] | None = None,
        notices: Iterable[str] = (),
        others: Iterable["PerturbedRecording"] = (),
        baseline: Baseline = None,
        detrend: bool = False,
    ) -> "PerturbedRecording":
        """A recording from two arrays of one length; torque and angle are converted with the lever
        arm.

            force = torque / lever_arm,   displacement = lever_arm · angle

        **Arguments:**

        - `force`, `displacement`, shape `(times,)`, in `units` (N, mN, kN, kgf, gf, lbf; N m, N cm,
          N mm) and `displacement_units` (m, cm, mm, um; deg, rad); `rate` [Hz].
        - `lever_arm` [m]: from the axis to the insertion; needed for a torque and for an angle.
        - `positive`: what the displacement counts as positive, `"lengthening"` or `"shortening"`.
          `None`: found from the data. If a spring, a damper and a mass describe the response better
          with the other sign, that of the displacement is turned, and a notice says so.
        - `delay` [s]: by which the force channel lags behind the displacement channel; the
          displacement is shifted by it.
        - `name`, `source`, `start`, `window`, `notices`, `others`: as in `Recording`; `baseline`,
          `detrend` too, of the force.

        **Raises:** `ValueError` naming the argument, its value and the remedy.
        """
        require(
            positive in (None, "lengthening", "shortening"),
            "positive",
            positive,
            "choose lengthening or shortening",
        )
        scale, turned = scale_to_si(units, "units", "force", lever_arm)
        reach, swung = scale_to_si(
            displacement_units, "displacement_units", "displacement", lever_arm
        )
        remedy = f"leave it out: {units} and {displacement_units} need none"
        require(lever_arm is None or turned or swung, "lever_arm", lever_arm, remedy)
        pull, moved = (
            _signal(name, values)
            for name, values in (("force", force), ("displacement", displacement))
        )
        require(
            pull.size == moved.size,
            "displacement",
            f"{moved.size} samples",
            f"the force has {pull.size}; give one length",
        )
        if np.isfinite(moved).all() and np.ptp(moved) <= 1e-12 * np.max(np.abs(moved), initial=0.0):
            raise ValueError(
                f"displacement: constant at {reach * moved[0] + 0.0:g} m, so nothing moved the"
                " muscle. Take the force alone, as a hold, or choose another column"
            )
        pull, moved, begin, said = _shifted(scale * pull, reach * moved, float(rate), delay)
        fields: dict[str, Any] = {
            "name": name,
            "source": source,
            "start": float(start) + begin,
            "window": window,
        }
        held, given = (
            _recording(
                "force", pull, rate, "N", fields | {"baseline": baseline, "detrend": detrend}
            ),
            _recording("displacement", moved, rate, "m", fields),
        )
        negative = bool(np.mean(held.whole) < 0)
        turn, more = _sign(held, given, positive)
        if negative:
            more = (
                [NEGATIVE + NEGATIVE_TURNED] if turn < 0 and positive is None else [NEGATIVE, *more]
            )
        size = 1e3 * float(np.std(given.whole))
        if not LEAST_MOVED < size < MOST_MOVED:
            other = "mm" if size > MOST_MOVED else "m"
            odd = "much" if other == "mm" else "little"
            more.append(
                f"the displacement is {size:.3g} mm rms, which is {odd} for a motor. If its column"
                f" is in {other}, give --displacement-units {other} (Python: displacement_units=)"
            )
        return cls(
            held,
            _recording("displacement", turn * moved, rate, "m", fields),
            notices=(*notices, *said, *more),
            others=others,
        )

    @property
    def rate(self) -> float:
        """Samples per second [Hz]."""
        return self.force.rate

    @property
    def window(self) -> tuple[float, float] | None:
        """(start, stop) [s] of the part that is analysed, or `None` for all of it."""
        return self.force.window

    def steady(self, window: Sequence[float | int] | str | None = None) -> "PerturbedRecording":
        """The recording with the part as window in which the mean force is held: given, or found as
        by `Recording.steady`.

        Where a weak force answers with more than a tenth of itself, so that none is found, it is
        looked for in what is left of the force without the answer of a spring, a damper and a mass.
        Both channels are cut alike.

        **Raises:** `ValueError` as `Recording.steady`.
        """
        for part in self.others if window is not None else ():
            if part.force.holds(window):
                return part.steady(window)
        try:
            held = self.force.steady(window)
        except ValueError:
            if window is not None:
                raise
            found = self._without_answer().steady()  # or it raises the same
            alone = self.force._with(window=None, notices=found.notices)
            held = alone.steady(found.window)
        moved = self.displacement.steady("all" if held.window is None else held.window)
        return PerturbedRecording(
            held, moved, name=self.name, source=self.source, notices=self.notices
        )

    def _without_answer(self) -> Recording:
        """The force less `K x + B x' + I x''` of the displacement, by least squares over all of the
        recording."""
        x = self.displacement.whole
        speed = np.gradient(x, 1 / self.rate)
        columns = np.stack([np.ones_like(x), x, speed, np.gradient(speed, 1 / self.rate)], axis=1)
        columns /= np.linalg.norm(columns, axis=0)
        sizes = np.linalg.lstsq(columns, self.force.whole, rcond=None)[0]
        return self.force._with(samples=self.force.whole - columns[:, 1:] @ sizes[1:], window=None)

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

        **Arguments:** `settings`, as for `Recording.spectrum`, or a name.

        **Raises:** `ValueError` if the window has fewer than three segments, or bins lie above half
        the recorded rate.
        """
        found = self._response(settings)
        source = f"{self.source}, {self.force.window_in_words}"
        fields = {"name": self.name, "source": source, "notices": self.notices}
        return FrequencyResponse(
            found.frequency, found.value, found.stderr, found.coherence, **fields
        )

    def _response(self, settings: SpectrumSettings | str | None) -> Response:
        return _response(self.force, self.displacement, recorded_settings(settings))

    def second_order(self, settings: SpectrumSettings | str | None = None) -> dict[str, Measure]:
        """The classical description of the response by a spring, a damper and a mass.

            H(f) = K + iωB - ω²I,   ω = 2πf

        Least squares, weighted with the errors of the response. If the response has another shape,
        the errors are multiplied by √(chi² / its expectation): the muscle is more than a spring, a
        damper and a mass.

        **Returns:** `{"K": ..., "B": ..., "I": ...}` [N/m, N s/m, kg], each a `Measure` with
        `interval`.

        **Source:** Kearney & Hunter 1990, Crit Rev Biomed Eng 18(1):55-87.
        """
        found = self._second_order(settings, False)
        rows = zip("KBI", found.value, found.stderr, UNITS, strict=False)
        return {
            name: Measure(
                float(value),
                float(error),
                unit,
                "spectrum",
                normal_interval(float(value), float(error)),
            )
            for name, value, error, unit in rows
        }

    def second_order_misfit(self, settings: SpectrumSettings | str | None = None) -> float:
        """How many times as large as expected chi² of `second_order` is: about 1 where that is the
        shape of the response."""
        return self._second_order(settings, False).chi2

    def _second_order(self, settings: SpectrumSettings | str | None, delayed: bool) -> SecondOrder:
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
        found = self._second_order(settings, True)
        return float(found.value[3]), float(found.stderr[3])

    def late(self, settings: SpectrumSettings | str | None = None) -> list[str]:
        """A notice if the force is surely later or earlier than a spring, a damper and a mass
        explain, else nothing."""
        try:
            response = self._response(settings)
        except ValueError:
            # too short or too slow for a response, which says so itself where one is asked for
            return []
        return lateness(response)

    def target(
        self,
        name: str | None = None,
        *,
        stiffness: (
            Callable[[Float[np.ndarray, " frequencies"]], Complex[np.ndarray, " frequencies"]]
            | None
        ) = None,
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
        return perturbed_target((self,), stiffness, name, settings=settings, provenance=provenance)

    def plot(self, settings: SpectrumSettings | str | None = None, ax: Any = None) -> Any:
        """Draw both channels with the window, and gain, phase and coherence with their errors;
        returns the figure."""
        return plot.perturbed(self, settings, ax)

    def __str__(self) -> str:
        force, moved = self.force, self.displacement
        lines = [
            (
                f"{self.name}: force [N] and lengthening [m], {force.whole.size} samples at"
                f" {self.rate:g} Hz"
            ),
            f"  source    {self.source}",
            f"  time      {force.start:g} s to {force.stop:g} s; {force.window_in_words}",
            (
                f"  force     mean {np.mean(force.samples):.4g} N, standard deviation"
                f" {np.std(force.samples):.3g} N"
            ),
            (
                f"  displaced {1e3 * np.std(moved.samples):.3g} mm rms, at most"
                f" {1e3 * _largest(moved.samples):.3g} mm"
            ),
        ]
        return folded(lines + [f"  notice    {notice}" for notice in self.notices])


def _largest(x: Float[np.ndarray, " times"]) -> float:
    return float(np.max(np.abs(x - np.mean(x))))


def _signal(name: str, values: Any) -> Float[np.ndarray, " times"]:
    try:
        signal = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: give real numbers, one for each time") from None
    require(signal.ndim == 1, f"{name} shape", signal.shape, "give one signal")
    return signal


def _recording(
    kind: str, samples: Any, rate: float | int, unit: str, fields: dict[str, Any]
) -> Recording:
    try:
        return Recording(samples, rate, unit=unit, **fields)
    except ValueError as error:
        raise ValueError(f"{kind}: {error}") from None


def _shifted(
    force: Float[np.ndarray, " times"], moved: Float[np.ndarray, " times"], rate: float, delay: Any
) -> tuple[Float[np.ndarray, " kept"], Float[np.ndarray, " kept"], float, list[str]]:
    """Both channels with the displacement later by `delay` [s] (a spline of order 5), the time of
    the first, a notice."""
    longest = force.size / 2 / rate
    number = isinstance(delay, int | float | np.number) and not isinstance(delay, bool)
    require(
        number and abs(delay) < longest,
        "delay",
        delay,
        "give a time in s, shorter than half of the recording",
    )
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
    if np.ptp(given) <= 1e-12 * np.max(np.abs(given)):
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


class _Moved(NamedTuple):
    """One recording at the rate of the settings: force, lengthening about its mean in the window,
    and what the force does when it follows that: linearly, and by how much differently in the
    nonlinear muscle (nothing where that is unknown).
    """

    force: Float[np.ndarray, " all"]
    length: Float[np.ndarray, " all"]
    reply: Float[np.ndarray, " all"]
    bend: Float[np.ndarray, " all"]
    exact: bool
    inside: slice


class _Ordinates(NamedTuple):
    """The transforms of one recording in its window: lengthening, what is left of the force, and
    all of what is left."""

    f: Float[np.ndarray, " ordinates"]
    length: Complex[np.ndarray, " ordinates"]
    rest: Complex[np.ndarray, " ordinates"]
    fluctuation: Recording


def perturbed_target(
    recordings: Sequence[PerturbedRecording],
    stiffness: Stiffness | None = None,
    name: str | None = None,
    *,
    predicted: Callable[[Motion, float], Reply] | None = None,
    settings: SpectrumSettings | str | None = None,
    provenance: str = "measured",
) -> Target:
    """Force fluctuations beside the response to the perturbation, and the dynamic stiffness, of
    trials of one condition.

    With the lengthening l, its response `h * l` by the `stiffness` H and the transform X_j = Σ_m
    w_m x_m e^(-2πi f_j m Δ) of a whole window (w a cosine taper over its first and last 5 %), the
    rest e = F - h * l gives

        Ĥ_g = H(f_g) + Σ_j w_j L_j* E_j / Σ_j w_j |L_j|²
        sd² = 1 / (2 Σ_j w_j |L_j|²)   (of each part)

    over the ordinates j of a group g, about 0.12 f wide, with w_j = 1 / S_E(f_j) and f_g their mean
    frequency, so weighted; real and imaginary part of Ĥ have the same sd. The response is computed
    through the whole recording, so neither window nor leakage of the input biases Ĥ; where H is the
    muscle's own, e is its fluctuation alone. Its spectrum, mean and coefficient of variation are
    the target's. S_E is the measured density of e. q is what the response of the nonlinear muscle
    (`predicted`) differs by from h * l, and β = 1, unless the recordings show another share of q
    (`_share_shown`).

    **Arguments:**

    - `recordings` with their windows
    - `stiffness` H(f) [N/m] of a vector of frequencies, by default the nonparametric one
      (`PerturbedRecording.frequency_response`)
    - `predicted`: which gives the response of the force [N] to lengthening, its velocity and
      acceleration (at times so far apart [s], every second of which is asked for), by the nonlinear
      muscle say, instead of H, which stays where that is not finite; others as in
      `Recording.target`
    """
    settings = recorded_settings(settings)
    each = [
        _measured(recording, settings) if stiffness is None else stiffness
        for recording in recordings
    ]
    moved = [
        _moved(recording, own, predicted, settings)
        for recording, own in zip(recordings, each, strict=True)
    ]
    share, said = _share_shown(moved, settings) if predicted is not None else (1.0, ())
    pieces = [
        _ordinates(*pair, share, said, settings) for pair in zip(recordings, moved, strict=True)
    ]
    fluctuations = [piece.fluctuation for piece in pieces]
    called = name_of_all([recording.name for recording in recordings]) if name is None else name
    target = pooled_target(fluctuations, called, "force", provenance, None, settings)
    return target.with_stiffness(
        _pooled(pieces, each[0], called, target.source, float(settings.frequency[-1]))
    )


def _measured(recording: PerturbedRecording, settings: SpectrumSettings) -> Stiffness:
    """The nonparametric response, held beyond its ends; what makes no odds since nothing moves
    there."""
    found = recording.frequency_response(settings)
    return lambda f: (
        np.interp(f, found.frequency, np.real(found.value))
        + 1j * np.interp(f, found.frequency, np.imag(found.value))
    )


def _even(recording: Recording, rate: float) -> tuple[Float[np.ndarray, " all"], slice]:
    even, margin = recording.resampled(rate), round(MARGIN * rate)
    first, stop = recording.span(rate)
    span = max(first, margin), min(stop, even.whole.size - margin)
    require(
        span[1] - span[0] > 4 * margin,
        "window",
        recording.window,
        f"holds less than {4 * MARGIN:g} s besides {MARGIN:g} s before and after it; record longer",
    )
    return even.whole, slice(*span)


def _moved(
    recording: Any, stiffness: Stiffness, predicted: Any, settings: SpectrumSettings
) -> _Moved:
    force, inside = _even(recording.force, settings.rate)
    moved, _ = _even(recording.displacement, settings.rate)
    length = moved - np.mean(moved[inside])
    return _Moved(force, length, *_reply(length, stiffness, predicted, settings.rate), inside)


def _transformed(x: Float[np.ndarray, " all"], inside: slice) -> Complex[np.ndarray, " ordinates"]:
    here = x[inside] - np.mean(x[inside])
    return np.fft.rfft(scipy.signal.windows.tukey(len(here), TAPER) * here)


def _share_shown(moved: list[_Moved], settings: SpectrumSettings) -> tuple[float, tuple[str, ...]]:
    """Which share β of the nonlinear muscle's own response q the recordings show, and what is to be
    said of it.

    With the transforms E of F - h * l and Q of q, both without what in each group of frequencies is
    in proportion to L,

        β = Σ Re(Q* E) / S_E  /  Σ |Q|² / S_E,     sd² = 1 / (2 Σ |Q|² / S_E)

    1 of a muscle as the model's, 0 of a linear one. So β = 1 unless the recordings contradict that
    by four errors.
    """
    shown = weight = 0.0
    for one in moved:
        length, rest, bend = (
            _transformed(x, one.inside) for x in (one.length, one.force - one.reply, one.bend)
        )
        f = np.fft.rfftfreq(one.inside.stop - one.inside.start, 1 / settings.rate)
        density = _smooth(f, np.abs(rest) ** 2)
        edges = _groups(_lowest([f]), float(settings.frequency[-1]))
        group = np.digitize(f, edges) - 1
        used = (group >= 0) & (group < len(edges) - 1)
        length, rest, bend, density, group = (
            length[used],
            rest[used],
            bend[used],
            density[used],
            group[used],
        )
        own = np.zeros((3, len(edges) - 1), complex)
        for row, x in zip(own, (length, rest, bend), strict=True):
            np.add.at(row, group, np.conj(length) * x / density)
        rest, bend = (
            x - length * (row[group] / np.maximum(np.real(own[0][group]), 1e-300))
            for x, row in ((rest, own[1]), (bend, own[2]))
        )
        shown += float(np.sum(np.real(np.conj(bend) * rest) / density))
        weight += float(np.sum(np.abs(bend) ** 2 / density))
    if weight <= 0:
        return 1.0, ()
    share, error = shown / weight, 1 / np.sqrt(2 * weight)
    if abs(share - 1) <= FROM_ALL * error:
        return 1.0, ()
    size = np.sqrt(np.mean(np.concatenate([one.bend[one.inside] for one in moved]) ** 2))
    none = abs(share) <= FROM_NONE * error
    words = UNLIKE.format(
        "less" if share < 1 else "more",
        size,
        100 * share,
        100 * error,
        "none of it" if none else "that share",
    )
    return 0.0 if none else share, (words,) * (abs(share - 1) > DIFFERENT)


def _ordinates(
    recording: Any, moved: _Moved, share: float, said: tuple[str, ...], settings: SpectrumSettings
) -> _Ordinates:
    rate, inside = settings.rate, moved.inside
    left = moved.force - moved.reply - share * moved.bend
    edges = (
        recording.force.start + inside.start / rate,
        recording.force.start + inside.stop / rate,
    )
    asked = tuple(recording.force.start + edge / rate for edge in recording.force.span(rate))
    cut = (
        ()
        if max(abs(a - b) for a, b in zip(asked, edges, strict=True)) < CUT
        else (SHORTER.format(*asked, *edges, MARGIN),)
    )
    linear = () if moved.exact else (LINEAR,)
    fluctuation = Recording(
        left,
        rate,
        unit=recording.force.unit,
        name=recording.name,
        source=recording.source,
        start=recording.force.start,
        window=edges,
        baseline="none",
        notices=(*recording.notices, *recording.late(), *cut, *linear, *said),
        recorded_at=recording.force.recorded_at,
    )
    f = np.fft.rfftfreq(inside.stop - inside.start, 1 / rate)
    return _Ordinates(
        f, _transformed(moved.length, inside), _transformed(fluctuation.whole, inside), fluctuation
    )


def _reply(
    length: Float[np.ndarray, " all"], stiffness: Stiffness, predicted: Any, rate: float
) -> tuple[Float[np.ndarray, " all"], Float[np.ndarray, " all"], bool]:
    """What the force does when it follows the lengthening linearly, right from the margin on; by
    how much `predicted` differs; and whether that is known."""
    edge = round(0.5 * MARGIN * rate)
    ramp = np.sin(0.5 * np.pi * (np.arange(edge) + 0.5) / edge) ** 2
    tapered = length.copy()
    tapered[:edge] *= ramp
    tapered[-edge:] *= ramp[::-1]
    f = np.fft.rfftfreq(len(length), 1 / rate)
    where, density = scipy.signal.welch(tapered, rate, nperseg=min(1024, len(length)))
    excited = np.interp(f, where, density) >= EXCITED * np.max(density)
    moved = np.where(excited, np.fft.rfft(tapered), 0.0)
    nodes = np.sinh(np.linspace(0.0, 6.0, NODES)) / np.sinh(6.0) * rate / 2
    value = stiffness(nodes)
    smooth = scipy.interpolate.CubicSpline(
        nodes, np.stack([np.real(value), np.imag(value)]), axis=1
    )(f)
    reply = np.fft.irfft((smooth[0] + 1j * smooth[1]) * moved, len(length))
    if predicted is not None:
        fine, turn = HALF_STEPS * len(length), 2j * np.pi * f
        motion = np.stack(
            [HALF_STEPS * np.fft.irfft(turn**order * moved, fine) for order in (0, 1, 2)]
        )
        motion = np.append(motion, motion[:, :1], axis=1)  # which is periodic
        whole = predicted(motion, 1 / (HALF_STEPS * rate))[:: HALF_STEPS // 2][: len(length)]
        if np.all(np.isfinite(whole)):
            return reply, whole - reply, True
    return reply, np.zeros_like(reply), predicted is None


def _lowest(each: list[Float[np.ndarray, " ordinates"]]) -> float:
    return max(LOWEST, LEAST_PERIODS * max(float(f[1]) for f in each))


def _groups(lowest: float, highest: float) -> Float[np.ndarray, " edges"]:
    edges = [LOWEST]
    while edges[-1] < highest:
        edges.append(edges[-1] + np.clip(WIDTH * edges[-1], NARROWEST, WIDEST))
    return np.array([edge for edge in edges if edge >= lowest])


def _pooled(
    pieces: list[_Ordinates], stiffness: Stiffness, name: str, source: str, highest: float
) -> FrequencyResponse:
    """The stiffness in groups of frequencies, those of all trials together with weights by their
    errors."""
    edges = _groups(_lowest([piece.f for piece in pieces]), highest)
    weight, change, middle = (np.zeros(len(edges) - 1, dtype) for dtype in (float, complex, float))
    for piece in pieces:
        group = np.digitize(piece.f, edges) - 1
        used = (group >= 0) & (group < len(weight))
        square = np.abs(piece.length) ** 2
        density = _smooth(piece.f, np.abs(piece.rest) ** 2)
        for values, each in (
            (weight, square / density),
            (change, np.conj(piece.length) * piece.rest / density),
            (middle, piece.f * square / density),
        ):
            np.add.at(values, group[used], each[used])
    kept = weight > 0
    weight, change, middle = weight[kept], change[kept], middle[kept]
    frequency = middle / weight
    return FrequencyResponse(
        frequency,
        stiffness(frequency) + change / weight,
        1 / np.sqrt(2 * weight),
        name=name,
        source=source,
    )


def _smooth(
    f: Float[np.ndarray, " ordinates"], power: Float[np.ndarray, " ordinates"]
) -> Float[np.ndarray, " ordinates"]:
    """Mean power over a quarter of each frequency to both sides, at least 0.1 Hz; without the
    mean's."""
    reach = np.maximum(np.rint(np.maximum(AROUND * f, FEWEST) / f[1]).astype(int), 3)
    summed, n = np.cumsum(np.append(0.0, power)), len(power)
    i = np.arange(n)
    low, high = np.maximum(i - reach, 1), np.minimum(i + reach + 1, n)
    return (summed[high] - summed[low]) / (high - low)
