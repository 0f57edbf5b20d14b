"""Perturbed recordings as the target of a fit: the response to the perturbation is taken off by
the model that is fitted. `_fit.py`, `_joint.py` and `_cohort.py` begin with it.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jaxmuscle.data._as_target import as_target
from jaxmuscle.data._frequency_response import UNSEEN, check_seen
from jaxmuscle.data._perturbed import (
    HALF_STEPS,
    Answer,
    PerturbedRecording,
    explained_power,
    halves,
    perturbed_target,
)
from jaxmuscle.data._target import Target
from jaxmuscle.data._two_channels import perturbed_recordings
from jaxmuscle.model._parameters import HARMONIC
from jaxmuscle.model._rungs import is_base
from jaxmuscle.model._tasks import AbstractTask, PrescribedLength
from jaxmuscle.objective._arguments import Plan, at_mean, planned
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
    """The target with the answer of a task taken off."""
    return perturbed_target(recordings, answer_of(muscle))


def answer_of(muscle: AbstractTask) -> Answer:
    """How the force of a moved muscle answers: of the nonlinear muscle, or of the linear one and a
    reflex that may answer lengthening alone.

    A reflex of twice the gain that answers max(v, 0), v the velocity, is the linear one and, beside
    it, one that answers |v|: 2 max(v, 0) = v + |v|. (Its mean is left in the force.)
    """
    assert isinstance(muscle, PrescribedLength)

    def stiffness(f: np.ndarray) -> np.ndarray:
        return np.asarray(dynamic_stiffness(muscle, f))

    def nonlinear(motion: np.ndarray, interval: float, reply: np.ndarray) -> np.ndarray:
        whole = driven(muscle, -motion, interval)  # at every second time of the motion
        return whole[:: HALF_STEPS // 2][: len(reply)] - reply

    if muscle.reflex is None:
        return Answer(stiffness, nonlinear)
    tissues = muscle.with_parts(reflex=None)

    def rectified(motion: np.ndarray, interval: float, reply: np.ndarray) -> np.ndarray:
        f = np.fft.rfftfreq(len(reply), HALF_STEPS * interval)[1:]
        speed = np.fft.rfft(np.abs(motion[1][:-1]))[1 : len(f) + 1] / HALF_STEPS
        own = stiffness(f) - np.asarray(dynamic_stiffness(tissues, f))
        return np.fft.irfft(np.append(0.0, own / (2j * np.pi * f) * speed), len(reply))

    return Answer(stiffness, rectified, one_way=True)


def explained(
    task: PrescribedLength,
    recordings: Sequence[PerturbedRecording],
    band: tuple[float, float],
    planned_for: Callable[[Target, Sequence[PerturbedRecording]], Plan],
    max_steps: int,
) -> dict[str, float]:
    """Which share of the variance of the force in a band [Hz] the fitted task explains: 1 - Σ |F -
    H L|² / Σ |F|² with the transforms of force and lengthening.

    `low` and `high` of the band; `together`; with a reflex `tissues`, what H without it explains,
    and `reflex`, what it adds; `other_half`, what a fit to one half of every window explains of the
    other one, for both halves. (The answer that is refined by what a half shows is that of the
    whole: to first order no bias, see docs/reflex.md.)
    """

    def share(muscle: AbstractTask) -> float:
        power, whole = explained_power(recordings, answer_of(muscle), band)
        return float(power / whole)

    found = {"low": band[0], "high": band[1], "together": share(task)}
    if task.reflex is not None:
        found["tissues"] = share(task.with_parts(reflex=None))
        found["reflex"] = found["together"] - found["tissues"]
    each, sums = halves(recordings), np.zeros(2)
    for one, other in zip(each, each[::-1], strict=True):
        try:
            plan = planned_for(seen_with(task, one), one)
        except ValueError:  # a half in which too little moves has no fit of its own
            return found
        c = plan.problem.coordinates
        point = c.from_theta(c.at(np.array([[float(task[name]) for name in c.names]])))
        fitted = least_squares(plan.problem.linear(), np.asarray(point), max_steps)
        if not np.isfinite(fitted.cost[fitted.best]):
            return found
        (half,) = plan.problem.tasks_at(np.asarray(c.theta(fitted.s[fitted.best])))
        sums += explained_power(other, answer_of(half), band, shown_by=one)
    return found | ({"other_half": float(sums[0] / sums[1])} if each else {})


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
