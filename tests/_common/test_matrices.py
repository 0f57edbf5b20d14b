"""Exponentials of small matrices, against SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from compiled import at_once

from jaxmuscle._common.matrices import exponential, product


@pytest.mark.parametrize("size", [1e-8, 1e-3, 0.3, 10.0, 1e3, 1e5])
@pytest.mark.parametrize("states", [1, 2, 5])
def test_exponential(x64, size, states):
    """Of systems that decay at rates from `size` down to a thousandth of it; its derivative is
    Fréchet's."""
    rng = np.random.default_rng(states)
    turn = np.linalg.qr(rng.normal(size=(states, states)))[0]
    rates = -size * np.geomspace(1.0, 1e-3, states)
    matrix, direction = turn * rates @ turn.T, size * rng.normal(size=(states, states))
    known = turn * np.exp(rates) @ turn.T
    found, slope = at_once(lambda x, along: jax.jvp(exponential, (x,), (along,)), matrix, direction)
    # Rounding of the rates: the largest times half a unit of the last place.
    np.testing.assert_allclose(found, known, rtol=0, atol=1e-15 * (10 + size))
    frechet = scipy.linalg.expm_frechet(matrix, direction, compute_expm=False)
    np.testing.assert_allclose(
        slope, frechet, rtol=0, atol=1e-13 * max(1.0, size) * np.abs(direction).max()
    )
    np.testing.assert_allclose(found, scipy.linalg.expm(matrix), rtol=0, atol=1e-15 * (10 + size))


def test_exponential_of_many_complex_matrices_in_single_precision():
    rng = np.random.default_rng(0)
    matrices = (
        rng.normal(size=(3, 4, 4)) + 1j * rng.normal(size=(3, 4, 4)) - 3 * np.eye(4)
    ).astype(np.complex64)
    found = exponential(jnp.asarray(matrices))
    assert found.dtype == jnp.complex64
    np.testing.assert_allclose(
        found, scipy.linalg.expm(matrices.astype(complex)), rtol=0, atol=2e-6
    )


def test_product():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(3, 2)), rng.normal(size=(5, 2, 4))
    np.testing.assert_allclose(product(jnp.asarray(a), jnp.asarray(b)), a @ b, rtol=1e-6, atol=1e-6)
