"""All figures. Nothing is shown, closed or configured globally.

What has one pair of axes draws into `ax` or a new figure and returns the axes. What has several panels (`ax`: the place in a
grid that they take) returns the figure, or the part of yours.
"""

from typing import Any

import numpy as np
from jaxtyping import Real
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._style import (
    BLACK,
    PROPORTIONAL,
    axes_or_new,
    canvas,
    density_unit,
    frequency_axis,
    legend,
    output_label,
    styled,
)  # fmt: skip
from ._style import BLUE as BLUE
from ._style import GREEN as GREEN
from ._style import ORANGE as ORANGE
from ._style import PALETTE as PALETTE
from ._style import PURPLE as PURPLE
from ._style import SKY as SKY
from ._style import STYLE as STYLE
from ._style import VERMILLION as VERMILLION

QUANTILES = (0.05, 0.95)
_MODEL = "jaxmuscle-model"


@styled
def spectrum(
    spectrum: Any, ax: Axes | None = None, *, log: bool = False, proportional: bool = True, label: str | None = None
) -> Axes:
    """Draws power over frequency; of several seeds the mean and the band that holds 90 % of them.

    The mean line is p_k = ⟨P_k⟩ / Σ_j ⟨P_j⟩, absolute power averaged before it is normalised; the band runs from the
    5 % to the 95 % quantile of the seeds' own spectra. Seeds that are not finite are left out, and the legend says so.

    **Arguments:** `spectrum`, leading axes being seeds; `ax`, or a new figure; `log`, both axes logarithmic;
    `proportional`, or else power in `spectrum.unit`²/Hz; `label`, what the legend calls it.

    **Returns:** the axes.
    """
    ax = axes_or_new(ax)
    frequency = np.asarray(spectrum.frequency)
    rows, kind = _finite(np.asarray(spectrum.power).reshape(-1, frequency.size))
    mean, each = rows.mean(0), rows
    if proportional:
        mean, each = mean / mean.sum(), rows / rows.sum(-1, keepdims=True)
    shown = slice(None) if not log else frequency > 0
    _mean_and_band(ax, frequency[shown], mean[shown], each[:, shown], ", ".join(filter(None, (label, kind))))
    frequency_axis(ax, log)
    legend(ax, "lower left" if log else "upper right")
    ax.set_ylabel(PROPORTIONAL if proportional else f"Power ({density_unit(spectrum.unit)})")
    return ax


def estimate(estimate: Any, ax: Axes | None = None, *, log: bool = False) -> Axes:
    """Draws the proportional power of a `SpectrumEstimate`, with two standard errors either way, and without control.

    **Arguments:** `estimate`; `ax`, or a new figure; `log`, both axes logarithmic. **Returns:** the axes.
    """
    from ._plot_estimate import draw

    return draw(estimate, ax, log)


@styled
def target(target: Any, ax: Axes | None = None, *, log: bool = False) -> Axes:
    """Draws a target's proportional power with the band of its sampling error.

    The band is where an expected spectrum lies at most one standard deviation from the target in log power:
    p_k exp(-bias ± sd). With ν degrees of freedom bias = ψ(ν/2) - ln(ν/2) and sd² = ψ'(ν/2), otherwise bias = 0 and
    sd² = ln(1 + (sigma_k/p_k)²). Without segments and sigma there is no band.

    **Arguments:** `target`; `ax`, or a new figure; `log`, both axes logarithmic.

    **Returns:** the axes.
    """
    ax = axes_or_new(ax)
    frequency, power, band = target.frequency, target.proportional_power, target.sampling_band()
    shown = slice(None) if not log else frequency > 0
    if band is not None:
        low, high = band
        label = "± 1 SD (assumed)" if target.provenance == "reconstructed" else "± 1 SD of the estimate"
        ax.fill_between(frequency[shown], low[shown], high[shown], color="0.86", lw=0, label=label, zorder=1)
    name = target.name if len(target.name) <= 40 else f"{target.name[:39]}…"
    style: dict[str, Any] = {"color": BLACK, "lw": 0.6, "marker": "o", "ms": 2.8, "zorder": 3}
    (line,) = ax.plot(frequency[shown], power[shown], **style)
    name = name.lstrip("_").replace("$", r"\$")  # neither hidden from the legend nor read as mathematics
    line.set_label(f"{name} ({target.provenance})")
    frequency_axis(ax, log)
    ax.set_ylabel(PROPORTIONAL)
    legend(ax, "lower left" if log else "upper right")
    return ax


