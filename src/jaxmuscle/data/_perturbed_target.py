"""The target of perturbed recordings: fluctuations of the force beside its response, and the dynamic stiffness.

See docs/perturbed.md for the mathematics.
"""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxmuscle._common.names import name_of_all
from jaxmuscle.spectra._settings import SpectrumSettings, require

from ._frequency_response import FrequencyResponse
from ._pooled import pooled_target
from ._recording import Recording, recorded_settings
from ._target import Target

if TYPE_CHECKING:
    from ._perturbed import PerturbedRecording

CUT = 0.1  # s
SHORTER = ("of the window from {:.4g} to {:.4g} s the fit uses {:.4g} to {:.4g} s: it needs {:g} s of the recording before "
           "and after what it uses. If you can, record that much longer")  # fmt: skip
MARGIN = 2.0  # s before and after the window, where the muscle forgets what is not known
TAPER = 0.1  # share of the window that is tapered
LOWEST, LEAST_PERIODS = 0.05, 2.5  # Hz; periods of the lowest frequency in the window
WIDTH, NARROWEST, WIDEST = 0.12, 0.05, 0.4  # of a group of frequencies: relative to it; at least, at most [Hz]
EXCITED = 1e-6  # of the largest density of the displacement: below is the sensor's noise
AROUND, FEWEST = 0.25, 0.1  # over which range the density of the fluctuations is averaged: relative; at least [Hz]
NODES = 600
HALF_STEPS = 10  # of the nonlinear muscle in a sampling interval
LINEAR = ("the response to the movement was taken off as a linear one, since that of the nonlinear muscle could not be "
          "computed. If the motion was large, a part of it is left in the fluctuations")  # fmt: skip

Stiffness = Callable[[Float[np.ndarray, " frequencies"]], Complex[np.ndarray, " frequencies"]]
Motion = Float[np.ndarray, "3 times"]
Reply = Float[np.ndarray, " steps"]


class _Ordinates(NamedTuple):
    """One recording at the rate of the settings: `length` lengthening and `force` about their means in the window, and what
    is left of the force."""

    f: Float[np.ndarray, " ordinates"]
    length: Complex[np.ndarray, " ordinates"]
    rest: Complex[np.ndarray, " ordinates"]
    fluctuation: Recording


def perturbed_target(
    recordings: "Sequence[PerturbedRecording]",
    stiffness: Stiffness | None = None,
    name: str | None = None,
    *,
    predicted: Callable[[Motion, float], Reply] | None = None,
    settings: SpectrumSettings | str | None = None,
    provenance: str = "measured",
) -> Target:
    """Force fluctuations beside the response to the perturbation, and the dynamic stiffness, of trials of one condition.

    With the lengthening l, its response `h * l` by the `stiffness` H and the transform X_j = Σ_m w_m x_m e^(-2πi f_j m Δ) of
    a whole window (w a cosine taper over its first and last 5 %), the rest e = F - h * l gives

        Ĥ_g = H(f_g) + Σ_j L_j* E_j / Σ_j |L_j|²,     sd² = S_E(f_g) / (2 Σ_j |L_j|²)   (real and imaginary part each)

    over the ordinates j of a group g, about 0.12 f wide. The response is computed through the whole recording, so neither
    window nor leakage of the input biases Ĥ; where H is the muscle's own, e is its fluctuation alone. Its spectrum, mean and
    coefficient of variation are the target's. S_E is the measured density of e.

    **Arguments:**

    - `recordings` with their windows
    - `stiffness` H(f) [N/m] of a vector of frequencies, by default the nonparametric one
      (`PerturbedRecording.frequency_response`)
    - `predicted`: which gives the response of the force [N] to lengthening, its velocity and acceleration (at times so far
      apart [s], every second of which is asked for), by the nonlinear muscle say, instead of H, which stays where that is
      not finite; others as in `Recording.target`
    """
    settings = recorded_settings(settings)
    each = [_measured(recording, settings) if stiffness is None else stiffness for recording in recordings]
    pieces = [_ordinates(recording, own, predicted, settings) for recording, own in zip(recordings, each, strict=True)]
    fluctuations = [piece.fluctuation for piece in pieces]
    called = name_of_all([recording.name for recording in recordings]) if name is None else name
    target = pooled_target(fluctuations, called, "force", provenance, None, settings)
    return target.with_stiffness(_pooled(pieces, each[0], called, target.source, float(settings.frequency[-1])))


def _measured(recording: "PerturbedRecording", settings: SpectrumSettings) -> Stiffness:
    """The nonparametric response, held beyond its ends; what makes no odds since nothing moves there."""
    found = recording.frequency_response(settings)
    return lambda f: (
        np.interp(f, found.frequency, np.real(found.value)) + 1j * np.interp(f, found.frequency, np.imag(found.value))
    )


def _even(recording: Recording, rate: float) -> tuple[Float[np.ndarray, " all"], slice]:
    even, margin = recording.resampled(rate), round(MARGIN * rate)
    first, stop = recording.span(rate)
    span = max(first, margin), min(stop, even.whole.size - margin)
    require(span[1] - span[0] > 4 * margin, "window", recording.window,
            f"holds less than {4 * MARGIN:g} s besides {MARGIN:g} s before and after it; record longer")  # fmt: skip
    return even.whole, slice(*span)


