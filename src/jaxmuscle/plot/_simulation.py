"""Figures of simulations."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._spectra import finite_rows, mean_and_band, spectrum
from ._style import (
    PALETTE,
    PER_BIN,
    AnyFigure,
    axes_or_new,
    finish,
    legend,
    output_label,
    panels,
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
    rows, label = finite_rows(output.reshape(-1, time.size))
    colour = mean_and_band(ax, time, rows.mean(0), rows, label)
    for row in rows[:lines] if len(rows) > 1 else ():
        ax.plot(time, row, color=colour, lw=0.5, alpha=0.6, zorder=2)
    return _over_time(ax, trajectory.task)


def _over_time(ax: Axes, task: Any) -> Axes:
    """The axes of an output over time."""
    ax.set(xlabel="Time (s)", ylabel=output_label(task.output_name, task.output_unit))
    ax.margins(x=0)
    legend(ax, "above")
    return ax


@styled
def simulation(runs: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws a simulation: the whole output over time, its analysed window, and the spectrum, linear
    and logarithmic.

    **Arguments:** `runs`, one seed or an ensemble; `ax`, its place. **Returns:** the figure.
    """
    heights = (1.4, 1.4, 1.9)
    figure, (whole, window, linear, logarithmic) = panels(ax, "AA;BB;CD", heights)
    spectra = runs.spectrum()
    trajectory(runs, whole)
    trajectory(runs, window, window=runs.analysed)
    spectrum(spectra, linear)
    spectrum(spectra, logarithmic, log=True)
    titles = ("Whole run", "Analysed window", "Spectrum, linear", "Spectrum, logarithmic")
    for panel, title in zip(figure.axes, titles, strict=True):
        without_legend(panel).set_title(title)
    for panel in (linear, logarithmic):
        panel.set_ylabel(PER_BIN)
    count = np.size(runs.seeds)
    words = f"{type(runs.task).__name__}, {count} seed{'s' * (count > 1)}"
    return finish(figure, heights, words)


@styled
def moments(summary: Any, ax: Axes | None = None, point: int = 0) -> Axes:
    """Draws the mean of a reduced ensemble over time, with a band from its lowest to its highest
    quantile.

    Further quantiles make further bands within it.

    **Arguments:**

    - `summary`: an `EnsembleSummary`
    - `ax`: or a new figure
    - `point` of a sweep

    **Returns:** the axes.
    """
    ax = axes_or_new(ax)
    swept = summary.mean.ndim == 2
    mean, quantile = (x[point] if swept else x for x in (summary.mean, summary.quantile))
    colour = PALETTE[len(ax.lines) % len(PALETTE)]
    ax.plot(summary.time, mean, color=colour, lw=1.2, label=f"Mean of {summary.seeds} seeds")
    levels = summary.levels
    for i in range(len(levels) // 2):
        ax.fill_between(
            summary.time,
            quantile[i],
            quantile[-1 - i],
            color=colour,
            alpha=0.18 * (1 + i),
            lw=0,
            label=f"{100 * levels[i]:g} to {100 * levels[-1 - i]:g} %",
        )
    return _over_time(ax, summary.task[0] if swept else summary.task)
