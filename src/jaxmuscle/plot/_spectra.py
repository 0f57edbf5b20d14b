"""Figures of spectra: of one or many seeds, of a target, of a mean with its standard error."""

from typing import Any

import numpy as np
from jaxtyping import Real
from matplotlib.axes import Axes

from ._style import (
    BLUE,
    GREY,
    PALETTE,
    PROPORTIONAL,
    Style,
    axes_or_new,
    density_unit,
    frequency_axes,
    ink,
    legend,
    positive,
    shade,
    shorten,
    styled,
)


@styled
def estimate(estimate: Any, ax: Axes | None = None, *, log: bool = False) -> Axes:
    """Draws the proportional power of a `SpectrumEstimate`, with two standard errors either way.

    If it has a control variate, the estimate without it is drawn, too, in grey.

    **Arguments:**

    - `estimate`
    - `ax`: or a new figure
    - `log`: both axes logarithmic

    **Returns:** the axes.
    """
    ax = axes_or_new(ax)
    frequency, whole = np.asarray(estimate.frequency), float(np.sum(estimate.power))
    shown = positive(frequency, log)
    own = (estimate.power, estimate.stderr, BLUE)
    plain = (estimate.plain_power, estimate.plain_stderr, GREY, "without")
    rows = (
        [(*own, "mean")] if estimate.expected is None else [(*own, "with control variate"), plain]
    )
    for order, (power, stderr, color, name) in enumerate(rows):
        low, high = ((power + side * stderr)[shown] / whole for side in (-2, 2))
        ax.fill_between(
            frequency[shown], low, high, color=color, alpha=0.25, lw=0, zorder=2 - order
        )
        label = f"{name} ({estimate.seeds} seeds, ± 2 SE)"
        ax.plot(frequency[shown], power[shown] / whole, color=color, label=label, zorder=3 - order)
    return _finished(ax, log)


QUANTILES = (0.05, 0.95)
_MODEL = "jaxmuscle-model"


@styled
def spectrum(
    spectrum: Any,
    ax: Axes | None = None,
    *,
    log: bool = False,
    proportional: bool = True,
    label: str | None = None,
) -> Axes:
    """Draws power over frequency; of several seeds the mean and the band that holds 90 % of them.

    The mean line is p_k = ⟨P_k⟩ / Σ_j ⟨P_j⟩, absolute power averaged before it is normalised; the
    band runs from the 5 % to the 95 % quantile of the seeds' own spectra. Seeds that are not finite
    are left out, and the legend says so.

    **Arguments:**

    - `spectrum`: leading axes being seeds
    - `ax`: or a new figure
    - `log`: both axes logarithmic
    - `proportional`: or else power in `spectrum.unit`²/Hz
    - `label`: what the legend calls it

    **Returns:** the axes.
    """
    ax = axes_or_new(ax)
    frequency = np.asarray(spectrum.bins)
    rows, kind = finite_rows(np.asarray(spectrum.power).reshape(-1, frequency.size))
    mean, each = rows.mean(0), rows
    if proportional:
        mean, each = mean / mean.sum(), rows / rows.sum(-1, keepdims=True)
    shown = positive(frequency, log)
    mean_and_band(
        ax, frequency[shown], mean[shown], each[:, shown], ", ".join(filter(None, (label, kind)))
    )
    return _finished(
        ax, log, PROPORTIONAL if proportional else f"Power ({density_unit(spectrum.unit)})"
    )


@styled
def target(target: Any, ax: Axes | None = None, *, log: bool = False) -> Axes:
    """Draws a target's proportional power with the band of its sampling error.

    The band is where an expected spectrum lies at most one standard deviation from the target in
    log power: p_k exp(-bias ± sd). With ν degrees of freedom bias = ψ(ν/2) - ln(ν/2) and sd² =
    ψ'(ν/2), otherwise bias = 0 and sd² = ln(1 + (sigma_k/p_k)²). Without segments and sigma there
    is no band. The spectra of single trials are thin lines, all divided by the same number (the sum
    of their mean): a trial with more power is higher.

    **Arguments:**

    - `target`: what is drawn
    - `ax`: or a new figure
    - `log`: both axes logarithmic

    **Returns:** the axes.
    """
    ax = axes_or_new(ax)
    frequency, power, band = target.frequency, target.proportional_power, target.sampling_band()
    shown = positive(frequency, log)
    if band is not None:
        label = "± 1 SD (assumed)" if target.provenance == "reconstructed" else "± 1 SD"
        ax.fill_between(
            frequency[shown],
            *(edge[shown] for edge in band),
            color=shade(0.14),
            lw=0,
            label=label,
            zorder=1,
        )
    style: Style = {"color": ink(), "lw": 0.6, "marker": "o", "ms": 2.8, "zorder": 3}
    (line,) = ax.plot(frequency[shown], power[shown], **style)
    # neither hidden from the legend nor read as mathematics
    name = shorten(target.name, 40).lstrip("_").replace("$", r"\$")
    line.set_label(f"{name} ({target.provenance})")
    if target.trial_power is not None:
        weights = np.asarray(target.segments)
        each = target.trial_power / (weights @ target.trial_power / weights.sum()).sum()
        ax.plot(frequency[shown], each.T[shown], color=shade(0.4), lw=0.5, zorder=2)
        ax.lines[-1].set_label(f"{len(each)} trials")
    return _finished(ax, log)


def _finished(ax: Axes, log: bool, ordinate: str = PROPORTIONAL) -> Axes:
    frequency_axes(ax, log, ordinate)
    legend(ax, "lower left" if log else "upper right")
    return ax


def finite_rows(
    rows: Real[np.ndarray, "seeds values"],
) -> tuple[Real[np.ndarray, "finite values"], str]:
    """The rows that are finite, and what the legend calls them; nothing for the only row of one."""
    finite = np.isfinite(rows).all(-1)
    if not finite.any():
        return np.full_like(rows[:1], np.nan), "not finite"
    label = f"mean of {finite.sum()} seeds" if len(rows) > 1 else ""
    left_out = "" if finite.all() else f", {(~finite).sum()} not finite left out"
    return rows[finite], label + left_out


def mean_and_band(
    ax: Axes,
    x: Real[np.ndarray, " values"],
    mean: Real[np.ndarray, " values"],
    each: Real[np.ndarray, "seeds values"],
    label: str,
) -> str:
    """A line in the next colour of the palette, with the seeds' band if there are several; returns
    the colour."""
    colour = PALETTE[sum(line.get_gid() == _MODEL for line in ax.lines) % len(PALETTE)]
    if len(each) > 1:
        low, high = np.quantile(each, QUANTILES, axis=0)
        ax.fill_between(
            x, low, high, color=colour, alpha=0.2, lw=0, label="5 to 95 % of seeds", zorder=1
        )
    ax.plot(x, mean, color=colour, label=label, gid=_MODEL, zorder=4)
    return colour
