"""Which colour of noise, with or without a harmonic, or which richer model explains a spectrum."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Unpack

import jax.numpy as jnp
import numpy as np

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.environment import fitting
from jaxmuscle._common.keys import number_of
from jaxmuscle._common.progress import told
from jaxmuscle._common.text import choices
from jaxmuscle._common.types import Key
from jaxmuscle.data._target import Target
from jaxmuscle.fits._verdict import Endpoint
from jaxmuscle.model._noises import NOISES, with_noise
from jaxmuscle.model._parameters import HARMONIC, PARAMETERS, unknown_parameter
from jaxmuscle.model._rungs import RICHER, on_rung
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import planned
from jaxmuscle.objective._consequences import expand
from jaxmuscle.objective._coordinates import task_at
from jaxmuscle.objective._options import FitOptions, ParameterOptions
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.spectra._bin_law import bin_statistics, standardised

from ._comparison import NEEDED, ComparedModel, Comparison, Model, score_difference
from ._evidence import Candidate, Folds, held_out, masked_bins, maxima, without_harmonic

NAMED = ("free", "fix", "priors", "bounds")  # options that name parameters


def compare_noise(
    task: AbstractTask,
    target: Target,
    *,
    noises: Iterable[str] = (*NOISES, *RICHER),
    groups: int = 10,
    key: Key = 0,
    progress: bool | Callable[[str, float], None] = False,
    **options: Unpack[ParameterOptions],
) -> Comparison:
    """Fit a spectrum with every colour of noise, with and without harmonic, and say which can be
    told apart.

        print(jm.comparison.compare_noise(target.task(), target))

    The richer models that a fit may climb to (`on_rung`) are compared, too, with the task's own
    noise: "activation", "resonance" instead of the harmonic, "two resonances".

    Each model is climbed, in linear response, to the highest of the maxima of its posterior from 64
    starting points (16 without harmonic). For a model with a resonance ("resonance", "two
    resonances") a third of the searches begin, in the parameters that both have, where that of a
    simpler model of the task's own noise ended, of several the one with the lowest AIC. There

        AIC = -2 ln L + 2 p,    p = tr(F (F + Λ)⁻¹),

    L the gamma-copula likelihood of the Welch bins with the total integrated out, F their Fisher
    information, Λ the prior's precision; and the held-out score `Σ_k ln f(p_k | bins kept)`: the
    bins are left out in `groups` turns, every `groups`-th at a time, and each is foretold by a fit
    to the rest. Two models are told apart if their AIC differs by at least 6 and the held-out score
    says the same (docs/noise-colour.md); a harmonic whose frequency is free has to gain 6 + 2
    ln(bins).

    **Arguments:**

    - `task`: whose own noise keeps its values while the others take their defaults
    - `target`: what is fitted, as in `fit`
    - `noises`: names of colours ("white", "band-limited", "ornstein-uhlenbeck", "pink") and of
      richer models ("activation", "resonance", "two resonances"); by default all of them
    - `free`, `fix`, `priors`, `bounds`: as in `fit`, those of a parameter that one model has and
      another has not for those that have it
    - `groups`
    - `key`: a `jax.random` key or a number; 8 of the starting points of each model are drawn with
      it, the others are always the same
    - `progress`: as in `fit`

    **Returns:** a `Comparison`. A model that the task cannot carry is in its `left_out`, with the
    reason. With a sigma but no segments there is no held-out score.

    **Raises:** `ValueError` if fewer than two models remain, for a target that states neither
    segments nor sigma, and as `fit` does.

    **Source:** Akaike 1974, doi:10.1109/TAC.1974.1100705; Murata et al. 1994,
    doi:10.1109/72.329683; Vehtari, Gelman & Gabry 2017, doi:10.1007/s11222-016-9696-4.
    """
    if not 2 <= groups <= len(target.bins):
        raise ValueError(
            f"groups = {groups}: give a number from 2 to that of the target's bins,"
            f" {len(target.bins)}"
        )
    given = FitOptions.of(compare_noise, ParameterOptions, options, key=key)
    with told(progress, f"comparing models on {target.name}") as tell, fitting():
        carried, left_out = _carry(task, noises, given.fix or {})
        problems = _setups(carried, target, given)
        folds = None if target.segments is None else Folds.of([target], groups)
        found: dict[Model, dict[str, Any]] = {}
        # the poorer ones first: a richer model begins where they ended
        order = sorted(problems, key=lambda noise: RICHER.get(noise, 0))
        for number, noise in enumerate(order):
            problem, known = problems[noise], _poorer(noise, task, found)
            present = float(problem.parts[0].task["harmonic_amplitude"]) > 0
            for harmonic in (True, False) if present else (False,):
                what = f"{noise}, {'with' if harmonic else 'without'} harmonic"
                tell(what, (number + 0.5 * (not harmonic)) / len(problems))
                found[noise, harmonic] = _fitted(problem, folds, known, harmonic=harmonic)
    sought = any("harmonic_frequency" in problem.coordinates.names for problem in problems.values())
    needed = NEEDED + 2 * np.log(len(target.bins)) * sought
    tasks, fitted = (
        {model: values.pop(name) for model, values in found.items()} for name in ("task", "fitted")
    )
    seed = number_of(key)
    return Comparison(target, _rows(found), left_out, tasks, fitted, float(needed), groups, seed)


def _carry(
    task: AbstractTask, noises: Iterable[str], fix: Mapping[str, float]
) -> tuple[dict[str, AbstractTask], dict[str, str]]:
    """The task with each noise, or why it cannot have it."""
    carried: dict[str, AbstractTask] = {}
    left_out: dict[str, str] = {}
    known = (*NOISES, *RICHER)
    for name in dict.fromkeys(noises):
        if name not in known:
            raise ValueError(f"noises: {name!r}: {choices(name, known)}")
        try:
            if name in RICHER:
                carried[name] = on_rung(task, RICHER[name])
            elif type(task.noise) is NOISES[name]:
                carried[name] = task
            else:
                carried[name] = with_noise(task, name, fix)
        except ValueError as error:
            left_out[name] = str(error)
    if len(carried) < 2:
        why = "".join(f"; {name}: {reason}" for name, reason in left_out.items())
        raise ValueError(
            f"noises: at least two are needed for a comparison, {len(carried)} can be used{why}"
        )
    return carried, left_out


def _setups(
    carried: dict[str, AbstractTask], target: Target, given: FitOptions
) -> dict[str, FitProblem]:
    """The fit of each noise; what concerns a parameter that only other noises have is left to
    them."""
    everywhere = {name for task in carried.values() for name in task.parameter_names}
    everywhere |= {name for name in PARAMETERS if name.startswith("noise_")}
    for argument in NAMED:
        for name in getattr(given, argument) or ():
            if name not in everywhere:
                raise ValueError(f"{argument}: {unknown_parameter(name, everywhere)}")
    problems = {}
    for noise, task in carried.items():
        own = set(task.parameter_names) - set(HARMONIC if RICHER.get(noise, 0) > 1 else ())
        mine: dict[str, Any] = {
            argument: {n: x for n, x in (getattr(given, argument) or {}).items() if n in own}
            for argument in NAMED[1:]
        }
        if given.free is not None:
            mine["free"] = [n for n in given.free if n in own]
        problems[noise] = planned(task, target, dataclasses.replace(given, **mine)).problem
    return problems


def _poorer(
    noise: str, task: AbstractTask, found: Mapping[Model, dict[str, Any]]
) -> dict[str, float] | None:
    """Where the best of the poorer models of the same noise ended; None for a model that has no
    resonance."""
    rung = RICHER.get(noise, 0)
    poorer = [
        values
        for (name, _), values in found.items()
        if RICHER.get(name, 0) < rung and (name in RICHER or NOISES[name] is type(task.noise))
    ]
    if rung < RICHER["resonance"] or not poorer:
        return None
    ended = min(poorer, key=_height)["task"]
    return {name: float(ended[name]) for name in ended.parameter_names}


def _height(values: Mapping[str, Any]) -> float:
    """The AIC, of a failed search the highest."""
    return values["aic"] if np.isfinite(values["aic"]) else np.inf


def _fitted(
    problem: FitProblem,
    folds: Folds | None,
    known: dict[str, float] | None = None,
    *,
    harmonic: bool,
) -> dict[str, Any]:
    """One model at its maximum, with its score."""
    model, target = Candidate.of(problem, harmonic=harmonic, known=known), problem.parts[0].target
    moving = np.ones((1, len(problem.prior)))
    bins = None if folds is None else masked_bins(target, np.ones((1, len(target.bins))))
    peak = maxima(model, model.starts[None], bins, moving)
    held = None if folds is None else held_out(model, peak.theta, folds, moving)
    residual = standardised(
        target.proportional_power, peak.proportional[0], bin_statistics(target, peak.line[0])
    )
    (part,) = model.likelihood.objective.parts
    problem = problem if harmonic else without_harmonic(problem)
    objective = problem.linear([peak.line[0]])
    judgement = Endpoint(problem, objective, expand(objective, peak.theta).row(0)).adequacy
    return {
        "task": as_numbers(task_at(part.task, part.coordinates, jnp.asarray(peak.theta[0]))),
        "fitted": peak.proportional[0],
        "log_likelihood": float(peak.log_likelihood[0]),
        "parameters": float(peak.parameters[0]),
        "aic": float(2 * (peak.parameters[0] - peak.log_likelihood[0])),
        "scores": None if held is None else held.scores[0],
        "chi2_per_bin": float(np.sum(residual**2) / (len(residual) - 1)),
        "adequacy_p": None if judgement is None else judgement.p,
        "success": bool(peak.settled[0] and (held is None or held.settled[0])),
    }


def _rows(found: dict[Model, dict[str, Any]]) -> tuple[ComparedModel, ...]:
    """What needs all models: differences to the lowest AIC, and weights."""
    best = min(found.values(), key=_height)
    above = {model: values["aic"] - best["aic"] for model, values in found.items()}
    whole = np.nansum(np.exp(-0.5 * np.array([*above.values()])))
    rows = []
    for model, values in found.items():
        scores = values["scores"]
        difference, error = score_difference(scores, best["scores"])
        rows.append(
            ComparedModel(
                *model,
                delta_aic=above[model],
                weight=float(np.exp(-0.5 * above[model]) / whole),
                score=None if scores is None else float(scores.sum()),
                score_difference=difference,
                score_stderr=error,
                **values,
            )
        )
    return tuple(rows)
