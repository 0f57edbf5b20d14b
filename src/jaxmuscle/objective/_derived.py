"""Quantities that follow from a task and its moments: what reports state beside the free
parameters."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.types import Scalar
from jaxmuscle.model._muscle import Muscle
from jaxmuscle.model._parameters import BASE, PARAMETERS
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._signals import AbstractSignal
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.response._equilibrium import HOLD, slowest
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._mechanics import Operating
from jaxmuscle.response._transfer import half_power_frequency
from jaxmuscle.spectra._fluctuations import BANDS, EDGES, in_bands

TANGENTS = ("K_w_tangent", "tangent_stiffness")
MEAN, VARIATION = "model_mean", "model_coefficient_of_variation"
DERIVED = (
    "corner_frequency",
    "half_power_frequency",
    "contraction_time",
    "resonance_frequency",
    "resonance_width",
    "resonance_share",
    "resonance_2_share",
    "harmonic_share",
    "harmonic_frequency",
    "K_w0",
    "K_z0",
    "C_w0",
    "C_z0",
    *TANGENTS,
    VARIATION,
    MEAN,
    *BANDS,
)
UNITS = {
    "corner_frequency": "Hz",
    "half_power_frequency": "Hz",
    "contraction_time": "s",
    "resonance_frequency": "Hz",
    "resonance_width": "Hz",
    "harmonic_frequency": "Hz",
    "K_w0": "N/m",
    "K_z0": "N/m",
    "C_w0": "N s/m",
    "C_z0": "N s/m",
    "K_w_tangent": "N/m",
    "tangent_stiffness": "N/m",
}


MEANINGS = {
    "corner_frequency": "where the slow response of the muscle falls off",
    "half_power_frequency": "where muscle and activation together let half the power through",
    "contraction_time": "contraction time of a twitch",
    "resonance_frequency": "frequency of the resonance in the drive, before the muscle smooths it",
    "resonance_width": "full width of the resonance at half power",
    "resonance_share": "the resonance's share of the power, counted from half its frequency on",
    "resonance_2_share": (
        "the second resonance's share of the power, counted from half its frequency on"
    ),
    "harmonic_share": "the harmonic's share of the power",
    "K_w0": "active stiffness without stretch",
    "K_z0": "passive stiffness without stretch",
    "C_w0": "active damping when nothing moves",
    "C_z0": "passive damping when nothing moves",
    "K_w_tangent": "active stiffness as displaced in the hold",
    "tangent_stiffness": "stiffness of both tissues in series, H(0)",
    VARIATION: "standard deviation over mean of the model's output",
    MEAN: "mean of the model's output",
    **{
        name: f"share of the power from {low:g} to {high:g} Hz"
        for name, (low, high) in BANDS.items()
    },
}


OF_SPECTRUM = {
    "harmonic_share",
    "harmonic_frequency",
    "resonance_frequency",
    "resonance_width",
    "resonance_share",
    "resonance_2_share",
    VARIATION,
    MEAN,
    *BANDS,
}


def derived_names(task: Any, spectrum: bool = True) -> tuple[str, ...]:
    """The derived quantities that a task has; without a spectrum among the data those of the muscle
    alone."""
    frequency, resonances = (
        task.settings.frequency,
        sum(isinstance(n, ResonantNoise) for n in task.noise.components),
    )
    covered = (
        np.sum(in_bands(frequency, task.settings.resolution), axis=1) * task.settings.resolution
    )
    bands = {
        name
        for name, there, width in zip(BANDS, covered, np.diff(EDGES), strict=True)
        if there >= 0.5 * width
    }
    missing = set(BANDS) - bands | (set() if spectrum else OF_SPECTRUM)
    missing |= set() if task.activation is not None else {"contraction_time"}
    missing |= set() if has_tangents(task) else {*TANGENTS}
    missing |= (
        {"resonance_frequency", "resonance_width", "resonance_share"} if resonances < 1 else set()
    )
    missing |= {"resonance_2_share"} if resonances < 2 else set()
    # About a mean of zero, and where the response begins with f².
    missing |= (
        {VARIATION, MEAN, "half_power_frequency"} if task.quantity == "acceleration" else set()
    )
    return tuple(name for name in DERIVED if name not in missing)


def has_tangents(task: Any) -> bool:
    """Whether a motor moves the insertion of the paper's muscle."""
    return type(task) is PrescribedLength and type(task.muscle) is Muscle


