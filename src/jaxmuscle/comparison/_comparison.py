"""What a comparison of noises found: a row for each model, which of them can be told apart, in
numbers and words."""

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import with_nulls
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import versions
from jaxmuscle._common.files import write_text
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import folded, probability
from jaxmuscle.data._target import Target
from jaxmuscle.fits._adequacy import ADEQUATE
from jaxmuscle.model._rungs import RICHER, RUNGS
from jaxmuscle.model._task_tables import task_to_table
from jaxmuscle.model._tasks import AbstractTask

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


FORMAT = 1
NEEDED = 6.0
LEGEND = (
    "  line: with a harmonic. par: effective number of parameters. weight: Akaike weight. p: of the"
    " verdict. held-out: score for bins left out, minus that of the first row, ± standard error"
)
NUMBERS = (
    "log_likelihood",
    "parameters",
    "aic",
    "delta_aic",
    "weight",
    "score",
    "score_difference",
    "score_stderr",
    "chi2_per_bin",
    "adequacy_p",
)
COLUMNS = ("noise", "harmonic", *NUMBERS, "adequate", "success")


class Evidence(NamedTuple):
    """What a decision looks at: a model's AIC, its score of every bin, if there is one, and whether
    its climbs settled."""

    aic: float
    scores: Float[np.ndarray, " bins"] | None
    settled: bool = True


class Decision(Printed, Result, eqx.Module):
    """Model `a` against model `b`.

    How much lower the AIC of `a` is (`aic_gain`), how much higher its held-out score (`score_gain`,
    `score_stderr`; None if nothing was held out). The two are told apart if the AIC differs by at
    least `needed` and the held-out score, if there is one, says the same. `unsettled` names those
    whose search did not come to its end: they are not compared.
    """

    a: str
    b: str
    aic_gain: float
    score_gain: float | None
    score_stderr: float | None
    needed: float = NEEDED
    unsettled: tuple[str, ...] = ()

    @property
    def winner(self) -> str | None:
        """The better one; None if they cannot be told apart."""
        if self.unsettled or not abs(self.aic_gain) >= self.needed or self._score_against:
            return None
        return self.a if self.aic_gain > 0 else self.b

    @property
    def _score_against(self) -> bool:
        return self.score_gain is not None and not self.score_gain * self.aic_gain > 0

    def __str__(self) -> str:
        better, worse = (self.a, self.b) if self.aic_gain >= 0 else (self.b, self.a)
        numbers = f"AIC lower by {abs(self.aic_gain):.1f}"
        if self.score_gain is not None:
            gain = self.score_gain if self.aic_gain >= 0 else -self.score_gain
            numbers += (
                f", held-out score {'higher' if gain >= 0 else 'lower'} by {abs(gain):.1f} ±"
                f" {self.score_stderr:.1f}"
            )
        if self.winner is not None:
            return f"the data prefer {better} to {worse}: {numbers}"
        open_ = f"{better} and {worse} cannot be told apart"
        if self.unsettled:
            whose = " and of ".join(self.unsettled)
            return f"{better} and {worse} are not compared: the search of {whose} did not converge"
        apart = f"to tell them apart, the AIC must differ by {self.needed:.3g} or more"
        apart += ", since chance alone would find some frequency that fits a little better" * (
            self.needed > NEEDED
        )
        if abs(self.aic_gain) >= self.needed:
            return f"{open_}: AIC and held-out score disagree (for {better}: {numbers})"
        return f"{open_} (for {better}: {numbers}); {apart}"


def decided(names: tuple[str, str], a: Evidence, b: Evidence, needed: float = NEEDED) -> Decision:
    """The decision between two models, called by `names`."""
    unsettled = tuple(name for name, one in zip(names, (a, b), strict=True) if not one.settled)
    return Decision(*names, b.aic - a.aic, *score_difference(a.scores, b.scores), needed, unsettled)


def score_difference(
    a: Float[np.ndarray, " bins"] | None, b: Float[np.ndarray, " bins"] | None
) -> tuple[float | None, float | None]:
    """`Σ (a_k - b_k)` and its standard error √n sd(a_k - b_k) (Vehtari, Gelman & Gabry 2017,
    10.1007/s11222-016-9696-4)."""
    if a is None or b is None:
        return None, None
    difference = a - b
    return float(difference.sum()), float(math.sqrt(len(difference)) * difference.std(ddof=1))


