"""What a design would tell of a fit's parameters: Fisher information."""

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.objective._consequences import Expansion, expand
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._likelihood import Likelihood, without_offsets
from jaxmuscle.objective._problem import FitProblem, Part, target_variation
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._linearised import has_response

from ._designs import MOST_VARIATION, Design, open_masses, segments_of

VAGUE = 1e-6  # prior precision of what is separate


def without_further(problem: FitProblem) -> FitProblem:
    """The problem without coefficients of variation and means as data."""
    parts = tuple(dataclasses.replace(part, variation=None, mean=None) for part in problem.parts)
    return dataclasses.replace(problem, parts=parts)


def seen_here(problem: FitProblem, theta: Float[np.ndarray, " free"]) -> Expansion:
    """What the model gives at θ, and its slopes."""
    return expand(without_further(problem).linear(), theta[None]).row(0)


def information_of(problem: FitProblem, seen: Expansion) -> Float[np.ndarray, "free free"]:
    """Fisher information of θ in a fit's data, at the θ where its model was seen."""
    return without_offsets(np.asarray(Likelihood.of(problem).information(seen)), len(seen.theta))


def design_information(
    problem: FitProblem, theta: Float[np.ndarray, " free"], design: Design
) -> Float[np.ndarray, "free free"]:
    """Fisher information about a fit's θ in a design; what is separate in it is eliminated, without a prior of its own.

    So are the masses where the insertion is moved and the fit says nothing of them, with their prior (`with_masses`).

    Raises `ValueError` for a task without linear response or whose insertion cannot be moved as the design says, unknown
    names in `separate`, and a coefficient of variation or mean of an output that is zero.
    """
    names = problem.coordinates.names
    for name in design.separate:
        if name not in names:
            raise ValueError(f"{design.name}: separate: {name!r} is not free in the fit; free are {', '.join(names)}")
    own, _, found = information_with_masses(problem, theta, design, masses=design.lengthening is not None)
    own, more = own[own < len(names)], int(np.sum(own >= len(names)))
    kept = np.append([names[i] not in design.separate for i in own], np.zeros(more, bool))
    whole = np.zeros((len(names), len(names)))
    if not np.all(kept):
        prior = np.append(np.full(len(own), VAGUE), np.ones(more))[~kept]
        loose, tied = found[np.ix_(~kept, ~kept)] + np.diag(prior), found[np.ix_(kept, ~kept)]
        found = found[np.ix_(kept, kept)] - tied @ np.linalg.pinv(loose, hermitian=True) @ tied.T
    shared = own[kept[: len(own)]]
    whole[np.ix_(shared, shared)] = found
    return whole


def information_with_masses(
    problem: FitProblem, theta: Float[np.ndarray, " free"], design: Design, *, masses: bool
) -> tuple[Int[np.ndarray, " own"], Coordinates, Float[np.ndarray, "own own"]]:
    """Fisher information in a design of what its task has of the fit's θ, and, where asked for, of `masses` beside them.

    **Returns:** the places of these coordinates in θ, those of masses after its end; the coordinates; the information.
    """
    like = design.like(problem)
    given = like.task if design.task is None else design.task
    if design.lengthening is not None and not isinstance(given, PrescribedLength):
        raise ValueError(f"{design.name}: lengthening: in {type(given).__name__} no motor moves the insertion; give "
                         "task=jaxmuscle.PrescribedLength(...)")  # fmt: skip
    settings = like.target.settings if design.settings is None else design.settings
    task: Any = given.with_parts(settings=settings)
    has_response(task, required=True)
    own, coordinates = coordinates_of(like, theta, task)
    wide = with_masses(like, coordinates, task) if masses else coordinates
    more = len(wide.names) - len(own)
    place, prior = np.append(theta[own], np.zeros(more)), np.append(problem.prior[own], np.ones(more))
    local = _local(like, wide, task, design)
    here = dataclasses.replace(problem, parts=(local,), coordinates=wide, prior=prior)
    seen = seen_here(here, place)
    (moments,) = seen.moments
    found = _information(dataclasses.replace(here, parts=(_with_data(local, design, moments),)), design, seen)
    if design.lengthening is not None:
        found = found + design.lengthening.information(task, wide, place)
    return np.append(own, len(theta) + np.arange(more)), wide, found


