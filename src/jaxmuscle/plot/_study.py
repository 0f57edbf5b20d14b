"""The figure of a study: spectra of people and means of their groups, a panel for each
condition."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from ._style import (
    ACROSS,
    GREY,
    PALETTE,
    PER_BIN,
    AnyFigure,
    canvas,
    density_unit,
    finish,
    frequency_axes,
    panel_grid,
    rows_for,
    shade,
    shorten,
    styled,
)

HEIGHT = 2.2  # inches
HALF, LONGEST, TITLE = 26, 40, 24  # letters: half a line of the key, a group's name, a condition's


@styled
def study(study: Any, ax: Axes | None = None, *, proportional: bool = True) -> AnyFigure:
    """Draws the spectrum of every person (thin), with a dot at the peak of a tremor, and the
    geometric mean of each group with its standard error (thick).

    **Arguments:**

    - `study`: a `StudyResult`
    - `ax`: its place, or a new figure
    - `proportional`: or else power in unit²/Hz, which is known where everybody has at least two
      trials

    **Raises:** `ValueError` for power in unit²/Hz where it is not known, or where people were
    measured in different units.
    """
    cells = study.cells
    units = {cell.target.unit for cell in cells}
    if not proportional and (
        len(units) > 1 or any(cell.target.trial_power is None for cell in cells)
    ):
        raise ValueError(
            "proportional = False: power is known where everybody has at least two trials, in the"
            " same unit"
        )
    conditions, across = study.conditions, min(len(study.conditions), ACROSS)
    heights = [HEIGHT] * rows_for(len(conditions))
    fig = canvas(ax, heights)
    axes, _ = panel_grid(fig, len(conditions), across, sharex=True, sharey=True)
    here = {
        group: [
            [c.target for c in cells if (c.group, c.condition) == (group, condition)]
            for condition in conditions
        ]
        for group in study.groups
    }
    labels = [with_count(group, *map(len, targets)) for group, targets in here.items()]
    unit = next(iter(units)) or "?"
    ordinate = PER_BIN if proportional else f"Power ({density_unit(unit)})"
    for place, (panel, condition) in enumerate(zip(axes, conditions, strict=True)):
        for number, targets in enumerate(here.values()):
            if targets[place]:
                colour = PALETTE[number % len(PALETTE)]
                group_spectra(panel, targets[place], colour, labels[number], proportional)
                _mark_peaks(panel, targets[place], colour)
        panel.set_title(shorten(condition, TITLE), parse_math=False)
        frequency_axes(panel, True, ordinate)
        panel.label_outer()
        if place + across >= len(conditions):  # nothing stands below
            panel.set_xlabel("Frequency (Hz)")
            panel.tick_params(axis="x", which="both", labelbottom=True)
    if any(line.get_marker() == "o" for panel in axes for line in panel.lines):
        axes[0].plot([], [], "o", color=GREY, ms=3.5, label="tremor of a person")
    return finish(fig, heights, columns=columns(labels), plain=True)


def _mark_peaks(ax: Axes, targets: list[Any], colour: str) -> None:
    """The people's tremors, on their lines, which are drawn last but the mean of the group."""
    lines = ax.lines[-1 - len(targets) : -1]
    for target, line in zip(targets, lines, strict=True):
        where = target.measured["tremor_frequency"].value
        if np.isfinite(where):
            height = np.exp(np.interp(where, target.frequency, np.log(line.get_ydata())))
            ax.plot(where, height, "o", color=colour, ms=3.5, mec=shade(0.0), mew=0.5, zorder=5)


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


def group_spectra(
    ax: Axes, targets: list[Any], colour: str, label: str, proportional: bool
) -> None:
    """Spectra of the people of a group (thin), their geometric mean and its standard error
    (thick)."""
    rows = [target.proportional_power if proportional else _power(target) for target in targets]
    for target, row in zip(targets, rows, strict=True):
        ax.plot(target.frequency, row, color=colour, lw=0.5, alpha=0.45, zorder=2)
    log, frequency, count = np.log(np.stack(rows)), targets[0].frequency, len(rows)
    mean = log.mean(axis=0)
    if count > 1:
        error = log.std(axis=0, ddof=1) / np.sqrt(count)
        band = np.exp(mean - error), np.exp(mean + error)
        ax.fill_between(frequency, *band, color=colour, alpha=0.25, lw=0, zorder=3)
    ax.plot(frequency, np.exp(mean), color=colour, lw=1.8, label=label, zorder=4)


def _power(target: Any) -> Float[np.ndarray, " bins"]:
    return np.average(target.trial_power, axis=0, weights=target.segments)
