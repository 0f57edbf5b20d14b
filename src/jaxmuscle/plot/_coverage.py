"""The figure of a calibration: how often intervals hold the truth, against how often they say that
they do."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import scipy.stats
from matplotlib.axes import Axes

from ._style import GREY, PALETTE, canvas, finish, ink, shade, shorten, styled

HEIGHT = 3.0  # inches
FINE = np.linspace(0.0, 1.0, 401)
DASHES = ("-", "--", ":", "-.")


@styled
def coverage(
    ranks: Mapping[str, Any],
    draws: int | None = None,
    ax: Axes | None = None,
    *,
    level: float = 0.95,
) -> Axes:
    """Draws the expected coverage of credible intervals against the credibility α that they state,
    a line for each quantity.

        C(α) = (1/N) Σ_i [ |2 u_i - 1| <= α ],   u_i = (r_i + 1/2) / (L + 1)

    r_i is the rank of the truth of simulation i among the L draws of its posterior, so C(α) is the
    share of N simulations whose central interval of credibility α holds the truth. A calibrated
    posterior lies on the diagonal. Below it intervals are too narrow (over-confident), above it too
    wide. The band holds `level` of what chance gives at each α: N C(α) is binomial with N trials of
    probability α. Of quantities with different N it is that of the smallest.

    These are intervals of each quantity alone. A region of several at once may be wrong although
    they are right.

    **Arguments:**

    - `ranks` {quantity: ranks 0 to L, one for each simulation}, as simulation-based calibration
      gives them
    - `draws`: L; without it `ranks` are the u_i themselves, the posterior's probability [1] below
      the truth
    - `ax`: or a new figure, which is legible in a column of 85 mm
    - `level` [1] of the band

    **Returns:** the axes.

    **Raises:** `ValueError` for no ranks, and for ranks outside their range.

    **Source:** Talts, Betancourt, Simpson, Vehtari & Gelman 2018, arXiv:1804.06788 (ranks); Hermans
    et al. 2022, arXiv:2110.06581 (expected coverage).
    """
    held = {
        name: _credibility(name, np.asarray(each, float), draws) for name, each in ranks.items()
    }
    if not held:
        raise ValueError(
            "ranks: is empty; give {quantity: ranks of the truth, one for each simulation}"
        )
    if not 0 < level < 1:
        raise ValueError(f"level = {level!r} must lie between 0 and 1: 0.95 is usual")
    own = ax is None
    ax = canvas(None, [HEIGHT]).add_subplot() if ax is None else ax
    fewest = min(map(len, held.values()))
    low, high = (
        scipy.stats.binom.ppf(0.5 + side * level / 2, fewest, FINE) / fewest for side in (-1, 1)
    )
    chance = f"{100 * level:g} % by chance, {fewest} simulations"
    ax.fill_between(FINE, low, high, color=shade(0.14), lw=0, zorder=0, label=chance)
    ax.plot(
        [0, 1], [0, 1], color=ink() if len(held) > 1 else GREY, lw=0.8, zorder=1, label="calibrated"
    )
    for number, (name, each) in enumerate(held.items()):
        again, colour = divmod(number, len(PALETTE))
        share = np.searchsorted(each, FINE, side="right") / len(each)
        style: dict[str, Any] = {
            "color": PALETTE[colour],
            "ls": DASHES[again % len(DASHES)],
            # equal curves lie upon each other: the lower one has an edge
            "lw": 1.0 + 1.6 * (1 - (number + 1) / len(held)),
        }
        label = shorten(name.replace("_", " "), 30)
        ax.step(FINE, share, where="post", zorder=3, label=label, **style)
    ax.set(xlim=(0, 1), ylim=(0, 1))
    ax.set(xlabel="Credibility α of the interval", ylabel="Share that holds the truth")
    ax.set_aspect("equal", adjustable="box")
    if own:
        finish(ax.figure, [HEIGHT])
    else:
        ax.legend(loc="upper left")
    return ax


def _credibility(name: str, ranks: np.ndarray, draws: int | None) -> np.ndarray:
    """The credibility from which on a central interval holds the truth, of every simulation,
    sorted."""
    top = 1 if draws is None else draws
    if ranks.ndim != 1 or not len(ranks):
        raise ValueError(
            f"ranks[{name!r}]: has shape {ranks.shape}; give one rank for each simulation"
        )
    if not np.all((ranks >= 0) & (ranks <= top)):
        what = "without draws= they are shares" if draws is None else f"of {draws} draws"
        raise ValueError(f"ranks[{name!r}]: must lie between 0 and {top} ({what})")
    places = ranks if draws is None else (ranks + 0.5) / (draws + 1)
    return np.sort(np.abs(2 * places - 1))
