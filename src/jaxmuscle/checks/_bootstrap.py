"""Do the stated errors hold? Recordings simulated from the fit, nonlinearly, and fitted again."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import fitting, versions
from jaxmuscle._common.executors import AnyExecutor
from jaxmuscle._common.files import nulled, write_json
from jaxmuscle._common.keys import number_of
from jaxmuscle._common.progress import told
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import folded
from jaxmuscle._common.types import Key
from jaxmuscle.fits._reopened import reopened
from jaxmuscle.fits._result import FitResult
from jaxmuscle.fits._search import search_in_blocks
from jaxmuscle.objective._arguments import Plan, base_of, settings_of
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._likelihood import require_spread
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.spectra._fluctuations import BANDS

from ._replicates import Made, replicates_of, with_data

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


FORMAT = 1
REACH = float(scipy.stats.norm.ppf(0.975))
DOUBT = 0.01
COLUMNS = (
    "unit",
    "true",
    "stated",
    "spread",
    "ratio",
    "ratio_stderr",
    "core",
    "bias",
    "bias_stderr",
    "coverage",
)


class Recovery(eqx.Module):
    """One quantity: the value `true` simulated from, the standard error `stated` by the fit,
    `values` that refits found with the errors `stderrs` they state (NaN where a refit states
    none)."""

    name: str
    unit: str
    true: float
    stated: float
    values: Float[np.ndarray, " refits"]
    stderrs: Float[np.ndarray, " refits"]

    @property
    def spread(self) -> float:
        """Standard deviation of the refits."""
        return float(np.std(self.values, ddof=1))

    @property
    def ratio(self) -> float:
        """Spread over stated error; 1 where that holds."""
        return self.spread / self.stated

    @property
    def ratio_stderr(self) -> float:
        """`ratio / √(2 (n - 1))`, for refits that scatter normally."""
        return self.ratio / math.sqrt(2 * (len(self.values) - 1))

    @property
    def core(self) -> float:
        """Half the width of the middle 68.3 % of the refits over the stated error: the ratio
        without its tails."""
        low, high = np.quantile(self.values, scipy.stats.norm.cdf([-1.0, 1.0]))
        return float(high - low) / 2 / self.stated

    @property
    def bias(self) -> float:
        """Mean of the refits less the true value."""
        return float(np.mean(self.values) - self.true)

    @property
    def bias_stderr(self) -> float:
        """Standard error of the bias."""
        return self.spread / math.sqrt(len(self.values))

    @property
    def inside(self) -> tuple[int, int]:
        """Refits whose 95 % interval holds the true value, and those that state one."""
        known = np.isfinite(self.stderrs)
        near = np.abs(self.values[known] - self.true) <= REACH * self.stderrs[known]
        return int(np.sum(near)), int(np.sum(known))

    @property
    def coverage(self) -> float:
        """Their share; NaN where no refit states an interval."""
        near, known = self.inside
        return near / known if known else math.nan

    @property
    def places(self) -> Float[np.ndarray, " intervals"]:
        """Where the true value lies in each refit's own normal law: its probability below the value
        that was simulated."""
        known = np.isfinite(self.stderrs) & (self.stderrs > 0)
        return scipy.stats.norm.cdf((self.true - self.values[known]) / self.stderrs[known])

    @property
    def verdict(self) -> str:
        """Whether the error holds, judged at 1 % by the χ² law of the spread and the binomial one
        of the coverage."""
        squares = (len(self.values) - 1) * self.ratio**2
        above = scipy.stats.chi2.sf(squares, len(self.values) - 1)
        near, known = self.inside
        rare = scipy.stats.binom.cdf(near, known, 0.95) if known else 1.0
        if above < DOUBT / 2:
            return "error too small"
        if 1 - above < DOUBT / 2:
            return "error too large"
        if rare < DOUBT:
            return "intervals miss"
        return "holds"


class Bootstrap(Printed, Result, eqx.Module):
    """What refits of data made from a fit found.

    `quantities` {name: `Recovery`}, those that the fit determines: of each the value `true`
    simulated from, the standard error `stated` by the fit, the `values` that refits found and the
    errors `stderrs` that these state; `replicates` asked for; `failed` {replicate: why it was not
    simulated or fitted}; `source`, how the data were made; `tasks` {target: the fitted task from
    which its data were made}; `target`, name of what was fitted; `seed`; `versions`.
    """

    target: str
    tasks: dict[str, Any]
    quantities: dict[str, Recovery]
    replicates: int
    failed: dict[int, str]
    source: str
    seed: int | None
    versions: dict[str, str] = eqx.field(default_factory=versions)

    @property
    def success(self) -> bool:
        """Whether every replicate was fitted and every stated error holds."""
        return (
            not self.failed
            and bool(self.quantities)
            and all(q.verdict == "holds" for q in self.quantities.values())
        )

    def table(self) -> list[dict[str, Any]]:
        """Tidy rows, one per quantity."""
        return [
            {
                "quantity": q.name,
                **{name: getattr(q, name) for name in COLUMNS},
                "intervals": q.inside[1],
                "refits": len(q.values),
                "verdict": q.verdict,
            }
            for q in self.quantities.values()
        ]

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows of `table`."""
        return frame(self.table())

    @property
    def sentences(self) -> tuple[str, ...]:
        """Whether the stated errors hold, and what is off, in words."""
        done = self.replicates - len(self.failed)
        said = []
        off = {
            verdict: [q.name for q in self.quantities.values() if q.verdict == verdict]
            for verdict in ("error too small", "error too large", "intervals miss")
        }
        holding = len(self.quantities) - sum(map(len, off.values()))
        if self.quantities and holding == len(self.quantities):
            said.append(f"the stated errors hold, as far as {done} refits can tell")
        elif self.quantities:
            said.append(
                f"the stated errors hold for {holding} of {len(self.quantities)} quantities"
            )
        words = {
            "error too small": "refits scatter more than the fit states",
            "error too large": "refits scatter less than the fit states",
            "intervals miss": "the 95 % intervals of the refits hold the true value too seldom",
        }
        said += [f"{words[verdict]}: {', '.join(names)}" for verdict, names in off.items() if names]
        tails = [
            f"{q.name} ({q.core:.2f})"
            for q in self.quantities.values()
            if q.verdict == "error too small" and q.core < 1 + (q.ratio - 1) / 2
        ]
        if tails:
            said.append(
                "the large scatter comes mostly from a few outlying refits. Without them (middle"
                f" 68 %), spread over stated error: {', '.join(tails)}"
            )
        biased = [
            q.name
            for q in self.quantities.values()
            if abs(q.bias) > max(0.5 * q.stated, 3 * q.bias_stderr)
        ]
        if biased:
            said.append(f"off by more than half a standard error on average: {', '.join(biased)}")
        silent = [
            f"{q.name} ({len(q.values) - q.inside[1]})"
            for q in self.quantities.values()
            if q.inside[1] < len(q.values)
        ]
        if silent:
            said.append(
                "refits whose own data do not determine the quantity state no interval:"
                f" {', '.join(silent)}"
            )
        if self.failed:
            first = next(iter(self.failed.items()))
            said.append(
                f"{len(self.failed)} of {self.replicates} failed and are not in the table;"
                f" replicate {first[0]}: {first[1]}"
            )
        return (*said, self.source)

    def __str__(self) -> str:
        done = self.replicates - len(self.failed)
        lines = [f"{self.target}: {done} refits of data made from the fit"]
        wide = max([24, *map(len, self.quantities)])
        lines.append(
            f"  {'':<{wide}} {'true':>8} {'stated':>7} {'spread/stated':>13} {'bias':>7}"
            f" {'in 95 %':>7}"
        )
        for q in self.quantities.values():
            share = "-" if math.isnan(q.coverage) else f"{100 * q.coverage:.0f} %"
            mark = "" if q.verdict == "holds" else "*"
            lines.append(
                f"  {q.name:<{wide}} {q.true:>8.4g} {q.stated:>7.2g} {q.ratio:>6.2f} ±"
                f" {q.ratio_stderr:<4.2f} {q.bias:>7.1g} {share:>7}{mark}"
            )
        return "\n".join([*lines, folded(f"- {sentence}" for sentence in self.sentences)])

    def save(self, path: str | Path) -> None:
        """Write everything but the task as JSON, atomically."""
        table = {
            "format": FORMAT,
            "target": self.target,
            "source": self.source,
            "replicates": self.replicates,
            "failed": {str(number): why for number, why in self.failed.items()},
            "sentences": self.sentences,
            "table": self.table(),
            "refits": {
                q.name: {"values": q.values, "stderrs": q.stderrs} for q in self.quantities.values()
            },
            "seed": self.seed,
            "versions": self.versions,
        }
        write_json(path, nulled(table))

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """The refits of every quantity, with the true value and the interval that the fit
        states."""
        return plot.bootstrap(self, ax)

    def plot_coverage(self, ax: "Axes | None" = None) -> "Axes":
        """How often the refits' own intervals hold the true value, at every level that they may
        state."""
        places = {
            name: q.places for name, q in self.quantities.items() if base_of(name) not in BANDS
        }
        return plot.coverage({name: each for name, each in places.items() if len(each)}, ax=ax)


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

        result = jm.fit(target.task(), target)
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
