"""Is the fit as good as the scatter of the data allows? Chi², runs and largest residuals, by
bootstrap with refits."""

from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax import Array
from jaxtyping import Complex, Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import fitting, versions
from jaxmuscle._common.keys import number_of
from jaxmuscle._common.parts import of_only, only
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import folded, probability
from jaxmuscle._common.types import Key
from jaxmuscle.data._target import Target
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.fits._result import FitResult, FittedPart
from jaxmuscle.objective._consequences import expand
from jaxmuscle.objective._least_squares import least_squares
from jaxmuscle.objective._likelihood import Likelihood, drawn_spectra, repeated, require_spread
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.objective._residuals import Data, Residuals
from jaxmuscle.objective._starts import amplitude_columns, frequency_names
from jaxmuscle.response._expected import Moments
from jaxmuscle.spectra._bin_law import bin_statistics

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


Rows = Float[np.ndarray, "rows bins"]
ELSEWHERE = 3
LINE_SHAPE = np.array([0.25, 1.0, 0.25])


class Drawn(NamedTuple):
    """Of every part: spectra drawn from the fit, what they scatter about, and their further data
    (None without)."""

    power: tuple[Rows, ...]
    expected: tuple[Float[np.ndarray, " bins"], ...]
    variation: tuple[Any, ...]
    mean: tuple[Any, ...]
    stiffness: tuple[Any, ...]


class Refits(NamedTuple):
    """Where every drawn set's fit ended; of every part the `expected` proportional power, the
    `share` of the line, and the `stiffness` at the points of a measured one, real and imaginary
    part along the second axis."""

    theta: Float[np.ndarray, "rows free"]
    cost: Float[np.ndarray, " rows"]
    expected: tuple[Rows, ...]
    share: tuple[Rows, ...]
    stiffness: tuple[Any, ...]


def drawn_about(
    problem: FitProblem, result: FitResult, count: int
) -> tuple[Drawn, tuple[Moments, ...]]:
    moments = repeated(problem, tuple(result.tasks.values()), count)
    found = []
    for i, (part, bins, seen) in enumerate(
        zip(problem.parts, Likelihood.of(problem).bins, moments, strict=True)
    ):
        key = jax.random.fold_in(problem.key, 21)
        key = jax.random.fold_in(key, i) if i else key
        keys = jax.random.split(key, 3)

        def scattered(given: Any, values: np.ndarray, key: Array) -> Any:
            if given is None:
                return None
            return values + given[1] * np.asarray(jax.random.normal(key, (count,))), np.full(
                count, float(given[1])
            )

        power = drawn_spectra(bins, part.target, seen, keys[0])
        variation = scattered(part.variation, np.log(seen.variation), keys[1])
        mean = scattered(part.mean, np.asarray(seen.mean), keys[2])
        stiffness = None
        if part.target.stiffness is not None:
            sd = np.tile(part.target.stiffness.known.stderr, (count, 1))
            normal = np.asarray(
                jax.random.normal(jax.random.fold_in(key, 3), np.shape(seen.stiffness))
            )
            stiffness = np.asarray(seen.stiffness) + sd[:, None] * normal, sd
        found.append((power, seen.power[0] / np.sum(seen.power[0]), variation, mean, stiffness))
    return Drawn(*zip(*found, strict=True)), moments


def refitted(problem: FitProblem, theta: Float[np.ndarray, " free"], drawn: Drawn) -> Refits:
    """Every drawn set fitted: all bins scattering alike first, then again with the line's share of
    each known."""
    objective, count = problem.linear(), len(drawn.power[0])
    starts = _starts(problem, theta, drawn)
    each = starts.shape[1]
    data = _data(problem, drawn, tuple(np.zeros_like(power) for power in drawn.power))
    first = least_squares(
        objective,
        problem.coordinates.from_theta(starts.reshape(count * each, -1)),
        40,
        data=jax.tree.map(lambda x: np.repeat(x, each, axis=0), data),
    )
    cost = np.where(np.isfinite(first.cost), first.cost, np.inf).reshape(count, each)
    s = first.s.reshape(count, each, -1)[np.arange(count), np.argmin(cost, axis=1)]
    share = _seen(objective, s)[1]
    second = least_squares(objective, s, 40, data=_data(problem, drawn, share))
    return Refits(np.asarray(objective.theta(second.s)), second.cost, *_seen(objective, second.s))


