"""The moved insertion: linear response and nonlinear simulation against formulas and integration
written here."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import at_once
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

import jaxmuscle as jm
from jaxmuscle.model import Sampled, SmoothStep
from jaxmuscle.response import noise_density
from jaxmuscle.simulation._driven import driven

STILL = jm.Harmonic(amplitude=0.0)
PULL, M_W, M_Z, X_REF, C_W, C_Z = 8.0, 0.4, 0.3, 0.02, 45.0, 6.0
K_W, K_Z = 6e5, 9e5  # N/m^3
MUSCLE = {"m_w": M_W, "m_z": M_Z, "k_w": K_W, "k_z": K_Z, "c_w": C_W, "c_z": C_Z, "P_w": PULL}
TASK = jm.PrescribedLength(harmonic=STILL).replace(**MUSCLE)
FREQUENCY = np.array([0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0])


def rest():
    return brentq(lambda x: K_W * (X_REF**2 + x**2) * x + K_Z * X_REF**2 * x - PULL, 0.0, 0.1)


def formula(f):
    """Two masses, two springs, two dampers in series, with the tangents at rest."""
    s, k_w, k_z = 2j * np.pi * f, K_W * (X_REF**2 + 3 * rest() ** 2), K_Z * X_REF**2
    inner = M_W * s**2 + C_W * s + k_w
    return inner * (k_z + C_Z * s) / (inner + k_z + C_Z * s) + M_Z * s**2


def multisine(amplitude, period=10.0, rate=1000.0, periods=2):
    """Lines from 0.1 to 8 Hz with random phases, and their derivatives; `amplitude` is that of a
    line."""
    rng, t = np.random.default_rng(4), np.arange(round(periods * period * rate) + 1) / rate
    lines = np.array([1, 3, 7, 13, 27, 49, 80]) / period
    turns = np.exp(1j * (2 * np.pi * np.outer(t, lines) + rng.uniform(0, 2 * np.pi, len(lines))))
    return lines, amplitude * np.stack(
        [np.real(turns @ (2j * np.pi * lines) ** n) for n in (0, 1, 2)]
    )


def at_lines(signal, lines, rate):
    """Amplitudes of the last period of 10 s, which ends before the last sample."""
    last = signal[-round(10 * rate) - 1 : -1]
    return np.fft.rfft(last)[np.rint(lines * 10).astype(int)]


def test_the_stiffness_is_that_of_two_tissues_in_series():
    with jax.enable_x64(True):
        found = np.asarray(jm.response.dynamic_stiffness(TASK, FREQUENCY))
    np.testing.assert_allclose(found, formula(FREQUENCY), rtol=1e-10)


def test_forward_reverse_and_differences_agree():
    with jax.enable_x64(True):

        def real(k_w):
            return jnp.sum(
                jnp.abs(jm.response.dynamic_stiffness(TASK.replace(k_w=k_w), FREQUENCY)) ** 2
            )

        forward, reverse = (
            at_once(slope(real), jnp.asarray(K_W)) for slope in (jax.jacfwd, jax.grad)
        )
        step = 1e-4 * K_W
        between = (real(K_W + step) - real(K_W - step)) / (2 * step)
    np.testing.assert_allclose(reverse, forward, rtol=1e-10)
    np.testing.assert_allclose(between, forward, rtol=1e-6)


def test_a_small_motion_is_answered_linearly():
    """The issue's bound: 1e-4 relative."""
    lines, motion = multisine(1e-6)
    with jax.enable_x64(True):
        force = driven(TASK, motion, 1e-3)
    # half as many samples
    measured = -at_lines(force, lines, 500.0) / at_lines(motion[0], lines, 1000.0) * 2
    np.testing.assert_allclose(measured, formula(lines), rtol=1e-4)


