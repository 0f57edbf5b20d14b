"""The figure of a fit, for `jaxmuscle.plot.fit`: is the fit good, and what does it say?"""

import math
import textwrap
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from ._numbers import quantity
from ._spectra import target
from ._stiffness import gain, phase, stiffness_residuals
from ._style import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, canvas, legend, output_label, styled

WIDTH, LINE, FONT = 7.5, 0.165, 7.5  # inches, inches, points
TABLE = (0.535, 0.548, 0.83)  # where values end, errors begin, units begin
WRAP = 116  # characters of FONT on a line of WIDTH

ALLOWED = 3.84  # 95 % quantile of χ² with one degree of freedom
DARK_GREEN = "#00664A"  # the palette's green is too light for small letters
_ORIGIN = {"measured": "Measured", "digitised": "Digitised", "user": "User's"}
_Line = tuple[str, dict[str, Any]]


@styled
def fit(result: Any, ax: Axes | None = None) -> Figure | SubFigure:
    """Draws what a fit found: spectra linear and logarithmic, residuals, simulated output and parameters.

    The band around the target is that of `target`. Residuals are in standard deviations of the log power, positive
    where the target is above the fit. Parameters that were not fitted are left out of the table, and those that the
    data do not determine are marked.

    **Arguments:** `result`, what `jaxmuscle.fit` returns; `ax`, its place. **Returns:** the figure.
    """
    header, notes = _header(result), _notes(result)
    free = result.as_shown({name: estimate for name, estimate in result.parameters.items() if estimate.free})
    derived = {name: p for name, p in result.as_shown(result.derived).items() if p.free}
    rows = 1 + max(len(free), len(derived), 1)
    panels = _panels(result)
    text = [LINE * (rows + 1), *[LINE * len(notes)] * bool(notes)]
    heights = [LINE * (len(header) + 0.7), *(height for height, _ in panels), *text]
    fig = canvas(ax, (WIDTH, sum(heights) + 1.25), w_pad=0.08, h_pad=0.05)
    grid = fig.add_gridspec(len(heights), 2, height_ratios=heights)
    _lines(fig.add_subplot(grid[0, :]), header)
    for row, (_, draw) in enumerate(panels, start=1):
        for column, panel in enumerate(draw):
            panel(fig.add_subplot(grid[row, column] if len(draw) > 1 else grid[row, :]))
    below = 1 + len(panels)
    _table(fig.add_subplot(grid[below, 0]), "Fitted parameters", free, rows)
    _table(fig.add_subplot(grid[below, 1]), "Derived quantities", derived, rows)
    if notes:
        _lines(fig.add_subplot(grid[below + 1, :]), notes)
    return fig


Panel = Callable[[Axes], None]


def _panels(result: Any) -> list[tuple[float, tuple[Panel, ...]]]:
    """Rows of panels with their heights: of one target in full, of several one row each."""
    parts = result.parts
    if len(parts) > 1:
        rows: list[tuple[float, tuple[Panel, ...]]] = [
            (1.9, (partial(_spectra, part=part, log=True, title=f"{name}: {type(part.task).__name__}"),
                   partial(_residuals, part=part))) for name, part in parts.items() if part.fitted.size]  # fmt: skip
        return rows + [row for name, part in parts.items() for row in _moved(part, f"{name}: dynamic stiffness")]
    part = result.only
    rows = [
        (2.35, (partial(_spectra, part=part, log=False), partial(_spectra, part=part, log=True))),
        (1.75, (partial(_residuals, part=part), partial(_stretch, part=part))),
    ] if part.fitted.size else []  # fmt: skip
    rows += _moved(part, "Dynamic stiffness")
    return rows if result.profile is None else [*rows, (1.35, (partial(_profile, result=result),))]


def _moved(part: Any, title: str) -> list[tuple[float, tuple[Panel, ...]]]:
    """Rows for the dynamic stiffness of a part that has one."""
    if part.stiffness is None:
        return []
    measured, fitted = part.target.stiffness.known, ("fit", part.stiffness)
    return [(1.9, (partial(gain, response=measured, curve=fitted, title=title),
                   partial(phase, response=measured, curve=fitted))),
            (1.5, (partial(stiffness_residuals, part=part),))]  # fmt: skip


