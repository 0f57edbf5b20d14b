"""Metrics against their definitions, written a second time and slowly, and against analytic
values."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from scipy.special import erf

from jaxmuscle.spectra._measures import (
    approximate_entropy,
    coefficient_of_variation,
    peak_frequency,
    peaks,
    sample_entropy,
)
from jaxmuscle.spectra._settings import SpectrumSettings
from jaxmuscle.spectra._welch import Spectrum, spectrum_of

RNG = np.random.default_rng(0)
RECORDS = {
    "noise": RNG.standard_normal(200),
    "walk": 10 + 0.01 * RNG.standard_normal(300).cumsum(),
    "sine": np.sin(np.arange(250) / 5),
    "coarse": np.round(2 * RNG.standard_normal(150)),
}


@pytest.fixture
def user_view():
    """As a user runs it: without the run-time type check, which would see a wrong argument
    first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def matching(x, i, j, m, radius):
    return all(abs(x[i + k] - x[j + k]) <= radius for k in range(m))


def slow_approximate_entropy(x, m, tolerance):
    def phi(m):
        n = len(x) - m + 1
        radius = tolerance * np.std(x)
        return (
            sum(np.log(sum(matching(x, i, j, m, radius) for j in range(n)) / n) for i in range(n))
            / n
        )

    return phi(m) - phi(m + 1)


def slow_sample_entropy(x, m, tolerance):
    n, radius = len(x) - m, tolerance * np.std(x)
    pairs = [(i, j) for i in range(n) for j in range(n) if i != j]
    b, a = (sum(matching(x, i, j, length, radius) for i, j in pairs) for length in (m, m + 1))
    return np.log(b / a)


@pytest.mark.parametrize("name", RECORDS)
@pytest.mark.parametrize("m, tolerance", [(1, 0.3), (2, 0.2), (3, 0.5)])
def test_entropies_are_their_definitions(name, m, tolerance):
    x = RECORDS[name]
    expected = slow_approximate_entropy(x, m, tolerance)
    assert approximate_entropy(x, m, tolerance) == pytest.approx(expected, abs=1e-12)
    expected = slow_sample_entropy(x, m, tolerance)
    assert sample_entropy(x, m, tolerance) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("name", RECORDS)
def test_entropies_are_those_of_antropy(name):
    import antropy  # takes 7 s: not in every worker

    x = RECORDS[name]
    assert approximate_entropy(x) == pytest.approx(antropy.app_entropy(x), abs=1e-10)
    assert sample_entropy(x) == pytest.approx(antropy.sample_entropy(x), abs=1e-10)


def test_sample_entropy_of_white_noise():
    """Independent normal samples match with probability erf(r/2), so SampEn = -ln erf(r/2), for r
    in σ."""
    values = [
        sample_entropy(np.random.default_rng(seed).standard_normal(2000)) for seed in range(60)
    ]
    standard_error = np.std(values, ddof=1) / np.sqrt(len(values))
    assert standard_error < 0.02
    assert abs(np.mean(values) + np.log(erf(0.1))) < 4 * standard_error


def test_entropy_of_ten_thousand_samples_is_near_that_of_its_parts():
    x = np.random.default_rng(1).standard_normal(10_000)
    assert sample_entropy(x) == pytest.approx(-np.log(erf(0.1)), rel=0.05)
    sine = np.sin(np.arange(10_000) / 50)
    assert 0 < approximate_entropy(sine) < 0.1 < 2 < approximate_entropy(x)


def test_entropy_does_not_depend_on_unit_or_offset():
    x = RECORDS["walk"]
    assert approximate_entropy(1000 * x - 3) == pytest.approx(approximate_entropy(x), abs=1e-9)
    assert sample_entropy(1000 * x - 3) == pytest.approx(sample_entropy(x), abs=1e-9)


def test_entropy_without_matches():
    assert sample_entropy(np.array([0.0, 1.0, 0.0, 2.0]), m=1, tolerance=0.1) == float("inf")
    assert np.isnan(sample_entropy(2.0 ** np.arange(8), tolerance=1e-6))


