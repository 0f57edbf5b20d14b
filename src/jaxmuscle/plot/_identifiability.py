"""The figure of an identifiability report: singular values, and what each further measurement
leaves of every error."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._style import (
    BLUE,
    COLUMN,
    GREY,
    VERMILLION,
    AnyFigure,
    Style,
    canvas,
    finish,
    log_axis,
    shade,
    styled,
)

TEXT, DOTS, ROW = 0.14, 0.15, 0.2  # inches: a line of words, its dots, a row of the table
NAMES, CELL = 1.3, 0.28  # inches: the names of quantities, the narrowest column
LEAST, EDGE = 1e-2, 5e-3
WRAP, WIDEST = 60, 20  # letters
# share of the prior's error at which the colours would begin: black is read on all that are left
PALE = -0.6


@styled
def identifiability(report: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws singular values and standard errors, now and with each further measurement.

    Above, the singular values of the Jacobian, one for each direction of the parameters: filled
    where the data determine it, open where they do not. Values that are smaller than the axis are
    counted at its left end. Below, the standard errors that data and prior leave; those of the
    shares by band are in the table alone. Letters are legible in a column of 85 mm, as far as ten
    measurements.
    """
    possible = {report.letter(i): d for i, d in enumerate(report.designs) if d.failed is None}
    shown, marks = [report.present, *possible.values()], ["now", *possible]
    labels = [textwrap.fill(f"{mark}: {d.name}", WRAP) for mark, d in possible.items()]
    labels = ["now", *labels]
    lines = sum(label.count("\n") + 1 for label in labels)
    names = [
        name for name in report.names if not name.startswith("band_")
    ]  # these are in the table
    heights = [0.7 + TEXT * lines + DOTS * len(shown), 1.1 + ROW * len(names)]
    width = max(COLUMN, NAMES + CELL * len(shown))
    fig = canvas(ax, heights, width)
    upper, lower = fig.subfigures(2, 1, squeeze=False, height_ratios=heights)[:, 0]
    _singular_values(upper.add_subplot(), shown, labels, report.threshold)
    _matrix(lower.add_subplot(), shown, marks, names, report.open_in_fit)
    return finish(fig, heights, report.target, bad=report.doubt, columns=3, width=width)


def _singular_values(ax: Axes, shown: list[Any], labels: list[str], threshold: float) -> None:
    """Words and a row of dots for each design: filled where determined, counted at the edge where
    smaller than the axis."""
    ax.axvspan(EDGE, threshold, color=shade(0.06), lw=0, zorder=0)
    words: dict[str, Any] = {
        "transform": ax.get_yaxis_transform(),
        "va": "top",
        "linespacing": 1.05,
    }
    open_: Style = {"facecolor": "none", "edgecolor": VERMILLION}
    row, top = 0.0, max(float(o.singular_values.max()) for o in shown)
    for outlook, label in zip(shown, labels, strict=True):
        size = outlook.singular_values
        known, tiny = size >= threshold, size < LEAST
        at = row + TEXT * (label.count("\n") + 1) + 0.35 * DOTS
        ax.text(0.0, row, label, **words)
        ax.text(1.0, row, f"{known.sum()} of {len(size)}", ha="right", **words)
        ax.axhline(at, color=shade(0.2), lw=0.5, zorder=0)
        # not through the words
        ax.vlines(threshold, at - 0.5 * DOTS, at + 0.5 * DOTS, color=GREY, lw=0.8, zorder=1)
        for which, name, style in (
            (known, "determined", {"color": BLUE}),
            (~known & ~tiny, "not determined", open_),
        ):
            places = np.full(which.sum(), at)
            ax.scatter(size[which], places, s=18, label=name, zorder=3, **style)
        if tiny.any():
            style: Style = {"marker": "<", "label": f"how many below {LEAST:g}"} | open_
            ax.scatter([1.15 * EDGE], [at], s=18, zorder=3, **style)
            ax.text(1.35 * EDGE, at, f"{tiny.sum()}", va="center", color=VERMILLION, zorder=3)
        row = at + 0.65 * DOTS
    right = 1.6 * max(EDGE, threshold, top)
    ax.set(xlim=(EDGE, right), ylim=(row + 0.02, -0.02), yticks=[])
    log_axis(ax)
    ax.set_xlabel("Singular value (per prior standard deviation)")
    ax.set_title(f"Combinations of parameters: determined from {threshold:g} on")
    ax.spines["left"].set_visible(False)


def _matrix(
    ax: Axes, shown: list[Any], marks: list[str], names: list[str], doubted: tuple[str, ...]
) -> None:
    """Colour: share of the prior's standard deviation that is left. Number: standard error; bold:
    determined.

    In the first column, the present data, that is as the fit has it: what it doubts is not bold.
    """
    left = np.array([[o.quantities[name].left for o in shown] for name in names])
    mesh = ax.imshow(np.minimum(left, 1.0), cmap="Blues_r", vmin=PALE, vmax=1.0, aspect="auto")
    labels = []
    for i, name in enumerate(names):
        unit = ""
        for j, outlook in enumerate(shown):
            known = outlook.quantities[name]
            number, _, unit = known.percent.partition(" ")
            sure = known.determined and (j > 0 or name not in doubted)
            weight = "bold" if sure else "normal"
            ax.text(j, i, number, ha="center", va="center", color="black", weight=weight)
        labels.append(_wrapped(name) + (f" ({unit})" if unit != "%" else ""))
    ax.set_yticks(range(len(names)), labels, linespacing=0.9)
    ax.set_xticks(range(len(shown)), marks, weight="bold", linespacing=0.95)
    ax.set_xticks(np.arange(len(shown) + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(len(names) + 1) - 0.5, minor=True)
    ax.grid(which="minor", color="white", lw=1.5)
    ax.tick_params(which="both", length=0)
    ax.tick_params(axis="x", top=True, labeltop=True, bottom=False, labelbottom=False)
    ax.spines[:].set_visible(False)
    ax.set_title("Standard error (%), bold: determined")
    bar = ax.figure.colorbar(mesh, ax=ax, location="bottom", fraction=0.04, pad=0.02, aspect=40)
    bar.ax.set_xlim(0, 1)
    bar.set_label("Share of the prior's error that is left")
    bar.outline.set_visible(False)


def _wrapped(name: str) -> str:
    """A long name in two lines, parted after one of its words."""
    if len(name) <= WIDEST:
        return name
    cut = name.rfind("_", 0, WIDEST) + 1
    return f"{name[:cut]}\n{name[cut:]}" if cut else name
