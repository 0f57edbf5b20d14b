"""The figure of a designed motion of the insertion."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._style import BLUE, COLUMN, GREY, ORANGE, canvas, fitted_to, key, log_axis, shade, styled

SHOWN = 20.0  # s
HEIGHTS, ROW = (1.7, 1.5), 0.2  # inches
LEAST = 2.0  # densities that differ by less are shown as even
NOW, FLAT, DESIGNED = "now, without this record", "flat motion", "designed motion"


@styled
def designed_input(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a designed motion: its density, its beginning, and the standard errors that are
    expected with it.

    The flat motion beside it has the same density at all frequencies of the band, and is as large
    as the same limits allow; it stands alone where the motion is flat itself. A dashed line is the
    error that was asked for. Errors are in percent of the value, of one record. Letters are legible
    in a column of 85 mm.
    """
    heights = HEIGHTS[0], HEIGHTS[1], 0.75 + ROW * len(found.told)
    fig = canvas(ax, (COLUMN, sum(heights)))
    density, motion, errors = fig.subplots(3, 1, height_ratios=heights)
    _density(density, found)
    shown = found.time <= SHOWN
    motion.plot(found.time[shown], 1e3 * found.displacement[shown], color=BLUE, lw=0.9)
    motion.axhline(0, color=GREY, lw=0.5)
    motion.set(
        xlabel="Time (s)",
        ylabel="Lengthening (mm)",
        xlim=(0, min(SHOWN, found.lengthening.seconds)),
    )
    name = _label(found).capitalize()
    motion.set_title(f"{name}, its first {SHOWN:g} s" if found.time[-1] > SHOWN else name)
    _errors(errors, found)
    fig.align_ylabels([density, motion])
    fitted_to(fig, sum(heights), key(fig, 3))
    return fig


def _label(found: Any) -> str:
    return DESIGNED if found.moves else FLAT


def _density(ax: Axes, found: Any) -> None:
    for lines, colour, label in [(found.even, GREY, FLAT)] * bool(found.moves) + [
        (found.lengthening, BLUE, _label(found))
    ]:
        ax.step(
            found.frequency,
            1e6 * lines.power * lines.seconds,
            where="mid",
            color=colour,
            lw=1.2,
            label=label,
        )
    log_axis(ax)
    low, high = ax.dataLim.intervaly
    if high < LEAST * low:
        ax.set_ylim(low / LEAST, high * LEAST)
    log_axis(ax, "y")
    ax.set(xlabel="Frequency (Hz)", ylabel="Density (mm²/Hz)", title="Motion of the insertion")


def _errors(ax: Axes, found: Any) -> None:
    """A row for each quantity, a mark for each way to measure it."""
    names = found.told
    flat = [(found.flat, GREY, "s", FLAT)] * bool(found.moves)
    for known, colour, marker, label in [
        (found.now, ORANGE, "D", NOW),
        *flat,
        (found.stderr, BLUE, "o", _label(found)),
    ]:
        size = [found.percent(name, known) for name in names]
        ax.plot(size, np.arange(len(names)), marker, ms=4.5, color=colour, label=label, zorder=3)
    if found.needed is not None:
        ax.axvline(
            100 * found.needed[0], color=shade(0.6), lw=0.8, ls="--", label="error asked for"
        )
    ax.set_yticks(range(len(names)), names)
    ax.set_ylim(len(names) - 0.4, -0.6)
    log_axis(ax)
    ax.grid(axis="both", color=shade(0.15), lw=0.5)
    ax.set(xlabel="Standard error (% of the value)")
    ax.set_title(f"Expected errors, one record of {found.lengthening.seconds:g} s")
