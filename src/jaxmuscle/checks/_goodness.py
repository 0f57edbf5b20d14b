"""Is the fit as good as the scatter of the data allows? Chi², runs and the largest residual, by bootstrap with refits."""

from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.environment import versions
from jaxmuscle._common.text import folded
from jaxmuscle.data._target import Target
from jaxmuscle.fits._reopened import taken_up
from jaxmuscle.fits._result import FitResult
from jaxmuscle.objective._consequences import seen_at
from jaxmuscle.objective._least_squares import descend
from jaxmuscle.objective._likelihood import LEAST, Likelihood, drawn_spectra, repeated
from jaxmuscle.objective._problem import Data, Problem, Setup, theta_of
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._bin_law import BinStatistics, bin_statistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


Rows = Float[np.ndarray, "rows bins"]
ELSEWHERE = 3
LINE_SHAPE = np.array([0.25, 1.0, 0.25])
SMALL_P, LARGE_P = 0.05, 0.975
CHECKS = ("chi2_per_bin", "runs", "largest")


def _p(value: float) -> str:
    return f"p = {value:.2g}"


def _check(result: FitResult, judged: Target) -> None:
    for of in (result.target, judged):
        if not bin_statistics(of).known:
            raise ValueError(f"{of.name}: states neither segments nor sigma, so nothing says how much it scatters: give "
                             "segments, the number of Welch segments that were averaged, or a sigma per bin")  # fmt: skip
    if judged.settings != result.target.settings or not np.array_equal(judged.bins, result.target.bins):
        raise ValueError(f"{judged.name}: other bins or spectrum settings than {result.target.name}, which was fitted")


def numbers_of(residuals: Rows) -> dict[str, Float[np.ndarray, " rows"]]:
    """The three numbers of every row."""
    return {
        "chi2_per_bin": np.sum(residuals**2, axis=1) / (residuals.shape[1] - 1),
        "runs": 1.0 + np.sum(np.diff(np.sign(residuals), axis=1) != 0, axis=1),
        "largest": np.max(np.abs(residuals), axis=1),
    }


