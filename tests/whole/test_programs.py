"""The programs of the design document run as written; those that the README has too are in
test_pages.py."""

import jax
import numpy as np
import pytest
from compiled import at_once

import jaxmuscle as jm


@pytest.mark.slow
def test_the_papers_tasks():
    task1 = jm.load_preset("zagrodny-slifkin")
    ax = jm.simulate(task1, jax.random.key(1)).plot()
    task2 = task1.as_task(jm.PrescribedForce)
    assert "P" in ax.get_ylabel()
    assert (
        task2.muscle is task1.muscle
        and task2.noise is task1.noise
        and task2.harmonic is task1.harmonic
    )


@pytest.mark.slow
def test_gradients_by_natural_name():
    task1 = jm.load_preset("zagrodny-slifkin")
    power = lambda k: jm.expected_spectrum(task1.replace(k_w=k)).proportional[10]  # noqa: E731
    slope = float(at_once(jax.grad(power), jax.numpy.asarray(task1["k_w"])))
    k = float(task1["k_w"])
    difference = float(power(1.01 * k) - power(0.99 * k)) / (0.02 * k)
    assert slope == pytest.approx(difference, rel=0.01)  # 1 % steps in single precision


@pytest.mark.slow
def test_a_users_own_muscle_has_noise_spectra_and_gradients():
    from jaxmuscle.model import AbstractMuscle

    class Linear(AbstractMuscle):
        m_w: float = 0.5
        m_z: float = 0.5
        stiffness: float = 300.0
        damping: float = 40.0

        def base(self):
            return jax.numpy.stack(
                [jax.numpy.asarray(v) * 1.0 for v in (self.stiffness, 200.0, self.damping, 5.0)]
            )

        def active_force(self, x_w, v_w, u):
            return (self.stiffness + u[0]) * x_w + (self.damping + u[2]) * v_w

        def passive_force(self, x_w, v_w, x_z, v_z, u):
            return (200.0 + u[1]) * (x_z - x_w) + (5.0 + u[3]) * (v_z - v_w)

        def contraction_velocity(self, x_w, x_z, v_z, force, u):
            return v_z - (force - (200.0 + u[1]) * (x_z - x_w)) / (5.0 + u[3])

    for kind in (jm.Isometric, jm.PrescribedForce, jm.PrescribedMotion):
        task = kind(muscle=Linear())
        assert task["stiffness"] == 300.0
    # The last, a motion, asks for all its methods. `floor` simulates it held, test_expected.py at a
    # prescribed force.
    power = jm.ensemble(task, jax.random.key(0), seeds=8).spectrum().mean().proportional
    assert np.all(np.isfinite(power))

    def floor(stiffness):
        moved = jm.simulate(
            jm.Isometric(muscle=Linear()).replace(stiffness=stiffness), jax.random.key(0)
        )
        return moved.spectrum().power[10]

    assert np.isfinite(at_once(jax.grad(floor), jax.numpy.asarray(300.0)))
