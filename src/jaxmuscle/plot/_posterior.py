"""Figures of a posterior: corner, predictive spectra, traces."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxmuscle._common.errors import NotMixedError

from ._numbers import in_words, unit_in_print
from ._style import (
    BLUE,
    COLUMN,
    ORANGE,
    PALETTE,
    PROPORTIONAL,
    SKY,
    AnyFigure,
    Style,
    axes_or_new,
    canvas,
    fit_height,
    frequency_axes,
    heading,
    ink,
    legend,
    styled,
)

ORDER = (
    "corner_frequency",
    "harmonic_frequency",
    "harmonic_share",
    "model_coefficient_of_variation",
)
MOST, PAIRS = 6, 4  # quantities that are drawn; those of which all pairs have room in a column
CUT = (0.002, 0.998)
BANDS = ((0.025, 0.975, 0.18), (0.25, 0.75, 0.35))
MASS = (0.95, 0.8, 0.5)
REGIONS = ("#cfe6f5", SKY, BLUE)  # of this mass


def names_to_draw(found: Any) -> list[str]:
    """What a corner figure shows: the quantities that the data determine, and the harmonic's
    frequency."""
    known = [name for name in found.quantities if name in found.determined]
    free = [name for name in found.samples if name.startswith("harmonic_frequency")]
    asked = [
        name
        for base in ORDER
        for name in found.quantities
        if name.partition("@")[0] == base and (name in known or name in free)
    ]
    return list(dict.fromkeys([*asked, *known]))[:MOST]


def _require_mixed(found: Any) -> None:
    if not found.success:
        raise NotMixedError(f"{found.title}: {found.message}")


@styled
def posterior(found: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws the posterior `found` of what the data determine: densities, and 50, 80 and 95 %
    regions of pairs.

    Of four quantities at most, so that it is legible in a column of 85 mm. `found.summary()` has
    all.

    **Raises:** `NotMixedError` if the chains did not mix; `ValueError` if the data determine
    nothing.
    """
    _require_mixed(found)
    names = names_to_draw(found)[:PAIRS]
    if not names:
        raise ValueError(
            f"{found.title}: the data determine no quantity, so there is nothing to draw"
        )
    count = len(names)
    draws = [found.quantities[name].ravel() for name in names]
    limits = [np.quantile(x, CUT) for x in draws]
    size = COLUMN if count > 2 else 3.0
    fig = canvas(ax, [size], size, w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)
    axes = fig.subplots(count, count, squeeze=False)
    for (i, j), panel in np.ndenumerate(axes):
        if j > i:
            panel.remove()
            continue
        lowest, first = i == count - 1, j == 0 and i > 0
        panel.set_xlim(*limits[j])
        panel.locator_params(nbins=2)
        panel.tick_params(labelbottom=lowest, labelleft=first)
        if i == j:
            _density(panel, draws[i])
        else:
            _pair(panel, draws[j], draws[i], limits[j], limits[i])
        if lowest:
            panel.set_xlabel(_label(found, names[j]))
            panel.tick_params(axis="x", rotation=90)
        if first:
            panel.set_ylabel(_label(found, names[i]))
    fig.align_labels()
    heading(fig, found.title)
    if count > 1:
        fig.legend(handles=_explained(), loc="upper right", frameon=False)
    return fig


def _explained() -> list[Any]:
    """What lines and areas are, in the empty corner."""
    regions = zip(MASS, REGIONS, strict=True)
    return [
        Patch(color=SKY, alpha=0.6, label="density"),
        Line2D([], [], color=BLUE, lw=1.0, label="median"),
        Patch(color=BLUE, alpha=0.08, label="95 % interval"),
        *(Patch(color=color, label=f"region of {100 * mass:g} %") for mass, color in regions),
    ]


def _label(found: Any, name: str) -> str:
    return textwrap.fill(in_words(name, found.unit(name)), 12, break_long_words=False)