def coordinates_of(like: Part, theta: np.ndarray, task: Any) -> tuple[np.ndarray, Coordinates]:
    """Which of the fit's coordinates the task has, and these: the same θ stands for the task's own values."""
    c = like.coordinates
    has = [i for i, n in enumerate(c.names) if n in task.parameter_names and (float(task[n]) > 0 or not c.positive[i])]
    own, sd, positive = np.array(like.columns, dtype=int)[has], c.sd[has], c.positive[has]
    values, step = np.array([float(task[c.names[i]]) for i in has]), sd * theta[own]
    centre = np.where(positive, values * np.exp(-step), values - step)
    unbounded = np.full(len(own), np.inf)
    return own, Coordinates(tuple(c.names[i] for i in has), centre, sd, positive, -unbounded, unbounded)


def with_masses(like: Part, coordinates: Coordinates, task: Any) -> Coordinates:
    """These, and the masses with their usual prior: the fit of a moved record finds m_z, too, and lets m_w be free.

    Without those of which the fit says what it knows: it has them free, or was one of a moved record and has them fixed.
    """
    c, rows = coordinates, [PARAMETERS[name] for name in open_masses(like, task)]
    more, unbounded = tuple(row.name for row in rows), np.full(len(rows), np.inf)
    values, sd, positive = ([float(task[row.name]) for row in rows], [row.prior_sd for row in rows],
                            np.array([row.positive for row in rows], bool))  # fmt: skip
    return Coordinates((*c.names, *more), np.append(c.centre, values), np.append(c.sd, sd), np.append(c.positive, positive),
                       np.append(c.low, -unbounded), np.append(c.high, unbounded))  # fmt: skip


def _local(like: Part, coordinates: Coordinates, task: Any, design: Design) -> Part:
    """The design's target with its task, without data."""
    present, settings = like.target, task.settings
    bins = present.bins if settings == present.settings else np.arange(settings.first_bin, settings.last_bin + 1)
    counts = design.counts if design.counts and design.spectral else segments_of(present)
    target = Target(design.name, np.ones(len(bins)), bins=bins, quantity=task.quantity, segments=counts, settings=settings)
    return Part("", task, target, coordinates, tuple(range(len(coordinates.names))), None, None)


def _with_data(part: Part, design: Design, moments: Moments) -> Part:
    """The part with the data that the design is expected to give."""
    mean, sd = float(moments.mean), float(np.sqrt(moments.variance))
    if (design.coefficient_of_variation or design.mean is not None) and not sd < MOST_VARIATION * abs(mean):
        raise ValueError(f"{design.name}: the mean of its output is zero, so neither it nor a coefficient of variation "
                         "can be stated relatively: leave both out")  # fmt: skip
    old = part.target
    target = Target(
        design.name, moments.proportional, bins=old.bins, quantity=old.quantity, segments=old.segments,
        coefficient_of_variation=sd / abs(mean) if design.coefficient_of_variation else None, settings=old.settings,
    )  # fmt: skip
    stated = None if design.mean is None else (mean, design.mean * abs(mean))
    return dataclasses.replace(part, target=target, variation=target_variation(target, part.task), mean=stated)


def _information(problem: FitProblem, design: Design, seen: Expansion) -> Float[np.ndarray, "own own"]:
    likelihood = Likelihood.of(problem)
    (bins,) = likelihood.bins
    assert bins is not None
    if not design.spectral:
        bins = bins._replace(mask=np.zeros(len(bins.mask)))
    return without_offsets(np.asarray(likelihood.information(seen, (bins,))), len(seen.theta))
