"""The result of a fit, of one target or of several: what was found, how sure it is, and what it cannot say."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import from_nulls, with_nulls
from jaxmuscle._common.errors import ResultError
from jaxmuscle._common.files import write_json
from jaxmuscle._common.parts import of_only, only
from jaxmuscle._common.text import choices, folded
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._consequences import DERIVED

from ._part import Estimate, FittedPart, Start, estimates_to_table, part_to_table, read_estimates, read_part

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


FORMAT = 1
PROFILE = ("frequency_hz", "chi2_rise")


class FitResult(eqx.Module):
    """What a fit found, of one target or of several.

    `success` and `message` (in words); `parts`, a `FittedPart` for each target by name; `method`; `parameters` and `derived`
    (`Estimate`s in natural units; with several targets, what belongs to one is called "name@target", what is the same number
    for all by its own name); `correlation` of the free parameters; `undetermined`, sentences naming the directions that the
    data do not determine; `singular_values` of the Jacobian (residuals in standard deviations, parameters in the prior's);
    the table of `starts`; `profile`, harmonic frequencies [Hz] and the rise of chi² there, all else fitted anew;
    `harmonic_p_value`, how often spectra without harmonic would show one as strong (both None with several targets);
    `notices`; `seed`; `settings`; `versions`.

    A fit of one target has what its part has as its own: `task`, `target`, `chi2_per_bin`, `fitted` and so on.
    """

    success: bool
    message: str
    parts: dict[str, FittedPart]
    method: str
    parameters: dict[str, Estimate]
    derived: dict[str, Estimate]
    correlation: dict[str, Any]
    undetermined: tuple[str, ...]
    singular_values: Float[np.ndarray, " free"]
    starts: tuple[Start, ...]
    profile: tuple[np.ndarray, np.ndarray] | None
    harmonic_p_value: float | None
    notices: tuple[str, ...]
    seed: int | None
    settings: dict[str, Any]
    versions: dict[str, str]

    @property
    def only(self) -> FittedPart:
        """The part of a fit of one target. Raises `AttributeError` where there are several."""
        return only(self.parts, "result")

    task = of_only("task", "The fitted task.")
    target = of_only("target", "The target.")
    chi2_per_bin = of_only("chi2_per_bin", "`Σ residual² / (bins - 1)`, None without knowledge of the spread.")
    rms_log_error = of_only("rms_log_error", "Standard deviation of the log of target over fit.")
    fitted = of_only("fitted", "Fitted proportional power on the target's bins.")
    harmonic_share = of_only("harmonic_share", "The harmonic's share of each bin's power.")
    residual = of_only("residual", "Residual of each bin.")
    deviation = of_only("deviation", "Standard deviation of each bin's log power.")
    stretch = of_only("stretch", "Time and output of a few simulated seconds.")
    check = of_only("check", "How far linear response and nonlinear simulation differ.")
    frequency_hz = of_only("frequency_hz", "Frequencies of the bins [Hz].")

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
        return DERIVED if len(self.parts) == 1 else tuple(self.derived)

    @property
    def determined(self) -> dict[str, Estimate]:
        """Fitted parameters and derived quantities that have a standard error; what is both, once."""
        both = {name: p for name, p in self.parameters.items() if p.free} | self.derived
        return {name: p for name, p in both.items() if p.stderr is not None}

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was checked, in sentences: linear response against simulation, and whether there is a harmonic."""
        single = len(self.parts) == 1
        said = [s if single else f"{name}: {s}" for name, part in self.parts.items() for s in part.remarks]
        if self.harmonic_p_value is not None:
            word = "significant" if self.harmonic_p_value < 0.05 else "not significant"
            said.append(f"the harmonic is {word}: p = {self.harmonic_p_value:.2g} by bootstrap without it")
        return tuple(said)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """The figure of the fit."""
        return plot.fit(self, ax)

    def save(self, path: str | Path) -> None:
        """Write JSON atomically; `load_result` reads it back equal. That of one target serves wherever a preset does."""
        write_json(path, to_table(self))

    def __str__(self) -> str:
        single = len(self.parts) == 1
        lines = [f"{'fitted' if self.success else 'NOT FITTED'}{_head(self)}", f"  {self.message}"]
        if not single:
            lines += [f"  {name}: {p.target.name}, {p.model}{_closeness(p, ', ')}" for name, p in self.parts.items()]
        lines += [f"  note: {notice}" for notice in self.notices]
        if single and self.rms_log_error is not None:
            unknown = "" if self.chi2_per_bin is not None else " (no chi2: the target states no spread)"
            lines.append(f"  {_closeness(self.only)}{unknown}")
        lines += [f"  {sentence}" for sentence in self.remarks]
        wide = max(24, *(2 + len(name) for name in ("parameter", *self.free, *self.derived)))
        for title, table in (("parameter", {n: self.parameters[n] for n in self.free}), ("derived", self.derived)):
            lines.append(f"  {title:<{wide}}{'value':>12}   {'std. error':<14} unit")
            for name, p in table.items():
                unit = "" if p.unit == "1" else p.unit
                lines.append(f"  {name:<{wide}}{p.value:>12.5g}   {p.error_in_words(3):<14} {unit}".rstrip())
        if self.undetermined:
            whose = "the data leave" if single else "all targets together leave"
            lines.append(f"  {whose} open (the prior keeps these near their default):")
            lines += [f"    - {sentence}" for sentence in self.undetermined]
        return folded(lines)


def _head(result: FitResult) -> str:
    if len(result.parts) > 1:
        return f"{' together' if result.success else ''}: {', '.join(result.parts)}"
    return f": {result.target.name} ({result.target.provenance}), {result.only.model}, {result.method}"


def _closeness(part: FittedPart, before: str = "") -> str:
    """χ² per bin and rms error, as far as they are known."""
    said = [] if part.chi2_per_bin is None else [f"chi2 per bin {part.chi2_per_bin:.2f}"]
    said += [] if part.rms_log_error is None else [f"rms log error {part.rms_log_error:.3f}"]
    return before * bool(said) + ", ".join(said)


def to_table(result: FitResult) -> dict[str, Any]:
    """What `fit.json` holds; of several targets, what belongs to each stands under "parts"."""
    parts = {name: part_to_table(part) for name, part in result.parts.items()}
    own = next(iter(parts.values())) if len(parts) == 1 else {"parts": parts}
    profile = result.profile
    return {
        "format": FORMAT,
        "success": result.success,
        "message": result.message,
        **own,
        "method": result.method,
        "parameters": estimates_to_table(result.parameters),
        "derived": estimates_to_table(result.derived),
        "correlation": result.correlation,
        "undetermined": list(result.undetermined),
        "singular_values": with_nulls(result.singular_values),
        "starts": [{"cost": s.cost, "success": s.success, "steps": s.steps} for s in result.starts],
        "profile": None if profile is None else dict(zip(PROFILE, map(with_nulls, profile), strict=True)),
        "harmonic_p_value": result.harmonic_p_value,
        "notices": list(result.notices),
        "seed": result.seed,
        "settings": result.settings,
        "versions": result.versions,
    }


def load_result(path: str | Path) -> FitResult:
    """Read the `fit.json` at `path`, of one target or several. Raises `ResultError` naming the file and what is wrong."""
    path = Path(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ResultError(f"{path}: is not JSON: {error}") from None
    if not isinstance(table, dict) or table.get("format") != FORMAT:
        raise ResultError(f"{path}: is not a fit result of format {FORMAT}; write it with FitResult.save")
    try:
        return _from_table(table)
    except KeyError as error:
        raise ResultError(f"{path}: has no entry {error}; {choices(str(error.args[0]), table)}") from None


def _from_table(table: dict[str, Any]) -> FitResult:
    parts = table["parts"] if "parts" in table else {table["target"]: table}
    profile = table["profile"]
    return FitResult(
        success=table["success"],
        message=table["message"],
        parts={name: read_part(part) for name, part in parts.items()},
        method=table["method"],
        parameters=read_estimates(table["parameters"]),
        derived=read_estimates(table["derived"]),
        correlation=table["correlation"],
        undetermined=tuple(table["undetermined"]),
        singular_values=from_nulls(table["singular_values"]),
        starts=tuple(Start(s["cost"], s["success"], s["steps"]) for s in table["starts"]),
        profile=None if profile is None else tuple(from_nulls(profile[name]) for name in PROFILE),
        harmonic_p_value=table["harmonic_p_value"],
        notices=tuple(table["notices"]),
        seed=table["seed"],
        settings=table["settings"],
        versions=table["versions"],
    )
