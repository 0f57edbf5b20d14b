"""The figure of an ensemble reduced to its moments."""

from typing import Any

from matplotlib.axes import Axes

from ._style import PALETTE, axes_or_new, legend, output_label, styled


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
    mean, quantile = (
        (summary.mean[point], summary.quantile[point])
        if swept
        else (summary.mean, summary.quantile)
    )
    colour = PALETTE[len(ax.lines) % len(PALETTE)]
    ax.plot(summary.time, mean, color=colour, lw=1.2, label=f"Mean of {summary.seeds} seeds")
    levels = summary.levels
    for low in range(len(levels) // 2):
        high = len(levels) - 1 - low
        share = f"{100 * levels[low]:g} to {100 * levels[high]:g} %"
        ax.fill_between(
            summary.time,
            quantile[low],
            quantile[high],
            color=colour,
            alpha=0.18 * (1 + low),
            lw=0,
            label=share,
        )
    ax.set_xlabel("Time (s)")
    first = summary.task[0] if swept else summary.task
    ax.set_ylabel(output_label(first.output_name, first.output_unit))
    ax.margins(x=0)
    legend(ax, "above")
    return ax