def _header(result: Any) -> list[_Line]:
    several = len(result.parts) > 1
    title = ", ".join(result.parts) if several else result.target.name
    lines = [(title if len(title) <= 60 else f"{title[:59]}…", {"size": 11, "weight": "bold"})]
    for name, part in result.parts.items():
        lines += _about(name if several else "", part)
    facts = [*_closeness(result.only)] if not several else []
    facts += [result.message.removeprefix("converged: ")] * result.success
    model = [] if several else [result.only.model, result.method]
    lines += _wrapped("  ·  ".join([*model, *facts]))
    believed = result.success and result.adequate is not False
    verdict = result.verdict[0].upper() + result.verdict[1:]
    lines += _wrapped(verdict, color=(DARK_GREEN if result.adequate else GREY) if believed else VERMILLION, weight="bold")
    for sentence in result.advice:
        lines += _wrapped(sentence[0].upper() + sentence[1:], color=VERMILLION)
    reasons = [part.target.reason for part in result.parts.values() if part.target.provenance == "reconstructed"]
    for notice in result.notices:
        if not any(reason in notice for reason in reasons):
            lines += _wrapped(f"Note: {notice}", most=3)
    return lines


def _about(name: str, part: Any) -> list[_Line]:
    """Where a target comes from; of several (each with its `name`) also its model and how close the fit is."""
    aim = part.target
    if name:
        model = part.model
        known = f"{name}: {aim.name} ({aim.provenance} {aim.quantity})"
        lines = _wrapped("  ·  ".join([known, model, *_closeness(part)]))
    else:
        what = aim.quantity if part.fitted.size else "dynamic stiffness"
        lines = _wrapped(f"{_ORIGIN.get(aim.provenance, '')} {what}: {aim.source}", most=2, color=GREY)
    if aim.provenance != "reconstructed":
        return lines
    told = _wrapped(f"RECONSTRUCTED, not measured: {aim.reason}", color=VERMILLION, weight="bold")
    return [*told, *(lines if name else [])]


def _closeness(part: Any) -> list[str]:
    facts = []
    if part.chi2_per_bin is not None:
        facts.append(f"χ² per bin {part.chi2_per_bin:.2f}")
    elif part.rms_log_error is not None:
        facts.append("no χ² (spread unknown)")
    if part.stiffness is not None:
        facts.append(f"χ² per point of stiffness {part.chi2_per_point:.2f}")
    return facts + ([] if part.rms_log_error is None else [f"rms log error {part.rms_log_error:.2f}"])


def _notes(result: Any) -> list[_Line]:
    """What was checked, and what the data do not determine, one bullet for each direction."""
    lines: list[_Line] = []
    for sentence in result.remarks:
        lines += _wrapped(sentence[0].upper() + sentence[1:] if len(result.parts) == 1 else sentence)
    if not result.undetermined:
        return lines
    whose = "the data" if len(result.parts) == 1 else "all targets together"
    lines += [(f"What {whose} do not notice", {"weight": "bold"})]
    for sentence in result.undetermined:
        lines += _wrapped(sentence, first="•  ", rest="    ")
    return lines


def _wrapped(text: str, most: int = 4, first: str = "", rest: str = "", **style: Any) -> list[_Line]:
    # Bold letters are wider.
    width = int(WRAP * (0.88 if style.get("weight") == "bold" else 1.0))
    wrap = textwrap.TextWrapper(width, initial_indent=first, subsequent_indent=rest, max_lines=most, placeholder=" …")
    return [(line, style) for line in wrap.wrap(text)]


def _lines(ax: Axes, lines: list[_Line]) -> None:
    """Text from the top of the axes down; the first line has half a line more room."""
    _text_only(ax, len(lines) + 0.7)
    for i, (text, style) in enumerate(lines):
        _text(ax, 0.0, i + 0.5 + 0.3 * (i > 0), text, **({"size": FONT} | style))


def _text_only(ax: Axes, rows: float) -> None:
    ax.axis("off")
    ax.set(xlim=(0, 1), ylim=(rows, 0))


