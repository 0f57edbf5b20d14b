"""Trees of numbers: as arrays, as plain numbers, concrete or traced."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer


def all_concrete(tree: Any) -> bool:
    """Whether a tree holds numbers, not tracers."""
    return all(is_concrete(leaf) for leaf in jax.tree.leaves(tree))


def is_concrete(value: Any) -> bool:
    """Whether a value can be looked at, that is, no JAX transformation is tracing it."""
    return not isinstance(value, Tracer)


def numpy_unless_traced(value: Any) -> Any:
    """A NumPy array, or the value as it is while JAX traces it."""
    return np.asarray(value) if is_concrete(value) else value


def require(condition: Any, message: str) -> None:
    """Raise a `ValueError` unless the condition holds; a traced condition is let through."""
    if is_concrete(condition) and not np.all(np.asarray(condition)):
        raise ValueError(message)


def checked(tree: Any) -> Any:
    """Run every `__check_init__` in a tree of modules, as its constructors would; returns the
    tree."""
    for node in jax.tree.leaves(
        tree, is_leaf=lambda x: isinstance(x, eqx.Module) and x is not tree
    ):
        if isinstance(node, eqx.Module):
            checked(node)
    check = getattr(type(tree), "__check_init__", None)
    if check is not None:
        check(tree)
    return tree


def _is_scalar(value: Any) -> bool:
    return not isinstance(value, bool | str) and isinstance(
        value, float | int | np.ndarray | jax.Array | np.generic
    )


def as_arrays(tree: Any, dtype: Any = None) -> Any:
    """Every number of a tree as an array of the caller's floating dtype, so that jit traces it."""
    dtype = jax.numpy.result_type(float) if dtype is None else dtype

    def array(leaf):
        # NumPy's arrays reach a jitted function ten times faster than JAX's own are made.
        make = jax.numpy.asarray if isinstance(leaf, jax.Array) else np.asarray
        return make(leaf, dtype=dtype) if _is_scalar(leaf) else leaf

    return jax.tree.map(array, tree)


def as_doubles(tree: Any) -> Any:
    """`as_arrays` in double precision; of concrete numbers they are concrete even where a function
    is traced.

    What is compiled of them belongs outside `ensure_compile_time_eval`: in it every operation on
    constants that is traced would be compiled by itself.
    """
    with jax.ensure_compile_time_eval(), jax.enable_x64(True):
        return as_arrays(tree)


def as_numbers(tree: Any) -> Any:
    """The reverse of `as_arrays`: NumPy's floats and arrays, exact in either precision."""

    def number(leaf):
        if not _is_scalar(leaf):
            return leaf
        return np.float64(leaf) if np.ndim(leaf) == 0 else np.asarray(leaf, dtype=float)

    return jax.tree.map(number, tree)


def as_inexact(value: Any) -> Any:
    """A number as NumPy's float, whole numbers of an array as floats, a function (a network holds
    some) as a tree without leaves; anything else as it is.

    Of a Python float JAX makes a weak type, which the sum with a gradient has not: the second step
    of a training would be compiled anew. And `equinox.is_inexact_array` does not see it.
    """
    if not _is_scalar(value):
        function = callable(value) and not isinstance(value, type | eqx.Module)
        return jax.tree_util.Partial(value) if function else value
    if isinstance(value, jax.Array):
        whole = jax.numpy.issubdtype(value.dtype, jax.numpy.integer)
        return value.astype(jax.numpy.result_type(float)) if whole else value
    if np.ndim(value) == 0:
        return np.float64(value)
    return value.astype(float) if np.issubdtype(value.dtype, np.integer) else value


class Inexact(eqx.Module):
    """A module whose leaves are inexact arrays, also those of a class that a user derives from it:
    `equinox.filter_grad`, `equinox.partition` and optax see all of its numbers, and `jax.grad`
    takes it as it is."""

    def __check_init__(self):
        for field in dataclasses.fields(self):
            if not field.metadata.get("static", False):
                value = jax.tree.map(
                    as_inexact, getattr(self, field.name), is_leaf=lambda x: isinstance(x, Inexact)
                )
                object.__setattr__(self, field.name, value)


def with_nulls(values: Any) -> Any:
    """A number, or an array as a flat list, for JSON: it has no word for what is not finite, so
    None there."""
    if values is None or isinstance(values, bool | int | str):
        return values
    if isinstance(values, float):
        return values if math.isfinite(values) else None
    return [float(v) if np.isfinite(v) else None for v in np.ravel(values)]


def from_nulls(values: list[Any] | None) -> Any:
    """The array of a list that `with_nulls` made; None if there is none."""
    return (
        None
        if values is None
        else np.array([np.nan if v is None else v for v in values], dtype=float)
    )
