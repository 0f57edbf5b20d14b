"""The drawing of the model: two masses between origin and insertion, with their springs, dampers,
forces and numbers."""

import collections
import dataclasses
import re
from collections.abc import Mapping
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib import rcParams
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from ._numbers import quantity, unit_in_print
from ._style import BLUE, GREY, ORANGE, VERMILLION, styled

WIDE = 85 / 25.4  # inches: one column of a journal
SIZE, SMALL, LINE = 7.0, 6.3, 8.2  # points
ORIGIN, W, Z, END = 6.0, 39.0, 77.0, 98.0  # abscissae in hundredths of the width
# of a mass: half its width and height; of spring and damper: distance from the middle
HALF, TALL, LANE = 6.0, 15.0, 10.8
MIDDLE_W, MIDDLE_Z, EDGE = (ORIGIN + W - HALF) / 2, (W + Z) / 2, ORIGIN - 4
INPUTS, CHANNELS = ("P_w", "F_ext", "x_z"), ("K_w", "K_z", "C_w", "C_z")
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
    ink = rcParams["text.color"]
    roles = dict.fromkeys(_given(model), BLUE) | {
        model.output_name.replace("a_z", "x_z"): VERMILLION
    }
    down = -25.5
    _tissues(ax, ink)
    _elements(ax, ink, noise)
    _masses(ax, ink, roles, down)
    _insertion(ax, ink, model, roles)
    _head(ax, model)
    _names(ax, ink, roles, numbers if values else {}, noise if values else {}, down)
    _forces(ax, ink, roles, numbers if values else {})
    if values:
        _foot(ax, slow, any(it.free and not it.identifiable for it in numbers.values()))
    return ax


