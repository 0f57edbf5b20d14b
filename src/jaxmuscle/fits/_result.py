"""The result of a fit, of one target or of several, and its file: what was found, how sure it is,
and what it cannot say. `_report.py` makes it; all that reads fits takes it from here.
"""

import dataclasses
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import equinox as eqx
import msgspec
import numpy as np
from jaxtyping import Complex, Float
from msgspec import Meta

from jaxmuscle import plot
from jaxmuscle._common.arrays import from_nulls
from jaxmuscle._common.cards import Card, Result, Shown
from jaxmuscle._common.documents import Table, checked, converted, parsed, says
from jaxmuscle._common.errors import ResultError
from jaxmuscle._common.files import expanded, nulled, write_json
from jaxmuscle._common.inputs import read_text
from jaxmuscle._common.keys import SEEDS
from jaxmuscle._common.parts import of_only, only
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import choices, probability, rounded
from jaxmuscle._common.upward import load_above
from jaxmuscle.data._measure import Measure
from jaxmuscle.data._target import Target
from jaxmuscle.model._task_tables import task_from_table, task_to_table
from jaxmuscle.model._tasks import TASKS, AbstractTask
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._derived import MEAN, derived_names, thirds
from jaxmuscle.objective._options import METHODS

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


FORMAT = 6
ADEQUATE = 0.01  # p of the verdict from which on a model describes the data

Number = float | None  # null where it is not finite
Numbers = list[Number]
Count = Annotated[int, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]


class EstimateTable(Table, kw_only=True):
    """A number with its error: an entry of `parameters` and `derived`."""

    value: Annotated[Number, says("Its value, null where there is none")]
    unit: Annotated[str, says("Its unit, 1 for a ratio")]
    stderr: Annotated[
        Annotated[float, Meta(ge=0)] | None,
        says("Standard error, null where the data do not determine it"),
    ]
    free: Annotated[bool, says("Whether it was fitted")]
    identifiable: Annotated[
        bool | None, says("Whether the data determine it, null of what was fixed")
    ]
    interval: Annotated[
        tuple[Number, Number] | None, says("95 % interval, an end null where it is open")
    ]


class Adequacy(Table):
    """Whether the model describes the data: `adequacy`."""

    chi2: Annotated[
        float, says("Chi² of the verdict: the sum of the squared residuals of all data")
    ]
    expected: Annotated[float, says("Mean of that sum if the model is right")]
    p: Annotated[Share, says("p-value: share of the model's own data with a larger chi²")]
    misfit: Annotated[
        str,
        says(
            "Where the data lie furthest from the model, if it does not describe them; else empty"
        ),
    ]

    @property
    def adequate(self) -> bool:
        """Whether the model describes the data: p >= 0.01."""
        return self.p >= ADEQUATE

    @property
    def widening(self) -> float:
        """By how much standard errors grow where the model does not describe the data, `√(chi² /
        expected)`."""
        return 1.0 if self.adequate else max(1.0, math.sqrt(self.chi2 / self.expected))


class Rung(Table):
    """A model that was tried: an entry of `ladder`."""

    number: Annotated[
        Annotated[int, Meta(ge=-1)],
        says(
            "-1 slow part alone, 0 with a regular rhythm, 1 also with twitch, 2 with twitch and a"
            " resonance, 3 with twitch and two"
        ),
    ]
    model: Annotated[str, says("The model in words")]
    aic: Annotated[float, says("-2 ln L + 2 parameters")]
    parameters: Annotated[
        float, says("Effective number of parameters: less for one that the prior determines")
    ]
    chi2_per_bin: Annotated[
        float, says("Chi² of the verdict on this model, divided by bins less one")
    ]
    p: Annotated[Share, says("p-value of the verdict on this model")]
    chosen: Annotated[bool, says("Whether this model was chosen")]


class Start(Table):
    """A start of the search: an entry of `starts`."""

    cost: Annotated[
        Number, says("Cost where it ended: half the sum of squares, that of the prior included")
    ]
    success: Annotated[
        bool, says("Whether its last step lowered the cost by less than a thousandth of it")
    ]
    steps: Annotated[Count, says("Steps taken")]
    values: Annotated[
        tuple[float, ...],
        says(
            "Free parameters where it ended, in their units, in the order of settings.free; empty"
            " where that is not finite"
        ),
    ]
    kind: Annotated[str, says("How it began, see *Starts* in docs/fitting.md")]


class CorrelationTable(Table, kw_only=True):
    """Correlations of the free parameters: `correlation`; empty if the fit has no result (`message`
    says why)."""

    parameters: Annotated[
        list[str], says("Names of the parameters", missing="the fit has no result")
    ] = msgspec.field(default_factory=list)
    matrix: Annotated[
        list[list[float]],
        says("Correlations, a row for each parameter", missing="the fit has no result"),
    ] = msgspec.field(default_factory=list)


class ProfileTable(Table, kw_only=True):
    """The harmonic's frequency tried: `profile`."""

    frequency_hz: Annotated[Numbers, says("Frequencies [Hz]")]
    chi2_rise: Annotated[Numbers, says("How much larger chi² is there, with all else fitted again")]


