"""The periodic perturbation of stiffness."""

import equinox as eqx
import jax.numpy as jnp

from ._law import Scalar
from ._parameter import default, require
from ._signal import AbstractSignal, Constant


class Harmonic(eqx.Module):
    """`S(t) = amplitude envelope(t) sin(2π frequency t + phase)`, a fraction of the base stiffness K_j0 of both tissues.

    **Arguments:** `amplitude` >= 0 (fraction of K_j0), `frequency` [Hz] > 0, `phase` [rad], `envelope` (a signal with
    at least one continuous derivative; constant 1 by default).

    **Raises:** `ValueError` for a negative amplitude or a frequency that is not positive.

    **Source:** the paper, S(t) in equation (2); the envelope is what it changes during the simulation of [12].
    """

    amplitude: Scalar = default("harmonic_amplitude")
    frequency: Scalar = default("harmonic_frequency")
    phase: Scalar = default("harmonic_phase")
    envelope: AbstractSignal = eqx.field(default_factory=lambda: Constant(1.0))

    def __check_init__(self):
        require(self.amplitude >= 0, f"harmonic_amplitude = {self.amplitude} must not be negative: shift the phase")
        require(self.frequency > 0, f"harmonic_frequency = {self.frequency} Hz must be positive")

    def __call__(self, t: Scalar) -> Scalar:
        """Relative change of stiffness at time t [s]."""
        return self.amplitude * self.envelope(t) * jnp.sin(2 * jnp.pi * self.frequency * t + self.phase)
