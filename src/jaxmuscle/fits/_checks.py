"""What looks wrong about a fit, in sentences: other minima, a nonlinear response, numbers that no
muscle has. `_report.py` asks for it.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._consequences import BATCH, consequences, expand, quantities
from jaxmuscle.objective._coordinates import Coordinates
from jaxmuscle.objective._covariance import Identifiability
from jaxmuscle.objective._derived import LIMB, TISSUES
from jaxmuscle.objective._least_squares import SMALL, Minima
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Residuals
from jaxmuscle.objective._starts import (
    ANSWER,
    OTHER_MODEL,
    OWN,
    PEAK,
    SPREAD,
    contenders,
    frequency_names,
    harmonic_frequencies,
)
from jaxmuscle.spectra._bin_law import BinStatistics
from jaxmuscle.spectra._settings import WINDOW

from ._result import Estimate, FittedPart, Start
from ._stages import Stage, expand_at_best

AMBIGUOUS, OTHER = 2.0, 3.0
SAME_MINIMUM = 0.5  # of costs
CONVERGED = "converged: "  # how the message of a fit that did begins
# how starts began, in words
BEGAN = {
    PEAK: "from peaks",
    ANSWER: "from the measured response",
    OTHER_MODEL: "from another model",
    SPREAD: "spread",
    OWN: "from the task's own values",
}
MISSED = 3.0  # standard deviations of a measured mean or variation
PULLED = 2.0  # prior standard deviations
# standard errors of a response that is seen clearly; of the tangent stiffness
CLEAR, EXTRAPOLATED = 4.0, 2.0
NONLINEAR = 0.1
LEFT = 1e-3
RISEN = 1.5
TWITCH = (0.05, 0.11)  # s; its source stands in the row of activation_time in the parameter table
SLOW = (
    "It also stands for other slow things: the nervous drive, the relaxation of the muscle, a"
    " low-pass filter of the recording"
)
BY_SIMULATION = (
    "Check with a fit by simulation, of one target at a time (--method montecarlo,"
    " method='montecarlo')"
)
NARROW = (
    "beside a tremor the interval of half_power_frequency is too narrow. It held the true value in"
    " 24 of 30 simulated recordings, not in 28 or 29. What to do: do not rest a conclusion on it"
)
FAST = (
    "The relaxation of the muscle smooths the force in the same way and may have taken its place."
    " Or power at high frequencies comes from elsewhere, as from the sensor"
)


def linear_check(
    each: np.ndarray, expected: np.ndarray, statistics: BinStatistics
) -> dict[str, float | int]:
    """How far the nonlinear spectrum is from the linear response, by fresh seeds with the control
    variate."""
    difference = each.mean(axis=0) - expected
    error = (
        each.std(axis=0, ddof=1) / np.sqrt(len(each))
        if len(each) > 1
        else np.full(len(expected), np.nan)
    )
    relative = difference / expected
    return {
        "seeds": len(each),
        "largest_deviation_se": float(np.max(np.abs(difference) / error)),
        "largest_deviation": float(np.max(np.abs(relative))),
        "largest_deviation_sd": float(
            np.max(np.abs(np.log1p(np.maximum(relative, -0.999)) / statistics.sd))
        ),
    }


def polish_check(
    problem: FitProblem, stages: list[Stage], found: dict[str, Estimate]
) -> dict[str, float | int]:
    """How far the nonlinear correction moved the determined quantities, in standard errors."""
    names = [stage.name for stage in stages]
    if "polishing" not in names or problem.method != "linear":
        return {}
    before, after = stages[names.index("linear response")], stages[-1]
    old, new = (
        problem.by_name(consequences(s.objective, expand_at_best(s.objective, s.minima)).values)
        for s in (before, after)
    )
    # Of several targets, a quantity that is the same for all is that of the first.
    held = {name: name if name in new else f"{name}@{problem.parts[0].name}" for name in found}
    moves = [
        abs(float(new[held[n]] - old[held[n]])) / p.stderr for n, p in found.items() if p.stderr
    ]
    return {
        "polish_moved_se": max(moves, default=0.0),
        "polish_turns": len(stages) - 1 - names.index("linear response"),
    }


def polish_notices(check: dict[str, float | int]) -> tuple[str, ...]:
    """The notice of a correction that matters."""
    if not check.get("polish_moved_se", 0.0) > 1:
        return ()
    return (
        (
            "the correction by simulation moved a determined quantity by"
            f" {check['polish_moved_se']:.1f} of its standard errors. {BY_SIMULATION}"
        ),
    )


def unsettled(problem: FitProblem, corner: float) -> float:
    """Share of an input's rise that is left when the analysed window begins, by the corner
    frequency [Hz]."""
    rate = 2 * np.pi * corner
    return float(np.exp(-rate * (WINDOW[0] - RISEN))) if problem.control else 0.0


def rivals(
    problem: FitProblem, stage: Stage, stated: Mapping[str, Estimate]
) -> tuple[tuple[str, ...], set[str]]:
    """Other solutions that fit almost as well as the best one, told in words; and which stated
    quantities differ in them.

    Almost as well: a cost `½ Σ r²` within 2 of the lowest, so that a 95 % likelihood interval would
    contain them. Near a single minimum no quantity is then further off than two standard errors;
    one that is further than three, or a harmonic's frequency further than a bin, belongs to another
    solution.
    """
    minima = stage.minima
    cost = np.where(np.isfinite(minima.cost), minima.cost, np.inf)
    order = np.argsort(cost, kind="stable")[:BATCH]
    order = order[cost[order] <= cost[order[0]] + AMBIGUOUS]
    names = frequency_names(problem.coordinates)
    theta = np.asarray(problem.coordinates.theta(minima.s))
    chosen = contenders(problem, minima, AMBIGUOUS)
    told, moved = [], set[str]()
    frequency = {name: harmonic_frequencies(problem, theta, name)[chosen] for name in names}
    for i in range(1, len(chosen)):
        differ = [
            n
            for n, f in frequency.items()
            if abs(f[i] - f[0]) >= problem.finest.settings.resolution
        ]
        told.append(
            " with ".join(f"{n} " * (len(names) > 1) + f"{frequency[n][i]:.2f} Hz" for n in differ)
        )
        moved |= set(differ)
    said: tuple[str, ...] = ()
    if told:
        verb = "is" if len(moved) == 1 else "are"
        others = (
            " or ".join((", ".join(told[:-1]), told[-1])) + " fit"
            if told[1:]
            else f"{told[0]} fits"
        )
        said = (
            (
                f"{' and '.join(sorted(moved))} {verb} ambiguous: {others} almost as well"
                f" (log-likelihood lower by at most {AMBIGUOUS:g}). All other numbers are those of"
                " the frequency shown"
            ),
        )
    if not any(p.stderr for p in stated.values()) or not stage.objective.linear:
        return said, moved
    # one size, so that one program serves all
    rows = order[np.minimum(np.arange(BATCH), len(order) - 1)]
    values = _values(problem, stage.objective, theta[rows])
    far = {
        n: values[n][np.argmax(np.abs(values[n] - values[n][0]))]
        for n, p in stated.items()
        if p.stderr
        and n in values
        and n not in moved
        and np.max(np.abs(values[n] - values[n][0])) > OTHER * p.stderr
    }
    if far:
        others = ", ".join(f"{n} {far[n]:.3g} instead of {values[n][0]:.3g}" for n in far)
        these, them = ("these quantities", "them") if len(far) > 1 else ("this quantity", "it")
        said += (
            (
                "another solution fits almost as well (log-likelihood lower by at most"
                f" {AMBIGUOUS:g}): {others}. No standard error is stated for {these}. Treat {them}"
                " as not determined"
            ),
        )
    return said, moved | set(far)


def _values(problem: FitProblem, objective: Residuals, theta: np.ndarray) -> dict[str, np.ndarray]:
    """Free parameters and derived quantities at every θ."""
    seen = expand(objective, theta)
    derived = problem.by_name(quantities(objective, seen)[0])
    return derived | dict(
        zip(problem.coordinates.names, problem.coordinates.values_of(theta).T, strict=True)
    )


def convergence(
    final: Minima,
    residuals: np.ndarray,
    jacobian: np.ndarray,
    prior: np.ndarray,
    theta: np.ndarray,
    known: Identifiability,
    starts: tuple[Start, ...],
    max_steps: int,
) -> tuple[bool, str]:
    """Success: a further step gains less than a thousandth of the cost, or only runs along what is
    not determined.

    "Converged" says more: starts of two kinds (or the only one) came to this minimum.
    """
    cost = final.cost[final.best]
    curvature = jacobian.T @ jacobian + prior
    gradient = jacobian.T @ residuals + prior @ theta
    step = -np.linalg.pinv(curvature, hermitian=True) @ gradient
    gain = -0.5 * gradient @ step / max(cost, 1e-300)
    finite = [s.cost for s in starts if s.cost is not None]
    there = [s.kind for s in starts if s.cost is not None and s.cost <= min(finite) + SAME_MINIMUM]
    kinds = Counter(there)
    census = (
        f"{len(there)} of {len(starts)} starts reach this minimum (cost within {SAME_MINIMUM:g};"
        f" {', '.join(f'{count} {BEGAN[kind]}' for kind, count in kinds.items())})"
    )
    if final.settled[final.best] or gain < SMALL:
        if len(kinds) > 1 or len(starts) == 1:
            return True, f"{CONVERGED}{census}"
        times = "once" if len(there) == 1 else f"{len(there)} times, by one kind of start"
        return True, (
            f"best of {len(starts)} starts, found {times} ({BEGAN[there[0]]}): a better minimum may"
            " exist. More starts would show (--starts)"
        )
    along = known.directions[~known.determined] @ step
    if along @ along >= 0.9 * (step @ step):
        return (
            True,
            (
                f"stopped after {max_steps} steps: further ones change only what the data do not"
                f" determine; {census}"
            ),
        )
    return (
        False,
        (
            f"did not converge: after {max_steps} steps a further step would still improve the fit"
            f" by {100 * gain:.2g} %. Give more starts (--starts), or in Python raise max_steps"
        ),
    )


def further_notices(further: Mapping[str, float]) -> tuple[str, ...]:
    """The notice of a datum that the fit misses."""
    words = {"coefficient_of_variation": "coefficient of variation", "mean": "mean"}
    return tuple(
        f"the fitted {words[name]} is {abs(off):.1f} standard deviations"
        f" {'above' if off > 0 else 'below'} the given one. The model cannot meet this value and"
        " the other data together: check how the value was measured"
        for name, off in further.items()
        if abs(off) > MISSED
    )


def twitch_notices(found: Mapping[str, Estimate]) -> tuple[str, ...]:
    """The notice of a contraction time whose interval lies outside the range of human muscle."""
    instead = "report half_power_frequency, which holds twitch and relaxation together, or "
    instead *= any(base_of(name) == "half_power_frequency" for name in found)
    said = []
    for name, p in found.items():
        if base_of(name) != "contraction_time" or p.stderr is None or p.interval is None:
            continue
        low, high = p.interval
        slow, fast = low is not None and low > TWITCH[1], high is not None and high < TWITCH[0]
        if slow or fast:
            said.append(
                f"{name} ({p.interval_in_words()} s) is {'longer' if slow else 'shorter'} than in"
                f" human muscle, {TWITCH[0]:g} to {TWITCH[1]:g} s. {SLOW if slow else FAST}. Do not"
                f" report it as the muscle's contraction time. What to do: {instead}hold"
                " activation_time at a value that you know"
            )
    return tuple(said)


def narrow_notices(
    found: Mapping[str, Estimate], parts: Mapping[str, FittedPart]
) -> tuple[str, ...]:
    """The notice of a half-power frequency beside a tremor that is seen."""
    seen = [part.target.measured.get("tremor_frequency") for part in parts.values()]
    trembles = any(m is not None and np.isfinite(m.value) for m in seen)
    stated = any(base_of(n) == "half_power_frequency" and p.stderr for n, p in found.items())
    return (NARROW,) * (trembles and stated)


def mass_notices(coordinates: Coordinates, theta: Float[np.ndarray, " free"]) -> tuple[str, ...]:
    """The notice of an active mass that was pulled far from where its prior has it."""
    said = []
    for name, at, centre, sd in zip(
        coordinates.names, theta, coordinates.centre, coordinates.sd, strict=True
    ):
        if base_of(name) == "m_w" and abs(at) > PULLED:
            said.append(
                f"{name} went to {centre * np.exp(at * sd):.2g} kg, {abs(at):.2g} standard"
                f" deviations of its prior from the {centre:.2g} kg with which the fit began. No"
                " record determines it, so something else pulls it: the force may fluctuate in a"
                " way that this muscle cannot, another mass moves, a weak reflex answers, or the"
                " limb is no two tissues in series. So the numbers of the tissues, H(0) and B0 are"
                " not stated. Take K and B of jaxmuscle analyse, which look at the response alone"
            )
    return tuple(said)


def array_notices(tasks: Iterable[AbstractTask]) -> tuple[str, ...]:
    """The notice of a muscle that holds arrays of many numbers, a network say."""
    said = []
    for muscle in (task.muscle for task in tasks):
        leaves = {
            field.name: jax.tree.leaves(getattr(muscle, field.name))
            for field in dataclasses.fields(muscle)
            if not field.metadata.get("static", False)
        }
        sizes = {name: sum(np.size(x) for x in of if np.ndim(x)) for name, of in leaves.items()}
        said += [
            f"{type(muscle).__name__}.{name} holds {size} numbers in arrays. The fit left them as"
            " they are: it moves single numbers, which have names. To train arrays, differentiate"
            " jaxmuscle.objective.log_likelihood by the task: docs/own-muscle.md, Train it"
            for name, size in sizes.items()
            if size
        ]
    return tuple(dict.fromkeys(said))


def reach_notices(
    found: Mapping[str, Estimate], parts: Mapping[str, FittedPart]
) -> tuple[str, ...]:
    """The notice of a tangent stiffness, H(0), that is not what was measured at the lowest
    frequency of the motion."""
    said = []
    for name, p in found.items():
        if base_of(name) != "tangent_stiffness" or p.stderr is None:
            continue
        for part in (part for key, part in parts.items() if name.partition("@")[2] in ("", key)):
            # a reflex, too, changes what is seen there
            reflex = "reflex_gain" in part.task.parameter_names
            if part.stiffness is None or part.target.stiffness is None or reflex:
                continue
            known = part.target.stiffness.known
            seen = np.flatnonzero(np.abs(part.stiffness) > CLEAR * known.stderr)
            if not len(seen):
                continue
            lowest, there = float(known.frequency[seen[0]]), float(np.real(part.stiffness[seen[0]]))
            if abs(there - p.value) > EXTRAPOLATED * p.stderr:
                said.append(
                    f"{name} ({p.value:.4g} N/m) is extrapolated: the motion tells little below"
                    f" {lowest:.2g} Hz, where this muscle has {there:.4g} N/m. What it does at"
                    " lower frequencies follows from the fluctuations alone. What to do: report"
                    f" the stiffness at {lowest:.2g} Hz, or record once more with a slower motion"
                )
    return tuple(said)


def prior_notices(resting: Iterable[str]) -> tuple[str, ...]:
    """The notice of numbers that a wider prior moves."""
    names = ", ".join(n for n in resting if base_of(n) in {*LIMB, *TISSUES})
    if not names:
        return ()
    return (
        f"rests on the prior: {names}. With priors three times as wide this moves by more than half"
        " of its standard error. The interval is that with the wide priors: report it. What to do:"
        " move more, or record longer",
    )


def notices_of(
    target: Any, statistics: BinStatistics, check: dict[str, float | int], left: float, method: str
) -> tuple[str, ...]:
    """What has to be said of one target and its task."""
    notices = list(target.notices)
    if not statistics.known:
        notices.append(
            "the target states neither segments nor sigma, so every bin counts alike and there is"
            " no chi2"
        )
    if check.get("largest_deviation", 0.0) > NONLINEAR:
        corrected = "corrected" if "polish_turns" in check else "not corrected"
        notices.append(
            f"formula and simulation differ by up to {100 * check['largest_deviation']:.0f} % of a"
            " bin's power, so noise or harmonic are large here"
            + f". The fit is {corrected} for it. {BY_SIMULATION}"
            * (method == "linear")
        )
    if left > LEFT:
        notices.append(
            f"slow muscle: when the analysed part of a simulation begins, {100 * left:.1g} % of the"
            " start-up is still left. The fit assumes a settled muscle. To simulate that in"
            " Python, use task.settled()"
        )
    return tuple(notices)
