"""The figure of a designed motion of the insertion."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._style import BLUE, GREY, ORANGE, canvas, log_axis, styled

SHOWN = 20.0  # s


@styled
def designed_input(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the density of a designed motion, its beginning, and the errors that are expected."""
    fig = canvas(ax, (7.2, 4.6))
    density, errors, motion = fig.subplot_mosaic([["density", "errors"], ["motion", "motion"]]).values()
    f = found.frequency
    for lines, colour, label in ((found.even, GREY, "flat"), (found.lengthening, BLUE, "designed")):
        density.step(f, 1e6 * lines.power * lines.seconds, where="mid", color=colour, lw=1.2, label=label)
    density.set_yscale("log")
    log_axis(density)
    density.set(xlabel="Frequency (Hz)", ylabel="Density (mm²/Hz)", title="Motion of the insertion")
    density.legend(frameon=False)
    names = found.told
    place = np.arange(len(names))
    for i, (known, colour, label) in enumerate(((found.now, ORANGE, "now"), (found.flat, GREY, "flat"),
                                                (found.stderr, BLUE, "designed"))):  # fmt: skip
        size = [found.percent(name, known) for name in names]
        bars = errors.bar(place + 0.27 * (i - 1), size, 0.25, color=colour, label=label)
        errors.bar_label(bars, [f"{x:.2g}" for x in size], fontsize=6.5, padding=1)
    errors.set_yscale("log")
    errors.set_xticks(place, names)
    errors.set_ylim(0.5 * errors.get_ylim()[0], 8 * errors.get_ylim()[1])
    errors.set(ylabel="Standard error (%)", title=f"Expected of one record of {found.lengthening.seconds:g} s")
    errors.legend(frameon=False, ncols=3, loc="upper center", columnspacing=1.0)
    shown = found.time <= SHOWN
    motion.plot(found.time[shown], 1e3 * found.displacement[shown], color=BLUE, lw=0.9)
    motion.axhline(0, color=GREY, lw=0.5)
    motion.set(xlabel="Time (s)", ylabel="Lengthening (mm)", xlim=(0, min(SHOWN, found.lengthening.seconds)))
    return fig
