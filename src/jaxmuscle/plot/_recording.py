"""The figure of a recording, for `Recording.plot`: is the window steady, and what is in its
spectrum?"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator

from ._style import (
    BLUE,
    COLUMN,
    GREY,
    ORANGE,
    SKY,
    canvas,
    density_unit,
    fitted_to,
    heading,
    ink,
    key,
    log_axis,
    styled,
)

MOST = 8  # traces of trials that are drawn


@styled
def recording(recording: Any, settings: Any = None, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a recording: the trace with its window, the window larger, and its spectra (Welch,
    FFT), linear, logarithmic.

    `settings`: `SpectrumSettings` or a name, as of `Recording.spectrum`.
    """
    heights = (1.2, 1.4, 1.9)
    fig = canvas(ax, (COLUMN, sum(heights)))
    grid = fig.add_gridspec(3, 2, height_ratios=heights)
    _trace(fig.add_subplot(grid[0, :]), recording)
    _window(fig.add_subplot(grid[1, :]), recording, settings)
    welch, fft = recording.spectrum(settings), recording.fft_spectrum(settings)
    band = recording.target("welch", quantity="force", settings=settings).sampling_band()
    edges = [edge * np.sum(welch.power) for edge in band or ()]
    label = f"Welch, {recording.segments(settings)} segments"
    for column, log in enumerate((False, True)):
        _spectra(fig.add_subplot(grid[2, column]), welch, fft, edges, label, log)
    fitted_to(fig, sum(heights), heading(fig, recording.name) + key(fig))
    return fig


@styled
def trials(trials: Any, settings: Any = None, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws several recordings below each other, each with its window, and their spectra with the
    mean.

    On the left each whole recording with the window shaded, on the right the window larger,
    low-passed. Below these the spectra, linear and logarithmic. `settings`: `SpectrumSettings` or a
    name, as of `Recording.spectrum`.
    """
    if len(trials) == 1:
        return recording(trials[0], settings, ax)
    shown = trials[:MOST]
    heights = [0.55] * len(shown) + [2.1]
    fig = canvas(ax, (COLUMN, sum(heights)))
    grid = fig.add_gridspec(len(heights), 2, height_ratios=heights)
    whole = window = None
    for row, one in enumerate(shown):
        last = row == len(shown) - 1
        whole = fig.add_subplot(grid[row, 0], sharex=whole, sharey=whole)
        whole.plot(one.start + np.arange(one.whole.size) / one.rate, one.whole, color=BLUE, lw=0.5)
        if one.window is not None:
            whole.axvspan(
                *one.window,
                color=ORANGE,
                alpha=0.25,
                lw=0,
                label=None if row else "window: what is analysed",
            )
        whole.set_title(one.name, pad=2.0, weight="normal", parse_math=False)
        _label(whole, "Time (s)" if last else "", f"({one.unit})")
        x = one.filtered(settings)
        window = fig.add_subplot(grid[row, 1], sharex=window, sharey=window)
        window.plot(np.arange(x.size) * one.duration / x.size, x, color=BLUE, lw=0.5)
        window.set_title("" if row else "Window", pad=2.0, weight="normal")
        _label(window, "Time in the window (s)" if last else "", f"({one.unit})")
        for panel in (whole, window):
            panel.margins(x=0)
            panel.tick_params(labelbottom=last)
            panel.yaxis.set_major_locator(MaxNLocator(2, prune="both", min_n_ticks=2))
    mean, each = trials.spectrum(settings), [one.spectrum(settings) for one in trials]
    for column, log in enumerate((False, True)):
        panel = fig.add_subplot(grid[-1, column])
        for one in each:
            panel.plot(
                one.frequency,
                one.power,
                color=GREY,
                lw=0.6,
                label=f"{len(each)} trials" if one is each[0] else None,
            )
        panel.plot(
            mean.frequency, mean.power, color=ink(), lw=1.0, marker="o", ms=2.8, label="mean"
        )
        _spectrum_axes(panel, mean.unit, log)
    words = f"{(trials[0].quantity or 'signal').capitalize()} of {len(trials)} trials"
    more = f", {len(shown)} shown" if len(shown) < len(trials) else ""
    fitted_to(fig, sum(heights), heading(fig, words + more) + key(fig))
    return fig


def _trace(ax: Axes, recording: Any) -> None:
    time = recording.start + np.arange(recording.whole.size) / recording.rate
    ax.plot(time, recording.whole, color=BLUE, lw=0.7)
    if recording.window is not None:
        ax.axvspan(*recording.window, color=ORANGE, alpha=0.25, lw=0, label="window")
    ax.margins(x=0)
    _label(ax, "Time (s)", f"{(recording.quantity or 'signal').capitalize()} ({recording.unit})")
    ax.set_title("Whole recording")


def _window(ax: Axes, recording: Any, settings: Any) -> None:
    x, time = recording.filtered(settings), recording.time
    ax.plot(time, recording.samples, color=SKY, lw=0.5, label="as recorded")
    ax.plot(
        time[0] + np.arange(x.size) / (x.size / recording.duration),
        x,
        color=BLUE,
        lw=0.9,
        label="filtered",
    )
    ax.axhline(float(np.mean(x)), color=GREY, lw=0.6, ls="--")
    ax.margins(x=0)
    _label(ax, "Time (s)", f"{(recording.quantity or 'signal').capitalize()} ({recording.unit})")
    ax.set_title("Window")


def _spectra(ax: Axes, welch: Any, fft: Any, band: list[Any], label: str, log: bool) -> None:
    f, power = np.asarray(welch.frequency), np.asarray(welch.power)
    shown = slice(None) if not log else f > 0
    ax.plot(
        fft.frequency, fft.power, color=GREY, lw=0.6, alpha=0.8, label="FFT of the window", zorder=2
    )
    if band:
        ax.fill_between(
            f[shown],
            band[0][shown],
            band[1][shown],
            color=BLUE,
            alpha=0.2,
            lw=0,
            label="± 1 SD",
            zorder=3,
        )
    ax.plot(f[shown], power[shown], color=ink(), lw=1.0, marker="o", ms=2.8, label=label, zorder=4)
    _spectrum_axes(ax, welch.unit, log)


def _spectrum_axes(ax: Axes, unit: str, log: bool) -> None:
    _label(ax, "Frequency (Hz)", f"Power ({density_unit(unit)})")
    ax.set_title("Logarithmic" if log else "Linear")
    if log:
        log_axis(ax, "y")
        log_axis(ax)
    else:
        ax.set_xlim(left=0, auto=None)
        ax.set_ylim(bottom=0, auto=None)


def _label(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y, parse_math=False)
