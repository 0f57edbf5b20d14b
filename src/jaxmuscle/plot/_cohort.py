"""The figure of a cohort: what its data determine, by person, group or level."""

import itertools
import textwrap
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import scipy
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ._numbers import in_print
from ._study import columns, people_spectra, with_count
from ._style import (
    BLUE,
    GREY,
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
APART = 0.3  # from people to their mean beside them
BRACKET = 0.2  # inches, for the p of two conditions
PAIRED = 3  # conditions of whose pairs the p is drawn
SHARE = 0.5  # of the targets that must determine a quantity for it to be drawn


@styled
def cohort(
    cohort: Any,
    by: str = "person",
    ax: Axes | None = None,
    *,
    quantities: Collection[str] | None = None,
    p: Mapping[tuple[str, str, str], float | None] | None = None,
) -> AnyFigure:
    """Draws what at least half of the targets determine, `by` "person", "group" or "level"
    (fraction of MVC).

    By person and level with standard errors. By group every person is a dot, joined where there are
    several conditions, which then are the colours; beside them stands the mean of the people with
    its 95 % interval.

    `quantities`, only these. `p` of differences within people, by quantity and the two conditions.

    **Raises:** `ValueError` for another `by`, and if there is nothing to draw.
    """
    if by not in WAYS:
        raise ValueError(f"by = {by!r}: choose one of {', '.join(WAYS)}")
    names = _rows_to_draw(cohort, quantities)
    if by == "level" and all(
        result.target.mvc_fraction is None for result in cohort.results.values()
    ):
        raise ValueError("by = 'level': no target states its mvc_fraction")
    groups, conditions = _groups(cohort), _conditions(cohort)
    below = {"person": cohort.results, "group": _ticked(groups, conditions), "level": ()}[by]
    pairs = _pairs(groups, conditions) if p else []
    above = BRACKET * len(pairs) if by == "group" else 0.0
    heights = [HEIGHT + _below(below) + above] * rows_for(len(names))
    fig = canvas(ax, heights)
    _panels(fig, cohort, names, by, p)
    coloured = conditions if by == "group" and len(conditions) > 1 else groups
    named = by == "group" and bool(below) and set(below) == set(coloured)
    if len(coloured) > 1 and not named:
        fit_height(fig, heights, key(fig, columns(coloured), plain=True))
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
            rows, colour = [t.proportional_power for t in targets], PALETTE[number % len(PALETTE)]
            people_spectra(panel, targets[0].frequency, rows, colour, label)
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


def _panels(
    fig: Any,
    cohort: Any,
    quantities: list[Rows],
    by: str,
    p: Mapping[tuple[str, str, str], float | None] | None = None,
) -> None:
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
                if len(conditions) > 1:
                    style = {"color": GREY}
                _group(panel, here, factor, number, conditions, style)
            else:
                _each(panel, here, factor, people if by == "person" else None, style)
        if by == "group":
            _name_groups(panel, groups, conditions)
            _span_data(panel)
            if p:
                _state_p(panel, rows[0]["quantity"], _pairs(groups, conditions), p, len(groups))
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
    the mean of each condition with its 95 % interval (Student's t): of the first before, of the
    others behind the lines."""
    people = list(dict.fromkeys(row.get("person", row["target"]) for row in rows))
    table = np.full((len(people), len(conditions)), np.nan)
    for row in rows:
        person, condition = row.get("person", row["target"]), row.get("condition", "")
        table[people.index(person), conditions.index(condition)] = factor * row["value"]
    several = len(conditions) > 1
    at = number * _width(conditions) + np.arange(len(conditions)) - (0.0 if several else APART / 2)
    ax.plot(at, table.T, "-", color=style["color"], alpha=0.6, lw=0.5, zorder=2)
    for i, (place, column) in enumerate(zip(at, table.T, strict=True)):
        known = column[np.isfinite(column)]
        own = style
        if several:
            own = {"color": PALETTE[i % len(PALETTE)], "label": shorten(conditions[i], 2 * LONGEST)}
        fine: Style = {"color": own["color"], "alpha": 0.6, "ms": 2.4, "mew": 0.0, "zorder": 2}
        ax.plot(np.full(len(known), place), known, "o", **fine)
        if len(known) < 2:
            continue
        half = scipy.stats.t.ppf(0.975, len(known) - 1) * scipy.stats.sem(known)
        bold: Style = {"fmt": "o", "ms": 4, "capsize": 2.5, "lw": 1.4, "zorder": 3} | own
        beside = place - APART if several and not i else place + APART
        ax.errorbar(beside, known.mean(), half, **bold)


def _conditions(cohort: Any) -> list[str]:
    return list(dict.fromkeys(row.get("condition", "") for row in cohort.table()))


def _width(conditions: list[str]) -> float:
    """From group to group: a gap, where they have several conditions."""
    return len(conditions) + 0.5 * (len(conditions) > 1)


def _ticked(groups: list[str], conditions: list[str]) -> list[str]:
    """What stands below a panel: the groups, or the conditions of the only one; nothing where the
    groups stand in a key, since they are long and the colours."""
    if len(groups) == 1 and len(conditions) > 1:
        return conditions
    return groups if len(conditions) > 1 or _short(groups) else []


def _name_groups(ax: Axes, groups: list[str], conditions: list[str]) -> None:
    names = _ticked(groups, conditions)
    middle = np.arange(len(groups)) * _width(conditions) + (len(conditions) - 1) / 2
    at = np.arange(len(conditions)) if names is conditions else middle[: len(names)]
    _ticks(ax, at, [n or "all" for n in names], turned=sum(map(len, names)) > ROOM)
    ax.set_xlim(-0.6, (len(groups) - 1) * _width(conditions) + len(conditions) - 0.4)


def _span_data(ax: Axes) -> None:
    """Ticks from below all that is drawn to above it."""
    low, high = ax.dataLim.intervaly
    ticks = np.asarray(MaxNLocator(4, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
    ticks = ticks[ticks >= 0] if low >= 0 else ticks
    ax.set_yticks(ticks)
    ax.set_ylim(ticks[0], ticks[-1])


def _pairs(groups: list[str], conditions: list[str]) -> list[tuple[str, str]]:
    """The conditions whose p is stated, of few conditions: over people of all groups, so that there
    is no place for more than one where there are several groups."""
    known = 2 if len(groups) > 1 else PAIRED
    return [*itertools.combinations(conditions, 2)] if len(conditions) <= known else []


def _state_p(
    ax: Axes,
    quantity: str,
    pairs: list[tuple[str, str]],
    p: Mapping[tuple[str, str, str], float | None],
    groups: int,
) -> None:
    """The p of each pair of conditions above the panel, over a line from one to the other."""
    conditions = list(dict.fromkeys(name for pair in pairs for name in pair))
    step = BRACKET / HEIGHT
    for row, (a, b) in enumerate(sorted(pairs, key=lambda pair: conditions.index(pair[1]))):
        known = p.get((quantity, a, b))
        if known is None:
            continue
        words = "p < 0.001" if known < 0.001 else f"p = {known:.{3 if known < 0.1 else 2}f}"
        height = 1.04 + row * step
        ends = [float(conditions.index(name)) for name in (a, b)]
        if groups > 1:
            words, ends = f"all people: {words}", [*ax.get_xlim()]
        style: Style = {"transform": ax.get_xaxis_transform(), "clip_on": False}
        ax.plot(ends, 2 * [height], color=GREY, lw=0.8, **style)
        middle = sum(ends) / 2
        ax.text(middle, height + 0.01, words, ha="center", va="bottom", **style)


def _name_people(ax: Axes, people: list[str]) -> None:
    ax.set_xlim(-0.5, len(people) - 0.5)
    if len(people) > LABELLED:
        ax.set_xlabel("Target number")
    else:
        _ticks(ax, range(len(people)), people, turned=True)


def _ticks(ax: Axes, at: Any, names: list[str], *, turned: bool) -> None:
    style: Style = {"rotation": 35, "ha": "right", "rotation_mode": "anchor"} if turned else {}
    ax.set_xticks(at, [shorten(name, LONGEST) for name in names], parse_math=False, **style)
