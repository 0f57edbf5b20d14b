"""The figure of a fit, for `jaxmuscle.plot.fit`: spectra, residuals and output; words and numbers
are the result's."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from jaxmuscle._common.text import probability

from ._components import lowest, mark, parts_of_power, rhythms
from ._spectra import target
from ._stiffness import gain, phase, stiffness_residuals
from ._style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PER_BIN,
    VERMILLION,
    AnyFigure,
    Style,
    canvas,
    finish,
    ink,
    log_axis,
    output_label,
    shade,
    shade_deviations,
    shorten,
    styled,
    without_legend,
)

Panel = Callable[[Axes], Any]
Row = tuple[float, tuple[Panel, ...]]  # height [inches]
ALLOWED = 3.84  # 95 % quantile of χ² with one degree of freedom
DARK_GREEN = "#00664A"  # the palette's green is too light for small letters


@styled
def fit(result: Any, ax: Axes | None = None) -> AnyFigure:
    """Draws what a fit found: spectra linear and logarithmic, residuals, simulated output, the
    harmonic's profile.

    The band around the target is that of `target`. The fit is the mean of new simulations, where
    there are some. Residuals are in standard deviations of the log power, positive where the target
    is above the fit; those beyond two are red. χ² and p above them are those of the verdict.
    Letters are legible in a column of 85 mm. Numbers, notices and what the data do not determine
    are what `print(result)` tells.

    **Arguments:** `result`, what `jaxmuscle.fit` returns; `ax`, its place. **Returns:** the figure.
    """
    panels = _panels(result)
    heights = [height for height, _ in panels]
    fig = canvas(ax, heights, w_pad=0.05, h_pad=0.04)
    grid = fig.add_gridspec(len(heights), 2, height_ratios=heights)
    for row, (_, draw) in enumerate(panels):
        for column, panel in enumerate(draw):
            panel(fig.add_subplot(grid[row, column] if len(draw) > 1 else grid[row, :]))
    # in red whatever forbids to believe the fit
    bad = "Does not describe the data" if result.adequate is False else ""
    parts, name = result.parts.values(), shorten(", ".join(result.parts), 50)
    if len(parts) == 1:
        name = shorten(result.target.name, 50)
    if any(part.target.provenance == "reconstructed" for part in parts):
        name += " (reconstructed)"
    return finish(fig, heights, name, bad=bad if result.success else "Not fitted")


def _panels(result: Any) -> list[Row]:
    """Rows of panels with their heights: of one target in full, of several one row each."""
    rows: list[Row] = []
    if len(result.parts) > 1:
        for name, part in result.parts.items():
            title = f"{name}: {type(part.task).__name__}"
            spectra = partial(_spectra, part=part, log=True, title=title)
            rows += [(1.7, (spectra, partial(_residuals, part=part)))] * bool(part.fitted.size)
        for name, part in result.parts.items():
            rows += _moved(part, f"{name}: dynamic stiffness")
        return rows
    part = result.only
    if part.fitted.size:
        verdict, relative = (result.closeness, result.adequacy_p), bool(result.per_newton)
        rows += [
            (1.75, tuple(partial(_spectra, part=part, log=log) for log in (False, True))),
            (
                1.4,
                (
                    partial(_residuals, part=part, verdict=verdict),
                    partial(_stretch, part=part, relative=relative),
                ),
            ),
        ]
    rows += _moved(part, "Dynamic stiffness")
    return rows if result.profile is None else [*rows, (1.2, (partial(_profile, result=result),))]


def _moved(part: Any, title: str) -> list[Row]:
    """Rows for the dynamic stiffness of a part that has one."""
    if part.stiffness is None:
        return []
    measured, fitted = part.target.stiffness.known, ("fit", part.stiffness)
    half = partial(_gain, response=measured, curve=fitted, title=title)
    return [
        (1.9, (half, partial(_phase, response=measured, curve=fitted))),
        (1.5, (partial(stiffness_residuals, part=part),)),
    ]


def _gain(ax: Axes, response: Any, curve: Any, title: str) -> None:
    """Half as wide as `gain` expects: what it shows is named in the key of the figure."""
    gain(ax, response, curve, title)
    without_legend(ax)
    ax.set_xlabel("Frequency (Hz)")


def _phase(ax: Axes, response: Any, curve: Any) -> None:
    phase(ax, response, curve)
    ax.set_xlabel("Frequency (Hz)")


def _spectra(ax: Axes, part: Any, *, log: bool, title: str = "") -> None:
    frequency, fitted = np.asarray(part.frequency_hz), np.asarray(part.fitted)
    target(part.target, ax, log=log)
    dots = ax.lines[0]
    dots.set_label("data, reconstructed" if part.target.provenance == "reconstructed" else "data")
    if np.isfinite(fitted).any():
        dots.set_linewidth(0.0)
        ax.plot(frequency, fitted, color=BLUE, label="fit", zorder=4)
        if _parts_are_drawn(part):
            parts_of_power(ax, part, log=log, named=not log)
            rhythms(ax, part)
        else:
            _harmonic(ax, part, frequency, fitted)
    ax.set_title(title or ("Logarithmic" if log else "Linear"), parse_math=False)
    if log:
        ax.set_xlim(frequency[frequency > 0][0] / 1.15, frequency[-1] * 1.15)
        _log_limits(ax, part, fitted)
    else:
        ax.set(xlim=(0, frequency[-1] + frequency[0]), ylim=(0, None))
    ax.set_ylabel(PER_BIN)
    without_legend(ax)


def _parts_are_drawn(part: Any) -> bool:
    """Of a model richer than the base one."""
    return bool(set(part.components) - {"relaxation", "floor", "harmonic"})


def _log_limits(ax: Axes, part: Any, fitted: Any) -> None:
    band = part.target.sampling_band()
    seen = np.concatenate([part.target.proportional_power, fitted, *(band or ())])
    seen = seen[np.isfinite(seen) & (seen > 0)]
    low = lowest(part, float(seen.min())) if _parts_are_drawn(part) else seen.min()
    ax.set_ylim(low / 1.4, seen.max() * 1.4)
    log_axis(ax, "y")


def _harmonic(ax: Axes, part: Any, frequency: Any, fitted: Any) -> None:
    """The harmonic's part of the fitted power, and its frequency."""
    share = np.asarray(part.harmonic_share)
    total, where = float(np.sum(fitted * share)), float(part.task["harmonic_frequency"])
    if not (math.isfinite(total) and total > 0):
        return
    percent = "<0.1" if total < 1e-3 else f"{100 * total:.2g}"
    held = fitted * share > 0
    ax.fill_between(
        frequency,
        fitted * (1 - share),
        fitted,
        where=held | np.roll(held, 1) | np.roll(held, -1),
        color=ORANGE,
        alpha=0.7,
        lw=0,
        zorder=2,
    )
    mark(ax, part, where, ORANGE, f"harmonic: {where:.2f} Hz, {percent} % of power")


