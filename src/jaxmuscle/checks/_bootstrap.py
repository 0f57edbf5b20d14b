"""Do the stated errors hold? Recordings simulated from the fit, nonlinearly, and fitted again."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.progress import teller
from jaxmuscle.fits._reopened import taken_up
from jaxmuscle.fits._result import FitResult
from jaxmuscle.fits._search import search_together
from jaxmuscle.objective._arguments import Plan
from jaxmuscle.objective._consequences import quantities, seen_at
from jaxmuscle.objective._problem import Setup, theta_of
from jaxmuscle.spectra._bin_law import bin_statistics

from ._recovery import Bootstrap, Recovery
from ._replicates import Made, drawn_data, simulated_data, with_data

STARTS = 32
TOGETHER = 50
SIMULATED = "recordings simulated nonlinearly"
DRAWN = "spectra drawn from the Gaussian law of their sigma, not simulated: the target states no segments"


def bootstrap(
    result: FitResult,
    *,
    replicates: int = 50,
    key: Array | int = 0,
    progress: bool | Callable[[str, float], None] = False,
) -> Bootstrap:
    """Whether the standard errors of a fit hold: data are made from the fitted task and fitted again.

    For every replicate the nonlinear simulator gives one recording for each trial, as long as its Welch segments ask for,
    analysed as the target's (a target with sigma alone: spectra drawn from the Gaussian law in the log about the fit). It
    is fitted as `result` was, with its free parameters, priors, bounds and further data, from 32 starts in linear response
    (no nonlinear correction: where `result.check` shows a nonlinear response, the bias contains it). For each quantity that
    the fit determines: spread of the refits over the stated standard error, bias, and how many of the refits' own 95 %
    intervals (±1.96 errors) hold the value that was simulated.

    **Arguments:** `result`; `replicates`; `key`, a `jax.random` key or a seed number; `progress`, True or a function of
    (text, share).

    **Returns:** a `Bootstrap`; replicates that could not be simulated or fitted are in `failed`, with the reason.

    **Raises:** `ValueError` for a target without segments and sigma, a failed fit, a task without linear response, a fit
    that determines nothing, fewer than 2 replicates.
    """
    if replicates < 2:
        raise ValueError(f"replicates = {replicates} must be at least 2: one refit has no spread")
    if not bin_statistics(result.target).known:
        raise ValueError(f"{result.target.name}: states neither segments nor sigma, so nothing says how much it scatters: "
                         "give segments, the number of Welch segments that were averaged, or a sigma per bin")  # fmt: skip
    stated = {n: e for n, e in ({n: p for n, p in result.parameters.items() if p.free} | result.derived).items()
              if e.stderr is not None}  # fmt: skip
    if not stated:
        raise ValueError(f"{result.target.name}: the fit determines no quantity, so there is no stated error to check")
    tell = teller(progress)
    with jax.enable_x64(True):
        setup = taken_up(result, key=key)
        tell("making data", 0.0)
        simulated = result.target.segments is not None
        made, failed = (simulated_data if simulated else drawn_data)(setup, result.task, replicates)
        fits, more = _fitted(setup, result, made, tell)
        true = _true(setup, result)
    found = {name: Recovery(name, e.unit, true[name], float(e.stderr), *_read(fits, name)) for name, e in stated.items()
             if e.stderr is not None} if len(fits) > 1 else {}  # fmt: skip
    return Bootstrap(result.target, result.task, found, replicates, dict(sorted((failed | more).items())),
                     SIMULATED if simulated else DRAWN, key if isinstance(key, int) else None)  # fmt: skip


def _read(fits: list[FitResult], name: str) -> tuple[np.ndarray, np.ndarray]:
    estimates = [fit.derived.get(name) or fit.parameters[name] for fit in fits]
    return (np.array([e.value for e in estimates], dtype=float),
            np.array([np.nan if e.stderr is None else e.stderr for e in estimates], dtype=float))  # fmt: skip


def _true(setup: Setup, result: FitResult) -> dict[str, float]:
    """Values of the fitted task in linear response."""
    seen = seen_at(setup.linear(), theta_of(setup, result.task)[None])
    values = quantities(setup.linear(), seen)[0]
    parameters = {name: float(value) for name, value in as_numbers(result.task.parameters).items()}
    return parameters | {name: float(np.asarray(x)[0]) for name, x in values.items()}


def _fitted(setup: Setup, result: FitResult, made: Made, tell: Callable[[str, float], None]) -> Any:
    """Refits that succeeded, and why others did not."""
    fits: list[FitResult] = []
    failed: dict[int, str] = {}
    numbers = list(made)
    settings = result.settings | {"starts": STARTS, "prior_centre": dict(zip(setup.coordinates.names,
                                  map(float, setup.coordinates.centre), strict=True))}  # fmt: skip
    for start in range(0, len(numbers), TOGETHER):
        part = numbers[start : start + TOGETHER]

        def show(text: str, share: float, before: int = start, size: int = len(part)) -> None:
            tell(text, 0.1 + 0.9 * (before + share * size) / len(numbers))

        plans = [Plan(with_data(setup, *made[n]), STARTS, settings["max_steps"], 0, settings, None) for n in part]
        for number, fit in zip(part, search_together(plans, show), strict=True):
            if fit.success:
                fits.append(fit)
            else:
                failed[number] = fit.message
    return fits, failed
