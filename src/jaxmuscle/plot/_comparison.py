"""The figure of a comparison of noises: how the best of each fits, and whether they can be told
apart."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._spectra import target
from ._style import (
    COLUMN,
    GREY,
    PALETTE,
    canvas,
    fitted_to,
    heading,
    ink,
    key,
    log_axis,
    shade,
    styled,
    without_legend,
)

SPECTRA, ROW = 2.4, 0.24  # inches
MARK: dict[str, Any] = {"ms": 5.5, "zorder": 3}
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (5, 1, 1, 1)))


@styled
def comparison(comparison: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the best fit of each noise, and AIC and held-out score of every model.

    Which can be told apart is what `print(comparison)` says.
    """
    rows = sorted(comparison.rows, key=lambda row: row.aic)
    heights = SPECTRA, 0.9 + ROW * len(rows)
    fig = canvas(ax, (COLUMN, sum(heights)))
    grid = fig.add_gridspec(2, 2, height_ratios=heights)
    names = dict.fromkeys(row.noise for row in comparison.rows)
    colours = {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(names)}
    _spectra(fig.add_subplot(grid[0, :]), comparison, colours)
    _criterion(fig.add_subplot(grid[1, 0]), rows, colours)
    _scores(fig.add_subplot(grid[1, 1]), rows, colours)
    fitted_to(fig, sum(heights), heading(fig, comparison.target.name) + key(fig))
    return fig


def _spectra(ax: Axes, comparison: Any, colours: dict[str, str]) -> None:
    target(comparison.target, ax, log=True)
    dots = ax.lines[0]
    dots.set_label("target")
    dots.set_linewidth(0.0)
    frequency, power = comparison.target.frequency, comparison.target.proportional_power
    for number, noise in enumerate(comparison.noises):
        best = comparison.of(noise)
        style = {
            "color": colours[noise],
            "ls": DASHES[number % len(DASHES)],
            "lw": 1.3,
            "zorder": 5 - 0.1 * number,
        }
        ax.plot(frequency, comparison.fitted[noise, best.harmonic], label=best.label, **style)
    ax.set(title="Best fit of each noise", ylim=(0.5 * power.min(), 2 * power.max()))
    log_axis(ax, "y")
    without_legend(ax).set_ylabel("Power (fraction per bin)")


def _criterion(ax: Axes, rows: list[Any], colours: dict[str, str]) -> None:
    """AIC above the lowest; filled with a harmonic, open without."""
    ax.axvspan(0, rows[0].needed, color=shade(0.15), lw=0, zorder=0)
    for i, row in enumerate(rows):
        ax.plot(row.delta_aic, i, "o", color=colours[row.noise], mfc=_face(row, colours), **MARK)
    if len({row.harmonic for row in rows}) > 1:
        for name, face in (("with harmonic", GREY), ("without", "none")):
            ax.plot([], [], "o", color=GREY, mfc=face, label=name, **MARK)
        ax.legend(
            loc="lower right",
            bbox_to_anchor=(1.02, 1.0),
            ncols=2,
            borderaxespad=0.0,
            columnspacing=0.8,
            handletextpad=0.1,
        )
    _rows(ax, [row.noise for row in rows])
    near = any(row.delta_aic < row.needed for row in rows[1:])
    ax.set(xlim=(-0.06 * _span(rows), _span(rows)))
    ax.set_xlabel("AIC above the lowest" + "\n(grey: not told apart)" * near)


def _span(rows: list[Any]) -> float:
    return max(
        1.6 * rows[0].needed,
        1.1 * max((row.delta_aic for row in rows if np.isfinite(row.delta_aic)), default=0.0),
    )


def _scores(ax: Axes, rows: list[Any], colours: dict[str, str]) -> None:
    """Held-out score minus that of the model of lowest AIC; none of a search that did not come to
    its end."""
    _rows(ax, [""] * len(rows))
    if rows[0].scores is None:
        ax.set(xticks=[])
        ax.text(
            0.5,
            0.5,
            "no bins left out:\nno segments",
            transform=ax.transAxes,
            ha="center",
            va="center",
            color=GREY,
        )
        return
    ax.axvline(0, color=ink(), lw=0.6, zorder=1)
    for i, row in enumerate(rows):
        if not row.success:
            ax.text(
                0.02,
                i,
                "not converged",
                transform=ax.get_yaxis_transform(),
                va="center",
                color=GREY,
            )
            continue
        error = row.score_stderr or None
        ax.errorbar(
            row.score_difference,
            i,
            xerr=error,
            fmt="o",
            capsize=2,
            lw=1,
            color=colours[row.noise],
            mfc=_face(row, colours),
            **MARK,
        )
    ax.set_xlabel("Held-out score minus that\nof the lowest AIC (± SE)")


def _rows(ax: Axes, labels: list[str]) -> None:
    ax.set_yticks(range(len(labels)), labels)
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.grid(axis="y", color=shade(0.1), lw=0.5)


def _face(row: Any, colours: dict[str, str]) -> str:
    return colours[row.noise] if row.harmonic else "none"
