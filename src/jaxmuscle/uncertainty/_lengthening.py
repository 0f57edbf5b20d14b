"""A muscle lengthened by a motor, and what its response tells of the parameters."""

from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arguments import positive
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.programs import kept
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.objective._coordinates import Coordinates, task_at
from jaxmuscle.response._input_response import density_at, parts_of_stiffness
from jaxmuscle.response._linearised import linearise

EVEN = 1024  # lines are padded to multiples of it: few programs for any record
WHOLE = 1e-9
WORDS = "lengthening of {:.3g} mm rms, {:.2g} to {:.2g} Hz, for {:g} s"


Lines = Float[np.ndarray, " lines"]
Samples = Float[np.ndarray, " samples"]
# of displacement, speed and acceleration
Largest = Float[np.ndarray, "3"]


def lines_in(band: tuple[float, float], seconds: float) -> Lines:
    """Multiples of 1 / seconds [Hz] in a band, both ends included. Raises `ValueError` if there is
    none."""
    positive("seconds", seconds)
    low, high = band
    first, last = np.ceil(low * seconds - WHOLE), np.floor(high * seconds + WHOLE)
    if not (0 < first <= last):
        raise ValueError(
            f"band = ({low:g}, {high:g}) Hz must lie above 0 Hz, rise, and hold a multiple of 1 /"
            f" seconds = {1 / seconds:.3g} Hz"
        )
    return np.arange(first, last + 1) / seconds


class Lengthening(Printed, Result, eqx.Module):
    """A periodic lengthening of the muscle: `x(t) = Σ_k √(2 p_k) cos(2π f_k t + φ_k)`, recorded for
    one period.

    The phases φ_k may be any: what the record tells does not depend on them.

    **Arguments:**

    - `frequency` f_k [Hz] (lines,), multiples of 1 / `seconds`
    - `power` p_k, the mean square of each line [m²] (lines,)
    - `seconds`: how long it is recorded. `Lengthening.flat(rms, band, seconds)` makes one of equal
      lines
    """

    frequency: Lines
    power: Lines
    seconds: float = eqx.field(static=True)

    @classmethod
    def flat(cls, rms: float, band: tuple[float, float], seconds: float = 60.0) -> "Lengthening":
        """Of `rms` [m], the same density at all frequencies of a `band` [Hz]. Raises `ValueError`
        for an impossible one."""
        positive("rms", rms)
        lines = lines_in(band, seconds)
        return cls(lines, np.full(len(lines), rms**2 / len(lines)), seconds)

    def of_motion(self, displacement: Samples) -> "Lengthening":
        """One of the same frequencies, with the power of `displacement` [m], one period of a
        motion, at each of them."""
        places = np.rint(self.frequency * self.seconds).astype(int)
        power = 2 * np.abs(np.fft.rfft(displacement)[places] / len(displacement)) ** 2
        return Lengthening(self.frequency, power, self.seconds)

    @property
    def rms(self) -> float:
        """Root of the mean square [m]."""
        return float(np.sqrt(np.sum(self.power)))

    def __str__(self) -> str:
        moved = self.frequency[self.power > 0]
        return WORDS.format(1e3 * self.rms, moved[0], moved[-1], self.seconds)

    def information(
        self, task: PrescribedLength, coordinates: Coordinates, theta: Float[np.ndarray, " own"]
    ) -> Float[np.ndarray, "own own"]:
        """Fisher information of the parameters in the response of the force.

        For the package itself: `coordinates` and `theta` are those of the problem of a fit.
        """
        return np.tensordot(self.power, self.by_line(task, coordinates, theta), 1)

    def by_line(
        self, task: PrescribedLength, coordinates: Coordinates, theta: Float[np.ndarray, " own"]
    ) -> Float[np.ndarray, "lines own own"]:
        """For the package itself: the information of θ per mean square [1/m²] of each line, where
        the task is that at θ.

            A_k = 2 T Re(∂H_k* ∂H_kᵀ) / S(f_k)

        H is the `dynamic_stiffness`, S the one-sided `noise_density` of the force. For a line `a
        cos(2π f t)`, of mean square p = a²/2, changes the ordinate of the force by ∂H a/2, while
        real and imaginary part of the noise there have the variance S / (4T) each.
        """
        f = self.frequency
        padded = np.resize(f, -(-len(f) // EVEN) * EVEN)
        slopes, density = jax.tree.map(
            np.asarray, _sensed(as_arrays(task), as_arrays(coordinates), theta, padded)
        )
        slopes, density = slopes[:, : len(f)], density[: len(f), None, None]
        return 2 * self.seconds * np.einsum("pki,pkj->kij", slopes, slopes) / density


@kept
def _sensed(
    task: Any, coordinates: Any, theta: Any, f: Any
) -> tuple[Float[Array, "2 lines own"], Float[Array, " lines"]]:
    """Slopes of real and imaginary part of the dynamic stiffness, and the density of the noise."""

    def parts(theta):
        moved = task_at(task, coordinates, theta)
        return parts_of_stiffness(moved, linearise(moved), f)

    there = task_at(task, coordinates, theta)
    return jax.jacfwd(parts)(theta), density_at(there, linearise(there), f)
