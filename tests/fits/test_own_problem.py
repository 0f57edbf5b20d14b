"""A fit as functions for optimisers and samplers of one's own."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from compiled import at_once, kept_jit

import jaxmuscle as jm
from jaxmuscle.objective._coordinates import Coordinates

TARGET = jm.load_target("vastus-lateralis-26mvc")
TASK = TARGET.task()
BOUNDS = {"harmonic_frequency": (3.0, 9.0)}
ALONE = {"rungs": 0, "seeds": 0, "check_seeds": 0, "starts": 16}


@pytest.fixture(autouse=True)
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def problem():
    return jm.fits.problem(TASK, TARGET)


@pytest.fixture(scope="module")
def result():
    return jm.fit(TASK, TARGET, **ALONE)


def test_coordinates_and_parameters(problem):
    start = problem.parameters(problem.start)
    assert tuple(start) == problem.names == jm.fits.Problem.of(problem.fit_problem).names
    for name, value in start.items():
        assert float(value) == pytest.approx(float(TASK[name]), rel=1e-9)
    values = {"k_w": 4e5, "harmonic_frequency": 7.0}
    theta = problem.theta(values)
    back = problem.parameters(theta)
    assert {name: float(back[name]) for name in values} == pytest.approx(values, rel=1e-9)
    assert (
        float(problem.task(theta).k_w) == pytest.approx(4e5)
        and float(problem.task(theta).m_w) == TASK.m_w
    )
    with pytest.raises(ValueError, match="'m_w' is not free in this problem"):
        problem.theta({"m_w": 1.0})
    with pytest.raises(ValueError, match=r"harmonic_frequency = 99\.0 lies outside"):
        problem.theta({"harmonic_frequency": 99.0})
    assert (
        str(problem).startswith("problem of vastus-lateralis-26mvc")
        and "<table>" in problem._repr_html_()
    )


def test_values_are_traced_on_their_way_to_theta_and_exact_beside_a_bound():
    """A log density of parameters in their units, as `problem.theta` under `jit` and `grad` makes
    it."""
    problem = jm.fits.problem(
        TASK, TARGET, free=("k_w", "x_z", "harmonic_frequency"), bounds=BOUNDS
    )
    start = {name: float(TASK[name]) for name in problem.names}
    back = kept_jit(lambda values: problem.parameters(problem.theta(values)))
    for values in (
        {"k_w": 3e5, "x_z": -0.003, "harmonic_frequency": 3.0001},
        {"harmonic_frequency": 8.9999},
    ):
        given = start | values
        assert problem.parameters(problem.theta(given)) == pytest.approx(given, rel=1e-9)
        assert {name: float(value) for name, value in back(given).items()} == pytest.approx(
            given, rel=1e-9
        )
    slopes = at_once(jax.jacrev(lambda values: problem.parameters(problem.theta(values))), start)
    for name in start:  # the way there and back is the identity
        of_each = {other: float(slope) for other, slope in slopes[name].items()}
        assert of_each == pytest.approx({n: float(n == name) for n in start}, abs=1e-9)
    assert np.isnan(back(start | {"harmonic_frequency": 9.5})["harmonic_frequency"])
    assert np.isfinite(back(start | {"harmonic_frequency": 9.5})["k_w"])


def test_the_prior_is_a_density_of_the_coordinates(problem):
    """`ln N(z) + ln |dz/dθ|` with z the distance from the prior's centre in its standard
    deviations, from the parameters."""
    theta = problem.theta({"k_w": 3e5, "harmonic_frequency": 7.0, "noise_K_z": 0.02})
    sds = np.array([jm.model.PARAMETERS[name].prior_sd for name in problem.names])

    def z(theta):
        values = problem.parameters(theta)
        return jnp.stack([jnp.log(values[name] / TASK[name]) for name in problem.names]) / sds

    both = kept_jit(lambda theta: (z(theta), jax.jacfwd(z)(theta)))

    def density(theta):
        distance, slopes = map(np.asarray, both(theta))
        return -0.5 * np.sum(distance**2) + np.linalg.slogdet(slopes)[1]

    difference = float(problem.log_prior(theta) - problem.log_prior(problem.start))
    assert difference == pytest.approx(density(theta) - density(problem.start), abs=1e-9)


def test_log_density_and_its_slope(problem):
    """The likelihood is that of `log_likelihood` but for a constant; both halves are
    differentiable."""
    theta = problem.theta({"c_w": 90.0, "harmonic_frequency": 7.0})
    # its law is the same everywhere
    bare = jm.Target("spectrum alone", TARGET.proportional_power, segments=TARGET.segments)
    alone = jm.fits.problem(TASK, bare)
    ours = float(alone.log_likelihood(theta) - alone.log_likelihood(alone.start))
    theirs = float(
        jm.objective.log_likelihood(alone.task(theta), bare)
        - jm.objective.log_likelihood(TASK, bare)
    )
    assert ours == pytest.approx(theirs, abs=1e-6)
    steps = 1e-5 * np.concatenate(
        [np.eye(len(theta)), -np.eye(len(theta)), np.zeros((1, len(theta)))]
    )
    around = np.asarray(
        at_once(lambda points: jax.lax.map(problem.log_density, points), theta + steps)
    )
    assert around[-1] == pytest.approx(
        float(problem.log_likelihood(theta) + problem.log_prior(theta)), abs=1e-9
    )
    slope, (ahead, behind) = (
        np.asarray(at_once(jax.grad(problem.log_density), theta)),
        np.split(around[:-1], 2),
    )
    # Second-order differences of a smooth function.
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-5, rtol=1e-4, atol=1e-5)


def test_the_log_density_has_second_derivatives():
    """Against differences of the slope, in a step so small that the ripple along the frequency does
    not show."""
    problem = jm.fits.problem(TASK, TARGET, free=("c_w", "noise_K_w", "harmonic_frequency"))
    theta, step = problem.theta({"c_w": 90.0, "harmonic_frequency": 7.0}), 1e-6 * np.eye(3)
    points = theta + np.concatenate([np.zeros((3, 3)), step, -step])

    # the slope, and its derivative in a direction, which is a column of the second derivatives
    def one(given):
        return jax.jvp(jax.grad(problem.log_density), given[:1], given[1:])

    slope, column = map(
        np.asarray,
        at_once(lambda *given: jax.lax.map(one, given), points, np.tile(np.eye(3), (3, 1))),
    )
    (_, ahead, behind), found = np.split(slope, 3), column[:3]
    differences = (ahead - behind) / 2e-6
    # a slope of 300 is rounded by 1e-12, divided by the step
    np.testing.assert_allclose(found, differences, rtol=1e-4)
    np.testing.assert_allclose(found, found.T, rtol=1e-8)


def test_far_away_the_density_is_zero_and_not_a_number_for_a_sampler_to_choke_on(problem):
    far = np.full(len(problem.names), 20.0)
    assert float(problem.log_density(far)) == -np.inf
    assert np.isfinite(float(problem.log_density(problem.start)))


def test_a_theta_of_another_shape_is_refused(problem):
    many = np.zeros((5, len(problem.names)))
    for wrong, said in (
        (many, "use jax.vmap for several"),
        (np.zeros(2), "theta has the shape"),
        ({}, "problem.theta"),
    ):
        with pytest.raises(ValueError, match=said):
            problem._scaled(wrong)  # of all methods, which the tests' type checker guards by itself
    assert at_once(jax.vmap(problem.log_prior), many).shape == (5,)


def test_bounds_are_counted_in_standard_deviations_of_the_prior():
    found = Coordinates.of(
        {"k_w": 5e5, "x_z": 0.001},
        {"k_w": (1e5, 2e6), "x_z": (-0.003, 0.002)},
        {"k_w": 0.5, "x_z": 0.01},
    )
    np.testing.assert_allclose(found.low, [np.log(0.2) / 0.5, -0.4], rtol=1e-12)
    np.testing.assert_allclose(found.high, [np.log(4.0) / 0.5, 0.1], rtol=1e-12)


def test_the_log_likelihood_is_that_of_the_task_but_for_the_variation():
    """A coefficient of variation scatters as at the start; without one the two are the same."""
    target = jm.Target("a", TARGET.proportional_power, segments=12)
    problem = jm.fits.problem(TASK, target, free=("k_w", "c_w", "noise_K_z"))
    off = [
        float(problem.log_likelihood(theta))
        - float(jm.objective.log_likelihood(problem.task(theta), target))
        for theta in np.array([[0.0, 0, 0], [1, 1, -1], [-1, 0.5, 0.5]])
    ]
    np.testing.assert_allclose(off, off[0], atol=1e-8)


def test_scipy_finds_the_minimum_of_the_fit(problem, result):
    """In the two descents that a fit makes: what the harmonic holds of the bins is unknown first,
    then known.

    A fit ends when two steps in a row gain less than 1e-4 of the cost; the table of starts is that
    of the first descent.
    """
    near = problem.theta({name: result.parameters[name].value for name in problem.names})
    for turn, used in enumerate((problem, problem.scattering_as(near))):
        residuals, slopes = (
            kept_jit(each) for each in (used.residuals, jax.jacfwd(used.residuals))
        )
        begin = np.asarray(near) + 0.05 * (-1.0) ** np.arange(len(near))
        found = scipy.optimize.least_squares(residuals, begin, slopes, ftol=1e-12, xtol=1e-12)
        ours = (
            0.5 * np.sum(np.asarray(residuals(near)) ** 2)
            if turn
            else min(start.cost for start in result.starts)
        )
        assert found.success and found.cost == pytest.approx(ours, rel=1e-3)


def test_a_target_without_scatter_has_residuals_but_no_density():
    bare = jm.fits.problem(TASK, jm.Target("bare", TARGET.proportional_power))
    assert np.all(np.isfinite(bare.residuals(bare.start)))
    with pytest.raises(ValueError, match="states neither segments nor sigma"):
        bare.log_density(bare.start)


def test_results_summarise_themselves(result):
    summary = result.summary()
    assert str(summary) == repr(summary) == str(result) == repr(result)
    html = summary._repr_html_()
    # the other rows are per newton of it
    shown = (result.found | result.parameters).keys() - {"model_mean"}
    assert html.count("<tr>") == 1 + len(result.measured) + len(shown)
    assert html.count(">measured<") == len(result.measured) and ">determined<" in html


class Network(jm.model.AbstractMuscle):
    """A linear muscle whose stiffness a small network changes."""

    stiffness: float = 300.0
    m_w: float = 0.5
    m_z: float = 0.5
    net: eqx.nn.MLP = eqx.field(
        default_factory=lambda: eqx.nn.MLP(
            "scalar", "scalar", 3, 1, activation=jnp.tanh, key=jax.random.key(0)
        )
    )

    def base(self):
        return jnp.stack([jnp.asarray(v) for v in (self.stiffness, 200.0, 40.0, 5.0)])

    def active_force(self, x_w, v_w, u):
        return (self.stiffness + self.net(100 * x_w) + u[0]) * x_w + (40.0 + u[2]) * v_w

    def passive_force(self, x_w, v_w, x_z, v_z, u):
        return (200.0 + u[1]) * (x_z - x_w) + (5.0 + u[3]) * (v_z - v_w)


def test_a_fit_leaves_the_arrays_of_a_network_and_says_so():
    task = jm.Isometric(muscle=Network()).with_parts(settings=TARGET.settings)
    found = jm.fit(task, TARGET, free=("stiffness", "noise_K_w"), **ALONE | {"starts": 2})
    assert found["stiffness"].value != 300.0
    assert sum("Network.net holds 10 numbers in arrays" in notice for notice in found.notices) == 1
    assert eqx.tree_equal(found.task.muscle.net, task.muscle.net, rtol=1e-6)
