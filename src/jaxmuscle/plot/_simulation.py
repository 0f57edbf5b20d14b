"""Figures of simulations."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._spectra import _finite, _mean_and_band, spectrum
from ._style import (
    COLUMN,
    axes_or_new,
    canvas,
    fitted_to,
    heading,
    key,
    legend,
    output_label,
    styled,
    without_legend,
)


@styled
def trajectory(
    trajectory: Any,
    ax: Axes | None = None,
    *,
    window: tuple[float, float] | None = None,
    lines: int = 3,
) -> Axes:
    """Draws the output over time; of an ensemble the mean, the band that holds 90 % of the seeds
    and a few of them.

    **Arguments:**

    - `trajectory`
    - `ax`: or a new figure
    - `window` (start, stop) [s], by default all of it
    - `lines`: the number of single seeds drawn thin

    **Returns:** the axes. **Raises:** `ValueError` for a window outside the simulated time.
    """
    ax = axes_or_new(ax)
    time, output = trajectory.time, np.asarray(trajectory.output)
    if window is not None:
        output = np.asarray(trajectory.between(window))
        start = round(window[0] * trajectory.rate)
        time = time[start : start + output.shape[-1]]
    rows, label = _finite(output.reshape(-1, time.size))
    colour = _mean_and_band(ax, time, rows.mean(0), rows, label)
    for row in rows[:lines] if len(rows) > 1 else ():
        ax.plot(time, row, color=colour, lw=0.5, alpha=0.6, zorder=2)
    task = trajectory.task
    ax.set_xlabel("Time (s)")
    ax.set_ylabel(output_label(task.output_name, task.output_unit))
    ax.margins(x=0)
    legend(ax, "above")
    return ax


@styled
def simulation(runs: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a simulation: the whole output over time, its analysed window, and the spectrum, linear
    and logarithmic.

    **Arguments:** `runs`, one seed or an ensemble; `ax`, its place. **Returns:** the figure.
    """
    heights = (1.4, 1.4, 1.9)
    figure = canvas(ax, (COLUMN, sum(heights)))
    grid = figure.add_gridspec(3, 2, height_ratios=heights)
    task, spectra = runs.task, runs.spectrum()
    panels = (
        trajectory(runs, figure.add_subplot(grid[0, :])),
        trajectory(runs, figure.add_subplot(grid[1, :]), window=runs.analysed),
        spectrum(spectra, figure.add_subplot(grid[2, 0])),
        spectrum(spectra, figure.add_subplot(grid[2, 1]), log=True),
    )
    titles = ("Whole run", "Analysed window", "Spectrum, linear", "Spectrum, logarithmic")
    for panel, title in zip(panels, titles, strict=True):
        without_legend(panel).set_title(title)
    for panel in panels[2:]:
        panel.set_ylabel("Power (fraction per bin)")
    count = np.atleast_1d(runs.seeds).size
    words = f"{type(task).__name__}, {count} seed{'s' * (count > 1)}"
    fitted_to(figure, sum(heights), heading(figure, words) + key(figure))
    return figure