def _ordinates(recording: Any, stiffness: Stiffness, predicted: Any, settings: SpectrumSettings) -> _Ordinates:
    rate = settings.rate
    force, inside = _even(recording.force, rate)
    moved, _ = _even(recording.displacement, rate)
    length = moved - np.mean(moved[inside])
    reply, exact = _response(length, stiffness, predicted, rate)
    edges = (recording.force.start + inside.start / rate, recording.force.start + inside.stop / rate)
    asked = tuple(recording.force.start + edge / rate for edge in recording.force.span(rate))
    cut = (
        () if max(abs(a - b) for a, b in zip(asked, edges, strict=True)) < CUT else (SHORTER.format(*asked, *edges, MARGIN),)
    )
    fluctuation = Recording(force - reply, rate, unit=recording.force.unit, name=recording.name, source=recording.source,
                            start=recording.force.start, window=edges,
                            notices=(*recording.notices, *recording.late(), *cut, *(LINEAR,) * (not exact)))  # fmt: skip
    rest = fluctuation.whole[inside]
    taper = scipy.signal.windows.tukey(len(rest), TAPER)
    f = np.fft.rfftfreq(len(rest), 1 / rate)
    return _Ordinates(f, np.fft.rfft(taper * length[inside]), np.fft.rfft(taper * (rest - np.mean(rest))), fluctuation)


def _response(
    length: Float[np.ndarray, " all"], stiffness: Stiffness, predicted: Any, rate: float
) -> tuple[Float[np.ndarray, " all"], bool]:
    """What the force does when it follows the lengthening, right from the margin on; and whether it is as `predicted`."""
    edge = round(0.5 * MARGIN * rate)
    ramp = np.sin(0.5 * np.pi * (np.arange(edge) + 0.5) / edge) ** 2
    tapered = length.copy()
    tapered[:edge] *= ramp
    tapered[-edge:] *= ramp[::-1]
    f = np.fft.rfftfreq(len(length), 1 / rate)
    where, density = scipy.signal.welch(tapered, rate, nperseg=min(1024, len(length)))
    excited = np.interp(f, where, density) >= EXCITED * np.max(density)
    moved = np.where(excited, np.fft.rfft(tapered), 0.0)
    if predicted is not None:
        fine, turn = HALF_STEPS * len(length), 2j * np.pi * f
        motion = np.stack([HALF_STEPS * np.fft.irfft(turn**order * moved, fine) for order in (0, 1, 2)])
        motion = np.append(motion, motion[:, :1], axis=1)  # which is periodic
        reply = predicted(motion, 1 / (HALF_STEPS * rate))[:: HALF_STEPS // 2][: len(length)]
        if np.all(np.isfinite(reply)):
            return reply, True
    nodes = np.sinh(np.linspace(0.0, 6.0, NODES)) / np.sinh(6.0) * rate / 2
    value = stiffness(nodes)
    smooth = scipy.interpolate.CubicSpline(nodes, np.stack([np.real(value), np.imag(value)]), axis=1)(f)
    return np.fft.irfft((smooth[0] + 1j * smooth[1]) * moved, len(length)), predicted is None


def _groups(lowest: float, highest: float) -> Float[np.ndarray, " edges"]:
    edges = [LOWEST]
    while edges[-1] < highest:
        edges.append(edges[-1] + np.clip(WIDTH * edges[-1], NARROWEST, WIDEST))
    return np.array([edge for edge in edges if edge >= lowest])


def _pooled(pieces: list[_Ordinates], stiffness: Stiffness, name: str, source: str, highest: float) -> FrequencyResponse:
    """The stiffness in groups of frequencies, those of all trials together with weights by their errors."""
    lowest = max(LOWEST, LEAST_PERIODS * max(float(piece.f[1]) for piece in pieces))
    edges = _groups(lowest, highest)
    weight, change, middle = (np.zeros(len(edges) - 1, dtype) for dtype in (float, complex, float))
    for piece in pieces:
        group = np.digitize(piece.f, edges) - 1
        used = (group >= 0) & (group < len(weight))
        square = np.abs(piece.length) ** 2
        density = _smooth(piece.f, np.abs(piece.rest) ** 2)
        for values, each in ((weight, square / density), (change, np.conj(piece.length) * piece.rest / density),
                             (middle, piece.f * square / density)):  # fmt: skip
            np.add.at(values, group[used], each[used])
    kept = weight > 0
    weight, change, middle = weight[kept], change[kept], middle[kept]
    frequency = middle / weight
    return FrequencyResponse(frequency, stiffness(frequency) + change / weight, 1 / np.sqrt(2 * weight), name=name,
                             source=source)  # fmt: skip


def _smooth(f: Float[np.ndarray, " ordinates"], power: Float[np.ndarray, " ordinates"]) -> Float[np.ndarray, " ordinates"]:
    """Mean power over a quarter of each frequency to both sides, at least 0.1 Hz; without the mean's."""
    reach = np.maximum(np.rint(np.maximum(AROUND * f, FEWEST) / f[1]).astype(int), 3)
    summed, n = np.cumsum(np.append(0.0, power)), len(power)
    i = np.arange(n)
    low, high = np.maximum(i - reach, 1), np.minimum(i + reach + 1, n)
    return (summed[high] - summed[low]) / (high - low)
