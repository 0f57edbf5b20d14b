"""Fits: the objective against plain simulation, gradients, recovery of known truths, and what
happens when it fails."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
import scipy.signal
import scipy.stats
from compiled import at_once, drawing
from hypothesis import given
from hypothesis import strategies as st
from refits import without_intervals

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.ensembles._ensemble import runs_for_means
from jaxmuscle.fits import _search
from jaxmuscle.fits._checks import AMBIGUOUS, rivals
from jaxmuscle.fits._stages import Stage
from jaxmuscle.model._noises import with_noise
from jaxmuscle.model._parameters import BASE, DEFAULT_FREE, PARAMETERS
from jaxmuscle.objective._arguments import free_names, planned
from jaxmuscle.objective._consequences import BATCH, consequences, expand
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._covariance import common_scales, identifiability
from jaxmuscle.objective._derived import of_spectrum
from jaxmuscle.objective._least_squares import Minima, _residuals, _Standing, least_squares
from jaxmuscle.objective._moment_models import Linear, MonteCarlo, welch_operator
from jaxmuscle.objective._options import DT, FitOptions
from jaxmuscle.objective._problem import FitProblem, Part, target_variation
from jaxmuscle.objective._residuals import data_residuals, further_residuals
from jaxmuscle.objective._starts import contenders, halton
from jaxmuscle.response._equilibrium import slowest_rate
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._rows import _noise_rows
from jaxmuscle.simulation._grid import Grid
from jaxmuscle.spectra._settings import WINDOW

PERTURBATION = (
    "all amplitudes of noise and harmonic can be multiplied by one number, and the fit stays as"
    " good"
)
MECHANICS = (
    "all stiffness and damping can be multiplied by one number, and the fit stays as good: at most"
    " their ratios are known"
)
HALF_BIN = 0.390625 / 2
VASTUS = jm.load_target("vastus-lateralis-26mvc")
QUICK: dict[str, Any] = {"starts": 2, "seeds": 16, "check_seeds": 16}  # as many each: one program


def simple_target(**fields: Any) -> jm.Target:
    """A falling spectrum with a hump at 4.3 Hz."""
    f = jm.SpectrumSettings().frequency
    power = 1 / (1 + (f / 1.2) ** 2) + 0.1 * np.exp(-(((f - 4.3) / 0.3) ** 2)) + 0.01
    return jm.Target("hump", power / power.sum(), **{"segments": 12, **fields})


def setup_of(task, target, free, *, extra=(None, None), seeds=8, key=0, control=False):
    """What `fit` makes of its arguments, for one objective without a search. Needs float64."""
    values = {name: float(task[name]) for name in free}
    coordinates = Coordinates.of(values, {}, {name: PARAMETERS[name].prior_sd for name in free})
    part = Part("", task, target, coordinates, tuple(range(len(free))), *extra)
    return FitProblem(
        (part,),
        coordinates,
        np.ones(len(free)),
        "montecarlo",
        DT,
        jax.random.key(key),
        seeds,
        control,
        lambda text, share: None,
    )


def part_of(problem, seeds=8):
    """The residuals of its one target by Monte Carlo."""
    return problem.montecarlo(seeds).parts[0]


# --- the spectrum as one matrix


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"filter_direction": "both"},
        {"detrend": "none", "window": "hamming"},
        {"detrend": "linear", "overlap": 0.25},
        {"filter_cutoff": None, "first_bin": 0, "last_bin": 128},
        {
            "rate": 50.0,
            "length": 100,
            "filter_cutoff": 20.0,
            "filter_order": 4,
            "window": "boxcar",
            "overlap": 0.29,
        },
        {"window": "dpss", "tapers": 3, "detrend": "linear"},
    ],
)
def test_welch_operator_is_the_spectrum(x64, changes):
    settings = jm.SpectrumSettings(**changes)
    window = (1.0, 9.5)
    samples = round(10 * settings.rate) + 1
    x = 3.0 + np.cumsum(np.random.default_rng(0).standard_normal((2, samples)), axis=1)
    operator = welch_operator(settings, samples, window)
    bins = settings.last_bin - settings.first_bin + 1
    power = np.sum((x @ operator.T).reshape(2, -1, bins) ** 2, axis=1)
    expected = np.asarray(jm.spectra.spectrum_of(x, settings, window).power)
    # Rounding relative to the largest power: small bins are differences of large numbers.
    np.testing.assert_allclose(power, expected, rtol=1e-9, atol=1e-13 * expected.max())


def test_welch_operator_refuses_a_window_shorter_than_a_segment():
    with pytest.raises(ValueError, match="shorter than one segment of 256 samples at 100"):
        welch_operator(jm.SpectrumSettings(), 1501, (5.0, 7.0))


# --- mean power over fixed paths


@pytest.mark.parametrize(
    "task",
    [
        jm.Isometric(
            noise=jm.BandLimitedNoise() + jm.ResonantNoise(0.02),
            settings=jm.SpectrumSettings(sampling="filtered"),
        ),
        jm.PrescribedForce(
            noise=jm.OrnsteinUhlenbeckNoise(),
            F_ext=2.0,
            settings=jm.SpectrumSettings(sampling="average"),
        ),
    ],
    ids=["isometric", "force"],
)
@pytest.mark.slow
def test_moments_are_those_of_a_plain_ensemble(x64, task):
    """But for the cross term of line and noise, whose expectation is zero."""
    key, seeds, dt = jax.random.key(3), 16, 2.5e-3
    runs = jm.ensemble(task, key, seeds=seeds, dt=dt)
    still = {
        name: 0.0
        for name in task.parameter_names
        if name.startswith(("noise_K", "noise_C", "resonance_amplitude"))
    }
    # by the same program
    quiet = np.asarray(jm.ensemble(task.replace(**still), key, seeds=seeds, dt=dt).output)[0]
    grid = Grid(dt, 6000, 4, runs.substeps)
    chosen = np.array([0, 3, 10, 29])
    linear = Linear(chosen, Moments(*[np.ones(4)] * 2, *[np.ones(())] * 2), np.array(1000), WINDOW)
    model = MonteCarlo.of(linear, task.settings, key, seeds, grid, control=False)
    moments = drawing(lambda task: model.moments(task))(as_arrays(task))

    def powers(signal):
        return np.asarray(jm.spectra.spectrum_of(signal, task.settings, WINDOW).power)[..., chosen]

    output = np.asarray(runs.output)
    line, random = powers(quiet), powers(output - quiet)
    # Rounding relative to the largest power: a bin far from the line holds 3e-10 of it.
    np.testing.assert_allclose(moments.line, line, rtol=1e-9, atol=1e-13 * line.max())
    np.testing.assert_allclose(moments.power, line + random.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(moments.mean, output[:, 500:1500].mean(), rtol=1e-12)
    passed, still = (
        scipy.signal.sosfilt(task.settings.sections, x)[..., 500:1500]
        for x in (output - quiet, quiet)
    )
    variance = still.var() + passed.var(axis=1).mean()
    np.testing.assert_allclose(moments.variance, variance, rtol=1e-9)
    cross = powers(output) - line - random
    references.assert_standard_normal(
        cross.mean(axis=0) / (cross.std(axis=0, ddof=1) / np.sqrt(seeds))
    )
    assert np.isclose(float(moments.variation), np.sqrt(variance) / abs(output[:, 500:1500].mean()))
    np.testing.assert_allclose(moments.proportional, moments.power / moments.power.sum())


# --- coordinates

NATURAL = {
    "c_w": 60.0,
    "F_ext": -2.0,
    "harmonic_frequency": 4.25,
    "noise_K_w": 0.15,
    "harmonic_phase": 0.3,
}
BOUNDS = {"F_ext": (-3.0, 5.0), "noise_K_w": (0.0, 0.5), "c_w": (10.0, np.inf)}


def coordinates(values=None, bounds=None):
    values = NATURAL if values is None else values
    return Coordinates.of(
        values, BOUNDS if bounds is None else bounds, {n: PARAMETERS[n].prior_sd for n in values}
    )


@functools.cache
def compiled_theta():
    """Of coordinates without bounds of their own; compiled, as hypothesis calls it a hundred
    times."""
    return jax.jit(lambda s: coordinates(bounds={}).theta(s))


@functools.cache
def compiled_values():
    given = coordinates()
    return jax.jit(lambda s: given.values(given.theta(s)))


def test_theta_counts_standard_deviations_of_the_prior(x64):
    values = coordinates().values(jnp.full(len(NATURAL), 0.5))
    for name, value in NATURAL.items():
        row = PARAMETERS[name]
        expected = (
            value * np.exp(0.5 * row.prior_sd) if row.positive else value + 0.5 * row.prior_sd
        )
        np.testing.assert_allclose(values[name], expected, rtol=1e-14)


def test_a_frequency_with_a_prior_of_its_own_comes_back():
    """A grid of frequencies is laid in coordinates: half a standard deviation of 0.2 in the log is
    `exp(0.1)`."""
    made = Coordinates(
        ("c_w", "harmonic_frequency"),
        np.array([60.0, 6.0]),
        np.array([1.0, 0.2]),
        np.array([True, True]),
        np.full(2, -np.inf),
        np.full(2, np.inf),
    )
    found = made.theta_of("harmonic_frequency", 6.0 * np.exp([0.0, 0.1]))
    np.testing.assert_allclose(found, [0.0, 0.5], atol=1e-14)
    np.testing.assert_allclose(
        made.values_of(np.array([[0.0, 0.5]]))[0, 1], 6.0 * np.exp(0.1), rtol=1e-14
    )


@given(theta=st.lists(st.floats(-0.8, 0.8), min_size=5, max_size=5))
def test_from_theta_is_the_reverse_of_theta(theta):
    with jax.enable_x64(True):
        again = compiled_theta()(coordinates(bounds={}).from_theta(np.array(theta)))
        # Where a bound is near, 1 - sigmoid(s) loses digits: the interval is at most 40 wide.
        np.testing.assert_allclose(again, theta, atol=1e-12)


@given(s=st.lists(st.floats(-1e6, 1e6), min_size=5, max_size=5))
def test_bounds_hold_wherever_the_coordinates_go(s):
    with jax.enable_x64(True):
        values = compiled_values()(np.array(s))
        bounds = {
            name: (PARAMETERS[name].fit_lower, PARAMETERS[name].fit_upper) for name in NATURAL
        } | BOUNDS
        for name, (low, high) in bounds.items():
            slack = 1e-12 * abs(float(values[name]))  # rounding of log and exp
            assert low - slack <= float(values[name]) <= high + slack


@given(theta=st.lists(st.floats(-30, 30), min_size=5, max_size=5))
def test_starts_outside_the_bounds_are_clipped_into_them(theta):
    with jax.enable_x64(True):
        given = coordinates()
        values = compiled_values()(given.from_theta(np.array(theta)))
        for name, (low, high) in BOUNDS.items():
            assert low < float(values[name]) < high


@pytest.mark.parametrize(("size", "count"), [(1, 1), (8, 100), (20, 32)])
def test_halton_points_are_scipys_to_the_last_bit(size, count):
    np.testing.assert_array_equal(
        halton(size, count), scipy.stats.qmc.Halton(size, rng=0).random(count)
    )


def test_slope_is_the_derivative_of_the_values(x64):
    given = coordinates(bounds={})
    theta = jnp.asarray([0.3, -0.2, 0.1, 0.5, 1.0])
    slopes = jax.jacfwd(lambda theta: jnp.stack(list(given.values(theta).values())))(theta)
    natural = np.array([float(v) for v in given.values(theta).values()])
    np.testing.assert_allclose(slopes, np.diag(given.slope(natural)), rtol=1e-12)


@pytest.mark.parametrize(
    ("values", "bounds", "message"),
    [
        ({"noise_K_w": 0.0}, {}, "noise_K_w = 0.0 cannot be fitted: it is fitted in log space"),
        (
            {"c_w": 60.0},
            {"c_w": (1.0, 50.0)},
            r"c_w = 60.0 N s\^3/m\^3 must lie inside its bounds \(1.0, 50.0\)",
        ),
        ({"c_w": 60.0}, {"c_w": (100.0, 50.0)}, "must lie inside its bounds"),
        ({"harmonic_frequency": 40.0}, {}, r"must lie inside its bounds \(0.2, 30.0\)"),
    ],
)
def test_what_cannot_be_fitted_is_an_error(values, bounds, message):
    with pytest.raises(ValueError, match=message):
        coordinates(values, bounds)


def test_a_bound_below_zero_does_not_bind_a_positive_parameter(x64):
    given = coordinates({"c_w": 60.0}, {"c_w": (-1.0, np.inf)})
    np.testing.assert_allclose(given.theta(jnp.asarray([0.0])), 0.0)


# --- minima, on objectives whose minimum is known


class Direct(eqx.Module):
    """An objective whose model gives the residuals themselves."""

    model: None = None
    data: None = None
    linear: bool = eqx.field(static=True, default=False)
    moving: np.ndarray = eqx.field(default_factory=lambda: np.ones(1))

    @property
    def parts(self):
        return (self,)

    def theta(self, s):
        return s

    def own(self, values, i):
        return values

    def spread(self, slope, i):
        return slope

    def filled(self):
        return self

    def moments(self, theta):
        none = jnp.zeros(())
        return Moments(self.values(theta), none, none, none)

    def residuals(self, theta, moments, data):
        return moments[0].power


class Curved(Direct):
    """Residuals of a narrow curved valley with its minimum, 1/8, at (1, 1); not finite for s_0 <
    -1.5."""

    scale: float = 10.0
    moving: np.ndarray = eqx.field(default_factory=lambda: np.ones(2))

    def values(self, theta):
        valley = jnp.stack(
            [self.scale * (theta[1] - theta[0] ** 2), 1 - theta[0], 0.5 * jnp.ones_like(theta[0])]
        )
        return valley * jnp.where(theta[0] < -1.5, jnp.nan, 1.0)


def watch(reports):
    return lambda minima: reports.append(minima)


def test_descent_finds_the_minimum_from_every_start_but_a_bad_one(x64):
    reports = []
    starts = np.array([[-1.0, 1.0], [np.nan, 0.0], [2.0, 2.0], [-2.0, 0.0]])
    found = least_squares(Curved(), starts, 80, report=watch(reports))
    # Settled means that a thousandth of the cost is left to gain: half a squared distance of
    # 1/8000.
    np.testing.assert_allclose(found.cost[[0, 2]], 0.125, rtol=1e-3)
    np.testing.assert_allclose(found.s[[0, 2], 0], 1.0, atol=0.02)
    assert np.all(found.settled[[0, 2]]) and not np.any(found.settled[[1, 3]])
    assert np.all(~np.isfinite(found.cost[[1, 3]]))
    assert found.best in (0, 2)
    assert len(reports) == found.steps.max() < 80
    # each counts until it has settled or given up
    assert found.steps[1] < found.steps[2] < found.steps[0]


def test_a_step_to_where_the_model_explodes_is_rejected(x64):
    class Cliff(Direct):
        """log(s): from s = 5 a Gauss-Newton step leads to s < 0."""

        def values(self, theta):
            return jnp.log(theta)

    reports = []
    found = least_squares(Cliff(), np.array([[5.0]]), 60, report=watch(reports))
    assert np.all(np.isfinite([r.cost[0] for r in reports]))
    costs = [r.cost[0] for r in reports]
    assert costs == sorted(costs, reverse=True)
    np.testing.assert_allclose(found.s, 1.0, atol=1e-6)


def test_no_finite_start_has_infinite_cost(x64):
    found = least_squares(Curved(), np.full((2, 2), np.nan), 20)
    assert not np.any(np.isfinite(found.cost)) and not np.any(found.settled)
    assert np.all(found.steps < 20)


def test_descent_takes_the_problem_that_prepare_gives(x64):
    """Exchanged at the first step, as for more sub-steps: the minimum is the new objective's."""

    class Line(Direct):
        at: float = 0.0

        def values(self, theta):
            return theta - self.at

    found = least_squares(Line(at=1.0), np.zeros((1, 1)), 20, prepare=lambda p, s: Line(at=2.0))
    np.testing.assert_allclose(found.s, 2.0, atol=1e-6)


