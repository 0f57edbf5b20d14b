"""What is checked about a fit: nonlinear against linear, other minima, transients; and what is said about it."""

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmuscle.data._target import Target
from jaxmuscle.objective._consequences import Expansion, consequences, expand
from jaxmuscle.objective._least_squares import Minima
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.objective._starts import contenders, frequency_names, harmonic_frequencies
from jaxmuscle.response._expected import Moments, expected_moments
from jaxmuscle.simulation._trajectory import Trajectory
from jaxmuscle.spectra._bin_law import BinStatistics, trial_samples
from jaxmuscle.spectra._settings import WINDOW

from ._part import Estimate

AMBIGUOUS = 1.92
NONLINEAR = 0.1
LEFT = 1e-3
RISEN = 1.5


class Stage(NamedTuple):
    """A stage of a search: its name, the residuals it lowers, and where its starts stand."""

    name: str
    objective: Residuals
    minima: Minima


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
        exact, _ = expected_moments(runs.task, settings, WINDOW, trial_samples(target))
        expected = jax.tree.map(np.asarray, exact)
        beside = runs.beside()
        power = expected.power + power - np.asarray(beside.spectrum(settings).power)
        variance = expected.variance + variance - beside.filtered(settings).var(axis=1)
    line = np.zeros_like(power) if expected is None else np.broadcast_to(expected.line, power.shape)
    mean = held.mean(axis=1)
    return Moments(power, line, mean, variance, np.full_like(mean, np.nan)), expected


def seen_best(objective: Residuals, minima: Minima) -> Expansion:
    """What the model gives at the best point."""
    return expand(objective, np.asarray(objective.theta(minima.s))).row(minima.best)


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


def polish_check(problem: FitProblem, stages: list[Stage], found: dict[str, Estimate]) -> dict[str, float | int]:
    """How far the nonlinear correction moved the determined quantities, in standard errors."""
    names = [stage.name for stage in stages]
    if "polishing" not in names or problem.method != "linear":
        return {}
    before, after = stages[names.index("linear response")], stages[-1]
    old, new = (problem.by_name(consequences(s.objective, seen_best(s.objective, s.minima)).values) for s in (before, after))
    # Of several targets, a quantity that is the same for all is that of the first.
    held = {name: name if name in new else f"{name}@{problem.parts[0].name}" for name in found}
    moves = [abs(float(new[held[n]] - old[held[n]])) / p.stderr for n, p in found.items() if p.stderr]
    return {"polish_moved_se": max(moves, default=0.0), "polish_turns": len(stages) - 1 - names.index("linear response")}


def polish_notices(check: dict[str, float | int]) -> tuple[str, ...]:
    """The notice of a correction that matters."""
    if not check.get("polish_moved_se", 0.0) > 1:
        return ()
    return (f"the nonlinear correction moved a determined quantity by {check['polish_moved_se']:.1f} standard errors: check "
            "with method='montecarlo'",)  # fmt: skip


def unsettled(problem: FitProblem, moments: Moments) -> float:
    """Share of an input's rise that is left when the analysed window begins."""
    return float(np.exp(-float(moments.rate) * (WINDOW[0] - RISEN))) if problem.control else 0.0


def rivals(problem: FitProblem, minima: Minima) -> tuple[list[str], list[str]]:
    """Other minima that fit almost as well as the best one, in words, and which harmonic frequencies differ in them.

    Almost as well: a cost `½ Σ r²` within 1.92 of the lowest, half the 95 % quantile of χ² with one degree of freedom, so
    that a likelihood interval for the frequency would contain them.
    """
    chosen = contenders(problem, minima, AMBIGUOUS)
    names = frequency_names(problem.coordinates)
    theta = np.asarray(problem.coordinates.theta(minima.s))
    frequency = {name: harmonic_frequencies(problem, theta, name)[chosen] for name in names}
    told, moved = [], []
    for i in range(1, len(chosen)):
        differ = [n for n, f in frequency.items() if abs(f[i] - f[0]) >= problem.finest.settings.resolution]
        told.append(" with ".join(f"{n} " * (len(names) > 1) + f"{frequency[n][i]:.2f} Hz" for n in differ))
        moved += differ
    return told, sorted(set(moved))


def ambiguity(told: list[str], moved: list[str]) -> tuple[str, ...]:
    """The notice of such minima."""
    if not told:
        return ()
    verb = "is" if len(moved) == 1 else "are"
    return (f"{' and '.join(moved)} {verb} ambiguous: {' or '.join(told)} fits almost as well (log-likelihood within "
            f"{AMBIGUOUS}); the other numbers belong to the frequency shown",)  # fmt: skip


def notices_of(target: Any, statistics: BinStatistics, check: dict[str, float | int], left: float) -> tuple[str, ...]:
    """What has to be said of one target and its task."""
    notices = list(target.notices)
    if not statistics.known:
        notices.append("the target states neither segments nor sigma: every bin counts alike and there is no chi2")
    if check.get("largest_deviation", 0.0) > NONLINEAR:
        notices.append(f"the response is not linear here: simulation and linear response differ by up to "
                       f"{100 * check['largest_deviation']:.0f} % of a bin (the fit is corrected for it); large noise or "
                       "harmonic: check with method='montecarlo'")  # fmt: skip
    if left > LEFT:
        notices.append(f"slow task: {100 * left:.1g} % of the input's rise is left when the analysed window begins; the fit "
                       "is about the settled task, simulate that with jaxmuscle.settled(task)")  # fmt: skip
    return tuple(notices)
