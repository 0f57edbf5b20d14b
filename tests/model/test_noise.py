"""Noise against its closed forms: density, variance, autocovariance, slopes; channels and
amplitudes."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.integrate
import scipy.linalg
from compiled import at_once
from jax.scipy.special import gammainc

import jaxmuscle as jm
from jaxmuscle._common.types import Scalar
from jaxmuscle.model import _own_parts
from jaxmuscle.model._noise import Realisation

KEY = jax.random.key(7)
CHANNELS = ("K_w", "K_z", "C_w", "C_z")
WHITE = jm.WhiteNoise(1.0, rate=50.0)
BAND = jm.BandLimitedNoise(1.0, rate=50.0, cutoff=12.0)
OU = jm.OrnsteinUhlenbeckNoise(1.0, 0.05)


def unit_paths(noise, dt, steps, seeds=256, key=KEY):
    def paths(key):
        made = jax.vmap(lambda k: noise.realise(noise.draw(k, steps), dt))(
            jax.random.split(key, seeds)
        )
        return made.values, made.slopes, made.increments

    return Realisation(*at_once(paths, key))


def band_variance(noise):
    """∫ density df = cutoff π / (√2 rate), since ∫ dx / (1 + x⁴) = π/√2."""
    return np.pi * noise.cutoff / (np.sqrt(2) * noise.rate)


def band_autocovariance(noise, lag):
    """Of N'' + √2 ω N' + ω² N = ω² w: damped at ω/√2 and oscillating at ω/√2."""
    a = 2 * np.pi * noise.cutoff * np.abs(lag) / np.sqrt(2)
    return band_variance(noise) * np.exp(-a) * (np.cos(a) + np.sin(a))


@pytest.mark.parametrize("noise, variance", [(BAND, band_variance(BAND)), (OU, 1.0)])
def test_the_density_integrates_to_the_stationary_variance(x64, noise, variance):
    half, _ = scipy.integrate.quad(
        lambda f: float(noise.psd(f)[0]), 0, np.inf, epsabs=1e-12, epsrel=1e-10
    )
    np.testing.assert_allclose(2 * half, variance, rtol=1e-8)


@pytest.mark.parametrize("noise", [BAND, OU])
def test_the_density_is_the_transform_of_the_autocovariance(x64, noise):
    lag = np.linspace(0, 2.0, 200_001)
    r = band_autocovariance(noise, lag) if noise is BAND else np.exp(-lag / noise.correlation_time)
    for f in (0.0, 3.0, 12.0, 30.0):
        transform = 2 * scipy.integrate.simpson(r * np.cos(2 * np.pi * f * lag), x=lag)
        np.testing.assert_allclose(noise.psd(f), transform, rtol=1e-6)


def test_psd_scales_with_the_square_of_the_amplitude():
    f = np.array([0.0, 10.0])
    np.testing.assert_allclose(jm.WhiteNoise(0.3, rate=200.0).psd(f), 0.09 / 200, rtol=1e-6)
    rows = jm.WhiteNoise((0.1, 0.2, 0.0, 1.0), rate=100.0).psd(f)
    np.testing.assert_allclose(
        rows, np.square([[0.1] * 2, [0.2] * 2, [0.0] * 2, [1.0] * 2]) / 100, rtol=1e-6
    )


