"""The figures of profile likelihoods, one or several."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._numbers import unit_in_print
from ._style import (
    BLUE,
    COLUMN,
    GREY,
    ORANGE,
    axes_or_new,
    canvas,
    fitted_to,
    heading,
    key,
    log_axis,
    styled,
    without_legend,
)

SHOWN = 3.0  # times the threshold
HEIGHT, ACROSS = 1.7, 2  # inches, panels


@styled
def profile(found: Any, ax: Axes | None = None) -> Axes:
    """Draws a profile likelihood with its interval and the parabola of the curvature. Returns the
    axes (`ax` or new)."""
    ax = axes_or_new(ax)
    ax.plot(found.values, found.rise, color=BLUE, marker="o", ms=2.5, lw=1.2, label="profile")
    ax.axhline(
        found.threshold,
        color=GREY,
        lw=0.8,
        ls=(0, (4, 2)),
        label=f"{100 * found.level:g} % threshold",
    )
    for number, (low, high) in enumerate(found.intervals):
        ends = found.values[0] if low is None else low, found.values[-1] if high is None else high
        ax.axvspan(
            *ends,
            color=BLUE,
            alpha=0.1,
            lw=0,
            label=f"{100 * found.level:g} % interval" if not number else None,
        )
    wide = np.all(found.values > 0) and found.values[-1] > 10 * found.values[0]
    if wide:
        x = np.geomspace(found.values[0], found.values[-1], 200)
        parabola = (np.log(x / found.value) * found.value / found.stderr) ** 2
    else:
        x = np.linspace(found.values[0], found.values[-1], 200)
        parabola = ((x - found.value) / found.stderr) ** 2
    top = min(SHOWN * found.threshold, 1.05 * max(float(found.rise.max()), 1.2 * found.threshold))
    if found.name != "harmonic_frequency":
        ax.plot(x, parabola, color=ORANGE, lw=0.9, label="by curvature")
    seen = found.values[np.flatnonzero(_beside(found.rise <= top))]
    ax.set(ylim=(0, top), xlim=(seen[0], seen[-1]), ylabel="Rise of -2 ln L")
    if wide:
        log_axis(ax)
    ax.set_xlabel(found.name + ("" if found.unit == "1" else f" ({unit_in_print(found.unit)})"))
    ax.set_title(f"{found.target}: profile likelihood", pad=32, parse_math=False)
    if found.low is None or found.high is None:
        side = (
            "on both sides"
            if found.low is found.high
            else "downwards"
            if found.low is None
            else "upwards"
        )
        ax.text(
            0.99, 0.97, f"open {side}", transform=ax.transAxes, color=GREY, ha="right", va="top"
        )
    ax.legend(
        frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, borderaxespad=0.0
    )
    return ax


@styled
def profiles(profiles: Sequence[Any], ax: Axes | None = None) -> Figure | SubFigure:
    """Draws several `profiles` of one fit beside each other, each as `profile` does, with one
    legend; `ax`, their place.

    Returns the figure. Raises `ValueError` where there is none.
    """
    if not profiles:
        raise ValueError("profiles: is empty; give [jm.profile(result, name) for name in ...]")
    columns = min(len(profiles), ACROSS)
    rows = -(-len(profiles) // columns)
    fig = canvas(ax, (COLUMN, HEIGHT * rows))
    for number, found in enumerate(profiles, start=1):
        panel = profile(found, fig.add_subplot(rows, columns, number))
        panel.set_title("")
        panel.set_ylabel("Rise of -2 ln L")
        without_legend(panel)
    fitted_to(fig, HEIGHT * rows, heading(fig, profiles[0].target) + key(fig))
    return fig


def _beside(inside: np.ndarray) -> np.ndarray:
    """What is inside, and its neighbours."""
    padded = np.pad(inside, 1)
    return padded[:-2] | inside | padded[2:]
