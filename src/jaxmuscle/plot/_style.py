"""The style of all figures: colours that colour-blind readers can tell apart, sizes for print, axes
with their units."""

import functools
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, ParamSpec, TypeVar, cast

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from jaxmuscle._common.text import printable

from ._numbers import number_in_print

# Okabe & Ito 2008, Color Universal Design: told apart with any common form of colour vision.
BLUE, VERMILLION, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
ORANGE, SKY, GREY = "#E69F00", "#56B4E9", "#767676"
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
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 8.0,
    "legend.facecolor": "inherit",
    "legend.edgecolor": "none",
    "legend.framealpha": 0.85,
    "lines.linewidth": 1.5,
    "figure.dpi": 160.0,
}
COLUMN = 4.4  # inches: in a column of 85 mm letters of 8 points are those of 6
ON_DARK = 1.8  # times as strong is a grey on a dark page, to be seen as well
LINE = 0.17  # inches
ACROSS = 2  # panels in a row
# from end to end of a logarithmic axis: of so few 1, 2 and 5 may leave one number only
NARROW = 4.0
LOCK = threading.RLock()  # pyplot and rcParams are those of all threads
PROPORTIONAL = "Proportional power (fraction per bin)"
PER_BIN = "Power (fraction per bin)"  # beside others, where there is less room

AnyFigure = Figure | SubFigure
Style = dict[str, Any]  # of lines, areas and letters, for matplotlib's functions
P = ParamSpec("P")
R = TypeVar("R")


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Runs a drawing function in this module's style, one thread at a time; the caller's rcParams
    stay the same."""

    @functools.wraps(draw)
    def inside(*args: P.args, **kwargs: P.kwargs) -> R:
        with LOCK:
            # Not rc_context: it also restores what a notebook's backend sets about itself while the
            # first figure is made.
            params = cast(Any, matplotlib.rcParams)
            before = {name: params[name] for name in STYLE}
            params.update(STYLE)
            try:
                return draw(*args, **kwargs)
            finally:
                params.update(before)

    return inside


def ink() -> str:
    """The colour of letters, for lines and points that are to stand out: black, or white on a dark
    page."""
    return matplotlib.rcParams["text.color"]


def shade(strength: float) -> tuple[float, float, float]:
    """A grey between the page (0) and the letters (1), for areas behind lines; right on a white and
    on a dark page."""
    page, letters = (
        np.array(to_rgb(matplotlib.rcParams[name])) for name in ("axes.facecolor", "text.color")
    )
    strength *= 1.0 if page.mean() > letters.mean() else ON_DARK
    red, green, blue = page + strength * (letters - page)
    return float(red), float(green), float(blue)


def canvas(
    ax: Axes | None, heights: Iterable[float], width: float = COLUMN, **pads: float
) -> AnyFigure:
    """What several panels are drawn into: a new figure for rows of these heights [inches], or the
    place that `ax` has in its figure."""
    if ax is None:
        figure = plt.figure(figsize=(width, sum(heights)), layout="constrained")
        figure.set_layout_engine("constrained", **pads)
        return figure
    place, whole = ax.get_subplotspec(), ax.get_figure()
    if place is None or whole is None:
        raise ValueError("ax has no place in a grid: give one made by plt.subplots or add_subplot")
    ax.remove()
    return whole.add_subfigure(place)


def panels(
    ax: Axes | None, layout: str, heights: Sequence[float], **shared: Any
) -> tuple[AnyFigure, list[Axes]]:
    """A canvas with panels as matplotlib's mosaic has them: "AA;BC" is one above two."""
    fig = canvas(ax, heights)
    return fig, [*fig.subplot_mosaic(layout, height_ratios=heights, **shared).values()]


def panel_grid(
    fig: AnyFigure, count: int, across: int = ACROSS, **shared: Any
) -> tuple[list[Axes], np.ndarray]:
    """So many panels, `across` of them in a row; and the whole grid, which may have had more."""
    grid = fig.subplots(rows_for(count, across), across, squeeze=False, **shared)
    for panel in grid.flat[count:]:
        panel.remove()
    return list(grid.flat[:count]), grid