@styled
def trajectory(
    trajectory: Any, ax: Axes | None = None, *, window: tuple[float, float] | None = None, lines: int = 3
) -> Axes:
    """Draws the output over time; of an ensemble the mean, the band that holds 90 % of the seeds and a few of them.

    **Arguments:** `trajectory`; `ax`, or a new figure; `window` (start, stop) [s], by default all of it; `lines`, the
    number of single seeds drawn thin.

    **Returns:** the axes. **Raises:** `ValueError` for a window outside the simulated time.
    """
    ax = axes_or_new(ax)
    time, output = trajectory.time, np.asarray(trajectory.output)
    if window is not None:
        output = np.asarray(trajectory.between(window))
        start = round(window[0] * trajectory.rate)
        time = time[start : start + output.shape[-1]]
    rows, label = _finite(output.reshape(-1, time.size))
    colour = _mean_and_band(ax, time, rows.mean(0), rows, label)
    for row in rows[:lines] if len(rows) > 1 else ():
        ax.plot(time, row, color=colour, lw=0.5, alpha=0.6, zorder=2)
    task = trajectory.task
    ax.set_xlabel("Time (s)")
    ax.set_ylabel(output_label(task.output_name, task.output_unit))
    ax.margins(x=0)
    legend(ax, "above")
    return ax


def moments(summary: Any, ax: Axes | None = None, point: int = 0) -> Axes:
    """Draws the mean of a reduced ensemble over time, and the bands between its outer quantiles.

    **Arguments:** `summary`, an `EnsembleSummary`; `ax`, or a new figure; `point` of a sweep. **Returns:** the axes.
    """
    from ._plot_moments import draw

    return draw(summary, ax, point)


