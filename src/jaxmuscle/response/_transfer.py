"""Transfer functions from one signal, the harmonic or noise on the active tissue, to the output."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxmuscle._common.types import Scalar
from jaxmuscle.model._activation import ACTIVE
from jaxmuscle.model._muscle import Perturbation
from jaxmuscle.model._tasks import AbstractTask

from ._linear_task import Linearisation

POINTS = 400


def turn_of(angle: Float[Array, "*any"]) -> Complex[Array, "*any"]:
    """exp(i angle)."""
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


def times_i(x: Float[Array, "*any"]) -> Complex[Array, "*any"]:
    return jax.lax.complex(jnp.zeros_like(x), x)


class SignalSystem(NamedTuple):
    """`y' = A y + b h`, `z = c y + d h + e h'`: the output's response to one signal h, on all the
    inputs that it moves."""

    A: Float[Array, "states states"]
    b: Float[Array, " states"]
    c: Float[Array, " states"]
    d: Float[Array, ""]
    e: Float[Array, ""]


def harmonic_system(task: AbstractTask, system: Linearisation) -> SignalSystem:
    """The response to the harmonic."""
    return system_of(task, system, task.harmonic_base())


def system_of(task: AbstractTask, system: Linearisation, base: Perturbation) -> SignalSystem:
    """The response to one signal that acts on every input by so much.

    With an activation, its states beside the task's: the active inputs get what has passed it.
    """
    if task.activation is None:
        return SignalSystem(system.A, system.B @ base, system.C, system.D @ base, system.E @ base)
    active = np.isin(np.arange(len(base)), ACTIVE)
    later, now = jnp.where(active, base, 0.0), jnp.where(active, 0.0, base)
    own, into = (x.astype(base.dtype) for x in task.activation.states())
    first = jnp.array([1.0, 0.0], base.dtype)
    A = jnp.block(
        [
            [system.A, jnp.outer(system.B @ later, first)],
            [jnp.zeros((2, len(system.A)), base.dtype), own],
        ]
    )
    read = (system.D @ later) * first + (system.E @ later) * own[0]
    return SignalSystem(
        A,
        jnp.concatenate([system.B @ now, into]),
        jnp.concatenate([system.C, read]),
        system.D @ now,
        system.E @ now,
    )


def transfer(system: SignalSystem, omega: Float[Array, ""]) -> Complex[Array, ""]:
    """Response of the output to the signal, `c (s - A)⁻¹ b + d + s e`, s = iω."""
    s = times_i(omega)
    A, b, c = (x.astype(s.dtype) for x in system[:3])
    inside = jnp.linalg.solve(s * jnp.eye(len(A), dtype=s.dtype) - A, b)
    return c @ inside + jax.lax.complex(system.d, omega * system.e)


def polynomials(system: SignalSystem) -> tuple[Array, Array]:
    """`c (s - A)⁻¹ b + d + s e` as numerator and denominator, highest power first: Faddeev and
    LeVerrier."""
    A, b, c, d, e = system
    n, eye = len(A), jnp.eye(len(A), dtype=A.dtype)
    adjoint, below, above = eye, [jnp.ones((), A.dtype)], []
    for k in range(1, n + 1):
        above.append(c @ adjoint @ b)
        forward = A @ adjoint
        below.append(-jnp.trace(forward) / k)
        adjoint = forward + below[-1] * eye
    denominator = jnp.stack(below)
    inside = jnp.concatenate([jnp.zeros(2, A.dtype), jnp.stack(above)])
    through = jnp.concatenate([jnp.zeros(1, A.dtype), d * denominator])
    return inside + through + jnp.concatenate([e * denominator, jnp.zeros(1, A.dtype)]), denominator


def polynomial(
    coefficients: Float[Array, " powers"], s: Complex[Array, "*grid"]
) -> Complex[Array, "*grid"]:
    """Its value at s."""
    value = jnp.zeros_like(s)
    for c in coefficients:
        value = value * s + c.astype(s.dtype)
    return value


def half_power_level(
    system: Linearisation, stiffness: Scalar, time: Scalar, log_f: Float[Array, "*any"]
) -> Float[Array, "*any"]:
    """`ln(2 |H(f)|² / |H(0)|²)`, H the response to noise on K_w: zero where half its power is left.

    `stiffness` is K_w0, `time` the contraction time T of an activation, which takes off `2 ln(1 +
    (2πf T)²)` (0: none). Smooth in the parameters everywhere, which the frequency of its first zero
    is not (docs/fitting.md).
    """
    return _level(log_f, *_active_response(system, stiffness), time)


def _active_response(system: Linearisation, stiffness: Scalar) -> tuple[Array, Array]:
    base = jnp.zeros(5, system.A.dtype).at[0].set(stiffness)
    return polynomials(
        SignalSystem(system.A, system.B @ base, system.C, system.D @ base, system.E @ base)
    )


def _level(
    log_f: Float[Array, "*any"], above: Array, below: Array, time: Scalar
) -> Float[Array, "*any"]:
    omega = 2 * jnp.pi * jnp.exp(log_f)
    s = times_i(omega)
    gain = jnp.abs(polynomial(above, s) / polynomial(below, s)) * jnp.abs(below[-1] / above[-1])
    return 2 * (jnp.log(gain) - jnp.log1p((omega * time) ** 2)) + np.log(2.0)


def half_power_frequency(
    system: Linearisation, stiffness: Scalar, time: Scalar
) -> Float[Array, ""]:
    """Frequency [Hz] at which white noise on K_w has fallen to half its power at 0: relaxation and
    activation together; arguments of `half_power_level`.

    The lowest one between 1 mHz and 100 Hz; not a number where there is none. Between two points of
    a grid, then by one Newton step, the only one that is differentiated (the implicit function
    theorem), with the slope of the grid.
    """
    above, below = _active_response(system, stiffness)
    grid = jnp.linspace(np.log(1e-3), np.log(100.0), POINTS)
    levels = jax.lax.stop_gradient(_level(grid, above, below, time))
    i = jnp.argmax(levels < 0)
    step = grid[1] - grid[0]
    x = grid[i] - levels[i] / (levels[i] - levels[i - 1]) * step
    before, here, after = (levels[i + k] - levels[i + k - 1] for k in (-1, 0, 1))
    slope = (here + (after - before) / 2 * ((x - grid[i]) / step + 0.5)) / step
    found = jnp.exp(x - _level(x, above, below, time) / slope)
    return jnp.where((i > 0) & (levels[i] < 0), found, jnp.nan)
