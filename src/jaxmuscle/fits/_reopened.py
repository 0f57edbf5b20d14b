"""A fit taken up again: from its result back to the problem. Likelihoods, profiles, posteriors
and checks of a fit begin with it.
"""

import dataclasses
from collections.abc import Iterable, Mapping
from typing import TypedDict

import numpy as np

from jaxmuscle._common.types import Key
from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import PARAMETERS, proper_names, proper_values
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import DAMPING, base_of, planned, target_of
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.response._linearised import has_response
from jaxmuscle.response._second_order import warn_beyond

from ._joint import planned_jointly
from ._result import FitResult


class ReopenOptions(TypedDict, total=False):
    """What `profile` and `posterior` take instead of the fit's own."""

    free: Iterable[str] | None
    bounds: Mapping[str, tuple[float, float]] | None
    priors: Mapping[str, float | tuple[float, float | None] | None] | None


def bounds_of(
    result: FitResult, names: Iterable[str], bounds: Mapping[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """The bounds that hold for the free parameters `names`: those of the fit, before them the given
    ones."""
    return {
        n: _open(*b) for n, b in result.settings["bounds"].items() if n in names
    } | proper_values(bounds)


def reopened(
    result: FitResult,
    target: Target | None = None,
    *,
    free: Iterable[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, float | tuple[float, float | None] | None] | None = None,
    key: Key = 0,
) -> FitProblem:
    """The problem of the fit that gave the result, in linear response; needs double precision.

    `priors` {name: sd, or (centre, sd)} and `bounds` go before those of the fit; another `target`
    only if that has one. Raises `ValueError` for a fit that failed and for a task without linear
    response.
    """
    if not all(np.all(np.isfinite(part.fitted)) for part in result.parts.values()):
        raise ValueError(f"the fit of {result.title} failed ({result.message}): fit again first")
    if target is not None and len(result.parts) > 1:
        raise ValueError(
            f"target: this fit has several ({', '.join(result.parts)}), so none of them can be"
            " exchanged"
        )
    settings = result.settings
    names = proper_names(settings["free"] if free is None else free) or ()
    priors = proper_values(priors)
    fitted = settings["prior_centre"]
    centres = {n: fitted[n] if n in fitted else _default(result, n) for n in names}
    sds = {
        n: (
            settings["prior_sd"].get(
                n, PARAMETERS[base_of(n)].prior_sd if base_of(n) in PARAMETERS else 1.0
            )
        )
        for n in names
    }
    sds[DAMPING] = settings.get("damping_ratio_sd")
    for name, given in priors.items():
        if name == DAMPING:
            sds[name] = given
            continue
        if name not in names:
            raise ValueError(f"priors: {name} is not free; free are {', '.join(names)}")
        centres[name], sds[name] = given if isinstance(given, tuple) else (centres[name], given)
    limits = bounds_of(result, names, bounds)
    for name, (low, high) in limits.items():
        if name in centres and not low < centres[name] < high:
            raise ValueError(
                f"the prior of {name} is centred at {centres[name]:g}, outside its bounds ({low:g},"
                f" {high:g}): give priors={{name: (centre, sd)}} inside them, or wider bounds"
            )
    options = FitOptions(
        free=names,
        key=key,
        bounds=limits,
        priors=sds,
        dt=settings["dt"],
    )
    problem = _problem(result, target, options, centres)
    return problem.scattering_as(
        [
            task.with_parts(settings=part.target.settings)
            for task, part in zip(result.tasks.values(), problem.parts, strict=True)
        ]
    )


def _open(low: float | None, high: float | None) -> tuple[float, float]:
    """Bounds as a result keeps them: None where there is none."""
    return (-np.inf if low is None else low, np.inf if high is None else high)


def _problem(
    result: FitResult, target: Target | None, options: FitOptions, centres: dict[str, float]
) -> FitProblem:
    """The problem with prior centres as they were: every task has its own values there."""
    for task in result.tasks.values():
        has_response(task, required=True)
        warn_beyond(task)
    varied, means = result.settings["coefficient_of_variation"], result.settings["mean_force"]
    if len(result.parts) == 1:
        given = dataclasses.replace(
            options,
            coefficient_of_variation=varied,
            mean_force=None if means is None else tuple(means),
        )
        return planned(
            result.task.replace(**centres), result.target if target is None else target, given
        ).problem
    tasks = {name: _centred(result, name, task, centres) for name, task in result.tasks.items()}
    known = {name: tuple(mean) for name, mean in means.items() if mean is not None}
    given = dataclasses.replace(options, coefficient_of_variation=any(varied.values()))
    return planned_jointly(
        tasks,
        result.targets,
        given,
        result.settings["separate"],
        result.settings["proportional"],
        known,
    ).problem


def _centred(
    result: FitResult, target: str, task: AbstractTask, centres: dict[str, float]
) -> AbstractTask:
    """One target's task at the prior's centre; where a parameter is proportional, its own share of
    the common factor."""
    values = {}
    for name, centre in centres.items():
        base, own = base_of(name), target_of(name)
        if base in task.parameter_names and own in ("", target):
            here, first = float(task[base]), float(_holder(result, name)[base])
            log = base not in PARAMETERS or PARAMETERS[base].positive
            values[base] = (
                centre if here == first else centre * here / first if log else centre + here - first
            )
    return task.replace(**values)


def _holder(result: FitResult, name: str) -> AbstractTask:
    """The first task that has a parameter, or the one that it is named with."""
    if target_of(name):
        return result.tasks[target_of(name)]
    return next(task for task in result.tasks.values() if base_of(name) in task.parameter_names)


def _default(result: FitResult, name: str) -> float:
    base = base_of(name)
    return PARAMETERS[base].default if base in PARAMETERS else float(_holder(result, name)[base])
