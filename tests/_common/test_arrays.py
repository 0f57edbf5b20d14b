"""Numbers as inexact arrays."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxmuscle._common.arrays import as_inexact


class Law(eqx.Module):
    k: float

    def __call__(self, q):
        return self.k * q


def test_whole_numbers_become_floats_and_all_else_stays():
    for value in (3, 3.0, np.int64(3), np.float32(3), np.array(3)):
        assert type(as_inexact(value)) is np.float64 and as_inexact(value) == 3.0
    for make in (np.array, jnp.asarray):
        assert as_inexact(make([1, 2])).dtype == make([1.0]).dtype
        own = make([0.5], dtype="float32")
        assert as_inexact(own) is own
    for other in (True, "three", None, float, Law(1.0)):
        assert as_inexact(other) is other


def test_a_function_becomes_a_tree_without_leaves():
    found = as_inexact(jnp.sin)
    assert not jax.tree.leaves(found) and found(0.0) == 0.0
    assert jax.tree.structure(found) == jax.tree.structure(as_inexact(jnp.sin))
    assert jax.tree.structure(found) != jax.tree.structure(as_inexact(jnp.cos))
