"""The drawing of the model: two masses between origin and insertion, with their springs, dampers,
forces and numbers."""

import collections
import dataclasses
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from ._numbers import quantity, unit_in_print
from ._style import BLUE, GREY, ORANGE, VERMILLION, ink, styled

WIDE = 85 / 25.4  # inches: one column of a journal
SIZE, SMALL, LINE = 7.0, 6.3, 8.2  # points
ORIGIN, W, Z, END = 6.0, 39.0, 77.0, 98.0  # abscissae in hundredths of the width
# of a mass: half its width and height; of spring and damper: distance from the middle
HALF, TALL, LANE = 6.0, 15.0, 10.8
MIDDLE_W, MIDDLE_Z, EDGE = (ORIGIN + W - HALF) / 2, (W + Z) / 2, ORIGIN - 4
INPUTS, CHANNELS = ("P_w", "F_ext", "x_z"), ("K_w", "K_z", "C_w", "C_z")
BASE = [f"{channel}0" for channel in CHANNELS]
UNITS = {
    "K_w0": "N/m",
    "K_z0": "N/m",
    "C_w0": "N s/m",
    "C_z0": "N s/m",
    "m_w": "kg",
    "m_z": "kg",
    "P_w": "N",
    "F_ext": "N",
    "activation_time": "s",
}
SYMBOLS = {"a_z": r"\ddot{x}_\mathrm{z}"}
DOWN = -25.5  # the ordinate of the arrows of displacement
Point = tuple[float, float]
OPEN = "†"  # behind what the data do not determine


class _Number(NamedTuple):
    """As a result's `Estimate`; of a task nothing is free."""

    value: float
    unit: str
    stderr: float | None = None
    free: bool = False
    identifiable: bool | None = None


@styled
def schematic(task: Any, ax: Axes | None = None, *, values: bool = True) -> Axes:
    """Draws the model of a `task`, or of the result of a fit: both masses, springs, dampers, forces
    and what is held.

    Blue is what the task prescribes, red its output; an orange arrow is upon what fluctuates.
    Displacements and P_w count in the direction of the contraction, F_ext against it. With a result
    the numbers have their standard errors, and † is behind what was fitted and the data do not
    determine.

    **Arguments:**

    - `task`: a task or what `jaxmuscle.fit` returns
    - `ax`
    - `values`: whether numbers are written

    **Returns:** the axes (`ax` or new).

    **Raises:** `ValueError` for a fit of several targets, which has a task for each.
    """
    model, numbers = _task_of(task)
    noise, slow = _noise(model, numbers), _rhythms(model, numbers)
    low, high = (-29 - 3.6 * (1 + len(slow)), 36) if values else (-32, 42)
    if ax is None:
        ax = plt.figure(figsize=(WIDE, WIDE * (high - low) / 100)).add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, 100), ylim=(low, high), aspect="equal")
    ax.axis("off")
    # the colours of what the task prescribes, and of its output; all else has that of letters
    roles = collections.defaultdict(ink, dict.fromkeys(_given(model), BLUE))
    roles[model.output_name.replace("a_z", "x_z")] = VERMILLION
    _tissues(ax)
    _elements(ax, noise)
    _masses(ax, roles)
    _insertion(ax, model, roles)
    _head(ax, model)
    left_open = any(it.free and not it.identifiable for it in numbers.values())
    if not values:
        numbers, noise = {}, {}
    _names(ax, roles, numbers, noise)
    _forces(ax, roles, numbers)
    if values:
        _foot(ax, slow, left_open)
    return ax