@pytest.mark.parametrize(
    "noise", [WHITE, BAND, OU], ids=["white", "band-limited", "ornstein-uhlenbeck"]
)
def test_paths_have_the_density(x64, noise):
    dt, steps, chunk = 4e-3, 2048, 256
    paths = unit_paths(noise, dt, steps)
    # White noise is the derivative of its increments' sum: its mean over a step.
    x = (
        np.asarray(paths.increments) / dt
        if paths.values is None
        else np.asarray(paths.values)[:, :steps]
    )
    bins = np.arange(4, 84, 2)  # to 80 Hz of 250 Hz
    segments = x.reshape(256, steps // chunk, chunk, 4)
    taper = np.hanning(chunk + 1)[:-1, None]
    power = np.abs(np.fft.rfft(segments * taper, axis=2)) ** 2 * dt / np.sum(taper**2)
    power = power[:, :, bins].mean(axis=(1, 3))
    # The density of the *sampled* path is what a periodogram estimates: aliases are part of the
    # reference, and so is the taper's leakage (no mean was removed).
    frequency = (np.arange(4096) / 4096 - 0.5) / dt
    sampled = (
        (lambda f: np.full_like(f, 1 / 50.0))
        if noise is WHITE
        else lambda f: np.asarray(noise.density(f))
    )
    density = (
        sampled(frequency)
        if noise is WHITE
        else references.aliased(sampled, 1 / dt, frequency, 200)
    )
    m = np.arange(chunk)
    wave = np.exp(2j * np.pi * np.outer(frequency * dt, m)) * taper[:, 0]
    kernel = (
        np.abs(wave @ np.exp(-2j * np.pi * np.outer(m, bins) / chunk)) ** 2 * dt / np.sum(taper**2)
    )
    expected = density @ kernel / dt / len(frequency)
    error = power.std(axis=0, ddof=1) / np.sqrt(len(power))
    # bins two apart: independent
    references.assert_standard_normal((power.mean(axis=0) - expected) / error)


def covariances(x, lags):
    """Mean over time and channels of x(t) x(t + lag) per seed (no mean is removed: it is zero)."""
    n = x.shape[1]
    return np.stack([(x[:, : n - k] * x[:, k:]).mean(axis=(1, 2)) for k in lags], axis=1)


@pytest.mark.parametrize("dt", [8e-3, 2e-3])
@pytest.mark.parametrize("noise", [BAND, OU], ids=["band-limited", "ornstein-uhlenbeck"])
def test_the_autocovariance_is_exact_at_any_step(x64, noise, dt):
    x = np.asarray(unit_paths(noise, dt, 500, seeds=512).values)
    lags = np.rint(np.array([0.0, 0.008, 0.016, 0.032, 0.064]) / dt).astype(int)
    seen = covariances(x, lags)
    lag = lags * dt
    exact = (
        band_autocovariance(noise, lag) if noise is BAND else np.exp(-lag / noise.correlation_time)
    )
    deviation = seen - exact
    standard = deviation.mean(axis=0) / (deviation.std(axis=0, ddof=1) / np.sqrt(len(x)))
    # Lags of one path depend on each other: decorrelate them by their own covariance.
    root = np.linalg.cholesky(np.cov(deviation.T) / len(x))
    references.assert_standard_normal(np.linalg.solve(root, deviation.mean(axis=0)))
    assert np.abs(standard).max() < 4


@pytest.mark.parametrize("noise", [BAND, OU], ids=["band-limited", "ornstein-uhlenbeck"])
def test_the_transition_is_the_exact_one(x64, noise):
    """The map from normals to the path, taken as a matrix: its Gram matrix must be the closed-form
    covariance."""
    steps, grids = 5, (8e-3, 2e-3)

    def matrices(key):
        normals = noise.draw(key, steps)[:, ::4]  # of the first channel
        return [
            jax.jacfwd(lambda z, h=dt: noise.realise(z, h).values[:, 0])(normals) for dt in grids
        ]

    for dt, found in zip(grids, at_once(matrices, KEY), strict=True):
        matrix = np.asarray(found).reshape(steps + 1, -1)
        lag = dt * np.subtract.outer(np.arange(steps + 1), np.arange(steps + 1))
        exact = (
            band_autocovariance(noise, lag)
            if noise is BAND
            else np.exp(-np.abs(lag) / noise.correlation_time)
        )
        np.testing.assert_allclose(matrix @ matrix.T, exact, rtol=1e-9, atol=1e-12)


def test_band_limited_transition_is_the_matrix_exponential(x64):
    dt, w = 3e-3, 2 * np.pi * BAND.cutoff
    drift = np.array([[0.0, 1.0], [-(w**2), -np.sqrt(2) * w]])
    zero = jnp.zeros((2, 2)).at[0].set(jnp.array([0.7, -0.4]))
    path = BAND.realise(zero, dt)
    assert path.values is not None and path.slopes is not None
    start, end = (np.array([path.values[i, 0], path.slopes[i, 0]]) for i in (0, 1))
    np.testing.assert_allclose(end, scipy.linalg.expm(drift * dt) @ start, rtol=1e-10)


def test_slopes_are_the_derivative_of_values(x64):
    omega = 2 * np.pi * BAND.cutoff
    for dt in (2e-3, 5e-4):
        path = unit_paths(BAND, dt, 500, seeds=64)
        difference = np.diff(path.values, axis=1) / dt
        slopes = np.asarray(path.slopes)
        middle = 0.5 * (slopes[:, 1:] + slopes[:, :-1])
        rms = np.sqrt(np.mean((difference - middle) ** 2) / (omega**2 * band_variance(BAND)))
        # N' is as rough as Brownian motion of variance q = 2√2 ω var(N') per second: a bridge's
        # mean has q dt / 12. The next term is of relative order ω dt.
        np.testing.assert_allclose(
            rms, np.sqrt(np.sqrt(2) * omega * dt / 6), rtol=0.5 * omega * dt + 0.01
        )


def test_white_increments_have_the_variance_of_their_step(x64):
    for dt in (1e-3, 2.5e-4):
        increments = np.asarray(unit_paths(WHITE, dt, 1000, seeds=64).increments)
        variance = np.mean(increments**2) * WHITE.rate / dt
        assert abs(variance - 1) < 3.3 * np.sqrt(2 / increments.size)
        neighbours = np.mean(increments[:, 1:] * increments[:, :-1]) * WHITE.rate / dt
        assert abs(neighbours) < 3.3 / np.sqrt(increments.size)


def test_paths_are_stationary_from_the_start(x64):
    for noise, variance in ((BAND, band_variance(BAND)), (OU, 1.0)):
        first = np.asarray(unit_paths(noise, 2e-3, 1, seeds=4096).values)[:, 0] / np.sqrt(variance)
        assert abs(np.mean(first**2) - 1) < 3.3 * np.sqrt(2 / first.size)


@pytest.mark.parametrize("kind", [jm.WhiteNoise, jm.BandLimitedNoise, jm.OrnsteinUhlenbeckNoise])
def test_channels_are_independent_unless_shared(x64, kind):
    def path(noise):
        unit = unit_paths(noise, 2e-3, 400, seeds=64)
        return np.asarray(unit.increments if unit.values is None else unit.values)

    own = path(kind(1.0))
    assert own.shape[-1] == 4
    products = np.stack(
        [(own[..., i] * own[..., j]).mean(axis=1) for i in range(4) for j in range(i)]
    )
    standard = products.mean(axis=1) / (products.std(axis=1, ddof=1) / 8)
    references.assert_standard_normal(standard)
    assert path(kind(1.0, shared=True)).shape[-1] == 1


def test_a_shared_noise_moves_all_coefficients_together(x64):
    def force(shared, channel):
        noise = jm.BandLimitedNoise({channel: 0.1}, shared=shared)
        return jm.simulate(jm.Isometric(noise=noise, x_z=0.01), KEY, duration=1.0).output

    quiet = jm.simulate(
        jm.Isometric(noise=jm.BandLimitedNoise(0.0), x_z=0.01), KEY, duration=1.0
    ).output
    # Nearly linear: what K_w and K_z do with one path adds up to what a shared noise does on both.
    both = jm.BandLimitedNoise({"K_w": 1e-4, "K_z": 1e-4}, shared=True)
    joint = jm.simulate(jm.Isometric(noise=both, x_z=0.01), KEY, duration=1.0).output - quiet
    parts = force(True, "K_w") + force(True, "K_z") - 2 * quiet
    np.testing.assert_allclose(joint * 1e3, parts, atol=0.1 * np.abs(parts).max())
    apart = force(False, "K_w") + force(False, "K_z") - 2 * quiet
    assert np.abs(joint * 1e3 - apart).max() > 0.5 * np.abs(parts).max()


def test_amplitude_as_number_tuple_and_mapping(x64):
    base = np.array([200.0, 200.0, 60.0, 5.0])
    expected = {
        "number": (0.1, 0.1 * np.ones(4)),
        "tuple": ((0.1, 0.2, 0.3, 0.4), np.array([0.1, 0.2, 0.3, 0.4])),
        "mapping": ({"K_z": 0.2, "C_w": 0.3}, np.array([0.0, 0.2, 0.3, 0.0])),
        "default": (None, np.array([0.15, 0.005, 1e-4, 1e-4])),
    }
    for kind in (jm.WhiteNoise, jm.BandLimitedNoise, jm.OrnsteinUhlenbeckNoise):
        for given, amplitude in expected.values():
            task = jm.PrescribedForce(noise=kind(given))
            np.testing.assert_allclose(task.noise_scale(), amplitude * base, rtol=1e-12)
            assert [float(task[f"noise_{c}"]) for c in CHANNELS] == list(amplitude)
            absolute = jm.PrescribedForce(noise=kind(given, relative=False))
            np.testing.assert_allclose(absolute.noise_scale(), amplitude, rtol=1e-12)


def test_relative_noise_is_absolute_noise_of_that_size(x64):
    def force(noise):
        return jm.simulate(jm.Isometric(noise=noise), KEY, duration=1.0).output

    relative = force(jm.BandLimitedNoise((0.1, 0.02, 0.1, 0.1)))
    absolute = force(jm.BandLimitedNoise((20.0, 4.0, 6.0, 0.5), relative=False))
    np.testing.assert_allclose(relative, absolute, rtol=1e-12, atol=1e-15)
    assert np.abs(relative - force(jm.BandLimitedNoise(0.0))).max() > 1e-3


@pytest.mark.parametrize("kind", [jm.WhiteNoise, jm.BandLimitedNoise, jm.OrnsteinUhlenbeckNoise])
def test_impossible_amplitudes_are_refused(kind):
    with pytest.raises(
        ValueError, match=r"unknown input \['K_x'\]: known: K_w, K_z, C_w, C_z, P_w"
    ):
        kind({"K_x": 0.1})
    with pytest.raises(ValueError, match="noise amplitude has 3 entries"):
        kind((0.1, 0.2, 0.3))
    with pytest.raises(ValueError, match="must not be negative"):
        kind(-0.1)
    with pytest.raises(ValueError, match="must not be negative"):
        kind((0.1, 0.1, -0.1, 0.1))
    with pytest.raises(ValueError, match=r"shape \(3,\)"):
        kind(np.ones(3))


def test_impossible_rates_and_grids_are_refused():
    for kind in (jm.WhiteNoise, jm.BandLimitedNoise):
        with pytest.raises(ValueError, match=r"noise rate = 0.0 Hz must be positive"):
            kind(rate=0.0)
    with pytest.raises(ValueError, match=r"noise_cutoff = 0.0 Hz must be positive"):
        jm.BandLimitedNoise(cutoff=0.0)
    with pytest.raises(ValueError, match=r"noise_correlation_time = 0.0 s must be positive"):
        jm.OrnsteinUhlenbeckNoise(correlation_time=0.0)
    with pytest.raises(ValueError, match=r"dt = 0.01 s is too coarse for noise_cutoff = 50.0 Hz"):
        jm.simulate(jm.Isometric(), KEY, dt=0.01)
    with pytest.raises(
        ValueError, match=r"dt = 0.01 s is too coarse for noise_correlation_time = 0.01 s"
    ):
        jm.simulate(
            jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise(correlation_time=0.01)), KEY, dt=0.01
        )


