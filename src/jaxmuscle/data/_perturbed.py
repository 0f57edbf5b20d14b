"""Recordings of two channels: the insertion is moved, the force that answers is read."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed
from jaxmuscle._common.text import folded
from jaxmuscle.spectra._cross_spectrum import Response, response_of
from jaxmuscle.spectra._settings import SpectrumSettings, require

from ._frequency_response import FrequencyResponse
from ._measure import Measure, normal_interval
from ._perturbed_target import perturbed_target
from ._recording import Recording, recorded_settings
from ._second_order import SecondOrder, lateness, lengthens, second_order_fit
from ._target import Target
from ._units import scale_to_si

SURE = 4.0  # standard errors from which on the sign of the displacement is found
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

    `jaxmuscle.load_recording(path, force=..., displacement=...)` reads one from a file, and
    converts units and sign.

    **Raises:** `ValueError` naming the argument, its value and the remedy.
    """

    force: Recording
    displacement: Recording
    name: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    notices: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        force: Recording,
        displacement: Recording,
        *,
        name: str | None = None,
        source: str | None = None,
        notices: Iterable[str] = (),
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
        self.force, self.displacement = force, displacement
        self.name, self.source = (
            force.name if name is None else name,
            force.source if source is None else source,
        )
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
        name: str = "recording",
        source: str = "given by the user",
        start: float | int = 0.0,
        window: Sequence[float | int] | None = None,
        notices: Iterable[str] = (),
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
        - `name`, `source`, `start`, `window`, `notices`: as in `Recording`.

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
        negative = bool(np.mean(pull) < 0)
        pull, moved, begin, said = _shifted(scale * pull, reach * moved, float(rate), delay)
        fields: dict[str, Any] = {
            "name": name,
            "source": source,
            "start": float(start) + begin,
            "window": window,
        }
        held, given = (
            _recording("force", pull, rate, "N", fields),
            _recording("displacement", moved, rate, "m", fields),
        )
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
        )

    @property
    def rate(self) -> float:
        """Samples per second [Hz]."""
        return self.force.rate

    @property
    def window(self) -> tuple[float, float] | None:
        """(start, stop) [s] of the part that is analysed, or `None` for all of it."""
        return self.force.window

    def steady(self, window: Sequence[float | int] | None = None) -> "PerturbedRecording":
        """The recording with the part as window in which the mean force is held: given, or found as
        by `Recording.steady`.

        Where a weak force answers with more than a tenth of itself, so that none is found, it is
        looked for in what is left of the force without the answer of a spring, a damper and a mass.
        Both channels are cut alike.

        **Raises:** `ValueError` as `Recording.steady`.
        """
        try:
            held = self.force.steady(window)
        except ValueError:
            if window is not None:
                raise
            found = self._without_answer().steady()  # or it raises the same
            held = self.force._with(self.force.whole, self.rate, found.window, found.notices)
        moved = self.displacement.steady(held.window)
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
        return self.force._with(
            self.force.whole - columns[:, 1:] @ sizes[1:], self.rate, None, self.force.notices
        )

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
    if abs(found) < SURE**2:
        return 1.0, [
            "the sign of the displacement is not found, since the force hardly follows it:"
            " lengthening is taken as positive. If you know the sign, give --positive lengthening"
            " or --positive shortening (Python: positive=)"
        ]
    if found < 0:
        return -1.0, ["the displacement counts shortening as positive: its sign is turned"]
    return 1.0, []
