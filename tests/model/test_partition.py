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


class Own(jm.model.AbstractMuscle):
    """A muscle as a user writes one: plain numbers, one in a part that is a plain module, and a
    network, which holds functions."""

    class Law(eqx.Module):
        k: float

    m_w: float = 1
    m_z: float = 0.5
    law: Law = eqx.field(default_factory=lambda: Own.Law(200))
    net: eqx.nn.MLP = eqx.field(
        default_factory=lambda: eqx.nn.MLP("scalar", "scalar", 3, 1, key=jax.random.key(0))
    )
    order: int = eqx.field(static=True, default=2)

    def base(self):
        return jnp.stack([jnp.asarray(self.law.k)] * 2 + [jnp.asarray(10.0)] * 2)

    def active_force(self, x_w, v_w, u):
        return (self.law.k + self.net(x_w) + u[0]) * x_w + (10.0 + u[2]) * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        return (200.0 + u[1]) * (x_z - x_w) + (10.0 + u[3]) * (v_z - v_w)


@pytest.mark.parametrize(
    "task",
    [
        jm.Isometric(5, k_w=400000, noise=jm.PinkNoise({"K_w": 1})),
        jm.PrescribedForce(activation=jm.Activation(1), initial=(0, 0, 0, 0)),
        jm.PrescribedMotion(F_ext=np.array(7.0), harmonic=jm.Harmonic(frequency=np.float32(9.5))),
        jm.PrescribedLength(x_z=jm.model.RampHold(0), noise=jm.OrnsteinUhlenbeckNoise(1, 1)),
        jm.model.on_rung(jm.Isometric(), 3).replace(P_w=6, resonance_2_width=2),
        jm.Isometric(muscle=Own()),
    ],
    ids=lambda t: f"{type(t).__name__} {type(t.muscle).__name__} {t.activation is None}",
)
def test_all_numbers_of_a_task_are_inexact_arrays(task, tmp_path):
    """Whatever was given: whole numbers, arrays without axes, single precision. Reading one by its
    name still gives a number of Python, and its table the same as before."""
    assert all(map(eqx.is_inexact_array, jax.tree.leaves(task)))
    numbers, _ = eqx.partition(task, eqx.is_inexact_array)
    assert len(jax.tree.leaves(numbers)) == len(jax.tree.leaves(task))
    assert all(type(value) is float for value in task.parameters.values())
    assert "float64" not in repr((task, task.muscle, task.noise, task.parameters))
    assert jax.tree.structure(jax.grad(lambda t: t["m_w"])(task)) == jax.tree.structure(task)
    if not isinstance(task.muscle, Own):
        task.save(tmp_path / "task.toml")
        assert jm.load_preset(tmp_path / "task.toml") == task


def test_own_arrays_and_tracers_stay_what_they_are(x64):
    own = jnp.asarray(0.25)
    assert jm.Harmonic(0.01, own).frequency is own
    assert jax.jit(lambda f: jm.Harmonic(0.01, f).frequency)(own) == own
    muscle = jm.Muscle(m_w=2)
    assert muscle == jm.Muscle(m_w=2.0) and hash(muscle) == hash(jm.Muscle(m_w=np.float64(2)))


def test_filter_grad_has_the_slope_of_every_number(x64):
    def three(task):
        whole = eqx.filter_grad(loss)(task)
        return whole.muscle.stiffness_w.k, whole.noise.amplitude[0], whole.P_w.level

    (_, _, slopes) = by_name()
    np.testing.assert_allclose(
        at_once(three, TASK), [slopes[name] for name in ("k_w", "noise_K_w", "P_w")], rtol=1e-9
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
    again.save(tmp_path / "again.toml")
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