def fit(result: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws what a fit found: spectra linear and logarithmic, residuals, simulated output and parameters.

    The band around the target is that of `target`. Residuals are in standard deviations of the log power, positive
    where the target is above the fit. Parameters that were not fitted are left out of the table, and those that the
    data do not determine are marked.

    **Arguments:** `result`, what `jaxmuscle.fit` returns; `ax`, its place. **Returns:** the figure.
    """
    from ._plot_fit import figure

    return figure(result, ax)


@styled
def simulation(runs: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a simulation: the whole output over time, its analysed window, and the spectrum, linear and logarithmic.

    **Arguments:** `runs`, one seed or an ensemble; `ax`, its place. **Returns:** the figure.
    """
    figure = canvas(ax, (9.0, 5.6))
    axes = figure.subplots(2, 2)
    task = runs.task
    trajectory(runs, axes[0, 0])
    trajectory(runs, axes[0, 1], window=runs.analysed)
    spectra = runs.spectrum()
    spectrum(spectra, axes[1, 0])
    spectrum(spectra, axes[1, 1], log=True)
    titles = ("Whole run", "Analysed window", "Spectrum, linear", "Spectrum, logarithmic")
    for panel in axes[:, 1]:
        if panel.get_legend() is not None:  # the same as to the left
            panel.get_legend().remove()
    for panel, title in zip(axes.flat, titles, strict=True):
        panel.set_title(title)
    count = np.atleast_1d(runs.seeds).size
    figure.suptitle(
        f"{type(task).__name__}, {type(task.noise).__name__}, {count} seed{'s' * (count > 1)}", x=0.01, ha="left"
    )
    return figure


def _finite(rows: Real[np.ndarray, "seeds values"]) -> tuple[Real[np.ndarray, "finite values"], str]:
    """The rows that are finite, and what the legend calls them; nothing for the only row of one."""
    finite = np.isfinite(rows).all(-1)
    label = f"mean of {finite.sum()} seeds" if len(rows) > 1 else ""
    if not finite.all():
        label = f"{label}, {(~finite).sum()} not finite left out" if finite.any() and label else "not finite"
    return (rows[finite] if finite.any() else np.full_like(rows[:1], np.nan)), label


def _mean_and_band(
    ax: Axes,
    x: Real[np.ndarray, " values"],
    mean: Real[np.ndarray, " values"],
    each: Real[np.ndarray, "seeds values"],
    label: str,
) -> str:
    """A line in the next colour of the palette, with the seeds' band if there are several; returns the colour."""
    colour = PALETTE[sum(line.get_gid() == _MODEL for line in ax.lines) % len(PALETTE)]
    if len(each) > 1:
        low, high = np.quantile(each, QUANTILES, axis=0)
        ax.fill_between(x, low, high, color=colour, alpha=0.2, lw=0, label="5 to 95 % of seeds", zorder=1)
    ax.plot(x, mean, color=colour, label=label, gid=_MODEL, zorder=4)
    return colour


def sensitivity(sensitivity: Any, ax: Axes | None = None) -> Axes:
    """Draws how proportional power answers to the parameters as a heat map, parameters that do nothing left out.

    **Arguments:** `sensitivity`; `ax`, or a new figure high enough for the parameters. **Returns:** the axes.
    """
    from ._plot_sensitivity import draw

    return draw(sensitivity, ax)


def profile(profile: Any, ax: Axes | None = None) -> Axes:
    """Draws a profile likelihood with its interval and the parabola of the curvature. Returns the axes (`ax` or new)."""
    from ._plot_profile import draw

    return draw(profile, ax)


def posterior(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the posterior `found` of what the data determine: densities, and 50, 80 and 95 % regions of pairs.

    **Raises:** `NotMixedError` if the chains did not mix; `ValueError` if the data determine nothing.
    """
    from ._plot_posterior import corner

    return corner(found, ax)


def chains(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws every chain of the posterior `found` over its draws, also of chains that did not mix."""
    from ._plot_posterior import traces

    return traces(found, ax)


def predictive(found: Any, ax: Axes | None = None) -> Axes:
    """Draws the target among spectra that the posterior `found` predicts. **Raises:** `NotMixedError`."""
    from ._plot_posterior import predictive

    return predictive(found, ax)


def comparison(comparison: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the best fit of each noise, AIC and held-out score of every model, and says whether they can be told apart."""
    from ._plot_compare import figure

    return figure(comparison, ax)


def identifiability(report: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws singular values and standard errors, now and with each further measurement."""
    from ._plot_identify import figure

    return figure(report, ax)


def goodness(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws residuals with what is usual in each bin, and the three checks with their reference distributions."""
    from ._plot_bootstrap import goodness_figure

    return goodness_figure(found, ax)


def bootstrap(found: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws the refits of every quantity, the value they were made from and the interval that the fit states.

    **Raises:** `ValueError` if fewer than two refits succeeded.
    """
    from ._plot_bootstrap import bootstrap_figure

    return bootstrap_figure(found, ax)


def joint(result: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a joint fit: spectrum, fit and residuals of each target, and what they determine together."""
    from ._plot_joint import figure

    return figure(result, ax)


def cohort(cohort: Any, by: str = "person", ax: Axes | None = None) -> Figure | SubFigure:
    """Draws what at least half of the targets determine, `by` "person", "group" or "level" (fraction of MVC).

    **Raises:** `ValueError` for another `by`, and if there is nothing to draw.
    """
    from ._plot_cohort import figure

    return figure(cohort, by, ax)


def recording(recording: Any, settings: Any = None, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws a recording: the trace with its window, and its spectra (Welch, FFT), linear and logarithmic."""
    from ._plot_recording import figure

    return figure(recording, settings, ax)


def static(curves: Any, ax: Any = None) -> tuple[Axes, Axes, Axes]:
    """Draws K(x), C(v) and force against displacement, in three axes (`ax`: three of yours). Returns the axes.

    **Raises:** `ValueError` unless `ax` has three.
    """
    return curves.plot(ax)
