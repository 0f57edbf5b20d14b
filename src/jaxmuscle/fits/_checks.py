"""What is checked about a fit: nonlinear against linear, other minima, transients; and what is said about it."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._consequences import Seen, consequences, seen_at
from jaxmuscle.objective._least_squares import Descent
from jaxmuscle.objective._problem import Problem, Setup
from jaxmuscle.objective._starts import contenders, harmonic_frequencies
from jaxmuscle.response._expected import Moments, expected_moments
from jaxmuscle.response._linearised import linearised
from jaxmuscle.simulation._trajectory import Trajectory
from jaxmuscle.spectra._bin_law import BinStatistics, trial_samples
from jaxmuscle.spectra._settings import WINDOW

from ._result import Estimate

AMBIGUOUS = 1.92
NONLINEAR = 0.1
LEFT = 1e-3
RISEN = 1.5


class Stage(NamedTuple):
    """A stage of a search: its name, its problem, and where its starts stand."""

    name: str
    problem: Problem
    descent: Descent


def controlled_moments(runs: Trajectory, target: Target) -> tuple[Moments, Moments | None]:
    """Moments of every seed, whose mean has the expectation of the nonlinear model, and those of the linear response.

    With a control variate a seed's power is `e + p_i - l_i` (see `Trajectory.mean_spectrum`), and so is its variance, e
    being that of a recording as long as the target's.
    """
    settings = target.settings
    held = runs.filtered(settings)
    power, variance = np.asarray(runs.spectrum(settings).power), held.var(axis=1)
    expected = None
    if runs.linear is not None:
        exact, _ = expected_moments(as_arrays(runs.task), settings, WINDOW, trial_samples(target))
        expected = jax.tree.map(np.asarray, exact)
        beside = runs.beside()
        power = expected.power + power - np.asarray(beside.spectrum(settings).power)
        variance = expected.variance + variance - beside.filtered(settings).var(axis=1)
    line = np.zeros_like(power) if expected is None else np.broadcast_to(expected.line, power.shape)
    return Moments(power, line, held.mean(axis=1), variance), expected


def seen_best(problem: Any, descent: Descent) -> Seen:
    """What the model gives at the best point."""
    seen = seen_at(problem, np.asarray(problem.theta(descent.s)))
    return jax.tree.map(lambda x: x[descent.best], seen)


def linear_check(each: np.ndarray, expected: np.ndarray, statistics: BinStatistics) -> dict[str, float | int]:
    """How far the nonlinear spectrum is from the linear response, by fresh seeds with the control variate."""
    difference = each.mean(axis=0) - expected
    error = each.std(axis=0, ddof=1) / np.sqrt(len(each)) if len(each) > 1 else np.full(len(expected), np.nan)
    relative = difference / expected
    return {
        "seeds": len(each),
        "largest_deviation_se": float(np.max(np.abs(difference) / error)),
        "largest_deviation": float(np.max(np.abs(relative))),
        "largest_deviation_sd": float(np.max(np.abs(np.log1p(np.maximum(relative, -0.999)) / statistics.sd))),
    }


def polish_check(setup: Setup, stages: list[Stage], found: dict[str, Estimate]) -> dict[str, float | int]:
    """How far the nonlinear correction moved the determined quantities, in standard errors."""
    names = [stage.name for stage in stages]
    if "polishing" not in names or setup.method != "linear":
        return {}
    before, after = stages[names.index("linear response")], stages[-1]
    old, new = (consequences(stage.problem, seen_best(stage.problem, stage.descent))[0][1] for stage in (before, after))
    moves = [abs(float(new[name] - old[name])) / p.stderr for name, p in found.items() if p.stderr]
    return {"polish_moved_se": max(moves, default=0.0), "polish_turns": len(stages) - 1 - names.index("linear response")}


def unsettled(setup: Setup, task: AbstractTask) -> float:
    """Share of the input's rise that is left when the analysed window begins."""
    if not setup.control:
        return 0.0
    rate = np.abs(np.linalg.eigvals(np.asarray(linearised(as_arrays(task)).system.A))).min()
    return float(np.exp(-rate * (WINDOW[0] - RISEN)))


def rival_frequencies(setup: Setup, final: Descent) -> list[float]:
    """Harmonic frequencies of other minima that fit almost as well as the best one, best first [Hz].

    Almost as well: a cost `½ Σ r²` within 1.92 of the lowest, half the 95 % quantile of χ² with one degree of freedom, so
    that a likelihood interval for the frequency would contain them.
    """
    chosen = contenders(setup.coordinates, setup.target, final, AMBIGUOUS)
    if len(chosen) < 2:
        return []
    frequency = harmonic_frequencies(setup.coordinates, final)
    return [float(frequency[i]) for i in chosen[1:]]


def notices_of(
    target: Any, statistics: BinStatistics, rivals: list[float], check: dict[str, float | int], left: float
) -> tuple[str, ...]:
    notices = list(target.notices)
    if not statistics.known:
        notices.append("the target states neither segments nor sigma: every bin counts alike and there is no chi2")
    if rivals:
        others = " and ".join(f"{f:.2f} Hz" for f in rivals)
        notices.append(f"harmonic_frequency is ambiguous: {others} fits almost as well (log-likelihood within {AMBIGUOUS}); "
                       "the other numbers hold for the frequency shown")  # fmt: skip
    if check.get("largest_deviation", 0.0) > NONLINEAR:
        notices.append(f"the response is not linear here: simulation and linear response differ by up to "
                       f"{100 * check['largest_deviation']:.0f} % of a bin (the fit is corrected for it); large noise or "
                       "harmonic: check with method='montecarlo'")  # fmt: skip
    if check.get("polish_moved_se", 0.0) > 1:
        notices.append(f"the nonlinear correction moved a determined quantity by {check['polish_moved_se']:.1f} standard "
                       "errors: check with method='montecarlo'")  # fmt: skip
    if left > LEFT:
        notices.append(f"slow task: {100 * left:.1g} % of the input's rise is left when the analysed window begins; the fit "
                       "is about the settled task, simulate that with jaxmuscle.settled(task)")  # fmt: skip
    return tuple(notices)
