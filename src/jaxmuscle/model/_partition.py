"""A task as the values of some of its parameters, which JAX differentiates and an optimiser moves,
and the rest."""

from collections.abc import Callable, Iterable, Mapping

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle._common.types import Scalar

from ._tasks import AbstractTask

Values = dict[str, Float[Array, "..."]]


def partition(
    task: AbstractTask, names: Iterable[str]
) -> tuple[Values, Callable[[Mapping[str, Scalar]], AbstractTask]]:
    """The named parameters of a task as arrays, and the function that puts such values into the
    task.

        values, rebuild = partition(task, ("k_w", "c_w"))
        jax.grad(lambda v: loss(rebuild(v)))(values)        # a slope for every name

    Use it to move some parameters and to keep the others. `values` are arrays of JAX's default
    precision, in their natural units: any optimiser of pytrees (optax, optimistix) can move them.
    (`jax.grad` and `equinox.filter_grad` take a task as it is, and give a slope for every number of
    it. `jaxmuscle.objective.free` makes a vector without bounds of some.)

    **Arguments:** `task`; `names` of its parameters (`task.parameter_names` are all).

    **Returns:** `values`, {name: array of shape ()}, and `rebuild`. `rebuild(values)` is
    `task.replace(**values)`: what `values` does not name stays as it is in the task, and values are
    checked where they are not traced.

    **Raises:** `ValueError` for a name that the task does not have, and for one text instead of
    several names.
    """
    if isinstance(names, str):
        raise ValueError(f"names = {names!r} is one text: give a list of names, [{names!r}]")
    values = {name: jnp.asarray(task[name], jnp.result_type(float)) for name in names}
    return values, lambda moved: task.replace(**moved)
