"""Measurements that could be made in addition to a fit's, and what they would tell of its
parameters."""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import numpy as np

from jaxmuscle._common.text import choices
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedForce, PrescribedLength
from jaxmuscle.objective._arguments import MASSES
from jaxmuscle.objective._consequences import Expansion
from jaxmuscle.objective._likelihood import require_spread
from jaxmuscle.objective._problem import FitProblem, Part
from jaxmuscle.response._expected import Moments
from jaxmuscle.response._scaling import FORCES
from jaxmuscle.spectra._settings import SpectrumSettings

from ._lengthening import Lengthening

AMPLITUDES = ("noise_K_w", "noise_K_z", "noise_C_w", "noise_C_z", "harmonic_amplitude")
MEAN_ERROR = 0.02
LEVELS = (2.0, 0.5)
LONGER = 10
# rms [m] and band [Hz] of standard perturbations; slower, force drifts
MOVED = ((1e-4, (0.5, 10.0)), (1e-3, (0.5, 5.0)))
MOST_VARIATION = 1e3
MOTION = "{:g} s with the insertion moved by {:.3g} mm rms to {:.3g} Hz"


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
        if not (
            self.spectral or self.coefficient_of_variation or self.moves or self.mean is not None
        ):
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

    @property
    def moves(self) -> bool:
        """Whether a motor moves the insertion."""
        return self.lengthening is not None

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


def _inputs(task: AbstractTask, names: Iterable[str]) -> dict[str, float]:
    """Those among these inputs of a task that are not zero."""
    values = {name: float(task[name]) for name in names if name in task.parameter_names}
    return {name: value for name, value in values.items() if value != 0}


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
    # the first force that moves a task, 0 without one
    levels = [next(map(abs, _inputs(part.task, FORCES).values()), 0.0) for part in problem.parts]
    designs = []
    for part, moments, level in zip(problem.parts, seen.moments, levels, strict=True):
        ends = zip(LEVELS, (max(levels), min(levels)), strict=True)
        factors = [factor for factor, extreme in ends if level == extreme]
        made = _designs_for(part, moments, factors, _amplitudes(problem, part))
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


def _amplitudes(problem: FitProblem, part: Part) -> tuple[str, ...]:
    """Free amplitudes of a part's noise and harmonic, by their names in the fit."""
    own = dict(zip(part.coordinates.names, part.columns, strict=True))
    return tuple(problem.coordinates.names[own[name]] for name in AMPLITUDES if name in own)


def _designs_for(
    part: Part, moments: Moments, factors: list[float], separate: tuple[str, ...]
) -> list[Design]:
    """Of one target: what it does not state, the other output, a moved insertion, other force
    levels, a longer recording."""
    task, mean, settings = part.task, float(moments.mean), part.target.settings
    # else the output fluctuates about zero, and nothing is relative to its mean
    steady = float(np.sqrt(moments.variance)) < MOST_VARIATION * abs(mean)
    varying, still = part.variation is not None, ", without motion" * (part.points is not None)
    designs = []
    if not varying and steady:
        name = "the coefficient of variation"
        designs += [Design(name, segments=0, coefficient_of_variation=True)]
    if part.mean is None and steady:
        name = f"the mean {task.quantity}, known to {100 * MEAN_ERROR:g} %"
        designs += [Design(name, segments=0, mean=MEAN_ERROR)]
    if isinstance(task, Isometric):
        loaded = task.as_task(PrescribedForce, P_w=task.P_w, F_ext=mean)
        designs += [Design(f"the displacement under a load of {mean:.3g} N", loaded)]
    if isinstance(task, PrescribedLength):
        motions = (Lengthening.flat(*given) for given in MOVED)
        designs += [
            moved_insertion(one, settings, coefficient_of_variation=steady) for one in motions
        ]
    if isinstance(task, PrescribedForce):
        name, fixed = "the force with the insertion held", task.as_task(Isometric, P_w=task.P_w)
        designs += [Design(name, fixed, coefficient_of_variation=True)]
    forces = _inputs(task, FORCES)
    for factor in factors if forces else ():
        if factor * (part.target.mvc_fraction or 0.0) <= 1.0:
            name = f"a second force level {factor:g} times as high{still}"
            moved = task.replace(**{n: factor * force for n, force in forces.items()})
            about = {"coefficient_of_variation": varying, "separate": separate}
            designs += [Design(name, moved, **about)]
    more = tuple((LONGER - 1) * k for k in segments_of(part.target))
    name = f"a recording {LONGER} times as long{still}"
    return [*designs, Design(name, segments=more, coefficient_of_variation=varying)]


def moved_insertion(
    lengthening: Lengthening,
    settings: SpectrumSettings,
    *,
    coefficient_of_variation: bool,
    target: str | None = None,
) -> Design:
    """A recording with the insertion moved: its response, and the spectrum of the fluctuations
    beside it."""
    seconds, top = lengthening.seconds, lengthening.frequency[-1]
    segments = settings.segments(round(seconds * settings.rate))
    return Design(
        MOTION.format(seconds, 1e3 * lengthening.rms, top),
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
