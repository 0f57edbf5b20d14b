"""The figure of a joint fit: every target with its fit and residuals, and what they determine together."""

import textwrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._fit import quantity
from ._spectra import target
from ._style import BLACK, BLUE, GREY, ORANGE, VERMILLION, canvas, legend, styled

WIDTH, PANEL, LINE, FONT = 8.5, 2.1, 0.165, 7.5  # inches, inches, inches, points
WRAP = 126
PLACES = (0.58, 0.60, 0.85)


@styled
def joint(result: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a joint fit: spectrum, fit and residuals of each target, and what they determine together."""
    header = _header(result)
    free = {name: p for name, p in result.parameters.items() if p.free}
    rows = max(len(free), len(result.derived), 1) + 1
    open_now = [line for sentence in result.undetermined for line in textwrap.wrap(f"•  {sentence}", WRAP)]
    notes = ["All targets together leave open:", *open_now] if open_now else []
    heights = [
        LINE * (len(header) + 0.5),
        *[PANEL] * len(result.parts),
        LINE * (rows + 1),
        *[LINE * len(notes)] * bool(notes),
    ]
    fig = canvas(ax, (WIDTH, sum(heights) + 0.9), w_pad=0.06, h_pad=0.05)
    grid = fig.add_gridspec(len(heights), 2, height_ratios=heights)
    _text(fig.add_subplot(grid[0, :]), header)
    for row, (name, part) in enumerate(result.parts.items(), start=1):
        _spectrum(fig.add_subplot(grid[row, 0]), name, part)
        _residuals(fig.add_subplot(grid[row, 1]), part, last=row == len(result.parts))
    below = 1 + len(result.parts)
    _table(fig.add_subplot(grid[below, 0]), "Fitted parameters", free, rows)
    _table(fig.add_subplot(grid[below, 1]), "Derived quantities", result.derived, rows)
    if notes:
        _text(
            fig.add_subplot(grid[below + 1, :]),
            [(line, {"weight": "bold"} if not i else {}) for i, line in enumerate(notes)],
        )
    return fig


def _header(result: Any) -> list[tuple[str, dict[str, Any]]]:
    verdict, colour = ("Converged", "#00664A") if result.success else ("Did not converge", VERMILLION)
    lines = [(", ".join(result.parts), {"size": 11, "weight": "bold"})]
    for name, part in result.parts.items():
        told = f"{name}: {part.target.name} ({part.target.provenance} {part.target.quantity}), {type(part.task).__name__}"
        told += "" if part.chi2_per_bin is None else f", χ² per bin {part.chi2_per_bin:.2f}"
        lines += [(line, {}) for line in textwrap.wrap(told, WRAP)]
    lines += [(line, {"color": colour}) for line in textwrap.wrap(f"{verdict}: {result.message}", WRAP)]
    for notice in result.notices:
        lines += [(line, {"color": GREY}) for line in textwrap.wrap(f"Note: {notice}", WRAP, max_lines=3, placeholder=" …")]
    return lines


def _text(ax: Axes, lines: list[tuple[str, dict[str, Any]]]) -> None:
    ax.axis("off")
    ax.set(xlim=(0, 1), ylim=(len(lines) + 0.3, 0))
    for i, (text, style) in enumerate(lines):
        _say(ax, 0.0, i + 0.5 + 0.2 * (i > 0), text, **({"size": FONT} | style))


def _say(ax: Axes, x: float, y: float, text: str, **style: Any) -> None:
    ax.text(x, y, text, va="center", parse_math=False, **style).set_in_layout(False)


def _spectrum(ax: Axes, name: str, part: Any) -> None:
    target(part.target, ax, log=True)
    frequency, fitted = np.asarray(part.target.frequency), np.asarray(part.fitted)
    dots = ax.lines[0]
    dots.set_label("target")
    if np.isfinite(fitted).all():
        dots.set_linewidth(0.0)
        ax.plot(frequency, fitted, color=BLUE, label="fit", zorder=4)
        line = fitted * np.asarray(part.harmonic_share)
        held = line > 0.01 * fitted
        near = held | np.roll(held, 1) | np.roll(held, -1)
        ax.fill_between(frequency, fitted - np.minimum(line, 0.999 * fitted), fitted, where=near, color=ORANGE, alpha=0.6,
                        lw=0, label="harmonic", zorder=2)  # fmt: skip
    edges = np.concatenate([part.target.proportional_power, fitted, *(part.target.sampling_band() or ())])
    edges = edges[np.isfinite(edges) & (edges > 0)]
    ax.set(ylim=(edges.min() / 1.4, edges.max() * 1.4), xlim=(frequency[frequency > 0][0] / 1.15, frequency[-1] * 1.15))
    ax.set_title(f"{name}: {type(part.task).__name__}", parse_math=False)
    legend(ax, "lower left")


def _residuals(ax: Axes, part: Any, *, last: bool) -> None:
    frequency, residual = np.asarray(part.target.frequency), np.asarray(part.residual)
    known = part.deviation is not None
    shown = np.where(np.isfinite(residual), residual, 0.0)
    outside = np.abs(shown) > 2 if known else np.zeros(shown.shape, bool)
    ax.bar(frequency, shown, 0.7 * np.min(np.diff(frequency)), color=np.where(outside, VERMILLION, BLUE), zorder=3)
    reach = max(3.0 if known else 0.1, 1.1 * float(np.abs(shown).max()))
    for deviations, shade in ((2, "0.94"), (1, "0.87")) if known else ():
        ax.axhspan(-deviations, deviations, color=shade, lw=0, zorder=0)
    ax.axhline(0, color=BLACK, lw=0.6, zorder=4)
    ax.set(xlim=(0, frequency[-1] + frequency[0]), ylim=(-reach, reach), xlabel="Frequency (Hz)")
    ax.set_ylabel("Residual (SD)" if known else "Residual (ln units)")
    ax.set_title("Target above (+) or below (–) fit")


def _table(ax: Axes, title: str, estimates: dict[str, Any], rows: int) -> None:
    ax.axis("off")
    ax.set(xlim=(0, 1), ylim=(rows + 1.0, 0))
    _say(ax, 0.0, 0.5, title, weight="bold", size=8)
    ax.axhline(1.0, color=BLACK, lw=0.6)
    for x, head, side in zip(PLACES, ("value", "± standard error", "unit"), ("right", "left", "left"), strict=True):
        _say(ax, x, 0.5, head, ha=side, color=GREY, size=FONT - 1)
    for i, (name, estimate) in enumerate(estimates.items()):
        style = {"size": FONT - 0.5, "color": BLACK if estimate.identifiable else GREY}
        _say(ax, 0.0, 1.6 + i, name if len(name) <= 31 else f"{name[:17]}…{name[-12:]}", **style)
        for x, cell, side in zip(PLACES, quantity(estimate), ("right", "left", "left"), strict=True):
            _say(ax, x, 1.6 + i, cell, ha=side, **style)
