"""Measurements that could be made in addition to a fit's, and what they would tell of its
parameters."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxmuscle._common.text import choices
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedForce, PrescribedLength
from jaxmuscle.objective._arguments import INPUTS, MASSES, base_of
from jaxmuscle.objective._consequences import Expansion
from jaxmuscle.objective._likelihood import require_spread
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._scaling import FORCES
from jaxmuscle.spectra._settings import SpectrumSettings

from ._identifiability_report import FITTED_TOO
from ._lengthening import Lengthening

AMPLITUDES = ("noise_K_w", "noise_K_z", "noise_C_w", "noise_C_z", "harmonic_amplitude")
MEAN_ERROR = 0.02
LEVELS = (2.0, 0.5)
LONGER = 10
# rms [m] and band [Hz] of standard perturbations; slower, force drifts
MOVED = ((1e-4, (0.5, 10.0)), (1e-3, (0.5, 5.0)))
MOST_VARIATION = 1e3
HELD: dict[type[AbstractTask], str] = {
    Isometric: "insertion held, force measured",
    PrescribedForce: "insertion free under a constant force, displacement measured",
    PrescribedLength: "insertion moved by a motor, force measured",
}


class Design(eqx.Module):
    """A measurement that could be added to a fit's data.

    It measures the person that was fitted: parameters of one name are shared. One whose value
    differs in the design's task differs by a factor that is taken as known (for one of either sign:
    by a difference).

    **Arguments:**

    - `name`: a noun phrase, "a second force level 2 times as high": reports make sentences of it.
    - `task`: what is measured, at the values expected; the fitted task itself by default.
    - `segments`: Welch segments of its spectrum, of one trial or of several; as many as the
      target's by default; 0 for no new spectrum: only what `coefficient_of_variation`, `mean` and
      `lengthening` say is measured.
    - `settings`: how its spectrum is estimated; as the target's by default.
    - `coefficient_of_variation`: whether that of its output is measured.
    - `mean`: relative standard error with which the mean output is measured, 0.02 say; None if it
      is not.
    - `separate`: names of free parameters that have another value in this measurement, of which
      nothing is known before.
    - `target`: of a fit with several targets, the one whose task, segments and settings it takes
      over; the first by default.
    - `lengthening`: how a motor moves the insertion meanwhile, a `Lengthening`. The response of the
      force is then measured beside the spectrum of its fluctuations. The task must be
      `PrescribedLength` or `Isometric`.

    **Raises:** `ValueError` for a measurement of nothing, segments below 0, a `mean` that is not
    positive.
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
            raise ValueError(
                f"{self.name}: segments = {self.segments} must not be negative; 0 for no new"
                " spectrum"
            )
        if self.mean is not None and not self.mean > 0:
            raise ValueError(
                f"{self.name}: mean = {self.mean} must be a positive relative standard error,"
                " 0.02 say"
            )
        nothing = not self.spectral and not self.coefficient_of_variation and self.mean is None
        if nothing and self.lengthening is None:
            raise ValueError(
                f"{self.name}: measures nothing: give segments, coefficient_of_variation=True or"
                " mean=0.02"
            )

    @property
    def counts(self) -> tuple[int, ...]:
        """Segments of every trial; none if they are the target's."""
        return () if self.segments is None else tuple(int(k) for k in np.atleast_1d(self.segments))

    @property
    def spectral(self) -> bool:
        """Whether it gives a spectrum."""
        return self.segments is None or sum(self.counts) > 0

    def told(self, problem: FitProblem) -> tuple[str, str]:
        """For the package itself:

        task and data in words. What the design leaves open is taken from the `problem` of a fit.
        """
        data, like = [], self.like(problem)
        if self.spectral:
            settings = like.target.settings if self.settings is None else self.settings
            data.append(_spectrum_in_words(self.counts or segments_of(like.target), settings))
        data += ["coefficient of variation"] if self.coefficient_of_variation else []
        data += [] if self.mean is None else [f"mean to {100 * self.mean:.2g} %"]
        if self.lengthening is not None:
            task = like.task if self.task is None else self.task
            own = next(i for i, part in enumerate(problem.parts) if part is like)
            open_here = [
                base_of(name) for name, parts in open_masses(problem).items() if own in parts
            ]
            masses = " and ".join(name for name in open_here if name in task.parameter_names)
            data.append(
                f"response to a {self.lengthening}" + f" ({masses} {FITTED_TOO})" * bool(masses)
            )
        kind = None if self.lengthening is None else PrescribedLength
        return _task_in_words(like.task if self.task is None else self.task, kind), ", ".join(data)

    def like(self, problem: FitProblem) -> Part:
        """For the package itself: the part of a fit's problem that belongs to `target` (by default
        the first), whose task, segments and settings the design takes over.

        **Raises:** `ValueError` for an unknown target.
        """
        names = [part.name for part in problem.parts]
        if self.target is not None and self.target not in names:
            raise ValueError(
                f"{self.name}: target: the fit has none called {self.target!r}:"
                f" {choices(self.target, names)}"
            )
        return problem.parts[0 if self.target is None else names.index(self.target)]


