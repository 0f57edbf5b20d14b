"""What a comparison of noises found: a row for each model, which of them can be told apart, in
numbers and words."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.environment import versions
from jaxmuscle._common.files import nulled, write_json
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import folded, probability
from jaxmuscle.data._target import Target
from jaxmuscle.fits._verdict import ADEQUATE
from jaxmuscle.model._rungs import RICHER, RUNGS
from jaxmuscle.model._task_tables import task_to_table
from jaxmuscle.model._tasks import AbstractTask

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


NEEDED = 6.0
# noise, harmonic, then numbers
LINE = "  {:<19}{:<5}{:>9}{:>5}{:>9}{:>7}{:>9}  {}"
HEAD = LINE.format("noise", "line", "ln L", "par", "ΔAIC", "weight", "p", "held-out")
LEGEND = (
    "  line: with a harmonic. par: effective number of parameters. weight: Akaike weight. p: of the"
    " verdict. held-out: score for bins left out, minus that of the first row, ± standard error"
)
# What is printed, by what it is about.
WORDS = {
    "prefer": "the data prefer {better} to {worse}: {numbers}",
    "unsettled": (
        "{better} and {worse} are not compared: the search of {unsettled} did not converge"
    ),
    "disagree": (
        "{better} and {worse} cannot be told apart: AIC and held-out score disagree (for {better}:"
        " {numbers})"
    ),
    "near": (
        "{better} and {worse} cannot be told apart (for {better}: {numbers}); to tell them apart,"
        " the AIC must differ by {needed:.3g} or more{chance}"
    ),
    "chance": ", since chance alone would find some frequency that fits a little better",
    "score": ", held-out score {side} by {gain:.1f} ± {error:.1f}",
    "no segments": "the target states no segments: nothing was held out, the AIC decides alone",
    "not judged": (
        "whether any model describes the data cannot be judged: the target states neither segments"
        " nor sigma"
    ),
    "none fits": (
        "none of the models describes the data (p < 0.01 for each): do not believe the best of them"
        " either"
    ),
    "all fit": "every model describes the data",
    "some fit": "these describe the data (p >= 0.01): {fine}",
    "mean": (
        "  The fit of these recordings also uses their mean force. So its p and AIC are a little"
        " different"
    ),
    "richer": "  the richer models that `fit` tries: {names}",
}
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
Bins = Float[np.ndarray, " bins"]
Model = tuple[str, bool]  # the name of its noise, whether it has a harmonic


class Evidence(NamedTuple):
    """What a decision looks at: a model's AIC, its score of every bin, if there is one, and whether
    its climbs settled."""

    aic: float
    scores: Bins | None
    success: bool = True


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
        side = 1 if self.aic_gain >= 0 else -1
        numbers = f"AIC lower by {abs(self.aic_gain):.1f}"
        if self.score_gain is not None:
            gain = side * self.score_gain
            about = {"side": "higher" if gain >= 0 else "lower", "error": self.score_stderr}
            numbers += WORDS["score"].format(gain=abs(gain), **about)
        better, worse = (self.a, self.b)[::side]
        case = (
            "prefer"
            if self.winner is not None
            else "unsettled"
            if self.unsettled
            else "disagree"
            if abs(self.aic_gain) >= self.needed
            else "near"
        )
        return WORDS[case].format(
            better=better,
            worse=worse,
            numbers=numbers,
            unsettled=" and of ".join(self.unsettled),
            needed=self.needed,
            chance=WORDS["chance"] * (self.needed > NEEDED),
        )


def score_difference(a: Bins | None, b: Bins | None) -> tuple[float | None, float | None]:
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
    scores: Bins | None

    needed: ClassVar[float] = NEEDED

    @property
    def adequate(self) -> bool | None:
        """Whether the model describes the data, `adequacy_p >= 0.01`."""
        return None if self.adequacy_p is None else self.adequacy_p >= ADEQUATE

    @property
    def label(self) -> str:
        """As in "pink, no harmonic"."""
        return self.noise + ("" if self.harmonic else ", no harmonic")


Row = TypeVar("Row", ComparedModel, Evidence)


def lowest(rows: list[Row]) -> Row:
    """The model of lowest AIC."""
    return min(rows, key=lambda row: row.aic if math.isfinite(row.aic) else math.inf)


def decide(names: tuple[str, str], a: Row, b: Row, needed: float = NEEDED) -> Decision:
    """The decision between two models, called by `names`."""
    unsettled = tuple(name for name, one in zip(names, (a, b), strict=True) if not one.success)
    return Decision(*names, b.aic - a.aic, *score_difference(a.scores, b.scores), needed, unsettled)


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
    tasks: dict[Model, AbstractTask]
    fitted: dict[Model, Bins]
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
            names = ", ".join(dict.fromkeys(row.noise for row in self.rows))
            raise ValueError(f"noise = {noise!r}: not compared; there are {names}")
        return lowest(rows)

    def between(self, a: str, b: str) -> Decision:
        """Two noises, each with or without harmonic, whichever has the lower AIC."""
        return decide((a, b), self.of(a), self.of(b))

    @property
    def harmonic(self) -> Decision | None:
        """Of noises that were fitted both ways the best with a harmonic against the best without;
        None if there is none."""
        both = {row.noise for row in self.rows if row.harmonic}
        rows = [row for row in self.rows if row.noise in both]
        present, absent = ([r for r in rows if r.harmonic == side] for side in (True, False))
        if not present or not absent:
            return None
        names = ("a harmonic", "no harmonic")
        return decide(names, lowest(present), lowest(absent), self.harmonic_needed)

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences: the best noise against each other one, and whether there is a harmonic."""
        first, *others = self.noises
        said = [str(self.between(first, other)) for other in others]
        if self.harmonic is not None:
            asked = any(row.harmonic for row in self.rows if row.noise == first)
            said.append(f"{'' if asked else 'among the models without resonance, '}{self.harmonic}")
        if self.best.scores is None:
            said.append(WORDS["no segments"])
        return tuple(said)

    @property
    def adequate(self) -> str:
        """Which models describe the data: that one is better than another does not say that it is
        good."""
        fine = [row.label for row in self.rows if row.adequate]
        case = (
            "not judged"
            if all(row.adequate is None for row in self.rows)
            else "none fits"
            if not fine
            else "all fit"
            if len(fine) == len(self.rows)
            else "some fit"
        )
        return WORDS[case].format(fine="; ".join(fine))

    def table(self) -> list[dict[str, Any]]:
        """A row for each model, with the columns that *Results as numbers* lists
        (docs/reference/index.md)."""
        return [{name: getattr(row, name) for name in COLUMNS} for row in self.rows]

    def to_dataframe(self) -> "pandas.DataFrame":
        """The rows of `table`."""
        return frame(self.table())

    def to_dict(self) -> dict[str, Any]:
        """Everything as nested tables, the fitted tasks as presets are."""
        models = [
            {
                "noise": row.noise,
                "harmonic": row.harmonic,
                "fitted": self.fitted[row.noise, row.harmonic],
                "scores": row.scores,
                "task": task_to_table(self.tasks[row.noise, row.harmonic]),
            }
            for row in self.rows
        ]
        own = ("adequate", "verdict", "left_out", "harmonic_needed", "groups", "seed")
        table = {
            "format": 1,
            "target": self.target.name,
            "rows": self.table(),
            **{name: getattr(self, name) for name in own},
            "frequency_hz": self.target.frequency,
            "models": models,
            "target_table": self.target.to_table(),
            "versions": self.versions,
        }
        return nulled(table)

    def save(self, path: str | Path) -> None:
        """Write `to_dict` as JSON, atomically."""
        write_json(path, self.to_dict())

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """The target with the best fit of each noise, AIC and held-out score of every model."""
        return plot.comparison(self, ax)

    def __str__(self) -> str:
        kind = type(next(iter(self.tasks.values()))).__name__
        lines = [f"{self.target.name} ({self.target.provenance}), {kind}: which noise?", HEAD]
        for row in sorted(self.rows, key=lambda row: row.aic):
            held = "" if row.success else "failed"
            if row.success and row.score is not None:
                held = f"{_short(row.score_difference)} ± {_short(row.score_stderr)}"
            p = "" if row.adequacy_p is None else probability(row.adequacy_p)
            lines.append(
                LINE.format(
                    row.noise,
                    "yes" if row.harmonic else "no",
                    _short(row.log_likelihood),
                    f"{row.parameters:.1f}",
                    _short(row.delta_aic),
                    f"{row.weight:.2f}",
                    p.removeprefix("p ").removeprefix("= "),
                    held,
                )
            )
        lines += [LEGEND, *[WORDS["mean"]] * (self.target.mean is not None)]
        richer = [f"{name} ({RUNGS[rung]})" for name, rung in RICHER.items() if name in self.noises]
        lines += [WORDS["richer"].format(names="; ".join(richer))] * bool(richer)
        said = [f"left out: {noise}: {why}" for noise, why in self.left_out.items()]
        return folded([*lines, *(f"- {one}" for one in (self.adequate, *self.verdict, *said))])


def _short(value: Any) -> str:
    return f"{value:.1f}" if abs(value) < 1e4 else f"{value:.3g}"
