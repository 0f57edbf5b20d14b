"""The law of Welch bins and the likelihoods: against simulation, closed forms, scipy and finite
differences."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from compiled import at_once
from scipy.special import digamma, gammaln

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._covariance import residual_covariance
from jaxmuscle.objective._likelihood import (
    _gamma_level,
    likeliest_offset,
    log_density,
    log_marginal,
    measured_bins,
)
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import target_variation
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.spectra._bin_law import bin_rows, trial_samples, welch_law
from jaxmuscle.spectra._settings import WINDOW

SEGMENTS = 6


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@functools.cache
def white_powers(count=20_000):
    """Welch powers of white noise by scipy, bins 1 to 30."""
    rng = np.random.default_rng(5)
    settings = jm.SpectrumSettings()
    samples = settings.length + (SEGMENTS - 1) * settings.step
    return scipy.signal.welch(rng.normal(size=(count, samples)), 100.0, nperseg=256)[1][:, 1:31]


def test_law_of_welch_bins_is_that_of_scipys_spectra_of_white_noise():
    settings = jm.SpectrumSettings()
    law = welch_law(settings, np.arange(1, 31), (SEGMENTS,))
    powers = white_powers()
    degrees = 2 * powers.mean(0) ** 2 / powers.var(0)
    # relative standard error of a variance of a gamma variable of shape ν/2: √((2 + 12/ν) / n); of
    # 30 bins, 5 of them
    bound = 5 * np.sqrt((2 + 12 / law.degrees) / len(powers))
    assert np.all(np.abs(degrees / law.degrees - 1) < bound)
    assert law.degrees[0] < 0.85 * law.degrees[5]  # detrending and negative frequencies
    found = np.corrcoef(powers.T)
    assert np.all(np.abs(found - law.correlation) < 5 / np.sqrt(len(powers)) + 0.01)
    assert law.degrees[5] == pytest.approx(settings.degrees_of_freedom(SEGMENTS), rel=1e-6)


def test_trials_add_their_degrees_of_freedom():
    settings, bins = jm.SpectrumSettings(), np.arange(1, 31)
    one, two = welch_law(settings, bins, (6,)), welch_law(settings, bins, (6, 6))
    np.testing.assert_allclose(two.degrees, 2 * one.degrees)
    np.testing.assert_allclose(two.correlation, one.correlation, atol=1e-12)


def test_a_mean_of_seeds_without_control_scatters_as_that_of_so_many_spectra():
    """Over the ten seconds that a fit simulates there is room for `SEGMENTS`. With a control
    variate nothing scatters."""
    assert SEGMENTS == (1000 - 256) // 128 + 1
    target = jm.Target("white", np.ones(30), segments=SEGMENTS)
    problem = planned(jm.Isometric(), target, FitOptions(free=("c_w",))).problem
    plain, controlled = (
        dataclasses.replace(problem, control=c).montecarlo(8).parts[0] for c in (False, True)
    )
    data, none = problem.linear().parts[0], np.zeros(30)
    np.testing.assert_array_equal(
        residual_covariance(target, controlled, none), residual_covariance(target, data, none)
    )
    simulated = residual_covariance(target, plain, none) - residual_covariance(target, data, none)
    logs = np.log(white_powers().reshape(-1, 8, 30).mean(axis=1))
    rows = (logs - logs.mean(axis=1, keepdims=True)) / data.statistics.sd
    found, variance = np.cov(rows.T), np.diag(simulated)
    # 465 different entries; that the bins' law is approximate moves a correlation by up to 0.01
    scale, correlation = (
        np.sqrt(np.outer(variance, variance)),
        simulated / np.sqrt(np.outer(variance, variance)),
    )
    assert np.all(
        np.abs(found / scale - correlation) < 5 * np.sqrt((1 + correlation**2) / len(rows)) + 0.01
    )


def independent(bins):
    return bins._replace(precision=np.eye(30), logdet=np.zeros(()))


def test_without_correlation_the_density_of_proportional_powers_is_a_closed_form():
    """∫ Π gamma(T p; a, E/a) T^(n-1) dT = Γ(Σa) Π a^a p^(a-1) / (Γ(a) E^a) / (Σ a p / E)^Σa."""
    target = jm.load_target("vastus-lateralis-26mvc")
    bins = independent(measured_bins(target))
    E = np.asarray(jm.expected_spectrum(target.task()).power)
    a, p = np.asarray(bins.half), np.exp(bins.log_power)
    expected = np.sum(a * np.log(a) - gammaln(a) + (a - 1) * np.log(p) - a * np.log(E))
    expected += gammaln(a.sum()) - a.sum() * np.log(np.sum(a * p / E))
    found = log_marginal(jax.tree.map(jnp.asarray, bins), jnp.asarray(E), jnp.zeros(30))
    assert float(found) == pytest.approx(expected, abs=1e-6)


def test_gamma_level():
    a = np.geomspace(0.5, 1e4, 200)
    level, slope = _gamma_level(jnp.asarray(a))
    np.testing.assert_allclose(level, a * np.log(a) - gammaln(a), rtol=1e-12, atol=2e-7)
    np.testing.assert_allclose(slope, np.log(a) + 1 - digamma(a), rtol=1e-12, atol=2e-6)


def test_slopes_by_hand_are_those_of_differences():
    """With a line that fills some bins, one beyond the share that still scatters, and bins that are
    left out."""
    target = jm.load_target("vastus-lateralis-26mvc")
    bins = measured_bins(target, mask=np.arange(30) % 7 > 0)
    noise = np.asarray(jm.expected_spectrum(target.task()).power)
    line = noise * np.geomspace(1e-3, 1e2, 30)
    line[3] = 1e5 * noise[3]

    def height(at):
        return log_density(bins, at[:30], at[30:60], at[60])

    at, steps = np.r_[noise + line, line, 0.1], 1e-4 * np.r_[noise, noise, 1.0]
    # The density is -1e6 here: of a smaller step, rounding would be seen.
    around = at + np.concatenate([np.diag(steps), -np.diag(steps)])
    slopes, heights = at_once(
        lambda at, around: (jax.grad(height)(at), jax.lax.map(height, around)), at, around
    )
    ahead, behind = np.split(np.asarray(heights), 2)
    np.testing.assert_allclose(slopes, (ahead - behind) / (2 * steps), rtol=1e-5, atol=1e-6)


def test_scale_of_the_model_does_not_count():
    bins = jax.tree.map(jnp.asarray, measured_bins(jm.load_target("vastus-lateralis-26mvc")))
    E, line = jnp.linspace(1.0, 0.01, 30), jnp.zeros(30).at[10].set(0.3)
    heights = [float(log_marginal(bins, c * E, c * line)) for c in (1.0, 1e-6)]
    assert heights[0] == pytest.approx(heights[1], rel=1e-12)


def test_offset_is_the_likeliest():
    bins = jax.tree.map(jnp.asarray, measured_bins(jm.load_target("fdi-abduction-45mvc")))
    E, line = jnp.linspace(1.0, 0.01, 30), jnp.zeros(30)
    u = at_once(lambda E, line: likeliest_offset(bins, E, line)[0], E, line)
    grid = np.linspace(float(u) - 1, float(u) + 1, 2001)
    heights = at_once(jax.vmap(lambda v: log_density(bins, E, line, v)), grid)
    assert abs(grid[int(np.argmax(heights))] - float(u)) < 1.1e-3


def test_bins_left_out_do_not_count():
    target = jm.load_target("vastus-lateralis-26mvc")
    mask = np.ones(30)
    mask[[3, 4, 20]] = 0
    bins = measured_bins(target, mask)
    moved = bins._replace(log_power=bins.log_power + 0.0)
    moved.log_power[[3, 20]] += 1.0
    E = jnp.linspace(1.0, 0.01, 30)
    first, second = (
        log_marginal(jax.tree.map(jnp.asarray, b), E, jnp.zeros(30)) for b in (bins, moved)
    )
    assert float(first) == pytest.approx(float(second), rel=1e-10)


SHAPES = {
    "tilt": np.linspace(-1, 1, 30),
    "curve": np.cos(2 * np.pi * np.arange(30) / 30),
    "first bins": np.exp(-np.arange(30) / 2),
    "one bin": 1.0 * (np.arange(30) == 10),
    "two bins": 1.0 * np.isin(np.arange(30), [10, 11]),
}


@pytest.mark.parametrize("shape", SHAPES)
def test_score_and_information(shape):
    """At the truth the score has mean zero and the Fisher information as variance, over scipy's
    spectra of white noise."""
    scores = _scores() @ SHAPES[shape]
    assert abs(scores.mean()) < 4 * scores.std() / np.sqrt(len(scores))
    bins = measured_bins(jm.Target("white", np.ones(30), segments=SEGMENTS))
    information = SHAPES[shape] @ bins_information(bins) @ SHAPES[shape]
    # the copula is an approximation, and so is 1/ν for the variance of a logarithm
    assert scores.var() == pytest.approx(information, rel=0.1)


@functools.cache
def _scores():
    bins = jax.tree.map(
        jnp.asarray, measured_bins(jm.Target("white", np.ones(30), segments=SEGMENTS))
    )
    powers = white_powers()[:4000]
    shares = jnp.log(jnp.asarray(powers / powers.sum(axis=1, keepdims=True)))
    truth = jnp.log(jnp.asarray(np.sum(np.abs(bin_rows(jm.SpectrumSettings())) ** 2, axis=(1, 2))))

    def slope(log_power):
        return jax.grad(
            lambda e: log_marginal(bins._replace(log_power=log_power), jnp.exp(e), jnp.zeros(30))
        )(truth)

    return np.asarray(at_once(jax.vmap(slope), shares))


def bins_information(bins):
    """Fisher information of the log powers with the offset eliminated."""
    w = np.sqrt(np.asarray(bins.half))
    whole = w[:, None] * np.asarray(bins.precision) * w
    ones = whole.sum(axis=1)
    return whole - np.outer(ones, ones) / ones.sum()


@functools.cache
def recording():
    seconds = 60.0
    runs = jm.ensemble(
        jm.Isometric().settled(), jax.random.key(3), seeds=1, duration=5 + seconds, control=False
    )
    return jm.Recording(np.asarray(runs.output[0]), 100, window=(5, 5 + seconds))


def test_a_coefficient_of_variation_adds_its_gaussian_density():
    target = jm.load_target("vastus-lateralis-26mvc")
    bare = jm.Target("the spectrum", target.proportional_power, segments=target.segments)
    task = jm.Isometric(settings=bare.settings).settled()
    moments = expected_moments(as_arrays(task), bare.settings, WINDOW, trial_samples(bare))[0]
    for measured in (0.01, 0.03):
        data = jm.Target(
            "both",
            target.proportional_power,
            segments=target.segments,
            coefficient_of_variation=measured,
        )
        logs, sd = target_variation(data, task)
        density = scipy.stats.norm.logpdf(
            np.log(moments.variation), np.log(measured), sd
        ) + 0.5 * np.log(2 * np.pi)
        assert logs == pytest.approx(np.log(measured))
        assert float(
            jm.objective.log_likelihood(task, data) - jm.objective.log_likelihood(task, bare)
        ) == pytest.approx(density, rel=1e-6)


def test_a_dynamic_stiffness_adds_the_gaussian_density_of_its_parts(x64):
    """Real and imaginary part are independent, each of the standard deviation that is stated."""
    f, task = np.array([0.5, 1.0, 2.0, 5.0]), jm.PrescribedLength()
    true = np.asarray(jm.response.dynamic_stiffness(task, f))
    sd = np.array([0.02, 0.05, 0.1, 0.03]) * np.abs(true)
    measured = true + sd * np.array([1.0 - 0.5j, -2.0 + 1.5j, 0.3j, 0.7])
    figure = jm.data.FrequencyResponse(f, measured, sd)
    density = scipy.stats.norm.logpdf([(measured - true).real, (measured - true).imag], scale=sd)
    expected = density.sum() + f.size * np.log(2 * np.pi)
    found = jm.objective.log_likelihood(task, jm.Target("figure", None, stiffness=figure))
    assert float(found) == pytest.approx(expected, rel=1e-9)


@pytest.mark.slow
def test_whittle_is_the_law_of_a_periodogram():
    """With a line: scipy's noncentral chi-squared density of 2 I / N with noncentrality 2 L / N."""
    data = recording()
    task = jm.Isometric().replace(harmonic_amplitude=0.01)
    spectrum = data.fft_spectrum(task.settings.replace(window="boxcar"))
    moments = expected_moments(as_arrays(task), spectrum.settings, (0.0, 60.0))[0]
    line, noise = np.asarray(moments.line), np.asarray(moments.power - moments.line)
    density = scipy.stats.ncx2.logpdf(
        2 * np.asarray(spectrum.power) / noise, 2, 2 * line / noise
    ) + np.log(2 / noise)
    assert float(jm.objective.log_likelihood(task, data)) == pytest.approx(density.sum(), rel=1e-9)
    quiet = task.replace(harmonic_amplitude=0.0)
    expected = np.asarray(
        jm.expected_spectrum(quiet.settled(), spectrum.settings, (0.0, 60.0)).power
    )
    plain = -np.sum(np.log(expected) + np.asarray(spectrum.power) / expected)
    assert float(jm.objective.log_likelihood(quiet, data)) == pytest.approx(plain, rel=1e-9)


