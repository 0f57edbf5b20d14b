"""Free parameters as unconstrained numbers."""

from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import expit

from jaxmuscle._common.arrays import all_concrete
from jaxmuscle._common.cards import Card
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._parameters import PARAMETERS, Parameter, set_parameters
from jaxmuscle.model._task import in_numbers
from jaxmuscle.model._tasks import AbstractTask

Numbers = TypeVar("Numbers", bound=Float[Array | np.ndarray, "*batch free"])


class Coordinates(eqx.Module):
    """Free parameters as unconstrained numbers.

    `θ = (ln v - ln v0) / sd` for positive parameters, `(v - v0) / sd` for others, v0 the task's own
    value and sd the prior's; a parameter with two finite bounds is `θ = low + (high - low)
    sigmoid(s)`, otherwise θ = s.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    centre: Float[np.ndarray, " free"]
    sd: Float[np.ndarray, " free"]
    positive: np.ndarray
    low: Float[np.ndarray, " free"]
    high: Float[np.ndarray, " free"]

    @classmethod
    def of(
        cls, values: dict[str, float], bounds: dict[str, tuple[float, float]], sds: dict[str, float]
    ) -> "Coordinates":
        """Coordinates about the given values. Raises `ValueError` for one that cannot be fitted."""
        rows = {name: PARAMETERS.get(name, _generic(name)) for name in values}
        ends = []
        for name, value in values.items():
            row = rows[name]
            a, b = bounds.get(name, (row.fit_lower, row.fit_upper))
            if row.positive and not value > 0:
                raise ValueError(
                    f"{name} = {value} cannot be fitted: it is fitted in log space, start from a"
                    " positive value"
                )
            if not a < value < b:
                raise ValueError(
                    f"{name} = {value} {row.unit} must lie inside its bounds ({a}, {b})"
                )
            ends.append(
                [
                    (_log(end) - np.log(value) if row.positive else end - value) / sds[name]
                    for end in (a, b)
                ]
            )
        positive = np.array([rows[name].positive for name in values])
        centre = np.array([float(v) for v in values.values()])
        sd = np.array([sds[name] for name in values])
        return cls(
            tuple(values), centre, sd, positive, *_both_or_none(*np.reshape(ends, (-1, 2)).T)
        )

    def filled(self, more: int) -> "Coordinates":
        """With so many further ones that are unbounded, and without names."""

        def wider(x: np.ndarray, value: float) -> np.ndarray:
            return np.pad(x, (0, more), constant_values=value)

        return Coordinates(
            (),
            wider(self.centre, 0.0),
            wider(self.sd, 1.0),
            wider(self.positive, 0.0),
            wider(self.low, -np.inf),
            wider(self.high, np.inf),
        )

    def theta(self, s: Numbers) -> Numbers:
        """Coordinates in standard deviations of the prior."""
        xp, sigmoid = self._library(s)
        bounded = xp.isfinite(self.low)
        low, high = xp.where(bounded, self.low, 0.0), xp.where(bounded, self.high, 1.0)
        return xp.where(bounded, low + (high - low) * sigmoid(s), s)

    def stretch(self, s: Float[np.ndarray, "*batch free"]) -> Float[np.ndarray, "*batch free"]:
        """dθ/ds."""
        bounded = np.isfinite(self.low)
        share = expit(s)
        return np.where(
            bounded, np.where(bounded, self.high - self.low, 1.0) * share * (1 - share), 1.0
        )

    def _library(self, given: Any) -> tuple[Any, Any]:
        """NumPy for numbers, which needs no compilation, else JAX; with its sigmoid."""
        return (
            (np, expit)
            if isinstance(given, np.ndarray) and isinstance(self.low, np.ndarray)
            else (jnp, jax.nn.sigmoid)
        )

    def from_theta(self, theta: Numbers, inset: float = 1e-3) -> Numbers:
        """The reverse of `theta`, clipped into the bounds: off them by a share `inset` of what lies
        between."""
        xp, _ = self._library(theta)
        bounded = xp.isfinite(self.low)
        low, high = xp.where(bounded, self.low, 0.0), xp.where(bounded, self.high, 1.0)
        share = xp.where(bounded, xp.clip((theta - low) / (high - low), inset, 1 - inset), 0.5)
        return xp.where(bounded, xp.log(share / (1 - share)), theta)

    def values(self, theta: Float[Array | np.ndarray, " free"]) -> dict[str, Scalar]:
        """Natural values of the parameters at θ."""
        xp, _ = self._library(theta)
        step = self.sd * theta
        natural = xp.where(
            self.positive,
            self.centre * xp.exp(xp.where(self.positive, step, 0.0)),
            self.centre + step,
        )
        return dict(zip(self.names, natural, strict=True))

    def values_of(self, theta: Float[np.ndarray, "rows free"]) -> Float[np.ndarray, "rows free"]:
        """Natural values of many θ, in the order of `names`; infinite where a search runs off."""
        step = self.sd * theta
        with np.errstate(over="ignore"):
            scaled = self.centre * np.exp(np.where(self.positive, step, 0.0))
        return np.where(self.positive, scaled, self.centre + step)

    def at(self, values: Numbers) -> Numbers:
        """θ of the parameters' natural values, in the order of `names`: the reverse of `values`."""
        xp, _ = self._library(values)
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = xp.where(self.positive, values, 1.0) / xp.where(self.positive, self.centre, 1.0)
            return xp.where(self.positive, xp.log(ratio), values - self.centre) / self.sd

    def unbounded(self, values: Sequence[Any]) -> Any:
        """s of the parameters' natural values, in the order of `names`.

        JAX may trace the values; a traced one outside its bounds is NaN. Raises `ValueError` for a
        concrete one.
        """
        if not all_concrete((values, self)):
            found = self.at(jnp.stack(jax.tree.map(jnp.asarray, list(values))))
            inside = (self.low < found) & (found < self.high)
            return self.from_theta(jnp.where(inside, found, jnp.nan), 0.0)
        found = self.at(np.asarray(values, dtype=float))
        for name, value, here, low, high in zip(
            self.names, values, found, self.low, self.high, strict=True
        ):
            if not low < here < high:
                raise ValueError(
                    f"{name} = {value} lies outside what this problem can reach: give one inside"
                    " its bounds"
                )
        return self.from_theta(found, 0.0)

    def log_stretch(self, s: Float[Array | np.ndarray, " free"]) -> Scalar:
        """ln |dθ/ds|."""
        xp, _ = self._library(s)
        bounded = xp.isfinite(self.low)
        width = xp.log(xp.where(bounded, self.high - self.low, 1.0))
        share = jax.nn.log_sigmoid(s) + jax.nn.log_sigmoid(-s)
        return jnp.sum(jnp.where(bounded, width + share, 0.0))

    def card(self, heading: str) -> Card:
        """The parameters with their values at θ = 0."""
        units = [PARAMETERS[name].unit if name in PARAMETERS else "" for name in self.names]
        rows = tuple(
            (name, in_numbers(value), "" if unit == "1" else unit)
            for name, value, unit in zip(self.names, self.centre, units, strict=True)
        )
        text = "\n".join(
            [heading, *(f"  {name:<24}{value:<12}{unit}".rstrip() for name, value, unit in rows)]
        )
        return Card(text, heading, ("name", "start", "unit"), rows)

    def theta_of(
        self, name: str, values: Float[np.ndarray, "*values"] | float
    ) -> Float[np.ndarray, "*values"]:
        """θ of one positive parameter at natural values."""
        i = self.names.index(name)
        return np.asarray(np.log(values / self.centre[i]) / self.sd[i])

    def slope(self, values: Float[np.ndarray, "*rows free"]) -> Float[np.ndarray, "*rows free"]:
        """dv/dθ at natural values."""
        return np.where(self.positive, values, 1.0) * self.sd


def _log(value: float) -> float:
    return -np.inf if value <= 0 else float(np.log(value))


def _generic(name: str) -> Parameter:
    return Parameter(name, name, "", 1.0, "", "a user's own")


def _both_or_none(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where only one bound is finite the other is set 20 prior standard deviations beyond the
    centre."""
    some = np.isfinite(low) | np.isfinite(high)
    low = np.where(some & ~np.isfinite(low), -20.0, low)
    high = np.where(some & ~np.isfinite(high), 20.0, high)
    return np.where(some, low, -np.inf), np.where(some, high, np.inf)


def task_at(
    task: AbstractTask, coordinates: Coordinates, theta: Float[Array | np.ndarray, " free"]
) -> AbstractTask:
    """The task at coordinates θ."""
    return set_parameters(task, coordinates.values(theta))
