"""The figure of static characteristics."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from ._style import BLUE, GREEN, GREY, VERMILLION, finish, panels, styled

HEIGHTS = 1.7, 1.7  # inches
TISSUES = (("w", BLUE, "active tissue", 3.0), ("z", VERMILLION, "passive tissue", 1.5))
OF_TISSUE = "K_{}", "K_{}_tangent", "C_{}", "x_{}"


@styled
def static(curves: Any, ax: Any = None) -> tuple[Axes, Axes, Axes]:
    """Draws K(x), C(v) and force against displacement, in three axes (`ax`: three of yours).
    Returns the axes.

    `curves` are the `StaticCharacteristics` that `jaxmuscle.response.static_characteristics(task)`
    returns.

    Thick lines are the active tissue, thin ones the passive; dashed is the slope of the force of a
    spring, dotted the operating point. In a figure of its own one legend names all lines, and
    letters are legible in a column of 85 mm.

    **Raises:** `ValueError` unless `ax` has three.
    """
    if ax is not None and len(ax) != 3:
        raise ValueError(
            f"ax has {len(ax)} axes: give three, for K(x), C(v) and force against displacement"
        )
    figure, axes = (None, ax) if ax is not None else panels(None, "AB;CC", HEIGHTS)
    stiffness, damping, force = axes
    _coefficients(curves, stiffness, damping)
    _forces(curves, force)
    if figure is None:
        for panel in axes:
            panel.legend(loc="best")
    else:
        finish(figure, HEIGHTS)
    return stiffness, damping, force


def _coefficients(curves: Any, stiffness: Axes, damping: Axes) -> None:
    x = 1e3 * curves.displacement
    for j, colour, tissue, width in TISSUES:
        K, tangent, C, place = (getattr(curves, name.format(j)) for name in OF_TISSUE)
        stiffness.plot(x, K, color=colour, lw=width, label=tissue)
        slope = rf"slope of its spring, d$F_\mathrm{{{j}}}$/d$x$"
        stiffness.plot(x, tangent, color=colour, lw=0.7 * width, ls="--", label=slope)
        damping.plot(curves.velocity, C, color=colour, lw=width, label=tissue)
        if np.isfinite(place):
            label = rf"$x_\mathrm{{{j}}}$ of the task"
            stiffness.axvline(1e3 * place, color=colour, lw=0.8, ls=":", label=label, zorder=1)
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
