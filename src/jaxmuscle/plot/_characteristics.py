"""The figure of static characteristics."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from ._style import BLUE, GREEN, GREY, VERMILLION, styled


@styled
def static(curves: Any, ax: Any = None) -> tuple[Axes, Axes, Axes]:
    """Draws K(x), C(v) and force against displacement, in three axes (`ax`: three of yours). Returns the axes.

    **Raises:** `ValueError` unless `ax` has three.
    """
    axes: Any = plt.subplots(1, 3, figsize=(9.0, 3.0), layout="constrained")[1] if ax is None else ax
    if len(axes) != 3:
        raise ValueError(f"ax has {len(axes)} axes: give three, for K(x), C(v) and force against displacement")
    _coefficients(curves, axes[0], axes[1])
    _forces(curves, axes[2])
    return tuple(axes)


def _coefficients(curves: Any, stiffness: Axes, damping: Axes) -> None:
    x = 1e3 * curves.displacement
    for j, colour, tissue, width in (("w", BLUE, "active tissue", 3.0), ("z", VERMILLION, "passive tissue", 1.5)):
        slope = rf"d$F_\mathrm{{{j}}}$/d$x$ of its spring"
        stiffness.plot(x, getattr(curves, f"K_{j}"), color=colour, lw=width, label=rf"$K_\mathrm{{{j}}}$, {tissue}")
        stiffness.plot(x, getattr(curves, f"K_{j}_tangent"), color=colour, lw=0.7 * width, ls="--", label=slope)
        damping.plot(
            curves.velocity, getattr(curves, f"C_{j}"), color=colour, lw=width, label=rf"$C_\mathrm{{{j}}}$, {tissue}"
        )
        place = getattr(curves, f"x_{j}")
        if np.isfinite(place):
            stiffness.axvline(1e3 * place, color=colour, lw=0.8, ls=":", label=rf"$x_\mathrm{{{j}}}$ of the task", zorder=1)
    _finish(stiffness, "Displacement (mm)", "Stiffness (N/m)", room=0.75)
    _finish(damping, "Velocity (m/s)", "Damping (N s/m)", room=0.35)


def _forces(curves: Any, ax: Axes) -> None:
    x = 1e3 * curves.displacement
    ax.plot(x, curves.F_w, color=BLUE, lw=3.0, label="spring of the active tissue")
    ax.plot(x, curves.F_z, color=VERMILLION, label="spring of the passive tissue")
    ax.plot(x, curves.F_ext, color=GREY, label=r"$F_\mathrm{ext}$ held at $x$, $P_\mathrm{w}$ = 0")
    if np.isfinite(curves.P_w) and curves.P_w != 0:
        label = rf"$F_\mathrm{{ext}}$ held at $x$, $P_\mathrm{{w}}$ = {curves.P_w:.3g} N"
        ax.plot(x, curves.F_ext_active, color=GREEN, label=label)
    _finish(ax, "Displacement (mm)", "Force (N)", room=0.6)


def _finish(ax: Axes, across: str, up: str, *, room: float) -> None:
    """Labels, and a legend above the curves in `room` times their height."""
    low, high = ax.get_ylim()
    low = min(low, 0.0)
    ax.set_ylim(low, high + room * (high - low))
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.legend(loc="upper center", fontsize=6.5)
