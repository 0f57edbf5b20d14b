"""The muscle: material laws of its two tissues, its coefficients and forces."""

import abc
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import Inexact, require
from jaxmuscle._common.cards import Spelled
from jaxmuscle._common.types import Scalar

from ._parameters import default


class AbstractLaw(Spelled, Inexact):
    """A material coefficient as a function of one kinematic quantity.

    Write one class with a `__call__` to replace the paper's quadratic laws, an exponential toe
    region of a tendon say. Its floating-point fields become parameters of the task: a field `k` of
    the active stiffness is named `k_w`.
    """

    @abc.abstractmethod
    def __call__(self, q: Scalar) -> Scalar:
        """The coefficient (stiffness [N/m] or damping [N s/m]) at displacement [m] or velocity
        [m/s] `q`.

        The force is `law(q) q`: a stiffness is force over displacement (the secant), not the slope
        of the force.
        """


class QuadraticStiffness(AbstractLaw):
    """`K(x) = k (x_ref² + x²)`, equation (2a) of the paper with its initial stiffness `K_0 = k
    x_ref²`.

    `k` [N/m³] >= 0, `x_ref` [m] >= 0; `x_ref = 0` is the equation as printed. Raises `ValueError`
    for negative ones.
    """

    k: Scalar = default("k_w")
    x_ref: Scalar = default("x_ref_w")

    def __check_init__(self):
        require(self.k >= 0, f"stiffness factor k = {self.k} N/m^3 must not be negative")
        require(
            self.x_ref >= 0, f"reference displacement x_ref = {self.x_ref} m must not be negative"
        )

    def __call__(self, q: Scalar) -> Scalar:
        return self.k * (self.x_ref**2 + q**2)


class QuadraticDamping(AbstractLaw):
    """`C(v) = c (v_ref² + v²)`, equation (2b) of the paper with its initial damping `C_0 = c
    v_ref²`.

    `c` [N s³/m³] >= 0, `v_ref` [m/s] >= 0; `v_ref = 0` is the equation as printed. Raises
    `ValueError` for negative ones.
    """

    c: Scalar = default("c_w")
    v_ref: Scalar = default("v_ref_w")

    def __check_init__(self):
        require(self.c >= 0, f"damping factor c = {self.c} N s^3/m^3 must not be negative")
        require(
            self.v_ref >= 0, f"reference velocity v_ref = {self.v_ref} m/s must not be negative"
        )

    def __call__(self, q: Scalar) -> Scalar:
        return self.c * (self.v_ref**2 + q**2)


Perturbation = Float[Array, " inputs"]


class AbstractMuscle(Spelled, Inexact):
    """A deterministic muscle that takes the perturbations `u = (ΔK_w, ΔK_z, ΔC_w, ΔC_z, ΔP_w /
    P_w)` as an input.

    Active tissue `w` (inner) and passive tissue `z` (at the insertion) move by

        m_w x_w'' = P_w - active_force + passive_force,      m_z x_z'' = -F_ext - passive_force

    where P_w stands for `drive(P_w, u)`. Whoever writes the methods and two masses gets simulation,
    noise, spectra and fits: everything stochastic is derived from them by differentiation with
    respect to `u`. `contraction_velocity` is only asked for by `PrescribedMotion`. The first task
    of a class checks the methods: an error names the one that does not return what it must.
    """

    m_w: eqx.AbstractVar[Scalar]
    m_z: eqx.AbstractVar[Scalar]

    @abc.abstractmethod
    def base(self) -> Float[Array, "4"]:
        """Unperturbed coefficients `(K_w0, K_z0, C_w0, C_z0)` [N/m, N s/m], of which relative
        amplitudes of noise and harmonic are fractions. Of the paper's muscle they are those at zero
        displacement and velocity.
        """

    def drive(self, force: Scalar, u: Perturbation) -> Scalar:
        """What becomes of the prescribed P_w [N] under its perturbation, `P_w (1 + u[4])`.

        A muscle in which the drive multiplies something else returns `force` here and uses u[4] in
        `active_force`.
        """
        return force * (1 + u[4]) if len(u) > 4 else force  # u may stop before the drive

    @abc.abstractmethod
    def active_force(self, x_w: Scalar, v_w: Scalar, u: Perturbation) -> Scalar:
        """Force [N] of the active spring and damper, positive when it pulls the active mass
        back."""

    @abc.abstractmethod
    def passive_force(
        self, x_w: Scalar, v_w: Scalar, x_z: Scalar, v_z: Scalar, u: Perturbation
    ) -> Scalar:
        """Force [N] between the tissues, positive when the insertion runs ahead of the active
        mass."""

    def contraction_velocity(
        self, x_w: Scalar, x_z: Scalar, v_z: Scalar, force: Scalar, u: Perturbation
    ) -> Scalar:
        """Velocity v_w [m/s] at which `passive_force` equals `force`; only `PrescribedMotion` asks
        for it."""
        raise NotImplementedError(f"{type(self).__name__} has no method contraction_velocity")


