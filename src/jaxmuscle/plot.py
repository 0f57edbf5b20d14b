"""Figures: spectra, targets, trajectories and the one of a fit. Nothing is shown, closed or configured globally."""

import functools
from collections.abc import Callable
from typing import Any, Literal, ParamSpec, TypeVar, cast

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float, Real
from matplotlib.axes import Axes
from matplotlib.colors import SymLogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from ._estimate import SpectrumEstimate
from ._sensitivity import Sensitivity
from ._spectrum import Spectrum
from ._target import Target
from ._trajectory import WINDOW, Trajectory
from ._uncertainty import bin_statistics

# Okabe & Ito 2008, Color Universal Design: told apart with any common form of colour vision.
BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, BLACK, GREY = "#E69F00", "#56B4E9", "#000000", "#767676"
PALETTE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)

STYLE: dict[str, Any] = {
    "font.size": 8.0,
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 7.5,
    "legend.facecolor": "white",
    "legend.edgecolor": "none",
    "legend.framealpha": 0.85,
    "lines.linewidth": 1.5,
    "figure.dpi": 160.0,
}
SIZE = (4.5, 3.0)
QUANTILES = (0.05, 0.95)
_MODEL = "jaxmuscle-model"

P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Runs a drawing function in this module's style; the caller's rcParams are the same before and after."""

    @functools.wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        # Not rc_context: it also restores what a notebook's backend sets about itself while the first figure is made.
        params = cast(Any, matplotlib.rcParams)
        before = {name: params[name] for name in STYLE}
        params.update(STYLE)
        try:
            return draw(*args, **kwargs)
        finally:
            params.update(before)

    return inside


@styled
def spectrum(spectrum: Spectrum, ax: Axes | None = None, *, log: bool = False, proportional: bool = True) -> Axes:
    """Draws power over frequency; of several seeds the mean and the band that holds 90 % of them.

    The mean line is p_k = ⟨P_k⟩ / Σ_j ⟨P_j⟩, absolute power averaged before it is normalised; the band runs from the
    5 % to the 95 % quantile of the seeds' own spectra. Seeds that are not finite are left out, and the legend says so.

    **Arguments:** `spectrum`, leading axes being seeds; `ax`, or a new figure; `log`, both axes logarithmic;
    `proportional`, or else power in `spectrum.unit`²/Hz.

    **Returns:** the axes.
    """
    ax = _axes(ax)
    frequency = np.asarray(spectrum.frequency)
    rows, label = _finite(np.asarray(spectrum.power).reshape(-1, frequency.size))
    mean, each = rows.mean(0), rows
    if proportional:
        mean, each = mean / mean.sum(), rows / rows.sum(-1, keepdims=True)
    shown = slice(None) if not log else frequency > 0
    _mean_and_band(ax, frequency[shown], mean[shown], each[:, shown], label)
    _frequency_axis(ax, log)
    legend(ax, "lower left" if log else "upper right")
    ax.set_ylabel(_PROPORTIONAL if proportional else f"Power ({_density_unit(spectrum.unit)})")
    return ax


@styled
def estimate(estimate: SpectrumEstimate, ax: Axes | None = None, *, log: bool = False) -> Axes:
    """Draws the proportional power of a `SpectrumEstimate`, with two standard errors either way, and without control.

    **Arguments:** `estimate`; `ax`, or a new figure; `log`, both axes logarithmic. **Returns:** the axes.
    """
    ax = _axes(ax)
    frequency, whole = np.asarray(estimate.frequency), float(np.sum(estimate.power))
    shown = slice(None) if not log else frequency > 0
    rows = [(estimate.power, estimate.stderr, BLUE, "with control variate" if estimate.expected is not None else "mean")]
    if estimate.expected is not None:
        rows.append((estimate.plain_power, estimate.plain_stderr, GREY, "without"))
    for order, (power, stderr, color, name) in enumerate(rows):
        low, high = ((power + side * stderr)[shown] / whole for side in (-2, 2))
        ax.fill_between(frequency[shown], low, high, color=color, alpha=0.25, lw=0, zorder=2 - order)
        label = f"{name} ({estimate.seeds} seeds, ± 2 SE)"
        ax.plot(frequency[shown], power[shown] / whole, color=color, label=label, zorder=3 - order)
    _frequency_axis(ax, log)
    legend(ax, "lower left" if log else "upper right")
    ax.set_ylabel(_PROPORTIONAL)
    return ax


@styled
def target(target: Target, ax: Axes | None = None, *, log: bool = False) -> Axes:
    """Draws a target's proportional power with the band of its sampling error.

    The band is where an expected spectrum lies at most one standard deviation from the target in log power:
    p_k exp(-bias ± sd). With ν degrees of freedom bias = ψ(ν/2) - ln(ν/2) and sd² = ψ'(ν/2), otherwise bias = 0 and
    sd² = ln(1 + (sigma_k/p_k)²). Without segments and sigma there is no band.

    **Arguments:** `target`; `ax`, or a new figure; `log`, both axes logarithmic.

    **Returns:** the axes.
    """
    ax = _axes(ax)
    frequency, power, band = target.frequency, target.proportional_power, sampling_band(target)
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
    _frequency_axis(ax, log)
    ax.set_ylabel(_PROPORTIONAL)
    legend(ax, "lower left" if log else "upper right")
    return ax


@styled
def trajectory(
    trajectory: Trajectory, ax: Axes | None = None, *, window: tuple[float, float] | None = None, lines: int = 3
) -> Axes:
    """Draws the output over time; of an ensemble the mean, the band that holds 90 % of the seeds and a few of them.

    **Arguments:** `trajectory`; `ax`, or a new figure; `window` (start, stop) [s], by default all of it; `lines`, the
    number of single seeds drawn thin.

    **Returns:** the axes. **Raises:** `ValueError` for a window outside the simulated time.
    """
    ax = _axes(ax)
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


@styled
def moments(summary: Any, ax: Axes | None = None, point: int = 0) -> Axes:
    """Draws the mean of a reduced ensemble over time, and the bands between its outer quantiles.

    **Arguments:** `summary`, an `EnsembleSummary`; `ax`, or a new figure; `point` of a sweep. **Returns:** the axes.
    """
    ax = _axes(ax)
    swept = summary.mean.ndim == 2
    mean, quantile = (summary.mean[point], summary.quantile[point]) if swept else (summary.mean, summary.quantile)
    (line,) = ax.plot(summary.time, mean, lw=1.2, label=f"Mean of {summary.seeds} seeds")
    levels = summary.levels
    for low in range(len(levels) // 2):
        high = len(levels) - 1 - low
        share = f"{100 * levels[low]:g} to {100 * levels[high]:g} %"
        ax.fill_between(
            summary.time, quantile[low], quantile[high], color=line.get_color(), alpha=0.18 * (1 + low), lw=0, label=share
        )
    ax.set_xlabel("Time (s)")
    first = summary.task[0] if swept else summary.task
    ax.set_ylabel(output_label(first.output_name, first.output_unit))
    ax.margins(x=0)
    legend(ax, "above")
    return ax


def fit(result: Any) -> Figure:
    """Draws what a fit found: spectra linear and logarithmic, residuals, simulated output and parameters.

    The band around the target is that of `target`. Residuals are in standard deviations of the log power, positive
    where the target is above the fit. Parameters that were not fitted are left out of the table, and those that the
    data do not determine are marked.

    **Arguments:** `result`, what `jaxmuscle.fit` returns. **Returns:** the figure.
    """
    from ._plot_fit import figure

    return figure(result)


@styled
def simulation(runs: Trajectory) -> Figure:
    """Draws a simulation: the whole output over time, its analysed window, and the spectrum, linear and logarithmic.

    **Arguments:** `runs`, one seed or an ensemble. **Returns:** the figure.
    """
    figure, axes = plt.subplots(2, 2, figsize=(9.0, 5.6), layout="constrained")
    task = runs.task
    trajectory(runs, axes[0, 0])
    trajectory(runs, axes[0, 1], window=WINDOW)
    spectra = runs.spectrum()
    spectrum(spectra, axes[1, 0])
    spectrum(spectra, axes[1, 1], log=True)
    for ax, title in zip(
        axes.flat, ("Whole run", "Analysed window", "Spectrum, linear", "Spectrum, logarithmic"), strict=True
    ):
        ax.set_title(title)
    count = np.atleast_1d(runs.seeds).size
    figure.suptitle(
        f"{type(task).__name__}, {type(task.noise).__name__}, {count} seed{'s' * (count > 1)}", x=0.01, ha="left"
    )
    return figure


def sampling_band(target: Target) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]] | None:
    """Lower and upper edge of the band of `target`; `None` if nothing is known about the sampling error."""
    statistics = bin_statistics(target)
    if not statistics.known:
        return None
    centre = target.proportional_power * np.exp(-statistics.bias)
    return centre * np.exp(-statistics.sd), centre * np.exp(statistics.sd)


def output_label(name: str, unit: str) -> str:
    """Axis label of a task's output, as `Force $F_\\mathrm{ext}$ (N)`."""
    quantity = {"N": "Force ", "m": "Displacement "}.get(unit, "")
    base, _, index = name.partition("_")
    symbol = rf"${base}_\mathrm{{{index}}}$" if base.isalpha() and index.isalnum() else name
    return f"{quantity}{symbol} ({unit})"


