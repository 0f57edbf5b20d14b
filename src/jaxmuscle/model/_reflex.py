"""A stretch reflex: the active tissue pulls harder, late, where the insertion is moved fast."""

import jax.numpy as jnp
from jaxtyping import Array, Complex

from jaxmuscle._common.arrays import Inexact, require
from jaxmuscle._common.cards import Spelled
from jaxmuscle._common.types import Scalar

from ._parameters import default


class Reflex(Spelled, Inexact):
    """A linear velocity reflex, `R(s) = gain s e^(-s delay) / (1 + s time)²`.

    A spindle senses how fast the insertion is moved, `s l` (l, the lengthening). After the `delay`
    of nerves and synapses the active tissue pulls harder, as slowly as a twitch allows (impulse
    response `t/time² exp(-t/time)`). R is the force on the active tissue [N] per lengthening [m].
    In a hold nothing is sensed. A reflex of length cannot be told from stiffness and is left to it.

    **Arguments:** `gain` [N s/m] >= 0, `delay` [s] >= 0, `time` [s] > 0, the contraction time.

    **Raises:** `ValueError` for others.

    **Source:** Kearney, Stein & Parameswaran 1997, IEEE Trans Biomed Eng 44(6):493-504.
    """

    gain: Scalar = default("reflex_gain")
    delay: Scalar = default("reflex_delay")
    time: Scalar = default("reflex_time")

    def __check_init__(self):
        require(self.gain >= 0, f"reflex_gain = {self.gain} N s/m must not be negative")
        require(self.delay >= 0, f"reflex_delay = {self.delay} s must not be negative")
        require(
            self.time > 0,
            f"reflex_time = {self.time} s must be positive: a muscle does not answer at once",
        )

    def transfer(self, s: Complex[Array, " frequencies"]) -> Complex[Array, " frequencies"]:
        """R(s) [N/m] at these s [1/s]."""
        gain, delay, time = (
            jnp.asarray(x).astype(s.dtype) for x in (self.gain, self.delay, self.time)
        )
        return gain * s * jnp.exp(-s * delay) / (1 + s * time) ** 2