def _stiffness(k: str, x_ref: str) -> QuadraticStiffness:
    return QuadraticStiffness(default(k), default(x_ref))


def _damping(c: str, v_ref: str) -> QuadraticDamping:
    return QuadraticDamping(default(c), default(v_ref))


class Muscle(AbstractMuscle):
    """The paper's muscle, equations (1) and (2).

        active_force  = C_w x_w' + K_w x_w
        passive_force = C_z (x_z' - x_w') + K_z (x_z - x_w)
        K_j = stiffness_j(q_j) + ΔK_j,   C_j = damping_j(q_j') + ΔC_j,   j = w, z

    with q_w = x_w and, literally as printed, q_z = x_z; `argument="elongation"` uses q_z = x_z -
    x_w.

    **Arguments:** masses `m_w`, `m_z` [kg] > 0; the material laws `stiffness_w`, `stiffness_z`
    [N/m], `damping_w`, `damping_z` [N s/m]; `argument`, "literal" or "elongation".

    **Raises:** `ValueError` for a mass that is not positive or an unknown `argument`.

    **Source:** Zagrodny, Wojnicz, Ludwicki, Barański, equations (1) and (2); reference terms: see
    docs/model.md.
    """

    m_w: Scalar = default("m_w")
    m_z: Scalar = default("m_z")
    stiffness_w: AbstractLaw = eqx.field(default_factory=lambda: _stiffness("k_w", "x_ref_w"))
    stiffness_z: AbstractLaw = eqx.field(default_factory=lambda: _stiffness("k_z", "x_ref_z"))
    damping_w: AbstractLaw = eqx.field(default_factory=lambda: _damping("c_w", "v_ref_w"))
    damping_z: AbstractLaw = eqx.field(default_factory=lambda: _damping("c_z", "v_ref_z"))
    argument: Literal["literal", "elongation"] = eqx.field(static=True, default="literal")

    def __check_init__(self):
        require(self.m_w > 0, f"mass m_w = {self.m_w} kg must be positive")
        require(self.m_z > 0, f"mass m_z = {self.m_z} kg must be positive")
        if self.argument not in ("literal", "elongation"):
            raise ValueError(f"argument = {self.argument!r} must be 'literal' or 'elongation'")

    def base(self) -> Float[Array, "4"]:
        laws = (self.stiffness_w, self.stiffness_z, self.damping_w, self.damping_z)
        return jnp.stack([jnp.asarray(law(0.0)) for law in laws])

    def active_force(self, x_w: Scalar, v_w: Scalar, u: Perturbation) -> Scalar:
        return (self.damping_w(v_w) + u[2]) * v_w + (self.stiffness_w(x_w) + u[0]) * x_w

    def passive_force(
        self, x_w: Scalar, v_w: Scalar, x_z: Scalar, v_z: Scalar, u: Perturbation
    ) -> Scalar:
        stretch, rate = x_z - x_w, v_z - v_w
        literal = self.argument == "literal"
        stiffness = self.stiffness_z(x_z if literal else stretch) + u[1]
        damping = self.damping_z(v_z if literal else rate) + u[3]
        return damping * rate + stiffness * stretch

    def contraction_velocity(
        self, x_w: Scalar, x_z: Scalar, v_z: Scalar, force: Scalar, u: Perturbation
    ) -> Scalar:
        if self.argument == "literal":  # linear in v_w: Newton's step is exact
            return _newton_step(self, v_z, (x_w, x_z, v_z, force, u))
        settled = _settle(
            *jax.tree.map(jax.lax.stop_gradient, (self, v_z, (x_w, x_z, v_z, force, u)))
        )
        # Two more steps, differentiable ones, make first to third derivatives exact (each squares
        # the error).
        once = _newton_step(self, settled, (x_w, x_z, v_z, force, u))
        return _newton_step(self, once, (x_w, x_z, v_z, force, u))


def _newton_step(muscle: Muscle, v_w: Scalar, given: tuple) -> Scalar:
    """One Newton step towards the v_w at which the passive force is as given."""
    x_w, x_z, v_z, force, u = given
    value, slope = jax.jvp(
        lambda v: muscle.passive_force(x_w, v, x_z, v_z, u), (v_w,), (jnp.ones_like(v_w),)
    )
    return v_w - (value - force) / slope


def _settle(muscle: Muscle, v_w: Scalar, given: tuple) -> Scalar:
    """Newton's method until it stops moving: monotone for a cubic damping force, a third of the way
    per step at first."""

    def moving(state):
        step, before, now = state
        return (step < 60) & (jnp.abs(now - before) > 1e-3 * jnp.abs(now))

    def move(state):
        step, _, now = state
        return step + 1, now, _newton_step(muscle, now, given)

    first = _newton_step(muscle, v_w, given)
    return jax.lax.while_loop(moving, move, (0, v_w, first))[2]
