"""What the page knows of the package, so that JavaScript repeats none of it: parameters, ranges,
tasks, noises, settings."""

import math
from typing import Any, get_args

import numpy as np

from jaxmuscle.model._noise import AbstractNoise
from jaxmuscle.model._noises import NOISES
from jaxmuscle.model._parameters import PARAMETERS, REFLEX, USUALLY_FREE, Parameter
from jaxmuscle.model._resonant_noise import ResonantNoise
from jaxmuscle.model._rungs import on_rung
from jaxmuscle.model._task_tables import task_to_table
from jaxmuscle.model._tasks import TASKS, AbstractTask, Isometric, Observed, PrescribedForce
from jaxmuscle.spectra._settings import NAMED, SpectrumSettings

REACH = 3.0  # prior standard deviations to either side of the default


def facts() -> dict[str, Any]:
    """All of it, as JSON holds it."""
    tasks = {name: kind() for name, kind in TASKS.items()}
    made: dict[str, Any] = dict(NOISES)
    kinds = {name: kind().per_channel() for name, kind in made.items()}
    needed = {
        name: list(task.smoothness_needed)
        for name, task in tasks.items()
        if name != "prescribed-force"
    }
    needed |= {
        f"prescribed-force {seen}": list(PrescribedForce(observe=seen).smoothness_needed)
        for seen in get_args(Observed)
    }
    richest = on_rung(Isometric(), 3)
    return {
        # the page shows spectra of a held muscle, on which a reflex does nothing
        "parameters": {n: parameter(row) for n, row in PARAMETERS.items() if n not in REFLEX},
        "usually_free": list(USUALLY_FREE),
        "tasks": {name: bare_table(task) for name, task in tasks.items()},
        "noises": {name: noise_table(noise) for name, noise in kinds.items()},
        "resonances": [
            noise_table(part)
            for part in richest.noise.components
            if isinstance(part, ResonantNoise)
        ],
        "settings": {name: SpectrumSettings.named(name).to_dict() for name in NAMED},
        "smoothness": {
            type(noise).__name__: noise.smoothness for noise in (*kinds.values(), ResonantNoise())
        },
        "smoothness_needed": needed,
        "observed": list(get_args(Observed)),
    }


def bare_table(task: AbstractTask) -> dict[str, Any]:
    """A task as a preset holds it, without the parts that it does not have (`"none"`)."""
    return {key: value for key, value in task_to_table(task).items() if value != "none"}


def noise_table(noise: AbstractNoise) -> dict[str, Any]:
    """One noise as a preset holds it."""
    return task_to_table(PrescribedForce(noise=noise))["noise"]


def parameter(row: Parameter) -> dict[str, Any]:
    """A row of the table, with the range of its slider: three standard deviations of its prior, as
    far as a fit may go."""
    low, high = span(row)
    found = {
        key: getattr(row, key)
        for key in ("unit", "default", "meaning", "positive", "prior_sd", "lower", "upper")
    }
    bounds = {key: found[key] if math.isfinite(found[key]) else None for key in ("lower", "upper")}
    off = row.lower == 0 and row.fit_lower == 0 and row.unit == "1"
    return found | bounds | {"low": low, "high": high, "off": off}


def span(row: Parameter) -> tuple[float, float]:
    """From where to where its slider goes."""
    far = REACH * row.prior_sd
    ends = (
        row.default * np.exp([-far, far]) if row.positive else row.default + np.array([-far, far])
    )
    return max(float(ends[0]), row.fit_lower), min(float(ends[1]), row.fit_upper)