def _text(ax: Axes, x: float, y: float, text: str, **style: Any) -> None:
    """Text that neither takes part in the layout nor is read as mathematics (a name may hold a dollar)."""
    ax.text(x, y, text, va="center", parse_math=False, **style).set_in_layout(False)


def _spectra(ax: Axes, part: Any, *, log: bool, title: str = "") -> None:
    frequency, fitted = np.asarray(part.frequency_hz), np.asarray(part.fitted)
    target(part.target, ax, log=log)
    dots = ax.lines[0]
    dots.set_label("target, reconstructed" if part.target.provenance == "reconstructed" else "target")
    if np.isfinite(fitted).any():
        dots.set_linewidth(0.0)
        ax.plot(frequency, fitted, color=BLUE, label="fit", zorder=4)
        if set(part.components) - {"relaxation", "floor", "harmonic"}:
            _components(ax, part, frequency, fitted, log=log)
        else:
            _harmonic(ax, part, frequency, fitted)
    ax.set_title(title or ("Logarithmic" if log else "Linear"), parse_math=False)
    if log:
        ax.set_xlim(frequency[frequency > 0][0] / 1.15, frequency[-1] * 1.15)
        _log_limits(ax, part, fitted)
        if title:
            legend(ax, "lower left")
        else:
            ax.legend().remove()  # the other panel's says it
    else:
        ax.set(xlim=(0, frequency[-1] + frequency[0]), ylim=(0, None))
        legend(ax, "upper right")


def _log_limits(ax: Axes, part: Any, fitted: Any) -> None:
    band = part.target.sampling_band()
    seen = np.concatenate([part.target.proportional_power, fitted, *(band or ())])
    seen = seen[np.isfinite(seen) & (seen > 0)]
    ax.set_ylim(seen.min() / 1.4, seen.max() * 1.4)


AREAS = {"floor": ("0.75", "floor"), "relaxation": (SKY, "relaxation"), "harmonic": (ORANGE, "harmonic"),
         "tremor": (GREEN, "tremor"), "resonance_2": (PURPLE, "second resonance")}  # fmt: skip


def _components(ax: Axes, part: Any, frequency: Any, fitted: Any, *, log: bool) -> None:
    """What the parts of the model hold of the fitted power: one area upon the other; over a logarithmic axis, lines."""
    below = np.zeros(len(fitted))
    for name, (color, words) in AREAS.items():
        power = fitted * np.maximum(part.components.get(name, 0.0), 0.0)
        total = float(np.sum(power))
        if not total > 1e-4:
            continue
        if log:
            ax.plot(frequency, np.where(power > 0, power, np.nan), color=color, lw=1.0, zorder=3)
            continue
        label = f"{words}, {'<1' if total < 0.01 else f'{100 * total:.0f}'} % of power"
        ax.fill_between(frequency, below, below + power, color=color, alpha=0.7, lw=0, zorder=2, label=label)
        below = below + power


def _harmonic(ax: Axes, part: Any, frequency: Any, fitted: Any) -> None:
    """The harmonic's part of the fitted power, and its frequency."""
    share = np.asarray(part.harmonic_share)
    total, where = float(np.sum(fitted * share)), float(part.task["harmonic_frequency"])
    if not (math.isfinite(total) and total > 0):
        return
    percent = "<0.1" if total < 1e-3 else f"{100 * total:.2g}"
    held = fitted * share > 0
    ax.fill_between(frequency, fitted * (1 - share), fitted, where=held | np.roll(held, 1) | np.roll(held, -1),
                    color=ORANGE, alpha=0.7, lw=0, zorder=2)  # fmt: skip
    label = f"harmonic: {where:.2f} Hz, {percent} % of power"
    inside = frequency[0] / 2 <= where <= frequency[-1] * 1.05
    ax.plot([where] if inside else [], [0.03] if inside else [], color=ORANGE, marker="^", ms=5, lw=0, label=label,
            transform=ax.get_xaxis_transform(), clip_on=False, zorder=5)  # fmt: skip
    if inside:
        ax.axvline(where, color=ORANGE, lw=0.8, ls=(0, (4, 2)), zorder=0)