def test_single_precision_paths_follow_double_ones():
    for kind, attributes in (
        (jm.BandLimitedNoise, ("values", "slopes")),
        (jm.OrnsteinUhlenbeckNoise, ("values",)),
        (jm.WhiteNoise, ("increments",)),
    ):
        normals = np.random.default_rng(0).normal(
            size=(501, 8 if kind is jm.BandLimitedNoise else 4)
        )

        def paths(dtype, kind=kind, normals=normals, attributes=attributes):
            def made(normals):
                realisation = kind(1.0).realise(normals, 1e-3)
                return [getattr(realisation, attribute) for attribute in attributes]

            with jax.enable_x64(dtype == np.float64):
                found = at_once(made, normals.astype(dtype))
            assert all(path.dtype == dtype for path in found)
            return [np.asarray(path, float) for path in found]

        for single, double in zip(paths(np.float32), paths(np.float64), strict=True):
            # The process noise is a difference of nearly equal numbers, good to a few 1e-4 in
            # single precision.
            np.testing.assert_allclose(single, double, atol=1e-3 * double.std())


class Smooth(jm.model.AbstractNoise):
    """Autocovariance `(1 + λ|t|) exp(-λ|t|)`, λ = 2π corner: white noise through the same low-pass
    twice."""

    amplitude: Scalar = eqx.field(converter=jm.model.as_amplitude, default=None)
    corner: Scalar = 1.0
    relative: bool = eqx.field(static=True, default=True)
    shared: bool = eqx.field(static=True, default=False)
    smoothness: ClassVar[int] = 2

    def density(self, f):
        fast = 2 * jnp.pi * self.corner
        return 4 * fast**3 / (fast**2 + (2 * jnp.pi * f) ** 2) ** 2

    def shaping_filter(self):
        fast = 2 * jnp.pi * jnp.asarray(self.corner)
        F = fast * jnp.array([[0.0, 1.0], [-1.0, -2.0]])
        G = jnp.stack([0 * fast, 2 * jnp.sqrt(fast)])[:, None]
        return jm.model.ShapingFilter(F, G, H=jnp.array([1.0, 0.0]), L=jnp.zeros(1))

    def recursion(self, dt):
        x = 2 * jnp.pi * self.corner * dt
        A = jnp.exp(-x) * jnp.array([[1 + x, x], [-x, 1 - x]])
        a, b = gammainc(3.0, 2 * x), 2 * x**2 * jnp.exp(-2 * x)
        return self.made(
            A, jnp.linalg.cholesky(jnp.array([[a, b], [b, a + 4 * x * jnp.exp(-2 * x)]]))
        )

    def made(self, A, L):
        H, S = (1.0, 0.0), (0.0, 2 * jnp.pi * self.corner)
        return jm.model.Recursion(tuple(map(tuple, A)), tuple(map(tuple, L)), H=H, S=S)

    def check_step(self, dt):
        pass


