"""The figure of a cohort: what its data determine, by person, group or level."""

import textwrap
from collections.abc import Collection
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._style import BLUE, GREY, PALETTE, canvas, styled

WAYS = ("person", "group", "level")
WIDTH, HEIGHT, ACROSS = 2.25, 1.8, 2  # inches, inches, panels: legible in a column of 85 mm
LABELLED = 12  # people who get a name on the axis
SHARE = 0.5  # of the targets that must determine a quantity for it to be drawn


@styled
def cohort(
    cohort: Any, by: str = "person", ax: Axes | None = None, *, quantities: Collection[str] | None = None
) -> Figure | SubFigure:
    """Draws what at least half of the targets determine, `by` "person", "group" or "level" (fraction of MVC).

    `quantities`, only these.

    **Raises:** `ValueError` for another `by`, and if there is nothing to draw.
    """
    if by not in WAYS:
        raise ValueError(f"by = {by!r}: choose one of {', '.join(WAYS)}")
    rows = [row for row in cohort.table() if row["stderr"] is not None]
    names = list(dict.fromkeys(row["quantity"] for row in rows if quantities is None or row["quantity"] in quantities))
    enough = SHARE * max(len(cohort.results), 1)
    names = [name for name in names if sum(row["quantity"] == name for row in rows) >= enough]
    if not names:
        raise ValueError("no quantity is determined by at least half of the targets: there is nothing to draw")
    if by == "level" and all(row["mvc_fraction"] is None for row in rows):
        raise ValueError("by = 'level': no target states its mvc_fraction")
    down = -(-len(names) // ACROSS)
    fig = canvas(ax, (WIDTH * ACROSS, HEIGHT * down))
    axes = fig.subplots(down, ACROSS, squeeze=False)
    groups = list(dict.fromkeys(cohort.groups.get(name, "") for name in cohort.results))
    for panel, name in zip(axes.flat, names, strict=False):
        _panel(panel, [row for row in rows if row["quantity"] == name], list(cohort.results), groups, by)
    for panel in axes.flat[len(names) :]:
        panel.remove()
    if len(groups) > 1 and by != "group":
        handles, labels = axes.flat[0].get_legend_handles_labels()
        fig.legend(handles, labels, loc="outside upper right", ncols=len(groups), frameon=False)
    return fig


def _panel(ax: Axes, rows: list[dict[str, Any]], people: list[str], groups: list[str], by: str) -> None:
    for number, group in enumerate(groups):
        here = [row for row in rows if row["group"] == group and (by != "level" or row["mvc_fraction"] is not None)]
        value, error = (np.array([row[key] for row in here], dtype=float) for key in ("value", "stderr"))
        colour = PALETTE[number % len(PALETTE)] if len(groups) > 1 else BLUE
        if by == "person":
            place = np.array([people.index(row["target"]) for row in here], dtype=float)
        elif by == "level":
            place = np.array([100 * row["mvc_fraction"] for row in here], dtype=float)
        else:
            place = number + np.linspace(-0.25, 0.25, len(here)) if len(here) > 1 else np.array([float(number)] * len(here))
            if len(here):
                ax.hlines(value.mean(), number - 0.35, number + 0.35, color=GREY, linewidth=1)
        ax.errorbar(place, value, error, fmt="o", markersize=3.5, capsize=2, linewidth=1, color=colour, label=group or None)
    unit = rows[0]["unit"]
    name = rows[0]["quantity"]
    label = (name if name[1] == "_" else name.replace("_", " ")) + ("" if unit == "1" else f" ({unit})")
    ax.set_ylabel(textwrap.fill(label, 18))
    if by == "group":
        ax.set_xticks(range(len(groups)), [group or "all" for group in groups])
        ax.set_xlim(-0.6, len(groups) - 0.4)
    elif by == "level":
        ax.set_xlabel("Level (% MVC)")
    else:
        ax.set_xlim(-0.5, len(people) - 0.5)
        if len(people) <= LABELLED:
            turned = 35 if len(people) <= 6 else 60
            ax.set_xticks(range(len(people)), people, rotation=turned, ha="right", rotation_mode="anchor")
        else:
            ax.set_xlabel("Target number")
