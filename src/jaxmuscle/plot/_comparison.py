"""The figure of a comparison of noises: how the best of each fits, and whether they can be told
apart."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._spectra import target
from ._style import (
    GREY,
    PALETTE,
    PER_BIN,
    AnyFigure,
    Style,
    finish,
    ink,
    log_axis,
    panels,
    shade,
    styled,
    without_legend,
)

SPECTRA, ROW = 2.4, 0.24  # inches
MARK: Style = {"ms": 5.5, "zorder": 3}
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (5, 1, 1, 1)))


@styled
def comparison(comparison: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws the best fit of each noise, and AIC and held-out score of every model.

    Which can be told apart is what `print(comparison)` says.
    """
    rows = sorted(comparison.rows, key=lambda row: row.aic)
    heights = SPECTRA, 0.9 + ROW * len(rows)
    fig, (spectra, criterion, scores) = panels(ax, "AA;BC", heights)
    names = dict.fromkeys(row.noise for row in comparison.rows)
    colours = {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(names)}
    # of every model: filled with a harmonic, open without
    marks = [
        MARK | {"color": colours[row.noise]} | ({} if row.harmonic else {"mfc": "none"})
        for row in rows
    ]
    _spectra(spectra, comparison, colours)
    _criterion(criterion, rows, marks)
    _scores(scores, rows, marks)
    return finish(fig, heights, comparison.target.name)


def _spectra(ax: Axes, comparison: Any, colours: dict[str, str]) -> None:
    target(comparison.target, ax, log=True)
    ax.lines[0].set(label="target", linewidth=0.0)
    frequency, power = comparison.target.frequency, comparison.target.proportional_power
    for number, noise in enumerate(comparison.noises):
        best = comparison.of(noise)
        ax.plot(
            frequency,
            comparison.fitted[noise, best.harmonic],
            label=best.label,
            color=colours[noise],
            ls=DASHES[number % len(DASHES)],
            lw=1.3,
            zorder=5 - 0.1 * number,
        )
    ax.set(title="Best fit of each noise", ylim=(0.5 * power.min(), 2 * power.max()))
    log_axis(ax, "y")
    without_legend(ax).set_ylabel(PER_BIN)


def _criterion(ax: Axes, rows: list[Any], marks: list[dict[str, Any]]) -> None:
    """AIC above the lowest."""
    needed, above = rows[0].needed, np.array([row.delta_aic for row in rows])
    ax.axvspan(0, needed, color=shade(0.15), lw=0, zorder=0)
    for i, mark in enumerate(marks):
        ax.plot(above[i], i, "o", **mark)
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
    span = max(1.6 * needed, 1.1 * np.max(above, where=np.isfinite(above), initial=0.0))
    ax.set(xlim=(-0.06 * span, span))
    near = bool(np.any(above[1:] < needed))
    ax.set_xlabel("AIC above the lowest" + "\n(grey: not told apart)" * near)


def _scores(ax: Axes, rows: list[Any], marks: list[dict[str, Any]]) -> None:
    """Held-out score minus that of the model of lowest AIC; none of a search that did not come to
    its end."""
    _rows(ax, [""] * len(rows))
    said: Style = {"va": "center", "color": GREY}
    if rows[0].scores is None:
        ax.set(xticks=[])
        words = "no bins left out:\nno segments"
        ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", **said)
        return
    ax.axvline(0, color=ink(), lw=0.6, zorder=1)
    for i, (row, mark) in enumerate(zip(rows, marks, strict=True)):
        if row.success:
            error = row.score_stderr or None
            ax.errorbar(row.score_difference, i, xerr=error, fmt="o", capsize=2, lw=1, **mark)
        else:
            ax.text(0.02, i, "not converged", transform=ax.get_yaxis_transform(), **said)
    ax.set_xlabel("Held-out score minus that\nof the lowest AIC (± SE)")


def _rows(ax: Axes, labels: list[str]) -> None:
    ax.set_yticks(range(len(labels)), labels)
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.grid(axis="y", color=shade(0.1), lw=0.5)
