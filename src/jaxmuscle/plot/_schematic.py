"""The drawing of the model: two masses between origin and insertion, with their springs, dampers
and forces."""

import collections
import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from ._style import BLUE, ORANGE, VERMILLION, Style, ink, styled

WIDE = 85 / 25.4  # inches: one column of a journal
SIZE, SMALL, LINE = 7.0, 6.3, 8.2  # points
LOW, HIGH = -32.0, 42.0  # ordinates of the ends, in hundredths of the width
ORIGIN, END = 6.0, 98.0  # abscissae, in hundredths of the width
MASSES = {"w": 39.0, "z": 77.0}
# of a mass: half its width and height; of spring and damper: distance from the middle
HALF, TALL, LANE = 6.0, 15.0, 10.8
EDGE = ORIGIN - 4
DOWN = -25.5  # the ordinate of the arrows of displacement
INPUTS = ("P_w", "F_ext", "x_z")
SYMBOLS = {"a_z": r"\ddot{x}_\mathrm{z}"}
# between which abscissae the elements of a tissue lie
TISSUES = {
    "w": (ORIGIN, MASSES["w"] - HALF),
    "z": (MASSES["w"] + HALF, MASSES["z"] - HALF),
}
# Lines of a spring and of a damper about their middle: abscissae, ordinates, width. The damper is a
# cylinder, open to the right, with a piston and its rod.
ZIGZAG = np.concatenate([[-8.0], np.arange(-6.5, 7.0, 1.625), [8.0]])
SPRING = ((ZIGZAG, [0.0, 0.0, *np.resize([-2.4, 2.4], len(ZIGZAG) - 4), 0.0, 0.0], 1.0),)
DAMPER = (
    ([3.5, -4.5, -4.5, 3.5], [2.8, 2.8, -2.8, -2.8], 1.0),
    ([1.0, 1.0], [-2.1, 2.1], 1.6),
    ([1.0, 4.5], [0.0, 0.0], 0.9),
)
# of each kind: its ordinate, half its length, its lines
ELEMENTS = {"K": (LANE, 8.0, SPRING), "C": (-LANE, 4.5, DAMPER)}
Point = tuple[float, float]


@styled
def schematic(task: Any, ax: Axes | None = None) -> Axes:
    """Draws the model of a `task`: both masses, springs, dampers, forces and what is held.

    Blue is what the task prescribes, red its output; an orange arrow is upon what fluctuates.
    Displacements and P_w count in the direction of the contraction, F_ext against it.

    **Arguments:** `task`; `ax`. **Returns:** the axes (`ax` or new).
    """
    if ax is None:
        ax = plt.figure(figsize=(WIDE, WIDE * (HIGH - LOW) / 100)).add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, 100), ylim=(LOW, HIGH), aspect="equal")
    ax.axis("off")
    given = [field.name for field in dataclasses.fields(task) if field.name in INPUTS]
    # the colours of what the task prescribes, and of its output; all else has that of letters
    roles = collections.defaultdict(ink, dict.fromkeys(given, BLUE))
    roles[task.output_name.replace("a_z", "x_z")] = VERMILLION
    _wall(ax, ORIGIN, -1)
    _elements(ax, {name[-3:] for name in task.parameter_names if np.any(task[name] != 0)})
    _masses(ax, roles)
    _forces(ax, roles)
    if "x_z" in given:
        _holder(ax, moving=callable(task.x_z), color=roles["x_z"])
    _write(ax, (EDGE, HIGH), -0.7, type(task).__name__, ha="left", weight="bold")
    words = f"given {', '.join(map(_symbol, given))}"
    _write(ax, (EDGE, HIGH), -1.8, words, BLUE, ha="left")
    words = f"output {_symbol(task.output_name)}"
    _write(ax, (END, HIGH), -1.8, words, VERMILLION, ha="right")
    return ax


def _symbol(name: str) -> str:
    base, _, index = name.partition("_")
    return "$" + SYMBOLS.get(name, rf"{base}_\mathrm{{{index}}}") + "$"