def tangents(task: Any, mean: Float[Array, ""]) -> dict[str, Float[Array, ""]]:
    """Stiffness of the active tissue [N/m] where the mean force stretches it, and of both tissues,
    slowly pulled.

    K_w_tangent = d(K_w x_w)/dx_w = k_w (x_ref² + 3 x_w²),   x_w = x_z + mean / K_z(x_z)
    tangent_stiffness = H(0) = a T / (T + K_z(x_z)),   T = K_w_tangent,   a = K_z(x_z) + 2 k_z x_z
    (x_z - x_w)
    """
    x_z = task.x_z(jnp.asarray(HOLD)) if isinstance(task.x_z, AbstractSignal) else task.x_z
    k_w, k_z, x_ref_w, x_ref_z = (task[name] for name in ("k_w", "k_z", "x_ref_w", "x_ref_z"))
    passive = k_z * (x_ref_z**2 + x_z**2)
    x_w = x_z + mean / passive
    active = k_w * (x_ref_w**2 + 3 * x_w**2)
    slope = passive + 2 * k_z * x_z * (x_z - x_w)
    return {"K_w_tangent": active, "tangent_stiffness": slope * active / (active + passive)}


def of_muscle(
    point: Operating, time: Scalar, moved: Any = None, scale: Scalar = 1.0
) -> dict[str, Float[Array, ""]]:
    """What follows from the operating point, the contraction time T of the activation (0: none),
    the task if its insertion is `moved`, and what its mean is multiplied by: `corner_frequency`
    |λ_slow|/2π of the operating point; `half_power_frequency` of the slow part, relaxation and
    activation together; the base coefficients; where the insertion is moved `tangents`."""
    found = dict(zip(BASE, point.base, strict=True))
    found["corner_frequency"] = slowest(point.system.A) / (2 * jnp.pi)
    found["half_power_frequency"] = half_power_frequency(point.system, point.base[0], time)
    return found | ({} if moved is None else tangents(moved, point.system.rest * scale))


def of_spectrum(
    moments: Moments,
    frequency: Float[Array | np.ndarray, " bins"],
    resolution: Scalar,
    peaks: Float[Array, " resonances"],
) -> dict[str, Float[Array, ""]]:
    """What follows from moments at the compared bins.

    `resonance_share` of the compared power, and `resonance_2_share` of a second one, `peaks` their
    frequencies, both from half the resonance's frequency on (what activation and muscle let through
    below is no peak and can hardly be told from the rest); `harmonic_share` of the compared power;
    `model_coefficient_of_variation` and `model_mean` of the output; `band_4_8` and so on, the
    proportional power from 4 to 8 Hz, of bins at the edges the part that lies inside.
    """
    at, whole = jnp.asarray(frequency, moments.power.dtype), moments.power.sum()
    names = ("resonance_share", "resonance_2_share")
    found = {
        name: jnp.sum(jnp.where(at >= 0.5 * peak, own, 0.0)) / whole
        for name, peak, own in zip(names, peaks, moments.resonant, strict=False)
    }
    found |= dict(zip(BANDS, in_bands(at, resolution) @ (moments.power / whole), strict=True))
    return found | observed(moments)


def observed(moments: Moments) -> dict[str, Any]:
    """Those derived quantities that follow from simulated moments."""
    return {
        "harmonic_share": moments.line.sum() / moments.power.sum(),
        VARIATION: moments.variation,
        MEAN: moments.mean,
    }


def jackknife(each: Moments) -> dict[str, float]:
    """Standard errors of the observed quantities from the moments of every seed."""
    count = len(each.mean)
    if count < 2:
        return {}
    left_out = [
        observed(jax.tree.map(lambda x, i=i: (x.sum(axis=0) - x[i]) / (count - 1), each))
        for i in range(count)
    ]
    return {
        name: float(np.std([o[name] for o in left_out]) * np.sqrt(count - 1))
        for name in left_out[0]
    }


def unit_of(name: str, output: str = "") -> str:
    """Unit of a parameter or derived quantity, "name@target" too; `output` is that of the task's
    output."""
    base = name.partition("@")[0]
    if base == MEAN:
        return output
    if base in DERIVED:
        return UNITS.get(base, "1")
    return PARAMETERS[base].unit if base in PARAMETERS else ""