WRONG_NOISES = {
    "density": (
        "density",
        lambda self, f: jnp.exp(-f),
        r"density at 0\.3 Hz is 0\.53\d+ by .*, but 0\.74082 by",
    ),
    "step": (
        "made",
        lambda self, A, L: Smooth.made(self, A, 1.1 * L),
        r"variance of state 1 after a step is 1\.00\d* by",
    ),
    "correlation": (
        "made",
        lambda self, A, L: Smooth.made(self, *faster(A)),
        r"correlation after .* s is .* by recursion",
    ),
    "no slope": (
        "made",
        lambda self, A, L: without_slope(Smooth.made(self, A, L)),
        r"smoothness = 2, so rec.* must give S",
    ),
    "slope": (
        "made",
        lambda self, A, L: with_slope(Smooth.made(self, A, L)),
        "variance of the slope is 1 by recursion",
    ),
    "digits": (
        "made",
        lambda self, A, L: Smooth.made(self, A, rest(A)),
        r"0 has the variance 3\.276e-07 in double.*single",
    ),
    "kind": (
        "shaping_filter",
        lambda self: jnp.zeros(2),
        "returns a ArrayImpl; it must return a ShapingFilter",
    ),
    "error": (
        "recursion",
        lambda self, dt: self.nothing,
        r"recursion\(0\.001\) cannot be computed: Attr.*nothing",
    ),
}


