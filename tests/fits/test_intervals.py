"""95 % intervals against the profile of the cost on a grid; those of a half-power frequency about a
shelf."""

import equinox as eqx
import golden
import jax
import numpy as np
import pytest
import scipy.stats
from scipy.interpolate import RectBivariateSpline

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.fits._intervals import Interval, intervals
from jaxmuscle.fits._report import with_intervals
from jaxmuscle.fits._result import Estimate
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._consequences import consequences, consequences_of_rows, expand
from jaxmuscle.objective._covariance import parameter_covariance, residual_covariance
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.response._linearised import linearise
from jaxmuscle.response._transfer import half_power_frequency, half_power_level
from jaxmuscle.spectra._settings import WINDOW

NAME, FREE = "half_power_frequency", ("c_w", "c_z")
# Without harmonic and floor. The passive damper makes a shelf at (2 C_z / (C_w + C_z))² of the
# power at 0.
STILL = jm.Isometric().replace(harmonic_amplitude=0.0, noise_K_z=1e-4)
STEEP, BENT, SHELF = (STILL.replace(c_z=c) for c in (5.0, 15.0, 20.0))
LAST = 30.5 * STILL.settings.resolution  # upper edge of the bins


def test_an_interval_that_says_next_to_nothing_is_none():
    ends = {
        "known": Interval(-2.0, 2.0, True),
        "half": Interval(-1.0, None, True),
        "signed": Interval(-1.5, 400.0, False),
        "vague": Interval(-4.0, 1.0, True),
        "open": Interval(None, None, True),
    }
    found = with_intervals({name: Estimate(1.0, "1", 0.1, True, True) for name in ends}, ends)
    assert [name for name, p in found.items() if p.stderr is not None] == [
        "known",
        "half",
        "signed",
    ]
    assert all(
        found[name].identifiable is False and found[name].interval is None
        for name in ("vague", "open")
    )


def drawn(task, segments, seed):
    """A spectrum that scatters about that of a task by the law of its bins."""
    moments, _ = expected_moments(as_arrays(task), task.settings, WINDOW)
    return golden.drawn(np.asarray(moments.proportional), segments, seed)


def fitted(task, target, start=(0.0, 0.0)):
    """Problem, residuals, and where Gauss-Newton steps by hand end."""
    problem = planned(task, target, FitOptions(free=FREE)).problem
    objective, theta = problem.linear(), np.array(start)
    for _ in range(8):
        found = consequences(objective, expand(objective, theta[None]).row(0))
        curvature = found.jacobian.T @ found.jacobian + np.eye(len(theta))
        step = np.linalg.solve(curvature, found.jacobian.T @ found.residuals + theta)
        theta = theta - step / max(1.0, np.max(np.abs(step)))
    return problem, objective, expand(objective, theta[None]).row(0)


def inverse_curvature(objective, seen):
    found = consequences(objective, seen)
    return np.linalg.inv(found.jacobian.T @ found.jacobian + np.eye(len(seen.theta)))


AXIS = np.linspace(-1.2, 1.2, 33)
FINE = np.linspace(-1.2, 1.2, 193)
PLANE = np.stack(np.meshgrid(AXIS, AXIS, indexing="ij"), axis=-1).reshape(-1, 2)


def rise(objective, seen, theta):
    """Root of twice the rise of the cost above that of the fit."""
    rows = expand(objective, np.concatenate([seen.theta[None], theta]))
    cost = np.sum(consequences_of_rows(objective, rows).residuals ** 2, axis=1) + np.sum(
        rows.theta**2, axis=1
    )
    return np.sqrt(np.maximum(cost[1:] - cost[0], 0.0))


def _response(task):
    time = 0.0 if task.activation is None else task.activation.time
    return linearise(task), task.muscle.base()[0], time


@eqx.filter_jit
def _levels(task, dampings, log_f):
    def one(c_w, c_z):
        changed = task.replace(c_w=c_w, c_z=c_z)
        return half_power_level(*_response(changed), log_f)

    return jax.vmap(one)(*dampings)


@eqx.filter_jit
def _level(task, log_f):
    return half_power_level(*_response(task), log_f)


@eqx.filter_jit
def _frequency(task):
    return half_power_frequency(*_response(task))


def level(task, theta, f):
    """`ln(2 |H(f)|² / |H(0)|²)` of the task with both dampings times exp(θ)."""
    dampings = np.array([task[n] for n in FREE])[:, None] * np.exp(theta.T)
    return np.asarray(_levels(as_arrays(task), tuple(dampings), np.log(f)))


def level_at(task, f):
    """The same of the task itself, at several frequencies."""
    return np.asarray(_level(as_arrays(task), np.log(f)))


def frequency_of(task):
    return float(_frequency(as_arrays(task)))


def finer(values):
    """Values on the plane, by cubic splines on the finer one."""
    return RectBivariateSpline(AXIS, AXIS, values.reshape(AXIS.size, AXIS.size))(FINE, FINE)


