"""Figures of the two checks of a fit: its residuals against their reference, and refits against the stated errors."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator

from ._style import BLACK, BLUE, GREY, SKY, VERMILLION, canvas, styled

TITLES = {"chi2_per_bin": "χ² per bin", "runs": "Runs of equal sign", "largest": "Largest |residual| (SD)"}
SMALL_P = 0.05
HISTOGRAM, BINS = 15, 24  # refits from which on they are drawn as a histogram; its bins
WIDTH, HEIGHT, ACROSS = 3.4, 2.2, 2  # inches, inches, panels
PALE = "0.80"


@styled
def goodness(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws residuals with what is usual in each bin, and the three checks with their reference distributions."""
    fig = canvas(ax, (7.2, 4.6 * len(found.parts)))
    places = fig.subfigures(len(found.parts), 1, squeeze=False)[:, 0] if len(found.parts) > 1 else [fig]
    for place, part in zip(places, found.parts.values(), strict=True):
        _goodness(place, part)
    return fig


def _goodness(fig: Any, found: Any) -> None:
    grid = fig.add_gridspec(2, 3, height_ratios=(1.15, 1.0))
    _residuals(fig.add_subplot(grid[0, :]), found)
    for column, name in enumerate(TITLES):
        _reference(fig.add_subplot(grid[1, column]), found, name)
    kind = "Foretold" if found.foretold else "Fitted"
    title = f"{kind}: {found.target.name}, all three checks together p = {found.p_values['all']:.2g}"
    fig.suptitle(title, x=0.01, ha="left", fontsize=9, fontweight="bold", parse_math=False)


def _residuals(ax: Axes, found: Any) -> None:
    f, r = np.asarray(found.target.frequency), np.asarray(found.residual)
    width = float(np.min(np.diff(f)))
    low, high = np.quantile(found.residuals, [0.025, 0.975], axis=0)
    edges = np.append(f - width / 2, f[-1] + width / 2)
    ax.stairs(high, edges, baseline=low, fill=True, color="0.90", zorder=1, label="95 % of fitted replicates")
    out = (r < low) | (r > high)
    ax.bar(f[~out], r[~out], 0.6 * width, color=BLUE, zorder=3, label="residual")
    if out.any():
        ax.bar(f[out], r[out], 0.6 * width, color=VERMILLION, zorder=3, label=f"outside ({out.sum()} of {len(f)} bins)")
    ax.axhline(0, color=BLACK, lw=0.6, zorder=4)
    reach = 1.15 * max(float(np.abs(r).max()), float(high.max()), float(-low.min()))
    ax.set(xlim=(edges[0], edges[-1]), ylim=(-reach, reach), xlabel="Frequency (Hz)", ylabel="Residual (SD of log power)")
    ax.set_title("Target above (+) or below (–) fit")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, borderaxespad=0.0)


def _reference(ax: Axes, found: Any, name: str) -> None:
    values, seen, p = np.asarray(found.reference[name]), found.observed[name], found.p_values[name]
    if name == "runs":
        edges = np.arange(min(values.min(), seen) - 0.5, max(values.max(), seen) + 1)
    else:
        edges = np.linspace(min(values.min(), seen), max(np.quantile(values, 0.999), 1.05 * seen), 30)
    ax.hist(values, edges, density=True, color=PALE, zorder=1)
    colour = VERMILLION if p < SMALL_P else BLUE
    ax.axvline(seen, color=colour, lw=1.8, zorder=3)
    digits = ".0f" if name == "runs" else ".2f"
    left = seen > 0.5 * (edges[0] + edges[-1])
    ax.margins(y=0.22)
    ax.annotate(
        f"{seen:{digits}}\np = {p:.2g}",
        (seen, 0.98),
        xycoords=("data", "axes fraction"),
        xytext=(-4 if left else 4, 0),
        textcoords="offset points",
        va="top",
        ha="right" if left else "left",
        color=colour,
    )
    ax.set_yticks([])
    ax.spines["left"].set_visible(False)
    ax.set_xlabel(TITLES[name])
    if name == "chi2_per_bin":
        ax.set_title("Here (line) and among replicates")


@styled
def bootstrap(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the refits of every quantity, the value they were made from and the interval that the fit states.

    **Raises:** `ValueError` if fewer than two refits succeeded.
    """
    names = list(found.quantities)
    if not names:
        raise ValueError(f"{found.target}: fewer than two refits succeeded, so there is nothing to draw")
    across = min(ACROSS, len(names))
    down = -(-len(names) // across)
    fig = canvas(ax, (WIDTH * across + 0.2, HEIGHT * down + 0.6))
    axes = fig.subplots(down, across, squeeze=False)
    for panel, name in zip(axes.flat, names, strict=False):
        _refits(panel, found.quantities[name])
    for panel in axes.flat[len(names) :]:
        panel.remove()
    handles, labels = axes.flat[0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    lost = f", {len(found.failed)} failed" if found.failed else ""
    fig.suptitle(f"{found.target}: {found.replicates - len(found.failed)} refits of data made from the fit{lost}",
                 x=0.01, ha="left", fontsize=9, fontweight="bold", parse_math=False)  # fmt: skip
    return fig


def _refits(ax: Axes, q: Any) -> None:
    low, high = q.true - 1.96 * q.stated, q.true + 1.96 * q.stated
    ax.axvspan(low, high, color=SKY, alpha=0.25, lw=0, zorder=0, label="stated 95 % interval")
    if len(q.values) >= HISTOGRAM:
        ax.hist(q.values, min(BINS, 2 + len(q.values) // 4), color=GREY, alpha=0.75, zorder=2, label="refits")
        ax.set_ylabel("Refits")
        ax.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    else:
        ax.plot(q.values, np.arange(len(q.values)) + 1, "o", ms=3.5, color=GREY, zorder=2, label="refits")
        ax.set(yticks=[], ylim=(0, len(q.values) + 1))
        ax.spines["left"].set_visible(False)
    ax.axvline(q.true, color=BLUE, lw=1.6, zorder=3, label="made from")
    ax.axvline(float(np.mean(q.values)), color=VERMILLION, lw=1.2, ls="--", zorder=3, label="mean of refits")
    ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.set_xlabel(q.name.replace("_", " ") + ("" if q.unit in ("", "1") else f" ({q.unit})"))
    near, known = q.inside
    share = "" if known == 0 else f"; intervals hold {near}/{known}"
    ax.set_title(f"spread / stated {q.ratio:.2f} ± {q.ratio_stderr:.2f}{share}", fontsize=7.5, fontweight="normal",
                 color=BLACK if q.verdict == "holds" else VERMILLION)  # fmt: skip