def test_residuals_and_their_slopes_are_exact_where_the_model_was_seen(x64):
    objective, s = Curved(), np.array([[0.4, -0.3], [1.2, 0.7]])
    seen = expand(objective, s)
    for i, point in enumerate(jnp.asarray(s)):
        here = jax.tree.map(lambda x, i=i: x[i], seen)
        np.testing.assert_allclose(
            _residuals(point, (objective, None, here))[0], objective.values(point), rtol=1e-14
        )
        slope = jax.jacfwd(lambda s, here=here: _residuals(s, (objective, None, here))[0])(point)
        np.testing.assert_allclose(slope, jax.jacfwd(objective.values)(point), rtol=1e-14)


# --- the objective that a fit solves

FREE = ("c_w", "noise_K_w", "harmonic_frequency")


@functools.cache
def _problem(extra=(None, None)):
    with jax.enable_x64(True):
        return setup_of(jm.Isometric(), simple_target(), FREE, extra=extra).montecarlo(8)


EXTRA, AT = ((np.log(0.02), 0.1), (2.0, 0.1)), np.array([0.2, -0.1, 0.05])


def _at(theta):
    """The model of all these objectives, by one program."""
    return expand(_problem(EXTRA), np.asarray(theta)[None]).row(0)


def _moments(theta):
    return jax.tree.map(jnp.asarray, _at(theta).moments[0])


