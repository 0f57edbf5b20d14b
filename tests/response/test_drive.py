"""Activation, sums of noises and a noisy drive in linear response, against quadrature, noise-free
runs, muscles by hand."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.integrate
import scipy.optimize
import scipy.stats
from compiled import at_once, kept_jit
from test_expected import (
    ACTS_ON,
    KEY,
    RHYTHM,
    WINDOW,
    Settings,
    assert_as_by_quadrature,
    density,
    shape,
    some_slow,
)

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.model import Decay, NoiseSum, RampHold
from jaxmuscle.response._expected import noise_variance
from jaxmuscle.response._expected_moments import linear_spectrum
from jaxmuscle.response._harmonic_line import harmonic_system
from jaxmuscle.response._linear_task import Linearisation
from jaxmuscle.response._linearised import linearised
from jaxmuscle.response._second_order import FAINT, negative_coefficients, second_order

BOTH = {"K_w": 0.15, "K_z": 0.05}
TWITCH = jm.Activation(0.06)
TREMOR, SLOW = jm.ResonantNoise(0.01, 9.0, 2.0), jm.ResonantNoise(0.02, 3.5, 1.0)
TASKS = {
    "activation": jm.Isometric(5.0, 0.003, noise=jm.BandLimitedNoise(BOTH), activation=TWITCH),
    "sum": jm.Isometric(5.0, 0.003, noise=jm.BandLimitedNoise(BOTH) + TREMOR),
    "two resonances": jm.Isometric(
        5.0, 0.003, noise=SLOW + TREMOR + jm.BandLimitedNoise(BOTH), activation=TWITCH
    ),
    "drive": jm.PrescribedForce(
        5.0, 1.0, noise=jm.OrnsteinUhlenbeckNoise({"K_w": 0.1, "P_w": 0.02}, 0.1)
    ),
    "shared": jm.Isometric(
        5.0,
        0.003,
        noise=jm.OrnsteinUhlenbeckNoise(BOTH | {"P_w": 0.1}, shared=True),
        activation=TWITCH,
    ),
    "motion": jm.PrescribedMotion(0.004, 6.0, noise=jm.BandLimitedNoise(BOTH), activation=TWITCH),
    "motion, white": jm.PrescribedMotion(
        0.004, 6.0, noise=jm.WhiteNoise({"K_w": 0.15}), activation=TWITCH
    ),
    "force": jm.PrescribedForce(
        5.0,
        1.0,
        noise=jm.ResonantNoise(BOTH, 4.0, 1.0) + jm.WhiteNoise({"K_w": 0.1, "K_z": 0.05}),
        activation=TWITCH,
    ),
}


@pytest.mark.parametrize("name", some_slow(TASKS, ["two resonances", "shared", "motion", "force"]))
def test_the_variance_is_the_integral_of_the_density(x64, name):
    task = TASKS[name]
    p = {key: float(value) for key, value in task.parameters.items()}
    half = integral(lambda f: density(task, p, Settings(), f))
    found = at_once(noise_variance, as_arrays(task), linearised(task).system)
    # the tail: P_w of a motion falls with f^-2, 1e-9 of it is left
    np.testing.assert_allclose(found, 2 * half, rtol=1e-8)


def integral(density):
    """From 0 to 1e11 Hz, by Gauss and Legendre in panels that grow by 9 %."""
    edges = np.r_[0.0, np.geomspace(0.05, 1e11, 330)]
    return sum(
        scipy.integrate.fixed_quad(density, a, b, n=16)[0] for a, b in itertools.pairwise(edges)
    )


SETTINGS = {
    "sum": {"filter_direction": "both", "first_bin": 0, "detrend": "none"},
    "two resonances": {"filter_cutoff": None, "last_bin": 128},
    "drive": {"rate": 200.0, "length": 100, "sampling": "average"},
}


@pytest.mark.parametrize("name", TASKS)
def test_spectrum_line_mean_and_variance_are_the_quadrature(x64, name):
    task = TASKS[name].with_parts(harmonic=RHYTHM)
    assert_as_by_quadrature(task, Settings().replace(**SETTINGS.get(name, {})), WINDOW)


ENVELOPES = {
    "changing": (
        jm.Isometric,
        (5.0, 0.003),
        jm.Harmonic(1e-5, 4.25, 0.7, Decay(1.0, 0.2, 5.0, 3.0)),
    ),
    "motion": (
        jm.PrescribedMotion,
        (0.004, 6.0),
        jm.Harmonic(1e-5, 2.1, 0.7, RampHold(1.0, 6.0, 4.0, 0.5, 0.1)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ENVELOPES)
def test_the_harmonic_through_the_activation_is_that_of_a_noise_free_simulation(x64, name):
    kind, inputs, harmonic = ENVELOPES[name]
    task = references.quiet(kind(*inputs, harmonic=harmonic, activation=TWITCH))
    power = np.asarray(jm.simulate(task.settled(), KEY, dt=5e-4, substeps=1).spectrum().power)
    # As without activation: Heun's (|λ| dt)² / 6, the envelope joined by lines; here the sine, too,
    # (ω dt)² / 6 = 3e-5.
    expected = linear_spectrum(task, task.settings).power
    np.testing.assert_allclose(expected, power, rtol=6e-4, atol=1e-6 * power.max())


ALL = (0.3, 0.2, 0.4, 0.1, 0.5)
ANY = {
    "band-limited": jm.BandLimitedNoise(ALL, relative=False),
    "shared, sum": (
        jm.BandLimitedNoise(ALL, shared=True, relative=False)
        + jm.ResonantNoise(ALL, 4.0, 8.5, relative=False)
    ),
    "Ornstein-Uhlenbeck": (
        jm.OrnsteinUhlenbeckNoise(ALL, relative=False) + jm.WhiteNoise(ALL[:4], relative=False)
    ),
    "white, shared": jm.WhiteNoise(ALL, shared=True, relative=False) + jm.ResonantNoise(0.1),
}


@pytest.mark.parametrize("name", ANY)
def test_any_linear_system(x64, name):
    """`C (s - A)⁻¹ B + D + s E` of numbers at random, also where no muscle of this package has any:
    E of active inputs."""
    rng, task = np.random.default_rng(5), jm.PrescribedForce(noise=ANY[name], activation=TWITCH)
    active, roughest = (
        np.array([1, 0, 1, 0, 1]),
        min(noise.smoothness for noise in task.noise.components),
    )
    A = rng.normal(size=(3, 3)) * 15 - np.diag([40.0, 60.0, 90.0])
    B, C, D, E = (rng.normal(size=size) for size in ((3, 5), 3, 5, 5))
    D, E = D * 0.02 * ((roughest > 0) | (active == 1)), E * 1e-3 * ((roughest > 1) | (active == 1))
    system = Linearisation(np.zeros(3), np.zeros(()), A, B, C, D, E)

    def reply(f):
        s = 2j * np.pi * np.atleast_1d(f)[:, None]
        inside = np.linalg.solve(s[..., None] * np.eye(3) - A, np.broadcast_to(B, (len(s), 3, 5)))
        return (np.einsum("n,fni->fi", C, inside) + D + s * E) / (1 + s * 0.06) ** (2 * active)

    def density(f):
        total, H = np.zeros(len(f)), reply(f)
        for noise in task.noise.components:
            part = np.asarray(noise.amplitude) * H[:, ACTS_ON[len(noise.amplitude)]]
            gain = (
                np.abs(part.sum(axis=1)) ** 2 if noise.shared else np.sum(np.abs(part) ** 2, axis=1)
            )
            total = total + gain * shape(noise, f)
        return total

    given = jax.tree.map(jnp.asarray, system)
    both = at_once(
        lambda *given: (noise_variance(*given), tuple(harmonic_system(*given))),
        as_arrays(task),
        given,
    )
    variance, whole = jax.tree.map(np.asarray, both)
    np.testing.assert_allclose(variance, 2 * integral(density), rtol=1e-8)
    for f in (0.0, 1.0, 7.0):
        s, (A_h, b, c, d, e) = 2j * np.pi * f, whole
        found = c @ np.linalg.solve(s * np.eye(len(A_h)) - A_h, b) + d + s * e
        np.testing.assert_allclose(
            found, reply(f)[0] @ np.array([200.0, 200.0, 0, 0, 0]), rtol=1e-10
        )


# --- a drive that multiplies


class Multiplied(jm.model.AbstractMuscle):
    """Its pull loses with the square of the shortening; a noisy drive multiplies what is left, not
    P_w."""

    m_w: float = 0.4
    m_z: float = 0.6
    full: float = 5.0
    reach: float = 0.05

    def base(self):
        return jnp.array([100.0, 250.0, 30.0, 5.0])

    def drive(self, force, u):
        return force

    def active_force(self, x_w, v_w, u):
        pull = self.full * (1 + u[4]) * (1 - (x_w / self.reach) ** 2)
        return self.full - pull + (100.0 + u[0]) * x_w + (30.0 + u[2]) * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        return (250.0 + u[1]) * (x_z - x_w) + (5.0 + u[3]) * (v_z - v_w)

    def contraction_velocity(self, x_w, x_z, v_z, force, u):
        return v_z - (force - (250.0 + u[1]) * (x_z - x_w)) / (5.0 + u[3])


@pytest.mark.parametrize("kind", [jm.Isometric, jm.PrescribedMotion])
def test_a_drive_that_multiplies(x64, kind):
    """By hand: the drive's noise is a force `F (1 - (x/ℓ)²) n`; in Isometric it moves the mass, a
    motion asks P_w for it."""
    noise, T = (
        jm.BandLimitedNoise({"K_w": 0.02}, cutoff=20.0) + jm.ResonantNoise(0.05, 6.0, 1.5),
        0.04,
    )
    inputs = (5.0, 0.002) if kind is jm.Isometric else (0.002, 4.0)
    task = kind(*inputs, muscle=Multiplied(), noise=noise, activation=jm.Activation(T))
    rest = lambda x: 5.0 * (1 - (x / 0.05) ** 2) - 100.0 * x  # noqa: E731
    if kind is jm.Isometric:
        x = scipy.optimize.brentq(lambda x: rest(x) - 250.0 * (x - 0.002), 0.0, 0.05, xtol=1e-16)
    else:
        x = 0.002 + 4.0 / 250.0
    tangent = 100.0 + 2 * 5.0 * x / 0.05**2

    def output(f):
        s = 2j * np.pi * f
        passive = (
            (5.0 * s + 250.0) / (0.4 * s**2 + 35.0 * s + tangent + 250.0)
            if kind is jm.Isometric
            else -1.0
        )
        gain = np.abs(passive / (1 + s * T) ** 2) ** 2
        stiffness = (0.02 * 100.0 * x) ** 2 / 100.0 / (1 + (f / 20.0) ** 4)
        pull = (
            (0.05 * (rest(x) + 100.0 * x)) ** 2
            * 1.5
            / np.pi
            * f**2
            / ((36.0 - f**2) ** 2 + (1.5 * f) ** 2)
        )
        return gain * (stiffness + pull)

    variance, system = kept_jit(noise_variance), linearised(task).system
    found = variance(as_arrays(task), system)
    np.testing.assert_allclose(found, 2 * integral(output), rtol=1e-8)
    without = variance(as_arrays(task.replace(resonance_amplitude=0.0)), system)
    assert without < 0.5 * found


# --- all off, and beyond first order


@pytest.mark.parametrize("name", ["drive", pytest.param("activation", marks=pytest.mark.slow)])
def test_what_is_off_changes_no_spectrum(x64, name):
    task = TASKS[name]
    power = linear_spectrum(task, task.settings).power
    alone, silent = NoiseSum((task.noise,)), task.noise + jm.ResonantNoise(0.0)
    for noise in (alone, silent):
        np.testing.assert_allclose(
            linear_spectrum(task.with_parts(noise=noise), task.settings).power, power, rtol=1e-11
        )


def added(task):
    """Power that the second order adds, in units of its own."""
    first = np.asarray(linear_spectrum(task, task.settings).power)
    return second_order(task).power * np.maximum(first, FAINT * first.mean())


@pytest.mark.parametrize(
    "name",
    ["drive", *(pytest.param(n, marks=pytest.mark.slow) for n in ("two resonances", "shared"))],
)
def test_the_second_order_of_a_sum_of_one(x64, name):
    task = TASKS[name]
    one = task.with_parts(
        noise=(
            NoiseSum((task.noise,))
            if name != "two resonances"
            else task.noise + jm.ResonantNoise(0.0)
        )
    )
    power = second_order(task).power
    assert np.max(power) > 0
    np.testing.assert_allclose(second_order(one).power, power, rtol=1e-9)
    assert second_order(one).mean == pytest.approx(second_order(task).mean, rel=1e-9)
    assert negative_coefficients(one) == negative_coefficients(task) == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    "shared, activation", [(True, None), pytest.param(False, TWITCH, marks=pytest.mark.slow)]
)
def test_white_noise_counts_as_its_samples_in_the_second_order(x64, shared, activation):
    noises = [
        jm.WhiteNoise(BOTH, shared=shared),
        jm.BandLimitedNoise(BOTH, cutoff=50.0, shared=shared),
    ]
    white, band = (
        jm.PrescribedForce(5.0, 1.0, noise=noise, activation=activation) for noise in noises
    )
    np.testing.assert_allclose(added(white), added(band), rtol=1e-9)


@pytest.mark.parametrize("std", [0.8, 1.5])
def test_negative_coefficients_behind_the_activation(std):
    """The activation smooths the noise of the active tissue, not that of the passive."""
    tau, T, channels = 0.1, 0.06, {"K_w": std, "K_z": std}
    noise = jm.OrnsteinUhlenbeckNoise(channels, tau)
    task = jm.Isometric(noise=noise, activation=jm.Activation(T)).replace(harmonic_amplitude=0.0)
    S = lambda f: 2 * tau / (1 + (2 * np.pi * f * tau) ** 2) / (1 + (2 * np.pi * f * T) ** 2) ** 2  # noqa: E731
    smoothed = np.sqrt(2 * integral(S))
    assert smoothed < 0.8
    for sentence, channel, sd in zip(
        negative_coefficients(task), channels, (smoothed, 1.0), strict=True
    ):
        share = 100 * scipy.stats.norm.cdf(-1 / (std * sd))
        assert sentence.startswith(f"{channel} is negative for {share:.2g} % of the time")