@pytest.mark.parametrize(("m_w", "close"), [(M_W, 1e-6), (0.01, 1e-5)])
def test_a_large_motion_is_answered_as_scipy_integrates_it(m_w, close):
    """A light and damped tissue has a rate of 5100 /s: a step of 2 ms is cut into eight, which
    still see little of how it jumps to its speed at the begin."""
    _, motion = multisine(1e-3)
    t = np.arange(motion.shape[1]) / 1000.0

    def passive(y, x_z, v_z):
        return C_Z * (1 + v_z**2) * (v_z - y[1]) + K_Z * (X_REF**2 + x_z**2) * (x_z - y[0])

    task = TASK.replace(m_w=m_w)
    smooth = CubicSpline(t, motion[:2], axis=1)

    def exact(now, y):
        x_z, v_z = smooth(now)
        return [
            y[1],
            (
                PULL
                - C_W * (1 + y[1] ** 2) * y[1]
                - K_W * (X_REF**2 + y[0] ** 2) * y[0]
                + passive(y, x_z, v_z)
            )
            / m_w,
        ]

    at = t[:2001:2]
    found = solve_ivp(
        exact,
        (0.0, at[-1]),
        [rest(), 0.0],
        method="LSODA",
        t_eval=at,
        rtol=1e-11,
        atol=1e-13,
        max_step=0.01,
    )
    expected = (
        -(passive(found.y, *motion[:2, :2001:2]) + M_Z * motion[2, :2001:2])
        - K_Z * X_REF**2 * rest()
    )
    with jax.enable_x64(True):
        force = driven(task, motion, 1e-3)[: len(at)]
    np.testing.assert_allclose(force, expected, atol=close * np.max(np.abs(expected)))


def test_simulate_moves_the_insertion():
    """The ordinary simulation with the motion as a signal, without noise, against the same at fixed
    steps."""
    _, motion = multisine(1e-3, periods=1)
    t = np.arange(motion.shape[1]) / 1000.0
    moved, held = Sampled.through(t[::5], motion[0, ::5]), jm.model.Constant(PULL)
    quiet = TASK.with_parts(
        x_z=moved, P_w=held, noise=jm.BandLimitedNoise(0.0), initial=(rest(), 0.0)
    )
    with jax.enable_x64(True):
        run = jm.simulate(quiet, jax.random.key(0), duration=8.0, dt=1e-3)
        expected = driven(TASK, motion, 1e-3) + K_Z * X_REF**2 * rest()
    seen = np.asarray(run.output)
    np.testing.assert_allclose(seen[1:], expected[::5][1 : len(seen)], atol=2e-4 * np.ptp(expected))


def test_an_insertion_at_rest_is_isometric():
    one = jm.PrescribedLength(x_z=0.003)
    other = jm.Isometric(x_z=0.003)
    a, b = (np.asarray(jm.simulate(task, jax.random.key(1)).output) for task in (one, other))
    # single precision, and b passes zero
    np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6 * np.abs(b).max())
    np.testing.assert_allclose(
        jm.expected_spectrum(one).power, jm.expected_spectrum(other).power, rtol=1e-4
    )


def test_the_density_of_the_noise():
    """Noise on K_w alone: a force -x_w ΔK_w on the active mass."""
    task = TASK.with_parts(noise=jm.BandLimitedNoise({"K_w": 0.1}))
    s, k_z = 2j * np.pi * FREQUENCY, K_Z * X_REF**2
    inner = M_W * s**2 + (C_W + C_Z) * s + K_W * (X_REF**2 + 3 * rest() ** 2) + k_z
    gain = rest() * (C_Z * s + k_z) / inner
    two_sided = (0.1 * K_W * X_REF**2) ** 2 / 100 / (1 + (FREQUENCY / 50) ** 4)
    with jax.enable_x64(True):
        found = np.asarray(noise_density(task, FREQUENCY))
    np.testing.assert_allclose(found, 2 * two_sided * np.abs(gain) ** 2, rtol=1e-10)


def test_what_has_no_stiffness_is_refused():
    with pytest.raises(
        ValueError, match=r"PrescribedForce, in which the insertion is not moved.*as_task"
    ):
        jm.response.dynamic_stiffness(jm.PrescribedForce(), FREQUENCY)
    moving = TASK.with_parts(x_z=SmoothStep(0.01, start=4.0, rise=10.0))
    with pytest.raises(ValueError, match="x_z of this PrescribedLength moves"):
        jm.response.dynamic_stiffness(moving, FREQUENCY)
    with pytest.raises(ValueError, match=r"WhiteNoise on K_z .* PrescribedLength"):
        jm.PrescribedLength(noise=jm.WhiteNoise({"K_z": 0.01}))
