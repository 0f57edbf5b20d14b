"""Perturbed recordings as the target of a fit: the response to the perturbation is taken off by
the model that is fitted. `_fit.py`, `_joint.py` and `_cohort.py` begin with it.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jaxmuscle.data._as_target import as_target
from jaxmuscle.data._frequency_response import UNSEEN, check_seen
from jaxmuscle.data._perturbed import PerturbedRecording, perturbed_target
from jaxmuscle.data._target import Target
from jaxmuscle.data._two_channels import perturbed_recordings
from jaxmuscle.model._parameters import HARMONIC
from jaxmuscle.model._rungs import is_base
from jaxmuscle.model._tasks import AbstractTask, PrescribedLength
from jaxmuscle.objective._arguments import at_mean, planned
from jaxmuscle.objective._least_squares import least_squares
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._starts import starting_points
from jaxmuscle.response._input_response import dynamic_stiffness
from jaxmuscle.simulation._driven import driven
from jaxmuscle.spectra._bin_law import bin_statistics

STARTS, STEPS, ROUNDS, KEPT = 16, 20, 2, 2
NEAR = 0.1
ANEW = "subtracting the response to the movement by the model found"


def aimed(
    given: Any, task: AbstractTask | None = None, options: FitOptions | None = None
) -> Target:
    """The target of whatever a fit was given; that of perturbed recordings with the response of the
    task's muscle."""
    recordings = recordings_of(given, task)
    if not recordings:
        return as_target(given)
    with jax.enable_x64(True):
        return analysed(
            recordings, PrescribedLength() if task is None else task, options or FitOptions()
        )


def without_rhythm(task: AbstractTask, options: FitOptions) -> AbstractTask:
    """The task without its harmonic, where the fit may leave that out: nobody asked for it, and the
    model is a base one.

    A harmonic whose frequency is sought in the noise of the spectrum bends that. It is fitted where
    the spectrum shows one (docs/perturbed.md).
    """
    named = {*(options.fix or ()), *(options.priors or ()), *(options.bounds or ())}
    asked = options.free is not None or not named.isdisjoint(HARMONIC)
    if asked or options.method != "linear" or not is_base(task):
        return task
    return task.replace(harmonic_amplitude=0.0)


def seen_with(muscle: AbstractTask, recordings: Sequence[PerturbedRecording]) -> Target:
    """The target with the response of a task's nonlinear muscle taken off, or of the linear one
    where that is not finite."""
    assert isinstance(muscle, PrescribedLength)

    def stiffness(f: np.ndarray) -> np.ndarray:
        return np.asarray(dynamic_stiffness(muscle, f))

    if muscle.reflex is not None:  # a delay is known to the linear response only
        return perturbed_target(recordings, stiffness)

    def predicted(motion: np.ndarray, interval: float) -> np.ndarray:
        return driven(muscle, -motion, interval)

    return perturbed_target(recordings, stiffness, predicted=predicted)


def alike(one: Target, other: Target) -> bool:
    """Whether two targets of the same recordings differ by less than a tenth of their scatter, as
    root mean squares."""
    apart = []
    if one.stiffness is not None and other.stiffness is not None:
        known, again = one.stiffness.known, other.stiffness.known
        if len(known.frequency) != len(again.frequency):
            return False
        apart.append(np.abs(again.value - known.value) / known.stderr / np.sqrt(2))
    if len(one.bins):
        level, later = (
            np.log(t.proportional_power)
            + np.log(np.mean(np.square(t.coefficient_of_variation or 1.0)))
            for t in (one, other)
        )
        apart.append((later - level) / bin_statistics(one).sd)
    return all(np.sqrt(np.mean(np.square(each))) < NEAR for each in apart)


def recordings_of(
    given: object, task: AbstractTask | None = None
) -> tuple[PerturbedRecording, ...]:
    """The perturbed recordings that a fit was given, for that or any task; none of anything else.

    Files of two channels are read as such only where neither the task nor the displacement says
    that the insertion is held.
    """
    return perturbed_recordings(
        given, files=task is None or type(task) is PrescribedLength, held=task is None
    )


def analysed(
    recordings: Sequence[PerturbedRecording], task: AbstractTask, options: FitOptions
) -> Target:
    """Their target, with the response by the muscle that fits it: found in a few rounds from the
    nonparametric one."""
    _check_trials(recordings)
    target, points = perturbed_target(recordings), None
    for _ in range(ROUNDS):
        carried, given = at_mean(task, target, options)
        problem = planned(carried, target, dataclasses.replace(given, method="linear")).problem
        points = starting_points(problem, STARTS) if points is None else points
        found = least_squares(problem.linear(), points, STEPS)
        if not np.isfinite(found.cost[found.best]):
            break
        (muscle,) = problem.tasks_at(np.asarray(problem.coordinates.theta(found.s[found.best])))
        points = found.s[np.argsort(np.where(np.isfinite(found.cost), found.cost, np.inf))[:KEPT]]
        target = seen_with(muscle, recordings)
    return target


def _check_trials(recordings: Sequence[PerturbedRecording]) -> None:
    """Refuse a trial whose force does not follow its displacement, though it would be seen to
    follow as in the others."""
    if len(recordings) < 2:
        return
    each = [
        one
        for recording in recordings
        if (one := perturbed_target((recording,)).stiffness) is not None
    ]
    for number, own in enumerate(each):
        if own.p_none <= UNSEEN:
            continue
        others = [other for i, other in enumerate(each) if i != number]
        weight = np.array(
            [np.interp(own.frequency, other.frequency, other.stderr**-2.0) for other in others]
        )
        value = [
            np.interp(own.frequency, other.frequency, np.real(other.value))
            + 1j * np.interp(own.frequency, other.frequency, np.imag(other.value))
            for other in others
        ]
        usual, error = np.average(value, axis=0, weights=weight), 1 / np.sqrt(weight.sum(axis=0))
        apart = dataclasses.replace(
            own, value=own.value - usual, stderr=np.hypot(own.stderr, error)
        )
        if apart.p_none <= UNSEEN:
            check_seen(
                own, f"trial {number + 1} of {len(recordings)} ({recordings[number].source})"
            )
