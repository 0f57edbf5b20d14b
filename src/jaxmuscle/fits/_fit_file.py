"""What `fit.json` holds: the schema of its keys, and whether they agree with each other."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from jaxmuscle._common.documents import Table, contradiction
from jaxmuscle._common.keys import SEEDS
from jaxmuscle.data._target import Target
from jaxmuscle.objective._arguments import METHODS, RESIDUALS, base_of, target_of

if TYPE_CHECKING:
    from ._result import FitResult

FORMAT = 4
FORMATS = (2, 3, 4)  # that can be read; 2 may leave out what task and target do not have, 3 where starts ended
SAME = 1e-9  # relative

Number = float | None  # null where it is not finite
Numbers = list[Number]
Count = Annotated[int, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]


def _told(text: str) -> Meta:
    return Meta(description=text)


class EstimateTable(Table, kw_only=True):
    """A number with its error: an entry of `parameters` and `derived`."""

    value: Annotated[Number, _told("Its value, null where there is none")]
    unit: Annotated[str, _told("Its unit, 1 for a ratio")]
    stderr: Annotated[Annotated[float, Meta(ge=0)] | None, _told("Standard error, null where the data do not determine it")]
    free: Annotated[bool, _told("Whether it was fitted")]
    identifiable: Annotated[bool | None, _told("Whether the data determine it, null of what was fixed")]
    interval: Annotated[tuple[Number, Number] | None, _told("95 % interval, an end null where it is open")]


class AdequacyTable(Table, kw_only=True):
    """Whether the model describes the data: `adequacy`."""

    chi2: Annotated[float, _told("Chi² of the verdict: the sum of the squared residuals of all data")]
    expected: Annotated[float, _told("Mean of that sum if the model is right")]
    p: Annotated[Share, _told("p-value: share of the model's own data with a larger chi²")]
    misfit: Annotated[str, _told("Where the data lie furthest from the model, if it does not describe them; else empty")]


class RungTable(Table, kw_only=True):
    """A model that was tried: an entry of `ladder`."""

    number: Annotated[Annotated[int, Meta(ge=-1)], _told("-1 noise alone, 0 base, 1 activation, 2 tremor, 3 resonance")]
    model: Annotated[str, _told("The model in words")]
    aic: Annotated[float, _told("-2 ln L + 2 parameters")]
    parameters: Annotated[float, _told("Effective number of parameters: less for one that the prior determines")]
    chi2_per_bin: Annotated[float, _told("Chi² of the verdict on this model, divided by bins less one")]
    p: Annotated[Share, _told("p-value of the verdict on this model")]
    chosen: Annotated[bool, _told("Whether this model was chosen")]


class StartTable(Table, kw_only=True):
    """A start of the search: an entry of `starts`."""

    cost: Annotated[Number, _told("Cost where it ended: half the sum of squares, that of the prior included")]
    success: Annotated[bool, _told("Whether it settled")]
    steps: Annotated[Count, _told("Steps taken")]
    values: Annotated[
        tuple[float, ...], _told("Free parameters where it ended, in their units, in the order of settings.free")
    ] = ()


class CorrelationTable(Table, kw_only=True):
    """Correlations of the free parameters: `correlation`; empty where the fit failed."""

    parameters: Annotated[list[str], _told("Names of the parameters")] = msgspec.field(default_factory=list)
    matrix: Annotated[list[list[float]], _told("Correlations, a row for each parameter")] = msgspec.field(
        default_factory=list
    )


class ProfileTable(Table, kw_only=True):
    """The harmonic's frequency tried: `profile`."""

    frequency_hz: Annotated[Numbers, _told("Frequencies [Hz]")]
    chi2_rise: Annotated[Numbers, _told("How much larger chi² is there, with all else fitted again")]


