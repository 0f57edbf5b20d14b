"""Figures of the two checks of a fit: its residuals against their reference, and refits against the
stated errors."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator

from ._numbers import in_words
from ._style import (
    BLUE,
    COLUMN,
    GREY,
    SKY,
    VERMILLION,
    canvas,
    fitted_to,
    heading,
    ink,
    key,
    log_axis,
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
SMALL_P = 0.05
COUNTED = {2: "Both", 3: "All three", 5: "All five"}
HISTOGRAM, BINS = 15, 24  # refits from which on they are drawn as a histogram; its bins
HEIGHTS = 1.8, 1.7  # inches: residuals, references
HEIGHT, ACROSS = 1.85, 2  # inches, panels
REFERENCE = "simulated data, fitted again"


@styled
def goodness(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws residuals with what is usual in each bin, and the checks with their reference
    distributions.

    Where a dynamic stiffness was fitted, its residuals follow below. Grey is what replicates of the
    fitted model give, coloured what the target gives: red where less than 5 % of them are as
    unusual. Letters are legible in a column of 85 mm.
    """
    each = [
        HEIGHTS * ((part.residual.size > 0) + (part.stiffness_residual.size > 0))
        for part in found.parts.values()
    ]
    height = sum(map(sum, each)) + 0.3 * (len(each) - 1)
    fig = canvas(ax, (COLUMN, height))
    places = [fig]
    if len(each) > 1:
        places = fig.subfigures(
            len(each), 1, squeeze=False, height_ratios=[sum(rows) for rows in each]
        )[:, 0]
    lines = [_goodness(*one) for one in zip(places, found.parts.values(), each, strict=True)]
    fitted_to(fig, height, sum(lines))
    return fig


def _goodness(fig: Any, found: Any, heights: tuple[float, ...]) -> int:
    """One target; how many lines of words stand about its panels."""
    grid = fig.add_gridspec(len(heights), 6, height_ratios=heights)
    rows, first = iter(range(len(heights))), None
    for residuals, names in (
        (_residuals, ("chi2_per_bin", "runs", "largest")),
        (_off, ("chi2_per_point", "largest_point")),
    ):
        if names[0] not in found.observed:
            continue
        above = fig.add_subplot(grid[next(rows), :])
        residuals(above, found)
        first = first or above
        row, width = next(rows), 6 // len(names)
        for column, name in enumerate(names):
            panel = fig.add_subplot(grid[row, column * width : (column + 1) * width])
            _reference(panel, found, name)
            if not column:
                panel.set_ylabel("Share of simulations")
    p = found.p_values["all"]
    assert first is not None  # a target has bins or points
    first.set_title(
        f"{COUNTED[len(found.observed)]} checks together: p = {p:.2g}",
        color=VERMILLION if p < SMALL_P else ink(),
    )
    return heading(fig, found.target.name + " (predicted)" * found.foretold) + key(fig)


def _residuals(ax: Axes, found: Any) -> None:
    f, r = np.asarray(found.target.frequency), np.asarray(found.residual)
    width = float(np.min(np.diff(f)))
    low, high = np.quantile(found.residuals, [0.025, 0.975], axis=0)
    edges = np.append(f - width / 2, f[-1] + width / 2)
    ax.stairs(
        high,
        edges,
        baseline=low,
        fill=True,
        color=shade(0.1),
        zorder=1,
        label="95 % of the simulated data",
    )
    out = (r < low) | (r > high)
    ax.bar(f[~out], r[~out], 0.6 * width, color=BLUE, zorder=3, label="target over fit")
    if out.any():
        ax.bar(
            f[out],
            r[out],
            0.6 * width,
            color=VERMILLION,
            zorder=3,
            label=f"outside ({out.sum()} of {len(f)} bins)",
        )
    ax.axhline(0, color=ink(), lw=0.6, zorder=4)
    reach = 1.15 * max(float(np.abs(r).max()), float(high.max()), float(-low.min()))
    ax.set(
        xlim=(edges[0], edges[-1]),
        ylim=(-reach, reach),
        xlabel="Frequency (Hz)",
        ylabel="Residual (SD)",
    )