def _task_of(task: Any) -> tuple[Any, dict[str, Any]]:
    """The task, and its numbers by name: of a fit with their errors."""
    tasks = getattr(task, "tasks", None)
    if tasks is None:
        base = zip(BASE, np.asarray(task.muscle.base()), strict=True)
        values = {name: task[name] for name in task.parameter_names} | dict(base)
        return task, {
            n: _Number(float(v), "Hz" if n.endswith("frequency") else UNITS.get(n, "1"))
            for n, v in values.items()
            if np.ndim(v) == 0
        }
    if len(tasks) > 1:
        raise ValueError(
            "a fit of several targets has a task for each: draw one, as schematic(result.tasks"
            f"[{next(iter(tasks))!r}])"
        )
    model = next(iter(tasks.values()))
    return model, _task_of(model)[1] | task.as_shown(task.parameters | task.derived)


def _given(model: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(model) if field.name in INPUTS]


def _symbol(name: str) -> str:
    base, _, index = name.partition("_")
    return "$" + SYMBOLS.get(name, rf"{base}_\mathrm{{{index}}}") + "$"


# --- numbers


def _in_words(name: str, numbers: Mapping[str, Any]) -> str:
    """A number with its error and unit, marked where the data leave it open; nothing where there is
    none."""
    if name not in numbers:
        return ""
    estimate = numbers[name]
    if estimate.free and not estimate.identifiable:
        value, _, unit = quantity(estimate)
        return f"{value} {unit} {OPEN}"
    if estimate.stderr is None:
        return f"{float(estimate.value):.3g} {unit_in_print(estimate.unit)}"
    return " ".join(part for part in quantity(estimate) if part != "–")


def _share(name: str, numbers: Mapping[str, Any]) -> str:
    """A fraction in per cent."""
    it = numbers[name]
    error = None if it.stderr is None else 100 * it.stderr
    return _in_words(name, {name: _Number(100 * it.value, "%", error, it.free, it.identifiable)})


def _noise(model: Any, numbers: Mapping[str, Any]) -> dict[str, list[str]]:
    """How much the noise of each coefficient and of the drive is, where there is any."""
    found: dict[str, list[str]] = collections.defaultdict(list)
    for prefix, part in _components(model):
        for channel in (*CHANNELS, "P_w", "amplitude"):
            name = f"{prefix}_{channel}"
            if name in numbers and numbers[name].value != 0:
                amount = _share(name, numbers) if part.relative else _in_words(name, numbers)
                rhythm = f"resonance {amount} at {_in_words(f'{prefix}_frequency', numbers)}"
                words = rhythm if part.sort == "resonance" else f"noise {amount}"
                found["P_w" if channel == "amplitude" else channel].append(words)
    return found


def _components(model: Any) -> list[tuple[str, Any]]:
    """The noises of a sum with what the names of their parameters begin with."""
    counts: collections.Counter[str] = collections.Counter()
    found = []
    for part in model.noise.components:
        counts[part.sort] += 1
        again = f"_{counts[part.sort]}" * (counts[part.sort] > 1)
        found.append((part.sort + again, part))
    return found


def _rhythms(model: Any, numbers: Mapping[str, Any]) -> list[str]:
    """Lines about what belongs to no single element: the unit, the sine on both stiffnesses, all
    that the drive has."""
    relative = "K_w0" in numbers and numbers["K_w0"].unit == "1/m"
    found = ["per newton of mean force"] * relative
    K_w, K_z, P_w = map(_symbol, ("K_w", "K_z", "P_w"))
    if numbers["harmonic_amplitude"].value != 0:
        sine = _share("harmonic_amplitude", numbers), _in_words("harmonic_frequency", numbers)
        found.append(f"{K_w} and {K_z}: sine {' at '.join(sine)}")
    if "P_w" in numbers:
        found += [f"{P_w}: {words}" for words in _noise(model, numbers)["P_w"]]
        if model.activation is not None:
            found.append(f"{P_w} and {K_w}: twitch of {_in_words('activation_time', numbers)}")
    return found


# --- lines


def _line(ax: Axes, x: Any, y: Any, width: float, color: Any = None, **style: Any) -> None:
    ax.plot(x, y, color=ink() if color is None else color, lw=width, **style)


