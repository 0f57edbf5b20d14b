"""Simulated noise responses against closed forms: spectra of a linear oscillator, means under
damping noise."""

import functools

import jax
import numpy as np
import pytest
import references
import scipy.integrate
from compiled import at_once
from noise_paths import coarsen, draw_normals, respond

import jaxmuscle as jm
from jaxmuscle.model import QuadraticDamping, QuadraticStiffness
from jaxmuscle.simulation._grid import Grid

KEY = jax.random.key(23)
MASS, K, C_W, C_Z, FORCE = 0.5, 200.0, 3.0, 1.0, 5.0
HUGE = 1e4  # reference displacement and velocity that make the laws constant to 1e-9


def linear_muscle(stiffness=K, c_w=C_W, c_z=C_Z):
    stiff, damp = (
        QuadraticStiffness(stiffness / HUGE**2, HUGE),
        functools.partial(QuadraticDamping, v_ref=HUGE),
    )
    return jm.Muscle(MASS, MASS, stiff, stiff, damp(c_w / HUGE**2), damp(c_z / HUGE**2))


def oscillator(noise):
    rest = FORCE / (2 * K)
    still = jm.Harmonic(0.0)
    return jm.Isometric(
        jm.model.Constant(FORCE),
        muscle=linear_muscle(),
        noise=noise,
        harmonic=still,
        initial=(rest, 0.0),
    )


def response(f, noise):
    """Density of F_ext: what N_Kw and N_Kz do to m x'' + C x' + K x = P at its equilibrium x, seen
    at the sensor."""
    s, rest = 2j * np.pi * f, FORCE / (2 * K)
    passive = (C_Z * s + K) / (MASS * s**2 + (C_W + C_Z) * s + 2 * K)
    amplitude = np.asarray(noise.amplitude) * K
    gains = (amplitude[0] * rest * np.abs(passive)) ** 2 + (
        amplitude[1] * rest * np.abs(1 - passive)
    ) ** 2
    match noise:
        case jm.WhiteNoise():
            return gains / noise.rate
        case jm.BandLimitedNoise():
            return gains / noise.rate / (1 + (f / noise.cutoff) ** 4)
        case jm.OrnsteinUhlenbeckNoise():
            return (
                gains
                * 2
                * noise.correlation_time
                / (1 + (2 * np.pi * f * noise.correlation_time) ** 2)
            )


SMALL = 2e-3  # second order effects of this noise are 1e-5 of its power


@pytest.mark.parametrize(
    "noise",
    [
        jm.WhiteNoise({"K_w": SMALL}),
        jm.BandLimitedNoise({"K_w": SMALL, "K_z": SMALL / 2}, cutoff=20.0),
        jm.OrnsteinUhlenbeckNoise({"K_w": SMALL, "K_z": SMALL / 2}, 0.05),
    ],
    ids=["white", "band-limited", "ornstein-uhlenbeck"],
)
def test_spectrum_of_a_linear_oscillator(x64, noise):
    task = oscillator(noise)
    power = np.asarray(jm.ensemble(task, KEY, seeds=256, substeps=1, chunk=32).spectrum().power)
    expected = references.expected_welch(functools.partial(response, noise=task.noise))
    error = power.std(axis=0, ddof=1) / np.sqrt(len(power))
    assert np.all(error < 0.04 * expected)
    # Hann bins three apart are independent.
    references.assert_standard_normal((power.mean(axis=0) - expected) / error, every=3)

    # The step's bias, by halving it with the same noise: 4/3 of the difference, Heun's mean being
    # of order two here. So many seeds have it to a twentieth of the error above.
    seeds = 128 if isinstance(noise, jm.WhiteNoise) else 32

    def spectra(key):
        fine = draw_normals(noise, key, 30_000)
        halved = coarsen(noise, fine, 5e-4, 2)
        pairs = (fine, Grid(5e-4, 30_000, 20)), (halved, Grid(1e-3, 15_000, 10))
        outputs = [respond(task, normals, grid)[1] for normals, grid in pairs]
        return [
            jm.spectra.spectrum_of(output, task.settings, (5.0, 15.0)).power for output in outputs
        ]

    fine, coarse = map(np.asarray, at_once(jax.vmap(spectra), jax.random.split(KEY, seeds)))
    bias = 4 / 3 * np.abs(np.mean(coarse - fine, axis=0))
    assert np.all(bias < 0.3 * error)


