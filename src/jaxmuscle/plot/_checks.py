"""Figures of the two checks of a fit: its residuals against their reference, and refits against the
stated errors."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ._numbers import in_words
from ._style import (
    ACROSS,
    BLUE,
    GREY,
    SKY,
    VERMILLION,
    AnyFigure,
    Style,
    canvas,
    finish,
    fit_height,
    heading,
    ink,
    key,
    log_axis,
    panel_grid,
    rows_for,
    shade,
    styled,
)

TITLES = {
    "chi2_per_bin": "χ² per bin",
    "runs": "Runs of\nequal sign",
    "largest": "Largest\n|residual| (SD)",
    "chi2_per_point": "χ² per point",
    "largest_point": "Largest\n|residual| (SE)",
}
KINDS = ("chi2_per_bin", "runs", "largest"), ("chi2_per_point", "largest_point")
SMALL_P = 0.05
COUNTED = {2: "Both", 3: "All three", 5: "All five"}
HISTOGRAM, BINS = 15, 24  # refits from which on they are drawn as a histogram; its bins
HEIGHTS = 1.8, 1.7  # inches: residuals, references
HEIGHT = 1.85  # inches
REFERENCE, USUAL = "simulated data, fitted again", "95 % of the simulated data"


@styled
def goodness(found: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws residuals with what is usual in each bin, and the checks with their reference
    distributions.

    Where a dynamic stiffness was fitted, its residuals follow below. Grey is what replicates of the
    fitted model give, coloured what the target gives: red where less than 5 % of them are as
    unusual. Letters are legible in a column of 85 mm.
    """
    parts = found.parts.values()
    each = [HEIGHTS * sum(_kinds(part)) for part in parts]
    heights = [*map(sum, each)]
    # between the figures of several targets
    height = sum(heights) + 0.3 * (len(each) - 1)
    fig = canvas(ax, [height])
    places = [fig]
    if len(each) > 1:
        places = fig.subfigures(len(each), 1, squeeze=False, height_ratios=heights)[:, 0]
    lines = [_goodness(*one) for one in zip(places, parts, each, strict=True)]
    return fit_height(fig, [height], sum(lines))


def _kinds(part: Any) -> tuple[bool, bool]:
    """Whether a target has bins, and points of a dynamic stiffness."""
    return part.residual.size > 0, part.stiffness_residual.size > 0


def _goodness(fig: Any, part: Any, heights: tuple[float, ...]) -> int:
    """One target; how many lines of words stand about its panels."""
    grid, row = fig.add_gridspec(len(heights), 6, height_ratios=heights), 0
    for present, residuals, names in zip(_kinds(part), (_of_bins, _of_points), KINDS, strict=True):
        if not present:
            continue
        residuals(fig.add_subplot(grid[row, :]), part)
        width = 6 // len(names)
        for column, name in enumerate(names):
            panel = fig.add_subplot(grid[row + 1, column * width : (column + 1) * width])
            _reference(panel, part, name)
            if not column:
                panel.set_ylabel("Share of simulations")
        row += 2
    p = part.p_values["all"]
    fig.axes[0].set_title(
        f"{COUNTED[len(part.observed)]} checks together: p = {p:.2g}",
        color=VERMILLION if p < SMALL_P else ink(),
    )
    return heading(fig, part.target.name + " (predicted)" * part.foretold) + key(fig)


def _of_bins(ax: Axes, part: Any) -> None:
    f, r = np.asarray(part.target.frequency), np.asarray(part.residual)
    width = float(np.min(np.diff(f)))
    low, high = np.quantile(part.residuals, [0.025, 0.975], axis=0)
    edges = np.append(f - width / 2, f[-1] + width / 2)
    ax.stairs(high, edges, baseline=low, fill=True, color=shade(0.1), zorder=1, label=USUAL)
    out = (r < low) | (r > high)
    for which, color, label in (
        (~out, BLUE, "target over fit"),
        (out, VERMILLION, f"outside ({out.sum()} of {len(f)} bins)"),
    ):
        if which.any() or color == BLUE:
            ax.bar(f[which], r[which], 0.6 * width, color=color, zorder=3, label=label)
    ax.axhline(0, color=ink(), lw=0.6, zorder=4)
    reach = 1.15 * float(np.max([np.abs(r), high, -low]))
    ax.set(xlim=(edges[0], edges[-1]), ylim=(-reach, reach))
    ax.set(xlabel="Frequency (Hz)", ylabel="Residual (SD)")


