"""The figure of an identifiability report: singular values, and what each further measurement leaves of every error."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ._style import BLACK, BLUE, GREY, VERMILLION, canvas, styled

WIDTH, ROW = 7.5, 0.21  # inches
LEAST, EDGE = 1e-2, 5e-3
WRAP = 46
PAIRS = 3


@styled
def identifiability(report: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws singular values and standard errors, now and with each further measurement."""
    letters = {d.name: report.letter(i) for i, d in enumerate(report.designs)}
    shown = [report.present, *(d for d in report.designs if d.failed is None), *report.telling_pairs[:PAIRS]]
    marks = ["now", *(" + ".join(letters[name] for name in o.name.split(report.together)) for o in shown[1:])]
    names = report.told
    rows = [_label(mark, o.name) for mark, o in zip(marks, shown, strict=True)]
    lines = sum(row.count("\n") + 1.35 for row in rows)
    heights = [0.15 * lines + 0.2, ROW * len(names) + 0.1]
    fig = canvas(ax, (WIDTH, sum(heights) + 1.6), h_pad=0.08)
    upper, lower = fig.subplots(2, 1, height_ratios=heights)
    fig.suptitle(f"{report.target}: what the data determine, and what more would", x=0.01, ha="left", weight="bold", size=10)
    _singular_values(upper, shown, rows, report.threshold)
    _matrix(lower, shown, marks, names)
    return fig


def _label(mark: str, name: str) -> str:
    if mark == "now" or " + " in mark:
        return mark
    return "\n".join(textwrap.wrap(f"{mark}: {name}", WRAP, break_long_words=False))


def _singular_values(ax: Axes, shown: list[Any], labels: list[str], threshold: float) -> None:
    """One row for each design: filled where determined; what is smaller than the axis is counted at its edge."""
    largest = max(float(o.singular_values.max()) for o in shown)
    ax.axvspan(EDGE, threshold, color="0.94", lw=0, zorder=0)
    ax.axvline(threshold, color=GREY, lw=0.8, zorder=1)
    for row, outlook in enumerate(shown):
        size = outlook.singular_values
        known, tiny = size >= threshold, size < LEAST
        ax.axhline(row, color="0.85", lw=0.5, zorder=0)
        ax.scatter(size[known], np.full(known.sum(), row), s=26, color=BLUE, zorder=3)
        some = ~known & ~tiny
        ax.scatter(size[some], np.full(some.sum(), row), s=26, facecolor="white", edgecolor=VERMILLION, zorder=3)
        if tiny.any():
            style: dict[str, Any] = {"va": "center", "ha": "left", "size": 7, "zorder": 3}
            ax.text(EDGE * 1.1, row, f"◂ {tiny.sum()}", color=VERMILLION, **style)
        ax.text(1.01, row, f"{known.sum()} of {len(size)}", transform=ax.get_yaxis_transform(), va="center", size=7.5)
    ax.set_xscale("log")
    ax.set(xlim=(EDGE, max(largest, threshold) * 1.6), ylim=(len(shown) - 0.4, -0.6))
    ax.set_yticks(range(len(shown)), labels)
    ax.tick_params(axis="y", length=0)
    ax.xaxis.set_major_locator(LogLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("Singular value (per prior standard deviation)")
    ax.set_title(f"Directions of the parameters: determined from {threshold:g} on")
    ax.spines["left"].set_visible(False)


def _matrix(ax: Axes, shown: list[Any], marks: list[str], names: list[str]) -> None:
    """Colour: share of the prior's standard deviation that is left. Number: standard error; bold: determined."""
    left = np.array([[o.quantities[name].left for o in shown] for name in names])
    mesh = ax.imshow(np.minimum(left, 1.0), cmap="Blues_r", vmin=-0.35, vmax=1.0, aspect="auto")
    for i, name in enumerate(names):
        for j, outlook in enumerate(shown):
            known = outlook.quantities[name]
            weight, colour = ("bold", "white" if left[i, j] < 0.4 else BLACK) if known.determined else ("normal", "0.35")
            ax.text(j, i, known.percent, ha="center", va="center", size=7, color=colour, weight=weight)
    ax.set_yticks(range(len(names)), names)
    ax.set_xticks(range(len(shown)), marks, weight="bold")
    ax.set_xticks(np.arange(len(shown) + 1) - 0.5, minor=True)
    ax.set_yticks(np.arange(len(names) + 1) - 0.5, minor=True)
    ax.grid(which="minor", color="white", lw=1.5)
    ax.tick_params(which="both", length=0)
    ax.tick_params(axis="x", top=True, labeltop=True, bottom=False, labelbottom=False)
    ax.spines[:].set_visible(False)
    ax.set_title("Standard error by data and prior (bold: determined)")
    bar = ax.figure.colorbar(mesh, ax=ax, fraction=0.04, pad=0.015, aspect=30)
    bar.ax.set_ylim(0, 1)
    bar.set_label("share of the prior's error that is left")
    bar.outline.set_visible(False)
