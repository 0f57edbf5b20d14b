"""A stretch reflex in the dynamic stiffness: against the formula by hand, and against an
integration in time with a delay line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmuscle as jm
from jaxmuscle.model import Reflex

GAIN, DELAY, TIME = 30.0, 0.04, 0.05
MOVED = jm.PrescribedLength(reflex=Reflex(GAIN, DELAY, TIME))
F = np.concatenate([np.linspace(0.3, 30.0, 80), [0.01]])


def by_hand(f, k_w, m_w=0.5, m_z=0.5, c_w=60.0, k_z=200.0, c_z=5.0):
    """`m_z s² + Z - Z²/D + (Z/D) R`, D = m_w s² + C_w s + K_w + Z."""
    s = 2j * np.pi * f
    z = k_z + c_z * s
    d = m_w * s**2 + c_w * s + k_w + z
    r = GAIN * s * np.exp(-s * DELAY) / (1 + s * TIME) ** 2
    return m_z * s**2 + z - z**2 / d + z / d * r


def test_the_dynamic_stiffness_is_that_of_two_tissues_and_a_late_force_on_the_active_one(x64):
    hold = float(jm.response.equilibrium(jm.PrescribedLength())[0])
    k_w = 200 * (1 + 3 * (hold / 0.02) ** 2)
    found = np.asarray(jm.response.dynamic_stiffness(MOVED, F))
    np.testing.assert_allclose(found, by_hand(F, k_w), rtol=1e-12)
    # slowly moved, a velocity reflex does nothing
    none = np.asarray(jm.response.dynamic_stiffness(jm.PrescribedLength(), F))
    assert abs(found[-1] / none[-1] - 1) < 0.02 < abs(found[5] / none[5] - 1)


def test_an_integration_with_a_delay_line_has_the_same_gain_and_phase(x64):
    """Euler's method, a step of 20 µs, one sine: the muscle linearised by hand."""
    f, dt, k_z, c_z, m, c_w = 4.0, 2e-5, 200.0, 5.0, 0.5, 60.0
    k_w = 200 * (1 + 3 * (float(jm.response.equilibrium(jm.PrescribedLength())[0]) / 0.02) ** 2)
    steps = round(3.0 / dt)
    t = dt * np.arange(steps)
    w = 2 * np.pi * f
    length, speed = np.sin(w * t), w * np.cos(w * t)  # lengthening
    late = np.concatenate([np.zeros(round(DELAY / dt)), speed])[:steps]
    x = v = a = b = 0.0  # of the active tissue, which shortens; the twitch and its slope
    force = np.empty(steps)
    for i in range(steps):
        pull = k_z * (x + length[i]) + c_z * (v + speed[i])
        force[i] = pull - m * w**2 * length[i]
        twitch = (GAIN * late[i] - a - 2 * b) / TIME
        x, v, a, b = (
            x + dt * v,
            v + dt * (a - k_w * x - c_w * v - pull) / m,
            a + dt * b / TIME,
            b + dt * twitch,
        )
    last = t >= 2.0  # a whole number of periods
    found = 2j * np.mean(force[last] * np.exp(-1j * w * t[last]))
    want = complex(np.asarray(jm.response.dynamic_stiffness(MOVED, np.array([f])))[0])
    assert abs(found / want - 1) < 2e-3


@pytest.mark.parametrize("name", ["reflex_gain", "reflex_delay", "reflex_time", "k_w"])
def test_slopes_are_those_of_differences(name, x64):
    def size(value):
        there = MOVED.replace(**{name: value})
        return jnp.sum(jnp.abs(jm.response.dynamic_stiffness(there, F)) ** 2)

    here = float(MOVED[name])
    step = 1e-5 * here
    apart = (size(here + step) - size(here - step)) / (2 * step)
    assert float(jax.grad(size)(here)) == pytest.approx(float(apart), rel=1e-6)


def test_a_hold_feels_nothing_of_it():
    still, usual = jm.Isometric(), MOVED.with_parts(reflex=None)
    assert "reflex_gain" in MOVED.parameter_names and "reflex_gain" not in still.parameter_names
    one, other = jm.expected_spectrum(MOVED), jm.expected_spectrum(usual)
    np.testing.assert_array_equal(one.power, other.power)


def test_it_is_saved_with_its_task(tmp_path):
    MOVED.save(tmp_path / "moved.toml")
    again = jm.load_preset(tmp_path / "moved.toml")
    assert [float(again[f"reflex_{n}"]) for n in ("gain", "delay", "time")] == [GAIN, DELAY, TIME]


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: Reflex(delay=-0.01), r"reflex_delay = -0.01 s must not be negative"),
        (lambda: Reflex(time=0.0), r"reflex_time = 0.0 s must be positive"),
        (lambda: jm.PrescribedLength(reflex=0.04), r"reflex = 0.04: give an object, as"),
        (
            lambda: jm.PrescribedLength(
                x_z=jm.model.Sampled.through(np.arange(9.0), np.sin(np.arange(9.0))),
                reflex=Reflex(),
            ),
            r"reflex: the insertion moves",
        ),
    ],
)
def test_what_cannot_be_is_refused(made, words):
    with pytest.raises(ValueError, match=words):
        made()
