"""The result of a fit, of one target or of several: what was found, how sure it is, and what it
cannot say."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import msgspec
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import from_nulls, with_nulls
from jaxmuscle._common.cards import Card, Result
from jaxmuscle._common.documents import checked, converted, parsed
from jaxmuscle._common.errors import ResultError
from jaxmuscle._common.files import expanded, write_json
from jaxmuscle._common.inputs import read_text
from jaxmuscle._common.parts import of_only, only
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import choices, probability
from jaxmuscle._common.upward import load_above
from jaxmuscle.data._measure import Measure
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._derived import MEAN, derived_names

from ._fit_file import FORMAT, Adequacy, FitTable, PartTable, Rung, Start
from ._part import (
    Estimate,
    FittedPart,
    estimates_to_table,
    in_use,
    once,
    part_to_table,
    per_newton,
    read_estimates,
    read_part,
)

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


WHAT_TO_DO = (
    "so no number of the model is shown: report what is measured, and that the model does not"
    " describe the data. (fit.json and report.html have its numbers; their standard errors are"
    " widened by a factor of {:.2g}.) To go on, look at the residuals in the figure, and whether"
    " the recording drifts. `jaxmuscle compare fit.json` tries other noises; it takes as long as"
    " all fits so far"
)
PROFILE = ("frequency_hz", "chi2_rise")
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
    `notices`; `seed`; `settings`; `versions`. An `Adequacy`, a `Rung` and a `Start` have as
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

        Where no mean force in newtons was given, these are newtons of the model muscle, and print
        shows forces, masses, stiffness and damping divided by its mean force,
        `result["model_mean"].value`, as the person's are unknown. `per_newton` and
        `as_shown(result.found)` give what is shown.

        Raises `ValueError` for an unknown name.
        """
        known = self.parameters | self.derived | self.measured
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
            for name, p in once(self.parameters, self.derived).items()
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
            derived_names(self.task, self.only.fitted.size > 0)
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
        return load_above("reports").fit_text(self, everything=True)

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

    def _card(self) -> Card:
        return load_above("reports").fit_card(self)


def to_table(result: FitResult) -> dict[str, Any]:
    """What `fit.json` holds; of several targets, what belongs to each stands under "parts"."""
    parts = {name: part_to_table(part) for name, part in result.parts.items()}
    own = next(iter(parts.values())) if len(parts) == 1 else {"parts": parts}
    profile = result.profile
    return {
        "format": FORMAT,
        "success": result.success,
        "message": result.message,
        "adequate": result.adequate,
        "adequacy_p": result.adequacy_p,
        "adequacy": msgspec.to_builtins(result.adequacy),
        "verdict": result.verdict,
        **own,
        "method": result.method,
        "parameters": estimates_to_table(result.parameters),
        "derived": estimates_to_table(result.derived),
        "per_newton": {name: with_nulls(value) for name, value in result.per_newton.items()},
        "correlation": result.correlation,
        "undetermined": list(result.undetermined),
        "ladder": msgspec.to_builtins(list(result.ladder)),
        "singular_values": with_nulls(result.singular_values),
        "starts": msgspec.to_builtins(list(result.starts)),
        "profile": (
            None if profile is None else dict(zip(PROFILE, map(with_nulls, profile), strict=True))
        ),
        "harmonic_p_value": result.harmonic_p_value,
        "notices": list(result.notices),
        "seed": result.seed,
        "settings": result.settings,
        "versions": result.versions,
    }


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
        success=said.success,
        message=said.message,
        adequacy=said.adequacy,
        parts=read if several else {part.target.name: part for part in read.values()},
        method=said.method,
        parameters=read_estimates(said.parameters),
        derived=read_estimates(said.derived),
        correlation=table["correlation"],
        undetermined=said.undetermined,
        ladder=said.ladder,
        singular_values=from_nulls(said.singular_values),
        starts=said.starts,
        profile=(
            None
            if said.profile is None
            else tuple(from_nulls(getattr(said.profile, name)) for name in PROFILE)
        ),
        harmonic_p_value=said.harmonic_p_value,
        notices=said.notices,
        seed=said.seed,
        settings=table["settings"],
        versions=said.versions,
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