@functools.cache
def _seen():
    return _at(_problem(EXTRA).theta(jnp.asarray(AT)))


def test_gradients_of_the_residuals_are_differences(x64):
    objective, s, seen = _problem(EXTRA), jnp.asarray(AT), _seen()

    def evaluate(s):
        theta = objective.theta(s)
        return objective.residuals(theta, (_moments(theta),), objective.data)

    forward = jax.jit(jax.jacfwd(lambda s: _residuals(s, (objective, objective.data, seen))[0]))(s)
    h = 1e-4
    central = np.stack(
        [(evaluate(s + h * e) - evaluate(s - h * e)) / (2 * h) for e in np.eye(3)], axis=1
    )
    assert np.all(np.isfinite(forward))
    # Truncation h² times the third derivative, which for a line crossing a bin is up to 1e2 of the
    # slope.
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-5 * np.abs(central).max())
    assert forward.shape == (30 + 2 + 3, 3)


def test_slopes_that_were_seen_are_those_of_the_whole(x64):
    """Every batch of points has one program for moments and slopes; here the residuals are
    differentiated in one piece."""
    objective, s, seen = _problem(EXTRA), jnp.asarray(AT), _seen()

    def whole(s):
        theta = objective.theta(s)
        return objective.residuals(theta, (objective.parts[0].moments(theta),), objective.data)

    forward = jax.jit(jax.jacfwd(lambda s: _residuals(s, (objective, objective.data, seen))[0]))(s)
    # Normals have single precision, which two programs round differently: 6e-8 of each of
    # thousands.
    np.testing.assert_allclose(forward, at_once(jax.jacfwd(whole), s), rtol=1e-6, atol=6e-8)


