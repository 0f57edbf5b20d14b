"""The figure of a steadiness report: spectrum with its peak, power by band, coefficients of
variation, regularity; every trial as a dot."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from ._numbers import RELATIVE_UNIT
from ._style import (
    GREEN,
    GREY,
    AnyFigure,
    Style,
    canvas,
    density_unit,
    finish,
    frequency_axes,
    ink,
    log_axis,
    shade,
    styled,
)

VARIATION = "coefficient_of_variation"
VARIATIONS = {
    "all": VARIATION,
    "no\ndrift": f"{VARIATION}_without_drift",
    ">0.5\nHz": f"{VARIATION}_above_0.5",
}
REGULARITY = {
    "Approx.\nentropy": "approximate_entropy",
    "Sample\nentropy": "sample_entropy",
    "DFA\nexponent": "dfa_exponent",
}
LEFT, RIGHT, MEAN = -0.32, 0.14, 0.3  # of the trials, and of their mean beside them
HEIGHTS = 1.8, 1.6, 1.1  # inches


@styled
def steadiness(steadiness: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws the steadiness of trials: Welch spectrum, power by band, coefficients of variation,
    entropies and DFA exponent.

    Grey are the trials. Black, in the spectrum their mean, elsewhere the value of all trials with
    its 95 % interval. Green is the frequency of the tremor with its interval, a shade the band in
    which it was looked for. Power is over the squared mean, variation in % of the mean; both in the
    unit of the signal, where nothing varies about a mean. Letters are legible in a column of 85 mm.
    """
    measures = steadiness.measures
    varied = {words: n for words, n in VARIATIONS.items() if np.isfinite(measures[n].value)}
    fig = canvas(ax, HEIGHTS)
    grid = fig.add_gridspec(len(HEIGHTS), 1, height_ratios=HEIGHTS)
    ratios = (1.5, 1) if varied else (1,)
    upper = grid[1].subgridspec(1, len(ratios), width_ratios=ratios)
    lower = grid[2].subgridspec(1, len(REGULARITY))
    spectrum, power, *below = (fig.add_subplot(at) for at in (grid[0], *upper, *lower))
    density = density_unit(steadiness.unit)
    unit, kind, scale = density.removesuffix("/Hz"), "power_", 1.0
    if varied:
        unit, kind, scale = RELATIVE_UNIT, "relative_power_", 1e6
        density = f"{unit}/Hz"
    _spectrum(spectrum, steadiness, scale / measures["mean"].value ** 2 if varied else 1.0, density)
    bands = [name for name in measures if name.startswith(kind)]
    _dots(power, steadiness, bands, scale)
    edges = ["0", *(name.split("_")[-1] for name in bands[:-1]), "30"]  # the low-pass ends the last
    power.set_xticks(np.arange(len(edges)) - 0.5, edges)
    log_axis(power, "y")
    power.set_xlabel("Frequency (Hz)")
    power.set_ylabel(f"Power ({unit})", parse_math=False)
    if varied:
        _dots(below[0], steadiness, [*varied.values()], 100.0)
        below[0].set_xticks(range(len(varied)), varied)
        below[0].set_ylabel("SD (% of mean)")
    for panel, (label, name) in zip(below[-len(REGULARITY) :], REGULARITY.items(), strict=True):
        _dots(panel, steadiness, [name])
        panel.set(ylabel=label, xticks=[])
    for panel in below:
        panel.margins(y=0.15)
        panel.yaxis.set_major_locator(MaxNLocator(4, min_n_ticks=2))
    return finish(fig, HEIGHTS)


def _spectrum(ax: Axes, steadiness: Any, scale: float, density: str) -> None:
    """Of every trial and of all, and where the tremor is, or was looked for."""
    f, each, whole = (np.asarray(x) for x in steadiness.spectrum)
    tremor, band = steadiness.measures["tremor_frequency"], steadiness.band
    seen = np.isfinite(tremor.value)
    if band[1] > band[0]:
        words = "" if seen else ": none seen"
        label = f"tremor band, {band[0]:g} to {band[1]:g} Hz{words}"
        ax.axvspan(*band, color=shade(0.08), lw=0, zorder=0, label=label)
    if len(each) > 1:
        ax.plot(f, scale * each.T, color=GREY, lw=0.6, zorder=2)
    ax.plot(f, scale * whole, color=ink(), lw=1.2, zorder=3)
    if seen:
        label = f"tremor, {tremor.value:.2f} Hz"
        if tremor.interval is not None:
            low, high = tremor.interval
            ax.axvspan(low, high, color=GREEN, alpha=0.25, lw=0, zorder=1)
            label += f" ({low:.2f} to {high:.2f})"
        ax.axvline(tremor.value, color=GREEN, lw=1.2, zorder=1, label=label)
    frequency_axes(ax, True, f"Power ({density})")
    ax.set_xlim(f[0] / 1.1, f[-1])


def _dots(ax: Axes, steadiness: Any, names: list[str], scale: float = 1.0) -> None:
    trials = list(steadiness.trials.values())
    beside = np.linspace(LEFT, RIGHT, len(trials)) if len(trials) > 1 else np.zeros(1)
    each = scale * np.array([[trial[name].value for trial in trials] for name in names])
    at = np.arange(len(names))
    if len(trials) > 1:
        places = (at[:, None] + beside).ravel()
        style: Style = {"ms": 2.8, "color": GREY, "zorder": 3}
        ax.plot(places, each.ravel(), "o", label=f"{len(trials)} trials, in their order", **style)
    found = [steadiness.measures[name] for name in names]
    value = scale * np.array([m.value for m in found])
    ends = (
        scale * np.array([(np.nan, np.nan) if m.interval is None else m.interval for m in found]).T
    )
    error = np.maximum([value - ends[0], ends[1] - value], 0.0)
    label, place = ("mean, 95 % interval", at + MEAN) if len(trials) > 1 else ("95 % interval", at)
    ax.errorbar(place, value, error, fmt="o", ms=4, capsize=2.5, lw=1.2, color=ink(), label=label)
    ax.set_xlim(-0.5, len(names) - 0.5)
