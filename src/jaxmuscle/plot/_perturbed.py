"""Figures of perturbation experiments: both channels, and the dynamic stiffness with its errors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._stiffness import POINTS, Curve, gain, phase
from ._style import BLUE, GREY, ORANGE, VERMILLION, canvas, legend, styled

SHOWN = 4.0  # seconds of the window that are drawn larger
CHANCE = 0.05


@styled
def frequency_response(response: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a frequency response: gain and phase with two standard errors either way, and the coherence.

    If the force did not follow the displacement, 5 % of the bins would have a coherence above the dashed line.
    """
    fig = canvas(ax, (4.8, 5.6))
    _response(fig.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.1, 1)), response)
    fig.suptitle(response.name, x=0.01, ha="left", fontsize=8.0, parse_math=False)
    return fig


@styled
def perturbed(recording: Any, settings: Any = None, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a recording of force and displacement: both with the window, four seconds of it larger, and the response.

    The response has its spring, damper and mass (`PerturbedRecording.second_order`) as a line.
    """
    fig = canvas(ax, (9.0, 5.8))
    left, right = fig.subfigures(1, 2, squeeze=False, width_ratios=(1.15, 1))[0]
    traces, closer = left.subplots(2, 2, sharex="col", width_ratios=(1.6, 1)).T
    channels = ((recording.force, 1.0, "Force (N)", BLUE), (recording.displacement, 1e3, "Lengthening (mm)", VERMILLION))
    for whole, near, (channel, scale, label, colour) in zip(traces, closer, channels, strict=True):
        time = channel.start + np.arange(channel.whole.size) / channel.rate
        whole.plot(time, scale * channel.whole, color=colour, lw=0.5)
        if channel.window is not None:
            whole.axvspan(*channel.window, color=ORANGE, alpha=0.25, lw=0, label="window")
        shown = slice(0, round(SHOWN * channel.rate))
        near.plot(channel.time[shown], scale * channel.samples[shown], color=colour, lw=0.9)
        for panel in (whole, near):
            panel.set_ylabel(label)
            panel.margins(x=0)
    traces[0].set_title("Whole recording")
    closer[0].set_title(f"First {SHOWN:g} s of the window" if recording.window else f"First {SHOWN:g} s")
    for panel in (traces[1], closer[1]):
        panel.set_xlabel("Time (s)")
    legend(traces[0], "above")
    response, classical = recording.frequency_response(settings), recording.second_order(settings)
    panels = right.subplots(3, 1, sharex=True, height_ratios=(1.5, 1.1, 1))
    s = 2j * np.pi * response.frequency
    line = np.sum([classical[name].value * s**power for power, name in enumerate("KBI")], axis=0)
    _response(panels, response, ("spring, damper, mass", line))
    fig.suptitle(f"{recording.name}: {recording.source}", x=0.01, ha="left", fontsize=8.0, parse_math=False)
    return fig


def _response(panels: Sequence[Axes] | np.ndarray, response: Any, line: Curve | None = None) -> None:
    f, coherence = response.frequency, panels[2]
    gain(panels[0], response, line)
    phase(panels[1], response, line)
    if response.coherence is None:
        coherence.text(0.5, 0.5, "no coherence stated", ha="center", transform=coherence.transAxes, color=GREY)
    else:
        k = np.maximum(response.averages, 2.0)
        spread = np.sqrt(2 * response.coherence / k) * (1 - response.coherence)
        ends = [np.minimum(2 * spread, response.coherence), np.minimum(2 * spread, 1 - response.coherence)]
        coherence.errorbar(f, response.coherence, np.nan_to_num(ends), **POINTS)
        chance = 1 - CHANCE ** (1 / (np.maximum(k - 1, 1)))
        coherence.plot(f, chance, color=GREY, lw=0.8, ls="--")
        words = f"without relation {100 * CHANCE:g} % of the bins lie above this"
        coherence.annotate(
            words, (f[-1], chance[-1]), (0, 3), textcoords="offset points", ha="right", color=GREY, fontsize=7.0
        )
    coherence.set_ylim(0, 1.03)
    coherence.set_ylabel("Coherence γ²")
    coherence.set_xlabel("Frequency (Hz)")
