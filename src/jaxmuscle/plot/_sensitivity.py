"""The figure of a sensitivity."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm

from ._style import axes_or_new, styled


@styled
def sensitivity(sensitivity: Any, ax: Axes | None = None) -> Axes:
    """Draws how proportional power answers to the parameters as a heat map, parameters that do
    nothing left out.

    **Arguments:** `sensitivity`; `ax`, or a new figure high enough for the parameters. **Returns:**
    the axes.
    """
    table = np.asarray(sensitivity.proportional)
    shown = np.flatnonzero(np.max(np.abs(table), axis=1) > 1e-6)
    ax = axes_or_new(ax, 1.6 + 0.2 * len(shown))
    frequency = np.asarray(sensitivity.frequency)
    half = 0.5 * (frequency[1] - frequency[0]) if len(frequency) > 1 else 0.5
    edges = np.append(frequency - half, frequency[-1] + half)
    largest = float(np.max(np.abs(table[shown]), initial=1e-6))
    # Logarithmic beyond a tenth: a frequency moves its own bins hundreds of times as much as
    # anything else does.
    scale = SymLogNorm(min(0.1, largest), vmin=-largest, vmax=largest)
    mesh = ax.pcolormesh(edges, np.arange(len(shown) + 1), table[shown], cmap="RdBu_r", norm=scale)
    labels = [sensitivity.names[i] + ("" if sensitivity.relative[i] else " *") for i in shown]
    ax.set_yticks(np.arange(len(shown)) + 0.5, labels)
    ax.invert_yaxis()
    ax.set_xlabel("Frequency (Hz)")
    ax.figure.colorbar(
        mesh, ax=ax, location="bottom", fraction=0.04, aspect=40, label="d ln p / d ln parameter"
    )
    if not np.all(sensitivity.relative[shown]):
        ax.set_title("* d ln p / d parameter, in its own unit", weight="normal")
    return ax
