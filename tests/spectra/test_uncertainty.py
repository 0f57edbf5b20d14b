"""How much a spectrum scatters, and what that leaves undetermined: closed forms against simulated
spectra and fits."""

import numpy as np
import pytest
import references
import scipy.signal
import scipy.stats

import jaxmuscle as jm
from jaxmuscle.objective._covariance import (
    Identifiability,
    common_scales,
    identifiability,
    known_products,
    parameter_covariance,
)
from jaxmuscle.spectra._bin_law import (
    bin_statistics,
    log_power_moments,
    standardised,
    welch_law,
)

BINS = np.arange(1, 31)
FLAT = np.full(30, 1 / 30)
NAMES = (
    "k_w",
    "k_z",
    "c_w",
    "c_z",
    "harmonic_amplitude",
    "harmonic_frequency",
    "noise_K_w",
    "noise_K_z",
)
PERTURBATION = (
    "all amplitudes of noise and harmonic can be multiplied by one number, and the fit stays as"
    " good"
)
MECHANICS = (
    "all stiffness and damping can be multiplied by one number, and the fit stays as good: at most"
    " their ratios are known"
)
# A published number of two digits stands for everything that rounds to it.
TWO_DIGITS = 0.005


def welch_powers(signals, settings):
    """Powers in bins 1 to 30, by scipy."""
    _, power = scipy.signal.welch(
        signals, settings.rate, settings.window, settings.length, settings.length - settings.step
    )
    return power[:, BINS]


def white(realisations, segments, settings=None, seed=1):
    """Welch powers of white noise, relative to their expectation."""
    settings = jm.SpectrumSettings() if settings is None else settings
    samples = settings.length + (segments - 1) * settings.step
    signals = np.random.default_rng(seed).standard_normal((realisations, samples))
    return welch_powers(signals, settings) * settings.rate / 2


@pytest.mark.parametrize("nu", [2.0, 11.4, 300.0])
def test_log_power_moments_are_those_of_simulated_chi_squared(nu):
    log = np.log(np.random.default_rng(2).chisquare(nu, 100_000) / nu)
    bias, variance = log_power_moments(nu)
    scatter = (log - log.mean()) ** 2
    references.assert_standard_normal(
        [
            (x.mean() - expected) / scipy.stats.sem(x)
            for x, expected in ((log, bias), (scatter, variance))
        ]
    )


def test_hann_bins_of_half_overlap_correlate_as_published():
    # Design 6: 0.45 and 0.04; the number of segments moves the second digit's last unit.
    for segments in ((6,), (12,), (6,) * 200):
        correlation = welch_law(jm.SpectrumSettings(), BINS, segments).correlation
        np.testing.assert_allclose(correlation[3, 3:7], [1, 0.45, 0.04, 0], atol=0.01)
        np.testing.assert_allclose(correlation, correlation.T, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "segments"),
    [
        ({}, 1),
        ({}, 12),
        ({"overlap": 0.75}, 2),
        ({"window": "hamming", "overlap": 0.25}, 6),
        ({"overlap": 0.0}, 4),
    ],
)
def test_the_correlation_is_that_of_white_noise(changes, segments):
    settings = jm.SpectrumSettings(**changes)
    expected = welch_law(settings, BINS, (segments,)).correlation[10, 10:]
    x = white(2000, segments, settings)[:, 3:] - 1  # detrending touches the first bins
    variance = np.mean(x[:, :-3] ** 2, axis=1)
    excess = [
        np.mean(x[:, :-3] * x[:, d : d - 3 or None], axis=1) - expected[d] * variance
        for d in (1, 2, 3)
    ]
    references.assert_standard_normal([q.mean() / scipy.stats.sem(q) for q in excess])


def test_bins_that_are_left_out_change_nothing():
    some, full = (
        welch_law(jm.SpectrumSettings(), bins, (6,)) for bins in (np.array([2, 4, 5]), BINS)
    )
    np.testing.assert_allclose(some.correlation, full.correlation[np.ix_([1, 3, 4], [1, 3, 4])])
    np.testing.assert_allclose(some.degrees, full.degrees[[1, 3, 4]])