class ComparedModel(eqx.Module):
    """One model: a colour of noise or a richer model (`noise`), with or without harmonic.

    `log_likelihood` at the maximum of the posterior, the offset integrated out; `parameters`, their
    effective number p = tr(F (F + Λ)⁻¹); `aic` = -2 ln L + 2 p; `delta_aic` above the lowest;
    Akaike `weight`; `scores`, log density of every bin foretold from the others, and `score`, their
    sum; `score_difference` to the model of lowest AIC with `score_stderr` (None where the target
    has no segments); `chi2_per_bin`; `adequacy_p`, how often its own spectra would lie as far from
    their fit; `success`, whether its climbs settled.
    """

    noise: str
    harmonic: bool
    log_likelihood: float
    parameters: float
    aic: float
    delta_aic: float
    weight: float
    score: float | None
    score_difference: float | None
    score_stderr: float | None
    chi2_per_bin: float
    adequacy_p: float | None
    success: bool
    scores: Float[np.ndarray, " bins"] | None

    needed: ClassVar[float] = NEEDED

    @property
    def adequate(self) -> bool | None:
        """Whether the model describes the data, `adequacy_p >= 0.01`."""
        return None if self.adequacy_p is None else self.adequacy_p >= ADEQUATE

    @property
    def evidence(self) -> "Evidence":
        """What decides between models: AIC, the score of every bin (or None), whether the search
        converged."""
        return Evidence(self.aic, self.scores, self.success)

    @property
    def label(self) -> str:
        """As in "pink, no harmonic"."""
        return self.noise + ("" if self.harmonic else ", no harmonic")


Row = TypeVar("Row", ComparedModel, Evidence)


def lowest(rows: list[Row]) -> Row:
    """The model of lowest AIC."""
    return min(rows, key=lambda row: row.aic if math.isfinite(row.aic) else math.inf)


