"""Figures of perturbation experiments: both channels, and the dynamic stiffness with its errors."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._recording import whole_trace
from ._stiffness import POINTS, Curve, gain, phase
from ._style import (
    BLUE,
    GREY,
    VERMILLION,
    AnyFigure,
    canvas,
    finish,
    fit_height,
    heading,
    ink,
    legend,
    panels,
    styled,
)

SHOWN = 4.0  # seconds of the window that are drawn larger
CHANCE = 0.05


@styled
def frequency_response(response: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws a frequency response: gain and phase with two standard errors either way, and the
    coherence.

    If the force did not follow the displacement, 5 % of the bins would have a coherence above the
    dashed line.
    """
    heights = (1.7, 1.2, 1.3)
    fig, axes = panels(ax, "A;B;C", heights, sharex=True)
    _response(axes, response)
    fig.align_ylabels(axes)
    return fit_height(fig, heights, heading(fig, response.name))


@styled
def perturbed(recording: Any, settings: Any = None, ax: Axes | None = None) -> AnyFigure:
    """Draws a recording of force and displacement: both with the window, four seconds of it larger,
    and the response.

    The response has its spring, damper and mass (`PerturbedRecording.second_order`) as a line.
    `settings`: `SpectrumSettings` or a name, as of `Recording.spectrum`.
    """
    heights = (1.2, 1.3, 1.5, 1.1, 1.2)
    fig = canvas(ax, heights)
    halves = sum(heights[:2]), sum(heights[2:])
    upper, lower = fig.subfigures(2, 1, squeeze=False, height_ratios=halves)[:, 0]
    traces, closer = upper.subplots(2, 2, sharex="col", sharey="row", width_ratios=(1.6, 1)).T
    moved = ("Angle (deg)", np.degrees(1.0)) if recording.of_joint else ("Lengthening (mm)", 1e3)
    channels = (
        (recording.force, 1.0, "Torque (N m)" if recording.of_joint else "Force (N)", BLUE),
        (recording.displacement, moved[1], moved[0], VERMILLION),
    )
    for whole, near, (channel, scale, label, colour) in zip(traces, closer, channels, strict=True):
        whole_trace(whole, channel, "window", scale, color=colour, lw=0.5)
        shown = slice(0, round(SHOWN * channel.rate))
        near.plot(channel.time[shown], scale * channel.samples[shown], color=colour, lw=0.9)
        whole.set_ylabel(label)
        for panel in (whole, near):
            panel.margins(x=0)
    traces[0].set_title("Whole recording")
    closer[0].set_title(f"{SHOWN:g} s of the window" if recording.window else f"First {SHOWN:g} s")
    for panel in (traces[1], closer[1]):
        panel.set_xlabel("Time (s)")
    response, classical = recording.frequency_response(settings), recording.second_order(settings)
    panels = lower.subplots(3, 1, sharex=True, height_ratios=heights[2:])
    s = 2j * np.pi * response.frequency
    line = np.sum([classical[name].value * s**power for power, name in enumerate("KBI")], axis=0)
    _response(panels, response, ("spring, damper, mass", line))
    upper.align_ylabels(traces)
    lower.align_ylabels(panels)
    return finish(fig, heights, recording.name)


def _response(
    panels: Sequence[Axes] | np.ndarray, response: Any, line: Curve | None = None
) -> None:
    f, coherence = response.frequency, panels[2]
    gain(panels[0], response, line)
    phase(panels[1], response, line)
    if response.coherence is None:
        coherence.text(
            0.5, 0.5, "no coherence stated", ha="center", transform=coherence.transAxes, color=GREY
        )
    else:
        k = np.maximum(response.averages, 2.0)
        spread = np.sqrt(2 * response.coherence / k) * (1 - response.coherence)
        ends = [
            np.minimum(2 * spread, response.coherence),
            np.minimum(2 * spread, 1 - response.coherence),
        ]
        coherence.errorbar(f, response.coherence, np.nan_to_num(ends), color=ink(), **POINTS)
        chance = 1 - CHANCE ** (1 / (np.maximum(k - 1, 1)))
        coherence.plot(
            f, chance, color=GREY, lw=0.8, ls="--", label=f"by chance {100 * CHANCE:g} % lie above"
        )
        legend(coherence, "above")
    coherence.set_ylim(0, 1.03)
    coherence.set_ylabel("Coherence γ²")
    coherence.set_xlabel("Frequency (Hz)")
