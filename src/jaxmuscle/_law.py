"""Material laws: how a stiffness depends on displacement and a damping on velocity."""

import abc
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ._parameter import default, require

if TYPE_CHECKING:
    Scalar = Any  # a union of numbers and arrays supports no arithmetic in the eyes of a type checker
else:
    Scalar = Float[Array, "..."] | Float[np.ndarray, "..."] | float | int


class AbstractLaw(eqx.Module):
    """A material coefficient as a function of one kinematic quantity.

    Write one class with a `__call__` to replace the paper's quadratic laws, an exponential toe region of a tendon say.
    Its floating-point fields become parameters of the task: a field `k` of the active stiffness is named `k_w`.
    """

    @abc.abstractmethod
    def __call__(self, q: Scalar) -> Scalar:
        """The coefficient (stiffness [N/m] or damping [N s/m]) at displacement [m] or velocity [m/s] `q`."""


class QuadraticStiffness(AbstractLaw):
    """`K(x) = k (x_ref² + x²)`, equation (2a) of the paper with its initial stiffness `K_0 = k x_ref²`.

    `k` [N/m³] >= 0, `x_ref` [m] >= 0; `x_ref = 0` is the equation as printed. Raises `ValueError` for negative ones.
    """

    k: Scalar = default("k_w")
    x_ref: Scalar = default("x_ref_w")

    def __check_init__(self):
        require(self.k >= 0, f"stiffness factor k = {self.k} N/m^3 must not be negative")
        require(self.x_ref >= 0, f"reference displacement x_ref = {self.x_ref} m must not be negative")

    def __call__(self, q: Scalar) -> Scalar:
        return self.k * (self.x_ref**2 + q**2)


class QuadraticDamping(AbstractLaw):
    """`C(v) = c (v_ref² + v²)`, equation (2b) of the paper with its initial damping `C_0 = c v_ref²`.

    `c` [N s³/m³] >= 0, `v_ref` [m/s] >= 0; `v_ref = 0` is the equation as printed. Raises `ValueError` for negative ones.
    """

    c: Scalar = default("c_w")
    v_ref: Scalar = default("v_ref_w")

    def __check_init__(self):
        require(self.c >= 0, f"damping factor c = {self.c} N s^3/m^3 must not be negative")
        require(self.v_ref >= 0, f"reference velocity v_ref = {self.v_ref} m/s must not be negative")

    def __call__(self, q: Scalar) -> Scalar:
        return self.c * (self.v_ref**2 + q**2)
