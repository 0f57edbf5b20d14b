"""Fit of a task's parameters to a target spectrum, in linear response or by Monte Carlo; to several
targets of one person together."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Unpack, overload

from jaxmuscle._common.arguments import check_options
from jaxmuscle._common.arrays import all_concrete, require
from jaxmuscle._common.environment import fitting
from jaxmuscle._common.progress import told
from jaxmuscle.data._as_target import as_target
from jaxmuscle.data._perturbed import PerturbedRecording
from jaxmuscle.data._target import Target
from jaxmuscle.model._noises import with_noise
from jaxmuscle.model._rungs import QUIET, RUNGS, is_base, on_rung
from jaxmuscle.model._task import AbstractTask, require_task
from jaxmuscle.model._tasks import PrescribedLength
from jaxmuscle.model._white_noise import BandLimitedNoise
from jaxmuscle.objective._arguments import Plan, at_mean, planned
from jaxmuscle.objective._derived import seen_band
from jaxmuscle.objective._options import FitOptions, JointFitOptions, OneFitOptions

from ._joint import fit_jointly
from ._model_choice import Models, first_rung, options_for
from ._perturbed import ANEW, alike, analysed, explained, recordings_of, seen_with, without_rhythm
from ._reflex import check_reflex, may_have_reflex, with_reflex
from ._result import FitResult
from ._search import search


@overload
def fit(
    task: AbstractTask,
    target: Any,
    *,
    progress: bool | Callable[[str, float], None] = ...,
    answer: Callable[[FitResult], None] | None = ...,
    **options: Unpack[OneFitOptions],
) -> FitResult: ...
@overload
def fit(
    task: Mapping[str, AbstractTask] | None,
    target: Mapping[str, Any],
    *,
    progress: bool | Callable[[str, float], None] = ...,
    answer: Callable[[FitResult], None] | None = ...,
    **options: Unpack[JointFitOptions],
) -> FitResult: ...
def fit(
    task: Any,
    target: Any,
    *,
    progress: bool | Callable[[str, float], None] = False,
    answer: Callable[[FitResult], None] | None = None,
    **options: Any,
) -> FitResult:
    """Find the parameters whose expected spectrum is the target's: Levenberg-Marquardt from many
    starts.

        target = jm.load_target("vastus-lateralis-26mvc")
        result = jm.fit(target.task(), target)
        print(result)

    Minimises `½ Σ r_k² + ½ Σ θ_j²`, r the residuals in standard deviations of the target, `(z_k -
    z̄) / sd_k` with `z_k = ln(target_k / fitted_k) - bias_k`, θ the free parameters' distance from
    the task's own values in standard deviations of the prior.

    `method="linear"`: the model's spectrum is that of the linear response (`expected_spectrum`);
    the best minimum is then polished with the nonlinear model's correction to it, from `seeds`
    noise paths. `method="montecarlo"`: a mean over `seeds` noise paths that stay the same
    throughout (common random numbers), with the linear response as control variate where the task
    has one. The reported spectrum comes from `check_seeds` fresh paths of the nonlinear model.

    **Arguments:**

    - `task`: the model; its values are the prior's centre. `target.task()` makes one
    - `target`: what is fitted; its spectrum settings replace the task's. A `Target`, a `Recording`,
      the recordings of one condition (a list, `Trials`), a `PerturbedRecording` or several, a
      `FrequencyResponse`, or names and paths of these (with a `PrescribedLength` a file of force
      and displacement is a perturbed recording, see `jaxmuscle.data.two_channels`)
    - `free`: names to fit. By default those marked ● in the table of parameters
      (docs/reference/parameters.md), and, if the task has them, the correlation time of its noise,
      the contraction time, and amplitude, frequency and width of its tremor and of its second
      resonance; where a motor moves the insertion m_w and m_z, too. Of a target without a spectrum
      only k_w, k_z, c_w, c_z, m_w and m_z
    - `fix`: values to set, which are then not free
    - `noise`: a name or an object
    - `starts`: from how many points the search starts (100, or 8 for a task without linear
      response)
    - `seeds`: noise paths of the nonlinear correction (32, or 48 for a task without linear
      response; 0: no nonlinear correction)
    - `key`: a `jax.random` key or a seed number
    - `bounds` {name: (low, high)} in the unit of the parameter; infinite where there is none
    - `priors` {name: sd in log, or None for a flat one}; "damping_ratio" for that of the muscle's
      damping ratio, which models with activation have (0.5; None: none)
    - `coefficient_of_variation`: whether the target's, if it states one, is one more residual (it
      fixes the scale of the noise)
    - `mean_force` (value, sd) [N] as a further residual, of a task that you have scaled
      (`task.at_force`) and whose P_w you free. By default, if the target states its mean in
      newtons, that mean: then the task is scaled to it, and P_w is free. False: no mean is used
    - `max_steps` of each search from a starting point
    - `check_seeds`: fresh noise paths of the reported spectrum (64; 200 for a task without linear
      response; 0: not simulated)
    - `dt` [s]: noise grid of a Monte Carlo fit
    - `progress`: True or a function of (text, share)
    - `rungs`: how many richer models may be tried where the spectrum shows a tremor, or the base
      model does not describe the data (`on_rung`; 3, or 0 where `noise` or `free` is given)
    - `reflex`: of a moved record, whether a stretch reflex beside the muscle is looked for, and
      fitted if it is seen ("auto"), left out ("none") or fitted in any case ("linear")
    - `answer`: a function that gets the result as soon as the search ends: with the verdict, before
      the simulated check, and before profile and p-value of the harmonic

    **Several targets of one person**, two force levels, or force and displacement, are fitted
    together with shared parameters:

        together = jm.fit(None, {"low": low, "high": high}, separate=("noise_K_w",))
        together["k_w"]

    The residuals of all targets are summed, in linear response, and each target's spectrum has its
    own nonlinear correction. A parameter of one name is the same number in all tasks that have it;
    one that only one task has belongs to that. The inputs (`P_w`, `F_ext`, `x_z`) are each task's
    own. Not for two spectra of one recording ("standard" and "slow"): its data would count twice; a
    notice says so. Then the arguments are as above, but for these:

    - `task` {name: task}, or None; of a target that is not named its own, `target.task()`
    - `target` {name: target, in any of the forms} (of one: the fit of that)
    - `separate`: names of parameters that have a value for each target, then called "c_w@high"
    - `proportional`: names that keep the ratio which their values have in the tasks (as
      `task.at_level` sets them)
    - `free` and `fix`: "P_w@high" for one target's
    - `starts`: 32. `seeds`: 32. `check_seeds`: 0, the linear response times the correction
    - `mean_force` {target: (value, sd)} [N]: means as further data, of tasks that you have scaled.
      By default, if no tasks are given, the means that the targets state in newtons: then all tasks
      are scaled by one number, to the first of these means, and every target that states a mean has
      a free P_w. Where one target is of a moved insertion, the masses are not scaled, and are free
      in all tasks
    - `rungs`: 0; all targets get the same model. Not with tasks
    - `reflex`: it is one and the same in all tasks of a moved insertion
    - no `method`, no `dt`

    **Returns:** a `FitResult`, with a part for each target; a fit that fails is one, too, and says
    why.

    **Raises:** `ValueError` for bad arguments (unknown names with the nearest known, too few bins,
    values outside bounds, tasks that contradict each other in what they share); `FitInterrupted` on
    Ctrl-C, with what was reached.
    """
    if isinstance(target, Mapping):
        check_options(fit, JointFitOptions, options)
        require(
            task is None or isinstance(task, Mapping),
            f"task: one {type(task).__name__}, but several targets. Of one person: give {{name:"
            " task}, or None for the task of each target; of several people: use fit_cohort",
        )
        return fit_jointly(task, target, progress, answer, **options)
    check_options(fit, OneFitOptions, options)
    require_task(task, "fit(task, target)")
    require(
        all_concrete(task),
        "task: JAX is tracing it (inside jit, grad or vmap), but a fit needs numbers. Call fit"
        " outside; jaxmuscle.fits.problem(task, target) has functions that JAX can transform"
        " (log_density, residuals)",
    )
    recordings = recordings_of(target, task)
    aim = recordings[0].name if recordings else (target := as_target(target)).name
    with told(progress, f"fitting {aim}") as tell, fitting():
        given = FitOptions(**options, progress=tell)
        task = with_noise(task, given.noise, given.fix)
        if recordings:
            tell("subtracting the response to the movement", 0.01)
            target = analysed(recordings, without_rhythm(task, given), given)
        top = _top(task, target, given)
        models = _models(task, target, given, top, recordings)
        plan = models.plan_at(models.first)
        several = top > models.lowest or models.with_reflex is not None

        def completed(found: FitResult) -> FitResult:
            given.progress("what it explains of the other half", 0.95)
            return _explained(found, recordings, task, given, models.first)

        done = completed if recordings else None
        return search(plan, answer, models if several else None, done)


def _explained(
    result: FitResult,
    recordings: tuple[PerturbedRecording, ...],
    task: AbstractTask,
    given: FitOptions,
    first: int,
) -> FitResult:
    """With the share of the variance of the force that the fitted task explains."""
    fitted, response = result.task, result.target.stiffness
    if not result.success or type(fitted) is not PrescribedLength or response is None:
        return result
    number = next((rung.number for rung in result.ladder if rung.chosen), first)

    def planned_for(target: Target, some: Sequence[PerturbedRecording]) -> Plan:
        models = _models(task, target, given, number, tuple(some))
        if fitted.reflex is not None and models.with_reflex is not None:
            return models.with_reflex(number, ())
        return models.plan_at(number)

    known = response.known
    low, high = seen_band(known.frequency, known.value, known.stderr).tolist()
    shares = explained(fitted, recordings, (low, high), planned_for, given.max_steps)
    ((name, part),) = result.parts.items()
    return dataclasses.replace(result, parts={name: dataclasses.replace(part, explained=shares)})


def _models(
    task: AbstractTask,
    target: Target,
    given: FitOptions,
    top: int,
    recordings: tuple[PerturbedRecording, ...],
) -> Models:
    """The models that may be fitted: of a moved record also noise alone."""
    target = target.with_measures()
    base, options = at_mean(task, target, given)
    # no verdict
    unknown = len(target.bins) > 0 and target.segments is None and target.sigma is None
    quiet = base if target.stiffness is None or unknown else without_rhythm(base, options)
    lowest = 0 if quiet is base else QUIET

    def plan_at(number: int) -> Plan:
        task = quiet if number == QUIET else on_rung(base, number) if number else base
        return planned(task, target, options_for(task, options))

    def renewed(muscles: tuple[AbstractTask, ...]) -> Models | None:
        """The response was taken off by a muscle of the base model: where that is not chosen, by
        the one that is."""
        given.progress(ANEW, 0.0)
        again = seen_with(muscles[0], recordings)
        return None if alike(target, again) else _models(task, again, given, top, recordings)

    def reflexive(number: int, seen_by: tuple[AbstractTask, ...]) -> Plan:
        own = quiet if number == QUIET else on_rung(base, number) if number else base
        aim = seen_with(seen_by[0], recordings) if recordings and seen_by else target
        moved, how = with_reflex(own, options_for(own, options))
        return planned(moved, aim.with_measures(), how)

    first = first_rung([target], lowest, top) if top > lowest else lowest
    sought = check_reflex(options, possible=may_have_reflex(base, target, options))
    return Models(
        first,
        lowest,
        top,
        plan_at,
        renewed if recordings else None,
        reflexive if sought else None,
        options.reflex,
    )


def _top(task: AbstractTask, target: Target, options: FitOptions) -> int:
    """The highest rung of the ladder that may be tried: all of them, unless a model was asked
    for."""
    possible = (
        options.method == "linear"
        and is_base(task)
        and (target.segments is not None or target.sigma is not None)
    )
    if options.rungs is None:
        chosen = options.noise is not None or type(task.noise) is not BandLimitedNoise
        return len(RUNGS) - 1 if possible and not chosen and options.free is None else 0
    if options.rungs >= len(RUNGS):
        raise ValueError(f"rungs = {options.rungs}: the highest is {len(RUNGS) - 1}")
    if options.rungs and not possible:
        raise ValueError(
            "rungs: richer models can be tried only if the method is 'linear', the target"
            " states segments or sigma, and the task has no activation or resonance yet"
        )
    return options.rungs
