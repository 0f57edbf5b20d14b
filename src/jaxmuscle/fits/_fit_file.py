"""What `fit.json` holds: the schema of its keys."""

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from jaxmuscle._common.documents import Table, says
from jaxmuscle._common.keys import SEEDS
from jaxmuscle.objective._options import METHODS

FORMAT = 5
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
        says("-1 noise alone, 0 base, 1 activation, 2 resonance, 3 two resonances"),
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
    """A few simulated seconds: `stretch`."""

    time: Annotated[Numbers, says("Time [s]")]
    output: Annotated[Numbers, says("Simulated force [N], displacement [m] or acceleration [m/s²]")]


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

    format: Annotated[Literal[5], says("Version of the format")]
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
    notices: Annotated[tuple[str, ...], says("Notes on the fit")]
    seed: Annotated[
        Annotated[int, Meta(ge=0, lt=SEEDS)] | None,
        says("The random key (`key=`, `--seed`), if it was a whole number; else null"),
    ]
    settings: Annotated[SettingsTable, says("How it was fitted")]
    versions: Annotated[dict[str, str], says("Versions of the libraries")]
