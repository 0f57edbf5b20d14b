"""Where a search stands (`Stage`), and what the model gives there: by the linear response
(`expand_at_best`), and by simulation with the linear response as control (`controlled_moments`).
The search, the verdict, the checks and the report read it.
"""

from typing import NamedTuple

import jax
import numpy as np

from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._consequences import Expansion, expand
from jaxmuscle.objective._least_squares import Minima
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.simulation._trajectory import Trajectory
from jaxmuscle.spectra._bin_law import recorded_interval, trial_samples
from jaxmuscle.spectra._settings import WINDOW


class Stage(NamedTuple):
    """A stage of a search: its name, the residuals it lowers, and where its starts stand."""

    name: str
    objective: Residuals
    minima: Minima


def controlled_moments(
    runs: Trajectory, target: Target, task: AbstractTask
) -> tuple[Moments, Moments | None]:
    """Moments of every seed, whose mean has the expectation of the nonlinear model, and those of
    the linear response.

    With a control variate a seed's power is `e + p_i - l_i` (see `Trajectory.mean_spectrum`), and
    so is its variance, e being that of a recording as long as the target's.
    """
    settings = target.settings
    held = runs.filtered(settings)
    power, variance = np.asarray(runs.spectrum(settings).power), held.var(axis=1)
    expected = None
    if runs.linear is not None:
        sampled = trial_samples(target), recorded_interval(target, settings)
        exact, _ = expected_moments(task, settings, WINDOW, *sampled)
        expected = jax.tree.map(np.asarray, exact)
        beside = runs.beside()
        power = expected.power + power - np.asarray(beside.spectrum(settings).power)
        variance = expected.variance + variance - beside.filtered(settings).var(axis=1)
    line = np.zeros_like(power) if expected is None else np.broadcast_to(expected.line, power.shape)
    mean = held.mean(axis=1)
    return Moments(power, line, mean, variance), expected


def expand_at_best(objective: Residuals, minima: Minima) -> Expansion:
    """What the model gives at the best point."""
    return expand(objective, np.asarray(objective.theta(minima.s))[[minima.best]]).row(0)
