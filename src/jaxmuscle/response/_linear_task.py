"""A task about its equilibrium: the linear system, and the task that has its equations."""

import functools
import operator
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle._common.types import Scalar
from jaxmuscle.model._muscle import Perturbation
from jaxmuscle.model._tasks import AbstractTask, State

from ._equilibrium import HOLD, equilibrium


class Linearisation(NamedTuple):
    """A task about its equilibrium, `y' = A (y - point) + B u`, `z = rest + C (y - point) + D u + E
    u'`. Made by `linearise`.

    y are the states (`task.state_names`), z is the output (`task.output_name`), and u are the five
    perturbations (ΔK_w, ΔK_z [N/m], ΔC_w, ΔC_z [N s/m], ΔP_w / P_w). `point` is y, and `rest` is z
    at the equilibrium.
    """

    point: Float[Array, " states"]
    rest: Float[Array, ""]
    A: Float[Array, "states states"]
    B: Float[Array, "states 5"]
    C: Float[Array, " states"]
    D: Float[Array, "5"]
    E: Float[Array, "5"]


def linearise_traced(task: AbstractTask, time: Scalar | float = HOLD) -> Linearisation:
    """`linearise` without checks, under a transformation, too."""
    if isinstance(task, LinearTask):
        return task.system
    point = equilibrium(task, time)
    n, t, still = point.shape[0], jnp.asarray(time, point.dtype), jnp.zeros(5, point.dtype)

    def field(both):
        return task.vector_field(t, both[:n], both[n:])

    def output(all_three):
        z = task.output(t, all_three[:n], all_three[n : n + 5], all_three[n + 5 :])
        return z, z

    AB = jax.jacfwd(field)(jnp.concatenate([point, still]))
    CDE, rest = jax.jacfwd(output, has_aux=True)(jnp.concatenate([point, still, still]))
    return Linearisation(point, rest, AB[:, :n], AB[:, n:], CDE[:n], CDE[n : n + 5], CDE[n + 5 :])


def balanced(system: Linearisation) -> Linearisation:
    """The system in units of its states in which rows and columns of A are of one size: single
    precision needs it."""
    A = jax.lax.stop_gradient(jnp.abs(system.A)) * (
        1 - jnp.eye(len(system.A), dtype=system.A.dtype)
    )
    scale = jnp.ones(len(A), A.dtype)
    for _ in range(2):
        for i in range(len(A)):
            row, column = jnp.sum(A[i] * scale) / scale[i], jnp.sum(A[:, i] / scale) * scale[i]
            fits = (row > 0) & (column > 0)
            ratio = jnp.where(fits, row, 1.0) / jnp.where(fits, column, 1.0)
            scale = scale.at[i].multiply(jnp.sqrt(ratio))
    size = jax.lax.stop_gradient(jnp.linalg.norm(system.C * scale))
    size = jnp.where(size > 0, size, 1.0)
    A = system.A * scale / scale[:, None]
    return system._replace(A=A, B=size * system.B / scale[:, None], C=system.C * scale / size)


class LinearTask(AbstractTask):
    """A task replaced by its linearisation about the equilibrium, where it starts; same noise,
    harmonic and settings."""

    system: Linearisation
    state_names: ClassVar[tuple[str, ...]] = ()
    state_units: ClassVar[tuple[str, ...]] = ()
    output_name: ClassVar[str] = "z"
    output_unit: ClassVar[str] = ""
    smoothness_needed: ClassVar[tuple[int, ...]] = (0, 0, 0, 0, 0)

    @classmethod
    def of(cls, task: AbstractTask, system: Linearisation) -> "LinearTask":
        """That of a task whose linearisation is `system`."""
        return cls(system, **task.common)

    def initial_state(self) -> State:
        return jnp.asarray(self.system.point)

    def vector_field(self, t: Scalar, y: State, u: Perturbation) -> State:
        s, away = self.system, [y[i] - self.system.point[i] for i in range(len(self.system.A))]
        return jnp.stack([_sum(s.A[i], away) + _sum(s.B[i], u) for i in range(len(s.A))])

    def output(self, t: Scalar, y: State, u: Perturbation, du: Perturbation) -> Scalar:
        s = self.system
        return (
            s.rest
            + _sum(s.C, [y[i] - s.point[i] for i in range(len(s.A))])
            + _sum(s.D, u)
            + _sum(s.E, du)
        )


def _sum(row: Array, values: Any) -> Array:
    """Their product, term by term: in a loop over many seeds XLA makes vectors of that, not of
    small matrices."""
    return functools.reduce(operator.add, (row[i] * values[i] for i in range(len(row))))
