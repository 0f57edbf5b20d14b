"""The residuals of a fit: what each target and the prior contribute, of one target or of
several."""

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.types import Scalar
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._bin_law import BinStatistics

from ._coordinates import Coordinates, task_at
from ._moment_models import Linear, MonteCarlo


class Data(eqx.Module):
    """What a fit knows of a target: powers, their spread; log coefficient of variation, mean, and
    real and imaginary part of the dynamic stiffness, each with its sd (or None).

    The model does not depend on it.
    """

    target: Float[Array | np.ndarray, "*rows bins"]
    bias: Float[Array | np.ndarray, "*rows bins"]
    sd: Float[Array | np.ndarray, "*rows bins"]
    variation: tuple[Scalar, Scalar] | None
    mean: tuple[Scalar, Scalar] | None
    stiffness: (
        tuple[
            Float[Array | np.ndarray, "*rows 2 points"], Float[Array | np.ndarray, "*rows points"]
        ]
        | None
    ) = None

    @property
    def further(self) -> int:
        """How many residuals there are besides those of the spectrum."""
        points = 0 if self.stiffness is None else 2 * np.shape(self.stiffness[1])[-1]
        return (self.variation is not None) + (self.mean is not None) + points


class Compared(eqx.Module):
    """What the residuals of one target follow from once its moments are known."""

    data: Data


class PartResiduals(eqx.Module):
    """One target's share: its task and coordinates, the model of its moments, and its data."""

    task: AbstractTask
    coordinates: Coordinates
    model: Linear | MonteCarlo
    data: Data
    statistics: BinStatistics

    def moments(self, theta: Float[Array, " own"]) -> Moments:
        """Moments of the model at its own coordinates."""
        return self.model.moments(task_at(self.task, self.coordinates, theta))


def data_residuals(moments: Moments, data: Data) -> Float[Array, " residuals"]:
    """Residuals in standard deviations of the data: spectrum, then the further ones."""
    z = jnp.log(data.target) - data.bias - jnp.log(moments.power)
    return jnp.concatenate([(z - jnp.mean(z)) / data.sd, further_residuals(moments, data)])


def further_residuals(moments: Moments, data: Data) -> Float[Array, " rows"]:
    """Residuals of coefficient of variation, mean and dynamic stiffness, where there are such."""
    rows = (
        []
        if data.variation is None
        else [(jnp.log(moments.variation) - data.variation[0]) / data.variation[1]]
    )
    rows += [] if data.mean is None else [(moments.mean - data.mean[0]) / data.mean[1]]
    found = jnp.stack([jnp.asarray(row) for row in rows]) if rows else jnp.zeros(0)
    if data.stiffness is None:
        return found
    measured, sd = data.stiffness
    return jnp.concatenate(
        [found, jnp.reshape((jnp.asarray(moments.stiffness) - measured) / sd, -1)]
    )


class Residuals(eqx.Module):
    """Everything that the residuals of a fit depend on besides the free coordinates.

    Of one target or of several: `columns` says of every part where its own coordinates stand among
    those of the fit. Moments and data are tuples, one entry for each part.
    """

    parts: tuple[Any, ...]  # of `PartResiduals`; where they are `filled`, of `Compared`
    coordinates: Coordinates
    prior_root: Float[Array | np.ndarray, "free free"]
    moving: Float[Array | np.ndarray, " free"]
    columns: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def linear(self) -> bool:
        """Whether the moments are those of the linear response."""
        return isinstance(self.parts[0].model, Linear)

    @property
    def data(self) -> tuple[Data, ...]:
        """Data of every part."""
        return tuple(part.data for part in self.parts)

    @property
    def rows(self) -> tuple[slice, ...]:
        """Which data residuals are those of each part: bins first, the dynamic stiffness last."""
        counts = [len(part.statistics.sd) + part.data.further for part in self.parts]
        return tuple(slice(a, b) for a, b in itertools.pairwise(np.cumsum([0, *counts]).tolist()))

    def theta(
        self, s: Float[Array | np.ndarray, "*rows free"]
    ) -> Float[Array | np.ndarray, "*rows free"]:
        """Coordinates in prior standard deviations; what is not `moving` (1, else 0) has no
        slope."""
        if not isinstance(s, np.ndarray):
            s = jnp.where(self.moving > 0, s, jax.lax.stop_gradient(s))
        return self.coordinates.theta(s)

    def data_residuals(
        self, moments: tuple[Moments, ...], data: tuple[Data, ...]
    ) -> Float[Array, " residuals"]:
        """Data residuals of all parts, one after the other."""
        return jnp.concatenate([data_residuals(m, d) for m, d in zip(moments, data, strict=True)])

    def residuals(
        self, theta: Float[Array, " free"], moments: tuple[Moments, ...], data: tuple[Data, ...]
    ) -> Float[Array, " all"]:
        """Data residuals of the moments at θ, then those of the prior, which counts once."""
        return jnp.concatenate([self.data_residuals(moments, data), self.prior_root @ theta])

    def filled(self) -> "Residuals":
        """What residuals follow from once moments are known, with coordinates that nothing depends
        on: a program of steps that fits share, whatever their tasks and free parameters."""
        more = free_size(len(self.coordinates.names)) - len(self.coordinates.names)
        parts = tuple(Compared(part.data) for part in self.parts)
        root = np.eye(len(self.prior_root) + more, dtype=self.prior_root.dtype)
        root[: len(self.prior_root), : len(self.prior_root)] = self.prior_root
        return Residuals(
            parts,
            self.coordinates.filled(more),
            root,
            np.pad(self.moving, (0, more), constant_values=1),
            columns=(),
        )

    def own(
        self, values: Float[Array | np.ndarray, "*rows free"], i: int
    ) -> Float[Array | np.ndarray, "*rows own"]:
        """One part's columns of θ, or of slopes with respect to it."""
        return values[..., np.array(self.columns[i], dtype=int)]

    def spread(
        self, slope: Float[np.ndarray, "*rows own"], i: int
    ) -> Float[np.ndarray, "*rows free"]:
        """Slopes with respect to one part's coordinates as slopes with respect to all."""
        whole = np.zeros((*np.shape(slope)[:-1], len(self.coordinates.names)))
        whole[..., np.array(self.columns[i], dtype=int)] = slope
        return whole


def free_size(free: int) -> int:
    """How many coordinates a shared program has for so many."""
    return max(-(-free // 8) * 8, 16)
