"""The target that recordings of one condition give together: absolute spectra averaged, means,
variations, notices."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle.spectra._settings import SpectrumSettings, require

from ._recording_quality import plateau, running_median
from ._target import Target

if TYPE_CHECKING:
    from ._recording import Recording

DRIFT = 0.5  # share of the variance
UNLIKE = 1.1  # ratio of the means of two trials
UNRAMPED = "steady part: no ramp found, so all of the recording is used"
FOUND = "steady part found automatically: "


def pooled_target(
    recordings: "Sequence[Recording]",
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
    rows = np.stack([np.asarray(recording.spectrum(settings).power) for recording in recordings])
    segments = [recording.segments(settings) for recording in recordings]
    signals = [recording.filtered(settings) for recording in recordings]
    means = np.array([float(np.mean(x)) for x in signals])
    variations = [
        float(np.std(x)) / max(abs(m), 1e-300) for x, m in zip(signals, means, strict=True)
    ]
    mean = abs(float(np.mean(means)))
    full = 100.0 if mvc is None and unit == "% MVC" else mvc
    require(
        full is None or 0 < mean <= full < math.inf,
        "mvc",
        mvc,
        f"give a force above the mean, {mean:.4g}",
    )
    varying = quantity in ("force", "torque") and max(variations) <= 1
    power = np.average(rows, axis=0, weights=segments)
    drifts = [_drift(x) if varying else () for x in signals]
    each = list(
        dict.fromkeys(
            f"{recording.source}, {recording.window_in_words}" for recording in recordings
        )
    )
    return Target(
        name,
        power / np.sum(power),
        quantity=str(quantity),
        provenance=provenance,
        source="; ".join(each) if len(rows) == 1 else f"{len(rows)} trials: {'; '.join(each)}",
        segments=segments,
        coefficient_of_variation=variations if varying else None,
        mvc_fraction=None if full is None else mean / full,
        mean=np.abs(means).tolist() if varying else None,
        unit=unit,
        trial_power=rows if len(rows) > 1 else None,
        settings=settings,
        notices=notices_of(recordings, signals, settings.rate, drifts, quantity),
    )


def notices_of(
    recordings: "Sequence[Recording]",
    signals: Sequence[np.ndarray],
    rate: float,
    more: Sequence[tuple[str, ...]],
    quantity: str | None,
) -> tuple[str, ...]:
    """What to mind of recordings of one condition, whose windows hold these low-passed signals;
    `more` of each of them."""
    unit, held = recordings[0].unit, quantity in ("force", "torque")
    ramps = [_ramped(x, rate, unit) if held else () for x in signals]
    each = [(*ramp, *own) for ramp, own in zip(ramps, more, strict=True)]
    unclear = (
        f"the unit {unit} does not say what was measured: is it the right column? A coefficient of"
        " variation makes sense only of a signal that is zero without force, and in proportion"
        " to it"
    )
    alike = (
        unlike([r.name for r in recordings], signals, unit)
        if held
        else (unclear,)
        if quantity is None
        else ()
    )
    return (*_notices(recordings, each), *alike)


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


def _notices(recordings: "Sequence[Recording]", more: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Those of every trial, each once, with the names of the trials unless all say so; the steady
    parts in one."""
    said = [
        (notice, r.name)
        for r, own in zip(recordings, more, strict=True)
        for notice in (*r.notices, *own)
    ]
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
    alone = {together} | {
        notice for notice, names in whose.items() if len(names) == len(recordings)
    }
    return tuple(
        notice if notice in alone else f"{', '.join(names)}: {notice}"
        for notice, names in whose.items()
    )


def unlike(names: Sequence[str], signals: Sequence[np.ndarray], unit: str) -> tuple[str, ...]:
    """What to say of trials that are the same, or whose means differ by more than a tenth."""
    said = [
        f"{names[i]} and {names[k]} hold the same numbers: give each trial once, or the errors come"
        " out too small"
        for k in range(len(signals))
        for i in range(k)
        if np.array_equal(signals[i], signals[k])
    ]
    means = [abs(float(np.mean(x))) for x in signals]
    low, high = int(np.argmin(means)), int(np.argmax(means))
    if means[high] > UNLIKE * means[low]:
        said.append(
            f"the means of the trials reach from {means[low]:.4g} {unit} ({names[low]}) to"
            f" {means[high]:.4g} {unit} ({names[high]}): are they of one condition, and did the"
            " person tire?"
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
            " without. The model has no drift: remove it first (scipy.signal.detrend, and add the"
            " mean), or choose a steadier window"
        ),
    )
