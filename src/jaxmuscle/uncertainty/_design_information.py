"""What a design would tell of a fit's parameters: Fisher information."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._consequences import Expansion, expand
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._likelihood import Likelihood, without_offsets
from jaxmuscle.objective._problem import FitProblem, Part, target_variation
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._linearised import has_response

from ._designs import MOST_VARIATION, Design, open_masses, segments_of

VAGUE = 1e-6  # prior precision of what is separate
Theta = Float[np.ndarray, " free"]
Square = Float[np.ndarray, "free free"]


def without_scalars(problem: FitProblem) -> FitProblem:
    """The problem without coefficients of variation and means as data."""
    parts = tuple(dataclasses.replace(part, variation=None, mean=None) for part in problem.parts)
    return dataclasses.replace(problem, parts=parts)


def expansion_at(problem: FitProblem, theta: Theta) -> Expansion:
    """What the model gives at θ, and its slopes."""
    return expand(without_scalars(problem).linear(), theta[None]).row(0)


def information_of(problem: FitProblem, seen: Expansion) -> Square:
    """Fisher information of θ in a fit's data, at the θ where its model was seen."""
    return without_offsets(np.asarray(Likelihood.of(problem).information(seen)), len(seen.theta))


def with_open_masses(problem: FitProblem) -> FitProblem:
    """The problem with the `open_masses` free, too, after all else and with their usual prior: θ =
    0 are those of the tasks.

    The fit of a moved record finds m_z and lets m_w be free, and what else is known of the person
    helps with that.
    """
    masses, c = open_masses(problem), problem.coordinates
    if not masses:
        return problem
    first = {name: problem.parts[parts[0]].task[base_of(name)] for name, parts in masses.items()}
    parts = []
    for i, part in enumerate(problem.parts):
        own = {
            base_of(name): len(c.names) + place
            for place, (name, acting) in enumerate(masses.items())
            if i in acting
        }
        coordinates = _widened(part.coordinates, {name: part.task[name] for name in own})
        columns = (*part.columns, *own.values())
        parts.append(dataclasses.replace(part, coordinates=coordinates, columns=columns))
    more = len(masses)
    return dataclasses.replace(
        problem,
        parts=tuple(parts),
        coordinates=_widened(c, first),
        prior=np.append(problem.prior, np.ones(more)),
        damping=tuple(np.append(row, np.zeros(more)) for row in problem.damping),
    )


def _widened(c: Coordinates, values: Mapping[str, Any]) -> Coordinates:
    """These, and masses of these values with their usual prior."""
    rows, unbounded = [PARAMETERS[base_of(name)] for name in values], np.full(len(values), np.inf)
    return Coordinates(
        (*c.names, *values),
        np.append(c.centre, [*map(float, values.values())]),
        np.append(c.sd, [row.prior_sd for row in rows]),
        np.append(c.positive, np.array([row.positive for row in rows], bool)),
        np.append(c.low, -unbounded),
        np.append(c.high, unbounded),
    )


