"""May a posterior be believed? Mixing of its chains, and spectra that it predicts for another
measurement."""

import itertools
from typing import Any, NamedTuple

import numpy as np
from jax import Array
from jaxtyping import Float

from jaxmuscle.data._target import Target
from jaxmuscle.objective._likelihood import Bins, drawn_spectra
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._bin_law import BinStatistics, bin_statistics, standardised

from ._chains import Chains


class Replicates(NamedTuple):
    """`expected` and `power`: proportional powers of the model and of a spectrum drawn about it;
    `chi2` of the measured spectrum and `chi2_drawn` of the drawn one about the same model;
    `p_value`, how often the drawn one is further away.
    """

    expected: Float[np.ndarray, "*draws bins"]
    power: Float[np.ndarray, "*draws bins"]
    chi2: Float[np.ndarray, "*draws"]
    chi2_drawn: Float[np.ndarray, "*draws"]

    @property
    def p_value(self) -> float:
        """Posterior-predictive p-value (Gelman, Meng & Stern 1996)."""
        return float(np.mean(self.chi2_drawn >= self.chi2))


def chi2_of(
    power: Float[np.ndarray, "rows bins"], moments: Moments, statistics: BinStatistics
) -> Float[np.ndarray, " rows"]:
    """`Σ (z_k - z̄)² / variance_k / (bins - 1)` of every row about its own model."""
    expected = np.asarray(moments.power)
    z = np.stack(
        [standardised(p, e / e.sum(), statistics) for p, e in zip(power, expected, strict=True)]
    )
    return np.sum(z**2, axis=1) / (z.shape[1] - 1)


def replicates(
    bins: Bins | None, target: Target, moments: Moments, shape: tuple[int, ...], key: Array
) -> Replicates:
    """One spectrum drawn for every row of moments; results have the given leading shape."""
    drawn = drawn_spectra(bins, target, moments, key)
    statistics = bin_statistics(target)
    measured = np.broadcast_to(target.proportional_power, drawn.shape)
    power = np.asarray(moments.power)
    expected = power / power.sum(axis=-1, keepdims=True)
    found = chi2_of(measured, moments, statistics), chi2_of(drawn, moments, statistics)
    whole = (*shape, power.shape[-1])
    return Replicates(
        expected.reshape(whole), drawn.reshape(whole), *(x.reshape(shape) for x in found)
    )


MIXED, NEARLY = 1.01, 1.05
EFFECTIVE = 100  # draws of each chain
DIVERGING = 0.002
LEAST_MODE = 0.05
TAILS = (0.05, 0.95)


def diagnose(draws: np.ndarray) -> tuple[float, float, float]:
    from arviz_stats.base.array import array_stats

    if np.ptp(draws) <= 1e-12 * np.abs(draws).max():
        return 1.0, float(draws.size), float(draws.size)
    parts: list[Any] = [
        array_stats.rhat(draws),
        array_stats.ess(draws),
        array_stats.ess(draws, method="tail", prob=TAILS),
    ]
    r_hat, bulk, tail = (float(x) for x in parts)
    return r_hat, bulk, tail


def verdict(found: Chains, diagnostics: dict, determined: tuple[str, ...]) -> tuple[bool, str]:
    """Whether the chains mixed, and the sentence that says so.

    R-hat at most 1.01 for what the data determine, 1.05 for the rest; an effective sample size of
    100 for each chain; at most two divergences in a thousand draws.
    """
    count = len(found.log_density)
    advice = (
        "draw longer chains (--draws, --warmup), or fit again with fewer free parameters (--fix)"
    )
    for names, most in ((determined, MIXED), (tuple(diagnostics), NEARLY)):
        worst = max(names, key=lambda n: diagnostics[n][0], default=None)
        if worst is not None and not diagnostics[worst][0] <= most:
            r_hat = diagnostics[worst][0]
            return (
                False,
                f"the chains did not mix: R-hat of {worst} is {r_hat:.3f}, above {most}; {advice}",
            )
    least = min(diagnostics, key=lambda n: min(diagnostics[n][1:]))
    size = min(diagnostics[least][1:])
    r_hat = max(d[0] for d in diagnostics.values())
    if not size >= EFFECTIVE * count:
        return (
            False,
            (
                f"the chains did not mix: {least} has an effective sample size of {size:.0f}, below"
                f" {EFFECTIVE * count}; {advice}"
            ),
        )
    if diverges(found):
        return (
            False,
            (
                f"{int(found.diverging.sum())} of {found.diverging.size} draws diverged, so parts"
                " of the posterior were not reached: fit again with fewer free parameters (--fix),"
                " or in Python with tighter priors or bounds"
            ),
        )
    return (
        True,
        f"the chains mixed: R-hat at most {r_hat:.3f}, effective sample size at least {size:.0f}",
    )


def diverges(found: Chains) -> bool:
    """Whether more than two draws in a thousand diverged: longer chains do not mend that."""
    return float(found.diverging.mean()) > DIVERGING


def modes_of(frequency: np.ndarray) -> tuple[tuple[float, float, float, float], ...]:
    """Intervals of the harmonic's frequency that low density separates, likeliest first: (from,
    median, to, probability)."""
    import scipy.stats

    logs = np.log(frequency)
    grid = np.linspace(logs.min(), logs.max(), 512)
    density = scipy.stats.gaussian_kde(logs, 0.08)(grid)
    low = np.flatnonzero((density[1:-1] < density[:-2]) & (density[1:-1] <= density[2:])) + 1
    peaks = [density[a : b + 1].max() for a, b in zip([0, *low], [*low, 511], strict=True)]
    # A dip separates modes if it is below half of the lower of the peaks beside it.
    cuts: list[float] = []
    highest = peaks[0]
    for i, dip in enumerate(low):
        if density[dip] < 0.5 * min(highest, max(peaks[i + 1 :])):
            cuts.append(float(np.exp(grid[dip])))
            highest = peaks[i + 1]
        else:
            highest = max(highest, peaks[i + 1])
    edges = [0.0, *cuts, np.inf]
    parts = [frequency[(frequency >= a) & (frequency < b)] for a, b in itertools.pairwise(edges)]
    found = [
        (float(p.min()), float(np.median(p)), float(p.max()), len(p) / len(frequency))
        for p in parts
        if len(p)
    ]
    return tuple(sorted((m for m in found if m[3] >= LEAST_MODE), key=lambda m: -m[3]))
