"""Several targets of one person as one problem: which parameters they share, and its residuals."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._consequences import Seen, seen_at
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._moment_models import Linear, MonteCarlo
from jaxmuscle.objective._problem import Data, Problem, Setup
from jaxmuscle.response._expected import Moments


class JointProblem(eqx.Module):
    """The problems of several targets, with the interface of `Problem`; moments and data are tuples, one entry each.

    `columns` says of every part where its own coordinates stand among the joint ones.
    """

    parts: tuple[Problem, ...]
    coordinates: Coordinates
    prior: Float[Array | np.ndarray, " free"]
    moving: Float[Array | np.ndarray, " free"]
    columns: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def model(self) -> Linear | MonteCarlo:
        """The kind of model that all parts have."""
        return self.parts[0].model

    @property
    def data(self) -> tuple[Data, ...]:
        """Data of every part."""
        return tuple(part.data for part in self.parts)

    def theta(self, s: Float[Array | np.ndarray, "*rows free"]) -> Float[Array | np.ndarray, "*rows free"]:
        """Coordinates in prior standard deviations; what is not `moving` (1, else 0) has no slope."""
        if not isinstance(s, np.ndarray):
            s = jnp.where(self.moving > 0, s, jax.lax.stop_gradient(s))
        return self.coordinates.theta(s)

    def moments(self, theta: Float[Array, " free"]) -> tuple[Moments, ...]:
        """Moments of every part's model at θ."""
        return tuple(part.moments(theta[np.array(own)]) for part, own in zip(self.parts, self.columns, strict=True))

    def data_residuals(self, moments: tuple[Moments, ...], data: tuple[Data, ...]) -> Float[Array, " residuals"]:
        """Data residuals of all parts, one after the other."""
        return jnp.concatenate([p.data_residuals(m, d) for p, m, d in zip(self.parts, moments, data, strict=True)])

    def residuals(
        self, theta: Float[Array, " free"], moments: tuple[Moments, ...], data: tuple[Data, ...]
    ) -> Float[Array, " all"]:
        """Data residuals, then those of the prior, which counts once."""
        return jnp.concatenate([self.data_residuals(moments, data), jnp.sqrt(self.prior) * theta])

    def part_of(self, seen: Seen, i: int) -> Seen:
        """What was seen of one part at one θ, with slopes with respect to its own coordinates."""
        own = np.array(self.columns[i])
        slopes = jax.tree.map(lambda slope: slope[..., own], seen.slopes[i])
        return Seen(seen.theta[own], seen.moments[i], slopes)

    def spread(self, slope: Float[np.ndarray, "*rows own"], i: int) -> Float[np.ndarray, "*rows free"]:
        """Slopes with respect to one part's coordinates as slopes with respect to all."""
        whole = np.zeros((*np.shape(slope)[:-1], len(self.coordinates.names)))
        whole[..., np.array(self.columns[i])] = slope
        return whole


@seen_at.register(JointProblem)
def _seen_jointly(problem: JointProblem, theta: Float[np.ndarray, "points free"]) -> Seen:
    """Part by part: each has the program of a fit alone. (One program of two kinds of task hangs under jaxlib 0.10.2.)"""
    each = [seen_at(part, theta[:, np.array(own)]) for part, own in zip(problem.parts, problem.columns, strict=True)]
    slopes = tuple(jax.tree.map(lambda g, i=i: problem.spread(g, i), seen.slopes) for i, seen in enumerate(each))
    return Seen(theta, tuple(seen.moments for seen in each), slopes)


@dataclasses.dataclass(frozen=True)
class JointSetup:
    """The setups of several targets by name, and the coordinates that they have together."""

    setups: dict[str, Setup]
    coordinates: Coordinates
    prior: np.ndarray
    columns: tuple[tuple[int, ...], ...]
    tell: Callable[[str, float], None]

    @classmethod
    def of(
        cls, setups: dict[str, Setup], names: Mapping[str, Mapping[str, str]], tell: Callable[[str, float], None]
    ) -> "JointSetup":
        """From the setups of the targets alone and the joint name of each one's parameters, as `joint_names` gives them.

        A coordinate that is shared is that of the first target: θ = 0 is the task's own value in every one.
        """
        places: dict[str, tuple[Setup, int]] = {}
        for target, setup in setups.items():
            for i, name in enumerate(setup.coordinates.names):
                places.setdefault(names[target][name], (setup, i))
        order = {name: i for i, name in enumerate(places)}
        columns = tuple(tuple(order[names[t][n]] for n in s.coordinates.names) for t, s in setups.items())

        def gathered(field: str) -> np.ndarray:
            return np.array([getattr(setup.coordinates, field)[i] for setup, i in places.values()])

        parts = (gathered(field) for field in ("centre", "sd", "positive", "low", "high"))
        prior = np.array([setup.prior[i] for setup, i in places.values()])
        return cls(setups, Coordinates(tuple(places), *parts), prior, columns, tell)

    @property
    def finest(self) -> Target:
        """The target whose bins are narrowest."""
        return min((setup.target for setup in self.setups.values()), key=lambda target: target.settings.resolution)

    def scattering_as(self, s: Float[np.ndarray, " free"]) -> "JointSetup":
        """The setup with coefficients of variation that scatter as those of the tasks at these coordinates do."""
        theta = np.asarray(self.coordinates.theta(s))
        setups = {name: setup.scattering_as(setup.at(self.theta_of_part(theta, i)))
                  for i, (name, setup) in enumerate(self.setups.items())}  # fmt: skip
        return dataclasses.replace(self, setups=setups)

    def linear(self, shares: list[Any] | None = None, corrections: list[Any] | None = None) -> JointProblem:
        """The problem in linear response, as `Setup.linear` with a list entry for each target."""
        none = [None] * len(self.setups)
        given = zip(self.setups.values(), shares or none, corrections or none, strict=True)
        parts = tuple(setup.linear(share, correction) for setup, share, correction in given)
        prior = as_arrays({"prior": self.prior, "moving": np.ones(len(self.prior))})
        return JointProblem(parts, self.coordinates, columns=self.columns, **prior)

    def theta_of_part(self, theta: Float[np.ndarray, " free"], i: int) -> Float[np.ndarray, " own"]:
        """One target's own coordinates."""
        return theta[np.array(self.columns[i])]

    def tasks(self, theta: Float[np.ndarray, " free"]) -> dict[str, AbstractTask]:
        """Every target's task at θ."""
        found = {}
        for i, (name, setup) in enumerate(self.setups.items()):
            values = setup.coordinates.values(self.theta_of_part(theta, i))
            found[name] = setup.task.replace(**{n: float(v) for n, v in values.items()})
        return found