def design_information(problem: FitProblem, theta: Theta, design: Design) -> Square:
    """Fisher information about a fit's θ in a design; what is separate in it is eliminated, without
    a prior of its own.

    Raises `ValueError` for a task without linear response or whose insertion cannot be moved as the
    design says, unknown names in `separate`, and a coefficient of variation or mean of an output
    that is zero.
    """
    names = problem.coordinates.names
    for name in design.separate:
        if name not in names:
            raise ValueError(
                f"{design.name}: separate: {name!r} is not free in the fit; free are"
                f" {', '.join(names)}"
            )
    like = design.like(problem)
    given = like.task if design.task is None else design.task
    if design.lengthening is not None and not isinstance(given, PrescribedLength):
        raise ValueError(
            f"{design.name}: lengthening: in {type(given).__name__} no motor moves the insertion;"
            " give task=jaxmuscle.PrescribedLength(...)"
        )
    settings = like.target.settings if design.settings is None else design.settings
    task: Any = given.with_parts(settings=settings)
    has_response(task, required=True)
    own, coordinates = coordinates_of(like, theta, task)
    local = _local(like, coordinates, task, design)
    here = dataclasses.replace(
        problem,
        parts=(local,),
        coordinates=coordinates,
        prior=problem.prior[own],
        damping=tuple(row[own] for row in problem.damping),
    )
    seen = expansion_at(here, theta[own])
    with_data = _with_data(local, design, seen.moments[0])
    likelihood = Likelihood.of(dataclasses.replace(here, parts=(with_data,)))
    (bins,) = likelihood.bins
    assert bins is not None
    if not design.spectral:
        bins = bins._replace(mask=np.zeros(len(bins.mask)))
    found = without_offsets(np.asarray(likelihood.information(seen, (bins,))), len(own))
    if design.lengthening is not None:
        found = found + design.lengthening.information(task, coordinates, theta[own])
    whole = np.zeros((len(names), len(names)))
    whole[np.ix_(own, own)] = found
    loose = np.array([name in design.separate for name in names])
    if np.any(loose):
        inside = whole[np.ix_(loose, loose)] + VAGUE * np.eye(np.sum(loose))
        tied = whole[np.ix_(~loose, loose)]
        whole[np.ix_(~loose, ~loose)] -= tied @ np.linalg.pinv(inside, hermitian=True) @ tied.T
        whole[loose] = whole[:, loose] = 0.0
    return whole


def coordinates_of(like: Part, theta: np.ndarray, task: Any) -> tuple[np.ndarray, Coordinates]:
    """Which of the fit's coordinates the task has, and these: the same θ stands for the task's own
    values."""
    c = like.coordinates
    values = [float(task[n]) if n in task.parameter_names else np.nan for n in c.names]
    has = np.array(values) > np.where(c.positive, 0.0, -np.inf)
    sd, positive, values = c.sd[has], c.positive[has], np.array(values)[has]
    own = np.array(like.columns, dtype=int)[has]
    step, unbounded = sd * theta[own], np.full(len(own), np.inf)
    centre = np.where(positive, values * np.exp(-step), values - step)
    names = tuple(n for n, there in zip(c.names, has, strict=True) if there)
    return own, Coordinates(names, centre, sd, positive, -unbounded, unbounded)


def _local(like: Part, coordinates: Coordinates, task: Any, design: Design) -> Part:
    """The design's target with its task, without data."""
    present, settings = like.target, task.settings
    bins = (
        present.bins
        if settings == present.settings
        else np.arange(settings.first_bin, settings.last_bin + 1)
    )
    counts = design.counts if design.counts and design.spectral else segments_of(present)
    target = Target(
        design.name,
        np.ones(len(bins)),
        bins=bins,
        quantity=task.quantity,
        segments=counts,
        settings=settings,
    )
    return Part("", task, target, coordinates, tuple(range(len(coordinates.names))), None, None)


def _with_data(part: Part, design: Design, moments: Moments) -> Part:
    """The part with the data that the design is expected to give."""
    mean, sd = float(moments.mean), float(np.sqrt(moments.variance))
    relative = design.coefficient_of_variation or design.mean is not None
    if relative and not sd < MOST_VARIATION * abs(mean):
        raise ValueError(
            f"{design.name}: the mean of its output is zero, so neither it nor a coefficient of"
            " variation can be stated relatively: leave both out"
        )
    variation = sd / abs(mean) if design.coefficient_of_variation else None
    old = part.target
    target = Target(
        design.name,
        moments.proportional,
        bins=old.bins,
        quantity=old.quantity,
        segments=old.segments,
        coefficient_of_variation=variation,
        settings=old.settings,
    )
    stated = None if design.mean is None else (mean, design.mean * abs(mean))
    return dataclasses.replace(
        part, target=target, variation=target_variation(target, part.task), mean=stated
    )