def coloured(realisations, segments, corner, seed=1):
    """Welch powers by scipy of Gaussian noise of density 1 / (1 + (f / corner)²)."""
    settings = jm.SpectrumSettings()
    samples = settings.length + (segments - 1) * settings.step
    noise = np.random.default_rng(seed).standard_normal((realisations, 8 * samples))
    shape = 1 / np.sqrt(1 + (np.fft.rfftfreq(8 * samples, 1 / settings.rate) / corner) ** 2)
    return welch_powers(np.fft.irfft(np.fft.rfft(noise) * shape)[:, :samples], settings)


@pytest.mark.parametrize("corner", [np.inf, 0.9], ids=["white", "falling"])
def test_statistics_are_those_of_measured_log_powers(corner):
    """Also of bin 1, which detrending and negative frequencies leave 0.8 times the degrees of
    freedom of the others.

    That of a spectrum that falls from 0.9 Hz on, as muscle force has it, is not flat within the
    resolution: within 3 %.
    """
    segments = 12
    log = np.log(coloured(2000, segments, corner))
    statistics = bin_statistics(jm.Target("measured", FLAT, segments=segments))
    for bins in (slice(0, 1), slice(1, 30)):
        found = np.sqrt(np.mean(log[:, bins].var(axis=0, ddof=1)))
        stated = np.sqrt(np.mean(statistics.sd[bins] ** 2))
        # Half the relative error of a variance; of 29 bins, neighbours correlated, about 18 are
        # independent.
        error = np.sqrt((1 + 3 / statistics.half.min()) / 2 / 2000 / (1 if bins.stop == 1 else 18))
        assert abs(found / stated - 1) < 4 * error + (0.0 if np.isinf(corner) else 0.03)
    nominal = np.sqrt(log_power_moments(jm.SpectrumSettings().degrees_of_freedom(segments))[1])
    assert log[:, 0].std() > 1.05 * nominal  # what was stated before: 0.303 instead of 0.336
    assert statistics.known


