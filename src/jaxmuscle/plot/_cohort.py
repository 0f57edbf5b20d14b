"""The figure of a cohort: what its data determine, by person, group or level."""

import textwrap
from collections.abc import Collection
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._numbers import in_words
from ._study import columns, group_spectra, with_count
from ._style import (
    BLUE,
    GREY,
    LINE,
    PALETTE,
    PER_BIN,
    AnyFigure,
    canvas,
    fit_height,
    frequency_axes,
    key,
    panel_grid,
    rows_for,
    shorten,
    styled,
)

WAYS = ("person", "group", "level")
HEIGHT, SPECTRA = 1.6, 2.3  # inches
LABELLED = 12  # people who get a name on the axis
LONGEST = 20  # letters of it
# inches that a letter needs downwards, letters for which there is room anyway
LETTER, FREE = 0.055, 6
ROOM = 16  # letters of all groups' names below a panel; else they stand in a key
Rows = list[dict[str, Any]]
SHARE = 0.5  # of the targets that must determine a quantity for it to be drawn


@styled
def cohort(
    cohort: Any,
    by: str = "person",
    ax: Axes | None = None,
    *,
    quantities: Collection[str] | None = None,
) -> AnyFigure:
    """Draws what at least half of the targets determine, `by` "person", "group" or "level"
    (fraction of MVC).

    `quantities`, only these.

    **Raises:** `ValueError` for another `by`, and if there is nothing to draw.
    """
    if by not in WAYS:
        raise ValueError(f"by = {by!r}: choose one of {', '.join(WAYS)}")
    names = _rows_to_draw(cohort, quantities)
    if by == "level" and all(
        result.target.mvc_fraction is None for result in cohort.results.values()
    ):
        raise ValueError("by = 'level': no target states its mvc_fraction")
    heights = [HEIGHT + (_below(cohort) if by == "person" else 0.0)] * rows_for(len(names))
    fig = canvas(ax, heights)
    _panels(fig, cohort, names, by)
    groups = _groups(cohort)
    if len(groups) > 1 and not (by == "group" and _short(groups)):
        fit_height(fig, heights, key(fig, columns(groups), plain=True))
    return fig


@styled
def groups(
    cohort: Any, ax: Axes | None = None, *, quantities: Collection[str] | None = None
) -> AnyFigure:
    """Draws the spectra of the groups of a cohort, and what the fits found by group.

    Above: every target (thin), the geometric mean of each group with its standard error (thick).
    Below: what at least half of the targets determine, with standard errors; the grey line is the
    mean of the group. `quantities`, only these. Where the targets differ in their bins, their
    spectra have no mean and are left out.

    **Raises:** `ValueError` if nothing is determined by half of the targets.
    """
    names = _rows_to_draw(cohort, quantities)
    here: dict[str, list[Any]] = {group: [] for group in _groups(cohort)}
    for name, result in cohort.results.items():
        here[cohort.groups.get(name, "")].append(result.target)
    alike = len({tuple(target.frequency) for some in here.values() for target in some}) == 1
    labels = [with_count(group, len(targets)) for group, targets in here.items()]
    across = columns(labels)
    spelled = alike or not _short([*here])  # a key, below the spectra or else below all
    heights = [SPECTRA] * alike + [HEIGHT * rows_for(len(names))]
    heights[0] += (0.2 + LINE * rows_for(len(labels), across)) * spelled
    fig = canvas(ax, heights)
    places = fig.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    if alike:
        panel = places[0].add_subplot()
        for number, (targets, label) in enumerate(zip(here.values(), labels, strict=True)):
            group_spectra(panel, targets, PALETTE[number % len(PALETTE)], label, True)
        frequency_axes(panel, True, PER_BIN)
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
    longest = max(len(shorten(name, LONGEST)) for name in cohort.results)
    return max(0.0, LETTER * (longest - FREE)) if len(cohort.results) <= LABELLED else 0.0


def _rows_to_draw(cohort: Any, quantities: Collection[str] | None) -> list[Rows]:
    """The rows of every quantity that at least half of the targets determine."""
    found: dict[str, Rows] = {}
    for row in cohort.table():
        name = row["quantity"]
        # the bands of the fit repeat the measured shares
        asked = not name.startswith("band_") if quantities is None else name in quantities
        if row["stderr"] is not None and asked:
            found.setdefault(name, []).append(row)
    enough = SHARE * max(len(cohort.results), 1)
    drawn = [rows for rows in found.values() if len(rows) >= enough]
    if not drawn:
        raise ValueError(
            "no quantity is determined by at least half of the targets: there is nothing to draw"
        )
    return drawn


def _panels(fig: Any, cohort: Any, quantities: list[Rows], by: str) -> None:
    panels, _ = panel_grid(fig, len(quantities))
    for panel, rows in zip(panels, quantities, strict=True):
        _panel(panel, rows, list(cohort.results), _groups(cohort), by)
    fig.align_ylabels()


def _panel(ax: Axes, rows: Rows, people: list[str], groups: list[str], by: str) -> None:
    for number, group in enumerate(groups):
        here = [
            row
            for row in rows
            if row["group"] == group and (by != "level" or row["mvc_fraction"] is not None)
        ]
        value, error = (
            np.array([row[key] for row in here], dtype=float) for key in ("value", "stderr")
        )
        if by == "group":
            place = number + (
                np.linspace(-0.25, 0.25, len(here)) if len(here) > 1 else np.zeros(len(here))
            )
            if len(here):
                ax.hlines(value.mean(), number - 0.35, number + 0.35, color=GREY, linewidth=1)
        else:
            place = [
                people.index(row["target"]) if by == "person" else 100 * row["mvc_fraction"]
                for row in here
            ]
        ax.errorbar(
            place,
            value,
            error,
            fmt="o",
            markersize=3.5,
            capsize=2,
            linewidth=1,
            color=PALETTE[number % len(PALETTE)] if len(groups) > 1 else BLUE,
            label=shorten(group, 2 * LONGEST) or None,
        )
    ax.set_ylabel(textwrap.fill(in_words(rows[0]["quantity"], rows[0]["unit"]), 18))
    if by == "level":
        ax.set_xlabel("Level (% MVC)")
    elif by == "group":
        shown = [shorten(group, LONGEST) or "all" for group in groups] if _short(groups) else []
        ax.set_xticks(range(len(shown)), shown, parse_math=False)
        ax.set_xlim(-0.6, len(groups) - 0.4)
    else:
        ax.set_xlim(-0.5, len(people) - 0.5)
        if len(people) > LABELLED:
            ax.set_xlabel("Target number")
            return
        ax.set_xticks(
            range(len(people)),
            [shorten(name, LONGEST) for name in people],
            rotation=35 if len(people) <= 6 else 60,
            ha="right",
            rotation_mode="anchor",
            parse_math=False,
        )