def _task_of(task: Any) -> tuple[Any, dict[str, Any]]:
    """The task, and its numbers by name: of a fit with their errors."""
    tasks = getattr(task, "tasks", None)
    if tasks is None:
        base = dict(
            zip(("K_w0", "K_z0", "C_w0", "C_z0"), np.asarray(task.muscle.base()), strict=True)
        )
        named = {name: task[name] for name in task.parameter_names}
        return task, {
            n: _Number(float(v), "Hz" if n.endswith("frequency") else UNITS.get(n, "1"))
            for n, v in (named | base).items()
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
        found.append(
            (part.sort if counts[part.sort] == 1 else f"{part.sort}_{counts[part.sort]}", part)
        )
    return found


def _rhythms(model: Any, numbers: Mapping[str, Any]) -> list[str]:
    """Lines about what belongs to no single element: the unit, the sine on both stiffnesses, all
    that the drive has."""
    found = (
        ["per newton of mean force"] if "K_w0" in numbers and numbers["K_w0"].unit == "1/m" else []
    )
    if numbers["harmonic_amplitude"].value != 0:
        sine = (
            f"sine {_share('harmonic_amplitude', numbers)} at"
            f" {_in_words('harmonic_frequency', numbers)}"
        )
        found.append(f"{_symbol('K_w')} and {_symbol('K_z')}: {sine}")
    if "P_w" in numbers:
        found += [f"{_symbol('P_w')}: {words}" for words in _noise(model, numbers)["P_w"]]
        if model.activation is not None:
            found.append(
                f"{_symbol('P_w')} and {_symbol('K_w')}: twitch of"
                f" {_in_words('activation_time', numbers)}"
            )
    return found


# --- lines


def _tissues(ax: Axes, ink: Any) -> None:
    """The origin, and the rods between which the elements lie."""
    _wall(ax, ORIGIN, -1, ink)
    for left, right in ((ORIGIN, W - HALF), (W + HALF, Z - HALF)):
        for y, half in ((LANE, 8.0), (-LANE, 4.5)):
            middle = (left + right) / 2
            ax.plot([left, middle - half], [y, y], color=ink, lw=0.9, solid_capstyle="butt")
            ax.plot([middle + half, right], [y, y], color=ink, lw=0.9, solid_capstyle="butt")


def _wall(ax: Axes, x: float, side: int, ink: Any) -> None:
    ax.plot([x, x], [-TALL, TALL], color=ink, lw=1.2)
    for y in np.linspace(-TALL, TALL - 4, 8):
        ax.plot([x, x + 2.6 * side], [y + 2.6, y], color=ink, lw=0.5)


def _elements(ax: Axes, ink: Any, noise: Mapping[str, Any]) -> None:
    for index, middle in (("w", MIDDLE_W), ("z", MIDDLE_Z)):
        x = np.concatenate([[-8.0], np.arange(-6.5, 7.0, 1.625), [8.0]])
        y = np.concatenate([[0.0], np.resize([2.4, -2.4], len(x) - 2), [0.0]])
        y[1] = y[-2] = 0.0
        ax.plot(middle + x, LANE + y, color=ink, lw=1.0, solid_joinstyle="round")
        ax.plot(
            middle + np.array([3.5, -4.5, -4.5, 3.5]),
            -LANE + np.array([2.8, 2.8, -2.8, -2.8]),
            color=ink,
            lw=1.0,
        )
        ax.plot(
            [middle + 1.0] * 2, [-LANE - 2.1, -LANE + 2.1], color=ink, lw=1.6, solid_capstyle="butt"
        )
        ax.plot([middle + 1.0, middle + 4.5], [-LANE] * 2, color=ink, lw=0.9)
        for lane, channel in ((LANE, f"K_{index}"), (-LANE, f"C_{index}")):
            if channel in noise:
                _arrow(ax, (middle - 5.0, lane - 4.2), (middle + 5.0, lane + 4.2), ORANGE, 0.9)


def _masses(ax: Axes, ink: Any, roles: Mapping[str, Any], down: float) -> None:
    for x, name in ((W, "x_w"), (Z, "x_z")):
        box = Rectangle((x - HALF, -TALL), 2 * HALF, 2 * TALL, facecolor=ink, alpha=0.08, lw=0)
        ax.add_patch(box)
        ax.add_patch(
            Rectangle((x - HALF, -TALL), 2 * HALF, 2 * TALL, fill=False, edgecolor=ink, lw=1.0)
        )
        color = roles.get(name, ink)
        ax.plot([x, x], [-TALL, down - 2.0], color=color, lw=0.7)
        _arrow(ax, (x, down), (x - 9.0, down), color, 0.9)
    _arrow(ax, (W - HALF, 0.0), (ORIGIN + 6.0, 0.0), roles.get("P_w", ink), 1.6)


def _insertion(ax: Axes, ink: Any, model: Any, roles: Mapping[str, Any]) -> None:
    """What the insertion is held by (a wall, a motor, nothing), and the force there."""
    x = Z + HALF
    if "x_z" not in _given(model):
        _arrow(ax, (x, 0.0), (END, 0.0), roles["F_ext"], 1.6)
        return
    if not callable(model.x_z):
        _wall(ax, END - 2.6, 1, ink)
    else:
        ax.add_patch(
            Rectangle((END - 6.0, 5.0), 6.0, 9.5, fill=False, edgecolor=roles["x_z"], lw=1.0)
        )
        ax.text(END - 3.0, 9.6, "M", color=roles["x_z"], ha="center", va="center", size=SMALL)
        ax.plot([x, END - 6.0], [9.6, 9.6], color=roles["x_z"], lw=0.9)
    far = END - 2.6 if not callable(model.x_z) else END
    _arrow(ax, (x, 0.0), (far, 0.0), roles.get("F_ext", ink), 1.6)


def _arrow(
    ax: Axes, start: tuple[float, float], end: tuple[float, float], color: Any, width: float
) -> None:
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
    top = ax.get_ylim()[1]
    given = ", ".join(map(_symbol, _given(model)))
    _write(
        ax, (EDGE, top), -0.7, type(model).__name__, rcParams["text.color"], "left", weight="bold"
    )
    _write(ax, (EDGE, top), -1.8, f"given {given}", BLUE, "left")
    _write(ax, (END, top), -1.8, f"output {_symbol(model.output_name)}", VERMILLION, "right")


def _names(
    ax: Axes,
    ink: Any,
    roles: Mapping[str, Any],
    numbers: Mapping[str, Any],
    noise: Mapping[str, Any],
    down: float,
) -> None:
    """Symbols of masses, springs, dampers and displacements, with their numbers if there are
    any."""
    for index, x, middle in (("w", W, MIDDLE_W), ("z", Z, MIDDLE_Z)):
        for channel, side in ((f"K_{index}", 1), (f"C_{index}", -1)):
            known = _in_words(f"{channel}0", numbers)
            lines = [
                f"{_symbol(channel + '0' * bool(known))}  {known}".rstrip(),
                *noise.get(channel, ()),
            ]
            for i, line in enumerate(lines[::-side]):
                first = line is lines[0]
                color = GREY if OPEN in line or not first else ink
                _write(
                    ax,
                    (middle, side * TALL),
                    side * (i + 0.7),
                    line,
                    color,
                    size=SIZE if first else SMALL,
                )
        mass = _in_words(f"m_{index}", numbers)
        _write(ax, (x, 0.0), 0.55 * bool(mass), _symbol(f"m_{index}"), ink)
        for i, line in enumerate(mass.split(" ", 1) if len(mass) > 7 else [mass]):
            _write(ax, (x, 0.0), -0.55 - i, line, GREY if OPEN in mass else ink, size=SMALL)
        _write(
            ax, (x - 9.5, down), 0.0, _symbol(f"x_{index}"), roles.get(f"x_{index}", ink), "right"
        )
        if numbers:
            _write(
                ax,
                (middle, TALL),
                2.8,
                {"w": "active tissue", "z": "passive tissue"}[index],
                GREY,
                size=SMALL,
            )


def _forces(ax: Axes, ink: Any, roles: Mapping[str, Any], numbers: Mapping[str, Any]) -> None:
    """P_w and F_ext beside their arrows; the mean of F_ext where a fit knows it."""
    drive = re.sub(r"(?<= )1\b", "× mean", _in_words("P_w", numbers))  # per newton of mean force
    _write(ax, (MIDDLE_W, 0.0), 0.6, f"{_symbol('P_w')}  {drive}".rstrip(), roles.get("P_w", ink))
    outside = _in_words("F_ext", numbers) or _in_words("model_mean", numbers) * (
        roles.get("F_ext") == VERMILLION
    )
    where, color = ((Z + HALF + END - 2.6) / 2, 0.0), roles.get("F_ext", ink)
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
    at: tuple[float, float],
    rows: float,
    text: str,
    color: Any,
    ha: Any = "center",
    size: float = SIZE,
    **style: Any,
) -> None:
    """Text as many lines above a point."""
    ax.annotate(
        text,
        at,
        (0.0, rows * LINE),
        textcoords="offset points",
        color=color,
        ha=ha,
        va="center",
        size=size,
        **style,
    )