def _elements(ax: Axes, fluctuating: Collection[str]) -> None:
    """Springs and dampers with the rods that hold them, their symbols outside."""
    for index, (left, right) in TISSUES.items():
        middle = (left + right) / 2
        for kind, (lane, half, lines) in ELEMENTS.items():
            for x, y, width in lines:
                _line(ax, middle + np.asarray(x), lane + np.asarray(y), width)
            for ends in ([left, middle - half], [middle + half, right]):
                _line(ax, ends, [lane, lane], 0.9)
            channel, side = f"{kind}_{index}", np.sign(lane)
            if channel in fluctuating:
                _arrow(ax, (middle - 5.0, lane - 4.2), (middle + 5.0, lane + 4.2), ORANGE, 0.9)
            _write(ax, (middle, side * TALL), 0.7 * side, _symbol(channel))


def _masses(ax: Axes, roles: Mapping[str, Any]) -> None:
    """Both masses with their displacements below."""
    for index, x in MASSES.items():
        box, name = ((x - HALF, -TALL), 2 * HALF, 2 * TALL), f"x_{index}"
        ax.add_patch(Rectangle(*box, facecolor=ink(), alpha=0.08, lw=0))
        ax.add_patch(Rectangle(*box, fill=False, edgecolor=ink(), lw=1.0))
        _write(ax, (x, 0.0), 0.0, _symbol(f"m_{index}"))
        _line(ax, [x, x], [-TALL, DOWN - 2.0], 0.7, roles[name])
        _arrow(ax, (x, DOWN), (x - 9.0, DOWN), roles[name], 0.9)
        _write(ax, (x - 9.5, DOWN), 0.0, _symbol(name), roles[name], ha="right")


def _forces(ax: Axes, roles: Mapping[str, Any]) -> None:
    """P_w and F_ext beside their arrows."""
    start, end = TISSUES["w"][1], MASSES["z"] + HALF
    _arrow(ax, (start, 0.0), (ORIGIN + 6.0, 0.0), roles["P_w"], 1.6)
    _write(ax, (sum(TISSUES["w"]) / 2, 0.0), 0.6, _symbol("P_w"), roles["P_w"])
    _arrow(ax, (end, 0.0), (END - 2.6, 0.0), roles["F_ext"], 1.6)
    _write(ax, ((end + END - 2.6) / 2, 0.0), -0.8, _symbol("F_ext"), roles["F_ext"])


def _holder(ax: Axes, *, moving: bool, color: Any) -> None:
    """What the insertion is held by: a motor or a wall."""
    if not moving:
        return _wall(ax, END - 2.6, 1)
    ax.add_patch(Rectangle((END - 6.0, 5.0), 6.0, 9.5, fill=False, edgecolor=color, lw=1.0))
    _line(ax, [MASSES["z"] + HALF, END - 6.0], [9.6, 9.6], 0.9, color)
    return _write(ax, (END - 3.0, 9.6), 0.0, "M", color, size=SMALL)


def _wall(ax: Axes, x: float, side: int) -> None:
    _line(ax, [x, x], [-TALL, TALL], 1.2)
    for y in np.linspace(-TALL, TALL - 4, 8):
        _line(ax, [x, x + 2.6 * side], [y + 2.6, y], 0.5)


def _line(ax: Axes, x: Any, y: Any, width: float, color: Any = None) -> None:
    style: Style = {"solid_capstyle": "butt", "solid_joinstyle": "round"}
    ax.plot(x, y, color=color or ink(), lw=width, **style)


def _arrow(ax: Axes, start: Point, end: Point, color: Any, width: float) -> None:
    style = {
        "arrowstyle": "-|>",
        "color": color,
        "lw": width,
        "shrinkA": 0.0,
        "shrinkB": 0.0,
        "mutation_scale": 4 + 3 * width,
    }
    ax.annotate("", end, start, arrowprops=style)


def _write(ax: Axes, at: Point, rows: float, text: str, color: Any = None, **style: Any) -> None:
    """Text as many lines above a point."""
    style = {"ha": "center", "va": "center", "size": SIZE, "color": color or ink()} | style
    ax.annotate(text, at, (0.0, rows * LINE), textcoords="offset points", **style)