class SettingsTable(Table, kw_only=True):
    """How it was fitted: `settings`. Posterior, profile and bootstrap need it to go on from the
    fit."""

    free: Annotated[list[str], says("Names of the fitted parameters")]
    prior_centre: Annotated[
        dict[str, float], says("Centre of the prior of every free parameter, in its unit")
    ]
    prior_sd: Annotated[
        dict[str, float | None],
        says("Its standard deviation (of positive ones: of the logarithm), or null: flat"),
    ]
    bounds: Annotated[
        dict[str, tuple[Number, Number]],
        says("Bounds that were asked for, null where there is none"),
    ]
    starts: Annotated[Count, says("Starts of the search")]
    seeds: Annotated[
        Count, says("How many seeds correct the formula by simulation; 0: not corrected")
    ]
    check_seeds: Annotated[Count, says("New seeds with which the fit was checked")]
    max_steps: Annotated[
        Count, says("Largest number of steps that one search from a starting point may take")
    ]
    dt: Annotated[Annotated[float, Meta(gt=0)], says("Step of the noise [s]")]
    coefficient_of_variation: Annotated[
        bool | dict[str, bool], says("Whether it was data; of several targets by name")
    ]
    mean_force: Annotated[
        tuple[float, float] | dict[str, tuple[float, float] | None] | None,
        says("Mean and its error [N] as data, or null; of several targets by name"),
    ]
    damping_ratio_sd: Annotated[
        float | None,
        says(
            "Standard deviation of the logarithm of the damping ratio in its prior, or null: none",
            missing="none",
        ),
    ] = None
    carried: Annotated[
        float | None,
        says(
            "Number by which forces, stiffness and damping (masses, too, if no target has a"
            " `stiffness`) were multiplied before the fit, so that the task has the mean force;"
            " null if nothing was multiplied"
        ),
    ]
    spectrum: Annotated[dict[str, Any], says("Spectrum settings; of several targets by name")]
    steps_per_sample: Annotated[Count, says("Steps of dt between samples")]
    separate: Annotated[
        tuple[str, ...],
        says("Parameters with a value for each target", missing="fit of one target"),
    ] = ()
    proportional: Annotated[
        tuple[str, ...],
        says(
            "Parameters that differ between targets by a fixed ratio", missing="fit of one target"
        ),
    ] = ()


class SpectrumTable(Table, kw_only=True):
    """Spectra on the target's bins: `spectrum`."""

    frequency_hz: Annotated[list[float], says("Frequencies [Hz]")]
    target: Annotated[list[float], says("Proportional power of the target")]
    fitted: Annotated[
        Numbers,
        says(
            "Proportional power of the fit: the mean of new simulations, or from the formula if"
            " there are none"
        ),
    ]
    harmonic_share: Annotated[Numbers, says("Share of the harmonic in each bin")]
    residual: Annotated[Numbers, says("Target against fit, in standard deviations")]
    deviation: Annotated[
        Numbers | None, says("Standard deviation of the log power, null where it is unknown")
    ]
    components: Annotated[
        dict[str, Numbers],
        says("Share of each bin: relaxation, floor, harmonic, and resonance, resonance_2 if any"),
    ]


class StretchTable(Table, kw_only=True):
    """A few simulated or measured seconds: `stretch`, `recorded`."""

    time: Annotated[Numbers, says("Time [s]")]
    output: Annotated[
        Numbers,
        says(
            "Simulated force [N], displacement [m] or acceleration [m/s²]; measured, in the unit of"
            " the target"
        ),
    ]


class PartTable(Table, kw_only=True):
    """What belongs to one target: beside the keys above, or for several targets under `parts`, by
    name."""

    target: Annotated[str, says("Name of the target")]
    provenance: Annotated[str, says("Where its numbers are from")]
    task: Annotated[str, says("Name of the task")]
    chi2_per_bin: Annotated[
        float | None,
        says("Chi² of spectrum.residual, divided by bins less one; the verdict has adequacy.chi2"),
    ]
    rms_log_error: Annotated[float | None, says("Standard deviation of the log of target over fit")]
    spectrum: Annotated[SpectrumTable, says("Spectra")]
    stretch: Annotated[StretchTable, says("A few simulated seconds")]
    recorded: Annotated[
        StretchTable,
        says("The first seconds of the first recording; empty where only its spectrum is known"),
    ]
    check: Annotated[
        dict[str, float | int],
        says(
            "How far formula and simulation differ (docs/fitting.md, section How): `seeds`, how"
            " many were simulated; the largest difference among the bins, each of the three for"
            " itself: relative to the formula (`largest_deviation`), in standard errors of the"
            " simulated mean (`largest_deviation_se`), in standard deviations of the measured bin"
            " (`largest_deviation_sd`); by how many of its errors the polish moved a quantity at"
            " most (`polish_moved_se`), and its rounds (`polish_turns`)"
        ),
    ]
    further: Annotated[
        dict[str, float],
        says(
            "Residuals [standard deviations] of `coefficient_of_variation` and `mean`, each only if"
            " the fit had it as data"
        ),
    ]
    explained: Annotated[
        dict[str, float],
        says(
            "Of a moved limb, shares of the variance of the force from `low` to `high` [Hz] that"
            " the response explains: `together`, `tissues`, `reflex`, and `other_half`, that of the"
            " half of the recording that was left out (docs/reflex.md); else empty",
            missing="none is known",
        ),
    ] = msgspec.field(default_factory=dict)
    stiffness: Annotated[
        tuple[list[float], list[float]] | None,
        says(
            "Fitted dynamic stiffness, real and imaginary part [N/m], at the frequencies of"
            " `target_table.stiffness` whose `stderr` is finite; null without one"
        ),
    ]
    target_table: Annotated[
        dict[str, Any], says("The target, as in a target file; null for what it does not state")
    ]
    task_table: Annotated[dict[str, Any], says("The fitted task, as in a preset")]