def _starts(
    problem: FitProblem, theta: np.ndarray, drawn: Drawn
) -> Float[np.ndarray, "rows starts free"]:
    """The fit's own values; and each harmonic, as strong as its prior has it, in the highest
    excesses of each spectrum."""
    c, count = problem.coordinates, len(drawn.power[0])
    starts = [np.broadcast_to(theta, (count, len(theta)))]
    for name in frequency_names(c):
        strengths = amplitude_columns(c.names, name)
        for part, power, expected in zip(problem.parts, drawn.power, drawn.expected, strict=True):
            if c.names.index(name) not in part.columns:
                continue
            excess = np.log(power / expected)
            score = np.stack([np.convolve(row - row.mean(), LINE_SHAPE, "same") for row in excess])
            for _ in range(ELSEWHERE):
                best, points = np.argmax(score, axis=1), np.array(starts[0])
                points[:, c.names.index(name)] = c.theta_of(
                    name, np.asarray(part.target.frequency)[best]
                )
                points[:, strengths] = 0.0
                starts.append(points)
                score = np.where(
                    np.abs(np.arange(score.shape[1]) - best[:, None]) <= 1, -np.inf, score
                )
    return np.stack(starts, axis=1)


def _data(problem: FitProblem, drawn: Drawn, share: tuple[Rows, ...]) -> tuple[Data, ...]:
    made = []
    for i, part in enumerate(problem.parts):
        law = bin_statistics(part.target, share[i])
        made.append(
            Data(
                drawn.power[i],
                law.bias,
                law.sd,
                drawn.variation[i],
                drawn.mean[i],
                drawn.stiffness[i],
            )
        )
    return tuple(made)


def _seen(
    objective: Residuals, s: np.ndarray
) -> tuple[tuple[Rows, ...], tuple[Rows, ...], tuple[Any, ...]]:
    """Of every part, at every row of coordinates: proportional power, share of the line, dynamic
    stiffness."""
    moments = expand(objective, np.asarray(objective.theta(s))).moments
    power = [np.asarray(m.power) for m in moments]
    share = tuple(
        np.clip(np.nan_to_num(np.asarray(m.line) / p), 0.0, 1.0)
        for m, p in zip(moments, power, strict=True)
    )
    whole = tuple(p / p.sum(axis=1, keepdims=True) for p in power)
    return whole, share, tuple(np.asarray(m.stiffness) for m in moments)


SMALL_P, LARGE_P = 0.05, 0.975
COUNTED = {2: "both", 3: "all three", 5: "all five"}


def _check(result: FitResult, judged: Target | None) -> None:
    for of in (*result.targets.values(), *([] if judged is None else [judged])):
        require_spread(of)
    if judged is None:
        return
    fitted = result.target
    if judged.settings != fitted.settings or not np.array_equal(judged.bins, fitted.bins):
        raise ValueError(
            f"{judged.name}: other bins or spectrum settings than {fitted.name}, which was fitted"
        )


def numbers_of(residuals: Rows) -> dict[str, Float[np.ndarray, " rows"]]:
    """The three numbers of every row of a spectrum's residuals."""
    return {
        "chi2_per_bin": np.sum(residuals**2, axis=1) / (residuals.shape[1] - 1),
        "runs": 1.0 + np.sum(np.diff(np.sign(residuals), axis=1) != 0, axis=1),
        "largest": np.max(np.abs(residuals), axis=1),
    }


def numbers_at_points(
    residuals: Complex[np.ndarray, "rows points"],
) -> dict[str, Float[np.ndarray, " rows"]]:
    """The two numbers of every row of a dynamic stiffness's residuals."""
    size = np.abs(residuals)
    return {"chi2_per_point": np.mean(size**2, axis=1) / 2, "largest_point": np.max(size, axis=1)}


