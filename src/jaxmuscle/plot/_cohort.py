"""The figure of a cohort: what its data determine, by person, group or level."""

import textwrap
from collections import Counter
from collections.abc import Collection
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._numbers import in_words
from ._study import columns, counted, group_spectra
from ._style import (
    BLUE,
    COLUMN,
    GREY,
    LINE,
    PALETTE,
    canvas,
    fitted_to,
    frequency_axis,
    key,
    named,
    styled,
)

WAYS = ("person", "group", "level")
HEIGHT, ACROSS, SPECTRA = 1.6, 2, 2.3  # inches, panels, inches
LABELLED = 12  # people who get a name on the axis
LONGEST = 20  # letters of it
# inches that a letter needs downwards, letters for which there is room anyway
LETTER, FREE = 0.055, 6
ROOM = 16  # letters of all groups' names below a panel; else they stand in a key
SHARE = 0.5  # of the targets that must determine a quantity for it to be drawn


@styled
def cohort(
    cohort: Any,
    by: str = "person",
    ax: Axes | None = None,
    *,
    quantities: Collection[str] | None = None,
) -> Figure | SubFigure:
    """Draws what at least half of the targets determine, `by` "person", "group" or "level"
    (fraction of MVC).

    `quantities`, only these.

    **Raises:** `ValueError` for another `by`, and if there is nothing to draw.
    """
    if by not in WAYS:
        raise ValueError(f"by = {by!r}: choose one of {', '.join(WAYS)}")
    names = _drawn(cohort, quantities)
    if by == "level" and all(
        result.target.mvc_fraction is None for result in cohort.results.values()
    ):
        raise ValueError("by = 'level': no target states its mvc_fraction")
    height = (HEIGHT + (_below(cohort) if by == "person" else 0.0)) * -(-len(names) // ACROSS)
    fig = canvas(ax, (COLUMN, height))
    _panels(fig, cohort, names, by)
    if len(_groups(cohort)) > 1 and not (by == "group" and _short(_groups(cohort))):
        fitted_to(fig, height, key(fig, columns(_groups(cohort)), plain=True))
    return fig


@styled
def groups(
    cohort: Any, ax: Axes | None = None, *, quantities: Collection[str] | None = None
) -> Figure | SubFigure:
    """Draws the spectra of the groups of a cohort, and what the fits found by group.

    Above: every target (thin), the geometric mean of each group with its standard error (thick).
    Below: what at least half of the targets determine, with standard errors; the grey line is the
    mean of the group. `quantities`, only these. Where the targets differ in their bins, their
    spectra have no mean and are left out.

    **Raises:** `ValueError` if nothing is determined by half of the targets.
    """
    names = _drawn(cohort, quantities)
    targets = {name: result.target for name, result in cohort.results.items()}
    alike = len({tuple(target.frequency) for target in targets.values()}) == 1
    numbers = Counter(cohort.groups.get(name, "") for name in targets)
    labels = {group: counted(group, numbers[group]) for group in _groups(cohort)}
    across = columns([*labels.values()])
    spelled = alike or not _short(_groups(cohort))  # a key, below the spectra or else below all
    heights = [SPECTRA] * alike + [HEIGHT * -(-len(names) // ACROSS)]
    heights[0] += (0.2 + LINE * -(-len(labels) // across)) * spelled
    fig = canvas(ax, (COLUMN, sum(heights)))
    places = fig.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    if alike:
        panel = places[0].add_subplot()
        for number, group in enumerate(_groups(cohort)):
            here = [
                target for name, target in targets.items() if cohort.groups.get(name, "") == group
            ]
            group_spectra(panel, here, PALETTE[number % len(PALETTE)], labels[group], True)
        frequency_axis(panel, log=True)
        panel.set_ylabel("Power (fraction per bin)")
    _panels(places[-1], cohort, names, "group")
    if spelled:
        key(places[0], across, plain=True)
    return fig


def _groups(cohort: Any) -> list[str]:
    return list(dict.fromkeys(cohort.groups.get(name, "") for name in cohort.results))


def _short(groups: list[str]) -> bool:
    """Whether their names have room below a panel."""
    return len(groups) * max(len(group or "all") for group in groups) <= ROOM


def _below(cohort: Any) -> float:
    """How much higher [inches] long names make a panel."""
    longest = max(len(named(name, LONGEST)) for name in cohort.results)
    return max(0.0, LETTER * (longest - FREE)) if len(cohort.results) <= LABELLED else 0.0


def _drawn(cohort: Any, quantities: Collection[str] | None) -> dict[str, list[dict[str, Any]]]:
    """The rows of every quantity that at least half of the targets determine."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in cohort.table():
        name = row["quantity"]
        # the bands of the fit repeat the measured shares
        asked = not name.startswith("band_") if quantities is None else name in quantities
        if row["stderr"] is not None and asked:
            found.setdefault(row["quantity"], []).append(row)
    enough = SHARE * max(len(cohort.results), 1)
    found = {name: rows for name, rows in found.items() if len(rows) >= enough}
    if not found:
        raise ValueError(
            "no quantity is determined by at least half of the targets: there is nothing to draw"
        )
    return found


def _panels(fig: Any, cohort: Any, names: dict[str, list[dict[str, Any]]], by: str) -> None:
    axes = fig.subplots(-(-len(names) // ACROSS), ACROSS, squeeze=False)
    for panel, rows in zip(axes.flat, names.values(), strict=False):
        _panel(panel, rows, list(cohort.results), _groups(cohort), by)
    for panel in axes.flat[len(names) :]:
        panel.remove()
    fig.align_ylabels()


def _panel(
    ax: Axes, rows: list[dict[str, Any]], people: list[str], groups: list[str], by: str
) -> None:
    for number, group in enumerate(groups):
        here = [
            row
            for row in rows
            if row["group"] == group and (by != "level" or row["mvc_fraction"] is not None)
        ]
        value, error = (
            np.array([row[key] for row in here], dtype=float) for key in ("value", "stderr")
        )
        colour = PALETTE[number % len(PALETTE)] if len(groups) > 1 else BLUE
        if by == "person":
            place = np.array([people.index(row["target"]) for row in here], dtype=float)
        elif by == "level":
            place = np.array([100 * row["mvc_fraction"] for row in here], dtype=float)
        else:
            place = (
                number + np.linspace(-0.25, 0.25, len(here))
                if len(here) > 1
                else np.array([float(number)] * len(here))
            )
            if len(here):
                ax.hlines(value.mean(), number - 0.35, number + 0.35, color=GREY, linewidth=1)
        label = named(group, 2 * LONGEST) or None
        ax.errorbar(
            place,
            value,
            error,
            fmt="o",
            markersize=3.5,
            capsize=2,
            linewidth=1,
            color=colour,
            label=label,
        )
    ax.set_ylabel(textwrap.fill(in_words(rows[0]["quantity"], rows[0]["unit"]), 18))
    if by == "group":
        ax.set_xticks(range(len(groups)) if _short(groups) else [])
        if _short(groups):
            ax.set_xticklabels(
                [named(group, LONGEST) or "all" for group in groups], parse_math=False
            )
        ax.set_xlim(-0.6, len(groups) - 0.4)
    elif by == "level":
        ax.set_xlabel("Level (% MVC)")
    else:
        ax.set_xlim(-0.5, len(people) - 0.5)
        if len(people) <= LABELLED:
            turned = 35 if len(people) <= 6 else 60
            labels = [named(name, LONGEST) for name in people]
            ax.set_xticks(
                range(len(people)),
                labels,
                rotation=turned,
                ha="right",
                rotation_mode="anchor",
                parse_math=False,
            )
        else:
            ax.set_xlabel("Target number")