class FitTable(Table, kw_only=True):
    """The keys of a fit."""

    format: Annotated[Literal[6], says("Version of the format")]
    success: Annotated[bool, says("Whether the search converged")]
    message: Annotated[str, says("How the search ended")]
    adequate: Annotated[
        bool | None, says("Whether the model describes the data, null where that is unknown")
    ]
    adequacy_p: Annotated[Share | None, says("p-value of that verdict")]
    adequacy: Annotated[Adequacy | None, says("Numbers behind that verdict")]
    verdict: Annotated[str, says("Verdict in words")]
    method: Annotated[Literal[METHODS], says("How it was fitted")]  # pyright: ignore[reportInvalidTypeForm]
    parameters: Annotated[
        dict[str, EstimateTable], says("Every parameter; of several targets also name@target")
    ]
    derived: Annotated[dict[str, EstimateTable], says("Quantities that follow from the parameters")]
    per_newton: Annotated[
        dict[str, Number], says("Stiffness [1/m] and damping [s/m] over the mean force")
    ]
    correlation: Annotated[CorrelationTable, says("Correlations of the free parameters")]
    undetermined: Annotated[
        tuple[str, ...],
        says("Sentences: which parameters can change together while the spectrum stays"),
    ]
    ladder: Annotated[tuple[Rung, ...], says("Models that were tried")]
    singular_values: Annotated[
        Numbers, says("Singular values of the Jacobian, a number for each direction")
    ]
    starts: Annotated[tuple[Start, ...], says("Where each start of the search ended")]
    profile: Annotated[ProfileTable | None, says("Profile of the frequency of the harmonic")]
    harmonic_p_value: Annotated[
        Share | None, says("p-value of the harmonic: how often chance makes one as strong")
    ]
    notices: Annotated[tuple[str, ...], says("Notes on the data and the fit")]
    unstated: Annotated[
        tuple[str, ...], says("Why a number of the model has no error, or is not to be reported")
    ]
    seed: Annotated[
        Annotated[int, Meta(ge=0, lt=SEEDS)] | None,
        says("The random key (`key=`, `--seed`), if it was a whole number; else null"),
    ]
    settings: Annotated[SettingsTable, says("How it was fitted")]
    versions: Annotated[dict[str, str], says("Versions of the libraries")]


RELATIVE = {
    "N": "1",
    "N/m": "1/m",
    "N s/m": "s/m",
    "N/m^3": "1/m^3",
    "N s^3/m^3": "s^3/m^3",
    "kg": "kg/N",
}
ALIASES = {"activation_time": "contraction_time"}
SPECTRUM = ("fitted", "harmonic_share", "residual", "deviation")
TRACES = ("stretch", "recorded")
STRETCH = ("time", "output")
SAME_OF_PART = ("chi2_per_bin", "rms_log_error", "check", "further", "explained")


class Estimate(Shown, eqx.Module):
    """A number, its `value` in `unit`, with its standard error; `stderr` is None where the data do
    not determine it.

    `free`, whether it was fitted; `identifiable`, whether the data determine it, None for what was
    fixed; `interval`, ends of its 95 % interval where that was computed, an end None where the data
    leave it open.
    """

    value: float
    unit: str
    stderr: float | None = None
    free: bool = True
    identifiable: bool | None = True
    interval: tuple[float | None, float | None] | None = None

    def _card(self) -> Card:
        unit = self.unit if self.unit != "1" else ""
        known = [self.error_in_words()] * (self.stderr is None and self.interval is None)
        known += (
            [f"95 % interval {self.interval_in_words()} {unit}".strip()]
            if self.interval_in_words()
            else []
        )
        return Card(
            f"{self.in_words()} {unit}".strip() + (f" ({'; '.join(known)})" if known else "")
        )

    def times(self, factor: float, unit: str) -> "Estimate":
        """The number in another scale, a positive one."""
        low, high = (None if e is None else factor * e for e in self.interval or (None, None))
        return dataclasses.replace(
            self,
            value=factor * self.value,
            unit=unit,
            stderr=None if self.stderr is None else factor * self.stderr,
            interval=None if self.interval is None else (low, high),
        )

    def row(self) -> dict[str, Any]:
        """As columns of a table."""
        low, high = (None, None) if self.interval is None else self.interval
        return {
            "value": self.value,
            "stderr": self.stderr,
            "low": low,
            "high": high,
            "unit": self.unit,
            "free": self.free,
            "determined": self.stderr is not None,
        }

    def in_words(self) -> str:
        """The value, rounded to its error where it has one."""
        if self.stderr is None:
            return f"{self.value:.3g}"
        return " ± ".join(rounded(self.value, self.stderr))

    def error_in_words(self) -> str:
        """The standard error, or why there is none."""
        if self.stderr is not None:
            return rounded(self.value, self.stderr)[1]
        return "not determined" if self.free else "fixed"

    def interval_in_words(self) -> str:
        """The 95 % interval, empty where there is none."""
        if self.interval is None:
            return ""
        ends = [end for end in self.interval if end is not None]
        # of an interval that is narrower than the error says, as many places as tell its ends apart
        narrow = (ends[1] - ends[0]) / 4 if len(ends) == 2 else math.inf
        error = min(narrow, self.stderr or math.nan)
        low, high = ("" if end is None else rounded(end, error)[0] for end in self.interval)
        if low and high:
            return f"{low} to {high}"
        return f"above {low}" if low else f"below {high}" if high else "open"


