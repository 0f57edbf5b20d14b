"""Two tissues in series fitted to a dynamic stiffness, as a start of a search: first a spring, a
damper and a mass, then two of each."""

import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxmuscle.data._frequency_response import FrequencyResponse
from jaxmuscle.data._second_order import parts
from jaxmuscle.model._muscle import Muscle
from jaxmuscle.model._tasks import AbstractTask

from ._problem import Part

NAMES = ("m_w", "m_z", "K_w", "K_z", "C_w", "C_z")
TRIES, SPREAD, STEPS = 24, 1.2, 100  # standard deviation of the starts in the logarithm


def in_series(
    s: Complex[np.ndarray, " frequencies"], parameters: Float[np.ndarray, "6"]
) -> Complex[np.ndarray, " frequencies"]:
    """`H = m_z s² + Z - Z² / (m_w s² + C_w s + K_w + Z)`, Z = C_z s + K_z, s = 2πif; parameters as
    in `NAMES`."""
    m_w, m_z, k_w, k_z, c_w, c_z = parameters
    outer = c_z * s + k_z
    return m_z * s**2 + outer - outer**2 / (m_w * s**2 + c_w * s + k_w + outer)


def two_tissues(response: FrequencyResponse) -> dict[str, float]:
    """The values of `NAMES` that fit a response best, of searches that begin about its spring,
    damper and mass."""
    one = response.known
    s, error = 2j * np.pi * one.frequency, np.tile(one.stderr, 2)
    k, i = one.spring_and_mass
    b = np.sqrt(k * i)
    centre = np.log([i, i, 2 * k, 2 * k, 2 * b, b])

    def residuals(logs: Float[np.ndarray, "6"]) -> Float[np.ndarray, " twice"]:
        return parts(in_series(s, np.exp(logs)) - one.value) / error

    starts = SPREAD * np.random.default_rng(0).standard_normal((TRIES, len(NAMES)))
    reach = 6 * SPREAD
    found = [
        scipy.optimize.least_squares(
            residuals, centre + away, bounds=(centre - reach, centre + reach), max_nfev=STEPS
        )
        for away in np.clip(starts, -3 * SPREAD, 3 * SPREAD)
    ]
    best = min(found, key=lambda one: one.cost)
    return dict(zip(NAMES, np.exp(best.x).tolist(), strict=True))


def muscle_in_series(part: Part, task: AbstractTask) -> dict[str, float]:
    """The muscle of a task with these values about the hold; nothing without a response, and of an
    own muscle.

    The active tissue has shortened by x_w = F / K_z there, F being the mean force.
    """
    if part.target.stiffness is None or not isinstance(task.muscle, Muscle):
        return {}
    found = two_tissues(part.target.stiffness)
    force = (part.target.mean_force or (0.0, 0.0))[0]
    squares = {end: float(task[f"x_ref_{end}"]) ** 2 for end in "wz"}
    squares["w"] += 3 * (force / found["K_z"]) ** 2
    slow = {end: float(task[f"v_ref_{end}"]) ** 2 for end in "wz"}
    if not all(squares.values()) or not all(slow.values()):
        return {}
    return {
        **{name: found[name] for name in ("m_w", "m_z")},
        **{f"k_{end}": found[f"K_{end}"] / squares[end] for end in "wz"},
        **{f"c_{end}": found[f"C_{end}"] / slow[end] for end in "wz"},
    }
