"""Data as a fitted task would give them: recordings simulated nonlinearly, or spectra drawn from
the law of a sigma."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmuscle._common.errors import SimulationError
from jaxmuscle.data._target import Target
from jaxmuscle.ensembles._ensemble import ensemble
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._likelihood import Likelihood, drawn_spectra, repeated
from jaxmuscle.objective._problem import FitProblem, Part, target_variation
from jaxmuscle.response._equilibrium import slowest_rate
from jaxmuscle.response._input_response import dynamic_stiffness
from jaxmuscle.response._linearised import settled
from jaxmuscle.spectra._measures import coefficient_of_variation

LEAD, FORGOTTEN = 5.0, 8.0
Datum = tuple[Target, float]
Made = dict[int, tuple[Datum, ...]]


def replicates_of(
    problem: FitProblem, tasks: tuple[AbstractTask, ...], count: int
) -> tuple[Made, dict[int, str]]:
    """Targets of every part with their mean output, as the tasks would give them; and why others
    could not be made.

    From the nonlinear simulator; where a target states no segments, drawn about its spectrum in
    linear response.
    """
    failed: dict[int, str] = {}
    parts = []
    for i, (part, task) in enumerate(zip(problem.parts, tasks, strict=True)):
        key = jax.random.fold_in(problem.key, 31)
        key = jax.random.fold_in(key, 1000 + i) if i else key
        if part.target.segments is None:
            parts.append(_drawn(problem, tasks, i, count, key))
        else:
            parts.append(_simulated(part, task, count, key, failed))
        parts[-1] = _with_stiffness(part, task, parts[-1], jax.random.fold_in(key, 77))
    made = {
        n: tuple(part[n] for part in parts)
        for n in range(count)
        if all(n in part for part in parts)
    }
    return made, {n: why for n, why in failed.items() if n not in made}


def _with_stiffness(
    part: Part, task: AbstractTask, made: dict[int, Datum], key: Array
) -> dict[int, Datum]:
    """The targets with dynamic stiffnesses that scatter about the task's as the measured one does,
    where there is one."""
    measured = part.target.stiffness
    if measured is None:
        return made
    measured = measured.known
    true = np.asarray(dynamic_stiffness(settled(task), measured.frequency))
    found = {}
    for number, (target, mean) in made.items():
        normal = np.asarray(jax.random.normal(jax.random.fold_in(key, number), (2, len(true))))
        value = true + measured.stderr * (normal[0] + 1j * normal[1])
        found[number] = target.with_stiffness(dataclasses.replace(measured, value=value)), mean
    return found


def _simulated(
    part: Part, task: AbstractTask, count: int, key: Array, failed: dict[int, str]
) -> dict[int, Datum]:
    """Targets from the nonlinear simulator, with their mean output; they scatter as much more as
    the target's trials do."""
    still = settled(task)
    trials = list(part.target.segments or ())
    runs = [
        _runs(still, part.target, K, jax.random.fold_in(key, trial), np.arange(count), failed)
        for trial, K in enumerate(trials)
    ]
    made, spread = {}, part.target.overdispersion
    whole = {
        number: [each[number] for each in runs]
        for number in range(count)
        if all(number in each for each in runs)
    }
    # Trials count in proportion to their segments, as in the law of the bins.
    powers = {
        n: np.average([row[0] for row in rows], axis=0, weights=trials)[part.chosen]
        for n, rows in whole.items()
    }
    middle = (
        np.exp(np.mean([np.log(power) for power in powers.values()], axis=0)) if powers else 1.0
    )
    for number, rows in whole.items():
        power = middle * (powers[number] / middle) ** spread
        target = _target(part.target, number, power, [row[1] for row in rows])
        made[number] = target, float(np.mean([row[2] for row in rows]))
    return made


def _runs(
    task: Any,
    target: Target,
    segments: int,
    key: Array,
    numbers: np.ndarray,
    failed: dict[int, str],
) -> dict[int, Any]:
    """Welch power, coefficient of variation and mean of one trial of every replicate that stays
    finite."""
    settings = target.settings
    rate = float(slowest_rate(task))
    start = math.ceil(max(LEAD, FORGOTTEN / rate) * settings.rate) / settings.rate
    window = start, start + (settings.length + (segments - 1) * settings.step) / settings.rate
    try:
        runs = ensemble(task, key, seeds=numbers, duration=window[1], control=False)
    except SimulationError as error:
        if len(numbers) == 1:
            failed[int(numbers[0])] = str(error)
            return {}
        halves = np.array_split(numbers, 2)
        return {
            n: x
            for half in halves
            for n, x in _runs(task, target, segments, key, half, failed).items()
        }
    power, held = np.asarray(runs.spectrum(settings, window).power), runs.filtered(settings, window)
    variation = np.asarray(coefficient_of_variation(held))
    return {
        int(n): (power[i], float(variation[i]), float(held[i].mean()))
        for i, n in enumerate(numbers)
    }


def _target(
    like: Target, number: int, power: np.ndarray, variation: list[float], sigma: Any = None
) -> Target:
    """A target as the given one, of other data; one coefficient of variation where that has one."""
    stated = like.coefficient_of_variation
    if stated is not None and len(stated) != len(variation):
        variation = [float(np.sqrt(np.mean(np.square(variation))))] * len(stated)
    return Target(
        f"{like.name}, replicate {number}",
        power,
        bins=like.bins,
        quantity=like.quantity,
        segments=like.segments,
        sigma=sigma,
        coefficient_of_variation=None if stated is None else variation,
        dispersion=like.dispersion,
        settings=like.settings,
    )


def _drawn(
    problem: FitProblem, tasks: tuple[AbstractTask, ...], i: int, count: int, key: Array
) -> dict[int, Datum]:
    """Targets drawn from the Gaussian law about the fitted spectrum of one part in linear
    response."""
    part, moments, keys = (
        problem.parts[i],
        repeated(problem, tasks, count)[i],
        jax.random.split(key, 3),
    )
    power = drawn_spectra(Likelihood.of(problem).bins[i], part.target, moments, keys[0])
    scatter = [0.0 if given is None else float(given[1]) for given in (part.variation, part.mean)]
    variation = moments.variation * np.exp(
        scatter[0] * np.asarray(jax.random.normal(keys[1], (count,)))
    )
    mean = moments.mean + scatter[1] * np.asarray(jax.random.normal(keys[2], (count,)))
    relative = np.asarray(part.target.sigma) / part.target.proportional_power
    return {
        n: (_target(part.target, n, p, [float(v)], relative * p), float(m))
        for n, (p, v, m) in enumerate(zip(power, variation, mean, strict=True))
    }


def with_data(problem: FitProblem, data: tuple[Datum, ...]) -> FitProblem:
    """The problem with other data, of the same kinds."""
    parts = []
    for part, (target, mean) in zip(problem.parts, data, strict=True):
        variation = None if part.variation is None else target_variation(target)
        stated = None if part.mean is None else (mean, part.mean[1])
        parts.append(dataclasses.replace(part, target=target, variation=variation, mean=stated))
    return dataclasses.replace(problem, parts=tuple(parts))
