"""The figure of a cohort: what its data determine, by person, group or level."""

import textwrap
from collections.abc import Collection
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes

from ._numbers import in_print
from ._study import columns, group_spectra, with_count
from ._style import (
    BLUE,
    LINE,
    PALETTE,
    PER_BIN,
    AnyFigure,
    Style,
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
MEAN = 0.15  # half the distance of people from their mean
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

    By person and level with standard errors. By group every person is a dot, joined where there are
    several conditions, and the mean of the people has its 95 % interval.

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
    below = {"person": cohort.results, "group": _conditions(cohort), "level": ()}[by]
    heights = [HEIGHT + _below(below)] * rows_for(len(names))
    fig = canvas(ax, heights)
    _panels(fig, cohort, names, by)
    groups = _groups(cohort)
    named = by == "group" and len(_conditions(cohort)) == 1 and _short(groups)
    if len(groups) > 1 and not named:
        fit_height(fig, heights, key(fig, columns(groups), plain=True))
    return fig


@styled
def groups(
    cohort: Any, ax: Axes | None = None, *, quantities: Collection[str] | None = None
) -> AnyFigure:
    """Draws the spectra of the groups of a cohort, and what the fits found by group.

    Above: every target (thin), the geometric mean of each group with its standard error (thick).
    Below: what at least half of the targets determine, with the mean of each group and its 95 %
    interval. `quantities`, only these. Where the targets differ in their bins, their
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


def _below(names: Collection[str]) -> float:
    """How much higher [inches] long names make a panel."""
    longest = max((len(shorten(name, LONGEST)) for name in names), default=0)
    return max(0.0, LETTER * (longest - FREE)) if len(names) <= LABELLED else 0.0


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
    people, groups, conditions = list(cohort.results), _groups(cohort), _conditions(cohort)
    for panel, rows in zip(panels, quantities, strict=True):
        factor, label = in_print(rows[0]["quantity"], rows[0]["unit"])
        panel.set_ylabel(textwrap.fill(label, 18))
        for number, group in enumerate(groups):
            here = [row for row in rows if row["group"] == group]
            style: Style = {
                "color": PALETTE[number % len(PALETTE)] if len(groups) > 1 else BLUE,
                "label": shorten(group, 2 * LONGEST) or None,
            }
            if by == "group":
                _group(panel, here, factor, number, conditions, style)
            else:
                _each(panel, here, factor, people if by == "person" else None, style)
        if by == "group":
            _name_groups(panel, groups, conditions)
        elif by == "level":
            panel.set_xlabel("Level (% MVC)")
        else:
            _name_people(panel, people)
    fig.align_ylabels()


def _each(ax: Axes, rows: Rows, factor: float, people: list[str] | None, style: Style) -> None:
    """Values with their standard errors, by person or, without people, by level."""
    rows = [row for row in rows if people or row["mvc_fraction"] is not None]
    value, error = (
        factor * np.array([row[key] for row in rows], dtype=float) for key in ("value", "stderr")
    )
    place = [people.index(row["target"]) if people else 100 * row["mvc_fraction"] for row in rows]
    ax.errorbar(place, value, error, fmt="o", ms=3.5, capsize=2, lw=1, **style)


def _group(
    ax: Axes, rows: Rows, factor: float, number: int, conditions: list[str], style: Style
) -> None:
    """The people of a group, joined where they were measured in several conditions, and beside them
    the mean of each condition with its 95 % interval (Student's t)."""
    people = list(dict.fromkeys(row.get("person", row["target"]) for row in rows))
    table = np.full((len(people), len(conditions)), np.nan)
    for row in rows:
        person, condition = row.get("person", row["target"]), row.get("condition", "")
        table[people.index(person), conditions.index(condition)] = factor * row["value"]
    at = number * _width(conditions) + np.arange(len(conditions))
    fine: Style = {"color": style["color"], "alpha": 0.6, "lw": 0.5, "ms": 2.2, "zorder": 2}
    ax.plot(at - MEAN, table.T, "o-", **fine)
    for place, column in zip(at + MEAN, table.T, strict=True):
        known = column[np.isfinite(column)]
        if len(known) < 2:
            continue
        half = scipy.stats.t.ppf(0.975, len(known) - 1) * scipy.stats.sem(known)
        bold: Style = {"fmt": "o", "ms": 4, "capsize": 2.5, "lw": 1.4, "zorder": 3} | style
        ax.errorbar(place, known.mean(), half, **bold)


def _conditions(cohort: Any) -> list[str]:
    return list(dict.fromkeys(row.get("condition", "") for row in cohort.table()))


def _width(conditions: list[str]) -> float:
    """From group to group: a gap, where they have several conditions."""
    return len(conditions) + 0.5 * (len(conditions) > 1)


def _name_groups(ax: Axes, groups: list[str], conditions: list[str]) -> None:
    """The conditions of each group, or where there is one only the groups, whose names stand in a
    key if they are long."""
    at = (np.arange(len(groups))[:, None] * _width(conditions) + np.arange(len(conditions))).ravel()
    names = conditions * len(groups) if len(conditions) > 1 else [g or "all" for g in groups]
    if len(conditions) == 1 and not _short(groups):
        at, names = at[:0], []
    _ticks(ax, at, names, turned=sum(map(len, names)) > ROOM)
    ax.set_xlim(-0.6, (len(groups) - 1) * _width(conditions) + len(conditions) - 0.4)


def _name_people(ax: Axes, people: list[str]) -> None:
    ax.set_xlim(-0.5, len(people) - 0.5)
    if len(people) > LABELLED:
        ax.set_xlabel("Target number")
    else:
        _ticks(ax, range(len(people)), people, turned=True)


def _ticks(ax: Axes, at: Any, names: list[str], *, turned: bool) -> None:
    style: Style = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if turned else {}
    ax.set_xticks(at, [shorten(name, LONGEST) for name in names], parse_math=False, **style)