@pytest.mark.parametrize("name", ["vastus-lateralis-26mvc", "recording"])
def test_likelihoods_are_differentiable(name):
    data = recording() if name == "recording" else jm.load_target(name)

    def height(c_w):
        return jm.objective.log_likelihood(jm.Isometric().replace(c_w=c_w), data)

    step = 1e-3
    heights, slopes = at_once(
        lambda at: jax.lax.map(jax.value_and_grad(height), at), 60 + step * np.arange(-1.0, 2.0)
    )
    assert float(slopes[1]) == pytest.approx(float(heights[2] - heights[0]) / (2 * step), rel=1e-5)


def test_a_recording_prefers_the_muscle_that_made_it():
    data = recording()
    heights = [
        float(jm.objective.log_likelihood(jm.Isometric().replace(c_w=c), data))
        for c in (30.0, 60.0, 120.0)
    ]
    assert np.argmax(heights) == 1


def test_what_has_no_likelihood():
    with pytest.raises(ValueError, match="does not state its segments"):
        jm.objective.log_likelihood(jm.Isometric(), jm.Target("bare", np.linspace(2, 1, 30)))
    with pytest.raises(ValueError, match="below half the sampling rate"):
        jm.objective.log_likelihood(
            jm.Isometric().replace(harmonic_frequency=60.0),
            jm.load_target("vastus-lateralis-26mvc"),
        )
