"""The figures of a study: spectra of people and their means, and every recording with the part that
was analysed."""

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, NullLocator

from ._numbers import RELATIVE_UNIT
from ._style import (
    ACROSS,
    BLUE,
    GREY,
    ORANGE,
    PALETTE,
    PER_BIN,
    AnyFigure,
    Style,
    canvas,
    finish,
    fit_height,
    frequency_axes,
    ink,
    panel_grid,
    rows_for,
    shorten,
    styled,
)

HEIGHT = 2.2  # inches
HALF, LONGEST, TITLE = 26, 40, 24  # letters: half a line of the key, a name in it, a title
RELATIVE = f"Power ({RELATIVE_UNIT}/Hz)"
TICKS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)  # Hz
MARK = 0.045  # of the height of a panel, from row to row of marks
TREMOR = "tremor_frequency"
ROW, SLOTS, MOST = 0.42, 6, 100  # inches; recordings in a row, rows of a figure


class _Curve(NamedTuple):
    """Spectra of people that have one colour, and what the key calls them."""

    cells: list[Any]
    colour: str
    label: str


@styled
def study(study: Any, ax: Axes | None = None, *, proportional: bool = False) -> AnyFigure:
    """Draws the spectrum of every person (thin), over the squared mean, and the geometric mean of
    people with its standard error (thick).

    Conditions are colours and groups are panels; of one condition the groups are the colours. Marks
    at the top stand at the frequencies of people's tremors.

    **Arguments:**

    - `study`: a `StudyResult`
    - `ax`: its place, or a new figure
    - `proportional`: or else power over the squared mean; always so where somebody's signal has no
      mean, as an acceleration
    """
    relative = not proportional and all(cell.power is not None for cell in study.cells)
    groups, conditions = study.groups, study.conditions
    panels = _by_condition(study) if len(conditions) == 1 else _by_group(study)
    across = min(len(panels), ACROSS)
    heights = [HEIGHT] * rows_for(len(panels), across)
    fig = canvas(ax, heights)
    axes, _ = panel_grid(fig, len(panels), across, sharex=True, sharey=True)
    for number, (panel, (title, curves)) in enumerate(zip(axes, panels.items(), strict=True)):
        for row, curve in enumerate(curves):
            targets = [cell.target for cell in curve.cells]
            rows = [
                1e6 * cell.power if relative else cell.target.proportional_power
                for cell in curve.cells
            ]
            people_spectra(panel, targets[0].frequency, rows, curve.colour, curve.label)
            _mark_tremors(panel, targets, curve.colour, 1 - MARK * (row + 0.6))
        panel.set_title(shorten(title, TITLE), parse_math=False)
        frequency_axes(panel, True, RELATIVE if relative else PER_BIN)
        panel.label_outer()
        if number + across >= len(panels):  # nothing stands below
            panel.set_xlabel("Frequency (Hz)")
            panel.tick_params(axis="x", which="both", labelbottom=True)
    f = study.cells[0].target.frequency
    axes[0].set_xlim(f[0] / 1.12, 1.12 * f[-1])
    axes[0].xaxis.set_major_locator(FixedLocator(TICKS))
    axes[0].xaxis.set_minor_locator(NullLocator())
    axes[0].plot([], [], color=GREY, lw=1.8, label="thick: geometric mean ± SE")
    if any(line.get_marker() == "v" for panel in axes for line in panel.lines):
        axes[0].plot([], [], "v", color=GREY, ms=3.5, label="tremor of a person")
    names = [*groups, *conditions]
    return finish(fig, heights, columns=columns(names), plain=True)


def _by_group(study: Any) -> dict[str, list[_Curve]]:
    """The curves of conditions, in a panel for each group."""
    panels = {}
    for group in study.groups:
        here = [
            [c for c in study.cells if (c.group, c.condition) == (group, condition)]
            for condition in study.conditions
        ]
        panels[with_count(group, *map(len, here))] = [
            _Curve(cells, PALETTE[number % len(PALETTE)], shorten(condition, LONGEST))
            for number, (condition, cells) in enumerate(zip(study.conditions, here, strict=True))
            if cells
        ]
    return panels


def _by_condition(study: Any) -> dict[str, list[_Curve]]:
    """The curves of groups, in the panel of the only condition."""
    each = {group: [c for c in study.cells if c.group == group] for group in study.groups}
    curves = [
        _Curve(cells, PALETTE[number % len(PALETTE)], with_count(group, len(cells)))
        for number, (group, cells) in enumerate(each.items())
    ]
    return {study.conditions[0]: curves}