def _tissues(ax: Axes) -> None:
    """The origin, and the rods between which the elements lie."""
    _wall(ax, ORIGIN, -1)
    for left, right in ((ORIGIN, W - HALF), (W + HALF, Z - HALF)):
        for y, half in ((LANE, 8.0), (-LANE, 4.5)):
            middle = (left + right) / 2
            for ends in ([left, middle - half], [middle + half, right]):
                _line(ax, ends, [y, y], 0.9, solid_capstyle="butt")


def _wall(ax: Axes, x: float, side: int) -> None:
    _line(ax, [x, x], [-TALL, TALL], 1.2)
    for y in np.linspace(-TALL, TALL - 4, 8):
        _line(ax, [x, x + 2.6 * side], [y + 2.6, y], 0.5)


def _elements(ax: Axes, noise: Mapping[str, Any]) -> None:
    x = np.concatenate([[-8.0], np.arange(-6.5, 7.0, 1.625), [8.0]])
    y = np.concatenate([[0.0, 0.0], np.resize([-2.4, 2.4], len(x) - 4), [0.0, 0.0]])
    for index, middle in (("w", MIDDLE_W), ("z", MIDDLE_Z)):
        _line(ax, middle + x, LANE + y, 1.0, solid_joinstyle="round")
        # a damper: its cylinder, open to the right, the piston in it and the rod of that
        left, right, piston = middle - 4.5, middle + 3.5, middle + 1.0
        low, high = -LANE - 2.8, -LANE + 2.8
        _line(ax, [right, left, left, right], [high, high, low, low], 1.0)
        _line(ax, [piston] * 2, [-LANE - 2.1, -LANE + 2.1], 1.6, solid_capstyle="butt")
        _line(ax, [piston, middle + 4.5], [-LANE] * 2, 0.9)
        for lane, channel in ((LANE, f"K_{index}"), (-LANE, f"C_{index}")):
            if channel in noise:
                _arrow(ax, (middle - 5.0, lane - 4.2), (middle + 5.0, lane + 4.2), ORANGE, 0.9)


def _masses(ax: Axes, roles: Mapping[str, Any]) -> None:
    for x, name in ((W, "x_w"), (Z, "x_z")):
        box = (x - HALF, -TALL), 2 * HALF, 2 * TALL
        ax.add_patch(Rectangle(*box, facecolor=ink(), alpha=0.08, lw=0))
        ax.add_patch(Rectangle(*box, fill=False, edgecolor=ink(), lw=1.0))
        _line(ax, [x, x], [-TALL, DOWN - 2.0], 0.7, roles[name])
        _arrow(ax, (x, DOWN), (x - 9.0, DOWN), roles[name], 0.9)
    _arrow(ax, (W - HALF, 0.0), (ORIGIN + 6.0, 0.0), roles["P_w"], 1.6)


def _insertion(ax: Axes, model: Any, roles: Mapping[str, Any]) -> None:
    """What the insertion is held by (a wall, a motor, nothing), and the force there."""
    x, far, color = Z + HALF, END, roles["x_z"]
    if "x_z" in _given(model) and callable(model.x_z):
        ax.add_patch(Rectangle((END - 6.0, 5.0), 6.0, 9.5, fill=False, edgecolor=color, lw=1.0))
        ax.text(END - 3.0, 9.6, "M", color=color, ha="center", va="center", size=SMALL)
        _line(ax, [x, END - 6.0], [9.6, 9.6], 0.9, color)
    elif "x_z" in _given(model):
        far = END - 2.6
        _wall(ax, far, 1)
    _arrow(ax, (x, 0.0), (far, 0.0), roles["F_ext"], 1.6)


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


# --- words


