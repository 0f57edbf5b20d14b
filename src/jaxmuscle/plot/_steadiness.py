"""The figure of a steadiness report: power by band, coefficients of variation, regularity; every
trial as a dot."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxmuscle._common.text import squared

from ._style import BLUE, SKY, AnyFigure, Style, finish, log_axis, panels, styled

VARIATION = "coefficient_of_variation"
VARIATIONS = {
    "all": VARIATION,
    "without\ndrift": f"{VARIATION}_without_drift",
    "above\n0.5 Hz": f"{VARIATION}_above_0.5",
}
REGULARITY = {
    "approx.\nentropy": "approximate_entropy",
    "sample\nentropy": "sample_entropy",
    "DFA\nexp. α": "dfa_exponent",
}
LEFT, RIGHT, MEAN = -0.32, 0.14, 0.3  # of the trials, and of their mean beside them
HEIGHTS = 1.9, 1.8  # inches


@styled
def steadiness(steadiness: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws the steadiness of trials: power by band, coefficients of variation, entropies and DFA
    exponent.

    Dots are trials. Beside them, large, stands the value of all trials with its 95 % interval.
    Letters are legible in a column of 85 mm.
    """
    # nothing varies about a mean that is none
    varied = {
        words: name
        for words, name in VARIATIONS.items()
        if np.isfinite(steadiness.measures[name].value)
    }
    fig, (power, *below) = panels(ax, "AA;BC" if varied else "AA;BB", HEIGHTS)
    bands = {_range(name): name for name in steadiness.measures if name.startswith("power_")}
    _dots(power, steadiness, bands)
    log_axis(power, "y")
    power.set(xlabel="Frequency (Hz)", title="Power by band")
    power.set_ylabel(f"Power ({squared(steadiness.unit).replace('^2', '²')})", parse_math=False)
    kinds = [(varied, 100.0, "SD (% of the mean)", "Coefficient of variation")] * bool(varied)
    kinds += [(REGULARITY, 1.0, "Value (no unit)", "Regularity")]
    for panel, (names, scale, ordinate, title) in zip(below, kinds, strict=True):
        _dots(panel, steadiness, names, scale)
        panel.margins(y=0.1)
        panel.set(ylabel=ordinate, title=title, ylim=(0, None))
    count = len(steadiness.trials)
    words = f"{count} trials" if count > 1 else next(iter(steadiness.trials))
    return finish(fig, HEIGHTS, f"Steadiness of {words}")


def _range(name: str) -> str:
    low, high = name.split("_")[1:]
    # the low-pass of what is measured
    return f"{high} to\n30" if low == "above" else f"{low} to\n{high}"


def _dots(ax: Axes, steadiness: Any, names: dict[str, str], scale: float = 1.0) -> None:
    trials = list(steadiness.trials.values())
    beside = np.linspace(LEFT, RIGHT, len(trials)) if len(trials) > 1 else np.zeros(1)
    each = scale * np.array([[trial[name].value for trial in trials] for name in names.values()])
    at = np.arange(len(names))
    if len(trials) > 1:
        places = (at[:, None] + beside).ravel()
        style: Style = {"ms": 2.8, "color": SKY, "zorder": 3}
        ax.plot(places, each.ravel(), "o", label="trials, in their order", **style)
    found = [steadiness.measures[name] for name in names.values()]
    value = scale * np.array([m.value for m in found])
    ends = (
        scale * np.array([(np.nan, np.nan) if m.interval is None else m.interval for m in found]).T
    )
    error = np.maximum([value - ends[0], ends[1] - value], 0.0)
    label, place = ("mean, 95 % interval", at + MEAN) if len(trials) > 1 else ("95 % interval", at)
    ax.errorbar(place, value, error, fmt="o", ms=4, capsize=2.5, lw=1.2, color=BLUE, label=label)
    ax.set_xticks(at, list(names))
    ax.set_xlim(-0.6, len(names) - 0.4)
