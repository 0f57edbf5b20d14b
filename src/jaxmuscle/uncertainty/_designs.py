"""Measurements that could be made in addition to a fit's, and what they would tell of its parameters."""

import dataclasses
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxmuscle._common.text import choices
from jaxmuscle.data._target import Target
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedForce, PrescribedLength
from jaxmuscle.objective._arguments import INPUTS, MASSES
from jaxmuscle.objective._consequences import Expansion, expand
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._likelihood import Likelihood, require_spread, without_offsets
from jaxmuscle.objective._problem import FitProblem, Part, target_variation
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._linearised import has_response
from jaxmuscle.response._scaling import FORCES
from jaxmuscle.spectra._settings import SpectrumSettings

from ._lengthening import Lengthening

AMPLITUDES = ("noise_K_w", "noise_K_z", "noise_C_w", "noise_C_z", "harmonic_amplitude")
MEAN_ERROR = 0.02
LEVELS = (2.0, 0.5)
LONGER = 10
MOVED = ((1e-4, (0.5, 10.0)), (1e-3, (0.5, 5.0)))  # rms [m] and band [Hz] of standard perturbations; slower, force drifts
MOST_VARIATION = 1e3
VAGUE = 1e-6  # prior precision of what is separate
HELD: dict[type[AbstractTask], str] = {
    Isometric: "insertion held, force measured",
    PrescribedForce: "insertion free under a constant force, displacement measured",
    PrescribedLength: "insertion moved by a motor, force measured",
}


class Design(eqx.Module):
    """A measurement that could be added to a fit's data.

    It measures the person that was fitted: parameters of one name are shared. One whose value differs in the design's task
    differs by a factor that is taken as known (for one of either sign: by a difference).

    **Arguments:**

    - `name`: a noun phrase, "a second force level 2 times as high": reports make sentences of it.
    - `task`: what is measured, at the values expected; the fitted task itself by default.
    - `segments`: Welch segments of its spectrum, of one trial or of several; as many as the target's by default; 0 for
      no new recording, only the numbers that follow.
    - `settings`: how its spectrum is estimated; as the target's by default.
    - `coefficient_of_variation`: whether that of its output is measured.
    - `mean`: relative standard error with which the mean output is measured, 0.02 say; None if it is not.
    - `separate`: names of free parameters that have another value in this measurement, of which nothing is known before.
    - `target`: of a fit with several targets, the one whose task, segments and settings it takes over; the first by default.
    - `lengthening`: how a motor moves the insertion meanwhile, a `Lengthening`. The response of the force is then measured
      beside the spectrum of its fluctuations. The task must be `PrescribedLength` or `Isometric`.

    **Raises:** `ValueError` for a measurement of nothing, segments below 0, a `mean` that is not positive.
    """

    name: str = eqx.field(static=True)
    task: AbstractTask | None = None
    segments: int | tuple[int, ...] | None = eqx.field(static=True, default=None)
    settings: SpectrumSettings | None = eqx.field(static=True, default=None, kw_only=True)
    coefficient_of_variation: bool = eqx.field(static=True, default=False, kw_only=True)
    mean: float | None = eqx.field(static=True, default=None, kw_only=True)
    separate: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    target: str | None = eqx.field(static=True, default=None, kw_only=True)
    lengthening: Lengthening | None = eqx.field(default=None, kw_only=True)

    def __check_init__(self):
        if any(k < 0 for k in self.counts):
            raise ValueError(f"{self.name}: segments = {self.segments} must not be negative; 0 for no new spectrum")
        if self.mean is not None and not self.mean > 0:
            raise ValueError(f"{self.name}: mean = {self.mean} must be a positive relative standard error, 0.02 say")
        nothing = not self.spectral and not self.coefficient_of_variation and self.mean is None
        if nothing and self.lengthening is None:
            raise ValueError(f"{self.name}: measures nothing: give segments, coefficient_of_variation=True or mean=0.02")

    @property
    def counts(self) -> tuple[int, ...]:
        """Segments of every trial; none if they are the target's."""
        return () if self.segments is None else tuple(int(k) for k in np.atleast_1d(self.segments))

    @property
    def spectral(self) -> bool:
        """Whether it gives a spectrum."""
        return self.segments is None or sum(self.counts) > 0

    def told(self, problem: FitProblem) -> tuple[str, str]:
        """Task and data in words."""
        data, like = [], self.like(problem)
        if self.spectral:
            settings = like.target.settings if self.settings is None else self.settings
            data.append(_spectrum_in_words(self.counts or segments_of(like.target), settings))
        data += ["coefficient of variation"] if self.coefficient_of_variation else []
        data += [] if self.mean is None else [f"mean to {100 * self.mean:.2g} %"]
        if self.lengthening is not None:
            task = like.task if self.task is None else self.task
            masses = " and ".join(_open_masses(like, task))
            data.append(f"response to a {self.lengthening}" + f" ({masses} fitted with it)" * bool(masses))
        kind = None if self.lengthening is None else PrescribedLength
        return _task_in_words(like.task if self.task is None else self.task, kind), ", ".join(data)

    def like(self, problem: FitProblem) -> Part:
        """The part of a fit that it resembles. Raises `ValueError` for an unknown target."""
        names = [part.name for part in problem.parts]
        if self.target is not None and self.target not in names:
            raise ValueError(f"{self.name}: target: the fit has none called {self.target!r}: {choices(self.target, names)}")
        return problem.parts[0 if self.target is None else names.index(self.target)]