def rows_for(count: int, across: int = ACROSS) -> int:
    """How many rows so many panels need."""
    return -(-count // across)


def finish(
    fig: AnyFigure,
    heights: Iterable[float],
    title: str | None = None,
    *,
    bad: str = "",
    columns: int = 2,
    plain: bool = False,
    width: float = COLUMN,
) -> AnyFigure:
    """The figure with its heading and its key; one of its own becomes as high as its panels and
    these words need."""
    lines = 0 if title is None else heading(fig, title, bad=bad)
    return fit_height(fig, heights, lines + key(fig, columns, plain=plain), width)


def fit_height(
    fig: AnyFigure, heights: Iterable[float], lines: int, width: float = COLUMN
) -> AnyFigure:
    """A figure of its own becomes as high as its panels and so many lines of words need."""
    if isinstance(fig, Figure):
        fig.set_size_inches(width, sum(heights) + 0.3 + LINE * lines)
    return fig


def output_label(name: str, unit: str) -> str:
    """Axis label of a task's output, as `Force $F_\\mathrm{ext}$ (N)`."""
    quantity = {"N": "Force ", "m": "Displacement ", "m/s^2": "Acceleration "}.get(unit, "")
    base, _, index = name.partition("_")
    symbol = rf"${base}_\mathrm{{{index}}}$" if base.isalpha() and index.isalnum() else name
    return f"{quantity}{symbol} ({unit.replace('^2', '²')})"


def density_unit(unit: str) -> str:
    return f"{unit}²/Hz" if unit.isalpha() else f"({unit.replace('^2', '²')})²/Hz"


def shorten(name: str, most: int) -> str:
    """A name from a file as it is drawn: in one line, and cut where it is long."""
    shown = printable(name)
    return shown if len(shown) <= most else f"{shown[: most - 1]}…"


def heading(fig: AnyFigure, words: str, *, bad: str = "") -> int:
    """What is drawn, and below it in red what forbids to believe it; how many lines."""
    text = "\n".join(filter(None, (shorten(words, 50), bad)))
    color = VERMILLION if bad else ink()
    fig.suptitle(text, x=0.02, ha="left", size=9, weight="bold", color=color, parse_math=False)
    return 1 + bool(bad)


def key(fig: AnyFigure, columns: int = 2, *, plain: bool = False) -> int:
    """One legend below all panels, in which each name stands once that no panel's own legend has;
    how many lines.

    It has fewer columns than asked where it would be wider than the figure. `plain`, of names that
    somebody else gave, in which $ is no sign of mathematics.
    """
    own = [legend.get_texts() for ax in fig.axes if (legend := ax.get_legend()) is not None]
    said = {text.get_text() for texts in own for text in texts}
    named = {
        label: handle
        for ax in fig.axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
        if label not in said
    }
    if not named:
        return 0
    made = fig.legend(
        named.values(),
        named,
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        columnspacing=1.2,
    )
    for text in made.get_texts() if plain else ():
        text.set_parse_math(False)
    if columns > 1 and made.get_window_extent().width > fig.bbox.width:
        made.remove()
        return key(fig, columns - 1, plain=plain)
    return -(-len(named) // columns)


def without_legend(ax: Axes) -> Axes:
    """The axes, whose names stand elsewhere."""
    own = ax.get_legend()
    if own is not None:
        own.remove()
    return ax


def axes_or_new(ax: Axes | None, height: float = 3.0) -> Axes:
    """The axes, or those of a new figure of that height [inches]."""
    if ax is not None:
        return ax
    return plt.subplots(figsize=(COLUMN, height), layout="constrained")[1]


def legend(ax: Axes, place: Literal["upper right", "lower left", "above"]) -> None:
    """A legend in a fixed place, if there is anything to name: the best place is slow to find among
    many lines."""
    named = len(ax.get_legend_handles_labels()[0])
    if not named:
        return
    if place == "above":
        ax.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=min(named, 3),
            borderaxespad=0.0,
            columnspacing=1.2,
        )
    else:
        ax.legend(loc=place)


def frequency_axes(ax: Axes, log: bool, ordinate: str | None = None) -> None:
    """Frequency as abscissa; linear axes begin at 0. `ordinate` is the label of the other one."""
    ax.set_xlabel("Frequency (Hz)")
    if ordinate is not None:
        ax.set_ylabel(ordinate, parse_math=False)
    if log:
        log_axis(ax, "y")
        log_axis(ax)
        return
    ax.set_xlim(left=0, auto=None)
    if ax.get_yscale() == "linear":
        ax.set_ylim(bottom=0, auto=None)


def positive(frequency: np.ndarray, log: bool) -> Any:
    """Which bins can be drawn: over a logarithmic axis all but that of the mean."""
    return frequency > 0 if log else slice(None)


def shade_deviations(ax: Axes) -> None:
    """One and two standard deviations about zero, which is a line."""
    for deviations, grey in ((2, 0.06), (1, 0.13)):
        ax.axhspan(-deviations, deviations, color=shade(grey), lw=0, zorder=0)


ROOMY = 3.0  # inches, in which three decades have room for three numbers each


def log_axis(ax: Axes, which: Literal["x", "y"] = "x") -> None:
    """A logarithmic abscissa or ordinate with plain numbers, as many as have room, and two at
    least."""
    ax.set(**{f"{which}scale": "log"})
    room = ax.get_window_extent().width / ax.figure.dpi  # inches
    (low, high), axis, decades = (
        (ax.get_xlim(), ax.xaxis, 1e3 if room > ROOMY else 1e2)
        if which == "x"
        else (ax.get_ylim(), ax.yaxis, 1e2)
    )
    narrow = high < NARROW * low
    axis.set_major_locator(
        MaxNLocator(4, min_n_ticks=2)
        if narrow
        else LogLocator(subs=(1.0, 2.0, 5.0) if high < decades * low else (1.0,))
    )
    if narrow:
        axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda x, _: number_in_print(x)))
    axis.set_minor_formatter(NullFormatter())
