"""The figure of a profile likelihood."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._numbers import unit_in_print
from ._style import BLUE, GREY, ORANGE, Style, axes_or_new, log_axis, styled

SHOWN = 3.0  # times the threshold
# whether the lower and the upper end are open
OPEN = {(True, True): "on both sides", (True, False): "downwards", (False, True): "upwards"}


@styled
def profile(found: Any, ax: Axes | None = None) -> Axes:
    """Draws a profile likelihood with its interval and the parabola of the curvature. Returns the
    axes (`ax` or new)."""
    ax = axes_or_new(ax)
    values, rise, percent = found.values, found.rise, f"{100 * found.level:g} %"
    ax.plot(values, rise, color=BLUE, marker="o", ms=2.5, lw=1.2, label="profile")
    style: Style = {"color": GREY, "lw": 0.8, "ls": (0, (4, 2))}
    ax.axhline(found.threshold, label=f"{percent} threshold", **style)
    for number, (low, high) in enumerate(found.intervals):
        ends = values[0] if low is None else low, values[-1] if high is None else high
        label = None if number else f"{percent} interval"
        ax.axvspan(*ends, color=BLUE, alpha=0.1, lw=0, label=label)
    wide = np.all(values > 0) and values[-1] > 10 * values[0]
    if found.name != "harmonic_frequency":
        x = (np.geomspace if wide else np.linspace)(values[0], values[-1], 200)
        # the curvature of a positive quantity is that of its logarithm
        away = np.log(x / found.value) * found.value if wide else x - found.value
        ax.plot(x, (away / found.stderr) ** 2, color=ORANGE, lw=0.9, label="by curvature")
    top = min(SHOWN * found.threshold, 1.05 * max(float(rise.max()), 1.2 * found.threshold))
    shown = values[np.flatnonzero(_beside(rise <= top))]
    ax.set(ylim=(0, top), xlim=(shown[0], shown[-1]), ylabel="Rise of -2 ln L")
    if wide:
        log_axis(ax)
    ax.set_xlabel(found.name + ("" if found.unit == "1" else f" ({unit_in_print(found.unit)})"))
    ax.set_title(f"{found.target}: profile likelihood", pad=32, parse_math=False)
    side = OPEN.get((found.low is None, found.high is None))
    if side is not None:
        style = {"transform": ax.transAxes, "color": GREY, "ha": "right", "va": "top"}
        ax.text(0.99, 0.97, f"open {side}", **style)
    ax.legend(
        frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.0
    )
    return ax


def _beside(inside: np.ndarray) -> np.ndarray:
    """What is inside, and its neighbours."""
    padded = np.pad(inside, 1)
    return padded[:-2] | inside | padded[2:]