class FittedPart(eqx.Module):
    """What a fit found of one target.

    Its fitted `task`; `chi2_per_bin` about `fitted` (None without knowledge of the spread) and
    `rms_log_error`, the standard deviation over the bins of ln(target / fitted); on the target's
    bins the `fitted` proportional power (of fresh seeds where they were simulated),
    `harmonic_share` of each bin's power; `residual`, target against fit [standard deviations];
    `deviation`, the standard deviation of each log power (None where it is unknown); `components`,
    what share of each bin's power the parts of the model have in linear response: the `relaxation`
    of the active tissue under its noise, the `floor` from noise on the passive one, the `harmonic`,
    the `resonance`, `resonance_2`; `stretch`, time and output of a few simulated seconds;
    `recorded`, the same of the first recording in its unit, empty where only its spectrum is known;
    `check`, how far linear response and nonlinear simulation differ; `further`, residuals of the
    coefficient of variation and of the mean, as far as they are data [standard deviations],
    positive where the model is above the data; `stiffness`, the fitted dynamic stiffness [N/m] at
    the frequencies of the target's; `explained`, of a recording of a moved limb, which shares of
    the variance of the force from `low` to `high` [Hz] the response explains: `together`, `tissues`
    without a reflex, what the `reflex` adds, and of the half that was left out, `other_half`.
    """

    target: Target
    task: AbstractTask
    chi2_per_bin: float | None
    rms_log_error: float | None
    fitted: Float[np.ndarray, " bins"]
    harmonic_share: Float[np.ndarray, " bins"]
    residual: Float[np.ndarray, " bins"]
    deviation: Float[np.ndarray, " bins"] | None
    components: dict[str, Float[np.ndarray, " bins"]]
    stretch: tuple[np.ndarray, np.ndarray]
    recorded: tuple[np.ndarray, np.ndarray]
    check: dict[str, float | int]
    further: dict[str, float]
    stiffness: Complex[np.ndarray, " points"] | None = None
    explained: dict[str, float] = eqx.field(default_factory=dict)

    @property
    def frequency_hz(self) -> Float[np.ndarray, " bins"]:
        """Frequencies of the bins [Hz]."""
        return np.asarray(self.target.frequency)

    @property
    def data(self) -> int:
        """Numbers that the fit compares: bins less one, as only their shape counts, and two for
        each frequency of the dynamic stiffness (real and imaginary part)."""
        return max(len(self.fitted) - 1, 0) + (
            0 if self.stiffness is None else 2 * len(self.stiffness)
        )

    @property
    def stiffness_residual(self) -> Complex[np.ndarray, " points"] | None:
        """Measured less fitted dynamic stiffness, real and imaginary part in standard errors; None
        where there is none."""
        if self.stiffness is None or self.target.stiffness is None:
            return None
        measured = self.target.stiffness.known
        return (measured.value - self.stiffness) / measured.stderr

    @property
    def chi2_per_point(self) -> float | None:
        """`Σ |stiffness_residual|² / (2 points)`, about 1 where the model describes the dynamic
        stiffness; or None."""
        off = self.stiffness_residual
        return None if off is None else float(np.mean(np.abs(off) ** 2) / 2)

    @property
    def thirds(self) -> tuple[float, ...]:
        """Frequencies [Hz] of `gain_low`, `gain_middle` and `gain_high`, and of the phases; none
        without a dynamic stiffness."""
        if self.target.stiffness is None:
            return ()
        known = self.target.stiffness.known
        at = thirds(known.frequency, known.value, known.stderr)
        return tuple(map(float, known.frequency[at]))

    def stiffness_columns(self) -> dict[str, Any]:
        """What `stiffness.csv` holds, by column; nothing where there is no dynamic stiffness."""
        if self.stiffness is None or self.target.stiffness is None:
            return {}
        measured = self.target.stiffness.known
        return {
            "frequency_hz": measured.frequency,
            "real": np.real(measured.value),
            "imaginary": np.imag(measured.value),
            "stderr": measured.stderr,
            "fitted_real": np.real(self.stiffness),
            "fitted_imaginary": np.imag(self.stiffness),
        }

    def columns(self) -> dict[str, Any]:
        """What `spectrum.csv` holds, by column."""
        return {
            "frequency_hz": self.frequency_hz,
            "target": self.target.proportional_power,
            "fitted": self.fitted,
            "harmonic_share": self.harmonic_share,
            "residual_sd": self.residual,
        }

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each bin: `frequency_hz`, `target` and `fitted` proportional power,
        `harmonic_share`, `residual_sd`."""
        return frame(self.columns())

    @property
    def model(self) -> str:
        """Task and noise in words."""
        parts = [type(noise).__name__ for noise in self.task.noise.components]
        kind = type(self.task).__name__ + " (acceleration)" * (self.task.quantity == "acceleration")
        return ", ".join(
            [kind, " + ".join(parts), *["activation"] * (self.task.activation is not None)]
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """Linear response against simulation, in a sentence."""
        if "largest_deviation" not in self.check:
            return ()
        off = 100 * self.check["largest_deviation"]
        if "largest_deviation_se" not in self.check:
            return (
                (
                    f"simulation and closed formula (linear response) differ by at most {off:.2g} %"
                    " of a bin"
                ),
            )
        return (
            (
                f"checked with {self.check['seeds']} new simulations: they differ from the closed"
                f" formula by at most {off:.2g} % of a bin"
            ),
        )


def in_use(name: str) -> str | None:
    """The name that people use for a parameter, of one target or "name@target"; None where that is
    its own."""
    base, at, target = name.partition("@")
    return ALIASES[base] + at + target if base in ALIASES else None


def once(
    parameters: Mapping[str, Estimate], derived: Mapping[str, Estimate]
) -> dict[str, Estimate]:
    """Parameters and derived quantities; what is both, once, by the name that people use."""
    return {name: p for name, p in parameters.items() if in_use(name) not in derived} | dict(
        derived
    )


def per_newton(table: Mapping[str, Estimate], mean: float) -> dict[str, Estimate]:
    """The table with whatever has newtons (or masses, which go with them) over the mean force;
    without that itself."""
    return {
        n: _over(p, mean) if p.unit in RELATIVE else p
        for n, p in table.items()
        if base_of(n) != MEAN
    }


def _over(p: Estimate, mean: float) -> Estimate:
    def over(value: float | None) -> float | None:
        return None if value is None else value / mean

    interval = None if p.interval is None else (over(p.interval[0]), over(p.interval[1]))
    return Estimate(
        p.value / mean, RELATIVE[p.unit], over(p.stderr), p.free, p.identifiable, interval
    )


def read_estimates(table: dict[str, EstimateTable]) -> dict[str, Estimate]:
    """Of a file, which has null where there is no value."""
    found = {}
    for name, entry in table.items():
        given: dict[str, Any] = msgspec.structs.asdict(entry)
        given["value"] = math.nan if entry.value is None else entry.value
        found[name] = Estimate(**given)
    return found


def part_to_table(part: FittedPart) -> dict[str, Any]:
    """What `fit.json` says of one target."""
    kind = next(
        (name for name, kind in TASKS.items() if isinstance(part.task, kind)),
        type(part.task).__name__,
    )
    return {
        "target": part.target.name,
        "provenance": part.target.provenance,
        "task": kind,
        **{name: getattr(part, name) for name in SAME_OF_PART},
        "spectrum": {
            "frequency_hz": part.frequency_hz,
            "target": part.target.proportional_power,
            **{field: getattr(part, field) for field in SPECTRUM},
            "components": part.components,
        },
        **{name: dict(zip(STRETCH, getattr(part, name), strict=True)) for name in TRACES},
        "stiffness": (
            None if part.stiffness is None else [np.real(part.stiffness), np.imag(part.stiffness)]
        ),
        "target_table": part.target.to_table(whole=True),
        "task_table": task_to_table(part.task),
    }


def read_part(table: PartTable) -> FittedPart:
    """The reverse of `part_to_table`."""
    spectrum, stiffness = table.spectrum, table.stiffness
    return FittedPart(
        **{name: getattr(table, name) for name in SAME_OF_PART},
        target=Target.from_table(table.target_table, whole=True),
        task=task_from_table(table.task_table),
        **{field: from_nulls(getattr(spectrum, field)) for field in SPECTRUM},
        components={name: from_nulls(share) for name, share in spectrum.components.items()},
        stretch=(from_nulls(table.stretch.time), from_nulls(table.stretch.output)),
        recorded=(from_nulls(table.recorded.time), from_nulls(table.recorded.output)),
        stiffness=None
        if stiffness is None
        else np.array(stiffness[0]) + 1j * np.array(stiffness[1]),
    )


WHAT_TO_DO = (
    "so no number of the model is shown: report what is measured, and that the model does not"
    " describe the data. (fit.json and report.html have its numbers; their standard errors are"
    " widened by a factor of {:.2g}.) To go on, look at the residuals in the figure, and whether"
    " the recording drifts. `jaxmuscle compare fit.json` tries other noises; it takes as long as"
    " all fits so far"
)
PROFILE = ("frequency_hz", "chi2_rise")
# what a result and its file have alike
SAME = (
    "success",
    "message",
    "method",
    "adequacy",
    "ladder",
    "starts",
    "undetermined",
    "harmonic_p_value",
    "notices",
    "unstated",
    "seed",
    "versions",
)
PRIOR = ("prior_centre", "prior_sd")


class FitResult(Result, eqx.Module):
    """What a fit found, of one target or of several.

    `success` and `message`, whether the search converged; `adequacy`, whether the model describes
    the data (an `Adequacy`, None where the scatter of the data is unknown or there is no fit);
    `parts`, a `FittedPart` for each target by name; `method`; `measured`, what needs no model;
    `parameters` and `derived` (`Estimate`s; with several targets, what belongs to one is called
    "name@target", what is the same number for all by its own name), their errors multiplied by
    `adequacy.widening`, √(chi² / expected), where the model does not describe the data;
    `correlation` of the free parameters; `undetermined`, sentences naming what can be
    scaled together without the data noticing; `ladder`, the models that were tried (`Rung`s; empty
    where one was asked for, in a cohort the one that all got); `singular_values` of the Jacobian
    (residuals in standard deviations, parameters in the prior's); the table of `starts`; `profile`,
    harmonic frequencies [Hz] and the rise of chi² there, all else fitted anew; `harmonic_p_value`,
    how often spectra without harmonic would show one as strong (both None with several targets);
    `notices` on the data and the fit, and `unstated`, why a number has no error or is not to be
    reported; `seed`; `settings`; `versions`. An `Adequacy`, a `Rung` and a `Start` have as
    attributes what docs/reference/files.md lists for `adequacy`, `ladder` and `starts`. A fit of
    one target has what its part has as its own: `task`, `target`, `chi2_per_bin`, `fitted` and so
    on.
    """

    success: bool
    message: str
    adequacy: Adequacy | None
    parts: dict[str, FittedPart]
    method: str
    parameters: dict[str, Estimate]
    derived: dict[str, Estimate]
    correlation: dict[str, Any]
    undetermined: tuple[str, ...]
    ladder: tuple[Rung, ...]
    singular_values: Float[np.ndarray, " free"]
    starts: tuple[Start, ...]
    profile: tuple[np.ndarray, np.ndarray] | None
    harmonic_p_value: float | None
    notices: tuple[str, ...]
    unstated: tuple[str, ...]
    seed: int | None
    settings: dict[str, Any]
    versions: dict[str, str]

    @property
    def measured(self) -> dict[str, Measure]:
        """What is measured of the recordings or the spectrum, without the model, by name: with
        several targets "name@target"."""
        return {
            name + (f"@{target}" if len(self.parts) > 1 else ""): m
            for target, part in self.parts.items()
            for name, m in part.target.measured.items()
        }

    def __getitem__(self, name: str) -> Estimate | Measure:
        """The measured quantity, parameter or derived quantity of that name, with its `value`,
        `stderr`, `interval` and `unit`.

        Where no mean force in newtons was given, forces, masses, stiffness and damping are per
        newton of mean force, as the scale of force is unknown. `parameters` and `derived` have the
        numbers of the fitted `task`.

        Raises `ValueError` for an unknown name.
        """
        known = self.as_shown(self.parameters | self.derived) | self.measured
        if name not in known:
            raise ValueError(
                f"unknown quantity {name!r} of the fit of {self.title}: {choices(name, known)}"
            )
        return known[name]

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each measured quantity, parameter and derived quantity, in the units of
        `result[name]`.

        What is both has one row. It counts as a parameter, and has the name that people use, as
        `contraction_time`.

        Columns: `quantity`; `kind`, "measured", "parameter" or "derived"; `value`; `stderr`, NaN
        where the data do not determine it; `low` and `high`, ends of the 95 % interval, NaN where
        one is open or was not computed; `unit`; `error_from`, what a measured one's error stands
        on; `free`, whether it was fitted; `determined`, whether it has a standard error.
        """
        own = self.parameters.keys() | {in_use(name) for name in self.parameters}
        rows = [
            {
                "quantity": name,
                "kind": "measured",
                **m.row(),
                "free": False,
                "determined": m.stderr is not None,
            }
            for name, m in self.measured.items()
        ]
        rows += [
            {"quantity": name, "kind": "parameter" if name in own else "derived", **p.row()}
            for name, p in self.as_shown(once(self.parameters, self.derived)).items()
        ]
        return frame(rows)

    @property
    def only(self) -> FittedPart:
        """The part of a fit of one target. Raises `AttributeError` where there are several."""
        return only(self.parts, "result")

    task = of_only("task", "The fitted task.")
    target = of_only("target", "The target.")
    chi2_per_bin = of_only(
        "chi2_per_bin",
        "`Σ residual² / (bins - 1)` about `fitted`, None without knowledge of the spread. The"
        " verdict has `adequacy.chi2`.",
    )
    rms_log_error = of_only("rms_log_error", "Standard deviation of the log of target over fit.")
    fitted = of_only("fitted", "Fitted proportional power on the target's bins.")
    harmonic_share = of_only("harmonic_share", "The harmonic's share of each bin's power.")
    residual = of_only("residual", "Residual of each bin.")
    deviation = of_only("deviation", "Standard deviation of each bin's log power.")
    stretch = of_only("stretch", "Time and output of a few simulated seconds.")
    recorded = of_only("recorded", "Time and output of the first seconds of the first recording.")
    check = of_only("check", "How far linear response and nonlinear simulation differ.")
    frequency_hz = of_only("frequency_hz", "Frequencies of the bins [Hz].")

    @property
    def adequate(self) -> bool | None:
        """Whether the model describes the data, `adequacy_p >= 0.01`; None where that cannot be
        judged."""
        return None if self.adequacy is None else self.adequacy.adequate

    @property
    def adequacy_p(self) -> float | None:
        """How often data of the fitted model itself would lie as far from their fit."""
        return None if self.adequacy is None else self.adequacy.p

    @property
    def data(self) -> int:
        """Numbers that the fit compares, of all targets."""
        return sum(part.data for part in self.parts.values())

    @property
    def closeness(self) -> str:
        """Chi² of the verdict, `adequacy.chi2`, divided by `data`, as "chi2 per bin 0.73"; empty if
        it cannot be judged."""
        if self.adequacy is None:
            return ""
        each = "bin" if all(part.stiffness is None for part in self.parts.values()) else "datum"
        return f"chi2 per {each} {self.adequacy.chi2 / self.data:.2f}"

    @property
    def verdict(self) -> str:
        """In one sentence, whether the fit may be believed."""
        if not self.success:
            return f"not fitted: {self.message}"
        if self.adequacy is None:
            return (
                "cannot be judged: the target does not say how much its powers scatter (give"
                " segments or sigma)"
            )
        found = (
            f"{self.closeness} (expected {self.adequacy.expected / self.data:.2f}),"
            f" {probability(self.adequacy.p)}"
        )
        if self.adequacy.adequate:
            return f"describes the data: {found}"
        return f"does not describe the data: {found}; {self.adequacy.misfit}"

    @property
    def advice(self) -> tuple[str, ...]:
        """What the verdict means for the numbers, and what to do."""
        if self.adequacy is None or self.adequacy.adequate:
            return ()
        return (WHAT_TO_DO.format(self.adequacy.widening),)

    @property
    def per_newton(self) -> dict[str, float]:
        """Stiffness [1/m] and damping [s/m] of both tissues at rest (`K_w0`, `K_z0`, `C_w0`,
        `C_z0`) per newton of mean force: free of the scale of force.

        Empty where a mean force or a dynamic stiffness was given, and where the output is no force.
        """
        known = len(self.parts) > 1 or self.settings.get("mean_force") is not None
        if known or self.only.stiffness is not None or self.task.output_unit != "N":
            return {}
        mean = self.derived[MEAN].value if MEAN in self.derived else np.nan
        return {
            n: self.derived[n].value / mean
            for n in ("K_w0", "K_z0", "C_w0", "C_z0")
            if n in self.derived
        }

    @property
    def tasks(self) -> dict[str, AbstractTask]:
        """The fitted task of every target."""
        return {name: part.task for name, part in self.parts.items()}

    @property
    def targets(self) -> dict[str, Target]:
        """The targets."""
        return {name: part.target for name, part in self.parts.items()}

    @property
    def title(self) -> str:
        """Names of the targets."""
        return ", ".join(part.target.name for part in self.parts.values())

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the fitted parameters."""
        return tuple(name for name, p in self.parameters.items() if p.free)

    @property
    def derived_names(self) -> tuple[str, ...]:
        """Names that derived quantities have in this fit."""
        return (
            derived_names(
                self.task, self.only.fitted.size > 0, self.only.target.stiffness is not None
            )
            if len(self.parts) == 1
            else tuple(self.derived)
        )

    @property
    def determined(self) -> dict[str, Estimate]:
        """Fitted parameters and derived quantities that have a standard error; what is both,
        once."""
        return {name: p for name, p in self.found.items() if p.stderr is not None}

    @property
    def found(self) -> dict[str, Estimate]:
        """Fitted parameters and derived quantities; what is both, once, by the name that people
        use."""
        return once({name: p for name, p in self.parameters.items() if p.free}, self.derived)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was checked, in sentences: linear response against simulation, and whether there is
        a harmonic."""
        single = len(self.parts) == 1
        said = [
            s if single else f"{name}: {s}"
            for name, part in self.parts.items()
            for s in part.remarks
        ]
        if (p := self.harmonic_p_value) is not None:
            said.append(
                f"the harmonic is {'not ' * (p >= 0.05)}significant: p = {p:.2g}, the share of"
                " simulated spectra without a harmonic that show one as strong by chance"
            )
        return tuple(said)

    def details(self) -> str:
        """As text all that it found: also models that were tried, parameters, what the data do not
        determine."""
        return load_above("reports").fit_details(self)

    def methods(self) -> str | None:
        """A paragraph for the methods section of a paper; None for several targets, a moved
        insertion, a failed fit."""
        return load_above("reports").fit_methods(self)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """The figure of the fit."""
        return plot.fit(self, ax)

    def save(self, path: str | Path) -> None:
        """Write JSON atomically; `load_result` reads it back equal. That of one target serves
        wherever a preset does."""
        write_json(path, to_table(self))

    def as_shown(self, table: Mapping[str, Estimate]) -> dict[str, Estimate]:
        """A table of quantities as it is shown: per newton of mean force where the scale of force
        is unknown."""
        return per_newton(table, self.derived[MEAN].value) if self.per_newton else dict(table)

    def scale_as_shown(self, unit: str) -> tuple[float, str]:
        """By what a number of this unit is multiplied to be shown, and its unit then."""
        if self.per_newton and unit in RELATIVE:
            return 1 / self.derived[MEAN].value, RELATIVE[unit]
        return 1.0, unit

    def _card(self) -> Card:
        return load_above("reports").fit_card(self)


def to_table(result: FitResult) -> dict[str, Any]:
    """What `fit.json` holds; of several targets, what belongs to each stands under "parts"."""
    parts = {name: part_to_table(part) for name, part in result.parts.items()}
    own = next(iter(parts.values())) if len(parts) == 1 else {"parts": parts}
    profile = result.profile
    return nulled(
        {
            "format": FORMAT,
            **{name: msgspec.to_builtins(getattr(result, name)) for name in SAME},
            "adequate": result.adequate,
            "adequacy_p": result.adequacy_p,
            "verdict": result.verdict,
            **own,
            "parameters": {name: vars(p) for name, p in result.parameters.items()},
            "derived": {name: vars(p) for name, p in result.derived.items()},
            "per_newton": result.per_newton,
            "correlation": result.correlation,
            "singular_values": result.singular_values,
            "profile": None if profile is None else dict(zip(PROFILE, profile, strict=True)),
            "settings": result.settings,
        }
    )


def load_result(path: str | Path) -> FitResult:
    """Read the `fit.json` at `path`, of one target or several. Raises `ResultError` naming the file
    and what is wrong.

        result.save("fit.json")
        result = jm.load_result("fit.json")

    A key is an error if it is unknown, of a wrong type, or missing against docs/reference/files.md.
    """
    if not isinstance(path, str | os.PathLike):
        raise ResultError(f"path {path!r}: give the path of a fit.json")
    path = expanded(path)
    table = parsed(
        read_text(path, ResultError, instead="a fit.json"), str(path), "JSON", ResultError
    )
    if type(table.get("format")) is not int or table["format"] != FORMAT:
        raise ResultError(
            f"{path}: is not a fit result of format {FORMAT}: fit again, FitResult.save writes it"
        )
    try:
        result = _from_table(table, str(path))
        missing = _missing(result, table)
    except (ValueError, ArithmeticError) as error:
        raise error if isinstance(error, ResultError) else ResultError(f"{path}: {error}") from None
    if missing:
        raise ResultError(f"{path}: the key {missing} is missing: fit again")
    return result


def _from_table(table: dict[str, Any], file: str) -> FitResult:
    own = {field.name for field in msgspec.structs.fields(PartTable)}
    several = "parts" in table
    parts = (
        converted(table["parts"], dict[str, dict[str, Any]], "parts")
        if several
        else {"": {key: value for key, value in table.items() if key in own}}
    )
    rest = {
        key: value for key, value in table.items() if key != "parts" and (several or key not in own)
    }
    said = checked(rest, FitTable, file, ResultError)
    read = {
        name: read_part(
            checked(part, PartTable, f"{file}: parts.{name}" if several else file, ResultError)
        )
        for name, part in parts.items()
    }
    if several and len(read) < 2:
        raise ResultError(f"{file}: parts holds {len(read)} targets, where several belong")
    return FitResult(
        **{name: getattr(said, name) for name in SAME},
        parts=read if several else {part.target.name: part for part in read.values()},
        parameters=read_estimates(said.parameters),
        derived=read_estimates(said.derived),
        correlation=table["correlation"],
        singular_values=from_nulls(said.singular_values),
        profile=(
            None
            if said.profile is None
            else tuple(from_nulls(getattr(said.profile, name)) for name in PROFILE)
        ),
        settings=table["settings"],
    )


def _missing(result: FitResult, table: dict[str, Any]) -> str | None:
    """A key that is not there though the rest of the file asks for it, where the schema leaves keys
    free; None if there is none."""
    settings, known = result.settings, set(map(base_of, result.parameters))
    of = result.correlation
    spectra = [settings["spectrum"]] if len(result.parts) == 1 else settings["spectrum"].values()
    wanted = [
        ("parameters", {n for task in result.tasks.values() for n in task.parameter_names}, known),
        ("per_newton", set(result.per_newton), table["per_newton"]),
        ("correlation", {"parameters", "matrix"} if of else set(), of),
        *((f"settings.{name}", set(result.free), settings[name]) for name in PRIOR),
        *(
            ("settings.spectrum", set(target.settings.to_dict()), used)
            for target, used in zip(result.targets.values(), spectra, strict=True)
        ),
    ]
    return next(
        (f"{at}.{min(names - {*has})}" for at, names, has in wanted if names - {*has}), None
    )
