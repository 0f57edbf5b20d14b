"""Some parameters of a task as numbers without bounds: for optimisers and samplers of one's own."""

from collections.abc import Iterable, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import all_concrete, as_numbers, require
from jaxmuscle._common.cards import Card, Shown
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._parameters import PARAMETERS, proper_names, proper_values, usually_free
from jaxmuscle.model._task import require_task
from jaxmuscle.model._tasks import AbstractTask

from ._arguments import check_names, tremor_bounds
from ._coordinates import Coordinates, task_at
from ._options import check_named

Vector = Float[Array | np.ndarray, " free"]


class Free(Shown, eqx.Module):
    """Some parameters of a task as a vector without bounds. Made by `free`.

    The entry of a positive parameter v is `θ = (ln v - ln v0) / sd`, of another one `θ = (v - v0) /
    sd`: v0 is its value in the task, and sd the standard deviation of its prior in the parameter
    table. Of a parameter with bounds it is the s of `θ = low + (high - low) sigmoid(s)`; a low of 0
    counts as none. `names` says which entry is which parameter, `start` is the vector of the task
    itself.

    All methods can be compiled, differentiated and mapped. A `Free` is a pytree of arrays, so it
    may be an argument of what you compile, and those of many people can be stacked. `base` is the
    task that was given, `coordinates` are its parameters, for the package itself.
    """

    base: AbstractTask
    coordinates: Coordinates

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters, in the order of the vector."""
        return self.coordinates.names

    @property
    def start(self) -> Vector:
        """The vector of the task that was given: 0 for all without bounds."""
        return self.coordinates.from_theta(0.0 * self.coordinates.centre, 0.0)

    def task(self, vector: Vector) -> AbstractTask:
        """The task with these parameters. Raises `ValueError` for another number of entries."""
        return task_at(self.base, self.coordinates, self._theta(vector))

    def vector(self, task: AbstractTask) -> Vector:
        """The vector of a task: the reverse of `task`. Raises `ValueError` for a value outside its
        bounds; of a traced one the entry is NaN."""
        return self.coordinates.unbounded([task[name] for name in self.names])

    def parameters(self, vector: Vector) -> dict[str, Scalar]:
        """The parameters by name, in their units."""
        return self.coordinates.values(self._theta(vector))

    def log_prior(self, vector: Vector) -> Scalar:
        """Log density of the priors in the parameter table, as one of the vector, up to a constant:
        normal about the task's own values. Add it to a log likelihood for the density of a
        posterior.

        `jaxmuscle.fits.problem` has one more prior, on the damping ratio.
        """
        theta = self._theta(vector)
        return self.coordinates.log_stretch(vector) - 0.5 * jnp.sum(theta**2)

    def _theta(self, vector: Vector) -> Vector:
        if np.shape(vector) != (len(self.names),):
            raise ValueError(
                f"vector has the shape {np.shape(vector)}, this takes ({len(self.names)},), a"
                f" number for each of {', '.join(self.names)}: use jax.vmap for several"
            )
        return self.coordinates.theta(vector)

    def _card(self) -> Card:
        heading = f"{len(self.names)} free parameters of {type(self.base).__name__}"
        return self.coordinates.card(heading)


def free(
    task: AbstractTask,
    names: Iterable[str] | None = None,
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> Free:
    """Some parameters of a task as a vector without bounds, and back.

        free = jm.objective.free(jm.Isometric(), ["k_w", "noise_K_w"])
        task = free.task(free.start + 0.1)
        free.vector(task)  # 0.1, 0.1

    A step of 1 is about one standard deviation of the prior in every direction. So optax, samplers
    and plain gradient descent can move the vector as it is: stiffnesses of 10⁵ and amplitudes of
    10⁻³ are of one size, and stay positive. `jaxmuscle.fits.problem` does the same with a target.

    **Arguments:**

    - `task`: numbers, not traced by JAX
    - `names` of its parameters; by default those that a fit lets free
    - `bounds`: `{name: (low, high)}` in the parameter's unit, instead of those in the parameter
      table

    **Returns:** a `Free`, with `names`, `start`, `task(vector)`, `vector(task)`,
    `parameters(vector)` and `log_prior(vector)`.

    **Raises:** `ValueError` for an unknown name, bounds of what is not free, a value outside its
    bounds, and a positive parameter that is 0.
    """
    require_task(task, "free(task)")
    require(
        all_concrete(task),
        "task: JAX is tracing it (inside jit, grad or vmap), but its values decide what is free."
        " Call free outside; its methods may be traced",
    )
    check_named(names, None, bounds, None)
    names = usually_free(task) if names is None else tuple(dict.fromkeys(proper_names(names) or ()))
    check_names("free", names, task.parameter_names)
    given = proper_values(bounds)
    check_names("bounds", given, names)
    sds = {name: PARAMETERS[name].prior_sd if name in PARAMETERS else 1.0 for name in names}
    values = {name: float(task[name]) for name in names}
    coordinates = Coordinates.of(values, tremor_bounds(task, names) | given, sds)
    return Free(as_numbers(task), coordinates)
