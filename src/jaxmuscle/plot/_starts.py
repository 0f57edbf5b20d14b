"""Figures of a fit's starts: whether they agree, and in what."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import SymLogNorm

from ._style import BLUE, GREY, Style, axes_or_new, ink, legend, log_axis, styled


@styled
def starts(result: Any, ax: Axes | None = None) -> Axes:
    """Draws where the starts of a fit ended, the best first (a waterfall plot).

    A level stretch is one solution that several starts found. The ordinate is the rise of chi²
    above the best start's, linear below 1 and logarithmic above. A grey cross is a start that did
    not settle: its last step still lowered the cost by a thousandth of it or more. Starts without a
    finite cost are left out.

    **Arguments:** `result`, what `jaxmuscle.fit` returns; `ax`. **Returns:** the axes (`ax` or
    new).
    """
    ax = axes_or_new(ax)
    ended = sorted((start.cost, start.success) for start in result.starts if start.cost is not None)
    cost, settled = np.array([c for c, _ in ended]), np.array([s for _, s in ended], bool)
    rank, rise = np.arange(1, len(cost) + 1), 2 * (cost - cost[:1])
    for which, marker, color, label in (
        (settled, "o", BLUE, "settled"),
        (~settled, "x", GREY, "did not settle"),
    ):
        if which.any():
            words = f"{which.sum()} {label}"
            ax.plot(rank[which], rise[which], marker, ms=3, color=color, label=words)
    ax.set(yscale="symlog", xlabel="Start, the best first", ylabel="Rise of χ²")
    ax.set_ylim(bottom=-0.1, auto=None)
    legend(ax, "above")
    return ax


@styled
def start_values(result: Any, ax: Axes | None = None) -> Axes:
    """Draws which values the starts of a fit ended at: a line for each start, a row for each
    parameter.

    The abscissa is the value over that of the best start, which is black. The colour is the rise of
    chi² above the best start's. A row in which dark lines lie wide apart is a parameter that the
    data leave open. Parameters that may be negative are left out.

    **Arguments:** `result`, what `jaxmuscle.fit` returns; `ax`, or a new figure. **Returns:** the
    axes.

    **Raises:** `ValueError` where the end values are not known, as of fits saved by earlier
    versions.
    """
    ended = sorted((s.cost, s.values) for s in result.starts if s.cost is not None and s.values)
    if not ended:
        raise ValueError(
            "the fit does not say where its starts ended: it was saved by an earlier version; fit"
            " again"
        )
    rise = 2 * (np.array([cost for cost, _ in ended]) - ended[0][0])
    values = np.array([row for _, row in ended])
    positive = np.atleast_1d((values > 0).all(axis=0))
    names = [name for name, shown in zip(result.settings["free"], positive, strict=True) if shown]
    ratio, rows = (values / values[0])[:, positive], np.arange(len(names))
    ax = axes_or_new(ax, 1.0 + 0.24 * len(names))
    norm = SymLogNorm(1.0, vmin=0.0, vmax=max(float(rise.max()), 1.0))
    colours = plt.get_cmap("viridis")
    style: Style = {"marker": "o", "ms": 2.5}
    for i in range(len(ratio) - 1, 0, -1):
        ax.plot(ratio[i], rows, lw=0.6, color=colours(norm(rise[i])), **style)
    ax.plot(ratio[0], rows, lw=1.2, color=ink(), zorder=3, **style)
    ax.set_yticks(rows, names)
    ax.set_ylim(len(names) - 0.5, -0.5)
    log_axis(ax)
    ax.set_xlabel("Value over that of the best start")
    bar = ax.figure.colorbar(
        ScalarMappable(norm, "viridis"), ax=ax, label="Rise of χ²", fraction=0.05, pad=0.02
    )
    bar.outline.set_visible(False)
    return ax