def _residuals(ax: Axes, part: Any) -> None:
    """Bars, with the range that one and two standard deviations cover if these are known."""
    frequency, residual = np.asarray(part.frequency_hz), np.asarray(part.residual)
    known = part.deviation is not None
    outside = np.abs(residual) > 2 if known else np.zeros(residual.shape, bool)
    width = 0.7 * np.min(np.diff(frequency), initial=math.inf)
    bars = {"width": width if math.isfinite(width) else 0.1, "zorder": 3}
    ax.bar(frequency, np.where(np.isfinite(residual), residual, 0.0), color=np.where(outside, VERMILLION, BLUE), **bars)
    ax.set_title("Residual per bin: target above (+) or below (–) fit")
    ax.set(xlabel="Frequency (Hz)", xlim=(0, frequency[-1] + frequency[0]))
    reach = float(np.max(np.abs(residual), where=np.isfinite(residual), initial=3.0 if known else 0.1)) * 1.1
    ax.set(ylim=(-reach, reach), ylabel="Residual (SD)" if known else "Residual (ln units)")
    if known:
        for deviations, shade in ((2, "0.94"), (1, "0.87")):
            ax.axhspan(-deviations, deviations, color=shade, lw=0, zorder=0)
    if not np.isfinite(residual).all():
        _say(ax, "no finite fit")
    ax.axhline(0, color=BLACK, lw=0.6, zorder=4)


def _stretch(ax: Axes, part: Any) -> None:
    task = part.task
    time, output = map(np.asarray, part.stretch or ((), ()))
    ax.set(xlabel="Time (s)", ylabel=output_label(task.output_name, task.output_unit))
    ax.set_title("Simulated output, one noise path")
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
    ax.axhspan(0, ALLOWED, color="0.9", lw=0, zorder=0)
    ax.plot(frequency, rise, color=BLUE, marker=".", ms=3)
    ax.axvline(float(result.task["harmonic_frequency"]), color=ORANGE, lw=0.8, ls=(0, (4, 2)), zorder=0)
    title = "Profile: rise of χ² with the harmonic held at a frequency (grey: 95 % interval)"
    if result.harmonic_p_value is not None:
        title += f"; harmonic p = {result.harmonic_p_value:.2g}"
    ax.set_title(title)
    top = float(np.max(rise, where=np.isfinite(rise), initial=2 * ALLOWED))
    ax.set(xlabel="Frequency (Hz)", ylabel="Δχ²", xlim=(0, frequency[-1] + frequency[0]), ylim=(0, 1.05 * top))


def _say(ax: Axes, message: str, color: str = VERMILLION) -> None:
    """A panel that has nothing to show."""
    ax.set(xticks=[], yticks=[])
    style: dict[str, Any] = {"ha": "center", "va": "bottom", "color": color, "weight": "bold"}
    ax.text(0.5, 0.52, message, transform=ax.transAxes, **style)


def _table(ax: Axes, title: str, estimates: Mapping[str, Any], rows: int) -> None:
    """Name, value ± standard error, unit; powers of ten stand with the unit."""
    _text_only(ax, rows + 1.0)
    _text(ax, 0.0, 0.5, title, weight="bold", size=8)
    _row(ax, 0.5, ("value", "± standard error", "unit"), color=GREY, size=FONT - 1)
    ax.axhline(1.0, color=BLACK, lw=0.6)
    if not estimates:
        _text(ax, 0.0, 1.6, "none", color=GREY, size=FONT)
    for i, (name, estimate) in enumerate(estimates.items()):
        style = {"size": FONT - 0.5, "color": BLACK if estimate.identifiable else GREY}
        _text(ax, 0.0, 1.6 + i, name if len(name) <= 24 else f"{name[:11]}…{name[-9:]}", **style)
        _row(ax, 1.6 + i, quantity(estimate), **style)


def _row(ax: Axes, y: float, cells: tuple[str, str, str], **style: Any) -> None:
    for x, text, side in zip(TABLE, cells, ("right", "left", "left"), strict=True):
        _text(ax, x, y, text, ha=side, **style)