def told_data(problem: FitProblem) -> tuple[str, str]:
    """Tasks and data of a fit in words."""
    tasks, told = [], []
    for part in problem.parts:
        segments = part.target.segments
        data = [f"{len(part.target.bins)} bins with a stated sigma" if segments is None else
                _spectrum_in_words(segments, part.target.settings)]  # fmt: skip
        data *= len(part.target.bins) > 0
        data += ["coefficient of variation"] * (part.variation is not None) + ["mean"] * (part.mean is not None)
        if part.points is not None:
            data.append(f"dynamic stiffness at {len(part.points)} frequencies")
        whose = f"{part.name}: " if len(problem.parts) > 1 else ""
        tasks.append(whose + _task_in_words(part.task))
        told.append(whose + ", ".join(data))
    return "; ".join(tasks), "; ".join(told)


def _task_in_words(task: AbstractTask, kind: type[AbstractTask] | None = None) -> str:
    inputs = [f"{n} = {float(task[n]):.3g} {'m' if n == 'x_z' else 'N'}" for n in INPUTS
              if n in task.parameter_names and float(task[n]) != 0]  # fmt: skip
    kind = kind or type(task)
    return ", ".join([kind.__name__ + (f" ({HELD[kind]})" if kind in HELD else ""), *inputs])


def _spectrum_in_words(counts: tuple[int, ...], settings: SpectrumSettings) -> str:
    seconds = sum(settings.length + (count - 1) * settings.step for count in counts if count) / settings.rate
    alike = f"{len(counts)} x {max(counts)}"
    listed = " + ".join(map(str, counts))
    return f"spectrum of {alike if len(counts) > 2 and min(counts) == max(counts) else listed} segments ({seconds:.3g} s)"


def segments_of(target: Target) -> tuple[int, ...]:
    """A target's segments; where it states only a sigma, as many as scatter like its median bin."""
    if target.segments is not None:
        return target.segments
    require_spread(target)
    relative = float(np.median(target.sigma / target.proportional_power))
    one = target.settings.degrees_of_freedom(1000) / 1000
    return (max(1, round(2 / relative**2 / one)),)


def designs_for(problem: FitProblem, seen: Expansion) -> tuple[Design, ...]:
    """What else could be measured of the person whose fit this is, its tasks being the fitted ones.

    At another force level the amplitudes of noise and harmonic have values of their own (people's variation is not
    proportional to force), all else of the muscle is as before: twice the highest and half the lowest of the fit's. The
    displacement is that under the load which the sensor had held, so that the operating point stays, and the perturbations
    with it.
    """
    if without_noise(problem):
        return ()
    levels = [_level_of(part.task) for part in problem.parts]
    factors = [
        tuple(f for f, extreme in zip(LEVELS, (max, min), strict=True) if level == extreme(levels)) for level in levels
    ]
    designs = []
    for part, moments, own in zip(problem.parts, seen.moments, factors, strict=True):
        made = _designs_for(part, moments, own, _amplitudes(problem, part))
        if len(problem.parts) > 1:
            made = [dataclasses.replace(d, name=f"{d.name} ({part.name})", target=part.name) for d in made]
        designs += made
    return tuple(designs)


