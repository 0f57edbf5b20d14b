"""Sampling with a low-pass against aliases: the decimation of scipy."""

import jax
import numpy as np
import pytest
import scipy.signal

from jaxmuscle.spectra._decimation import FINER, anti_alias, at_every, decimated


@pytest.mark.parametrize("every, samples", [(4, 601), (10, 1501), (10, 1494), (2, 30)])
def test_decimation_is_that_of_scipy(x64, every, samples):
    """At the ends, too: a drift on a large mean, in two rows."""
    x = 50.0 + np.cumsum(np.random.default_rng(every).normal(size=(2, samples)), axis=1)
    expected = scipy.signal.resample_poly(x, 1, every, axis=1, padtype="line")
    np.testing.assert_allclose(decimated(x, every), expected, rtol=1e-12)
    np.testing.assert_array_equal(at_every(x, every, "filtered"), decimated(x, every))
    np.testing.assert_array_equal(at_every(x, every, "instant"), x[:, ::every])
    np.testing.assert_array_equal(at_every(x, 1, "filtered"), x)


def test_single_precision_keeps_the_digits_of_the_fluctuations():
    x = 50.0 + np.random.default_rng(0).normal(size=2001)
    rounded = decimated(x.astype(np.float32), 10)
    assert rounded.dtype == np.float32
    np.testing.assert_allclose(
        rounded, scipy.signal.resample_poly(x, 1, 10, padtype="line"), atol=4 * 50.0 * 6e-8
    )


def test_gradients_are_those_of_a_linear_map(x64):
    x = np.random.default_rng(1).normal(size=81)
    forward, reverse = (of(lambda x: decimated(x, 4))(x) for of in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, atol=1e-15)
    np.testing.assert_allclose(forward @ x, decimated(x, 4), atol=1e-14)


def test_what_passes():
    """In the analysed band all of it; half of the amplitude at half the rate; little of what would
    come back below 42 Hz."""
    f, gain = scipy.signal.freqz(anti_alias(FINER), fs=100.0 * FINER, worN=8000)
    gain = np.abs(gain)
    assert np.all(np.abs(gain[f < 40] - 1) < 0.006) and np.all(gain[f > 60] < 0.004)
    assert np.interp(50.0, f, gain) == pytest.approx(0.5, abs=1e-3)
