"""The figure of an identifiability report: what each further measurement leaves of every error."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._numbers import in_words
from ._style import COLUMN, AnyFigure, canvas, finish, styled

TEXT, ROW, HEAD = 0.15, 0.2, 0.5  # inches: a line of words, a row of the table, what is above
NAMES, CELL, WIDEST = 1.3, 0.28, 7.0  # inches: the names of quantities, a column, a page
HIGHEST, COLUMNS = 8.0, 20  # what a page has room for, in inches and columns
LETTERS, LONGEST = 15, 22  # letters to an inch; of a name in one line
# share of the prior's error at which the colours would begin: black is read on all that are left
PALE = -0.6


@styled
def identifiability(report: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws the standard errors that data and prior leave, now and with each further measurement.

    Above them stands how many combinations of parameters are determined. Bold is what is
    determined; the darker a cell, the less is left of the prior's error. The measurements are named
    below. Shares by band are in the printed table alone, and so is what a page has no room for.
    Letters are legible in a column of 85 mm, as far as ten measurements.
    """
    possible = {report.letter(i): d for i, d in enumerate(report.designs) if d.failed is None}
    shown = {"now": report.present, **possible}
    shown = dict([*shown.items()][:COLUMNS])
    width = min(max(COLUMN, NAMES + CELL * len(shown)), WIDEST)
    words = [f"{mark}  {d.name}" for mark, d in shown.items() if mark != "now"]
    lines = [textwrap.fill(each, int(LETTERS * width), subsequent_indent="    ") for each in words]
    below = "\n".join(lines)
    said = TEXT * (1 + below.count("\n"))
    names = [name for name in report.names if not name.startswith("band_")]
    names = names[: int((HIGHEST - said - HEAD) / ROW) - 1]
    heights = [HEAD + ROW * (1 + len(names)), said]
    fig = canvas(ax, heights, width)
    upper, lower = fig.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
    _matrix(upper.add_subplot(), shown, names, report.open_in_fit)
    lower.text(0.02, 1.0, below, va="top", linespacing=1.15, parse_math=False)
    return finish(fig, heights, "" if report.doubt else None, bad=report.doubt, width=width)


def _matrix(ax: Axes, shown: dict[str, Any], names: list[str], doubted: tuple[str, ...]) -> None:
    """Colour: share of the prior's standard deviation that is left. Number: standard error; bold:
    determined.

    In the first column, the present data, that is as the fit has it: what it doubts is not bold.
    """
    outlooks = [*shown.values()]
    left = np.array([[o.quantities[name].left for o in outlooks] for name in names])
    left = np.concatenate([np.ones((1, len(outlooks))), left])
    ax.imshow(np.minimum(left, 1.0), cmap="Blues_r", vmin=PALE, vmax=1.0, aspect="auto")
    labels = [f"combinations (of {outlooks[0].singular_values.size})"]
    for j, outlook in enumerate(outlooks):
        ax.text(j, 0, f"{outlook.determined}", ha="center", va="center", color="black")
    for i, name in enumerate(names, 1):
        unit = ""
        for j, outlook in enumerate(outlooks):
            known = outlook.quantities[name]
            number, _, unit = known.percent.partition(" ")
            sure = known.determined and (j > 0 or name not in doubted)
            weight = "bold" if sure else "normal"
            ax.text(j, i, number, ha="center", va="center", color="black", weight=weight)
        label = textwrap.fill(in_words(name, ""), LONGEST)
        labels.append(label + (f" ({unit})" if unit != "%" else ""))
    ax.set_yticks(range(len(labels)), labels, linespacing=0.9)
    ax.set_xticks(range(len(shown)), [*shown], weight="bold")
    ax.set_xticks(np.arange(len(shown) + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(len(labels) + 1) - 0.5, minor=True)
    ax.grid(which="minor", color="white", lw=1.5)
    ax.tick_params(which="both", length=0)
    ax.tick_params(axis="x", top=True, labeltop=True, bottom=False, labelbottom=False)
    ax.spines[:].set_visible(False)
    ax.set_title("Standard error (%), bold: determined")