def test_the_extra_residuals_are_log_variation_and_mean(x64):
    (objective,) = _problem(EXTRA).parts
    moments = _moments(jnp.zeros(3))
    rows = further_residuals(moments, objective.data)
    expected = [np.log(float(moments.variation) / 0.02) / 0.1, (float(moments.mean) - 2.0) / 0.1]
    np.testing.assert_allclose(rows, expected)


def test_the_residuals_vanish_for_a_target_that_the_model_makes(x64):
    (objective,) = _problem().parts
    moments, bias = _moments(jnp.zeros(3)), np.exp(objective.statistics.bias)
    made = eqx.tree_at(lambda p: p.data.target, objective, moments.proportional * bias)
    np.testing.assert_allclose(data_residuals(moments, made.data), 0.0, atol=1e-12)
    assert np.abs(data_residuals(_moments(jnp.full(3, 0.2)), made.data)).max() > 0.1


def null_sentences(task, extra):
    objective = setup_of(task, VASTUS, DEFAULT_FREE, extra=extra, control=True).linear()
    seen = expand(objective, np.zeros((1, len(DEFAULT_FREE)))).row(0)
    return common_scales(DEFAULT_FREE, identifiability(consequences(objective, seen).jacobian))


def test_the_measured_variation_fixes_the_scale(x64):
    """Design 8: both null directions are named, and a coefficient of variation takes the first
    away."""
    without = null_sentences(jm.Isometric(), (None, None))
    assert {PERTURBATION, MECHANICS} <= set(without)
    variation = target_variation(VASTUS)
    assert variation is not None
    assert np.exp(variation[0]) == pytest.approx(0.0133)
    fixed = null_sentences(jm.Isometric(), (variation, None))
    assert PERTURBATION not in fixed and MECHANICS in fixed


def test_stiff_points_get_substeps(x64):
    """c_w / m_w = 4000/s: λ dt = 10 on the grid of the fit, which Heun's method does not
    survive."""
    problem = setup_of(jm.Isometric().replace(c_w=2000.0), simple_target(), ("c_w", "k_w"))
    objective = problem.montecarlo(8)
    assert objective.parts[0].model.grid.substeps == 1
    finer = problem.finer(objective, np.zeros((1, 2)))
    assert finer.parts[0].model.grid.substeps == 16
    # never fewer again
    assert problem.finer(finer, np.array([[-5.0, 0.0]])).parts[0].model.grid.substeps == 16
    assert (
        problem.finer(objective, np.array([[-5.0, 0.0], [np.nan, 0.0]]))
        .parts[0]
        .model.grid.substeps
        == 1
    )
    assert (
        problem.finer(objective, np.array([[-5.0, 0.0], [0.0, 0.0]])).parts[0].model.grid.substeps
        == 16
    )
    assert np.all(
        np.isfinite(at_once(lambda theta: finer.parts[0].moments(theta).power, jnp.zeros(2)))
    )
    assert not np.all(
        np.isfinite(at_once(lambda theta: objective.parts[0].moments(theta).power, jnp.zeros(2)))
    )


# --- arguments


def test_the_task_follows_from_the_quantity():
    force = VASTUS.task()
    assert isinstance(force, jm.Isometric) and force.settings == VASTUS.settings
    assert isinstance(simple_target(quantity="torque").task(), jm.Isometric)
    moved = simple_target(quantity="displacement").task(noise="ornstein-uhlenbeck")
    assert isinstance(moved, jm.PrescribedForce) and isinstance(
        moved.noise, jm.OrnsteinUhlenbeckNoise
    )
    felt = simple_target(quantity="acceleration")
    assert moved.quantity == "displacement" and felt.task().quantity == "acceleration"
    assert felt.task(jm.PrescribedForce).quantity == "acceleration"
    assert isinstance(felt.task(jm.PrescribedMotion), jm.PrescribedMotion)


def test_an_acceleration_is_fitted_as_one():
    felt, free = simple_target(quantity="acceleration"), ("c_w",)
    with pytest.raises(
        ValueError,
        match="target 'hump' is an acceleration, but its task PrescribedForce gives x_z in m",
    ):
        jm.fit(jm.PrescribedForce(), felt, free=free)
    with pytest.raises(
        ValueError, match="target 'hump' is a force, but its task PrescribedForce gives a_z in m/s"
    ):
        jm.fit(felt.task(), simple_target(), free=free)
    with pytest.raises(ValueError, match="the mean of an acceleration is zero; leave it out"):
        jm.fit(felt.task(), felt, free=free, mean_force=(1.0, 0.1))


def test_white_noise_works_where_the_output_does_not_contain_it():
    with pytest.raises(
        ValueError,
        match=r"WhiteNoise on K_z cannot be used in Isometric.*BandLimitedNoise.*noise_K_z",
    ):
        with_noise(jm.Isometric(), "white")
    with pytest.raises(ValueError, match="WhiteNoise on C_z"):
        with_noise(jm.Isometric(), "white", {"noise_K_z": 0.0})
    task = with_noise(
        jm.Isometric(), "white", {"noise_K_z": 0.0, "noise_C_z": 0.0, "noise_K_w": 0.2}
    )
    assert isinstance(task.noise, jm.WhiteNoise)
    np.testing.assert_array_equal(
        task.noise.amplitude, [0.2, 0.0, PARAMETERS["noise_C_w"].default, 0.0]
    )
    assert "noise_K_z" not in free_names(task, None, {"noise_K_z": 0.0}, VASTUS)