def _off(ax: Axes, found: Any) -> None:
    """How far every point of the dynamic stiffness lies from the fit, whatever the direction."""
    f, off = np.asarray(found.target.stiffness.known.frequency), np.abs(found.stiffness_residual)
    high = np.quantile(np.abs(found.stiffness_residuals), 0.95, axis=0)
    ax.fill_between(
        f, 0, high, color=shade(0.1), lw=0, zorder=1, label="95 % of the simulated data"
    )
    out = off > high
    ax.plot(
        f[~out], off[~out], "o", ms=3.5, color=BLUE, zorder=3, label="dynamic stiffness from fit"
    )
    if out.any():
        said = f"above it ({out.sum()} of {len(f)} points)"
        ax.plot(f[out], off[out], "o", ms=3.5, color=VERMILLION, zorder=3, label=said)
    ax.set(
        xlim=(f[0] / 1.1, 1.1 * f[-1]),
        ylim=(0, 1.15 * max(float(off.max()), float(high.max()))),
        xlabel="Frequency (Hz)",
        ylabel="|Residual| (SE)",
    )
    log_axis(ax)


def _reference(ax: Axes, found: Any, name: str) -> None:
    values, seen, p = np.asarray(found.reference[name]), found.observed[name], found.p_values[name]
    if name == "runs":
        edges = np.arange(min(values.min(), seen) - 0.5, max(values.max(), seen) + 1)
    else:
        edges = np.linspace(
            min(values.min(), seen), max(np.quantile(values, 0.999), 1.05 * seen), 30
        )
    ax.hist(values, edges, density=True, color=shade(0.25), zorder=1, label=REFERENCE)
    colour = VERMILLION if p < SMALL_P else BLUE
    ax.axvline(seen, color=colour, lw=1.8, zorder=3, label="value of the target")
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.xaxis.set_major_locator(MaxNLocator(3))
    ax.set_xlabel(TITLES[name])
    ax.set_title(
        f"{seen:{'.0f' if name == 'runs' else '.2f'}}, p = {p:.2g}", color=colour, weight="normal"
    )


@styled
def bootstrap(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
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
    down = -(-len(names) // across)
    fig = canvas(ax, (COLUMN, HEIGHT * down))
    axes = fig.subplots(down, across, squeeze=False)
    done = found.replicates - len(found.failed)
    label = f"{done} refits" + (f" ({len(found.failed)} failed)" if found.failed else "")
    for panel, name in zip(axes.flat, names, strict=False):
        _refits(panel, found.quantities[name], label)
    for panel in axes.flat[len(names) :]:
        panel.remove()
    for panel in axes[:, 0]:
        if len(found.quantities[names[0]].values) >= HISTOGRAM:
            panel.set_ylabel("Refits")
    fitted_to(fig, HEIGHT * down, heading(fig, found.target) + key(fig))
    return fig


def _refits(ax: Axes, q: Any, label: str) -> None:
    low, high = q.true - 1.96 * q.stated, q.true + 1.96 * q.stated
    ax.axvspan(low, high, color=SKY, alpha=0.25, lw=0, zorder=0, label="stated 95 % interval")
    if len(q.values) >= HISTOGRAM:
        ax.hist(
            q.values,
            min(BINS, 2 + len(q.values) // 4),
            color=GREY,
            alpha=0.75,
            zorder=2,
            label=label,
        )
        ax.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    else:
        ax.plot(
            q.values, np.arange(len(q.values)) + 1, "o", ms=3.5, color=GREY, zorder=2, label=label
        )
        ax.set(yticks=[], ylim=(0, len(q.values) + 1))
        ax.spines["left"].set_visible(False)
    ax.axvline(q.true, color=BLUE, lw=1.6, zorder=3, label="true value")
    ax.axvline(
        float(np.mean(q.values)),
        color=VERMILLION,
        lw=1.2,
        ls="--",
        zorder=3,
        label="mean of the refits",
    )
    ax.xaxis.set_major_locator(MaxNLocator(4))
    ax.set_xlabel(textwrap.fill(in_words(q.name, q.unit), 26))
    near, known = q.inside
    said = f"spread/stated {q.ratio:.2f} ± {q.ratio_stderr:.2f}" + (
        f"\n{near} of {known} intervals hold" if known else ""
    )
    ax.set_title(said, weight="normal", color=ink() if q.verdict == "holds" else VERMILLION)