@pytest.mark.parametrize("entropy", [approximate_entropy, sample_entropy])
def test_entropy_needs_a_proper_record(user_view, entropy):
    x = RECORDS["noise"]
    for signal, message in (
        (np.ones(50), "not constant"),
        (x[:3], "m [+] 2 = 4"),
        (x.reshape(2, -1), "one record"),
        (np.where(x > 2, np.nan, x), "not finite"),
    ):
        with pytest.raises(ValueError, match=message):
            entropy(signal)
    with pytest.raises(ValueError, match="m=0"):
        entropy(x, m=0)
    for tolerance in (0.0, -0.2, float("nan")):
        with pytest.raises(ValueError, match="tolerance="):
            entropy(x, tolerance=tolerance)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_coefficient_of_variation(x64, dtype):
    force = (-10 + 0.1 * RNG.standard_normal((3, 500))).astype(dtype)
    mean, deviation = force.astype(float).mean(-1), force.astype(float).std(-1)
    # float32 samples near 10 hold the deviation of 0.1 to about 1e-5.
    rtol = 1e-5 if dtype == np.float32 else 1e-12
    variation = coefficient_of_variation(force)
    assert variation.dtype == dtype
    np.testing.assert_allclose(variation, deviation / abs(mean), rtol=rtol)


def test_derivatives_agree(x64):
    signal, metric = jnp.asarray(5 + RNG.standard_normal(20)), coefficient_of_variation
    forward, reverse = jax.jacfwd(metric)(signal), jax.jacrev(metric)(signal)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-14)
    h = 1e-5
    steps = h * np.eye(20)
    differences = np.array([(metric(signal + e) - metric(signal - e)) / (2 * h) for e in steps])
    # Central differences: truncation of order h² = 1e-10, rounding of order 1e-15 / h = 1e-10.
    np.testing.assert_allclose(forward, differences, atol=1e-9)


def test_constant_and_centred_signals(x64):
    constant = jnp.full(8, 3.0)
    assert coefficient_of_variation(constant) == 0
    assert np.all(jax.grad(coefficient_of_variation)(constant) == 0)
    assert coefficient_of_variation(jnp.asarray([-1.0, 1.0])) == np.inf


def spectrum(power, settings=None):
    settings = settings or SpectrumSettings(last_bin=len(power))
    return Spectrum(settings.frequency, np.asarray(power, dtype=float), settings)


def test_peaks_of_a_handmade_spectrum(x64):
    found = peaks(spectrum([10, 4, 2, 3, 1, 6, 1, 2, 1]))  # sum 30
    assert found.maximum.bin == 1
    assert found.maximum.frequency == found.maximum.interpolated == 100 / 256
    assert found.maximum.power == pytest.approx(10 / 30)
    assert found.maximum.prominence == pytest.approx(9 / 30)
    assert [peak.bin for peak in found.local_maxima] == [4, 6, 8]
    np.testing.assert_allclose([30 * peak.prominence for peak in found.local_maxima], [1, 5, 1])
    found = peaks(spectrum([10, 4, 2, 3, 1, 6, 1, 2, 1]), min_prominence=0.2)
    assert [peak.bin for peak in found.local_maxima] == [6]


def test_an_interior_maximum_is_a_local_maximum(x64):
    found = peaks(spectrum([2, 3, 1, 5, 1]))
    assert found.maximum == found.local_maxima[1]
    assert found.maximum.prominence == pytest.approx(4 / 12)


def test_interpolation_is_exact_for_a_gaussian(x64):
    settings = SpectrumSettings(first_bin=3)
    found = peaks(spectrum(np.exp(-(((settings.frequency - 4.251) / 0.8) ** 2)), settings))
    assert found.maximum.bin == 11
    assert found.maximum.frequency == pytest.approx(11 * 100 / 256)
    assert found.maximum.interpolated == pytest.approx(4.251, abs=1e-9)


@pytest.mark.parametrize("hertz", [4.251, 1.24, 7.0])
def test_interpolation_finds_a_sine(x64, hertz):
    """The log of a Hann main lobe is a parabola to within 0.02 bins; the bin itself is up to half a
    bin away."""
    settings = SpectrumSettings(filter_cutoff=None)
    sine = np.sin(2 * np.pi * hertz * np.arange(1500) / 100)
    peak = peaks(spectrum_of(sine, settings)).maximum
    assert peak.frequency == pytest.approx(hertz, abs=settings.resolution / 2)
    assert peak.interpolated == pytest.approx(hertz, abs=0.02 * settings.resolution)


