"""Activation: what the active tissue makes of the nervous drive, a critically damped twitch."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import Inexact, require
from jaxmuscle._common.cards import Spelled
from jaxmuscle._common.quadrature import NODES, WEIGHTS
from jaxmuscle._common.types import Scalar

from ._parameters import default

ACTIVE = (0, 2, 4)  # K_w, C_w and P_w among the inputs: those of the active tissue


class Transition(NamedTuple):
    """Coefficients of a step of an activation; x is the step over the contraction time."""

    x: Array
    fade: Array
    early: Array
    late: Array
    early_slope: Array
    late_slope: Array

    def advance(self, state: tuple[Array, Array], n: Array, m: Array) -> tuple[Array, Array]:
        """States (a, b) after a step in which the input runs from n to m."""
        (a, b), x = state, self.x
        return (
            self.fade * ((1 + x) * a + x * b) + self.early * n + self.late * m,
            self.fade * ((1 - x) * b - x * a) + self.early_slope * n + self.late_slope * m,
        )


class Activation(Spelled, Inexact):
    """`H_a(s) = 1 / (1 + s T)²`, impulse response `t/T² exp(-t/T)`: a twitch with the contraction
    time T.

    It stands between the nervous drive and the active tissue: perturbations of K_w, C_w and P_w,
    noise and harmonic alike, pass it; those of the passive tissue do not. Slow perturbations pass
    undiminished, H_a(0) = 1. The prescribed drive P_w(t) itself does not pass it.

    **Arguments:** `time` T [s] > 0. **Raises:** `ValueError` for others.
    """

    time: Scalar = default("activation_time")

    def __check_init__(self):
        require(
            self.time > 0,
            f"activation_time = {self.time} s must be positive: leave the activation out (None) for"
            " none",
        )

    def states(self) -> tuple[Float[Array, "2 2"], Float[Array, "2"]]:
        """Matrix and input vector of the states (a, T a'): `a' = b / T`, `b' = (n - a - 2 b) / T`,
        n what comes in."""
        rate = 1 / jnp.asarray(self.time)
        return rate * jnp.array([[0.0, 1.0], [-1.0, -2.0]]), jnp.stack([0 * rate, rate])

    def transition(self, dt: Scalar) -> "Transition":
        """What a step of dt [s] does to the states (a, b = T a'), exactly, where the input runs
        straight in it.

        Its `advance((a, b), n, m)` gives the states after a step in which the input runs from n to
        m.
        """
        x = jnp.asarray(dt / self.time, jnp.result_type(float))
        share = jnp.asarray(NODES, x.dtype)
        y = x * (1 - share)  # time left in the step
        weight = x * jnp.asarray(WEIGHTS, x.dtype) * jnp.exp(-y)
        late, late_slope = jnp.sum(weight * y * share), jnp.sum(weight * (1 - y) * share)
        early, early_slope = (
            jnp.sum(weight * y * (1 - share)),
            jnp.sum(weight * (1 - y) * (1 - share)),
        )
        return Transition(x, jnp.exp(-x), early, late, early_slope, late_slope)

    def check_step(self, dt: float) -> None:
        """Raise a `ValueError` if a grid of step dt [s] is too coarse."""
        require(
            dt <= 0.5 * self.time,
            f"dt = {dt} s is too coarse for activation_time = {self.time} s: use at most half"
            " of it",
        )
