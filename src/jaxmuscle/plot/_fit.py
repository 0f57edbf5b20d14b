"""The figure of a fit: the spectrum and the parts that the model makes it of, residuals, traces."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ._spectra import target
from ._stiffness import gain, phase, stiffness_residuals
from ._style import (
    ACROSS,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PER_BIN,
    PURPLE,
    SKY,
    VERMILLION,
    AnyFigure,
    Style,
    canvas,
    finish,
    ink,
    log_axis,
    rows_for,
    shade,
    shade_deviations,
    shorten,
    styled,
    without_legend,
)

PARTS = {
    "relaxation": (SKY, "-", "slow part"),
    "floor": (GREY, ":", "floor"),
    "harmonic": (ORANGE, "-", "regular rhythm"),
    "resonance": (GREEN, "--", "resonance"),
    "resonance_2": (PURPLE, "-.", "second resonance"),
}
LEAST = 1e-4  # share of the power below which a part is not drawn
DECADE = 10.0  # by which a part may lie below the spectrum to be seen
ALONE, BESIDE, TRACES, MOVED = (2.2, 0.8), (1.7, 0.7), 0.95, (1.9, 1.5)  # inches


@styled
def fit(result: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws what a fit found: the spectrum with the parts of the model, residuals, traces, dynamic
    stiffness.

    Points and band are those of `target`. The fit is the mean of new simulations, where there are
    some. The parts add up to it: the slow part is from noise on the active tissue, the floor from
    noise on the passive one. Behind them stands which share of the power each holds, unless the
    model does not describe the data; of a rhythm only if its frequency in the drive is determined,
    which then is dashed; a resonance holds power in all bins. Residuals are in standard deviations
    of the log power, positive where the data are above the fit; those beyond two are red and
    open. Below stand the first seconds of the recording, where there was one, beside
    some that the fitted muscle gave. Letters are legible in a column of 85 mm.

    **Arguments:** `result`, what `jaxmuscle.fit` returns; `ax`, its place. **Returns:** the figure.
    """
    parts, alone = result.parts, len(result.parts) == 1
    fixed = (name for name, p in result.parameters.items() if not p.free)
    known = None if result.adequate is False else {*result.determined, *fixed}
    spectra = {name: part for name, part in parts.items() if part.fitted.size}
    moved = {name: part for name, part in parts.items() if part.stiffness is not None}
    across = 1 if alone else ACROSS
    traces = [
        part for part in parts.values() if alone and part.recorded[0].size and part.stretch[0].size
    ]
    heights = [
        *(ALONE if alone else BESIDE) * rows_for(len(spectra), across),
        *[TRACES] * len(traces),
        *MOVED * len(moved),
    ]
    fig = canvas(ax, heights, h_pad=0.03)
    grid = fig.add_gridspec(len(heights), 2, height_ratios=heights)
    for number, (name, part) in enumerate(spectra.items()):
        row, place = 2 * (number // across), slice(None) if alone else number % across
        upper = fig.add_subplot(grid[row, place])
        lower = fig.add_subplot(grid[row + 1, place], sharex=upper)
        _spectrum(upper, part, None if alone else name, known)
        _residuals(lower, part)
    row = 2 * rows_for(len(spectra), across)
    for part in traces:
        left = fig.add_subplot(grid[row, 0])
        _traces(left, fig.add_subplot(grid[row, 1], sharey=left), part)
        row += 1
    for name, part in moved.items():
        title = "Dynamic stiffness" if alone else f"{name}: dynamic stiffness"
        left = fig.add_subplot(grid[row, 0])
        _stiffness(left, fig.add_subplot(grid[row, 1]), part, title)
        stiffness_residuals(fig.add_subplot(grid[row + 1, :]), part)
        row += 2
    return finish(fig, heights, columns=3)


def _spectrum(ax: Axes, part: Any, name: str | None, known: set[str] | None) -> None:
    """The target and the fit; of one among several, its name, and the parts without numbers.
    `known`, see `_parts_of_power`."""
    fitted = np.asarray(part.fitted)
    target(part.target, ax, log=True)
    without_legend(ax)
    dots, *trials = ax.lines
    for line in trials:  # the band says how much they scatter
        line.remove()
    provenance = part.target.provenance
    dots.set_label("data" if provenance == "user" else provenance)
    frequency, band = part.target.frequency, part.target.sampling_band()
    seen = np.concatenate([part.target.proportional_power, fitted, *(band or ())])
    seen = seen[np.isfinite(seen) & (seen > 0)]
    low = seen.min()
    if np.isfinite(fitted).all():
        dots.set_linewidth(0.0)
        ax.plot(frequency, fitted, color=BLUE, label="fit", zorder=4)
        low = _parts_of_power(ax, part, low, known if name is None else None)
    ax.set(xlim=(frequency[0] / 1.15, frequency[-1] * 1.15), ylim=(low / 1.4, seen.max() * 1.4))
    ax.set(xlabel="", ylabel=PER_BIN)
    ax.set_title(shorten(name or "", 24), parse_math=False)
    ax.tick_params(labelbottom=False)
    log_axis(ax, "y")


def _parts_of_power(ax: Axes, part: Any, low: float, known: set[str] | None) -> float:
    """A line for each part, dashed at the frequency of a rhythm; down to where all can be seen, at
    most a decade below `low`.

    With numbers, of a rhythm where its frequency is among the `known`; None: without any.
    """
    frequency, fitted = np.asarray(part.frequency_hz), np.asarray(part.fitted)
    shares = part.components or {"harmonic": part.harmonic_share}
    resonances = [noise for noise in part.task.noise.components if noise.sort == "resonance"]
    rhythms = dict(
        zip(
            ("harmonic", "resonance", "resonance_2"),
            (part.task.harmonic, *resonances),
            strict=False,
        )
    )
    lowest = low
    for name, (color, dashes, words) in PARTS.items():
        power = fitted * np.maximum(shares.get(name, 0.0), 0.0)
        total = float(np.sum(power))
        if not total > LEAST:
            continue
        label = words
        if known is not None and (name not in rhythms or f"{name}_frequency" in known):
            label += f", {'<1' if total < 0.01 else f'{100 * total:.2g}'} %"
        if known is not None and name in rhythms and f"{name}_frequency" in known:
            where = float(rhythms[name].frequency)
            label += f" ({where:.3g} Hz)"
            if frequency[0] / 2 <= where <= frequency[-1] * 1.05:
                ax.axvline(where, color=color, lw=0.8, ls=(0, (4, 2)), zorder=0)
        style: Style = {"color": color, "ls": dashes, "lw": 1.0, "zorder": 3}
        ax.plot(frequency, power, label=label, **style)
        lowest = min(lowest, float(np.max(power)) / 2)
    return max(lowest, low / DECADE)


def _residuals(ax: Axes, part: Any) -> None:
    """Stems, with the range that one and two standard deviations cover if these are known."""
    frequency, residual = np.asarray(part.frequency_hz), np.asarray(part.residual)
    known, finite = part.deviation is not None, np.isfinite(residual)
    if known:
        shade_deviations(ax)
    if not finite.all():
        _say(ax, "no finite fit")
    for which, color, inside in (
        (finite & ~((np.abs(residual) > 2) & known), BLUE, BLUE),
        (finite & (np.abs(residual) > 2) & known, VERMILLION, shade(0.0)),
    ):
        ax.vlines(frequency[which], 0, residual[which], color=color, lw=1.0, zorder=3)
        style: Style = {"color": color, "mfc": inside, "ms": 2.8, "zorder": 3}
        ax.plot(frequency[which], residual[which], "o", **style)
    ax.axhline(0, color=ink(), lw=0.6, zorder=4)
    least = 3.0 if known else 0.1
    reach = 1.1 * float(np.max(np.abs(residual), where=finite, initial=least))
    ax.set(ylim=(-reach, reach), ylabel=f"Residual\n({'SD' if known else 'ln'})")
    ax.set_xlabel("Frequency (Hz)")
    ax.yaxis.set_major_locator(MaxNLocator(4))
    log_axis(ax)


def _traces(left: Axes, right: Axes, part: Any) -> None:
    """The first seconds of the recording, and as many simulated ones on the same scale: relative to
    the mean where that is known, else to the standard deviation."""
    held = part.target.coefficient_of_variation is not None
    for ax, (time, output), color, title in (
        (left, part.recorded, ink(), "Measured"),
        (right, part.stretch, BLUE, "Simulated"),
    ):
        ax.set(title=title, xlabel="Time (s)")
        if not np.isfinite(output).all():
            _say(ax, "no finite simulation")
            continue
        mean = float(np.mean(output))
        shown = 100 * output / mean if held else (output - mean) / np.std(output)
        ax.plot(time - time[0], shown, color=color, lw=0.8)
        ax.margins(x=0)
    right.tick_params(labelleft=False)
    left.set_ylabel(f"{part.target.quantity.capitalize()}\n({'% of mean' if held else 'SD'})")


def _stiffness(left: Axes, right: Axes, part: Any, title: str) -> None:
    """Gain and phase; half as wide as `gain` expects: its names stand in the key of the figure."""
    measured, fitted = part.target.stiffness.known, ("fit", part.stiffness)
    gain(left, measured, fitted, title)
    without_legend(left)
    phase(right, measured, fitted)
    for ax in (left, right):
        ax.set_xlabel("Frequency (Hz)")


def _say(ax: Axes, message: str) -> None:
    """A panel that has nothing to show."""
    style: Style = {"transform": ax.transAxes, "color": VERMILLION, "weight": "bold"}
    ax.text(0.5, 0.52, message, ha="center", va="bottom", **style)