class Comparison(Printed, Result, eqx.Module):
    """Which noise a spectrum speaks for.

    `rows`, a `ComparedModel` each; `left_out` {noise: why the task cannot carry it}; `tasks` and
    `fitted` (proportional power on the target's bins) by (noise, harmonic); `harmonic_needed`, by
    how much the AIC has to be lower with the harmonic; `groups`, the number of turns in which bins
    were left out; `seed`; `versions`.
    """

    target: Target
    rows: tuple[ComparedModel, ...]
    left_out: dict[str, str]
    tasks: dict[tuple[str, bool], AbstractTask]
    fitted: dict[tuple[str, bool], Float[np.ndarray, " bins"]]
    harmonic_needed: float
    groups: int
    seed: int | None
    versions: dict[str, str] = eqx.field(default_factory=versions)

    @property
    def success(self) -> bool:
        """Whether every search settled."""
        return all(row.success for row in self.rows)

    @property
    def best(self) -> ComparedModel:
        """The model of lowest AIC."""
        return lowest(list(self.rows))

    @property
    def noises(self) -> tuple[str, ...]:
        """The noises compared, lowest AIC first."""
        names = dict.fromkeys(row.noise for row in self.rows)
        return tuple(sorted(names, key=lambda name: self.of(name).aic))

    def of(self, noise: str) -> ComparedModel:
        """The better one, by AIC, of a noise's models with and without harmonic. Raises
        `ValueError` for another noise."""
        rows = [row for row in self.rows if row.noise == noise]
        if not rows:
            raise ValueError(
                f"noise = {noise!r}: not compared; there are"
                f" {', '.join(dict.fromkeys(r.noise for r in self.rows))}"
            )
        return lowest(rows)

    def between(self, a: str, b: str) -> Decision:
        """Two noises, each with or without harmonic, whichever has the lower AIC."""
        return decided((a, b), self.of(a).evidence, self.of(b).evidence)

    @property
    def harmonic(self) -> Decision | None:
        """Of noises that were fitted both ways the best with a harmonic against the best without;
        None if there is none."""
        both = {row.noise for row in self.rows if row.harmonic}
        sides = [
            [row for row in self.rows if row.harmonic == present and row.noise in both]
            for present in (True, False)
        ]
        if not all(sides):
            return None
        names = ("a harmonic", "no harmonic")
        return decided(
            names, lowest(sides[0]).evidence, lowest(sides[1]).evidence, self.harmonic_needed
        )

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences: the best noise against each other one, and whether there is a harmonic."""
        first, *others = self.noises
        said = [str(self.between(first, other)) for other in others]
        if self.harmonic is not None:
            asked = any(row.harmonic for row in self.rows if row.noise == first)
            said.append(
                str(self.harmonic)
                if asked
                else f"among the models without resonance, {self.harmonic}"
            )
        if self.best.scores is None:
            said.append(
                "the target states no segments: nothing was held out, the AIC decides alone"
            )
        return tuple(said)

    @property
    def adequate(self) -> str:
        """Which models describe the data: that one is better than another does not say that it is
        good."""
        known = [row for row in self.rows if row.adequate is not None]
        fine = [row.label for row in known if row.adequate]
        if not known:
            return (
                "whether any model describes the data cannot be judged: the target states neither"
                " segments nor sigma"
            )
        if not fine:
            return (
                "none of the models describes the data (p < 0.01 for each): do not believe the best"
                " of them either"
            )
        every = len(fine) == len(self.rows)
        return (
            "every model describes the data"
            if every
            else f"these describe the data (p >= 0.01): {'; '.join(fine)}"
        )

    def table(self) -> list[dict[str, Any]]:
        """A row for each model, with the columns that *Results as numbers* lists
        (docs/reference/index.md)."""
        return [{name: getattr(row, name) for name in COLUMNS} for row in self.rows]

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows of `table`."""
        return frame(self.table())

    def to_xarray(self) -> "xarray.Dataset":
        """The numbers over (noise, harmonic), `fitted` and `scores` over frequency as well; NaN for
        what there is not."""
        import xarray

        names, present = list(dict.fromkeys(row.noise for row in self.rows)), [True, False]
        found = {(row.noise, row.harmonic): row for row in self.rows}
        empty = np.full(len(self.target.bins), np.nan)

        def grid(read: Any, missing: Any) -> list[list[Any]]:
            values = [
                [read(found[n, h]) if (n, h) in found else None for h in present] for n in names
            ]
            return [[missing if value is None else value for value in row] for row in values]

        dims = ("noise", "harmonic")
        numbers = {
            name: (dims, grid(lambda row, name=name: getattr(row, name), np.nan))
            for name in NUMBERS
        }
        spectra = {
            "fitted": grid(lambda row: self.fitted[row.noise, row.harmonic], empty),
            "scores": grid(lambda row: row.scores, empty),
        }
        return xarray.Dataset(
            numbers
            | {name: ((*dims, "frequency"), values) for name, values in spectra.items()}
            | {
                "success": (dims, grid(lambda row: row.success, False)),
                "target": ("frequency", self.target.proportional_power),
            },
            coords={
                "noise": names,
                "harmonic": present,
                "frequency": ("frequency", self.target.frequency, {"units": "Hz"}),
            },
            attrs={"target_name": self.target.name, "verdict": "\n".join(self.verdict)}
            | {f"left_out_{name}": why for name, why in self.left_out.items()}
            | {f"version_{package}": number for package, number in self.versions.items()},
        )

    def to_json(self) -> str:
        """Everything as JSON, the fitted tasks as presets are."""
        table = {
            "format": FORMAT,
            "target": self.target.name,
            "rows": [
                {name: with_nulls(value) for name, value in row.items()} for row in self.table()
            ],
            "adequate": self.adequate,
            "verdict": list(self.verdict),
            "left_out": self.left_out,
            "harmonic_needed": self.harmonic_needed,
            "groups": self.groups,
            "seed": self.seed,
            "frequency_hz": self.target.frequency.tolist(),
            "models": [
                {
                    "noise": row.noise,
                    "harmonic": row.harmonic,
                    "fitted": with_nulls(self.fitted[row.noise, row.harmonic]),
                    "scores": with_nulls(row.scores),
                    "task": task_to_table(self.tasks[row.noise, row.harmonic]),
                }
                for row in self.rows
            ],
            "target_table": self.target.to_table(),
            "versions": self.versions,
        }
        return json.dumps(table, indent=1, ensure_ascii=False, allow_nan=False) + "\n"

    def save(self, path: str | Path) -> None:
        """Write `to_json` atomically."""
        write_text(path, self.to_json())

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """The target with the best fit of each noise, AIC and held-out score of every model."""
        return plot.comparison(self, ax)

    def __str__(self) -> str:
        kind = type(next(iter(self.tasks.values()))).__name__
        head = (
            f"  {'noise':<19}{'line':<5}{'ln L':>9}{'par':>5}{'ΔAIC':>9}{'weight':>7}{'p':>9} "
            " held-out"
        )
        lines = [f"{self.target.name} ({self.target.provenance}), {kind}: which noise?", head]
        for row in sorted(self.rows, key=lambda row: row.aic):
            held = (
                ""
                if row.score is None
                else f"{_short(row.score_difference)} ± {_short(row.score_stderr)}"
            )
            p = row.adequacy_p
            line = f"  {row.noise:<19}{'yes' if row.harmonic else 'no':<5}"
            line += f"{_short(row.log_likelihood):>9}{row.parameters:>5.1f}"
            line += f"{_short(row.delta_aic):>9}{row.weight:>7.2f}"
            line += (
                f"{'' if p is None else probability(p).removeprefix('p ').removeprefix('= '):>9}"
            )
            lines.append(f"{line}  {held if row.success else 'failed'}")
        lines.append(LEGEND)
        if self.target.mean is not None:
            lines.append(
                "  The fit of these recordings also uses their mean force. So its p and AIC are a"
                " little different"
            )
        called = [
            f"{name} ({RUNGS[rung]})"
            for name, rung in RICHER.items()
            if any(row.noise == name for row in self.rows)
        ]
        lines += [f"  the richer models that `fit` tries: {'; '.join(called)}"] * bool(called)
        said = [f"left out: {noise}: {why}" for noise, why in self.left_out.items()]
        for sentence in (self.adequate, *self.verdict, *said):
            lines.append(f"- {sentence}")
        return folded(lines)


def _short(value: Any) -> str:
    return f"{value:.1f}" if abs(value) < 1e4 else f"{value:.3g}"
