"""The figure of a fit's starts: whether they agree."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._style import BLUE, GREY, axes_or_new, legend, styled


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