def _mark_tremors(ax: Axes, targets: list[Any], colour: str, height: float) -> None:
    """The people's tremors, in a row above the spectra, where they cover no peak."""
    seen = np.array([target.measured[TREMOR].value for target in targets])
    seen = seen[np.isfinite(seen)]
    if seen.size:
        style: Style = {"ms": 3.5, "mew": 0.0, "transform": ax.get_xaxis_transform()}
        ax.plot(seen, np.full(seen.size, height), "v", color=colour, **style)


def with_count(group: str, *numbers: int) -> str:
    """A group and how many people it has, of conditions with different numbers the range."""
    low, high = min(filter(None, numbers), default=0), max(numbers)
    people = (
        "1 person" if high == 1 else f"{high} people" if low == high else f"{low} to {high} people"
    )
    return f"{shorten(group, LONGEST)} ({people})" if group else people


def columns(labels: list[str]) -> int:
    """How many of these have room beside each other in a key."""
    return ACROSS if max(map(len, labels), default=0) <= HALF else 1


def people_spectra(ax: Axes, frequency: Any, rows: list[Any], colour: str, label: str) -> None:
    """Spectra of people (thin), their geometric mean and its standard error (thick)."""
    for row in rows:
        ax.plot(frequency, row, color=colour, lw=0.5, alpha=0.45, zorder=2)
    log, count = np.log(np.stack(rows)), len(rows)
    mean = log.mean(axis=0)
    if count > 1:
        error = log.std(axis=0, ddof=1) / np.sqrt(count)
        band = np.exp(mean - error), np.exp(mean + error)
        ax.fill_between(frequency, *band, color=colour, alpha=0.25, lw=0, zorder=3)
    ax.plot(frequency, np.exp(mean), color=colour, lw=1.8, label=label, zorder=4)


@styled
def study_trials(study: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws every recording of a study, as far as a hundred rows of them reach, with the part that
    was analysed shaded.

    The recordings of a person in a condition stand side by side below their name. All have the same
    scale of time; those of a person have the same scale of the signal.

    **Arguments:** `study`, a `StudyResult`; `ax`, its place, or a new figure.
    """
    cells = study.cells
    most = max(cell.trials for cell in cells)
    across = max(SLOTS // most, 1)
    if across > (each := len(study.conditions)) > 1:
        across -= across % each  # a person's conditions stay in one row
    rows = rows_for(len(cells), across)
    shown = cells[: MOST * across]
    rows, heights = min(rows, MOST), [ROW * min(rows, MOST)]
    fig = canvas(ax, heights)
    panel = fig.subplots()
    longest = max(r.time[-1] - r.time[0] for cell in cells for r in cell.recordings)
    reach: dict[str, list[float]] = {}
    for cell in cells:
        edges = [edge(r.signal) for r in cell.recordings for edge in (np.min, np.max)]
        own = reach.setdefault(cell.person, edges)
        own[:] = [min(*own, *edges), max(*own, *edges)]
    wide = 1.0 / most  # of a recording: a block of a person and a condition is 1 wide
    for number, cell in enumerate(shown):
        row, place = divmod(number, across)
        low, high = reach[cell.person]
        for i, r in enumerate(cell.recordings):
            left, scale = place + wide * i, 0.94 * wide / longest
            x = left + scale * (r.time - r.time[0])
            y = -row + 0.62 * (r.signal - low) / max(high - low, 1e-300)
            panel.plot(x, y, color=BLUE, lw=0.4, zorder=2)
            ends = [left + scale * (t - r.time[0]) for t in (r.start, r.stop)]
            panel.fill_between(ends, -row - 0.02, -row + 0.64, color=ORANGE, alpha=0.3, lw=0)
        name = ", ".join(filter(None, (cell.person, cell.condition)))
        room = int(72 / across)
        panel.text(place, -row + 0.68, shorten(name, room), va="bottom", parse_math=False)
    seconds = 10.0 if longest > 15 else 1.0
    bottom = 0.75 - rows
    reached = 0.94 * wide / longest * seconds
    panel.plot([0, reached], 2 * [bottom], color=ink(), lw=1.2)
    panel.text(reached, bottom, f" {seconds:g} s", va="center")
    panel.set(xlim=(-0.01, across), ylim=(bottom - 0.2, 1.0))
    panel.axis("off")
    more = f"; {len(shown)} of {len(cells)} rows of people are shown" * (len(shown) < len(cells))
    panel.set_title(f"Shaded: what is analysed{more}", weight="normal")
    return fit_height(fig, heights, 0)
