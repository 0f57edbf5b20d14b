"""The figure of a recording, for `Recording.plot`: is the window steady, and what is in its
spectrum?"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ._style import (
    BLUE,
    GREY,
    ORANGE,
    SKY,
    AnyFigure,
    Style,
    canvas,
    density_unit,
    finish,
    frequency_axes,
    ink,
    panels,
    positive,
    styled,
)

MOST = 8  # traces of trials that are drawn
DOTS: Style = {"lw": 1.0, "marker": "o", "ms": 2.8}


@styled
def recording(recording: Any, settings: Any = None, ax: Axes | None = None) -> AnyFigure:
    """Draws a recording: the trace with its window, the window larger, and its spectra (Welch,
    FFT).

    `settings`: `SpectrumSettings` or a name, as of `Recording.spectrum`.
    """
    heights = (1.1, 1.3, 2.0)
    fig, (whole, window, panel) = panels(ax, "A;B;C", heights)
    whole_trace(whole, recording, "window", color=BLUE, lw=0.7)
    _window(window, recording, settings)
    for trace, title in ((whole, "Whole recording"), (window, "Window")):
        trace.margins(x=0)
        trace.set(title=title, xlabel="Time (s)")
        trace.set_ylabel(f"{_quantity(recording)} ({recording.unit})", parse_math=False)
    welch, fft = recording.spectrum(settings), recording.fft_spectrum(settings)
    band = recording.target("welch", quantity="force", settings=settings).sampling_band()
    label = f"Welch, {recording.segments(settings)} segments"
    f, power = np.asarray(welch.frequency), np.asarray(welch.power)
    style: Style = {"color": GREY, "lw": 0.6, "alpha": 0.8, "zorder": 2}
    slow = positive(np.asarray(fft.frequency), True)
    panel.plot(fft.frequency[slow], fft.power[slow], label="FFT of the window", **style)
    shown = positive(f, True)
    if band:
        edges = (edge[shown] * np.sum(power) for edge in band)
        area: Style = {"color": BLUE, "alpha": 0.2, "lw": 0, "zorder": 3}
        panel.fill_between(f[shown], *edges, label="± 1 SD", **area)
    panel.plot(f[shown], power[shown], color=ink(), label=label, zorder=4, **DOTS)
    _spectrum_axes(panel, welch.unit)
    return finish(fig, heights, recording.name)


@styled
def trials(trials: Any, settings: Any = None, ax: Axes | None = None) -> AnyFigure:
    """Draws several recordings below each other, each with its window, and their spectra with the
    mean.

    On the left each whole recording with the window shaded, on the right the window larger,
    low-passed. Below these the spectra. `settings`: `SpectrumSettings` or a name, as of
    `Recording.spectrum`.
    """
    if len(trials) == 1:
        return recording(trials[0], settings, ax)
    shown = trials[:MOST]
    heights = [0.7] * len(shown) + [2.1]
    fig = canvas(ax, heights)
    grid = fig.add_gridspec(len(heights), 2, height_ratios=heights)
    whole = window = None
    for row, one in enumerate(shown):
        last = row == len(shown) - 1
        whole = fig.add_subplot(grid[row, 0], sharex=whole, sharey=whole)
        whole_trace(whole, one, None if row else "window: what is analysed", color=BLUE, lw=0.5)
        window = fig.add_subplot(grid[row, 1], sharex=window, sharey=window)
        x = one.filtered(settings)
        window.plot(np.arange(x.size) * one.duration / x.size, x, color=BLUE, lw=0.5)
        for panel, title, abscissa in (
            (whole, one.name, "Time (s)"),
            (window, "" if row else "Window", "Time in the window (s)"),
        ):
            panel.set_title(title, pad=2.0, weight="normal", parse_math=False)
            panel.set_xlabel(abscissa if last else "")
            panel.set_ylabel(f"{_quantity(one)}\n({one.unit})", parse_math=False)
            panel.margins(x=0)
            panel.tick_params(labelbottom=last)
            panel.yaxis.set_major_locator(MaxNLocator(2, prune="both", min_n_ticks=2))
    mean, each = trials.spectrum(settings), [one.spectrum(settings) for one in trials]
    panel = fig.add_subplot(grid[-1, :])
    shown_bins = positive(np.asarray(mean.frequency), True)
    for number, one in enumerate(each):
        label = None if number else f"{len(each)} trials"
        power = one.power[shown_bins]
        panel.plot(one.frequency[shown_bins], power, color=GREY, lw=0.6, label=label)
    frequency, power = mean.frequency[shown_bins], mean.power[shown_bins]
    panel.plot(frequency, power, color=ink(), label="mean", **DOTS)
    _spectrum_axes(panel, mean.unit)
    more = f", {len(shown)} shown" if len(shown) < len(trials) else ""
    return finish(fig, heights, f"{_quantity(trials[0])} of {len(trials)} trials{more}")


def whole_trace(
    ax: Axes, recording: Any, label: str | None, scale: float = 1.0, **style: Any
) -> None:
    """The whole recording, with its window shaded and called so."""
    time = recording.start + np.arange(recording.whole.size) / recording.rate
    ax.plot(time, scale * recording.whole, **style)
    if recording.window is not None:
        ax.axvspan(*recording.window, color=ORANGE, alpha=0.25, lw=0, label=label)


def _quantity(recording: Any) -> str:
    return (recording.quantity or "signal").capitalize()


def _window(ax: Axes, recording: Any, settings: Any) -> None:
    x, time = recording.filtered(settings), recording.time
    ax.plot(time, recording.samples, color=SKY, lw=0.5, label="as recorded")
    filtered = time[0] + np.arange(x.size) / (x.size / recording.duration)
    ax.plot(filtered, x, color=BLUE, lw=0.9, label="filtered")
    ax.axhline(float(np.mean(x)), color=GREY, lw=0.6, ls="--")


def _spectrum_axes(ax: Axes, unit: str) -> None:
    frequency_axes(ax, True, f"Power ({density_unit(unit)})")
    ax.set_title("Spectrum")
