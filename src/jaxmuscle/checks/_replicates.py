"""Data as a fitted task would give them: recordings simulated nonlinearly, or spectra drawn from the law of a sigma."""

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from jaxmuscle._common.arrays import as_arrays, as_numbers
from jaxmuscle._common.errors import SimulationError
from jaxmuscle.data._target import Target
from jaxmuscle.ensembles._ensemble import ensemble
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._likelihood import Likelihood, drawn_spectra, repeated
from jaxmuscle.objective._problem import Setup, target_variation
from jaxmuscle.response._equilibrium import slowest_rate
from jaxmuscle.response._linearised import settled
from jaxmuscle.spectra._measures import coefficient_of_variation

LEAD, FORGOTTEN = 5.0, 8.0
Made = dict[int, tuple[Target, float]]


def simulated_data(setup: Setup, task: AbstractTask, count: int) -> tuple[Made, dict[int, str]]:
    """Targets from the nonlinear simulator, with their mean output; and why others could not be made."""
    still = as_numbers(settled(as_arrays(task)))
    trials = list(setup.target.segments or ())
    chosen = setup.target.bins - setup.target.settings.first_bin
    made: Made = {}
    failed: dict[int, str] = {}
    runs = [_runs(still, setup, K, trial, np.arange(count), failed) for trial, K in enumerate(trials)]
    for number in range(count):
        if number in failed:
            continue
        rows = [each[number] for each in runs]
        # Trials count in proportion to their segments, as in the law of the bins.
        power = np.average([row[0] for row in rows], axis=0, weights=trials)[chosen]
        made[number] = _target(setup.target, number, power, [row[1] for row in rows]), float(np.mean([r[2] for r in rows]))
    return made, failed


def _runs(task: Any, setup: Setup, segments: int, trial: int, numbers: np.ndarray, failed: dict[int, str]) -> dict[int, Any]:
    """Welch power, coefficient of variation and mean of one trial of every replicate that stays finite."""
    settings = setup.target.settings
    rate = float(slowest_rate(as_arrays(task)))
    start = math.ceil(max(LEAD, FORGOTTEN / rate) * settings.rate) / settings.rate
    window = start, start + (settings.length + (segments - 1) * settings.step) / settings.rate
    key = jax.random.fold_in(jax.random.fold_in(setup.key, 31), trial)
    try:
        runs = ensemble(task, key, seeds=numbers, duration=window[1], control=False)
    except SimulationError as error:
        if len(numbers) == 1:
            failed[int(numbers[0])] = str(error)
            return {}
        halves = np.array_split(numbers, 2)
        return {n: x for half in halves for n, x in _runs(task, setup, segments, trial, half, failed).items()}
    power, held = np.asarray(runs.spectrum(settings, window).power), runs.filtered(settings, window)
    variation = np.asarray(coefficient_of_variation(held))
    return {int(n): (power[i], float(variation[i]), float(held[i].mean())) for i, n in enumerate(numbers)}


def _target(like: Target, number: int, power: np.ndarray, variation: list[float], sigma: Any = None) -> Target:
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
        settings=like.settings,
    )


def drawn_data(setup: Setup, task: AbstractTask, count: int) -> tuple[Made, dict[int, str]]:
    """Targets drawn from the Gaussian law about the fitted spectrum in linear response."""
    keys = jax.random.split(jax.random.fold_in(setup.key, 31), 3)
    moments = repeated(setup, task, count)
    power = drawn_spectra(Likelihood.of(setup), setup.target, moments, keys[0])
    scatter = [0.0 if given is None else float(given[1]) for given in setup.extra]
    variation = moments.variation * np.exp(scatter[0] * np.asarray(jax.random.normal(keys[1], (count,))))
    mean = moments.mean + scatter[1] * np.asarray(jax.random.normal(keys[2], (count,)))
    relative = np.asarray(setup.target.sigma) / setup.target.proportional_power
    made = {i: (_target(setup.target, i, p, [float(v)], relative * p), float(m))
            for i, (p, v, m) in enumerate(zip(power, variation, mean, strict=True))}  # fmt: skip
    return made, {}


def with_data(setup: Setup, target: Target, mean: float) -> Setup:
    """The setup with other data, of the same kinds."""
    variation, force = setup.extra
    extra = (None if variation is None else target_variation(target), None if force is None else (mean, force[1]))
    return dataclasses.replace(setup, target=target, extra=extra)