def faster(A):
    """A step that keeps the covariance, and forgets faster."""
    A = 0.999 * A
    return A, rest(A)


def rest(A):
    """What a step adds so that the covariance stays 1, as the difference that it is."""
    return jnp.linalg.cholesky(jnp.eye(2) - A @ A.T)


def without_slope(made):
    return jm.model.Recursion(made.A, made.L, made.H)


def with_slope(made):
    return jm.model.Recursion(made.A, made.L, made.H, (0.0, 1.0))


@pytest.mark.parametrize("case", WRONG_NOISES)
def test_a_noise_of_ones_own_is_looked_at(case):
    method, wrong, message = WRONG_NOISES[case]
    with pytest.raises(ValueError, match=f"Wrong.*{message}"):
        jm.Isometric(noise=type("Wrong", (Smooth,), {method: wrong})())
    assert jm.Isometric(noise=Smooth({"K_w": 0.1}))["noise_corner"] == 1.0


@pytest.mark.parametrize(
    "noise",
    [WHITE, BAND, OU, jm.PinkNoise(1.0), jm.ResonantNoise(1.0, 9.0, 2.0)],
    ids=lambda n: type(n).__name__,
)
def test_what_is_asked_of_a_noise_of_ones_own_holds_of_ours(noise, monkeypatch):
    monkeypatch.setattr(_own_parts, "_ours", lambda part: False)
    monkeypatch.setattr(_own_parts, "_SEEN", set())
    # its recursion compiled as a whole; those of own classes, above, run as they are
    kind = type(noise)
    monkeypatch.setattr(
        kind, "recursion", lambda self, dt, made=kind.recursion: eqx.filter_jit(made)(self, dt)
    )
    _own_parts.check_noise(noise)
    assert type(noise) in _own_parts._SEEN


