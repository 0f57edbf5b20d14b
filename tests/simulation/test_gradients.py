"""Derivatives of a simulated log spectrum by every parameter: forward = reverse = finite
differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import at_once, drawing

import jaxmuscle as jm

KEY = jax.random.key(2)
SETTINGS = jm.SpectrumSettings(first_bin=2, last_bin=13)
TASKS = {
    "motion": jm.PrescribedMotion(0.004, 5.0, settings=SETTINGS),
    "force": jm.PrescribedForce(5.0, 1.0, noise=jm.WhiteNoise(0.05), settings=SETTINGS),
    "acceleration": jm.PrescribedForce(
        5.0, 1.0, noise=jm.OrnsteinUhlenbeckNoise(0.05), settings=SETTINGS, observe="acceleration"
    ),
    "all": jm.Isometric(
        5.0,
        0.003,
        noise=jm.OrnsteinUhlenbeckNoise((0.05, 0.05, 0.05, 0.05, 0.02)) + jm.ResonantNoise(0.01),
        activation=jm.Activation(0.06),
        settings=SETTINGS.replace(sampling="filtered"),
    ),
}
SUBSTEPS = {"all": 2}
WITHOUT_INFLUENCE = {"motion": (), "force": (), "acceleration": (), "all": ("m_z",)}


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_every_parameter_forward_reverse_and_by_differences(x64, name):
    task = TASKS[name].replace(harmonic_phase=0.4, harmonic_amplitude=0.02)
    names = task.parameter_names
    scale = jnp.array([float(task[n]) for n in names])
    assert jnp.all(scale != 0)

    def log_power(relative):
        changed = task.replace(**dict(zip(names, scale * relative, strict=True)))
        run = jm.simulate(changed, KEY, duration=4.0, dt=2e-3, substeps=SUBSTEPS.get(name))
        return jnp.log(run.spectrum(window=(1.0, 4.0)).power)

    n, h = len(names), 1e-5  # truncation h² f''' / 6 and rounding 1e-15 / h
    # One program for derivatives and differences: values and slopes along a parameter, at one and a
    # little off.
    along, off = (
        np.concatenate(rows)
        for rows in ([np.eye(n)] * 3, [0 * np.eye(n), h * np.eye(n), -h * np.eye(n)])
    )
    power, slopes = at_once(
        jax.vmap(lambda at, to: jax.jvp(log_power, (at,), (to,))), 1 + off, along
    )
    _, ahead, behind = np.split(np.asarray(power), 3)
    forward, differences = np.asarray(slopes)[:n].T, (ahead - behind).T / (2 * h)
    # A fault of the reverse mode in any bin shows in their sum with weights at random.
    weight = np.random.default_rng(0).normal(size=12)
    value, reverse = at_once(jax.value_and_grad(lambda at: weight @ log_power(at)), np.ones(n))

    assert forward.shape == (12, n) and np.all(np.isfinite(forward))
    largest = np.abs(forward).max()
    np.testing.assert_allclose(value, weight @ power[0], rtol=1e-9)
    np.testing.assert_allclose(reverse, weight @ forward, rtol=1e-9, atol=1e-10 * largest)
    np.testing.assert_allclose(forward, differences, atol=1e-5 * largest)
    silent = [p for p, column in zip(names, forward.T, strict=True) if np.all(column == 0)]
    assert tuple(silent) == WITHOUT_INFLUENCE[name]


def test_a_parameter_by_its_natural_name(x64):
    task = jm.Isometric()

    def last_force(k_w):
        return jm.simulate(task.replace(k_w=k_w), KEY, duration=1.0).output[-1]

    slope = at_once(jax.grad(last_force), jnp.asarray(task["k_w"]))
    h = 1e-4 * task["k_w"]
    np.testing.assert_allclose(
        slope, (last_force(task["k_w"] + h) - last_force(task["k_w"] - h)) / (2 * h), rtol=1e-6
    )


def test_a_mean_spectrum_and_the_filtered_output_by_differences(x64):
    """Also with the control variate, and the numbers are those without derivatives."""

    def of(k_w):
        task = jm.Isometric(k_w=k_w, settings=SETTINGS)
        runs = jm.ensemble(task, KEY, seeds=2, dt=2e-3, control=True)
        estimate = runs.mean_spectrum()
        assert estimate.expected is not None
        scatter = jnp.asarray(runs.filtered()).std(axis=1)
        return jnp.concatenate(
            [jnp.log(estimate.power), jnp.log(estimate.stderr), jnp.log(scatter)]
        )

    h = 5.0
    ahead, value, behind = (np.asarray(of(k_w)) for k_w in (5e5 + h, 5e5, 5e5 - h))
    again, slope = drawing(lambda k_w: jax.jvp(of, (k_w,), (jnp.ones_like(k_w),)))(jnp.asarray(5e5))
    np.testing.assert_allclose(again, value, rtol=1e-9)
    np.testing.assert_allclose(
        slope, (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-5 * np.abs(slope).max()
    )
