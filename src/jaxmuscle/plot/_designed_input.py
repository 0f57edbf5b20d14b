"""The figure of a designed motion of the insertion."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._style import BLUE, GREY, ORANGE, AnyFigure, finish, log_axis, panels, shade, styled

SHOWN = 20.0  # s
HEIGHTS, ROW = (1.7, 1.5), 0.2  # inches
LEAST = 2.0  # densities that differ by less are shown as even
NOW, FLAT, DESIGNED = "now, without this record", "flat motion", "designed motion"


@styled
def designed_input(found: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws a designed motion: its density, its beginning, and the standard errors that are
    expected with it.

    The flat motion beside it has the same density at all frequencies of the band, and is as large
    as the same limits allow; it stands alone where the motion is flat itself. A dashed line is the
    error that was asked for. Errors are in percent of the value, of one record. Letters are legible
    in a column of 85 mm.
    """
    heights = *HEIGHTS, 0.75 + ROW * len(found.names)
    fig, (density, motion, errors) = panels(ax, "A;B;C", heights)
    name = DESIGNED if found.moves else FLAT
    # lines of a motion, what is known with it, and how they are drawn
    motions = [(found.even, found.flat, GREY, "s", FLAT)] * bool(found.moves)
    motions += [(found.lengthening, found.stderr, BLUE, "o", name)]
    _density(density, found, motions)
    shown = found.time <= SHOWN
    motion.plot(found.time[shown], 1e3 * found.displacement[shown], color=BLUE, lw=0.9)
    motion.axhline(0, color=GREY, lw=0.5)
    motion.set(
        xlabel="Time (s)",
        ylabel="Lengthening (mm)",
        xlim=(0, min(SHOWN, found.lengthening.seconds)),
        title=name.capitalize() + f", its first {SHOWN:g} s" * bool(found.time[-1] > SHOWN),
    )
    _errors(errors, found, [(None, found.now, ORANGE, "D", NOW), *motions])
    fig.align_ylabels([density, motion])
    return finish(fig, heights, columns=3)


def _density(ax: Axes, found: Any, motions: list[Any]) -> None:
    for lines, _, colour, _, label in motions:
        density = 1e6 * lines.power * lines.seconds
        ax.step(found.frequency, density, where="mid", color=colour, lw=1.2, label=label)
    log_axis(ax)
    low, high = ax.dataLim.intervaly
    if high < LEAST * low:
        ax.set_ylim(low / LEAST, high * LEAST)
    log_axis(ax, "y")
    ax.set(xlabel="Frequency (Hz)", ylabel="Density (mm²/Hz)", title="Motion of the insertion")


def _errors(ax: Axes, found: Any, ways: list[Any]) -> None:
    """A row for each quantity, a mark for each way to measure it."""
    names = found.names
    for _, known, colour, marker, label in ways:
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