def lowest(levels, rises):
    """The least rise over the line on which the level is zero, of values on the plane.

    The line is taken where the level changes its sign between two points of a finer plane, linear
    in between; splines lead from one plane to the other.
    """
    levels, rises = (finer(levels), np.sqrt(np.maximum(finer(rises**2), 0.0)))
    on_line = []
    for before, after in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        crossed = levels[before] * levels[after] < 0
        low, high = levels[before][crossed], levels[after][crossed]
        first, second = rises[before][crossed] ** 2, rises[after][crossed] ** 2
        on_line.append(np.sqrt(first + low / (low - high) * (second - first)))
    return np.min(np.concatenate(on_line))


@pytest.mark.parametrize(
    ("task", "segments"), [(STEEP, 6), (BENT, 45), (SHELF, 45)], ids=["steep", "bent", "shelf"]
)
def test_an_interval_ends_where_the_profile_does(task, segments, x64):
    """With the inverse curvature as covariance the root of the rise that is sought is 1.96, at
    either end."""
    names = ["corner_frequency", "band_8_12", "model_coefficient_of_variation"]
    problem, objective, seen = fitted(task, drawn(task, segments, 3))
    value, theta = consequences(objective, seen).values[0], seen.theta + PLANE
    over_plane, rises = (
        consequences_of_rows(objective, expand(objective, theta)).values[0],
        rise(objective, seen, theta),
    )
    found = intervals(
        problem, objective, seen, inverse_curvature(objective, seen), dict.fromkeys(names, 1.0)
    )
    # the same number, as a parameter and as what follows from it
    own = intervals(
        problem, objective, seen, inverse_curvature(objective, seen), {"c_w": 1.0, "C_w0": 1.0}
    )
    np.testing.assert_allclose(own["c_w"], own["C_w0"], rtol=1e-6)
    for name in names:
        ends = found[name].about(value[name])
        assert ends[0] < value[name] < ends[1]
        at = [lowest(np.log(over_plane[name] / end), rises) for end in ends]
        np.testing.assert_allclose(at, 1.96, rtol=0.04, err_msg=name)


def test_the_level_is_zero_at_the_half_power_frequency(x64):
    for task in (STEEP, BENT, SHELF, jm.model.on_rung(STEEP, 1)):
        at, below, above = level_at(task, frequency_of(task) * np.exp([0.0, -0.1, 0.1]))
        # One Newton step from a grid of 3 %: what it leaves is of the order of 3 % squared.
        assert abs(at) < 1e-3
        assert below > 0 > above


def test_the_frequency_jumps_where_the_level_does_not(x64):
    """A third more of the passive damping: four times the frequency, and below it at most a third
    more power."""
    low, high = map(frequency_of, (BENT, SHELF))
    assert high > 3.5 * low
    grid = np.geomspace(0.2, low, 50)
    assert np.max(np.abs(level_at(SHELF, grid) - level_at(BENT, grid))) < 0.3


@pytest.mark.parametrize("task", [STEEP, BENT], ids=["steep", "bent"])
def test_that_of_a_half_power_frequency_ends_where_its_profile_does(task, x64):
    """With the inverse curvature as covariance the root of the rise that is sought is 1.96, at
    either end."""
    problem, objective, seen = fitted(task, drawn(task, 45, 3))
    value, gain = consequences(objective, seen).values[0][NAME], inverse_curvature(objective, seen)
    low, high = intervals(problem, objective, seen, gain, {NAME: 1.0})[NAME].about(value)
    assert low < value < high
    rises = rise(objective, seen, seen.theta + PLANE)
    np.testing.assert_allclose(
        [lowest(level(task, seen.theta + PLANE, f), rises) for f in (low, high)], 1.96, rtol=0.03
    )


def test_about_a_shelf_there_is_no_interval(x64):
    """The region reaches over the bins."""
    problem, objective, seen = fitted(SHELF, drawn(SHELF, 45, 3))
    value, gain = consequences(objective, seen).values[0][NAME], inverse_curvature(objective, seen)
    assert value < 0.2 * LAST
    theta = seen.theta + PLANE
    rises = rise(objective, seen, theta)
    assert (
        max(lowest(level(SHELF, theta, f), rises) for f in np.geomspace(value, 2 * LAST, 8)[1:])
        < 1.96
    )
    assert intervals(problem, objective, seen, gain, {NAME: 1.0})[NAME].about(value) == (
        None,
        None,
    )


def test_stated_intervals_hold_the_truth(x64):
    """Dampings drawn from the prior about a bent response: misses at most as 5 % allow once in 10
    000 runs."""
    rng, held = np.random.default_rng(8), []
    for seed in range(40):
        theta = rng.standard_normal(2)
        truth = BENT.replace(
            c_w=float(BENT["c_w"]) * np.exp(theta[0]), c_z=float(BENT["c_z"]) * np.exp(theta[1])
        )
        problem, objective, seen = fitted(BENT, drawn(truth, 12, seed), theta)
        found = consequences(objective, seen)
        scatter = residual_covariance(problem.parts[0].target, objective.parts[0], np.zeros(30))
        covariance = parameter_covariance(found.jacobian, scatter, problem.precision)
        value = float(found.values[0][NAME])
        low, high = intervals(problem, objective, seen, covariance, {NAME: 1.0})[NAME].about(value)
        if low is not None:
            held.append(low <= frequency_of(truth) <= high)
    assert len(held) >= 15 and len(held) - sum(held) <= scipy.stats.binom.isf(1e-4, len(held), 0.05)
