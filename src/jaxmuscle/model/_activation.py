"""Activation: what the active tissue makes of the nervous drive, a critically damped twitch."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import require
from jaxmuscle._common.quadrature import NODES, WEIGHTS
from jaxmuscle._common.types import Scalar

from ._parameters import default

ACTIVE = (0, 2, 4)  # K_w, C_w and P_w among the inputs: those of the active tissue


class Activation(eqx.Module):
    """`H_a(s) = 1 / (1 + s T)²`, impulse response `t/T² exp(-t/T)`: a twitch with the contraction time T.

    It stands between the nervous drive and the active tissue: perturbations of K_w, C_w and P_w, noise and harmonic alike,
    pass it; those of the passive tissue do not. The mean passes unchanged, H_a(0) = 1.

    **Arguments:** `time` T [s] > 0. **Raises:** `ValueError` for others.
    """

    time: Scalar = default("activation_time")

    def __check_init__(self):
        require(self.time > 0, f"activation_time = {self.time} s must be positive: leave the activation out (None) for none")

    def states(self) -> tuple[Float[Array, "2 2"], Float[Array, "2"]]:
        """Matrix and input vector of the states (a, T a'): `a' = b / T`, `b' = (n - a - 2 b) / T`, n what comes in."""
        rate = 1 / jnp.asarray(self.time)
        return rate * jnp.array([[0.0, 1.0], [-1.0, -2.0]]), jnp.stack([0 * rate, rate])

    def through(
        self, before: Float[Array, "steps inputs"], after: Float[Array, "steps inputs"], dt: Scalar
    ) -> tuple[Float[Array, "points inputs"], Float[Array, "points inputs"]]:
        """Values and slopes of what comes out, from rest; what goes in runs straight from `before` to `after` in a step."""
        x = jnp.asarray(dt / self.time, before.dtype)
        fade = jnp.exp(-x)
        share = jnp.asarray(NODES, x.dtype)
        y = x * (1 - share)  # time left in the step
        weight = x * jnp.asarray(WEIGHTS, x.dtype) * jnp.exp(-y)
        late, late_slope = jnp.sum(weight * y * share), jnp.sum(weight * (1 - y) * share)
        early, early_slope = jnp.sum(weight * y * (1 - share)), jnp.sum(weight * (1 - y) * (1 - share))

        def advance(state, given):
            (a, b), (n, m) = state, given
            new = (
                fade * ((1 + x) * a + x * b) + early * n + late * m,
                fade * ((1 - x) * b - x * a) + early_slope * n + late_slope * m,
            )
            return new, new

        rest = jnp.zeros(before.shape[1:], before.dtype)
        _, (a, b) = jax.lax.scan(advance, (rest, rest), (before, after))
        a, b = (jnp.concatenate([rest[None], values]) for values in (a, b))
        return a, b / self.time

    def check_step(self, dt: float) -> None:
        """Raise a `ValueError` if a grid of step dt [s] is too coarse."""
        require(
            dt <= 0.5 * self.time, f"dt = {dt} s is too coarse for activation_time = {self.time} s: use at most half of it"
        )