_PROPORTIONAL = "Proportional power (fraction per bin)"


def _density_unit(unit: str) -> str:
    return f"{unit}²/Hz" if unit.isalpha() else f"({unit})²/Hz"


def _axes(ax: Axes | None) -> Axes:
    return plt.subplots(figsize=SIZE, layout="constrained")[1] if ax is None else ax


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


def legend(ax: Axes, place: Literal["upper right", "lower left", "above"]) -> None:
    """A legend in a fixed place, if there is anything to name: the best place is slow to find among many lines."""
    if not ax.get_legend_handles_labels()[0]:
        return
    if place == "above":
        ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, borderaxespad=0.0)
    else:
        ax.legend(loc=place)


def _frequency_axis(ax: Axes, log: bool) -> None:
    ax.set_xlabel("Frequency (Hz)")
    if not log:
        ax.set_xlim(left=0, auto=None)
        if ax.get_yscale() == "linear":
            ax.set_ylim(bottom=0, auto=None)
        return
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())


@styled
def sensitivity(sensitivity: Sensitivity, ax: Axes | None = None) -> Axes:
    """Draws how proportional power answers to the parameters as a heat map, parameters that do nothing left out.

    **Arguments:** `sensitivity`; `ax`, or a new figure high enough for the parameters. **Returns:** the axes.
    """
    table = np.asarray(sensitivity.proportional)
    shown = np.flatnonzero(np.max(np.abs(table), axis=1) > 1e-6)
    if ax is None:
        ax = plt.figure(figsize=(6.5, 1.3 + 0.22 * len(shown)), layout="constrained").add_subplot()
    frequency = np.asarray(sensitivity.frequency)
    half = 0.5 * (frequency[1] - frequency[0]) if len(frequency) > 1 else 0.5
    edges = np.append(frequency - half, frequency[-1] + half)
    largest = float(np.max(np.abs(table[shown]), initial=1e-6))
    # Logarithmic beyond a tenth: a frequency moves its own bins hundreds of times as much as anything else does.
    scale = SymLogNorm(min(0.1, largest), vmin=-largest, vmax=largest)
    mesh = ax.pcolormesh(edges, np.arange(len(shown) + 1), table[shown], cmap="RdBu_r", norm=scale)
    labels = [sensitivity.names[i] + ("" if sensitivity.relative[i] else " *") for i in shown]
    ax.set_yticks(np.arange(len(shown)) + 0.5, labels)
    ax.invert_yaxis()
    ax.set_xlabel("Frequency (Hz)")
    ax.figure.colorbar(mesh, ax=ax, label="d ln p / d ln parameter")
    if not np.all(sensitivity.relative[shown]):
        ax.set_title("* d ln p / d parameter, in its own unit", size="small")
    return ax