def told_data(problem: FitProblem) -> tuple[str, str]:
    """Tasks and data of a fit in words."""
    tasks, told = [], []
    for part in problem.parts:
        segments = part.target.segments
        data = [
            (
                f"{len(part.target.bins)} bins with a stated sigma"
                if segments is None
                else _spectrum_in_words(segments, part.target.settings)
            )
        ]
        data *= len(part.target.bins) > 0
        data += ["coefficient of variation"] * (part.variation is not None) + ["mean"] * (
            part.mean is not None
        )
        if part.points is not None:
            data.append(f"dynamic stiffness at {len(part.points)} frequencies")
        whose = f"{part.name}: " if len(problem.parts) > 1 else ""
        tasks.append(whose + _task_in_words(part.task))
        told.append(whose + ", ".join(data))
    return "; ".join(tasks), "; ".join(told)


def _task_in_words(task: AbstractTask, kind: type[AbstractTask] | None = None) -> str:
    inputs = [
        f"{n} = {float(task[n]):.3g} {'m' if n == 'x_z' else 'N'}"
        for n in INPUTS
        if n in task.parameter_names and float(task[n]) != 0
    ]
    kind = kind or type(task)
    return ", ".join([kind.__name__ + (f" ({HELD[kind]})" if kind in HELD else ""), *inputs])


def _spectrum_in_words(counts: tuple[int, ...], settings: SpectrumSettings) -> str:
    seconds = (
        sum(settings.length + (count - 1) * settings.step for count in counts if count)
        / settings.rate
    )
    alike = f"{len(counts)} x {max(counts)}"
    listed = " + ".join(map(str, counts))
    return (
        f"spectrum of {alike if len(counts) > 2 and min(counts) == max(counts) else listed}"
        f" segments ({seconds:.3g} s)"
    )


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

    At another force level the amplitudes of noise and harmonic have values of their own (people's
    variation is not proportional to force), all else of the muscle is as before: twice the highest
    and half the lowest of the fit's. The displacement is that under the load which the sensor had
    held, so that the operating point stays, and the perturbations with it.
    """
    if without_noise(problem):
        return ()
    levels = [_level_of(part.task) for part in problem.parts]
    factors = [
        tuple(f for f, extreme in zip(LEVELS, (max, min), strict=True) if level == extreme(levels))
        for level in levels
    ]
    designs = []
    for part, moments, own in zip(problem.parts, seen.moments, factors, strict=True):
        made = _designs_for(part, moments, own, _amplitudes(problem, part))
        if len(problem.parts) > 1:
            made = [
                dataclasses.replace(d, name=f"{d.name} ({part.name})", target=part.name)
                for d in made
            ]
        designs += made
    return tuple(designs)


def without_noise(problem: FitProblem) -> bool:
    """Whether a target has no spectrum, so that nothing is known of the noise that would limit a
    further measurement."""
    return any(len(part.target.bins) == 0 for part in problem.parts)


def _level_of(task: AbstractTask) -> float:
    """The first force that moves a task, 0 without one."""
    return next(
        (abs(float(task[n])) for n in FORCES if n in task.parameter_names and float(task[n]) != 0),
        0.0,
    )


def _amplitudes(problem: FitProblem, part: Part) -> tuple[str, ...]:
    """Free amplitudes of a part's noise and harmonic, by their names in the fit."""
    own = dict(zip(part.coordinates.names, part.columns, strict=True))
    return tuple(problem.coordinates.names[own[name]] for name in AMPLITUDES if name in own)