class SettingsTable(Table, kw_only=True):
    """How it was fitted: `settings`. Posterior, profile and bootstrap need it to go on from the fit."""

    free: Annotated[list[str], _told("Names of the fitted parameters")]
    residual: Annotated[Literal[RESIDUALS], _told("How powers were compared, see docs/fitting.md")]  # pyright: ignore[reportInvalidTypeForm]
    prior_centre: Annotated[dict[str, float], _told("Centre of the prior of every free parameter, in its unit")]
    prior_sd: Annotated[
        dict[str, float | None], _told("Its standard deviation (of positive ones: of the logarithm), or null: flat")
    ]
    bounds: Annotated[dict[str, tuple[Number, Number]], _told("Bounds that were asked for, null where there is none")]
    starts: Annotated[Count, _told("Starts of the search")]
    seeds: Annotated[Count, _told("How many seeds correct the formula by simulation; 0: not corrected")]
    check_seeds: Annotated[Count, _told("New seeds with which the fit was checked")]
    max_steps: Annotated[Count, _told("Largest number of steps of each descent")]
    dt: Annotated[Annotated[float, Meta(gt=0)], _told("Step of the noise [s]")]
    increments: Annotated[
        Literal["gaussian", "weak"],
        _told("Random numbers of the simulations: normal ones (also if missing), or cheaper ones of docs/engine.md"),
    ] = "gaussian"
    coefficient_of_variation: Annotated[bool | dict[str, bool], _told("Whether it was data; of several targets by name")]
    mean_force: Annotated[
        tuple[float, float] | dict[str, tuple[float, float] | None] | None, _told("Mean and its error [N] as data, or null")
    ]
    carried: Annotated[
        float | None,
        _told(
            "Number by which forces, stiffness and damping (masses, too, if no target has a `stiffness`) were multiplied "
            "before the fit, so that the task has the mean force; null if nothing was multiplied"
        ),
    ]
    spectrum: Annotated[dict[str, Any], _told("Spectrum settings; of several targets by name")]
    steps_per_sample: Annotated[Count, _told("Steps of dt between samples")]
    optimiser: Annotated[str | None, _told("Solver, where another than Levenberg-Marquardt was asked for")] = None
    separate: Annotated[tuple[str, ...], _told("Of several targets only: parameters with a value for each")] = ()
    proportional: Annotated[
        tuple[str, ...], _told("Of several targets only: parameters that differ between them by a fixed ratio")
    ] = ()


class SpectrumTable(Table, kw_only=True):
    """Spectra on the target's bins: `spectrum`."""

    frequency_hz: Annotated[list[float], _told("Frequencies [Hz]")]
    target: Annotated[list[float], _told("Proportional power of the target")]
    fitted: Annotated[
        Numbers, _told("Proportional power of the fit: the mean of new simulations, or from the formula if there are none")
    ]
    harmonic_share: Annotated[Numbers, _told("Share of the harmonic in each bin")]
    residual: Annotated[Numbers, _told("Target against fit, in standard deviations")]
    deviation: Annotated[Numbers | None, _told("Standard deviation of the log power, null where it is unknown")]
    components: Annotated[
        dict[str, Numbers], _told("Share of each bin: relaxation, floor, harmonic, and tremor, resonance_2 if any")
    ]


class StretchTable(Table, kw_only=True):
    """A few simulated seconds: `stretch`."""

    time: Annotated[Numbers, _told("Time [s]")]
    output: Annotated[Numbers, _told("Simulated force [N], displacement [m] or acceleration [m/s²]")]


class PartTable(Table, kw_only=True):
    """What belongs to one target: beside the keys above, or for several targets under `parts`, by name."""

    target: Annotated[str, _told("Name of the target")]
    provenance: Annotated[str, _told("Where its numbers are from")]
    task: Annotated[str, _told("Name of the task")]
    chi2_per_bin: Annotated[
        float | None, _told("Chi² of spectrum.residual, divided by bins less one; the verdict has adequacy.chi2")
    ]
    rms_log_error: Annotated[float | None, _told("Standard deviation of the log of target over fit")]
    spectrum: Annotated[SpectrumTable, _told("Spectra")]
    stretch: Annotated[StretchTable, _told("A few simulated seconds")]
    check: Annotated[
        dict[str, float | int],
        _told(
            "How far formula and simulation differ (docs/fitting.md, section How): `seeds`, how many were simulated; the "
            "largest difference of a bin, relative (`largest_deviation`), in its standard errors (`largest_deviation_se`), "
            "in standard deviations of the bin (`largest_deviation_sd`); by how many of its errors the polish moved a "
            "quantity at most (`polish_moved_se`), and its rounds (`polish_turns`)"
        ),
    ]
    further: Annotated[
        dict[str, float], _told("Residuals of coefficient of variation and mean, if data [standard deviations]")
    ]
    stiffness: Annotated[
        tuple[list[float], list[float]] | None,
        _told(
            "Fitted dynamic stiffness, real and imaginary part [N/m], at the frequencies of `target_table.stiffness` whose "
            "`stderr` is finite; null without one"
        ),
    ]
    target_table: Annotated[dict[str, Any], _told("The target, as in a target file; null for what it does not state")]
    task_table: Annotated[dict[str, Any], _told("The fitted task, as in a preset")]