@pytest.mark.parametrize(
    ("name", "tapers"), [("slow", ["hann"]), ("multitaper", scipy.signal.windows.dpss(1000, 2, 3))]
)
def test_the_law_of_long_segments_is_that_of_coloured_noise(name, tapers):
    """Noise that falls from 0.9 Hz on, stationary from its first sample: spread of the bins,
    correlation of neighbours."""
    settings, segments, a = jm.SpectrumSettings.named(name), 3, np.exp(-2 * np.pi * 0.9 / 100)
    white = (
        np.random.default_rng(7).standard_normal((1500, 2000))
        * np.r_[1, np.full(1999, np.sqrt(1 - a**2))]
    )
    signals = scipy.signal.lfilter([1], [1, -a], white)
    power = np.mean(
        [scipy.signal.welch(signals, 100, w, 1000, 500, detrend="linear")[1] for w in tapers],
        axis=0,
    )
    power = power[:, settings.first_bin : settings.last_bin + 1]
    statistics = bin_statistics(jm.Target(name, power[0], segments=segments, settings=settings))
    log, step = np.log(power), 4 * len(tapers)  # bins so far apart are independent
    for bins in (slice(0, 1), slice(1, 2), slice(2, None)):
        found, stated = (
            np.sqrt(np.mean(x))
            for x in (log[:, bins].var(axis=0, ddof=1), statistics.sd[bins] ** 2)
        )
        independent = 1500 * max(1, len(log[0, bins]) // step)
        assert (
            abs(found / stated - 1)
            < 4 * np.sqrt((1 + 3 / statistics.half.min()) / 2 / independent) + 0.03
        )
    # What the degrees of freedom are without detrending and leakage.
    np.testing.assert_allclose(
        2 * statistics.half[20:], settings.degrees_of_freedom(segments), rtol=1e-3
    )
    law, x = (
        welch_law(settings, np.arange(settings.first_bin, 118), (segments,)),
        power[:, 6:] / power[:, 6:].mean(axis=0) - 1,
    )
    variance = np.mean(x[:, :-3] ** 2, axis=1)
    excess = [
        np.mean(x[:, :-3] * x[:, d : d - 3 or None], axis=1)
        - law.correlation[20, 20 + d] * variance
        for d in (1, 2, 3)
    ]
    references.assert_standard_normal([q.mean() / scipy.stats.sem(q) for q in excess])


def test_statistics_of_several_trials_add_their_degrees_of_freedom():
    one, three = (bin_statistics(jm.Target("t", FLAT, segments=s)) for s in (6, [6, 6, 6]))
    nu = welch_law(jm.SpectrumSettings(), BINS, (6,)).degrees
    np.testing.assert_allclose(one.sd**2, log_power_moments(nu)[1])
    np.testing.assert_allclose(three.sd**2, log_power_moments(3 * nu)[1])
    # Far from each other two bins have about 1e-31 in common, which is rounding and differs between
    # processors.
    np.testing.assert_allclose(three.correlation, one.correlation, atol=1e-15)


@pytest.mark.parametrize("overlap", [0.0, 0.5])
def test_a_line_does_not_scatter(overlap):
    """A sine in white noise: a bin has 1 / (1 - share²) times the degrees of freedom."""
    segments, k, share = 12, 12, 0.6
    settings = jm.SpectrumSettings(overlap=overlap)
    samples = settings.length + (segments - 1) * settings.step
    rng = np.random.default_rng(5)
    sine = np.sin(
        2 * np.pi * k / settings.length * np.arange(samples) + rng.uniform(0, 2 * np.pi, (4000, 1))
    )
    line = welch_powers(sine[:1], settings)[0, k - 1]
    amplitude = np.sqrt(share / (1 - share) * (2 / settings.rate) / line)
    power = welch_powers(amplitude * sine + rng.standard_normal(sine.shape), settings)[:, k - 1]
    log = np.log(power * (1 - share) * settings.rate / 2)
    target = jm.Target("line", FLAT, segments=segments, settings=settings)
    other = np.arange(30) != k - 1
    with_line, without = bin_statistics(target, np.where(other, 0.0, share)), bin_statistics(target)
    bias, variance = with_line.bias[k - 1], with_line.sd[k - 1] ** 2
    np.testing.assert_allclose(
        variance, log_power_moments(2 * without.half[k - 1] / (1 - share**2))[1]
    )
    np.testing.assert_array_equal(with_line.sd[other], without.sd[other])
    # The formula is the first order in 1/ν. Where segments overlap, their products with the line
    # correlate by 1/6, not by its square: the variance is then up to 1.31 / 1.05 times as large.
    second_order = 2 / settings.degrees_of_freedom(segments) ** 2
    excess = 1.0 if overlap == 0 else (1 + 11 / 12 / 3) / (1 + 11 / 12 / 18)
    error = 4 * scipy.stats.sem((log - log.mean()) ** 2)
    assert (
        -second_order - error
        < log.var() - variance
        < (excess - 1) * variance + second_order + error
    )
    assert abs(log.mean() - bias) < (excess - 1) * abs(bias) + second_order + 4 * scipy.stats.sem(
        log
    )


def test_statistics_from_sigma_and_from_nothing():
    # Relative sigma 0.5: variance of the log is ln(1 + 0.25), that of a log-normal variable.
    stated = bin_statistics(jm.Target("t", FLAT, sigma=0.5 * FLAT))
    np.testing.assert_allclose(stated.sd, np.sqrt(np.log(1.25)))
    assert stated.known and not np.any(stated.bias)
    unknown = bin_statistics(jm.Target("t", FLAT))
    assert not unknown.known
    np.testing.assert_array_equal(unknown.sd, 1.0)


def test_the_true_spectrum_gives_the_stated_chi2():
    """Design 6: 0.97 ± 0.31 for a recording of twelve segments."""
    target = jm.Target("white", FLAT, segments=12)
    statistics = bin_statistics(target)
    powers = white(2000, 12)
    powers = powers / powers.sum(axis=1, keepdims=True)
    truth = white(20_000, 12, seed=3).mean(axis=0)
    chi2 = np.array([np.sum(standardised(p, truth, statistics) ** 2) for p in powers]) / 29
    assert abs(chi2.mean() - 0.97) < TWO_DIGITS + 3 * scipy.stats.sem(chi2)
    spread = scipy.stats.sem((chi2 - chi2.mean()) ** 2) / (2 * chi2.std())
    assert abs(chi2.std() - 0.31) < TWO_DIGITS + 3 * spread


def test_standardised_does_not_see_scale():
    rng = np.random.default_rng(0)
    p, q = rng.uniform(1, 2, (2, 30))
    statistics = bin_statistics(jm.Target("t", FLAT, segments=12))
    np.testing.assert_allclose(
        standardised(7 * p, q, statistics), standardised(p, q, statistics), atol=1e-12
    )


def test_parameter_covariance_is_the_scatter_of_penalised_fits():
    """Truths drawn from the prior, data with correlated errors; one direction that nothing but the
    prior holds."""
    rng = np.random.default_rng(6)
    jacobian = rng.standard_normal((12, 4)) @ np.diag([5.0, 2.0, 1.0, 0.0])
    root = np.tril(rng.uniform(0.2, 1.0, (12, 12)))
    half = np.diag([1.0, 1.0, 0.5, 1.0])
    half[0, 1] = 2.0  # the prior joins two of them, as it does what makes a damping ratio
    covariance = parameter_covariance(jacobian, root @ root.T, half.T @ half)
    draws = 20_000
    truth = np.linalg.solve(half, rng.standard_normal((4, draws))).T
    data = truth @ jacobian.T + rng.standard_normal((draws, 12)) @ root.T
    weights = np.vstack([jacobian, half])
    found = np.linalg.lstsq(weights, np.hstack([data, np.zeros((draws, 4))]).T, rcond=None)[0].T
    # In whitened coordinates the entries of the sample covariance are independent.
    errors = np.linalg.solve(np.linalg.cholesky(covariance), (found - truth).T)
    upper = np.triu_indices(4)
    excess = (errors @ errors.T / draws - np.eye(4)) / np.sqrt((1 + np.eye(4)) / draws)
    references.assert_standard_normal(excess[upper])
    np.testing.assert_allclose(covariance[3], [0, 0, 0, 1], atol=1e-12)


def test_where_the_data_decide_the_covariance_is_that_of_least_squares():
    rng = np.random.default_rng(7)
    jacobian = 1e4 * rng.standard_normal((12, 3))
    sigma = np.diag(rng.uniform(0.5, 2.0, 12))
    inverse = np.linalg.pinv(jacobian)
    # The prior enters with the ratio of its precision to that of the data, 1e-8.
    np.testing.assert_allclose(
        parameter_covariance(jacobian, sigma, np.eye(3)), inverse @ sigma @ inverse.T, rtol=1e-6
    )


def jacobian_without(*nulls, strength=10.0, residuals=12):
    """Equally steep in every direction but the given ones, in which it is flat."""
    nulls = np.linalg.qr(np.array(nulls, dtype=float).T)[0].T
    basis = np.linalg.qr(np.random.default_rng(8).standard_normal((residuals, len(NAMES))))[0]
    return strength * basis @ (np.eye(len(NAMES)) - nulls.T @ nulls)


def direction(**weights):
    return [weights.get(name, 0.0) for name in NAMES]


PERTURBED = direction(noise_K_w=1, noise_K_z=1, harmonic_amplitude=1)
MECHANICAL = direction(k_w=1, k_z=1, c_w=1, c_z=1)


@pytest.mark.parametrize(
    ("nulls", "sentences"),
    [
        ([PERTURBED], [PERTURBATION]),
        ([MECHANICAL], [MECHANICS]),
        ([PERTURBED, MECHANICAL], [PERTURBATION, MECHANICS]),
        (
            [np.add(PERTURBED, MECHANICAL), np.subtract(PERTURBED, MECHANICAL)],
            [PERTURBATION, MECHANICS],
        ),
        ([direction(harmonic_frequency=1)], []),
        ([PERTURBED, direction(k_z=1)], [PERTURBATION]),
        ([direction(noise_K_w=2, noise_K_z=1)], []),
    ],
)
def test_common_scales_are_told_in_words(nulls, sentences):
    found = identifiability(jacobian_without(*nulls))
    assert list(common_scales(NAMES, found)) == sentences
    assert len(nulls) == np.sum(~found.determined)


@pytest.mark.parametrize(
    ("nulls", "known"),
    [
        ([direction(k_w=1)], [n for n in NAMES if n != "k_w"]),
        ([direction(k_w=1, c_z=1)], [*(n for n in NAMES if n not in ("k_w", "c_z")), "k_w / c_z"]),
        ([direction(k_w=1, c_z=-1)], [*(n for n in NAMES if n not in ("k_w", "c_z")), "k_w c_z"]),
        (
            [MECHANICAL],
            [
                *(n for n in NAMES if n not in ("k_w", "k_z", "c_w", "c_z")),
                "k_w / k_z",
                "k_w / c_w",
                "k_w / c_z",
            ],
        ),
    ],
)
def test_what_is_known_is_told_as_the_simplest_products_and_ratios(nulls, known):
    """Whatever basis of the null space rounding chooses; as many as there are determined
    directions."""
    found = identifiability(jacobian_without(*nulls))
    positive, sd = np.ones(len(NAMES), dtype=bool), np.ones(len(NAMES))
    said = known_products(NAMES, positive, sd, found)
    assert list(said) == known and len(said) == np.sum(found.determined)
    turned = np.linalg.qr(np.random.default_rng(3).standard_normal((8, 8)))[0]
    kept = found.determined
    turned = turned[: kept.sum(), : kept.sum()] @ found.directions[kept]
    again = found._replace(
        directions=np.concatenate([np.linalg.qr(turned.T)[0].T, found.directions[~kept]])
    )
    assert list(known_products(NAMES, positive, sd, again)) == known
    for slope in said.values():
        assert found.left(slope) == pytest.approx(1 / 101)


@pytest.mark.parametrize(("strength", "told"), [(5.0, True), (10.0, False)])
def test_a_common_scale_is_named_if_moving_along_it_is_not_noticed(strength, told):
    """15 % of its square lies in directions of that steepness: 5 √0.15 = 1.9, 10 √0.15 = 3.9
    standard deviations."""
    flat = np.sqrt(0.85) * np.array(MECHANICAL) / 2 + np.sqrt(0.15) * np.array(
        direction(noise_K_w=-1)
    )
    found = identifiability(jacobian_without(flat, strength=strength))
    assert (MECHANICS in common_scales(NAMES, found)) is told


def test_nothing_is_told_where_all_is_determined():
    found = identifiability(10 * np.eye(8))
    assert common_scales(NAMES, found) == ()
    assert np.all(found.parameters)


def test_identifiable_are_the_parameters_outside_the_flat_directions():
    found = identifiability(jacobian_without(PERTURBED, MECHANICAL))
    assert [name for name, known in zip(NAMES, found.parameters, strict=True) if known] == [
        "harmonic_frequency"
    ]
    np.testing.assert_allclose(found.singular_values, [10] * 6 + [0, 0], atol=1e-12)


@pytest.mark.parametrize(("value", "determined"), [(3.0, True), (2.99, False)])
def test_a_direction_is_determined_from_a_singular_value_of_three(value, determined):
    found = identifiability(np.diag([50.0, value]))
    np.testing.assert_array_equal(found.determined, [True, determined])


@pytest.mark.parametrize(("share", "determined"), [(0.099, True), (0.101, False)])
def test_one_criterion_at_most_a_tenth_of_the_prior_variance_is_left(share, determined):
    """A flat direction that holds a share of a parameter leaves that share of its prior's
    variance."""
    flat = np.array([np.sqrt(share), np.sqrt(1 - share)])
    found = identifiability(1e6 * (np.eye(2) - np.outer(flat, flat)))
    np.testing.assert_array_equal(found.parameters, [determined, False])
    assert found.left(np.array([7.0, 0.0])) == pytest.approx(share, rel=1e-6)
    assert found.determines(np.array([-3.0, 0.0])) is determined  # as K_w0 = k_w x_ref²


def test_correlated_bins_count_for_less():
    """The covariance of a parameter seen by two bins of correlation 0.6, against the same as if
    independent."""
    jacobian = np.array([[2.0], [2.0]])
    scatter = np.array([[1.0, 0.6], [0.6, 1.0]])
    left = parameter_covariance(jacobian, scatter, np.eye(1))
    found = Identifiability.of_covariance(left)
    assert found.singular_values[0] == pytest.approx(np.sqrt(1 / left[0, 0] - 1))
    assert found.singular_values[0] < identifiability(jacobian).singular_values[0]


def test_fewer_residuals_than_parameters():
    found = identifiability(np.array([[5.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(found.singular_values, [5, 0, 0])
    np.testing.assert_array_equal(found.parameters, [True, False, False])
