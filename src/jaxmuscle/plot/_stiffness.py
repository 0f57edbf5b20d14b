"""Panels of a dynamic stiffness: gain and phase with their errors, a curve through them, and what
the curve misses."""

from typing import Any

import numpy as np
import scipy
from jaxtyping import Complex
from matplotlib.axes import Axes
from matplotlib.ticker import MultipleLocator

from ._style import BLUE, GREY, ORANGE, Style, ink, legend, log_axis, shade_deviations

Curve = tuple[str, Complex[np.ndarray, " bins"]]
POINTS: Style = {"fmt": "o", "ms": 2.8, "lw": 0.8, "zorder": 3}


def gain(
    ax: Axes, response: Any, curve: Curve | None = None, title: str = "Dynamic stiffness"
) -> None:
    """The gain with two standard errors either way, and the gain of a curve with its name, at the
    same frequencies.

    Points of which two standard errors are larger than the curve, where nothing moved the
    insertion, are left out.
    """
    f, known, shown = response.frequency, np.isfinite(response.stderr), _shown(response, curve)
    # a bar to 0 has no end on a logarithmic axis
    low = np.minimum(2 * response.stderr, 0.95 * response.gain)
    bars = np.where(known, [low, 2 * response.stderr], 0.0)
    ax.errorbar(
        f[shown], response.gain[shown], bars[:, shown], label="± 2 SE", color=ink(), **POINTS
    )
    if curve is not None:
        name, values = curve
        fine, smooth = _smooth(f, values)
        ax.plot(fine, np.abs(smooth), color=BLUE, lw=1.2, label=name, zorder=2)
    log_axis(ax, "y")
    log_axis(ax)
    ax.set_ylabel(f"Gain ({response.unit})")
    ax.set_title(title, parse_math=False)
    legend(ax, "above")


def phase(ax: Axes, response: Any, curve: Curve | None = None) -> None:
    """The phase with two standard errors either way, and that of a curve."""
    f, known, shown = response.frequency, np.isfinite(response.stderr), _shown(response, curve)
    bars = np.where(known, np.minimum(2 * response.phase_stderr, 180.0), 0.0)
    values = response.phase
    if curve is not None:
        fine, smooth = _smooth(f, curve[1])
        turned = np.degrees(np.unwrap(np.angle(smooth)))
        ax.plot(fine, turned, color=BLUE, lw=1.2, label=curve[0], zorder=2)
        # the turn nearest to the curve
        values = values + 360 * np.rint((np.interp(f, fine, turned) - values) / 360)
    ax.errorbar(f[shown], values[shown], bars[shown], label="± 2 SE", color=ink(), **POINTS)
    ax.axhline(0, color=GREY, lw=0.6)
    ax.set_ylabel("Phase (deg)")
    low, high = ax.get_ylim()
    ax.yaxis.set_major_locator(
        MultipleLocator(
            90 if high - low > 300 else 45 if high - low > 100 else 15 if high - low > 30 else 5
        )
    )
    log_axis(ax)


def stiffness_residuals(ax: Axes, part: Any) -> None:
    """Measured less fitted stiffness in standard errors, of the real and of the imaginary part."""
    f, off = part.target.stiffness.known.frequency, part.stiffness_residual
    shade_deviations(ax)
    for values, marker, colour, name in (
        (np.real(off), "o", BLUE, "real (spring, mass)"),
        (np.imag(off), "^", ORANGE, "imaginary (damping)"),
    ):
        ax.plot(f, values, color=colour, lw=0.6, marker=marker, ms=3.5, label=name, zorder=3)
    reach = 1.1 * float(np.max(np.abs([np.real(off), np.imag(off)]), initial=3.0))
    ax.axhline(0, color=ink(), lw=0.6, zorder=2)
    log_axis(ax)
    ax.set(xlabel="Frequency (Hz)", ylabel="Residual (SE)", ylim=(-reach, reach))
    ax.set_title("Stiffness")
    legend(ax, "above")


def _shown(response: Any, curve: Curve | None) -> np.ndarray:
    """Which points say something: those with two standard errors smaller than the curve, where
    there is one."""
    return (
        np.full(len(response.frequency), True)
        if curve is None
        else ~(2 * response.stderr > np.abs(curve[1]))
    )


def _smooth(f: np.ndarray, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """The values, and between them a curve without swings of its own."""
    if len(f) < 3:
        return f, values
    fine = np.unique(np.concatenate([f, np.geomspace(f[0], f[-1], 200)]))
    real, imaginary = (
        scipy.interpolate.PchipInterpolator(np.log(f), part(values))(np.log(fine))
        for part in (np.real, np.imag)
    )
    return fine, real + 1j * imaginary