def test_peaks_need_one_spectrum(user_view):
    for power, message in (
        (np.ones((2, 5)), "mean()"),
        (np.ones(2), "3 bins"),
        (np.zeros(5), "not all zero"),
        ([1.0, np.nan, 1.0], "finite"),
    ):
        with pytest.raises(ValueError, match=message):
            peaks(Spectrum(np.arange(np.shape(power)[-1]), np.asarray(power), SpectrumSettings()))
    with pytest.raises(ValueError, match="min_prominence=2"):
        peaks(spectrum([1, 2, 1]), min_prominence=2)


def test_peak_frequency_is_the_interpolated_maximum_of_peaks(x64):
    power = RNG.gamma(3.0, size=(4, 3, 30))
    found = peak_frequency((SpectrumSettings().frequency, power))
    assert found.shape == (4, 3)
    for i in np.ndindex(4, 3):
        assert found[i] == pytest.approx(peaks(spectrum(power[i])).maximum.interpolated, rel=1e-12)
    many = spectrum(power[0], SpectrumSettings())
    np.testing.assert_array_equal(peak_frequency(many), found[0])
    mapped = jax.jit(jax.vmap(lambda p: peak_frequency((SpectrumSettings().frequency, p))))
    np.testing.assert_allclose(mapped(power), found, rtol=1e-12)


def test_peak_frequency_in_a_band_and_at_its_ends(x64):
    """The largest bin itself where its peak lies beyond; NaN where there is one."""
    f, p = np.arange(1.0, 10.0), np.array([10.0, 4, 2, 3, 1, 6, 1, 2, 1])
    assert peak_frequency((f, p)) == 1.0
    assert peak_frequency((f, p), 2.0) == 6.0  # symmetric
    assert peak_frequency((f, p), 2.0, 3.0) == 2.0  # falls from 1 Hz on
    assert 3.5 < peak_frequency((f, p), 3.0, 5.0) < 4.5
    assert peak_frequency((f, np.where(p == 3, 0.0, p)), 3.0, 4.0) == 3.0
    assert peak_frequency((f, np.array([1.0, 2, 2, 1, 1, 1, 1, 1, 1]))) == 2.5
    assert peak_frequency((f, np.where(p == 6, 7.0, 0.0))) == 6.0
    assert peak_frequency((f, np.ones(9))) == 1.0
    assert np.isnan(peak_frequency((f, np.where(p == 6, np.nan, p))))


def test_slopes_of_the_peak_frequency_are_those_of_differences(x64):
    """Forward as in reverse; 0 at an end, and finite where a power is 0."""
    f, p = np.arange(1.0, 6.0), np.array([1.0, 3.0, 5.0, 4.0, 0.0])

    def at(p):
        return peak_frequency((f, p))

    forward, reverse = jax.jit(lambda p: (jax.jacfwd(at)(p), jax.grad(at)(p)))(p)
    h = 1e-5
    wanted = [float(at(p + h * e) - at(p - h * e)) / (2 * h) for e in np.eye(5)[:4]]
    np.testing.assert_allclose(reverse, [*wanted, 0.0], atol=1e-9)
    np.testing.assert_allclose(forward, reverse, rtol=1e-12)
    assert np.all(np.asarray(wanted)[1:] != 0)
    assert not np.any(jax.jit(jax.grad(at))(p[::-1] * np.array([0.0, 1, 1, 1, 9])))


def test_peak_frequency_needs_bins(user_view):
    f = np.arange(1.0, 10.0)
    for given, message in (
        ((f, np.ones(8)), "equally many"),
        ((f[:2], np.ones(2)), "3 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            peak_frequency(given)
    with pytest.raises(ValueError, match="a band that holds a bin; they reach from 1 to 9 Hz"):
        peak_frequency((f, f), 2.2, 2.8)


def test_traced_peaks_are_refused_with_a_remedy():
    with pytest.raises(
        ValueError, match=r"JAX is tracing it .* jaxmuscle\.spectra\.peak_frequency"
    ):
        jax.jit(lambda p: peaks(Spectrum(np.arange(3.0), p, SpectrumSettings())))(jnp.ones(3))
