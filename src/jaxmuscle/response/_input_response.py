"""The response of force to a moved insertion, and the density of the noise beside it, in linear
response."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxmuscle._common.arrays import all_concrete, as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle.model._parameters import INPUTS, set_parameters
from jaxmuscle.model._tasks import AbstractTask, PrescribedLength

from ._equilibrium import HOLD
from ._linear_task import Linearisation
from ._linearised import check_equilibrium, check_inputs, linearisation, linearise
from ._mechanics import Mechanics, Near, in_parts, value_and_slopes
from ._transfer import SignalSystem, polynomial, polynomials, system_of, times_i

AT_ONCE = 64  # frequencies of the program of `stiffness_rows`
Frequencies = Float[Array | np.ndarray, " frequencies"]


def _gain(
    system: SignalSystem, s: Complex[Array, " frequencies"]
) -> Complex[Array, " frequencies"]:
    above, below = polynomials(system)
    return polynomial(above, s) / polynomial(below, s)


def _laplace(f: Frequencies, system: Linearisation) -> Complex[Array, " frequencies"]:
    return times_i(2 * jnp.pi * jnp.asarray(f, system.A.dtype))


def stiffness_at(
    task: PrescribedLength, system: Linearisation, f: Frequencies
) -> Complex[Array, " frequencies"]:
    """`dynamic_stiffness` where the linearisation is known."""
    t, y, u = (
        jnp.asarray(HOLD, system.A.dtype),
        system.point,
        jnp.zeros(len(INPUTS), system.A.dtype),
    )
    x_z = task.insertion(t)[0].astype(y.dtype)
    held = jnp.stack([x_z, jnp.zeros_like(x_z), jnp.zeros_like(x_z)])
    b, d = jax.jacfwd(lambda at: task.moved(t, y, u, (at[0], at[1], at[2])))(held)
    none, s = jnp.zeros_like(d[0]), _laplace(f, system)
    by_place = SignalSystem(system.A, b[:, 0], system.C, d[0], d[1])
    by_velocity = SignalSystem(system.A, b[:, 1], system.C, none, d[2])
    found = -(_gain(by_place, s) + s * _gain(by_velocity, s))
    if task.reflex is None:
        return found
    # a force on the active tissue: the state is (x_w, x_w')
    pull = jnp.stack([none, 1 / jnp.asarray(task.muscle.m_w, none.dtype)])
    return found + _gain(
        SignalSystem(system.A, pull, system.C, none, none), s
    ) * task.reflex.transfer(s)


def parts_of_stiffness(
    task: AbstractTask, system: Linearisation, f: Frequencies
) -> Float[Array, "2 frequencies"]:
    """Its real and its imaginary part. Raises `ValueError` for a task in which the insertion is not
    held or moved."""
    found = stiffness_at(_perturbed(task), system, f)
    return jnp.stack([jnp.real(found), jnp.imag(found)])


def _perturbed(task: AbstractTask) -> PrescribedLength:
    if isinstance(task, PrescribedLength):
        return task
    raise ValueError(
        f"task: this is a {type(task).__name__}, in which the insertion is not moved; put its"
        " muscle into the experiment: task.as_task(jaxmuscle.PrescribedLength)"
    )


def density_at(
    task: AbstractTask, system: Linearisation, f: Frequencies
) -> Float[Array, " frequencies"]:
    """`noise_density` where the linearisation is known."""
    s, found = _laplace(f, system), jnp.zeros(np.shape(f), system.A.dtype)
    for noise in task.noise.components:
        scale = (
            jnp.zeros(len(INPUTS), system.A.dtype)
            .at[np.array(noise.acts_on)]
            .set(task.noise_scale(noise))
        )
        each = scale[None] if noise.shared else jnp.diag(scale)[np.array(noise.acts_on)]
        gains = jax.vmap(lambda base: _gain(system_of(task, system, base), s))(each)
        found += (
            2
            * jax.vmap(noise.density)(jnp.asarray(f, found.dtype))
            * jnp.sum(jnp.abs(gains) ** 2, axis=0)
        )
    return found


@kept
def _stiffness(
    task: AbstractTask, names: tuple[str, ...], near: Near, f: Float[Array | np.ndarray, " points"]
) -> tuple[Array, Array]:
    def one(near):
        def parts(values):
            there = set_parameters(task, dict(zip(names, values, strict=True)))
            return parts_of_stiffness(there, near.at(values).system, f)

        return value_and_slopes(parts, near.values)

    return jax.vmap(one)(near)


def stiffness_rows(
    here: Mechanics, near: Near, f: Float[np.ndarray, " frequencies"]
) -> tuple[Float[np.ndarray, "rows 2 frequencies"], Float[np.ndarray, "rows 2 frequencies moving"]]:
    """`parts_of_stiffness` at each row of operating points, and its slopes with respect to the
    mechanical values."""
    blocks = max(-(-len(f) // AT_ONCE), 1)
    found = [
        in_parts(lambda near, own=own: _stiffness(here.bare, here.moving, near, own), near)
        for own in as_arrays(np.resize(f, (blocks, AT_ONCE)))
    ]
    value, slopes = jax.tree.map(lambda *x: np.concatenate(x, axis=2), *found)
    return value[:, :, : len(f)], slopes[:, :, : len(f)]


@kept
def _density(task: Any, f: Any) -> Float[Array, " frequencies"]:
    return density_at(task, linearise(task), f)


def _checked(task: AbstractTask) -> None:
    if all_concrete(task):
        check_inputs(task)
        system = linearisation(task)
        check_equilibrium(task, np.asarray(system.point), np.asarray(system.A))


def dynamic_stiffness(task: AbstractTask, frequency: Frequencies) -> Complex[Array, " frequencies"]:
    """Force per lengthening of the muscle at each frequency, in linear response about the operating
    point.

        stiffness = jm.response.dynamic_stiffness(jm.Isometric(), np.array([1.0, 10.0]))

        H(f) = -F_ext(f) / x_z(f) = -[C (s - A)⁻¹ (b₀ + s b₁) + d₀ + s d₁ + s² d₂],    s = 2πif

    with y' = A y + b₀ x_z + b₁ x_z', F_ext = C y + d₀ x_z + d₁ x_z' + d₂ x_z'', d₂ = -m_z. At low
    frequency it is the tangent stiffness of the two tissues in series (for the paper's muscle held
    at x_z = 0: `K K_z0 / (K + K_z0)`, K = K_w_tangent), at high frequency that of the passive
    tissue and the inertia of its mass, `K_z + s C_z + s² m_z`.

    **Arguments:** `task`, a `PrescribedLength` (or `Isometric`) whose inputs are held; `frequency`
    [Hz].

    **Returns:** H [N/m], complex; its real part is the stiffness, its imaginary part over 2πf the
    damping. Differentiable.

    **Raises:** `ValueError` for another task; `OperatingPointError` (a `ValueError`) where an input
    moves or there is no stable equilibrium.
    """
    _checked(_perturbed(task))
    if not all_concrete((task, frequency)):
        return stiffness_at(_perturbed(task), linearise(task), frequency)
    here = Mechanics.of(task)
    _, near = here.at(np.zeros((1, 0)))
    (value,), _ = stiffness_rows(here, near, np.ravel(frequency))
    return jnp.asarray((value[0] + 1j * value[1]).reshape(np.shape(frequency)))


def noise_density(task: AbstractTask, frequency: Frequencies) -> Float[Array, " frequencies"]:
    """One-sided power density [unit²/Hz] of the noise in a task's output, in linear response,
    before it is sampled.

        density = jm.response.noise_density(jm.Isometric(), np.array([1.0, 10.0]))

        S(f) = 2 Σ_j |T_j(f)|² S_j(f)

    S_j is the two-sided density of channel j of the noise, T_j the transfer function from it to the
    output. The harmonic is not in it. `expected_spectrum` is what Welch's method makes of both.

    **Arguments:** `task`; `frequency` [Hz]. **Raises:** `OperatingPointError` as
    `dynamic_stiffness` does.
    """
    _checked(task)
    return _density(as_arrays(task), jnp.asarray(frequency, jnp.result_type(float)))