def test_a_noise_of_ones_own_is_simulated_as_its_response_says():
    """16 seeds with the control variate: the standard error is a few tenths of a per cent, what the
    response misses less."""
    runs = jm.ensemble(jm.Isometric(noise=Smooth({"K_w": 0.02})), KEY, seeds=16)
    estimate = runs.mean_spectrum()
    error = np.asarray(estimate.stderr / estimate.expected)
    assert (
        np.max(np.abs(estimate.nonlinearity) / error) < 6
        and np.max(np.abs(estimate.nonlinearity)) < 0.02
    )
    raw, rough = np.asarray(runs.spectrum().power).mean(0), 4 / np.sqrt(16 * 5)
    assert np.all(np.abs(raw / np.asarray(estimate.expected) - 1) < 1.2 * rough)


def test_a_noise_prints_its_numbers():
    assert (
        repr(BAND)
        == "BandLimitedNoise(amplitude=1.0, rate=50.0, cutoff=12.0, relative=True, shared=False)"
    )
    both = repr(jm.BandLimitedNoise({"K_w": 0.1}) + jm.ResonantNoise(0.2, 9.0, 2.0))
    assert (
        "amplitude=[0.1, 0.0, 0.0, 0.0]" in both
        and "ResonantNoise(amplitude=[0.2], frequency=9.0" in both
    )
    traced = []
    jax.jit(lambda a: traced.append(repr(jm.BandLimitedNoise(a))) or a)(1.0)
    assert (
        traced[0].startswith("BandLimitedNoise(amplitude=")
        and "0." not in traced[0].partition(",")[0]
    )
