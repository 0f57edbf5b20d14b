"""The laws of every noise, in one table: its density, filter, steps and paths against the closed
form of its autocovariance."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.linalg
import scipy.signal
from compiled import at_once, drawing
from noise_paths import draw_normals, draw_path, unit_path
from test_simulate import Integral

import jaxmuscle as jm
from jaxmuscle.model import _own_parts

KEY = jax.random.key(7)


def of_band(noise, lag):
    """Of N'' + √2 ω N' + ω² N = ω² w: damped at ω/√2 and oscillating at ω/√2. The variance is
    ∫ density df = cutoff π / (√2 rate), since ∫ dx / (1 + x⁴) = π/√2."""
    a = 2 * np.pi * noise.cutoff * lag / np.sqrt(2)
    return np.pi * noise.cutoff / (np.sqrt(2) * noise.rate) * np.exp(-a) * (np.cos(a) + np.sin(a))


def of_ornstein_uhlenbeck(noise, lag):
    return np.exp(-lag / noise.correlation_time)


def of_pink(noise, lag):
    return np.exp(-2 * np.pi * lag[..., None] * noise.corners) @ noise.shares


def of_resonance(noise, lag):
    """Of the velocity of a damped oscillator, roots -πb ± iω."""
    rate = np.pi * noise.width
    omega = 2 * np.pi * np.sqrt(complex(noise.frequency**2 - noise.width**2 / 4))
    return (np.exp(-rate * lag) * (np.cos(omega * lag) - rate / omega * np.sin(omega * lag))).real


COLOURED = {
    "band-limited": (jm.BandLimitedNoise(1.0, rate=50.0, cutoff=12.0), of_band),
    "Ornstein-Uhlenbeck": (jm.OrnsteinUhlenbeckNoise(1.0, 0.05), of_ornstein_uhlenbeck),
    "pink": (jm.PinkNoise(1.0), of_pink),
    "pink, an octave": (jm.PinkNoise(1.0, 1.0, 2.0), of_pink),
    "tremor": (jm.ResonantNoise(1.0, 9.0, 2.0), of_resonance),
    "narrow": (jm.ResonantNoise(1.0, 9.0, 0.02), of_resonance),
    "overdamped": (jm.ResonantNoise(1.0, 4.0, 10.0), of_resonance),
}
WHITE = jm.WhiteNoise(1.0, rate=50.0)
NOISES = {name: noise for name, (noise, _) in COLOURED.items()} | {"white": WHITE}
coloured = pytest.mark.parametrize("name", COLOURED)
every_noise = pytest.mark.parametrize("name", NOISES)


def sampled_autocovariance(name, dt, steps):
    """Of what a path has on the grid: values, or the mean of white noise over a step."""
    if name == "white":
        return np.eye(1, steps)[0] / WHITE.rate / dt
    noise, autocovariance = COLOURED[name]
    return autocovariance(noise, dt * np.arange(steps))


@every_noise
def test_the_shaping_filter_has_the_density(x64, name):
    """Σ over the white noises of |H (iω - F)⁻¹ G + L|²."""
    noise = NOISES[name]
    F, G, H, L = (np.asarray(x) for x in jax.tree.leaves(noise.shaping_filter()))
    assert (F.shape, G.shape) == ((len(H), len(H)), (len(H), len(L)))
    for f in (0.0, 0.3, 3.9, 4.0, 8.99, 9.0, 11.0, 25.0, 200.0):
        gain = H @ np.linalg.solve(2j * np.pi * f * np.eye(len(H)) - F, G) + L
        exact = np.sum(np.abs(gain) ** 2)
        np.testing.assert_allclose(noise.density(f), exact, rtol=1e-9, atol=1e-30)
        psd = eqx.tree_at(lambda n: n.amplitude, noise, 0.3).psd(f)
        np.testing.assert_allclose(psd, [0.09 * exact], rtol=1e-9, atol=1e-30)


@coloured
def test_the_shaping_filter_has_the_autocovariance(x64, name):
    """R(t) = H exp(F t) P H, P the stationary covariance: F P + P Fᵀ + G Gᵀ = 0."""
    noise, autocovariance = COLOURED[name]
    F, G, H, L = (np.asarray(x) for x in jax.tree.leaves(noise.shaping_filter()))
    assert not np.any(L)
    P = scipy.linalg.solve_continuous_lyapunov(F, -G @ G.T)
    lag = np.array([0.0, 1e-3, 0.01, 0.05, 0.3, 2.0])
    found = [H @ scipy.linalg.expm(F * t) @ P @ H for t in lag]
    exact = autocovariance(noise, lag)
    np.testing.assert_allclose(found, exact, rtol=1e-10, atol=1e-11 * exact[0])


@pytest.mark.parametrize("dt", [8e-3, 2e-3])
@coloured
def test_a_path_is_exact_on_any_grid(x64, name, dt):
    """The map from normals to the path, taken as a matrix: its Gram matrix must be the closed-form
    covariance."""
    (noise, autocovariance), steps = COLOURED[name], 6
    numbers = noise.recursion(dt).numbers
    matrix = at_once(
        jax.jacfwd(lambda z: unit_path(noise, z, dt).values[:, 0]), np.zeros((steps + 1, numbers))
    )
    matrix = np.asarray(matrix).reshape(steps + 1, -1)
    lag = dt * np.abs(np.subtract.outer(np.arange(steps + 1), np.arange(steps + 1)))
    np.testing.assert_allclose(matrix @ matrix.T, autocovariance(noise, lag), rtol=1e-9, atol=1e-11)


def test_white_increments_have_the_variance_of_their_step(x64):
    for dt in (1e-3, 2.5e-4):
        increments = unit_path(WHITE, jnp.ones((3, 4)), dt).increments
        np.testing.assert_allclose(
            increments, np.full((2, 4), np.sqrt(dt / WHITE.rate)), rtol=1e-12
        )


def test_slopes_are_the_derivative_of_values(x64):
    """Without kicks (N, N') moves by the matrix exponential of its equation, and the covariance of
    slopes is -R''."""
    noise, dt = NOISES["band-limited"], 3e-3
    w = 2 * np.pi * noise.cutoff
    drift = np.array([[0.0, 1.0], [-(w**2), -np.sqrt(2) * w]])
    path = unit_path(noise, jnp.zeros((2, 2)).at[0].set(jnp.array([0.7, -0.4])), dt)
    start, end = (np.array([path.values[i, 0], path.slopes[i, 0]]) for i in (0, 1))
    np.testing.assert_allclose(end, scipy.linalg.expm(drift * dt) @ start, rtol=1e-10)
    matrix = jax.jacfwd(lambda z: unit_path(noise, z, dt).slopes[:, 0])(jnp.zeros((7, 2)))
    matrix = np.asarray(matrix).reshape(7, -1)
    a = w * dt / np.sqrt(2) * np.abs(np.subtract.outer(np.arange(7), np.arange(7)))
    exact = w**2 * of_band(noise, 0.0) * np.exp(-a) * (np.cos(a) - np.sin(a))
    np.testing.assert_allclose(matrix @ matrix.T, exact, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@every_noise
def test_drawn_paths_have_variance_covariances_and_spectrum(name, precision):
    """Of 2048 seeds for 2 s; the expected periodogram is that of the autocovariance
    and the taper. Channels are independent."""
    dt, steps, seeds = 4e-3, 512, 2048
    with jax.enable_x64(precision == "float64"):

        def path(key):
            found = draw_path(NOISES[name].per_channel(), key, steps, dt)
            return found.increments / dt if found.values is None else found.values[:steps]

        values = at_once(lambda key: jax.vmap(path)(jax.random.split(key, seeds)), KEY)
    channels = 1 if isinstance(NOISES[name], jm.ResonantNoise) else 4
    assert values.dtype == precision and values.shape == (seeds, steps, channels)
    x = np.asarray(values, float)
    lags, bins, taper = (
        np.array([0, 1, 5, 14, 28, 100]),
        np.arange(2, 125, 3),
        scipy.signal.get_window("hann", steps),
    )
    seen = [
        x[:, 0] ** 2,
        x[:, -1] ** 2,
        *((x[:, : steps - k] * x[:, k:]).mean(axis=1) for k in lags),
    ]
    r = sampled_autocovariance(name, dt, steps)
    overlap = (
        np.correlate(taper, taper, "full")[steps - 1 :] * r * np.where(np.arange(steps) > 0, 2, 1)
    )
    expected = np.cos(2 * np.pi * np.outer(bins, np.arange(steps)) / steps) @ overlap
    power = np.abs(np.fft.rfft(x * taper[:, None], axis=1)[:, bins]) ** 2

    def standard(found, exact):
        """Of numbers of every seed (and channel), which are independent of one another."""
        found = found.reshape(-1, len(exact))
        return (found.mean(axis=0) - exact) / (found.std(axis=0, ddof=1) / np.sqrt(len(found)))

    # Lags of a path depend on each other: the bound alone. Bins three apart do not, unless one line
    # leaks into all.
    references.assert_standard_normal(
        standard(np.stack(seen, axis=-1), np.r_[r[0], r[0], r[lags]]), every=len(seen)
    )
    references.assert_standard_normal(
        standard(np.moveaxis(power, 1, -1), expected), every=len(bins) if name == "narrow" else 1
    )
    if channels == 4:
        products = np.stack(
            [(x[..., i] * x[..., j]).mean(axis=1) for i in range(4) for j in range(i)], axis=-1
        )
        references.assert_standard_normal(standard(products, np.zeros(6)))


@every_noise
def test_a_path_in_single_precision_follows_the_double_one(name):
    noise = NOISES[name]
    normals = np.random.default_rng(0).normal(size=(501, noise.recursion(1e-3).numbers))
    found = []
    for dtype in (np.float32, np.float64):
        with jax.enable_x64(dtype == np.float64):
            path = at_once(lambda z: unit_path(noise, z, 1e-3)[:3], normals.astype(dtype))
        path = [x for x in path if x is not None]
        assert path and all(x.dtype == dtype for x in path)
        found.append([np.asarray(x, float) for x in path])
    for single, double in zip(*found, strict=True):
        # The process noise is a difference of nearly equal numbers, good to a few 1e-4 in single
        # precision.
        np.testing.assert_allclose(single, double, atol=1e-3 * double.std())


@every_noise
def test_what_is_asked_of_a_noise_of_ones_own_holds_of_ours(name, monkeypatch):
    noise = NOISES[name]
    monkeypatch.setattr(_own_parts, "_ours", lambda part: False)
    monkeypatch.setattr(_own_parts, "_SEEN", set())
    # its recursion compiled as a whole; those of own classes run as they are
    kind = type(noise)
    made = kind.recursion
    monkeypatch.setattr(kind, "recursion", lambda self, dt: jax.jit(lambda n: made(n, dt))(self))
    _own_parts.check_noise(noise)
    assert kind in _own_parts._SEEN


class Seen(Integral):
    """A task whose output is a mixture of its inputs and their slopes, and whose state is the
    integral of another mixture: of white noise, the sum of its increments."""

    smoothness_needed = (0,) * 5
    weights: ClassVar = np.random.default_rng(4).normal(size=(3, 5))

    def vector_field(self, t, y, u):
        return jnp.sum(jnp.asarray(self.weights[0], u.dtype) * u)[None]

    def output(self, t, y, u, du):
        value, slope = jnp.asarray(self.weights[1:], u.dtype)
        return jnp.sum(value * u + slope * du)


def inputs_of(task, key, steps, dt):
    """Values and slopes of the inputs at the grid points, and the increments of white noise in
    every step; what passes the activation by scipy's linear system."""
    parts = task.noise.components

    def paths(key):
        normals = draw_normals(task.noise, key, steps)
        return [unit_path(*each, dt)[:3] for each in zip(parts, normals, strict=True)]

    values, slopes, kicks = np.zeros((3, steps + 1, 5))
    for part, path in zip(parts, drawing(paths)(key), strict=True):
        scale = np.asarray(task.noise_scale(part))
        for found, own in zip((values, slopes, kicks), path, strict=True):
            if own is not None:
                found[: len(own), list(part.acts_on)] += np.asarray(scale * own, float)
    if task.activation is not None:
        rate, times = 1 / float(task.activation.time), dt * np.arange(steps + 1)
        twitch = rate * np.array([[0, 1], [-1, -2]]), [[0.0], [rate]], np.eye(2), np.zeros((2, 1))
        for i in (0, 2, 4):
            _, smooth, _ = scipy.signal.lsim(twitch, values[:, i], times)
            _, rough, _ = scipy.signal.lsim(twitch, kicks[:, i] / dt, times, interp=False)
            values[:, i], slopes[:, i] = (smooth + rough).T * [[1.0], [rate]]
            kicks[:, i] = 0.0
    return values, slopes, kicks


BAND = jm.BandLimitedNoise()
ON_THE_WAY = {
    "white": (jm.WhiteNoise(), False),
    "white, active": (jm.WhiteNoise(), True),
    "band-limited": (BAND, False),
    "sum, active": (BAND + jm.ResonantNoise(0.1), True),
    "Ornstein-Uhlenbeck": (jm.OrnsteinUhlenbeckNoise(), False),
    "pink": (jm.PinkNoise(), False),
    "shared": (jm.BandLimitedNoise(0.1, shared=True), False),
    "drive, active": (jm.OrnsteinUhlenbeckNoise({"K_w": 0.1, "P_w": 0.05}), True),
}


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("name", ON_THE_WAY)
def test_a_simulation_sees_the_paths_of_its_seed(name, precision):
    """Every number of a simulation's inputs, against the paths made of the normals of its seed."""
    noise, active = ON_THE_WAY[name]
    with jax.enable_x64(precision == "float64"):
        activation = jm.Activation() if active else None
        task = Seen(noise=noise, harmonic=jm.Harmonic(0.0), activation=activation)
        run = jm.simulate(task, KEY, seed=4, duration=0.3, substeps=1)
        values, slopes, kicks = inputs_of(task, jax.random.fold_in(KEY, 4), 300, 1e-3)
    summed, *shown = Seen.weights
    drift = values @ summed
    state = np.cumsum(0.5e-3 * (drift[1:] + drift[:-1]) + kicks[:-1] @ summed)
    output = values @ shown[0] + slopes @ shown[1]
    tolerance = 1e-9 if precision == "float64" else 1e-3
    for ours, exact in ((run.output, output), (run.states[1:, 0], state[9:])):
        exact = exact[::10]
        np.testing.assert_allclose(ours, exact, rtol=0, atol=tolerance * np.abs(exact).max())
