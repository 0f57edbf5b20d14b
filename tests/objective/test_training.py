"""Tasks, data and free parameters as pytrees: trained, mapped over people and compiled once."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxmuscle as jm

BUNDLED = jm.load_target("vastus-lateralis-26mvc")
TASK = BUNDLED.task()
# of the trials' coefficients of variation: for the first person the expected scatter is larger, for
# the second that of the trials
VARIATIONS = ((0.0101, 0.0102), (0.005, 0.03), (0.01, 0.012))
SEGMENTS = ((7, 8), (30, 12), (6, 6))
RATE = 0.01
# relative steps of a central difference: truncation 1e-6, and rounding of a likelihood near 100
STEP, SLOPE = 1e-3, 1e-5


def person(i, seed=0):
    scatter = np.random.default_rng([seed, i]).gamma(20, 1 / 20, len(BUNDLED.bins))
    return jm.Target(
        f"person {i}",
        BUNDLED.proportional_power * scatter,
        settings=BUNDLED.settings,
        segments=SEGMENTS[i],
        coefficient_of_variation=VARIATIONS[i],
    )


def stacked(trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def loss(task, data):
    return -jm.objective.log_likelihood(task, data)


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@functools.cache
def trained():
    """Three people's tasks, the same after four steps of Adam for every number, each in units of
    itself; what the steps saw; and how often the step was traced."""
    tasks = [TASK.replace(P_w=5 + i, k_w=5e5 * 1.1**i) for i in range(3)]
    moving, optimiser, traces = stacked(tasks), optax.adam(RATE), []

    @eqx.filter_jit
    def step(tasks, state, data):
        traces.append(1)
        values, slopes = eqx.filter_vmap(eqx.filter_value_and_grad(loss))(tasks, data)
        relative = jax.tree.map(lambda g, x: g * x, slopes, tasks)
        with jax.numpy_dtype_promotion("standard"):  # optax counts in whole numbers
            updates, state = optimiser.update(relative, state)
        moved = jax.tree.map(lambda u, x: u * x, updates, tasks)
        return eqx.apply_updates(tasks, moved), state, values, slopes

    state, seen = optimiser.init(eqx.filter(moving, eqx.is_inexact_array)), []
    for seed in (0, 0, 0, 1):  # people with other numbers at last
        data = stacked([person(i, seed).data() for i in range(3)])
        moving, state, *found = step(moving, state, data)
        seen.append(found)
    return tasks, moving, seen, len(traces)


def test_all_numbers_of_all_people_are_trained_by_one_program():
    tasks, moving, seen, traces = trained()
    assert traces == 1
    first, third = (np.asarray(values) for values, _ in (seen[0], seen[2]))
    assert np.all(third < first)
    before, after = jax.tree.leaves(stacked(tasks)), jax.tree.leaves(moving)
    slopes = jax.tree.leaves(seen[0][1])
    assert len(before) == len(after) == len(slopes) == 22
    for x, y, slope in zip(before, after, slopes, strict=True):
        felt = (np.abs(slope) > 0) & (x != 0)  # not when P_w begins, or where x_z is 0
        assert np.all(np.asarray(x != y)[felt])


def test_mapped_likelihoods_are_those_of_the_targets_one_by_one():
    tasks, _, seen, _ = trained()
    alone = [-float(jm.objective.log_likelihood(task, person(i))) for i, task in enumerate(tasks)]
    np.testing.assert_allclose(seen[0][0], alone, rtol=1e-10)
    bare = [
        -float(jm.objective.log_likelihood(task, person(i).data())) for i, task in enumerate(tasks)
    ]
    np.testing.assert_array_equal(bare, alone)


@pytest.mark.parametrize("name", ["k_w", "noise_K_w", "m_w"])
def test_their_slopes_are_those_of_differences(name):
    """Also that of the error of the coefficient of variation, which moves with the task."""
    tasks, _, seen, _ = trained()
    for i, task in enumerate(tasks):
        h = STEP * float(task[name])
        ahead, behind = (
            loss(task.replace(**{name: float(task[name]) + s * h}), person(i)) for s in (1, -1)
        )
        slope = float(jax.tree.map(lambda g, i=i: g[i], seen[0][1])[name])
        assert slope == pytest.approx(float(ahead - behind) / (2 * h), rel=10 * SLOPE)


def test_data_are_arrays_and_settings():
    data = person(0).data()
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(data))
    np.testing.assert_allclose(np.exp(data.log_power), person(0).proportional_power)
    np.testing.assert_array_equal(BUNDLED.settings.frequency[data.chosen], person(0).frequency)
    same = [jax.tree.structure(person(i).data()) for i in range(3)]
    assert same[0] == same[1] == same[2]
    long = jm.Target("long", np.ones(30), settings=BUNDLED.settings, segments=40)
    assert jax.tree.structure(long.data()) != same[0]  # 5200 samples take a larger program


def test_data_that_cannot_be_used_are_refused():
    with pytest.raises(ValueError, match=r"JAX is tracing the target 'person 0'. Give its arrays"):
        jax.jit(jm.objective.log_likelihood)(TASK, person(0))
    with pytest.raises(ValueError, match=r"these are of 3 targets in one. Map over them"):
        jm.objective.log_likelihood(TASK, stacked([person(i).data() for i in range(3)]))
    with pytest.raises(ValueError, match="does not state its segments"):
        jm.Target("bare", np.ones(30)).data()


NAMES = ("k_w", "noise_K_w", "harmonic_frequency", "harmonic_phase", "P_w")


def test_free_parameters_as_a_vector_and_back():
    free = jm.objective.free(TASK, NAMES)
    assert (
        free.names == NAMES
        and jm.objective.free(TASK).names == jm.fits.problem(TASK, BUNDLED).names
    )
    assert free.task(free.start).parameters == pytest.approx(TASK.parameters, rel=1e-14)
    vector = free.start + np.linspace(-0.5, 0.5, len(NAMES))
    task = free.task(vector)
    np.testing.assert_allclose(free.vector(task), vector, rtol=1e-12)
    assert {name: task[name] for name in NAMES} == free.parameters(vector)
    assert task["c_w"] == TASK["c_w"]
    row = jm.model.PARAMETERS["k_w"]
    assert task["k_w"] == pytest.approx(5e5 * np.exp(-0.5 * row.prior_sd))
    inside = jm.objective.free(TASK, ["k_w"], bounds={"k_w": (1e5, 2e6)})
    for step, limit in ((-50.0, 1e5), (50.0, 2e6)):
        assert inside.task(np.array([step]))["k_w"] == pytest.approx(limit)
    assert "free parameters of Isometric" in str(free) and "harmonic_phase" in str(free)


def test_a_problem_has_the_same_coordinates():
    """And the same prior, but for that of the damping ratio, which these two do not move."""
    names = ("noise_K_w", "harmonic_frequency")
    free, problem = jm.objective.free(TASK, names), jm.fits.problem(TASK, BUNDLED, free=names)
    vector = np.array([0.3, -0.7])
    assert free.parameters(vector) == pytest.approx(
        {name: float(v) for name, v in problem.parameters(vector).items()}, rel=1e-12
    )
    np.testing.assert_allclose(free.start, problem.start, atol=1e-12)
    priors = [float(f.log_prior(v)) for f in (free, problem) for v in (vector, 0 * vector)]
    assert priors[0] - priors[1] == pytest.approx(priors[2] - priors[3], rel=1e-9)


def test_free_is_a_pytree_of_many_people():
    """Its slope: `dv/dθ = sd v` of a positive parameter."""
    people = [jm.objective.free(TASK.replace(k_w=k), NAMES) for k in (3e5, 6e5)]
    vectors = jnp.stack([free.start + 0.1 for free in people])

    def level(vector, free):
        return free.task(vector)["k_w"]

    def both(free, vector):
        return free.vector(free.task(vector)), *jax.value_and_grad(level)(vector, free)

    again, values, slopes = jax.jit(jax.vmap(both))(stacked(people), vectors)
    np.testing.assert_allclose(again, vectors, rtol=1e-9)
    sd = jm.model.PARAMETERS["k_w"].prior_sd
    np.testing.assert_allclose(values, [k * np.exp(0.1 * sd) for k in (3e5, 6e5)])
    np.testing.assert_allclose(slopes[:, 0], sd * values)
    assert np.all(slopes[:, 1:] == 0)
    out = jax.jit(lambda k: people[0].vector(TASK.replace(harmonic_frequency=k)))(jnp.asarray(80.0))
    assert np.isnan(out[2]) and not np.isnan(out[0])


def test_what_cannot_be_free_is_refused():
    with pytest.raises(ValueError, match="unknown or not free parameter 'k'"):
        jm.objective.free(TASK, ["k"])
    with pytest.raises(ValueError, match="give a list of names"):
        jm.objective.free(TASK, "k_w")
    with pytest.raises(ValueError, match="bounds: unknown or not free parameter 'c_w'"):
        jm.objective.free(TASK, ["k_w"], bounds={"c_w": (1.0, 2.0)})
    with pytest.raises(ValueError, match="must lie inside its bounds"):
        jm.objective.free(TASK, ["k_w"], bounds={"k_w": (1.0, 2.0)})
    with pytest.raises(ValueError, match=r"JAX is tracing it .* Call free outside"):
        jax.jit(lambda k: jm.objective.free(TASK.replace(k_w=k)).start)(4e5)
    free = jm.objective.free(TASK, ["k_w", "c_w"])
    with pytest.raises(
        ValueError, match=r"shape \(3,\), this takes \(2,\), a number for each of k_w"
    ):
        free.task(np.zeros(3))
    with pytest.raises(ValueError, match=r"k_w = 0.0 lies outside"):
        jm.objective.free(TASK, ["k_w"], bounds={"k_w": (1e3, 1e9)}).vector(TASK.replace(k_w=0.0))
