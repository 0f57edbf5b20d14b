"""The target of perturbed recordings: fluctuations of the force beside its response, and the
dynamic stiffness.

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
# standard errors of a share of the nonlinear response from 1, and from 0; for a notice
SURE, NONE, MUCH = 4.0, 2.0, 0.2
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
    recordings: "Sequence[PerturbedRecording]",
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


def _measured(recording: "PerturbedRecording", settings: SpectrumSettings) -> Stiffness:
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
    return _Moved(force, length, *_response(length, stiffness, predicted, settings.rate), inside)


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
    if abs(share - 1) <= SURE * error:
        return 1.0, ()
    size = np.sqrt(np.mean(np.concatenate([one.bend[one.inside] for one in moved]) ** 2))
    none = abs(share) <= NONE * error
    words = UNLIKE.format(
        "less" if share < 1 else "more",
        size,
        100 * share,
        100 * error,
        "none of it" if none else "that share",
    )
    return 0.0 if none else share, (words,) * (abs(share - 1) > MUCH)


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
        notices=(*recording.notices, *recording.late(), *cut, *linear, *said),
    )
    f = np.fft.rfftfreq(inside.stop - inside.start, 1 / rate)
    return _Ordinates(
        f, _transformed(moved.length, inside), _transformed(fluctuation.whole, inside), fluctuation
    )


def _response(
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