def _designs_for(
    part: Part, moments: Moments, factors: tuple[float, ...], separate: tuple[str, ...]
) -> list[Design]:
    """Of one target: what it does not state, the other output, a moved insertion, other force
    levels, a longer recording."""
    task, mean = part.task, float(moments.mean)
    steady = float(np.sqrt(moments.variance)) < MOST_VARIATION * abs(mean)
    varying = part.variation is not None
    still = "" if part.points is None else ", without motion"
    designs = []
    if not varying and steady:
        designs.append(
            Design("the coefficient of variation", segments=0, coefficient_of_variation=True)
        )
    if part.mean is None and steady:
        designs.append(
            Design(
                f"the mean {task.quantity}, known to {100 * MEAN_ERROR:g} %",
                segments=0,
                mean=MEAN_ERROR,
            )
        )
    if isinstance(task, Isometric):
        held = task.as_task(PrescribedForce, P_w=task.P_w, F_ext=mean)
        designs.append(Design(f"the displacement under a load of {mean:.3g} N", held))
    if isinstance(task, PrescribedLength):
        designs += [
            moved_insertion(
                Lengthening.flat(*given), part.target.settings, coefficient_of_variation=steady
            )
            for given in MOVED
        ]
    if isinstance(task, PrescribedForce):
        fixed = task.as_task(Isometric, P_w=task.P_w)
        designs.append(
            Design("the force with the insertion held", fixed, coefficient_of_variation=True)
        )
    forces = {
        n: float(task[n]) for n in FORCES if n in task.parameter_names and float(task[n]) != 0
    }
    if forces:
        for factor in (f for f in factors if f * (part.target.mvc_fraction or 0.0) <= 1.0):
            name = f"a second force level {factor:g} times as high{still}"
            moved = task.replace(**{n: factor * v for n, v in forces.items()})
            designs.append(Design(name, moved, coefficient_of_variation=varying, separate=separate))
    more = tuple((LONGER - 1) * k for k in segments_of(part.target))
    designs.append(
        Design(
            f"a recording {LONGER} times as long{still}",
            segments=more,
            coefficient_of_variation=varying,
        )
    )
    return designs


def moved_insertion(
    lengthening: Lengthening,
    settings: SpectrumSettings,
    *,
    coefficient_of_variation: bool,
    target: str | None = None,
) -> Design:
    """A recording with the insertion moved: its response, and the spectrum of the fluctuations
    beside it."""
    top = lengthening.frequency[-1]
    name = (
        f"{lengthening.seconds:g} s with the insertion moved by {1e3 * lengthening.rms:.3g} mm rms"
        f" to {top:.3g} Hz"
    )
    segments = settings.segments(round(lengthening.seconds * settings.rate))
    return Design(
        name,
        segments=segments,
        coefficient_of_variation=coefficient_of_variation and segments > 0,
        lengthening=lengthening,
        target=target,
    )


def open_masses(problem: FitProblem) -> dict[str, tuple[int, ...]]:
    """The masses that the fit of a further, moved record would find, and of which the fit at hand
    says nothing.

    By their names in the fit; with each the targets that have it fixed. Where a moved record was
    fitted with a mass fixed, that mass is known.
    """
    found: dict[str, tuple[int, ...]] = {}
    for mass in MASSES:
        parts = [i for i, part in enumerate(problem.parts) if mass in part.task.parameter_names]
        fixed = [i for i in parts if mass not in problem.parts[i].coordinates.names]
        if any(problem.parts[i].target.stiffness is not None for i in fixed):
            continue
        if len(fixed) == len(parts):
            found |= {mass: tuple(fixed)} if fixed else {}
        else:
            found |= {f"{mass}@{problem.parts[i].name}": (i,) for i in fixed}
    return found