def test_free_by_default():
    assert free_names(jm.Isometric(), None, {}, VASTUS) == DEFAULT_FREE
    ornstein = jm.Isometric(noise=jm.OrnsteinUhlenbeckNoise())
    assert free_names(ornstein, None, {"k_w": 1.0}, VASTUS) == (
        *DEFAULT_FREE[1:],
        "noise_correlation_time",
    )
    # What is zero cannot be fitted in log space and stays.
    assert "harmonic_amplitude" not in free_names(
        jm.Isometric().replace(harmonic_amplitude=0.0), None, {}, VASTUS
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "linaer"}, "method = 'linaer'.*did you mean 'linear'"),
        ({"noise": "pinkish"}, "noise = 'pinkish': .*band-limited"),
        ({"starts": 0}, "starts = 0: give a whole number from 1"),
        ({"seeds": -1}, "seeds = -1: give a whole number from 0"),
        ({"seeds": 0, "method": "montecarlo"}, "seeds = 0: a Monte Carlo fit needs at least one"),
        ({"free": ["c_W"]}, "free: .*'c_W': did you mean 'c_w'"),
        ({"free": []}, "no parameter is free"),
        ({"free": ["c_w"], "fix": {"c_w": 1.0}}, "c_w cannot be both free and fixed"),
        ({"fix": {"k_ww": 1.0}}, "'k_ww' of Isometric: did you mean 'k_w'"),
        ({"fix": {"m_w": -1.0}}, "m_w = -1.0 kg is outside"),
        ({"free": ["c_w"], "priors": {"k_w": 1.0}}, "priors: .*'k_w'"),
        ({"free": ["c_w"], "bounds": {"k_w": (1.0, 2.0)}}, "bounds: .*'k_w'"),
        (
            {"free": ["c_w"], "bounds": {"c_w": (1.0, 2.0)}},
            "c_w = 60.0 .* must lie inside its bounds",
        ),
        ({"dt": 3e-3}, "dt = 0.003 s does not divide the sampling interval 0.01"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        jm.fit(jm.Isometric(), simple_target(), **arguments)


@pytest.mark.parametrize(
    "function, given, message",
    [
        (jm.fit, "metod", "did you mean 'method'"),
        (jm.fits.problem, "starts", "known are bounds"),
    ],
)
def test_an_unknown_option_is_named_with_the_nearest(function, given, message):
    with pytest.raises(TypeError, match=message):
        function(jm.Isometric(), simple_target(), **{given: 1})
    for other, given in (
        (jm.fit_cohort, ([],)),
        (jm.fit, (None, {})),
        (jm.run_study, ("study.csv",)),
    ):
        with pytest.raises(TypeError, match="has no option 'sedes'"):
            other(*given, sedes=1)


def test_a_task_that_does_not_fluctuate():
    still = jm.Isometric(noise=jm.BandLimitedNoise(0.0), harmonic=jm.Harmonic(amplitude=0.0))
    with pytest.raises(ValueError, match="neither noise nor a harmonic"):
        jm.fit(still, simple_target(), free=("c_w",), **QUICK)
    result = jm.fit(still.replace(noise_C_w=0.01), simple_target(), free=("c_w",), **QUICK)
    assert (
        not result.success
        and "noise on damping alone does nothing when nothing moves" in result.message
    )
    with pytest.raises(
        ValueError, match=r"harmonic_frequency = 60.0 Hz is not below half the sampling rate"
    ):
        jm.fit(jm.Isometric(), simple_target(), fix={"harmonic_frequency": 60.0}, **QUICK)


def test_fewer_bins_than_parameters():
    few = jm.Target("few", np.full(5, 0.2), bins=np.arange(1, 6), segments=12)
    with pytest.raises(
        ValueError, match=r"5 bins cannot determine 8 free parameters \(k_w, .*fix some"
    ):
        jm.fit(jm.Isometric(), few)


# --- whole fits


def averaged(task, *, seeds=192, key=99):
    """The target that averaging the absolute spectra of many seeds gives; none of them is used by
    the fit."""
    # the program of a fit's check
    runs = jm.ensemble(task.settled(), jax.random.key(key), seeds=seeds, chunk=64)
    power = np.asarray(runs.spectrum().mean().proportional)
    return jm.Target("truth", power, segments=[6] * seeds)


def true_derived(task):
    """Derived quantities of the truth, its spectrum with a control variate: each seed is worth
    hundreds."""
    runs, quiet = (
        jm.ensemble(t.settled(), jax.random.key(7), seeds=64)
        for t in (task, references.quiet(task))
    )
    line = quiet.spectrum().power[0]
    held = np.asarray(runs.between())
    seen = runs.mean_spectrum().power, line, held.mean(), held.var(axis=1).mean()
    settings = task.settings
    found = of_spectrum(
        Moments(*map(jnp.asarray, seen)), settings.frequency, settings.resolution, jnp.zeros(0)
    )
    found["corner_frequency"] = slowest_rate(task) / (2 * np.pi)
    known = (*BASE, "harmonic_frequency")
    return {name: float(value) for name, value in (found | {n: task[n] for n in known}).items()}


def off(task, free):
    """The task with its free parameters half as large again or two thirds as large."""
    return task.replace(
        **{name: float(task[name]) * (1.5 if i % 2 else 1 / 1.5) for i, name in enumerate(free)}
    )


def assert_recovered(result, task, determined, free=()):
    """The harmonic frequency, and within three standard errors all derived quantities and `free`
    that have one.

    Those in `determined` must have one.
    """
    assert result.success, result.message
    nearest = np.argmin(np.abs(result.frequency_hz - float(task["harmonic_frequency"])))
    assert result.harmonic_share[nearest] >= 0.8
    assert (
        abs(result.parameters["harmonic_frequency"].value - float(task["harmonic_frequency"]))
        < HALF_BIN / 2
    )
    known = {**result.parameters, **result.derived}
    truth = true_derived(task) | {name: float(task[name]) for name in free}
    for name in {*DERIVED, "corner_frequency", *free}:
        if known[name].stderr is not None:
            assert abs(known[name].value - truth[name]) < 3 * known[name].stderr, name
    assert all(known[name].stderr is not None for name in determined)


DERIVED = ("harmonic_frequency", "harmonic_share", "band_8_12")
# Where a noise amplitude is hardly seen (noise_K_z = 0.005, say) its estimate may fall to zero,
# where the linear theory behind the standard errors ends; these are seen.
FIRST = jm.Isometric().replace(harmonic_amplitude=0.03, noise_K_z=0.012)
SECOND = jm.Isometric().replace(
    harmonic_amplitude=0.03, harmonic_frequency=7.2, c_w=100.0, noise_K_z=0.008
)
RECOVERY: dict[str, Any] = {"starts": BATCH, "seeds": 64, "key": 1, "rungs": 0}


@pytest.mark.parametrize("task", [FIRST, SECOND], ids=["first", "second"])
@pytest.mark.slow
def test_what_the_data_determine_is_recovered(x64, task):
    """Eight free parameters; the stated errors of single ones hold only as far as the model is
    linear.

    Of a displacement the same is seen in `test_joint`.
    """
    with without_intervals():
        result = jm.fit(off(task, DEFAULT_FREE), averaged(task), **RECOVERY)
    assert_recovered(result, task, DERIVED)
    # The scale of all perturbations is not recovered, and the result says so.
    assert PERTURBATION in result.undetermined
    for name in ("noise_K_w", "noise_K_z", "harmonic_amplitude"):
        assert result.parameters[name].stderr is None


@pytest.mark.parametrize("task", [FIRST, SECOND], ids=["first", "second"])
def test_three_free_parameters_are_recovered(x64, task):
    with without_intervals():
        result = jm.fit(off(task, FREE), averaged(task), free=FREE, **RECOVERY)
    assert_recovered(result, task, (*DERIVED, *FREE), FREE)


FEW = ("c_w", "noise_K_w")
# one program for all such fits
SIMULATED: dict[str, Any] = {"free": FREE, "starts": 4, "seeds": 16, "check_seeds": 16}


@pytest.mark.parametrize(
    ("method", "reason"),
    [
        ("linear", "the fitted task cannot be simulated"),
        ("montecarlo", "none of the starts gives a finite spectrum"),
    ],
)
@pytest.mark.slow
def test_a_model_that_explodes_everywhere_is_a_result(x64, method, reason):
    """Noise of 500 times the stiffness has a linear response, but no simulation survives it."""
    task = jm.Isometric().replace(noise_K_w=500.0)
    result = jm.fit(task, simple_target(), method=method, **SIMULATED)
    assert not result.success and reason in result.message
    assert result.chi2_per_bin is None and np.all(np.isnan(result.fitted))
    assert result.parameters["c_w"].stderr is None and not result.parameters["c_w"].identifiable
    assert any(line.startswith("MODEL  not fitted: ") for line in str(result).splitlines())


def literal():
    """Equation (2) as printed: no stiffness and no damping at rest, noise in absolute units."""
    noise = jm.BandLimitedNoise((2.0, 1.0, 0.0, 0.0), relative=False)
    task = jm.PrescribedForce(noise=noise, F_ext=1.0, P_w=5.0, harmonic=jm.Harmonic(amplitude=0.0))
    return task.replace(x_ref_w=0.0, x_ref_z=0.0, v_ref_w=0.0, v_ref_z=0.0, c_w=2e4, c_z=2e4)


@pytest.mark.slow
def test_without_linear_response_only_monte_carlo_fits():
    with pytest.raises(jm.errors.OperatingPointError, match="undamped: eigenvalues"):
        jm.fit(literal(), simple_target(), free=("k_w", "noise_K_w"), **QUICK)
    found = jm.fit(
        literal(),
        simple_target(),
        free=("k_w", "noise_K_w"),
        method="montecarlo",
        **QUICK | {"starts": 1, "seeds": 8},
        max_steps=1,
        dt=1.25e-3,
    )
    # Later steps lead to where simulations explode. One program for all: a search begins with 8
    # seeds, and no point that is seen is so stiff that it asks for more steps than these.
    assert np.all(np.isfinite(found.fitted)) and len(found.starts) == 1
    assert found.profile is None and found.check == {}


@functools.cache
def quick_fit(**arguments):
    """A small fit of two parameters; the same shapes throughout, so that it is compiled once."""
    return jm.fit(jm.Isometric(), simple_target(), free=FEW, **QUICK, **arguments)


def test_one_failing_start_does_not_stop_the_others(monkeypatch):
    made = _search.starting_points

    def with_a_bad_one(*arguments):
        points = made(*arguments)
        points[0] = np.nan
        return points

    monkeypatch.setattr(_search, "starting_points", with_a_bad_one)
    result = quick_fit(key=1)
    assert result.success
    assert result.starts[0].cost is None and not result.starts[0].success
    assert result.starts[1].cost is not None


def test_the_same_seed_gives_the_same_fit():
    first, again = (
        quick_fit(),
        jm.fit(jm.Isometric(), simple_target(), free=FEW, key=jax.random.key(0), **QUICK),
    )
    assert {n: p.value for n, p in again.parameters.items()} == {
        n: p.value for n, p in first.parameters.items()
    }
    np.testing.assert_array_equal(again.fitted, first.fitted)
    assert first.seed == 0 and again.seed is None


def test_a_fit_is_in_double_precision_whatever_the_callers():
    assert not jax.config.jax_enable_x64
    result = quick_fit()
    assert result.success and not jax.config.jax_enable_x64
    assert result.fitted.dtype == np.float64
    value = result.parameters["c_w"].value
    assert float(np.float32(value)) != value


def test_progress_is_told_up_to_the_end():
    told = []
    found = jm.fit(
        jm.Isometric(),
        simple_target(),
        free=FEW,
        key=0,
        progress=lambda *a: told.append(a),
        **QUICK,
    )
    held = found.derived["harmonic_frequency"]  # it follows from what is fixed alone
    assert not held.free and held.stderr is None and held.identifiable is None
    shares = [share for _, share in told]
    assert shares == sorted(shares) and shares[0] == 0 and shares[-1] == 1
    for stage in ("searching from all starting points, misfit", "correcting by simulation"):
        assert any(stage in text for text, _ in told)


def interruption(stage):
    """What a fit calls with its progress, which interrupts at the second word of a stage."""
    count = 0

    def interrupt(text, share):
        nonlocal count
        count += stage in text
        if count == 2:
            count = 3
            raise KeyboardInterrupt

    return interrupt


def test_a_fit_interrupted_in_its_first_model_holds_what_had_been_reached():
    with pytest.raises(jm.fits.FitInterrupted) as caught:
        progress = interruption("searching from")
        jm.fit(jm.Isometric(), simple_target(), progress=progress, **QUICK)
    (task,) = caught.value.tasks
    assert type(task) is jm.Isometric and task["c_w"] != jm.Isometric()["c_w"]
    assert "interrupted after 2 steps" in caught.value.result.message


@pytest.mark.parametrize("stage", ["searching from", "correcting by"])
def test_an_interrupted_fit_holds_what_had_been_reached(stage):
    interrupt = interruption(stage)

    with pytest.raises(jm.fits.FitInterrupted) as caught:
        jm.fit(jm.Isometric(), simple_target(), free=FEW, progress=interrupt, **QUICK)
    result = caught.value.result
    assert not result.success and "interrupted after 2 steps" in result.message
    (task,) = caught.value.tasks
    assert {name: task[name] for name in FEW} == {name: result.task[name] for name in FEW}
    assert any(task[name] != jm.Isometric()[name] for name in FEW)
    assert np.all(np.isfinite(result.fitted)) and result.chi2_per_bin is not None
    assert all(start.steps <= (2 if stage == "searching from" else 12) for start in result.starts)


def test_the_answer_comes_before_the_checks_and_an_interruption_in_them_keeps_it():
    order, given = [], {"free": FEW, "key": 0, **QUICK}

    def tell(text, share):
        order.append(text)
        if text.startswith("checking with new simulations"):
            raise KeyboardInterrupt

    with pytest.raises(jm.fits.FitInterrupted) as caught:
        jm.fit(jm.Isometric(), simple_target(), progress=tell, answer=order.append, **given)
    (found,) = (x for x in order if not isinstance(x, str))
    assert order.index(found) == len(order) - 2 and order[-1].startswith("checking")
    kept = caught.value.result
    assert kept.success and kept.parameters == found.parameters
    assert not found.stretch[0].size and found.harmonic_p_value is None
    assert [n for n in kept.notices if n not in found.notices] == [
        "not done: the check by new simulations, the test of other frequencies of the harmonic, and"
        " its p-value. --quick (check_seeds=0) leaves these out, and so does an interruption"
    ]
    # The checks change no estimate, but for the spectrum's own numbers, which they simulate.
    whole, quick = jm.fit(jm.Isometric(), simple_target(), **given), found
    assert whole.parameters == quick.parameters and "seeds" in whole.check
    answers = []
    unchecked = jm.fit(
        jm.Isometric(), simple_target(), answer=answers.append, **(given | {"check_seeds": 0})
    )
    assert unchecked.parameters == quick.parameters and [a.notices for a in answers] == [
        unchecked.notices
    ]


def test_an_interruption_between_the_search_and_the_answer_keeps_what_the_search_found(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(jm.fits.FitInterrupted) as caught:
        patched.setattr(_search.Endpoint, "of", interrupt)
        jm.fit(jm.Isometric(), simple_target(), free=FEW, **QUICK)
    (task,) = caught.value.tasks
    assert {name: task[name] for name in FEW} == {
        name: caught.value.result.task[name] for name in FEW
    }
    assert caught.value.result.success and "seeds" not in caught.value.result.check


def test_an_interruption_before_the_first_step_has_no_result():
    def interrupt(text, share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt) as caught:
        jm.fit(jm.Isometric(), simple_target(), free=FEW, progress=interrupt, **QUICK)
    assert not isinstance(caught.value, jm.fits.FitInterrupted)


def test_a_start_in_the_stiff_region_survives(x64):
    """c_w / m_w = 4000/s."""
    result = jm.fit(jm.Isometric().replace(c_w=2000.0), simple_target(), free=FEW, **QUICK)
    assert np.all(np.isfinite(result.fitted)) and result.chi2_per_bin is not None
    assert all(start.cost is not None for start in result.starts)


def test_what_a_fit_says_about_itself():
    result = quick_fit()
    assert result.settings["free"] == list(FEW) and result.settings["starts"] == 2
    assert set(result.versions) >= {"jaxmuscle", "jax", "optimistix"}
    assert set(result.parameters) == set(jm.Isometric().parameter_names)
    assert result.free == FEW
    correlation = np.array(result.correlation["matrix"])
    np.testing.assert_allclose(np.diag(correlation), 1.0)
    assert abs(correlation[0, 1]) < 1
    assert float(result.task["c_w"]) == result.parameters["c_w"].value
    time, output = result.stretch
    assert time[-1] - time[0] == pytest.approx(5.0) and len(output) == len(time)
    residual = result.residual
    assert result.chi2_per_bin == pytest.approx(np.sum(residual**2) / 29)
    np.testing.assert_allclose(result.fitted.sum(), 1.0)


def test_monte_carlo_agrees_with_the_linear_fit():
    """The control variate leaves a dozen paths the error of thousands, so both minima are the
    same."""
    with without_intervals():
        linear = jm.fit(jm.Isometric(), simple_target(), **SIMULATED)
        simulated = jm.fit(jm.Isometric(), simple_target(), method="montecarlo", **SIMULATED)
    known = [
        name for name, estimate in (linear.parameters | linear.derived).items() if estimate.stderr
    ]
    assert len(known) > 3
    for name in known:
        # Both stop within a thousandth of the cost, some 0.1 standard errors, and correct with
        # different seeds.
        assert abs(simulated[name].value - linear[name].value) < 0.2 * linear[name].stderr, name


def test_controlled_moments_are_those_of_a_controlled_ensemble(x64):
    options = FitOptions(free=FEW, method="montecarlo", dt=1e-3, key=3)
    problem = planned(jm.Isometric(), simple_target(), options).problem
    (part,), seeds = problem.montecarlo(16).parts, 16
    assert part.model.control
    key = jax.random.fold_in(problem.key, 0)
    runs = runs_for_means(jm.Isometric().settled(), key, seeds)
    power = at_once(lambda task: part.model.moments(task).power, as_arrays(jm.Isometric()))
    np.testing.assert_allclose(power, runs.mean_spectrum().power[:30], rtol=1e-9)


def test_any_number_of_points_is_one_compiled_program(x64):
    problem = setup_of(jm.Isometric(), simple_target(), FREE, control=True)
    objective = problem.linear()
    theta = np.random.default_rng(0).normal(size=(BATCH + 5, 3))
    seen = expand(objective, theta)
    traces = len(_noise_rows.programs)
    single = expand(objective, theta[-2:])
    assert len(_noise_rows.programs) == traces
    np.testing.assert_allclose(seen.moments[0].power[-2:], single.moments[0].power, rtol=1e-12)
    assert seen.slopes[0].power.shape == (BATCH + 5, 30, 3)


def test_profile_and_bootstrap_find_a_line_that_is_there():
    """A spectrum of the model with a harmonic that holds its bin, and one without."""
    task = jm.Isometric().replace(harmonic_frequency=6.0, harmonic_amplitude=0.012)
    for changes, low, high in (({}, 0.0, 0.01), ({"harmonic_amplitude": 0.0}, 0.1, 1.0)):
        truth = jm.expected_spectrum(task.replace(**changes))
        target = jm.Target("truth", np.asarray(truth.proportional), segments=12)
        with without_intervals():
            found = jm.fit(
                jm.Isometric(), target, **RECOVERY | {"starts": 8, "seeds": 16, "check_seeds": 16}
            )
        assert found.harmonic_p_value is not None and low <= found.harmonic_p_value <= high
        assert found.profile is not None
        if not changes:
            frequency, rise = found.profile
            assert abs(frequency[np.argmin(rise)] - 6.0) < HALF_BIN
            assert np.median(rise) > 10


@pytest.mark.slow
def test_the_bootstrap_is_uniform_without_a_harmonic():
    """p-values of spectra drawn from the model without harmonic: not all as small as those of a
    bootstrap that forgets how many frequencies a harmonic may choose from.
    """
    task = jm.Isometric().replace(harmonic_amplitude=0.0)
    expected = np.asarray(jm.expected_spectrum(task).power)
    rng, nu = np.random.default_rng(0), 23.0
    free = ("c_w", "noise_K_w", "harmonic_amplitude", "harmonic_frequency")
    p = []
    for _ in range(4):
        power = expected * rng.chisquare(nu, 30) / nu
        target = jm.Target("null", power / power.sum(), segments=12)
        with without_intervals():
            found = jm.fit(jm.Isometric(), target, free=free, starts=8, check_seeds=16, seeds=0)
        p.append(found.harmonic_p_value)
    # All four below 0.1 have a probability of 1e-4. Bins are drawn independent here, while the
    # bootstrap correlates neighbours by 0.45, which a line of two bins mimics: it may only make p
    # larger.
    assert max(p) > 0.1


def ended(coordinates, frequencies, costs):
    """Starts that ended at these harmonic frequencies with these costs."""
    values = np.array([[f] for f in frequencies])
    s = coordinates.from_theta(np.log(values / coordinates.centre) / coordinates.sd)
    return Minima(s, np.array(costs), np.ones(len(costs), int), np.ones(len(costs), bool))


def test_other_minima_in_frequency_are_polished_too(x64):
    problem = setup_of(jm.Isometric(), VASTUS, ("harmonic_frequency",))
    found = ended(
        problem.coordinates, [3.9, 4.1, 6.6, 6.7, 8.0, 10.0], [5.0, 5.1, 6.0, 5.9, np.nan, 30.0]
    )
    # 4.1 and 6.6 Hz are nearer than a bin to a better one
    assert contenders(problem, found, 6.0) == [0, 3]
    assert contenders(problem, found, 0.5) == [0]
    other = setup_of(jm.Isometric(), VASTUS, ("c_w",))
    assert contenders(other, ended(other.coordinates, [400.0, 500.0], [2.0, 1.0]), 9.0) == [1]


def test_a_frequency_that_the_spectrum_leaves_open_is_called_ambiguous(x64):
    problem = setup_of(jm.Isometric(), VASTUS, ("harmonic_frequency",))
    close = ended(problem.coordinates, [3.9, 6.6], [5.0, 5.0 + 0.9 * AMBIGUOUS])
    clear = ended(problem.coordinates, [3.9, 6.6], [5.0, 5.0 + 1.1 * AMBIGUOUS])
    objective = problem.montecarlo(1)
    assert rivals(problem, Stage("clear", objective, clear), {}) == ((), set())
    (said,), moved = rivals(problem, Stage("close", objective, close), {})
    assert (
        moved == {"harmonic_frequency"}
        and "harmonic_frequency is ambiguous: 6.60 Hz fits almost as well" in said
    )


def test_two_equal_lines_make_the_frequency_ambiguous():
    """A target with the same hump at 4.3 and 8.6 Hz: whichever one the harmonic takes, the other
    fits as well."""
    f = jm.SpectrumSettings().frequency
    power = 1 / (1 + (f / 1.2) ** 2) + 0.02
    target = jm.Target(
        "twins", power * (1 + 0.9 * (np.isin(np.arange(1, 31), (11, 22)))), segments=4
    )
    free = ("c_w", "noise_K_w", "harmonic_amplitude", "harmonic_frequency")
    found = jm.fit(jm.Isometric(), target, free=free, starts=6, seeds=16, check_seeds=16)
    assert any("harmonic_frequency is ambiguous" in words for words in found.unstated)
    for table in (found.parameters, found.derived):
        assert (
            table["harmonic_frequency"].stderr is None
            and not table["harmonic_frequency"].identifiable
        )


def test_mean_force_and_no_spread():
    """Half a percent of the mean, which k_z alone can move; nothing is known about the scatter of
    the bins."""
    free = ("k_z", "noise_K_w")
    result = jm.fit(
        jm.Isometric(), simple_target(segments=None), free=free, mean_force=(3.0, 0.015), **QUICK
    )
    assert result.success
    assert abs(result.derived["model_mean"].value - 3.0) < 3 * 0.015
    assert result.chi2_per_bin is None and result.deviation is None
    assert result.rms_log_error is not None
    assert any("neither segments nor sigma" in notice for notice in result.notices)


def test_a_start_that_is_left_behind_ends_sooner():
    """Of four starts that gain evenly: the best; one near it; one far above and slow; one far above
    that comes nearer."""
    gains = np.array([0.02, 0.02, 0.02, 0.2])

    def active(margin, steps):
        none, cost = np.zeros(4, dtype=int), np.array([10.0, 11.5, 30.0, 30.0])
        now = _Standing(
            *[np.zeros((4, 1))] * 2,
            cost,
            none,
            none,
            none,
            none,
            none,
            none,
            np.ones(4, dtype=bool),
        )
        for _ in range(steps):
            now = now.advanced(now.s, now.ahead, now.cost - gains, now.accepted + 1, margin)
        return now.active.tolist()

    assert active(2.0, 1) == [True] * 4  # it takes two small gains in a row
    assert active(2.0, 2) == [True, True, False, True]
    assert active(np.inf, 2) == [True] * 4


def test_a_task_that_is_traced_is_refused_with_a_way_out():
    target = jm.load_target("vastus-lateralis-26mvc")
    with pytest.raises(
        ValueError, match=r"JAX is tracing it.*Call fit outside; jaxmuscle.fits.problem"
    ):
        jax.jit(lambda k_w: jm.fit(jm.Isometric().replace(k_w=k_w), target).chi2_per_bin)(4e5)