def _head(ax: Axes, model: Any) -> None:
    """Name of the task, what it prescribes, and its output: the key to the colours."""
    top, given = ax.get_ylim()[1], ", ".join(map(_symbol, _given(model)))
    _write(ax, (EDGE, top), -0.7, type(model).__name__, ink(), "left", weight="bold")
    _write(ax, (EDGE, top), -1.8, f"given {given}", BLUE, "left")
    _write(ax, (END, top), -1.8, f"output {_symbol(model.output_name)}", VERMILLION, "right")


def _names(
    ax: Axes, roles: Mapping[str, Any], numbers: Mapping[str, Any], noise: Mapping[str, Any]
) -> None:
    """Symbols of masses, springs, dampers and displacements, with their numbers if there are
    any."""
    for index, x, middle, tissue in (
        ("w", W, MIDDLE_W, "active tissue"),
        ("z", Z, MIDDLE_Z, "passive tissue"),
    ):
        for channel, side in ((f"K_{index}", 1), (f"C_{index}", -1)):
            known = _in_words(f"{channel}0", numbers)
            first = f"{_symbol(channel + '0' * bool(known))}  {known}".rstrip()
            # the nearest to the element is the last of those above it
            for i, line in enumerate([first, *noise.get(channel, ())][::-side]):
                color = GREY if OPEN in line or line is not first else ink()
                size = SIZE if line is first else SMALL
                _write(ax, (middle, side * TALL), side * (i + 0.7), line, color, size=size)
        mass = _in_words(f"m_{index}", numbers)
        _write(ax, (x, 0.0), 0.55 * bool(mass), _symbol(f"m_{index}"), ink())
        for i, line in enumerate(mass.split(" ", 1) if len(mass) > 7 else [mass]):
            _write(ax, (x, 0.0), -0.55 - i, line, GREY if OPEN in mass else ink(), size=SMALL)
        name = f"x_{index}"
        _write(ax, (x - 9.5, DOWN), 0.0, _symbol(name), roles[name], "right")
        if numbers:
            _write(ax, (middle, TALL), 2.8, tissue, GREY, size=SMALL)


def _forces(ax: Axes, roles: Mapping[str, Any], numbers: Mapping[str, Any]) -> None:
    """P_w and F_ext beside their arrows; the mean of F_ext where a fit knows it."""
    drive = re.sub(r"(?<= )1\b", "× mean", _in_words("P_w", numbers))  # per newton of mean force
    _write(ax, (MIDDLE_W, 0.0), 0.6, f"{_symbol('P_w')}  {drive}".rstrip(), roles["P_w"])
    color, where = roles["F_ext"], ((Z + HALF + END - 2.6) / 2, 0.0)
    mean = _in_words("model_mean", numbers) * (color == VERMILLION)
    outside = _in_words("F_ext", numbers) or mean
    _write(ax, where, -0.8, _symbol("F_ext"), color)
    for i, line in enumerate(outside.replace(" ±", "\n±").splitlines()):
        _write(ax, where, -1.8 - i, line, color, size=SMALL)


def _foot(ax: Axes, slow: list[str], left_open: bool) -> None:
    """What belongs to no single element, and the key."""
    bottom = ax.get_ylim()[0]
    for i, line in enumerate(slow[::-1]):
        _write(ax, (EDGE, bottom), 1.7 + i, line, GREY, "left", SMALL)
    _arrow(ax, (EDGE, bottom + 0.5), (EDGE + 4, bottom + 3.7), ORANGE, 0.9)
    _write(ax, (EDGE + 5.5, bottom), 0.6, "fluctuates", GREY, "left", SMALL)
    if left_open:
        _write(ax, (END, bottom), 0.6, f"{OPEN} not determined by the data", GREY, "right", SMALL)


def _write(
    ax: Axes,
    at: Point,
    rows: float,
    text: str,
    color: Any,
    ha: Any = "center",
    size: float = SIZE,
    **style: Any,
) -> None:
    """Text as many lines above a point."""
    style |= {"color": color, "ha": ha, "va": "center", "size": size}
    ax.annotate(text, at, (0.0, rows * LINE), textcoords="offset points", **style)