def p_values(observed: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """How often a replicate is as extreme, `(1 + count) / (1 + replicates)`; "all": how often its smallest p is as small."""
    pooled = np.stack([np.append(observed[n], reference[n]) * (-1 if n == "runs" else 1) for n in CHECKS])
    each = np.stack([len(row) - np.searchsorted(np.sort(row), row) for row in pooled]) / pooled.shape[1]
    smallest = each.min(axis=0)
    return {n: float(p) for n, p in zip(CHECKS, each[:, 0], strict=True)} | {"all": float(np.mean(smallest <= smallest[0]))}


class Goodness(eqx.Module):
    """How a spectrum lies about the fit, against spectra drawn from the fit that were themselves fitted.

    `residual` z_k of every bin [standard deviations of its log power]; `observed` {chi2_per_bin, runs, largest}, each with
    its `reference` values of the replicates and `p_values`, and "all", the p-value of the smallest of the three;
    `residuals` of the replicates; `foretold`, whether the spectrum is another than the one fitted; `law` of the bins;
    `lost`, replicates whose refit was not finite; `seed`, `versions`.
    """

    target: Target
    residual: Float[np.ndarray, " bins"]
    observed: dict[str, float]
    reference: dict[str, Float[np.ndarray, " replicates"]]
    p_values: dict[str, float]
    residuals: Float[np.ndarray, "replicates bins"]
    foretold: bool
    law: str
    lost: int
    seed: int | None
    versions: dict[str, str] = eqx.field(default_factory=versions)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Each check in words, then the three together."""
        p, seen = self.p_values, self.observed
        thing = "prediction" if self.foretold else "fit"
        low, high = np.quantile(self.reference["chi2_per_bin"], [0.05, 0.95])
        chi2 = f"chi2 per bin {seen['chi2_per_bin']:.2f}, expected {low:.2f} to {high:.2f}, {_p(p['chi2_per_bin'])}"
        if p["chi2_per_bin"] < SMALL_P:
            first = f"the {thing} is worse than expected: {chi2}"
        elif p["chi2_per_bin"] > LARGE_P:
            first = f"the {thing} is better than it should be: {chi2}; more segments than stated, or a smoothed spectrum?"
        else:
            first = f"the {thing} is as good as expected: {chi2}"
        usual, runs = float(np.mean(self.reference["runs"])), f"{seen['runs']:.0f} runs of equal sign"
        if p["runs"] < SMALL_P:
            second = (f"the residuals have fewer runs than expected: {runs} where {usual:.1f} are usual, {_p(p['runs'])}; "
                      "something slow in frequency is missing")  # fmt: skip
        else:
            second = f"the residuals change sign as often as expected: {runs}, {usual:.1f} usual, {_p(p['runs'])}"
        worst = int(np.argmax(np.abs(self.residual)))
        place = f"{self.residual[worst]:+.1f} standard deviations at {self.target.frequency[worst]:.2f} Hz"
        if p["largest"] < SMALL_P:
            third = f"one bin stands out: {place}, {_p(p['largest'])}; a line or an artefact that the model does not have"
        else:
            third = f"no bin stands out: the largest residual is {place}, {_p(p['largest'])}"
        return first, second, third, f"all three together: {_p(p['all'])}"

    def __str__(self) -> str:
        done = "foretold by fits of" if self.foretold else "each fitted anew,"
        head = f"{self.target.name}: against {len(self.residuals)} spectra drawn from the fit, {done} {self.law} law"
        lines = [head]
        for sentence in self.sentences + ((f"{self.lost} refits were not finite and are left out",) if self.lost else ()):
            lines.append(f"- {sentence}")
        return folded(lines)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Residuals with what is usual in each bin, and the three checks with their reference distributions."""
        return plot.goodness(self, ax)


def goodness(result: FitResult, target: Target | None = None, *, replicates: int = 999, key: Array | int = 0) -> Goodness:
    """Whether a fit is as good as the scatter of its target allows, by parametric bootstrap with refits.

    Three numbers, from the residuals `z_k = (ln(p_k / fitted_k) - bias_k - mean) / sd_k`: chi² per bin
    `Σ z_k² / (bins - 1)`, the number of runs of equal sign (few: a smooth misfit), the largest |z_k| (a line). Their
    reference: spectra drawn from the law of the bins about the fitted spectrum (correlated gamma variables; with a sigma
    instead of segments Gaussian in the log), every one fitted by the whole nonlinear descent, from the fit's own values and
    from a harmonic in each of its three highest excesses. So the reference knows that a fit takes up some of the scatter,
    that a harmonic finds the highest of many bins, and that neighbouring bins correlate by 0.45. The runs test of Wald and
    Wolfowitz (1940) assumes independent signs; it would find too few runs in every good fit.

    **Arguments:** `result`; `target`, another spectrum of the same bins and settings that the fit is to have foretold (its
    reference: spectra drawn by its law, against fits of replicates of the fitted one); `replicates`; `key`, a `jax.random`
    key or a seed number.

    **Returns:** a `Goodness`. **Raises:** `ValueError` for a target without segments and sigma, other bins, a failed fit,
    a task without linear response, fewer than 19 replicates.
    """
    if replicates < 19:
        raise ValueError(f"replicates = {replicates} must be at least 19: with fewer no p-value can be as small as 0.05")
    judged = result.target if target is None else target
    _check(result, judged)
    with jax.enable_x64(True):
        setup = taken_up(result, key=key)
        drawn, moments = _drawn(setup, result, replicates)
        refits = refitted(setup, theta_of(setup, result.task), drawn)
        expected, share = refits.expected, refits.share
        power = drawn.power
        if target is not None:
            likelihood = Likelihood.of(taken_up(result, target, key=key))
            power = drawn_spectra(likelihood, target, moments, jax.random.fold_in(setup.key, 22))
    residual = residuals_of(judged.proportional_power[None], result.fitted[None], judged, result.harmonic_share[None])[0]
    kept = np.isfinite(refits.cost)
    if np.sum(kept) < 19:
        raise ValueError(f"{judged.name}: only {np.sum(kept)} of {replicates} refits are finite: fit again first")
    residuals = residuals_of(power[kept], expected[kept], judged, share[kept])
    observed, reference = numbers_of(residual[None]), numbers_of(residuals)
    return Goodness(
        judged,
        residual,
        {name: float(x[0]) for name, x in observed.items()},
        reference,
        p_values(observed, reference),
        residuals,
        target is not None,
        "gamma" if judged.segments is not None else "Gaussian",
        int(np.sum(~kept)),
        key if isinstance(key, int) else None,
    )


def residuals_of(power: Rows, expected: Rows, target: Target, share: Rows) -> Rows:
    """`(ln(p_k / E_k) - bias_k - mean) / sd_k` of every row, the line's share of its bins known."""
    bias, sd = _scatter(target, bin_statistics(target), share)
    z = np.log(power) - np.log(expected) - bias
    return (z - z.mean(axis=1, keepdims=True)) / sd


def _scatter(target: Target, statistics: BinStatistics, share: Rows) -> tuple[Rows, Rows]:
    """Bias and standard deviation of every row's log powers, as `bin_statistics` with that row's share of the line."""
    keep = np.maximum(1 - share**2, LEAST) if target.segments is not None else np.ones_like(share)
    return statistics.bias * keep, statistics.sd * np.sqrt(keep)


class Drawn(NamedTuple):
    """Spectra drawn from the fit, with the further data of a fit (log coefficient of variation, mean), if it has them."""

    power: Rows
    expected: Float[np.ndarray, " bins"]
    extra: tuple[Any, Any]


class Refits(NamedTuple):
    """Where every drawn spectrum's fit ended; `expected` proportional power, `share` of the line."""

    theta: Float[np.ndarray, "rows free"]
    cost: Float[np.ndarray, " rows"]
    expected: Rows
    share: Rows


def _drawn(setup: Setup, result: FitResult, count: int) -> tuple[Drawn, Moments]:
    keys = jax.random.split(jax.random.fold_in(setup.key, 21), 3)
    moments = repeated(setup, result.task, count)
    power = drawn_spectra(Likelihood.of(setup), setup.target, moments, keys[0])
    expected = moments.power[0] / np.sum(moments.power[0])

    def scattered(given: Any, values: np.ndarray, key: Array) -> Any:
        return (
            None
            if given is None
            else (values + given[1] * np.asarray(jax.random.normal(key, (count,))), np.full(count, float(given[1])))
        )

    variation, mean = setup.extra
    extra = scattered(variation, np.log(moments.variation), keys[1]), scattered(mean, np.asarray(moments.mean), keys[2])
    return Drawn(power, expected, extra), moments


def refitted(setup: Setup, theta: Float[np.ndarray, " free"], drawn: Drawn) -> Refits:
    """Every drawn spectrum fitted: all bins scattering alike first, then again with the line's share of each known."""
    problem, count = setup.linear(), len(drawn.power)
    starts = _starts(setup, theta, drawn)
    each = starts.shape[1]
    data = _data(problem, drawn, np.zeros_like(drawn.power), setup.target)
    first = descend(problem, setup.coordinates.from_theta(starts.reshape(count * each, -1)), 40,
                    data=jax.tree.map(lambda x: np.repeat(x, each, axis=0), data))  # fmt: skip
    cost = np.where(np.isfinite(first.cost), first.cost, np.inf).reshape(count, each)
    s = first.s.reshape(count, each, -1)[np.arange(count), np.argmin(cost, axis=1)]
    share = _seen_share(problem, s)[1]
    second = descend(problem, s, 40, data=_data(problem, drawn, share, setup.target))
    expected, share = _seen_share(problem, second.s)
    return Refits(np.asarray(problem.theta(second.s)), second.cost, expected, share)


def _starts(setup: Setup, theta: np.ndarray, drawn: Drawn) -> Float[np.ndarray, "rows starts free"]:
    """The fit's own values; and its harmonic, as strong as its prior has it, in the highest excesses of each spectrum."""
    names, c = setup.coordinates.names, setup.coordinates
    if "harmonic_frequency" not in names:
        return np.broadcast_to(theta, (len(drawn.power), 1, len(theta)))
    excess = np.log(drawn.power / drawn.expected)
    score = np.stack([np.convolve(row - row.mean(), LINE_SHAPE, "same") for row in excess])
    points = np.broadcast_to(theta, (len(score), 1 + ELSEWHERE, len(theta))).copy()
    frequency, n = np.asarray(setup.target.frequency), score.shape[1]
    for turn in range(1, 1 + ELSEWHERE):
        best = np.argmax(score, axis=1)
        points[:, turn, names.index("harmonic_frequency")] = c.theta_of("harmonic_frequency", frequency[best])
        if "harmonic_amplitude" in names:
            points[:, turn, names.index("harmonic_amplitude")] = 0.0
        score = np.where(np.abs(np.arange(n) - best[:, None]) <= 1, -np.inf, score)
    return points


def _data(problem: Problem, drawn: Drawn, share: Rows, target: Target) -> Data:
    bias, sd = _scatter(target, bin_statistics(target), share)
    sigma = np.broadcast_to(np.asarray(problem.data.sigma), (len(drawn.power), *np.shape(problem.data.sigma)))
    return Data(drawn.power, bias, sd, sigma, drawn.extra)


def _seen_share(problem: Problem, s: np.ndarray) -> tuple[Rows, Rows]:
    moments = seen_at(problem, np.asarray(problem.theta(s))).moments
    power = np.asarray(moments.power)
    share = np.clip(np.nan_to_num(np.asarray(moments.line) / power), 0.0, 1.0)
    return power / power.sum(axis=1, keepdims=True), share
