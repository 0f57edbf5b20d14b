"""What the linear response is made of: the linearised task, and the autocovariance of its noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import jaxmuscle as jm
from jaxmuscle.response._equilibrium import HOLD

# Of central differences with relative steps of 1e-4: truncation 1e-8, rounding 1e-10.
DIFFERENCE = 1e-6
TASKS = (
    jm.Isometric(),
    jm.PrescribedMotion(F_ext=jm.model.Constant(10.0)),
    jm.PrescribedForce(observe="acceleration", F_ext=0.5),
)


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def differences(function, at):
    """Central differences of a function of a vector, a column for each entry."""
    steps = 1e-4 * np.maximum(np.abs(at), 1e-2)
    columns = [
        (np.asarray(function(at + h * e)) - np.asarray(function(at - h * e))) / (2 * h)
        for h, e in zip(steps, np.eye(len(at)), strict=True)
    ]
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("task", TASKS, ids=lambda t: type(t).__name__)
def test_a_linearised_task_has_the_slopes_of_its_equations(task):
    system = jm.response.linearise(task)
    point = np.asarray(system.point)
    n, none = len(point), jnp.zeros(5)
    field = jax.jit(lambda *at: task.vector_field(*at))
    output = jax.jit(lambda *at: task.output(*at))
    np.testing.assert_allclose(field(HOLD, point, none), 0.0, atol=1e-9)
    assert float(system.rest) == pytest.approx(float(output(HOLD, point, none, none)), rel=1e-12)
    at = np.concatenate([point, np.zeros(10)])
    wanted = np.concatenate(
        [
            differences(lambda x: field(HOLD, x[:n], x[n : n + 5]), at),
            differences(lambda x: output(HOLD, x[:n], x[n : n + 5], x[n + 5 :]), at)[None],
        ]
    )
    found = np.zeros_like(wanted)
    found[:n, :n], found[:n, n : n + 5] = system.A, system.B
    found[n] = np.concatenate([system.C, system.D, system.E])
    np.testing.assert_allclose(found, wanted, rtol=DIFFERENCE, atol=1e-6 * np.abs(wanted).max())


def test_the_transfer_function_gives_the_density_of_the_noise():
    task = TASKS[0]
    A, B, C, D, E = map(np.asarray, jm.response.linearise(task)[2:])
    f, scale = np.array([0.3, 3.0, 30.0]), np.append(task.noise_scale(), 0.0)
    wanted = []
    for s in 2j * np.pi * f:
        gain = C @ np.linalg.solve(s * np.eye(len(A)) - A, B) + D + s * E
        wanted.append(2 * np.sum(np.abs(gain * scale) ** 2))
    wanted *= np.asarray(task.noise.density(f))
    np.testing.assert_allclose(jm.response.noise_density(task, f), wanted, rtol=1e-9)


def test_a_task_that_has_no_linear_response_is_refused():
    with pytest.raises(jm.errors.OperatingPointError, match=r"undamped|no equilibrium|unstable"):
        jm.response.linearise(jm.Isometric(c_w=0.0, c_z=0.0))
    moving = jm.Isometric(jm.model.RampHold(5.0, start=4.0, ramp=8.0))
    with pytest.raises(jm.errors.OperatingPointError, match=r"P_w of this Isometric moves"):
        jm.response.linearise(moving)
    early, late = (jm.response.linearise(moving, time) for time in (7.0, 14.0))
    assert float(early.rest) < float(late.rest)


F_MAX, POINTS = 2000.0, 400_001
# of r(0): the power above 2 kHz, where the density of the fastest of these falls as f⁻²
TAIL = 1e-3
LAGS = np.array([0.0, 0.004, 0.05, 0.3, -0.3])


@pytest.mark.parametrize(
    "task",
    [jm.model.on_rung(jm.Isometric(), 2), jm.Isometric(noise=jm.PinkNoise(shared=True))],
    ids=["activation and resonance", "pink, shared"],
)
def test_autocovariance_is_the_transform_of_the_density(task):
    """Wiener and Khinchin, by scipy."""
    f = np.linspace(1e-6, F_MAX, POINTS)
    density = np.asarray(jm.response.noise_density(task, f))
    wanted = [scipy.integrate.simpson(density * np.cos(2 * np.pi * f * lag), x=f) for lag in LAGS]
    found = np.asarray(jm.response.autocovariance(task, LAGS))
    np.testing.assert_allclose(found, wanted, atol=TAIL * found[0])
    assert found[-1] == found[-2]


def test_autocovariance_of_any_shape_and_at_any_lag():
    task = jm.model.on_rung(jm.Isometric(), 2)
    grid = np.asarray(jm.response.autocovariance(task, LAGS[:4].reshape(2, 2)))
    assert grid.shape == (2, 2) and jm.response.autocovariance(task, 0.05).shape == ()
    np.testing.assert_allclose(grid[1, 0], jm.response.autocovariance(task, 0.05), rtol=1e-12)
    assert np.all(np.abs(jm.response.autocovariance(task, np.array([1e3, 1e5]))) < 1e-12 * grid[0])


def test_slopes_of_the_autocovariance_are_those_of_differences():
    """With the task and with the lag: one that is not 0 everywhere, in reverse mode."""
    task, lag = jm.model.on_rung(jm.Isometric(), 2), 0.05

    def at(k_w, lag):
        return jm.response.autocovariance(task.replace(k_w=k_w), lag)

    slopes = jax.jit(jax.grad(at, argnums=(0, 1)))(5e5, lag)
    for slope, step in zip(slopes, ((50.0, 0.0), (0.0, 1e-5)), strict=True):
        ahead, behind = (float(at(5e5 + s * step[0], lag + s * step[1])) for s in (1, -1))
        wanted = (ahead - behind) / (2 * max(step))
        assert wanted != 0 and float(slope) == pytest.approx(wanted, rel=DIFFERENCE)