RATE, DIFFUSION = 20.0, 4.0  # C/m [1/s], and density of the noise of C/m [1/s]


def sliding(noise_of, mean):
    """`v' = P/m - (λ + n) v`: a mass in a viscous medium with noisy viscosity, pulled to v = 1
    without noise."""
    amplitude = np.sqrt(DIFFUSION) / RATE  # of C_w0, per √Hz
    noise = noise_of({"C_w": amplitude * 10.0}, rate=100.0)
    muscle = linear_muscle(0.0, c_w=RATE * MASS, c_z=0.0)
    pull = jm.model.Constant(RATE * MASS)
    return jm.PrescribedForce(
        pull, noise=noise, muscle=muscle, harmonic=jm.Harmonic(0.0), initial=(0, mean, 0, 0)
    )


def mean_velocity(task, dt, seeds=256):
    """Mean and standard error over seeds of the velocity, after it has forgotten its start
    (e^{-18})."""
    runs = jm.ensemble(task, KEY, seeds=seeds, duration=6.0, dt=dt, substeps=1)
    means = np.asarray(runs.state("v_w"))[:, 101:].mean(axis=1)
    return means.mean(), means.std(ddof=1) / np.sqrt(seeds)


def test_white_damping_noise_is_stratonovich(x64):
    """`dv = λ (1 - v) dt - √D v ∘ dW` has the mean λ / (λ - D/2); in the sense of Itô it would be
    1."""
    expected = RATE / (RATE - DIFFUSION / 2)
    # Heun's mean decays by 1 - λh + Dh/2 + (λh)²/2 per step: a bias of h (λ² - (λ - D/2)²) / 2 (λ -
    # D/2).
    dt = 2.5e-4
    mean, error = mean_velocity(sliding(jm.WhiteNoise, expected), dt)
    bias = dt * (RATE**2 - (RATE - DIFFUSION / 2) ** 2) / (2 * (RATE - DIFFUSION / 2))
    assert bias < 0.3 * error
    assert abs(mean - expected) < 2.6 * error  # 1 %
    assert mean - 1.0 > 20 * error


def coloured_mean(cutoff):
    """E v = λ ∫ exp(-λ τ + Var(∫_0^τ n) / 2) dτ, exact for Gaussian n; Var = 2 ∫ (τ - r) R(r)
    dr."""
    w = 2 * np.pi * cutoff
    tau = np.linspace(0.0, 2.0, 40_001)
    a = w * tau / np.sqrt(2)
    covariance = DIFFUSION * w / (2 * np.sqrt(2)) * np.exp(-a) * (np.cos(a) + np.sin(a))
    once = scipy.integrate.cumulative_simpson(covariance, x=tau, initial=0)
    variance = 2 * scipy.integrate.cumulative_simpson(once, x=tau, initial=0)
    return RATE * scipy.integrate.simpson(np.exp(-RATE * tau + variance / 2), x=tau)


@pytest.mark.slow
def test_white_noise_is_the_limit_of_band_limited_noise(x64):
    limit = RATE / (RATE - DIFFUSION / 2)
    distance, standard = [], []
    for cutoff, dt in ((2.0, 5e-4), (10.0, 5e-4), (100.0, 5e-4)):
        expected = coloured_mean(cutoff)
        mean, error = mean_velocity(
            sliding(functools.partial(jm.BandLimitedNoise, cutoff=cutoff), expected), dt
        )
        standard.append((mean - expected) / error)
        distance.append(abs(mean - limit))
    references.assert_standard_normal(standard)
    assert distance[0] > distance[1] > distance[2]
    assert distance[2] < 0.1 * abs(1.0 - limit)
