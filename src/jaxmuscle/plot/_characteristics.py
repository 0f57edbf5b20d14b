"""The figure of static characteristics."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._style import BLUE, COLUMN, GREEN, GREY, VERMILLION, canvas, fitted_to, key, styled

HEIGHTS = 1.7, 1.7  # inches
TISSUES = (("w", BLUE, "active tissue", 3.0), ("z", VERMILLION, "passive tissue", 1.5))


@styled
def static(curves: Any, ax: Any = None) -> tuple[Axes, Axes, Axes]:
    """Draws K(x), C(v) and force against displacement, in three axes (`ax`: three of yours).
    Returns the axes.

    `curves` are the `StaticCharacteristics` that `jaxmuscle.static_characteristics(task)` returns.

    Thick lines are the active tissue, thin ones the passive; dashed is the slope of the force of a
    spring, dotted the operating point. In a figure of its own one legend names all lines, and
    letters are legible in a column of 85 mm.

    **Raises:** `ValueError` unless `ax` has three.
    """
    if ax is not None and len(ax) != 3:
        raise ValueError(
            f"ax has {len(ax)} axes: give three, for K(x), C(v) and force against displacement"
        )
    stiffness, damping, force = _places(canvas(None, (COLUMN, sum(HEIGHTS)))) if ax is None else ax
    _coefficients(curves, stiffness, damping)
    _forces(curves, force)
    if ax is None:
        fitted_to(force.figure, sum(HEIGHTS), key(force.figure))
    else:
        for panel in (stiffness, damping, force):
            panel.legend(loc="best")
    return stiffness, damping, force


def _places(fig: Any) -> tuple[Axes, ...]:
    """Both coefficients beside each other, the forces below."""
    grid = fig.add_gridspec(2, 2, height_ratios=HEIGHTS)
    return tuple(fig.add_subplot(grid[place]) for place in ((0, 0), (0, 1), (1, slice(None))))


def _coefficients(curves: Any, stiffness: Axes, damping: Axes) -> None:
    x = 1e3 * curves.displacement
    for j, colour, tissue, width in TISSUES:
        stiffness.plot(x, getattr(curves, f"K_{j}"), color=colour, lw=width, label=tissue)
        slope = rf"slope of its spring, d$F_\mathrm{{{j}}}$/d$x$"
        stiffness.plot(
            x, getattr(curves, f"K_{j}_tangent"), color=colour, lw=0.7 * width, ls="--", label=slope
        )
        damping.plot(
            curves.velocity, getattr(curves, f"C_{j}"), color=colour, lw=width, label=tissue
        )
        place = getattr(curves, f"x_{j}")
        if np.isfinite(place):
            stiffness.axvline(
                1e3 * place,
                color=colour,
                lw=0.8,
                ls=":",
                label=rf"$x_\mathrm{{{j}}}$ of the task",
                zorder=1,
            )
    for panel in (stiffness, damping):
        panel.set_ylim(bottom=min(panel.get_ylim()[0], 0.0), auto=None)
    stiffness.set(title="Stiffness K(x)", xlabel="Displacement (mm)", ylabel="Stiffness (N/m)")
    damping.set(title="Damping C(v)", xlabel="Velocity (m/s)", ylabel="Damping (N s/m)")


def _forces(curves: Any, ax: Axes) -> None:
    x = 1e3 * curves.displacement
    for j, colour, tissue, width in TISSUES:
        ax.plot(x, getattr(curves, f"F_{j}"), color=colour, lw=width, label=tissue)
    ax.plot(x, curves.F_ext, color=GREY, label=r"$F_\mathrm{ext}$ held at $x$, $P_\mathrm{w}$ = 0")
    if np.isfinite(curves.P_w) and curves.P_w != 0:
        label = rf"$F_\mathrm{{ext}}$ held at $x$, $P_\mathrm{{w}}$ = {curves.P_w:.3g} N"
        ax.plot(x, curves.F_ext_active, color=GREEN, label=label)
    ax.set(title="Forces against displacement", xlabel="Displacement (mm)", ylabel="Force (N)")