def _of_points(ax: Axes, part: Any) -> None:
    """How far every point of the dynamic stiffness lies from the fit, whatever the direction."""
    f, off = np.asarray(part.target.stiffness.known.frequency), np.abs(part.stiffness_residual)
    high = np.quantile(np.abs(part.stiffness_residuals), 0.95, axis=0)
    ax.fill_between(f, 0, high, color=shade(0.1), lw=0, zorder=1, label=USUAL)
    out = off > high
    for which, color, label in (
        (~out, BLUE, "dynamic stiffness from fit"),
        (out, VERMILLION, f"above it ({out.sum()} of {len(f)} points)"),
    ):
        if which.any() or color == BLUE:
            ax.plot(f[which], off[which], "o", ms=3.5, color=color, zorder=3, label=label)
    ax.set(xlim=(f[0] / 1.1, 1.1 * f[-1]), ylim=(0, 1.15 * float(np.max([off, high]))))
    ax.set(xlabel="Frequency (Hz)", ylabel="|Residual| (SE)")
    log_axis(ax)


def _reference(ax: Axes, part: Any, name: str) -> None:
    values, own, p = np.asarray(part.reference[name]), part.observed[name], part.p_values[name]
    low, counted = min(values.min(), own), name == "runs"
    edges = (
        np.arange(low - 0.5, max(values.max(), own) + 1)
        if counted
        else np.linspace(low, max(np.quantile(values, 0.999), 1.05 * own), 30)
    )
    ax.hist(values, edges, density=True, color=shade(0.25), zorder=1, label=REFERENCE)
    colour = VERMILLION if p < SMALL_P else BLUE
    ax.axvline(own, color=colour, lw=1.8, zorder=3, label="value of the target")
    _without_ordinate(ax)
    ax.xaxis.set_major_locator(MaxNLocator(3))
    ax.set_xlabel(TITLES[name])
    shown = f"{own:.0f}" if counted else f"{own:.2f}"
    ax.set_title(f"{shown}, p = {p:.2g}", color=colour, weight="normal")


def _without_ordinate(ax: Axes) -> None:
    """Only the abscissa has a meaning."""
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)


@styled
def bootstrap(found: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws the refits of every quantity, the value they were made from and the interval that the
    fit states.

    Above each: the spread of the refits over the stated error, and how many of their own 95 %
    intervals hold the value that they were made from; red where the error does not hold. Letters
    are legible in a column of 85 mm.

    **Raises:** `ValueError` if fewer than two refits succeeded.
    """
    names = list(found.quantities)
    if not names:
        raise ValueError(
            f"{found.target}: fewer than two refits succeeded, so there is nothing to draw"
        )
    across = min(ACROSS, len(names))
    heights = [HEIGHT] * rows_for(len(names), across)
    fig = canvas(ax, heights)
    panels, grid = panel_grid(fig, len(names), across)
    done, failed = found.replicates - len(found.failed), len(found.failed)
    label = f"{done} refits" + f" ({failed} failed)" * bool(failed)
    for panel, name in zip(panels, names, strict=True):
        _refits(panel, found.quantities[name], label)
    if len(found.quantities[names[0]].values) >= HISTOGRAM:
        for panel in grid[:, 0]:
            panel.set_ylabel("Refits")
    return finish(fig, heights, found.target)


def _refits(ax: Axes, q: Any, label: str) -> None:
    low, high = q.true - 1.96 * q.stated, q.true + 1.96 * q.stated
    ax.axvspan(low, high, color=SKY, alpha=0.25, lw=0, zorder=0, label="stated 95 % interval")
    style: Style = {"color": GREY, "zorder": 2, "label": label}
    count = len(q.values)
    if count >= HISTOGRAM:
        ax.hist(q.values, min(BINS, 2 + count // 4), alpha=0.75, **style)
        ax.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    else:
        ax.plot(q.values, np.arange(count) + 1, "o", ms=3.5, **style)
        ax.set_ylim(0, count + 1)
        _without_ordinate(ax)
    mean = float(np.mean(q.values))
    ax.axvline(q.true, color=BLUE, lw=1.6, zorder=3, label="true value")
    label = "mean of the refits"
    ax.axvline(mean, color=VERMILLION, lw=1.2, ls="--", zorder=3, label=label)
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.set_xlabel(textwrap.fill(in_words(q.name, q.unit), 26))
    near, known = q.inside
    said = f"spread/stated {q.ratio:.2f} ± {q.ratio_stderr:.2f}" + (
        f"\n{near} of {known} intervals hold" if known else ""
    )
    ax.set_title(said, weight="normal", color=ink() if q.verdict == "holds" else VERMILLION)
