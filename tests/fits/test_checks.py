"""When a fit counts as converged, and how far its spectrum lies from the linear response: against
scipy and NumPy."""

import numpy as np
import pytest
import scipy.stats

from jaxmuscle.fits._checks import convergence, linear_check
from jaxmuscle.fits._result import Start
from jaxmuscle.objective._covariance import Identifiability
from jaxmuscle.objective._least_squares import Minima
from jaxmuscle.spectra._bin_law import BinStatistics

DETERMINED = Identifiability(np.full(3, 10.0), np.eye(3))


def cost_of(residuals, prior, theta):
    """What a fit minimises: ½ Σ r² + ½ Σ prior θ²."""
    return 0.5 * np.sum(residuals**2) + 0.5 * np.sum(prior * theta**2)


def told(residuals, jacobian, prior, theta, known=DETERMINED, settled=False, starts=()):
    cost = cost_of(residuals, prior, theta)
    final = Minima(theta[None], np.array([cost]), np.array([64]), np.array([settled]))
    starts = starts or (Start(cost, False, 64, (), "spread"),)
    return convergence(final, residuals, jacobian, np.diag(prior), theta, known, starts, 64)


@pytest.fixture
def quadratic():
    """Residuals that are linear in θ, where a fit stopped, and the step to its minimum by NumPy's
    least squares."""
    rng = np.random.default_rng(11)
    jacobian, residuals = rng.standard_normal((12, 3)), 5 * rng.standard_normal(12)
    prior, theta = np.array([1.0, 2.0, 0.5]), np.array([0.3, -0.4, 0.8])
    whole = np.concatenate([jacobian, np.diag(np.sqrt(prior))])
    step = np.linalg.lstsq(whole, -np.concatenate([residuals, np.sqrt(prior) * theta]), rcond=None)[
        0
    ]
    return residuals, jacobian, prior, theta, step


def test_what_a_further_step_would_gain_is_said(quadratic):
    residuals, jacobian, prior, theta, step = quadratic
    before = cost_of(residuals, prior, theta)
    gain = 1 - cost_of(residuals + jacobian @ step, prior, theta + step) / before
    success, message = told(residuals, jacobian, prior, theta)
    assert gain > 0.01 and not success
    assert f"a further step would still improve the fit by {100 * gain:.2g} %" in message
    assert told(residuals, jacobian, prior, theta, settled=True)[0]


def test_a_fit_at_its_minimum_has_converged(quadratic):
    residuals, jacobian, prior, theta, step = quadratic
    # of the step to the minimum
    for share, converged in ((1.0, True), (0.999, True), (0.5, False)):
        success, message = told(
            residuals + share * jacobian @ step, jacobian, prior, theta + share * step
        )
        assert success is converged and ("converged: 1 of 1 starts" in message) is converged, share


def test_a_step_along_what_the_data_do_not_determine_is_no_failure():
    jacobian = np.eye(12, 3)
    jacobian[:, 2] = 0.0  # no datum depends on the third parameter
    residuals = np.where(np.arange(12) > 2, 1.0, 0.0)  # at their minimum
    prior, theta = np.ones(3), np.array([0.0, 0.0, 5.0])
    known = Identifiability(np.array([10.0, 10.0, 0.0]), np.eye(3))
    success, message = told(residuals, jacobian, prior, theta, known)
    assert success and "change only what the data do not determine" in message
    assert not told(residuals, jacobian, prior, theta)[0]


def test_the_linear_response_against_fresh_seeds():
    """Deviations from the mean over the seeds, with scipy's standard error of a mean; in logarithms
    over the bins' sd."""
    rng = np.random.default_rng(12)
    expected, sd = np.array([3.0, 2.0, 1.0]), np.array([0.3, 0.2, 0.25])
    each = expected * (1.1 + 0.2 * rng.standard_normal((5, 3)))
    found = linear_check(
        each, expected, BinStatistics(np.zeros(3), sd, np.eye(3), np.ones(3), True)
    )
    off = each.mean(axis=0) / expected - 1
    assert found["seeds"] == 5
    assert found["largest_deviation"] == pytest.approx(np.max(np.abs(off)))
    assert found["largest_deviation_se"] == pytest.approx(
        np.max(np.abs(off * expected) / scipy.stats.sem(each))
    )
    assert found["largest_deviation_sd"] == pytest.approx(np.max(np.abs(np.log(1 + off)) / sd))


@pytest.mark.parametrize(
    ("ended", "words"),
    [
        ("peak 1, spread 1.4, spread 3", "converged: 2 of 3 starts reach this minimum"),
        ("peak 1, spread 1.6", "best of 2 starts, found once (from peaks): a better minimum may"),
        ("spread 1, spread 1, peak 2", "best of 3 starts, found 2 times, by one kind of start"),
        ("spread 1", "converged: 1 of 1 starts"),
    ],
)
def test_only_two_kinds_of_start_at_one_minimum_are_called_converged(quadratic, ended, words):
    residuals, jacobian, prior, theta, _ = quadratic
    each = (start.split() for start in ended.split(", "))
    starts = tuple(Start(float(cost), True, 9, (), kind) for kind, cost in each)
    success, message = told(residuals, jacobian, prior, theta, settled=True, starts=starts)
    assert success and message.startswith(words)