def without_noise(problem: FitProblem) -> bool:
    """Whether a target has no spectrum, so that nothing is known of the noise that would limit a further measurement."""
    return any(len(part.target.bins) == 0 for part in problem.parts)


def _level_of(task: AbstractTask) -> float:
    """The first force that moves a task, 0 without one."""
    return next((abs(float(task[n])) for n in FORCES if n in task.parameter_names and float(task[n]) != 0), 0.0)


def _amplitudes(problem: FitProblem, part: Part) -> tuple[str, ...]:
    """Free amplitudes of a part's noise and harmonic, by their names in the fit."""
    own = dict(zip(part.coordinates.names, part.columns, strict=True))
    return tuple(problem.coordinates.names[own[name]] for name in AMPLITUDES if name in own)


def _designs_for(part: Part, moments: Moments, factors: tuple[float, ...], separate: tuple[str, ...]) -> list[Design]:
    """Of one target: what it does not state, the other output, a moved insertion, other force levels, a longer recording."""
    task, mean = part.task, float(moments.mean)
    steady = float(np.sqrt(moments.variance)) < MOST_VARIATION * abs(mean)
    varying = part.variation is not None
    still = "" if part.points is None else ", without motion"
    designs = []
    if not varying and steady:
        designs.append(Design("the coefficient of variation", segments=0, coefficient_of_variation=True))
    if part.mean is None and steady:
        designs.append(Design(f"the mean {task.quantity}, known to {100 * MEAN_ERROR:g} %", segments=0, mean=MEAN_ERROR))
    if isinstance(task, Isometric):
        held = task.as_task(PrescribedForce, P_w=task.P_w, F_ext=mean)
        designs.append(Design(f"the displacement under a load of {mean:.3g} N", held))
    if isinstance(task, PrescribedLength):
        designs += [moved_insertion(Lengthening.flat(*given), part.target.settings, coefficient_of_variation=steady)
                    for given in MOVED]  # fmt: skip
    if isinstance(task, PrescribedForce):
        fixed = task.as_task(Isometric, P_w=task.P_w)
        designs.append(Design("the force with the insertion held", fixed, coefficient_of_variation=True))
    forces = {n: float(task[n]) for n in FORCES if n in task.parameter_names and float(task[n]) != 0}
    if forces:
        for factor in (f for f in factors if f * (part.target.mvc_fraction or 0.0) <= 1.0):
            name = f"a second force level {factor:g} times as high{still}"
            moved = task.replace(**{n: factor * v for n, v in forces.items()})
            designs.append(Design(name, moved, coefficient_of_variation=varying, separate=separate))
    more = tuple((LONGER - 1) * k for k in segments_of(part.target))
    designs.append(Design(f"a recording {LONGER} times as long{still}", segments=more, coefficient_of_variation=varying))
    return designs


def moved_insertion(
    lengthening: Lengthening, settings: SpectrumSettings, *, coefficient_of_variation: bool, target: str | None = None
) -> Design:
    """A recording with the insertion moved: its response, and the spectrum of the fluctuations beside it."""
    top = lengthening.frequency[-1]
    name = f"{lengthening.seconds:g} s with the insertion moved by {1e3 * lengthening.rms:.3g} mm rms to {top:.3g} Hz"
    segments = settings.segments(round(lengthening.seconds * settings.rate))
    return Design(name, segments=segments, coefficient_of_variation=coefficient_of_variation and segments > 0,
                  lengthening=lengthening, target=target)  # fmt: skip


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
    c, rows = coordinates, [PARAMETERS[name] for name in _open_masses(like, task)]
    more, unbounded = tuple(row.name for row in rows), np.full(len(rows), np.inf)
    values, sd, positive = ([float(task[row.name]) for row in rows], [row.prior_sd for row in rows],
                            np.array([row.positive for row in rows], bool))  # fmt: skip
    return Coordinates((*c.names, *more), np.append(c.centre, values), np.append(c.sd, sd), np.append(c.positive, positive),
                       np.append(c.low, -unbounded), np.append(c.high, unbounded))  # fmt: skip


def _open_masses(like: Part, task: Any) -> tuple[str, ...]:
    if like.target.stiffness is not None:
        return ()
    return tuple(name for name in MASSES if name in task.parameter_names and name not in like.coordinates.names)


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
