"""Pink noise: how close to 1/f it is, its exact paths, filter and linear response, and where it may
be used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.integrate
import scipy.linalg
import scipy.signal
import scipy.stats
from compiled import at_once
from refits import without_intervals

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.commands.options import NoiseName
from jaxmuscle.model import _pink_noise as _pink
from jaxmuscle.model._noises import NOISES
from jaxmuscle.response._expected_moments import linear_spectrum
from jaxmuscle.response._linearised import linearise

KEY = jax.random.key(23)
PINK = jm.PinkNoise(1.0)
BANDS = [(0.05, 50.0), (0.1, 20.0), (1.0, 2.0), (0.001, 500.0), (1e-6, 1e6)]


def level(noise, points=40_001):
    """f times density inside the band, in equal steps of ln f."""
    f = np.geomspace(noise.f_low, noise.f_high, points)
    return f * np.asarray(noise.density(f))


def autocovariance(noise, lag):
    return np.exp(-2 * np.pi * np.abs(np.asarray(lag))[..., None] * noise.corners) @ noise.shares


def unit_paths(noise, dt, steps, seeds, key=KEY):
    path = jax.vmap(lambda k: noise.realise(noise.draw(k, steps), dt).values)
    return np.asarray(at_once(lambda key: path(jax.random.split(key, seeds)), key))


@pytest.mark.parametrize("band", BANDS)
def test_the_density_is_near_one_over_f_with_the_fewest_states(band):
    noise = jm.PinkNoise(1.0, *band)
    log_level = np.log(level(noise))
    largest = np.abs(log_level - log_level.mean()).max()
    assert largest <= _pink.TOLERANCE
    # A mean over at least 2000 points counts the ends of the band whole instead of half.
    np.testing.assert_allclose(noise.deviation(), largest, rtol=1e-3)
    # A best approximation alternates: 2 n + 1 equally large extremes, one more than it has free
    # numbers (Chebyshev).
    for count in {noise.corners.size, max(noise.corners.size - 1, 1)}:
        corners, shares = _pink._zolotarev(*band, count)
        assert np.all(np.diff(corners) > 0) and np.all(shares > 0)
        f = np.geomspace(*band, 20_000 * count + 1)
        curve = f * (1 / (1 + (f[:, None] / corners) ** 2) @ (shares / corners))
        turns = np.flatnonzero(np.diff(np.sign(np.diff(curve)))) + 1
        extremes = curve[np.r_[0, turns, f.size - 1]]
        assert extremes.size == 2 * count + 1
        np.testing.assert_allclose(extremes[::2], extremes[0], rtol=1e-6)
        np.testing.assert_allclose(extremes[1::2], extremes[1], rtol=1e-6)
        if count < noise.corners.size:
            relative = np.log(curve) - np.log(curve).mean()
            assert np.abs(relative).max() > _pink.TOLERANCE


def test_the_default_band_takes_four_states_within_3_6_percent(x64):
    noise = jm.PinkNoise()
    assert (noise.f_low, noise.f_high, noise.corners.size) == (0.05, 50.0, 4)
    log_level = np.log(level(noise))
    assert noise.deviation() <= 0.036 and np.abs(log_level - log_level.mean()).max() <= 0.036
    assert log_level.std() <= 0.025
    inside = 2 * np.trapezoid(level(noise), np.linspace(np.log(0.05), np.log(50.0), 40_001))
    # as docs/model.md rounds them
    np.testing.assert_allclose([np.exp(log_level.mean()), inside], [0.053, 0.73], rtol=0.01)


def test_the_density_is_the_transform_of_the_autocovariance(x64):
    noise = jm.PinkNoise(1.0, 0.5, 50.0)
    np.testing.assert_allclose(noise.shares.sum(), 1.0, rtol=1e-14)
    half, _ = scipy.integrate.quad(
        lambda x: np.exp(x) * float(noise.psd(np.exp(x))[0]), -30, 30, limit=200, epsrel=1e-10
    )
    np.testing.assert_allclose(2 * half, 1.0, rtol=1e-8)
    # to e^-34 of the slowest; Simpson's (ω h)⁴ / 180 is 2e-10 at the fastest corner
    lag = np.linspace(0, 10.0, 200_001)
    r = autocovariance(noise, lag)
    for f in (0.0, 0.5, 3.0, 12.0, 30.0):
        transform = 2 * scipy.integrate.simpson(r * np.cos(2 * np.pi * f * lag), x=lag)
        np.testing.assert_allclose(noise.psd(f)[0], transform, rtol=1e-7)
    np.testing.assert_allclose(
        jm.PinkNoise(0.3).psd(2.0), 0.09 * jm.PinkNoise(1.0).psd(2.0), rtol=1e-12
    )


@pytest.mark.parametrize("dt", [5e-3, 2.5e-3])
def test_the_transition_is_the_exact_one(x64, dt):
    """The map from normals to the path, taken as a matrix: its Gram matrix is the autocovariance at
    any step."""
    steps = 6

    def drawn(key):
        normals = PINK.draw(key, steps)
        return normals, jax.jacfwd(lambda z: PINK.realise(z, dt).values[:, 0])(normals[:, ::4])

    normals, matrix = at_once(drawn, KEY)
    assert normals.shape == (steps + 1, 16)
    matrix = np.asarray(matrix).reshape(steps + 1, -1)
    exact = autocovariance(PINK, dt * np.subtract.outer(np.arange(steps + 1), np.arange(steps + 1)))
    np.testing.assert_allclose(matrix @ matrix.T, exact, rtol=1e-12)


@pytest.mark.parametrize("dt", [8e-3, 4e-3])
def test_drawn_paths_have_the_autocovariance(x64, dt):
    """Variance and autocovariance of the drawn paths at dt and dt / 2, from the start."""
    x = unit_paths(PINK, dt, round(4.0 / dt), seeds=512)
    lag = np.array([0.0, 0.008, 0.04, 0.2, 1.0])
    lags = np.rint(lag / dt).astype(int)
    n = x.shape[1]
    seen = np.stack([(x[:, : n - k] * x[:, k:]).mean(axis=(1, 2)) for k in lags], axis=1)
    deviation = seen - autocovariance(PINK, lag)
    # Lags of one path depend on each other: decorrelate them by their own covariance.
    root = np.linalg.cholesky(np.cov(deviation.T) / len(x))
    references.assert_standard_normal(np.linalg.solve(root, deviation.mean(axis=0)))
    assert abs(np.mean(x[:, 0] ** 2) - 1) < 3.3 * np.sqrt(2 / x[:, 0].size)


def test_paths_have_the_density(x64):
    """Periodograms of drawn paths; a tapered segment's expected power is a quadratic form of the
    autocovariance."""
    dt, steps, chunk, seeds = 4e-3, 2048, 256, 256
    x = unit_paths(PINK, dt, steps, seeds)[:, :steps].reshape(seeds, steps // chunk, chunk, 4)
    bins = np.arange(3, 84, 3)  # 3 Hz to 80 Hz of 250 Hz, far enough apart to be independent
    taper = scipy.signal.get_window("hann", chunk)
    scale = dt / np.sum(taper**2)
    power = (np.abs(np.fft.rfft(x * taper[:, None], axis=2)) ** 2 * scale)[:, :, bins].mean(
        axis=(1, 3)
    )
    rows = taper * np.exp(-2j * np.pi * np.outer(bins, np.arange(chunk)) / chunk)
    covariance = scipy.linalg.toeplitz(autocovariance(PINK, dt * np.arange(chunk)))
    expected = np.einsum("km,mn,kn->k", rows, covariance, rows.conj()).real * scale
    error = power.std(axis=0, ddof=1) / np.sqrt(seeds)
    references.assert_standard_normal((power.mean(axis=0) - expected) / error)
    # The density itself, where neither aliases nor leakage reach: 1/f from 3 to 12 Hz, to the
    # deviation and 3 Hz's leakage.
    seen = np.log(power.mean(axis=0)[:4] * bins[:4])
    assert np.ptp(seen) < 2 * PINK.deviation() + 3.3 * np.sqrt(2) * np.max(error / expected) + 0.05


def test_channels_are_independent_unless_shared(x64):
    x = unit_paths(PINK, 2e-3, 400, seeds=128)
    products = np.stack([(x[..., i] * x[..., j]).mean(axis=1) for i in range(4) for j in range(i)])
    references.assert_standard_normal(
        products.mean(axis=1) / (products.std(axis=1, ddof=1) / np.sqrt(128))
    )
    assert unit_paths(jm.PinkNoise(1.0, shared=True), 2e-3, 10, seeds=2).shape == (2, 11, 1)


FILTERED = [
    jm.WhiteNoise(1.0),
    jm.BandLimitedNoise(1.0),
    jm.OrnsteinUhlenbeckNoise(1.0),
    PINK,
    jm.PinkNoise(1.0, 1.0, 2.0),
]


@pytest.mark.parametrize("noise", FILTERED, ids=lambda noise: type(noise).__name__)
def test_the_shaping_filter_has_the_density(x64, noise):
    """Σ over the white noises of |H (iω - F)⁻¹ G + L|²."""
    F, G, H, L = (np.asarray(x) for x in jax.tree.leaves(noise.shaping_filter()))
    assert (F.shape, G.shape) == ((len(H), len(H)), (len(H), len(L)))
    for f in (0.0, 0.3, 4.0, 25.0, 200.0):
        gain = H @ np.linalg.solve(2j * np.pi * f * np.eye(len(H)) - F, G) + L
        np.testing.assert_allclose(np.sum(np.abs(gain) ** 2), noise.psd(f)[0], rtol=1e-10)


TASKS = {
    "isometric": jm.Isometric(5.0, 0.003, noise=jm.PinkNoise(0.1)),
    "force, shared": jm.PrescribedForce(
        5.0, 1.0, noise=jm.PinkNoise({"K_w": 0.1, "K_z": 0.05}, shared=True)
    ),
    "motion": jm.PrescribedMotion(
        0.004, 6.0, noise=jm.PinkNoise({"K_w": 0.1, "C_w": 0.1}, 0.2, 40.0)
    ),
}


@pytest.mark.parametrize(
    "name", ["isometric", *(pytest.param(n, marks=pytest.mark.slow) for n in list(TASKS)[1:])]
)
def test_its_response_is_the_sum_of_its_states_responses(x64, name):
    """Each is an Ornstein-Uhlenbeck noise of variance w_i and correlation time 1 / 2π f_i, with a
    known response."""
    task = references.quiet(TASKS[name], harmonic_amplitude=0.0)
    amplitude, noise = TASKS[name].noise.amplitude, TASKS[name].noise
    task, total = task.with_parts(noise=noise), 0.0
    for corner, share in zip(noise.corners, noise.shares, strict=True):
        one = jm.OrnsteinUhlenbeckNoise(
            np.sqrt(share) * amplitude, 1 / (2 * np.pi * corner), shared=noise.shared
        )
        total += np.asarray(linear_spectrum(task.with_parts(noise=one), task.settings).power)
    np.testing.assert_allclose(linear_spectrum(task, task.settings).power, total, rtol=1e-9)


def test_simulations_have_the_expected_spectrum(x64):
    """Stiffness noise of 1 %: nonlinearity adds 1e-4 of a bin, a seed scatters by more than half of
    one."""
    # forgets its start by 1 s
    task, window = jm.Isometric(5.0, 0.003, noise=jm.PinkNoise(0.01)).settled(), (1.0, 6.12)
    runs = jm.ensemble(
        task, KEY, seeds=256, duration=window[1], dt=1.25e-3, substeps=1, control=False
    )
    power = np.asarray(runs.spectrum(window=window).power)
    expected = np.asarray(linear_spectrum(task, task.settings, window).power)
    z = (power.mean(axis=0) - expected) / (power.std(axis=0, ddof=1) / np.sqrt(len(power)))
    references.assert_standard_normal(z, every=3)


def test_linear_trajectories_have_the_expected_spectrum_on_the_grid_of_a_fit(x64):
    runs = jm.ensemble(jm.Isometric(noise=jm.PinkNoise()), KEY, seeds=128, dt=2.5e-3)
    power = np.asarray(runs.beside().spectrum().power)
    expected = np.asarray(jm.expected_spectrum(runs.task).power)
    z = (power.mean(axis=0) - expected) / (power.std(axis=0, ddof=1) / np.sqrt(len(power)))
    references.assert_standard_normal(z, every=3)
    np.testing.assert_array_equal(runs.mean_spectrum().expected, expected)


@pytest.mark.slow
def test_derivatives_with_respect_to_the_amplitude(x64):
    quiet = references.quiet(jm.Isometric(5.0, 0.003, noise=jm.PinkNoise()), harmonic_amplitude=0.0)

    def log_power(K_w):
        return jnp.log(jm.expected_spectrum(quiet.replace(noise_K_w=K_w)).power)

    weight, at = np.random.default_rng(0).normal(size=30), jnp.asarray(0.1)
    forward = at_once(jax.jacfwd(log_power), at)
    np.testing.assert_allclose(forward, 2 / 0.1, rtol=1e-9)  # power goes with its square
    reverse = at_once(jax.grad(lambda K_w: weight @ log_power(K_w)), at)
    np.testing.assert_allclose(
        reverse, 2 / 0.1 * weight.sum(), rtol=1e-9 * np.abs(weight).sum() / abs(weight.sum())
    )

    def last(K_w):
        return jm.simulate(
            quiet.replace(noise_K_w=K_w), KEY, duration=0.5, dt=5e-3, substeps=2
        ).output[-1]

    h = 1e-5
    (_, ahead, behind), (forward, *_) = at_once(
        jax.vmap(lambda K_w: jax.jvp(last, (K_w,), (jnp.ones_like(K_w),))),
        at + h * np.array([0.0, 1.0, -1.0]),
    )
    difference, reverse = (ahead - behind) / (2 * h), at_once(jax.grad(last), at)
    np.testing.assert_allclose([forward, reverse], difference, rtol=1e-6)
    assert abs(difference) > 1e-6


def condition(A, F):
    """Of the covariance equation `A X + X Fᵀ + Q = 0`."""
    return np.linalg.cond(np.kron(A, np.eye(len(F))) + np.kron(np.eye(len(A)), F))


def test_single_precision():
    normals, noise = np.random.default_rng(0).normal(size=(501, 16)), jm.PinkNoise(1.0)
    task = jm.Isometric(5.0, 0.003, noise=jm.PinkNoise())

    def both():
        values = at_once(
            lambda z: noise.realise(z, 1e-3).values, normals.astype(jnp.result_type(float))
        )
        return np.asarray(values), np.asarray(jm.expected_spectrum(task).power)

    path, power = both()
    assert path.dtype == power.dtype == np.float32
    with jax.enable_x64(True):
        exact_path, exact_power = both()
        A, F = map(
            np.asarray,
            at_once(lambda task: (linearise(task).A, noise.shaping_filter().F), as_arrays(task)),
        )
    # Each of 500 steps rounds a state by 6e-8; they are forgotten or add up at random.
    np.testing.assert_allclose(path, exact_path, atol=500 * 6e-8)
    # Rounding, of sums over hundreds of lags and of the covariance equations.
    worst = max(condition(F, F), condition(A, F), condition(A, A))
    np.testing.assert_allclose(power, exact_power, rtol=6e-8 * (280 + worst))


def test_where_it_may_be_used():
    for channel in ("K_z", "C_z"):
        with pytest.raises(
            ValueError,
            match=f"PinkNoise on {channel} cannot be used in PrescribedMotion.*differentiable",
        ):
            jm.PrescribedMotion(noise=jm.PinkNoise({channel: 0.1}))
    assert jm.PrescribedMotion(noise=jm.PinkNoise({"K_w": 0.1, "C_w": 0.1})).noise.smoothness == 1
    assert jm.Isometric(noise=jm.PinkNoise(0.1))["noise_C_z"] == 0.1
    assert not {"noise_f_low", "noise_f_high"} & set(
        jm.Isometric(noise=jm.PinkNoise()).parameter_names
    )
    assert {name.value for name in NoiseName} == set(NOISES) and NOISES["pink"] is jm.PinkNoise


def test_impossible_bands_amplitudes_and_grids_are_refused():
    for band in (
        (0.0, 50.0),
        (-1.0, 50.0),
        (1.0, 1.9),
        (50.0, 0.05),
        (np.nan, 50.0),
        (0.05, np.inf),
    ):
        with pytest.raises(
            ValueError, match=r"f_low = .* Hz, f_high = .* Hz: needs 0 < 2 f_low <= f_high"
        ):
            jm.PinkNoise(0.1, *band)
    for amplitude, message in (
        (-0.1, "must not be negative"),
        ({"K_x": 1.0}, "unknown"),
        ((1.0, 2.0), "has 2 entries"),
    ):
        with pytest.raises(ValueError, match=message):
            jm.PinkNoise(amplitude)
    with pytest.raises(
        ValueError, match=r"dt = 0\.01 s is too coarse for pink noise up to f_high = 50\.0 Hz"
    ):
        jm.simulate(jm.Isometric(noise=jm.PinkNoise()), KEY, dt=0.01)
    for dt in (1e-3, 2.5e-3):
        jm.PinkNoise().check_step(dt)


@pytest.mark.parametrize("relative, shared", [(True, False), (False, True)])
def test_preset_round_trip(tmp_path, relative, shared):
    noise = jm.PinkNoise((0.1, 0.2, 0.0, 0.3), 0.2, 20.0, relative=relative, shared=shared)
    jm.Isometric(noise=noise).save(tmp_path / "pink.toml")
    loaded = jm.load_preset(tmp_path / "pink.toml").noise
    assert isinstance(loaded, jm.PinkNoise)
    assert (loaded.f_low, loaded.f_high, loaded.relative, loaded.shared) == (
        0.2,
        20.0,
        relative,
        shared,
    )
    np.testing.assert_array_equal(loaded.amplitude, noise.amplitude)
    text = (tmp_path / "pink.toml").read_text()
    for wrong in ('"low"', "60.0", "[1.0, 2.0]", "true"):
        (tmp_path / "wrong.toml").write_text(text.replace("f_low = 0.2", f"f_low = {wrong}"))
        with pytest.raises(ValueError, match=r"f_low|task\.noise"):
            jm.load_preset(tmp_path / "wrong.toml")


@pytest.mark.slow
def test_a_measured_spectrum_is_fitted(tmp_path):
    target = jm.load_target("vastus-lateralis-26mvc")
    with without_intervals():
        result = jm.fit(target.task(noise="pink"), target, starts=8, seeds=0, check_seeds=0)
    assert result.success, result.message
    # Residuals in standard deviations of the target: a χ² of as many bins, which few free numbers
    # only lower.
    assert result.chi2_per_bin < scipy.stats.chi2.isf(0.01, len(target.bins)) / len(target.bins)
    result.save(tmp_path / "fit.json")
    kept = jm.load_result(tmp_path / "fit.json").task.noise
    assert isinstance(kept, jm.PinkNoise) and (kept.f_low, kept.f_high) == (0.05, 50.0)