def _density(ax: Axes, x: np.ndarray) -> None:
    style: Style = {"histtype": "stepfilled", "color": SKY, "alpha": 0.6, "lw": 0}
    ax.hist(x, bins=60, range=ax.get_xlim(), density=True, **style)
    low, middle, high = np.quantile(x, (0.025, 0.5, 0.975)).tolist()
    ax.axvline(middle, color=BLUE, lw=1.0)
    ax.axvspan(low, high, color=BLUE, alpha=0.08, lw=0)
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)


def _pair(ax: Axes, x: np.ndarray, y: np.ndarray, wide: np.ndarray, high: np.ndarray) -> None:
    from scipy.ndimage import gaussian_filter

    counts, xs, ys = np.histogram2d(x, y, bins=40, range=[wide, high])
    smooth = gaussian_filter(counts, 1.2)
    order = np.sort(smooth.ravel())[::-1]
    inside = np.cumsum(order) / order.sum()
    levels = np.unique([order[np.searchsorted(inside, mass)] for mass in MASS])
    middles = (0.5 * (edges[1:] + edges[:-1]) for edges in (xs, ys))
    colors = list(REGIONS[-len(levels) :])
    ax.contourf(*middles, smooth.T, levels=[*levels, smooth.max() * 1.01], colors=colors)
    ax.set_ylim(*high)
    ax.locator_params(nbins=2)


@styled
def predictive(found: Any, ax: Axes | None = None, target: str | None = None) -> Axes:
    """Draws the target among spectra that the posterior `found` predicts; of several, the named
    one.

    **Raises:** `NotMixedError`.
    """
    _require_mixed(found)
    part = found.only if target is None else found.parts[target]
    ax = axes_or_new(ax)
    f, measured = (np.asarray(x) for x in (part.target.frequency, part.target.proportional_power))
    power, expected = (
        x.reshape(-1, len(f)) for x in (part.replicates.power, part.replicates.expected)
    )
    for low, high, alpha in BANDS:
        edges = np.quantile(power, (low, high), axis=0)
        label = f"predicted, {100 * (high - low):.0f} %"
        ax.fill_between(f, *edges, color=SKY, alpha=alpha + 0.1, lw=0, label=label)
    ax.plot(f, np.median(expected, axis=0), color=BLUE, lw=1.2, label="model, median")
    ax.plot(f, measured, color=ink(), marker="o", ms=2.8, lw=0, label="data", zorder=3)
    frequency_axes(ax, True, PROPORTIONAL)
    ax.set_xlim(f[0] / 1.15, 1.15 * f[-1])
    legend(ax, "above")
    return ax


@styled
def chains(found: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws every chain of the posterior `found` over its draws, also of chains that did not
    mix."""
    names = names_to_draw(found) or list(found.samples)[:MOST]
    heights = [0.9] * len(names)
    fig = canvas(ax, heights)
    axes = fig.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    for panel, name in zip(axes, names, strict=True):
        for number, chain in enumerate(found.quantities[name]):
            panel.plot(chain, lw=0.3, color=PALETTE[number % len(PALETTE)])
        r_hat, bulk, _ = found.diagnostics[name]
        unit, style = found.unit(name), {"pad": 3.0, "weight": "normal"}
        panel.set_title(in_words(name, unit), parse_math=False, **style)
        panel.set_title(f"R-hat {r_hat:.3f}, ESS {bulk:.0f}", loc="right", **style)
        panel.set_ylabel("ratio" if unit in ("", "1") else unit_in_print(unit))
        for draw in np.unique(np.nonzero(found.chains.diverging)[1]):
            panel.axvline(draw, color=ORANGE, lw=0.5, zorder=0)
    axes[-1].set_xlabel("Draw")
    fig.align_ylabels()
    lines = heading(fig, found.title, bad="Not mixed" * (not found.success))
    return fit_height(fig, heights, lines)
