"""What the parts of the model hold of the fitted power: in the figure of a fit, and as a figure of
its own."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxmuscle._common.text import choices

from ._spectra import target as draw_target
from ._style import BLUE, GREEN, ORANGE, PURPLE, SKY, axes_or_new, log_axis, styled

PARTS = {
    "floor": ("0.75", "floor"),
    "relaxation": (SKY, "relaxation"),
    "harmonic": (ORANGE, "harmonic"),
    "resonance": (GREEN, "resonance (all bins)"),
    "resonance_2": (PURPLE, "resonance 2 (all bins)"),
}
RHYTHMS = {
    "harmonic": "harmonic",
    "resonance": "resonance in the drive",
    "resonance_2": "resonance 2 in the drive",
}
LEAST = 1e-4  # share of the power below which a part is not drawn
DECADE = 10.0  # by which a part may lie below the spectrum to be seen


def parts_of_power(ax: Axes, part: Any, *, log: bool, named: bool = True) -> None:
    """One area upon the other, which add up to the fit; over a logarithmic axis a line for each."""
    frequency, fitted = np.asarray(part.frequency_hz), np.asarray(part.fitted)
    below = np.zeros(len(fitted))
    for name, (color, words) in PARTS.items():
        power = _power_of(part, name)
        total = float(np.sum(power))
        if not total > LEAST:
            continue
        label = (
            f"{words}, {'<1' if total < 0.01 else f'{100 * total:.0f}'} % of power"
            if named
            else None
        )
        if log:
            ax.plot(
                frequency,
                np.where(power > 0, power, np.nan),
                color=color,
                lw=1.0,
                zorder=3,
                label=label,
            )
            continue
        ax.fill_between(
            frequency, below, below + power, color=color, alpha=0.7, lw=0, zorder=2, label=label
        )
        below = below + power


def lowest(part: Any, seen: float) -> float:
    """How far a logarithmic axis goes down from `seen`, the least power: all parts show, at most a
    decade below."""
    powers = [_power_of(part, name) for name in PARTS]
    peaks = [float(np.max(power)) / 2 for power in powers if float(np.sum(power)) > LEAST]
    return max(min([seen, *peaks]), seen / DECADE)


def rhythms(ax: Axes, part: Any) -> None:
    """Marks the frequency of every rhythm that has power: of a resonance that in the drive, above
    its hill in the force."""
    resonances = [noise for noise in part.task.noise.components if noise.sort == "resonance"]
    for (name, words), rhythm in zip(
        RHYTHMS.items(), (part.task.harmonic, *resonances), strict=False
    ):
        if np.sum(_power_of(part, name)) > LEAST:
            where = float(rhythm.frequency)
            mark(ax, part, where, PARTS[name][0], f"{words}: {where:.2f} Hz")


def mark(ax: Axes, part: Any, where: float, color: str, label: str) -> None:
    """A triangle at the foot of the axes and a dashed line; of a frequency outside the bins the
    label alone."""
    frequency = np.asarray(part.frequency_hz)
    inside = frequency[0] / 2 <= where <= frequency[-1] * 1.05
    ax.plot(
        [where] if inside else [],
        [0.03] if inside else [],
        color=color,
        marker="^",
        ms=5,
        lw=0,
        label=label,
        transform=ax.get_xaxis_transform(),
        clip_on=False,
        zorder=5,
    )
    if inside:
        ax.axvline(where, color=color, lw=0.8, ls=(0, (4, 2)), zorder=0)


def _power_of(part: Any, name: str) -> Any:
    """What a part of the model holds of every bin's fitted power."""
    return np.asarray(part.fitted) * np.maximum(part.components.get(name, 0.0), 0.0)


@styled
def components(
    result: Any, ax: Axes | None = None, target: str | None = None, *, log: bool = True
) -> Axes:
    """Draws what the parts of the model hold of the fitted power: they add up to the fit.

    The floor is from noise on the passive tissue, the relaxation from noise on the active one.
    Harmonic, resonance and second resonance are drawn where the model has them. Those of the two
    resonances hold all of their power, also that far below their peaks; a result's
    `resonance_share` counts from half its frequency on.

    **Arguments:**

    - `result`: what `jaxmuscle.fit` returns
    - `ax`: or a new figure
    - `target`: which of several
    - `log`: both axes logarithmic with a line for each part, else areas upon each other

    **Returns:** the axes.

    **Raises:** `ValueError` for an unknown target, and where the parts are not known (no spectrum,
    or no linear response).
    """
    if target is not None and target not in result.parts:
        raise ValueError(f"target = {target!r}: {choices(target, result.parts)}")
    if target is None and len(result.parts) > 1:
        raise ValueError(f"a fit of several targets: give target= one of {', '.join(result.parts)}")
    part = next(iter(result.parts.values())) if target is None else result.parts[target]
    if not part.components:
        raise ValueError(
            f"{part.target.name}: the parts of the power are not known: the fit has no linear"
            " response, or the target no spectrum"
        )
    ax = axes_or_new(ax)
    draw_target(part.target, ax, log=log)
    dots, fitted = ax.lines[0], np.asarray(part.fitted)
    dots.set(label="data", linewidth=0.0)
    ax.plot(part.frequency_hz, fitted, color=BLUE, label="fit", zorder=4)
    parts_of_power(ax, part, log=log)
    if log:
        seen = np.concatenate([fitted, part.target.proportional_power])
        ax.set_ylim(seen[seen > 0].min() / DECADE, 1.5 * seen.max())
        log_axis(ax, "y")
    ax.set_title(part.target.name, parse_math=False)
    ax.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2, frameon=False, columnspacing=1.2
    )
    return ax
