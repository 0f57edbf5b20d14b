"""A task taken apart into arrays by name and put together again: what `jax.grad` and optimisers
work on."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import at_once

import jaxmuscle as jm

TASK = jm.Isometric()
NAMES = ("k_w", "c_z", "noise_K_w", "noise_K_z", "harmonic_amplitude", "harmonic_frequency", "P_w")
STEP = 1e-4  # relative, of a central difference: truncation 1e-8, rounding 1e-12
SLOPE = 1e-5


def loss(task):
    """Unevenly weighted log powers, so that no slope is zero by symmetry."""
    power = jnp.log(jm.expected_spectrum(task).power)
    return jnp.sum(jnp.arange(1.0, power.size + 1.0) * power)


@functools.cache
def by_name():
    values, rebuild = jm.model.partition(TASK, NAMES)
    return values, rebuild, at_once(jax.grad(lambda v: loss(rebuild(v))), values)


@pytest.mark.parametrize(
    "task",
    [jm.Isometric(), jm.PrescribedForce(), jm.PrescribedMotion()],
    ids=lambda t: type(t).__name__,
)
def test_values_are_arrays_by_name_and_rebuild_the_task(x64, task):
    values, rebuild = jm.model.partition(task, task.parameter_names)
    assert tuple(values) == task.parameter_names
    assert all(isinstance(value, jax.Array) and value.shape == () for value in values.values())
    again = rebuild(values)
    assert type(again) is type(task)
    assert {name: float(value) for name, value in again.parameters.items()} == {
        n: float(task[n]) for n in values
    }
    assert (
        float(rebuild({"k_w": 4e5})["k_w"]) == 4e5 and rebuild({"k_w": 4e5})["c_w"] == task["c_w"]
    )


def test_precision_is_the_callers():
    """Also for a whole number, which `jax.grad` would refuse."""
    values, _ = jm.model.partition(TASK.replace(P_w=5), NAMES)
    assert {value.dtype.name for value in values.values()} == {"float32"}
    with jax.enable_x64(True):
        values, _ = jm.model.partition(TASK, NAMES)
        assert {value.dtype.name for value in values.values()} == {"float64"}


def test_slopes_by_name_against_differences_and_against_replace(x64):
    values, rebuild, slopes = by_name()
    assert set(slopes) == set(NAMES)
    direct = jax.jacfwd(lambda v: loss(TASK.replace(**dict(zip(NAMES, v, strict=True)))))
    together = at_once(direct, jnp.stack([values[name] for name in NAMES]))
    np.testing.assert_allclose([slopes[name] for name in NAMES], together, rtol=1e-9)
    for name in NAMES:
        h = STEP * float(values[name])
        ahead, behind = (
            float(loss(rebuild(values | {name: values[name] + s * h}))) for s in (1, -1)
        )
        assert float(slopes[name]) != 0
        np.testing.assert_allclose(slopes[name], (ahead - behind) / (2 * h), rtol=SLOPE)


def test_what_filter_grad_says_of_numbers_and_of_arrays(x64):
    """The reason for `partition`: None for a Python number, and the slope where all numbers have
    become arrays."""
    assert eqx.filter_grad(loss)(TASK).muscle.stiffness_w.k is None

    def three(task):
        whole = eqx.filter_grad(loss)(task)
        return whole.muscle.stiffness_w.k, whole.noise.amplitude[0], whole.P_w.level

    found, (_, _, slopes) = at_once(three, jax.tree.map(jnp.asarray, TASK)), by_name()
    np.testing.assert_allclose(
        found, [slopes[name] for name in ("k_w", "noise_K_w", "P_w")], rtol=1e-9
    )


def test_a_gradient_step_by_an_optimiser_of_pytrees(x64):
    """`optax` moves such dictionaries: ten steps of plain descent in the logarithm lower the loss
    at every step."""
    optax = pytest.importorskip("optax")
    target = jnp.log(jm.expected_spectrum(TASK.replace(k_w=4e5, c_w=80.0)).proportional)
    values, rebuild = jm.model.partition(TASK, ("k_w", "c_w"))

    def misfit(logs):
        found = jm.expected_spectrum(rebuild(jax.tree.map(jnp.exp, logs))).proportional
        return jnp.mean((jnp.log(found) - target) ** 2)

    logs = jax.tree.map(jnp.log, values)
    descent = optax.sgd(0.3)
    state, costs = descent.init(logs), []
    both = jax.jit(jax.value_and_grad(misfit))
    for _ in range(10):
        cost, slopes = both(logs)
        costs.append(float(cost))
        updates, state = descent.update(slopes, state, logs)
        logs = optax.apply_updates(logs, updates)
    assert np.all(np.diff(costs) < 0) and costs[-1] < 0.5 * costs[0]


def test_a_rebuilt_task_is_simulated_and_saved(x64, tmp_path):
    values, rebuild = jm.model.partition(TASK, NAMES)
    again = rebuild(values)
    runs = [jm.simulate(task, jax.random.key(0), duration=1.0).output for task in (TASK, again)]
    np.testing.assert_allclose(runs[1], runs[0], rtol=1e-12)
    jm.save_preset(tmp_path / "again.toml", again)
    assert jm.load_preset(tmp_path / "again.toml").parameters == TASK.parameters


def test_wrong_names_and_values_are_refused():
    with pytest.raises(ValueError, match="unknown parameter 'k'"):
        jm.model.partition(TASK, ("k",))
    with pytest.raises(
        ValueError, match=r"names = 'k_w' is one text: give a list of names, \['k_w'\]"
    ):
        jm.model.partition(TASK, "k_w")
    _, rebuild = jm.model.partition(TASK, ("k_w",))
    with pytest.raises(ValueError, match=r"k_w = -1.0 N/m\^3 is outside"):
        rebuild({"k_w": -1.0})