def _residuals(ax: Axes, part: Any, verdict: tuple[str, float | None] = ("", None)) -> None:
    """Bars, with the range that one and two standard deviations cover if these are known; how close
    the fit is."""
    frequency, residual = np.asarray(part.frequency_hz), np.asarray(part.residual)
    known, finite = part.deviation is not None, np.isfinite(residual)
    outside = (np.abs(residual) > 2) & known
    width = 0.7 * np.min(np.diff(frequency), initial=math.inf)
    drawn = ax.bar(
        frequency,
        np.where(finite, residual, 0.0),
        width if math.isfinite(width) else 0.1,
        color=np.where(outside, VERMILLION, BLUE),
        zorder=3,
    )
    for first in np.flatnonzero(outside)[:1]:
        drawn[first].set_label("residual beyond 2 SD")
    _closeness(ax, part, *verdict)
    least = 3.0 if known else 0.1
    reach = 1.1 * float(np.max(np.abs(residual), where=finite, initial=least))
    ax.set(xlim=(0, frequency[-1] + frequency[0]), ylim=(-reach, reach))
    ax.set(xlabel="Frequency (Hz)", ylabel="Residual (SD)" if known else "Residual (ln units)")
    if known:
        shade_deviations(ax)
    if not finite.all():
        _say(ax, "no finite fit")
    ax.axhline(0, color=ink(), lw=0.6, zorder=4)


def _closeness(ax: Axes, part: Any, said: str, p: float | None) -> None:
    """The verdict of the fit with its χ²; of one target among several the χ² of the line that is
    drawn."""
    if not np.isfinite(part.fitted).all():
        words = "Residual"
    elif p is not None:
        words = f"{said.replace('chi2', 'χ²')}, {probability(p)}"
    elif part.chi2_per_bin is None:
        words = "no χ² (spread unknown)"
    else:
        words = f"χ² per bin {part.chi2_per_bin:.2f}"
    green = DARK_GREEN if shade(0.0) > shade(1.0) else GREEN
    ax.set_title(words, color=ink() if p is None else green if p >= 0.01 else VERMILLION)


def _stretch(ax: Axes, part: Any, relative: bool) -> None:
    """A simulated path; `relative` to its mean, where the data do not tell how many newtons that
    is."""
    task = part.task
    time, output = map(np.asarray, part.stretch or ((), ()))
    label = "Force / mean" if relative else output_label(task.output_name, task.output_unit)
    output = output / np.mean(output) if relative and output.size else output
    ax.set(xlabel="Time (s)", ylabel=label)
    ax.set_title("One simulated recording")
    if not output.size and np.isfinite(part.fitted).all():
        _say(ax, "not simulated", color=GREY)
        return
    if output.size < 2 or not np.isfinite(output).all():
        _say(ax, "no finite simulation")
        return
    ax.plot(time, output, color=BLUE, lw=0.9)
    ax.set_xlim(time[0], 2 * time[-1] - time[-2])


def _profile(ax: Axes, result: Any) -> None:
    """Which other frequencies of the harmonic the spectrum allows."""
    frequency, rise = map(np.asarray, result.profile)
    allowed = f"Δχ² < {ALLOWED:g}: in the 95 % interval"
    ax.axhspan(0, ALLOWED, color=shade(0.1), lw=0, zorder=0, label=allowed)
    ax.plot(frequency, rise, color=BLUE, marker=".", ms=3)
    ax.axvline(
        float(result.task["harmonic_frequency"]), color=ORANGE, lw=0.8, ls=(0, (4, 2)), zorder=0
    )
    ax.set_title("Profile of the harmonic's frequency")
    if result.harmonic_p_value is not None:
        ax.set_title(f"harmonic p = {result.harmonic_p_value:.2g}", loc="right", weight="normal")
    top = float(np.max(rise, where=np.isfinite(rise), initial=2 * ALLOWED))
    ax.set(xlim=(0, frequency[-1] + frequency[0]), ylim=(0, 1.05 * top))
    ax.set(xlabel="Frequency (Hz)", ylabel="Δχ²")


def _say(ax: Axes, message: str, color: str = VERMILLION) -> None:
    """A panel that has nothing to show."""
    ax.set(xticks=[], yticks=[])
    style: Style = {"transform": ax.transAxes, "color": color, "weight": "bold"}
    ax.text(0.5, 0.52, message, ha="center", va="bottom", **style)
