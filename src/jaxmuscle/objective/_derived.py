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

TANGENTS = ("K_w_tangent", "tangent_stiffness", "B0")
# of the dynamic stiffness, in the thirds of the band that was moved
GAINS = ("gain_low", "gain_middle", "gain_high")
PHASES = ("phase_low", "phase_middle", "phase_high")
# what holds of a moved limb whatever its tissues are, and what if there are two in series and
# nothing beside them
LIMB = ("tangent_stiffness", "B0", "m_z", *GAINS, *PHASES)
TISSUES = ("K_w_tangent", "K_z0", "C_w0", "C_z0")
SPLIT = (*TISSUES, "K_w0", "k_w", "k_z", "c_w", "c_z")  # the same by all its names
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
    *GAINS,
    *PHASES,
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
    "B0": "N s/m",
    **dict.fromkeys(GAINS, "N/m"),
    **dict.fromkeys(PHASES, "deg"),
}


SEEN = 5.0  # standard errors: by chance a point is larger in four of a million cases
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
    "tangent_stiffness": "stiffness of the limb when pulled slowly, H(0)",
    "B0": "damping of the limb when pulled slowly, Im H / 2πf for f -> 0, without a reflex",
    **{
        f"{what}_{third}": f"{what} of the dynamic stiffness in the {words} third of the band"
        for what in ("gain", "phase")
        for third, words in (("low", "lowest"), ("middle", "middle"), ("high", "highest"))
    },
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


def derived_names(task: Any, spectrum: bool = True, response: bool = False) -> tuple[str, ...]:
    """The derived quantities that a task has; without a spectrum among the data those of the muscle
    alone, with a dynamic stiffness also its gain and phase."""
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
    missing |= set() if response else {*GAINS, *PHASES}
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
    """Stiffness of the active tissue [N/m] where the mean force stretches it, stiffness [N/m] and
    damping [N s/m] of both tissues, slowly pulled.

        K_w_tangent = d(K_w x_w)/dx_w = k_w (x_ref² + 3 x_w²),   x_w = x_z + mean / K_z(x_z)
        H(s) = (a + C_z s) (T + C_w s) / (T + K_z + (C_w + C_z) s) + O(s²),   T = K_w_tangent
        tangent_stiffness = H(0) = a T / (T + K_z),   a = K_z(x_z) + 2 k_z x_z (x_z - x_w)
        B0 = H'(0) = (C_z T (T + K_z - a) + C_w a K_z) / (T + K_z)²

    At x_z = 0 is a = K_z, and B0 = (C_z T² + C_w K_z²) / (T + K_z)².
    """
    x_z = task.x_z(jnp.asarray(HOLD)) if isinstance(task.x_z, AbstractSignal) else task.x_z
    k_w, k_z, x_ref_w, x_ref_z = (task[name] for name in ("k_w", "k_z", "x_ref_w", "x_ref_z"))
    passive = k_z * (x_ref_z**2 + x_z**2)
    x_w = x_z + mean / passive
    active = k_w * (x_ref_w**2 + 3 * x_w**2)
    slope, both = passive + 2 * k_z * x_z * (x_z - x_w), active + passive
    C_w, C_z = (task[f"c_{j}"] * task[f"v_ref_{j}"] ** 2 for j in "wz")
    damping = (C_z * active * (both - slope) + C_w * slope * passive) / both**2
    return {
        "K_w_tangent": active,
        "tangent_stiffness": slope * active / both,
        "B0": damping,
    }


def seen_band(frequency: np.ndarray, value: np.ndarray, stderr: np.ndarray) -> np.ndarray:
    """The band that was moved: the first and the last frequency of a measured dynamic stiffness at
    which it is more than `SEEN` standard errors large; those of all where none is."""
    seen = np.flatnonzero(np.abs(value) > SEEN * stderr)
    return frequency[seen[[0, -1]] if len(seen) else [0, -1]]


def thirds(frequency: np.ndarray, value: np.ndarray, stderr: np.ndarray) -> np.ndarray:
    """Which points of a measured dynamic stiffness stand for the thirds of the band that was moved:
    those nearest to their middles, on a log scale."""
    low, high = np.log(seen_band(frequency, value, stderr))
    middles = low + (high - low) * np.array([1, 3, 5]) / 6
    return np.argmin(np.abs(np.log(frequency)[:, None] - middles), axis=0)


def of_response(
    stiffness: Float[np.ndarray, "rows 2 points"],
    slopes: Float[np.ndarray, "rows 2 points own"],
    measured: Float[np.ndarray, "2 points"],
    at: np.ndarray,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Gain [N/m] and phase [deg] of a dynamic stiffness at three points, and their slopes. A phase
    is within half a turn of the measured one, so that it does not jump."""
    H, dH = (np.asarray(x)[:, 0] + 1j * np.asarray(x)[:, 1] for x in (stiffness, slopes))
    seen = measured[0] + 1j * measured[1]
    found, along = {}, {}
    for gain, phase, k in zip(GAINS, PHASES, at, strict=True):
        h, dh, turn = H[:, k], dH[:, k], seen[k] / np.abs(seen[k])
        relative = dh / h[:, None]
        found[gain], along[gain] = np.abs(h), np.abs(h)[:, None] * relative.real
        found[phase] = np.degrees(np.angle(h / turn) + np.angle(turn))
        along[phase] = np.degrees(relative.imag)
    return found, along


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
