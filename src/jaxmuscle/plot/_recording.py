"""The figure of a recording, for `Recording.plot`: is the window steady, and what is in its spectrum?"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ._style import BLACK, BLUE, GREY, ORANGE, SKY, canvas, density_unit, legend, styled

MOST = 8  # traces of trials that are drawn


@styled
def recording(recording: Any, settings: Any = None, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a recording: the trace with its window, and its spectra (Welch, FFT), linear and logarithmic."""
    fig = canvas(ax, (9.0, 5.6))
    axes = fig.subplots(2, 2)
    _trace(axes[0, 0], recording)
    _window(axes[0, 1], recording, settings)
    welch, fft = recording.spectrum(settings), recording.fft_spectrum(settings)
    target = recording.target("welch", quantity="force", settings=settings)
    band = [edge * np.sum(welch.power) for edge in target.sampling_band() or ()]
    for panel, log in ((axes[1, 0], False), (axes[1, 1], True)):
        _spectra(panel, welch, fft, band, log)
    words = f"{target.settings.name or 'own'} spectrum, {recording.segments(settings)} Welch segments"
    fig.suptitle(f"{recording.source}; {words}", x=0.01, ha="left", fontsize=8.0, parse_math=False)
    return fig


@styled
def trials(trials: Any, settings: Any = None, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the windows of several recordings below each other, and their spectra with the mean, linear and logarithmic."""
    if len(trials) == 1:
        return recording(trials[0], settings, ax)
    fig, shown = canvas(ax, (9.0, 5.6)), trials[:MOST]
    traces, spectra = fig.subfigures(1, 2, squeeze=False, width_ratios=(1.0, 1.3))[0]
    rows = traces.subplots(len(shown), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for panel, one in zip(rows, shown, strict=True):
        x = one.filtered(settings)
        panel.plot(np.arange(x.size) * one.duration / x.size, x, color=BLUE, lw=0.6)
        panel.set_title(
            one.name if len(shown) == len(trials) else f"{one.name} (of {len(trials)} trials)",
            loc="left",
            fontsize=7.0,
            pad=2.0,
            parse_math=False,
        )
        panel.margins(x=0)
        _label(panel, "", trials[0].unit)
    rows[-1].set_xlabel("Time in the window (s)")
    traces.supylabel((trials[0].quantity or "signal").capitalize(), fontsize=8.0)
    mean, each = trials.spectrum(settings), [one.spectrum(settings) for one in trials]
    for panel, log in zip(spectra.subplots(2, 1), (False, True), strict=True):
        for one in each:
            panel.plot(one.frequency, one.power, color=GREY, lw=0.6, label="trials" if one is each[0] else None)
        panel.plot(mean.frequency, mean.power, color=BLACK, lw=1.0, marker="o", ms=2.8, label=f"mean of {len(each)}")
        _spectrum_axes(panel, mean.unit, log)
    return fig


def _trace(ax: Axes, recording: Any) -> None:
    time = recording.start + np.arange(recording.whole.size) / recording.rate
    ax.plot(time, recording.whole, color=BLUE, lw=0.7)
    if recording.window is not None:
        ax.axvspan(*recording.window, color=ORANGE, alpha=0.25, lw=0, label="window")
        legend(ax, "above")
    ax.margins(x=0)
    _label(ax, "Time (s)", f"{(recording.quantity or 'signal').capitalize()} ({recording.unit})")
    ax.set_title("Whole recording")


def _window(ax: Axes, recording: Any, settings: Any) -> None:
    x, time = recording.filtered(settings), recording.time
    ax.plot(time, recording.samples, color=SKY, lw=0.5, label="as recorded")
    ax.plot(time[0] + np.arange(x.size) / (x.size / recording.duration), x, color=BLUE, lw=0.9, label="filtered")
    ax.axhline(float(np.mean(x)), color=GREY, lw=0.6, ls="--")
    ax.margins(x=0)
    _label(ax, "Time (s)", f"{(recording.quantity or 'signal').capitalize()} ({recording.unit})")
    ax.set_title("Window")
    legend(ax, "above")


def _spectra(ax: Axes, welch: Any, fft: Any, band: list[Any], log: bool) -> None:
    f, power = np.asarray(welch.frequency), np.asarray(welch.power)
    shown = slice(None) if not log else f > 0
    ax.plot(fft.frequency, fft.power, color=GREY, lw=0.6, alpha=0.8, label="FFT of the window", zorder=2)
    if band:
        ax.fill_between(f[shown], band[0][shown], band[1][shown], color=BLUE, alpha=0.2, lw=0, label="± 1 SD", zorder=3)
    ax.plot(f[shown], power[shown], color=BLACK, lw=1.0, marker="o", ms=2.8, label="Welch", zorder=4)
    _spectrum_axes(ax, welch.unit, log)


def _spectrum_axes(ax: Axes, unit: str, log: bool) -> None:
    _label(ax, "Frequency (Hz)", f"Power ({density_unit(unit)})")
    ax.set_title("Spectrum, logarithmic" if log else "Spectrum, linear")
    if log:
        ax.set(xscale="log", yscale="log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        ax.xaxis.set_minor_formatter(NullFormatter())
    else:
        ax.set_xlim(left=0, auto=None)
        ax.set_ylim(bottom=0, auto=None)
    legend(ax, "lower left" if log else "upper right")


def _label(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y, parse_math=False)