def p_values(observed: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> dict[str, float]:
    """How often a replicate is as extreme, `(1 + count) / (1 + replicates)`; "all": how often its
    smallest p is as small.

    Of runs few are extreme, of all else much.
    """
    pooled = np.stack(
        [
            np.append(observed[n], reference[n]) * (-1 if n.startswith("runs") else 1)
            for n in observed
        ]
    )
    each = (
        np.stack([len(row) - np.searchsorted(np.sort(row), row) for row in pooled])
        / pooled.shape[1]
    )
    smallest = each.min(axis=0)
    return {n: float(p) for n, p in zip(observed, each[:, 0], strict=True)} | {
        "all": float(np.mean(smallest <= smallest[0]))
    }


class GoodnessPart(Printed, Result, eqx.Module):
    """How the data of one target lie about the fit, against data drawn from the fit that were
    themselves fitted.

    `residual` z_k of every bin [standard deviations of its log power]; `stiffness_residual` of
    every point of a dynamic stiffness, complex [standard errors]; `observed`, the numbers of
    `goodness` by name, each with its `reference` values of the replicates and `p_values`, and
    "all", the p-value of the smallest of them; `residuals` and `stiffness_residuals` of the
    replicates; `foretold`, whether the spectrum is another than the one fitted; `law` of the bins.
    A target without spectrum has no bins; one without dynamic stiffness, or a foretold one, no
    points.
    """

    target: Target
    residual: Float[np.ndarray, " bins"]
    observed: dict[str, float]
    reference: dict[str, Float[np.ndarray, " replicates"]]
    p_values: dict[str, float]
    residuals: Float[np.ndarray, "replicates bins"]
    foretold: bool
    law: str
    stiffness_residual: Complex[np.ndarray, " points"]
    stiffness_residuals: Complex[np.ndarray, "replicates points"]

    @property
    def sentences(self) -> tuple[str, ...]:
        """Each check in words, then all together."""
        said = (
            *(self._of_spectrum() if self.residual.size else ()),
            *(self._of_stiffness() if self._points else ()),
        )
        return (*said, f"{COUNTED[len(said)]} together: {probability(self.p_values['all'])}")

    @property
    def _points(self) -> int:
        return len(self.stiffness_residual)

    def _chi2(self, name: str, worse: str, usual: str, better: str, why: str) -> str:
        """The chi² of bins or points in words."""
        p, (low, high) = self.p_values[name], np.quantile(self.reference[name], [0.05, 0.95])
        said = (
            f"{name.replace('_', ' ')} {self.observed[name]:.2f}, expected {low:.2f} to {high:.2f},"
            f" {probability(p)}"
        )
        if p > LARGE_P:
            return f"{better}: {said}; {why}"
        return f"{worse if p < SMALL_P else usual}: {said}"

    def _of_stiffness(self) -> tuple[str, str]:
        p = self.p_values
        first = self._chi2(
            "chi2_per_point",
            "the dynamic stiffness is further from the fit than expected",
            "the dynamic stiffness is as near to the fit as expected",
            "the dynamic stiffness is nearer to the fit than it should be",
            "are its errors too large?",
        )
        measured, size = self.target.stiffness, np.abs(self.stiffness_residual)
        assert measured is not None  # or it would have no residuals
        worst = int(np.argmax(size))
        place = f"{size[worst]:.1f} standard errors at {measured.known.frequency[worst]:.2f} Hz"
        if p["largest_point"] < SMALL_P:
            return (
                first,
                f"one point stands out: it is off by {place}, {probability(p['largest_point'])}",
            )
        return (
            first,
            (
                f"no point stands out: the largest distance is {place},"
                f" {probability(p['largest_point'])}"
            ),
        )

    def _of_spectrum(self) -> tuple[str, str, str]:
        p, seen = self.p_values, self.observed
        thing = "prediction" if self.foretold else "fit of the spectrum" if self._points else "fit"
        said = {name: probability(value) for name, value in p.items()}
        first = self._chi2(
            "chi2_per_bin",
            f"the {thing} is worse than expected",
            f"the {thing} is as good as expected",
            f"the {thing} is better than it should be",
            "was the spectrum made of more segments than stated, or smoothed?",
        )
        usual, runs = (
            float(np.mean(self.reference["runs"])),
            f"{seen['runs']:.0f} runs of equal sign",
        )
        if p["runs"] < SMALL_P:
            second = (
                f"the residuals have fewer runs than expected: {runs} where {usual:.1f} are usual,"
                f" {said['runs']}; the {thing} is too high or too low over whole ranges of"
                " frequency"
            )
        else:
            second = (
                f"the residuals change sign as often as expected: {runs}, {usual:.1f} usual,"
                f" {said['runs']}"
            )
        worst = int(np.argmax(np.abs(self.residual)))
        place = (
            f"{self.residual[worst]:+.1f} standard deviations at"
            f" {self.target.frequency[worst]:.2f} Hz"
        )
        if p["largest"] < SMALL_P:
            third = (
                f"one bin stands out: {place}, {said['largest']}; a line or an artefact that the"
                " model does not have"
            )
        else:
            third = f"no bin stands out: the largest residual is {place}, {said['largest']}"
        return first, second, third

    def __str__(self) -> str:
        done = "predicted by fits of simulated data" if self.foretold else "fitted again"
        count, scatter = (
            len(next(iter(self.reference.values()))),
            "bins" if self.law == "gamma" else "logarithms of bins",
        )
        law = f" ({scatter} scatter by a {self.law} distribution)" * bool(self.residual.size)
        what = " and ".join(
            ["spectra"] * bool(self.residual.size) + ["dynamic stiffnesses"] * bool(self._points)
        )
        head = (
            f"{self.target.name}: compared with {count} {what} that were drawn from the fit and"
            f" {done}{law}"
        )
        return folded([head, *(f"- {sentence}" for sentence in self.sentences)])


class Goodness(Printed, Result, eqx.Module):
    """Whether a fit is as good as the scatter of its data allows.

    `parts`, a `GoodnessPart` for each target by name; `p_value`, that of the smallest p-value of
    all checks of all targets; `lost`, replicates whose refit was not finite; `seed`, `versions`. A
    `Goodness` of one target has what its part has: `residual`, `observed`, `p_values` and so on.
    """

    parts: dict[str, GoodnessPart]
    p_value: float
    lost: int
    seed: int | None
    versions: dict[str, str] = eqx.field(default_factory=versions)

    @property
    def only(self) -> GoodnessPart:
        """The part of a fit of one target. Raises `AttributeError` where there are several."""
        return only(self.parts, "goodness")

    target = of_only("target", "The target.")
    residual = of_only("residual", "Residual of every bin.")
    observed = of_only("observed", "The numbers of every check.")
    reference = of_only("reference", "The numbers of the replicates.")
    p_values = of_only("p_values", "p-value of each number and of all.")
    residuals = of_only("residuals", "Residuals of the replicates.")
    stiffness_residual = of_only(
        "stiffness_residual", "Residual of every point of the dynamic stiffness."
    )
    stiffness_residuals = of_only("stiffness_residuals", "The same of the replicates.")
    law = of_only("law", "Law of the bins.")
    sentences = of_only("sentences", "Each check in words, then all together.")

    @property
    def foretold(self) -> bool:
        """Whether the spectrum is another than the one fitted."""
        return next(iter(self.parts.values())).foretold

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each target and check: `target`, `check`, `observed`, `usual` (mean of the
        replicates), `p_value`."""
        return frame(
            [
                {
                    "target": name,
                    "check": check,
                    "observed": value,
                    "usual": float(np.mean(part.reference[check])),
                    "p_value": part.p_values[check],
                }
                for name, part in self.parts.items()
                for check, value in part.observed.items()
            ]
        )

    def __str__(self) -> str:
        lines = [str(part) for part in self.parts.values()]
        if len(self.parts) > 1:
            lines.append(f"all targets together: {probability(self.p_value)}")
        return "\n".join(
            lines + [f"- {self.lost} refits were not finite and are left out"] * bool(self.lost)
        )

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Residuals with what is usual in each bin, and the three checks with their reference
        distributions."""
        return plot.goodness(self, ax)


def goodness(
    result: FitResult, target: Target | None = None, *, replicates: int = 999, key: Key = 0
) -> Goodness:
    """Whether a fit is as good as the scatter of its target allows, by parametric bootstrap with
    refits.

        result = jm.fit(target.task(), target)
        print(jm.checks.goodness(result))

    Three numbers, from the residuals `z_k = (ln(p_k / fitted_k) - bias_k - mean) / sd_k`: chi² per
    bin `Σ z_k² / (bins - 1)`, the number of runs of equal sign (few: a smooth misfit), the largest
    |z_k| (a line). Their reference: spectra drawn from the law of the bins about the fitted
    spectrum (correlated gamma variables; with a sigma instead of segments Gaussian in the log),
    every one fitted by the whole nonlinear descent, from the fit's own values and from a harmonic
    in each of its three highest excesses. So the reference knows that a fit takes up some of the
    scatter, that a harmonic finds the highest of many bins, and that neighbouring bins correlate by
    0.45. The runs test of Wald and Wolfowitz (1940) assumes independent signs; it would find too
    few runs in every good fit.

    A target with a dynamic stiffness H(f) adds two numbers, from `r = (H - fitted) / stderr` of
    every point: chi² per point `Σ |r|² / (2 points)`, and the largest |r|. Its replicates scatter
    by the stated standard errors about the fitted H.

    **Arguments:**

    - `result`: what `fit` returns
    - `target`: another spectrum of the same bins and settings that the fit is to have foretold (its
      reference: spectra drawn by its law, against fits of replicates of the fitted one)
    - `replicates`: how many data sets are drawn and fitted, at least 19
    - `key`: a `jax.random` key or a seed number

    **Returns:** a `Goodness`. **Raises:** `ValueError` for a target without segments and sigma,
    other bins, a failed fit, a task without linear response, fewer than 19 replicates.
    """
    if replicates < 19:
        raise ValueError(
            f"replicates = {replicates} must be at least 19: with fewer no p-value can be as small"
            " as 0.05"
        )
    _check(result, target)
    with fitting():
        problem = reopened(result, key=key)
        drawn, moments = drawn_about(problem, result, replicates)
        refits = refitted(problem, problem.theta_of(tuple(result.tasks.values())), drawn)
        power = drawn.power
        if target is not None:
            (bins,) = Likelihood.of(reopened(result, target, key=key)).bins
            power = (drawn_spectra(bins, target, moments[0], jax.random.fold_in(problem.key, 22)),)
    kept = np.isfinite(refits.cost)
    if np.sum(kept) < 19:
        raise ValueError(
            f"{result.title}: only {np.sum(kept)} of {replicates} refits are finite: fit again"
            " first"
        )
    parts = {}
    for i, (name, fitted) in enumerate(result.parts.items()):
        judged = fitted.target if target is None else target
        residual = residuals_of(
            judged.proportional_power[None],
            fitted.fitted[None],
            judged,
            fitted.harmonic_share[None],
        )
        residuals = residuals_of(
            power[i][kept], refits.expected[i][kept], judged, refits.share[i][kept]
        )
        off, offs = _at_points(
            fitted if target is None else None, drawn.stiffness[i], refits.stiffness[i], kept
        )
        observed, reference = {}, {}
        if residual.size:
            observed, reference = numbers_of(residual), numbers_of(residuals)
        if off.size:
            observed, reference = (
                observed | numbers_at_points(off),
                reference | numbers_at_points(offs),
            )
        law = "gamma" if judged.segments is not None else "Gaussian"
        parts[name] = GoodnessPart(
            judged,
            residual[0],
            {n: float(x[0]) for n, x in observed.items()},
            reference,
            p_values(observed, reference),
            residuals,
            target is not None,
            law,
            off[0],
            offs,
        )
    observed = {
        f"{n}@{name}": np.array([x])
        for name, part in parts.items()
        for n, x in part.observed.items()
    }
    reference = {
        f"{n}@{name}": x for name, part in parts.items() for n, x in part.reference.items()
    }
    together = p_values(observed, reference)["all"]
    return Goodness(parts, together, int(np.sum(~kept)), number_of(key))


def _at_points(
    fitted: FittedPart | None, drawn: Any, refitted: Any, kept: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Complex residuals of a dynamic stiffness in standard errors, and those of its replicates; of
    no points without one."""
    own = None if fitted is None else fitted.stiffness_residual
    if own is None:
        return np.zeros((1, 0), complex), np.zeros((int(np.sum(kept)), 0), complex)
    value, sd = drawn
    parts = (value - refitted)[kept]
    return own[None], (parts[:, 0] + 1j * parts[:, 1]) / sd[kept]


def residuals_of(power: Rows, expected: Rows, target: Target, share: Rows) -> Rows:
    """`(ln(p_k / E_k) - bias_k - mean) / sd_k` of every row, the line's share of its bins known."""
    if not power.size:
        return power
    law = bin_statistics(target, share)
    z = np.log(power) - np.log(expected) - law.bias
    return (z - z.mean(axis=1, keepdims=True)) / law.sd
