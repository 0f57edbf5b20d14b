"""Do the stated errors hold? Recordings simulated from the fit, nonlinearly, and fitted again."""

from collections.abc import Callable

import numpy as np

from jaxmuscle._common.environment import fitting
from jaxmuscle._common.executors import AnyExecutor
from jaxmuscle._common.keys import number_of
from jaxmuscle._common.progress import told
from jaxmuscle._common.types import Key
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.fits._result import FitResult
from jaxmuscle.fits._search import search_in_blocks
from jaxmuscle.objective._arguments import Plan, settings_of
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._likelihood import require_spread
from jaxmuscle.objective._problem import FitProblem

from ._recovery import Bootstrap, Recovery
from ._replicates import Made, replicates_of, with_data

STARTS = 32
SIMULATED = "recordings simulated nonlinearly"
DRAWN = (
    "spectra drawn from the Gaussian law of their sigma, not simulated: the target states no"
    " segments"
)


def bootstrap(
    result: FitResult,
    *,
    replicates: int = 50,
    key: Key = 0,
    progress: bool | Callable[[str, float], None] = False,
    executor: AnyExecutor | None = None,
) -> Bootstrap:
    """Whether the standard errors of a fit hold: data are made from the fitted task and fitted
    again.

        result = jm.fit(jm.task_for(target), target)
        print(jm.checks.bootstrap(result))

    For every replicate the nonlinear simulator gives one recording for each trial, as long as its
    Welch segments ask for, analysed as the target's (a target with sigma alone: spectra drawn from
    the Gaussian law in the log about the fit). It is fitted as `result` was, with its free
    parameters, priors and bounds, and with a coefficient of variation, a mean force and a dynamic
    stiffness made for this replicate where the fit used them, from 32 starts in linear response (no
    nonlinear correction: where `result.check` shows a nonlinear response, the bias contains it).
    For each quantity that the fit determines: spread of the refits over the stated standard error,
    bias, and how many of the refits' own 95 % intervals (±1.96 errors) hold the value that was
    simulated.

    **Arguments:**

    - `result`: what `fit` returns
    - `replicates`: how many data sets are made and fitted
    - `key`: a `jax.random` key or a seed number
    - `progress`: True or a function of (text, share)
    - `executor`: who fits the replicates, as in `fit_cohort`; they are made in this process

    **Returns:** a `Bootstrap`; replicates that could not be simulated or fitted are in `failed`,
    with the reason.

    **Raises:** `ValueError` for a target without segments and sigma, a failed fit, a task without
    linear response, a fit that determines nothing, fewer than 2 replicates; `WorkersLostError` for
    an executor whose workers or scheduler are lost.
    """
    if replicates < 2:
        raise ValueError(f"replicates = {replicates} must be at least 2: one refit has no spread")
    for target in result.targets.values():
        require_spread(target)
    stated = result.determined
    if not stated:
        raise ValueError(
            f"{result.title}: the fit determines no quantity, so there is no stated error to check"
        )
    with told(progress, f"bootstrap of {result.title}") as tell, fitting():
        problem = reopened(result, key=key)
        tell("making data", 0.0)
        made, failed = replicates_of(problem, tuple(result.tasks.values()), replicates)
        fits, more = _fitted(problem, result, made, tell, executor)
        true = _true(problem, result)
    found = (
        {
            name: Recovery(name, e.unit, true[name], float(e.stderr), *_read(fits, name))
            for name, e in stated.items()
            if e.stderr is not None
        }
        if len(fits) > 1
        else {}
    )
    laws = {
        SIMULATED if target.segments is not None else DRAWN for target in result.targets.values()
    }
    return Bootstrap(
        result.title,
        result.tasks,
        found,
        replicates,
        dict(sorted((failed | more).items())),
        "; ".join(sorted(laws, reverse=True)),
        number_of(key),
    )


def _read(fits: list[FitResult], name: str) -> tuple[np.ndarray, np.ndarray]:
    estimates = [fit.derived.get(name) or fit.parameters[name] for fit in fits]
    return (
        np.array([e.value for e in estimates], dtype=float),
        np.array([np.nan if e.stderr is None else e.stderr for e in estimates], dtype=float),
    )


def _true(problem: FitProblem, result: FitResult) -> dict[str, float]:
    """Values of the fitted tasks in linear response."""
    objective = problem.linear()
    values = quantities(
        objective, expand(objective, problem.theta_of(tuple(result.tasks.values()))[None])
    )[0]
    places = {name: problem.where(name) for name in result.derived_names}
    derived = {name: float(values[i][base][0]) for name, (i, base) in places.items()}
    return {name: p.value for name, p in result.parameters.items()} | derived


def _fitted(
    problem: FitProblem,
    result: FitResult,
    made: Made,
    tell: Callable[[str, float], None],
    executor: AnyExecutor | None,
) -> tuple[list[FitResult], dict[int, str]]:
    """Refits that succeeded, and why others did not."""
    settings = (
        result.settings | {"starts": STARTS} | settings_of(problem, result.settings["bounds"])
    )
    plans = [
        Plan(with_data(problem, data), STARTS, settings["max_steps"], 0, settings, None)
        for data in made.values()
    ]

    def show(text: str, share: float) -> None:
        tell(text, 0.1 + 0.9 * share)

    found = search_in_blocks(executor, [plans], show, replicates=True)
    fits = dict(zip(made, found, strict=True))
    failed = {number: fit.message for number, fit in fits.items() if not fit.success}
    return [fit for fit in fits.values() if fit.success], failed