class FitTable(Table, kw_only=True):
    """The keys of a fit."""

    format: Annotated[Literal[FORMATS], _told("Version of the format")]  # pyright: ignore[reportInvalidTypeForm]
    success: Annotated[bool, _told("Whether the search converged")]
    message: Annotated[str, _told("How the search ended")]
    adequate: Annotated[bool | None, _told("Whether the model describes the data, null where that is unknown")]
    adequacy_p: Annotated[Share | None, _told("p-value of that verdict")]
    adequacy: Annotated[AdequacyTable | None, _told("Numbers behind that verdict")]
    verdict: Annotated[str, _told("Verdict in words")]
    method: Annotated[Literal[METHODS], _told("How it was fitted")]  # pyright: ignore[reportInvalidTypeForm]
    parameters: Annotated[dict[str, EstimateTable], _told("Every parameter; of several targets also name@target")]
    derived: Annotated[dict[str, EstimateTable], _told("Quantities that follow from the parameters")]
    products: Annotated[list[str], _told("Products and ratios that the data determine")]
    per_newton: Annotated[dict[str, Number], _told("Stiffness [1/m] and damping [s/m] over the mean force")]
    correlation: Annotated[CorrelationTable, _told("Correlations of the free parameters")]
    undetermined: Annotated[list[str], _told("Sentences: which parameters can change together while the spectrum stays")]
    ladder: Annotated[list[RungTable], _told("Models that were tried")]
    singular_values: Annotated[Numbers, _told("Singular values of the Jacobian, a number for each direction")]
    starts: Annotated[list[StartTable], _told("Where each start of the search ended")]
    profile: Annotated[ProfileTable | None, _told("Profile of the frequency of the harmonic")]
    harmonic_p_value: Annotated[Share | None, _told("p-value of the harmonic: how often chance makes one as strong")]
    notices: Annotated[list[str], _told("Notes on the fit")]
    seed: Annotated[
        Annotated[int, Meta(ge=0, lt=SEEDS)] | None,
        _told("The random key (`key=`, `--seed`), if it was a whole number; else null"),
    ]
    settings: Annotated[SettingsTable, _told("How it was fitted")]
    versions: Annotated[dict[str, str], _told("Versions of the libraries")]


def disagreement(result: "FitResult") -> str | None:
    """In words, where parts of a result contradict each other that are not made from each other; None if nowhere."""
    settings, free = result.settings, set(result.free)
    for key in ("free", "prior_centre", "prior_sd"):
        if set(settings[key]) != free:
            return f"settings.{key} names {_names(settings[key])}, but free among the parameters are {_names(free)}"
    if any(len(start.values) not in (0, len(free)) for start in result.starts):
        return f"starts: values needs a number for each of {_names(free)}"
    if not set(settings["bounds"]) <= free:
        return f"settings.bounds names {_names(settings['bounds'])}, but free are {_names(free)}"
    if len(result.parts) > 1 and not {"separate", "proportional"} <= set(settings):
        return "settings has no key 'separate' or 'proportional', which the fit of several targets has"
    spectra = {name: part.target.settings.to_dict() for name, part in result.parts.items()}
    used = settings["spectrum"] if len(spectra) > 1 else {name: settings["spectrum"] for name in spectra}
    if differs := contradiction(used, spectra, "settings.spectrum"):
        return differs
    of = result.correlation
    if len(of) == 1 or (
        of and (len(of["matrix"]), *map(len, of["matrix"])) != (len(of["parameters"]),) * (1 + len(of["parameters"]))
    ):
        return "correlation.matrix needs a row and a column for each of correlation.parameters"
    if result.profile is not None and len(result.profile[0]) != len(result.profile[1]):
        return "profile.chi2_rise needs a number for each of profile.frequency_hz"
    return _values(result)


def _values(result: "FitResult") -> str | None:
    """Parameters against the tasks that have them."""
    for name, estimate in result.parameters.items():
        base, own = base_of(name), target_of(name)
        if own and own not in result.tasks:
            return f"parameters.{name}: there is no target {own!r}"
        tasks = [result.tasks[own]] if own else [task for task in result.tasks.values() if base in task.parameter_names]
        if not tasks or base not in tasks[0].parameter_names:
            return f"parameters.{name}: no task has this parameter"
        value = float(tasks[0][base])
        if np.isfinite(estimate.value) and not np.isclose(value, estimate.value, rtol=SAME, atol=0):
            return f"parameters.{name}.value is {estimate.value!r}, but {value!r} in the task_table"
    missing = {name for task in result.tasks.values() for name in task.parameter_names} - set(
        map(base_of, result.parameters)
    )
    return f"parameters has no key {sorted(missing)[0]!r}, which the task has" if missing else None


def check_lengths(table: PartTable, target: Target) -> None:
    """Raise a `ValueError` for columns that have not a number for each bin, or for each time."""
    spectrum, bins = table.spectrum, len(target.bins)
    columns = {name: getattr(spectrum, name) for name in ("fitted", "harmonic_share", "residual", "deviation")}
    for name, column in (columns | spectrum.components).items():
        if column is not None and len(column) != bins:
            raise ValueError(f"spectrum.{name} has {len(column)} numbers, the target {bins} bins")
    if len(table.stretch.time) != len(table.stretch.output):
        raise ValueError("stretch.output needs a number for each of stretch.time")
    known = 0 if target.stiffness is None else len(target.stiffness.known.frequency)
    real, imaginary = table.stiffness or ([], [])
    if not len(real) == len(imaginary) == known:
        raise ValueError(f"stiffness has {len(real)} real and {len(imaginary)} imaginary parts, the target {known}")


def _names(names: Iterable[str]) -> str:
    return ", ".join(sorted(names)) or "none"
