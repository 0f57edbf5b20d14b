"""The figure of a mean spectrum with its standard error."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._style import BLUE, GREY, PROPORTIONAL, axes_or_new, frequency_axis, legend, styled


@styled
def draw(estimate: Any, ax: Axes | None, log: bool) -> Axes:
    """Mean with control variate over the mean without, each ± 2 SE."""
    ax = axes_or_new(ax)
    frequency, whole = np.asarray(estimate.frequency), float(np.sum(estimate.power))
    shown = slice(None) if not log else frequency > 0
    rows = [(estimate.power, estimate.stderr, BLUE, "with control variate" if estimate.expected is not None else "mean")]
    if estimate.expected is not None:
        rows.append((estimate.plain_power, estimate.plain_stderr, GREY, "without"))
    for order, (power, stderr, color, name) in enumerate(rows):
        low, high = ((power + side * stderr)[shown] / whole for side in (-2, 2))
        ax.fill_between(frequency[shown], low, high, color=color, alpha=0.25, lw=0, zorder=2 - order)
        label = f"{name} ({estimate.seeds} seeds, ± 2 SE)"
        ax.plot(frequency[shown], power[shown] / whole, color=color, label=label, zorder=3 - order)
    frequency_axis(ax, log)
    legend(ax, "lower left" if log else "upper right")
    ax.set_ylabel(PROPORTIONAL)
    return ax
