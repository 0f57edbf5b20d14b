"""Noise against its closed forms: density, variance, autocovariance, slopes; channels and
amplitudes."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.special import gammainc

import jaxmuscle as jm
from jaxmuscle._common.types import Scalar

KEY = jax.random.key(7)
CHANNELS = ("K_w", "K_z", "C_w", "C_z")
WHITE = jm.WhiteNoise(1.0, rate=50.0)
BAND = jm.BandLimitedNoise(1.0, rate=50.0, cutoff=12.0)
OU = jm.OrnsteinUhlenbeckNoise(1.0, 0.05)


def test_psd_scales_with_the_square_of_the_amplitude():
    f = np.array([0.0, 10.0])
    np.testing.assert_allclose(jm.WhiteNoise(0.3, rate=200.0).psd(f), 0.09 / 200, rtol=1e-6)
    rows = jm.WhiteNoise((0.1, 0.2, 0.0, 1.0), rate=100.0).psd(f)
    np.testing.assert_allclose(
        rows, np.square([[0.1] * 2, [0.2] * 2, [0.0] * 2, [1.0] * 2]) / 100, rtol=1e-6
    )


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
