"""The result of a fit: what was found, how sure it is, and what it cannot say."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import from_nulls, with_nulls
from jaxmuscle._common.errors import ResultError
from jaxmuscle._common.files import write_json
from jaxmuscle._common.text import choices, folded
from jaxmuscle.data._target import Target
from jaxmuscle.model._presets import task_from_table, task_to_table
from jaxmuscle.model._tasks import TASKS, AbstractTask

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


R = TypeVar("R")
FORMAT = 1


class Estimate(eqx.Module):
    """A number, its `value` in `unit`, with its standard error; `stderr` is None where the data do not determine it.

    `free`, whether it was fitted; `identifiable`, whether the data determine it.
    """

    value: float
    unit: str
    stderr: float | None = None
    free: bool = True
    identifiable: bool = True

    def error_in_words(self, digits: int = 2) -> str:
        """The standard error, or why there is none."""
        if self.stderr is not None:
            return f"{self.stderr:.{digits}g}"
        return "not determined" if self.free else "fixed"


class Start(eqx.Module):
    """One start of a fit: final cost `½ Σ r²` (None if not finite), whether it settled, steps taken."""

    cost: float | None
    success: bool
    steps: int


class FitResult(eqx.Module):
    """What a fit found.

    `success` and `message` (in words); `task`, fitted; `target`; `method`; `parameters` and `derived` (`Estimate`s in
    natural units); `correlation` of the free parameters; `undetermined`, sentences naming the directions that the data
    do not determine; `singular_values` of the Jacobian (residuals in standard deviations, parameters in the prior's);
    `chi2_per_bin` (None without knowledge of the spread); `rms_log_error`; `fitted` proportional power (fresh seeds) on
    the target's bins, `harmonic_share` of each bin's power, `residual` and `deviation` [standard deviations, log power];
    the table of `starts`; `stretch`, a few seconds of simulated output; `profile`, harmonic frequencies [Hz] and the rise
    of chi² there, all else fitted anew; `harmonic_p_value`, how often spectra without harmonic would show one as strong;
    `check`, how far linear response and nonlinear simulation differ; `notices`; `seed`; `settings`; `versions`.
    """

    success: bool
    message: str
    task: AbstractTask
    target: Target
    method: str
    parameters: dict[str, Estimate]
    derived: dict[str, Estimate]
    correlation: dict[str, Any]
    undetermined: tuple[str, ...]
    singular_values: Float[np.ndarray, " free"]
    chi2_per_bin: float | None
    rms_log_error: float | None
    fitted: Float[np.ndarray, " bins"]
    harmonic_share: Float[np.ndarray, " bins"]
    residual: Float[np.ndarray, " bins"]
    deviation: Float[np.ndarray, " bins"] | None
    starts: tuple[Start, ...]
    stretch: tuple[np.ndarray, np.ndarray]
    profile: tuple[np.ndarray, np.ndarray] | None
    harmonic_p_value: float | None
    check: dict[str, float | int]
    notices: tuple[str, ...]
    seed: int | None
    settings: dict[str, Any]
    versions: dict[str, str]

    @property
    def frequency_hz(self) -> Float[np.ndarray, " bins"]:
        """Frequencies of the bins [Hz]."""
        return np.asarray(self.target.frequency)

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the fitted parameters."""
        return tuple(name for name, p in self.parameters.items() if p.free)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was checked, in sentences: linear response against simulation, and whether there is a harmonic."""
        said = []
        if "largest_deviation" in self.check:
            percent, errors = 100 * self.check["largest_deviation"], self.check["largest_deviation_se"]
            said.append(f"simulation and linear response differ by at most {percent:.2g} % of a bin "
                        f"({errors:.1f} standard errors of {self.check['seeds']} seeds)")  # fmt: skip
        if self.harmonic_p_value is not None:
            word = "significant" if self.harmonic_p_value < 0.05 else "not significant"
            said.append(f"the harmonic is {word}: p = {self.harmonic_p_value:.2g} by bootstrap without it")
        return tuple(said)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """The figure of the fit."""
        return plot.fit(self, ax)

    def save(self, path: str | Path) -> None:
        """Write JSON atomically; `load_result` reads it back equal. The file also serves wherever a preset does."""
        write_json(path, _to_json(self))

    def __str__(self) -> str:
        verdict = "fitted" if self.success else "NOT FITTED"
        model = f"{type(self.task).__name__}, {type(self.task.noise).__name__}, {self.method}"
        lines = [f"{verdict}: {self.target.name} ({self.target.provenance}), {model}", f"  {self.message}"]
        lines += [f"  note: {notice}" for notice in self.notices]
        if self.chi2_per_bin is not None:
            lines.append(f"  chi2 per bin {self.chi2_per_bin:.2f}, rms log error {self.rms_log_error:.3f}")
        elif self.rms_log_error is not None:
            lines.append(f"  rms log error {self.rms_log_error:.3f} (no chi2: the target states no spread)")
        lines += [f"  {sentence}" for sentence in self.remarks]
        rows = [("parameter", {n: p for n, p in self.parameters.items() if p.free}), ("derived", self.derived)]
        for title, table in rows:
            lines.append(f"  {title:<24}{'value':>12}   {'std. error':<14} unit")
            for name, p in table.items():
                error = p.error_in_words(3)
                lines.append(f"  {name:<24}{p.value:>12.5g}   {error:<14} {'' if p.unit == '1' else p.unit}".rstrip())
        if self.undetermined:
            lines.append("  the data leave open (the prior keeps these near their default):")
            lines += [f"    - {sentence}" for sentence in self.undetermined]
        return folded(lines)


def estimate_to_table(p: Estimate) -> dict[str, Any]:
    """For JSON, which knows no infinite numbers."""
    value = with_nulls(float(p.value))
    return {"value": value, "unit": p.unit, "stderr": p.stderr, "free": p.free, "identifiable": p.identifiable}


def estimate_from_table(table: dict[str, Any]) -> Estimate:
    """The reverse of `estimate_to_table`."""
    value = np.nan if table["value"] is None else table["value"]
    return Estimate(value, table["unit"], table["stderr"], table["free"], table["identifiable"])


def _to_json(result: FitResult) -> dict[str, Any]:
    table = {
        "format": FORMAT,
        "success": result.success,
        "message": result.message,
        "target": result.target.name,
        "provenance": result.target.provenance,
        "task": _task_name(result.task),
        "method": result.method,
        "parameters": {name: estimate_to_table(p) for name, p in result.parameters.items()},
        "derived": {name: estimate_to_table(p) for name, p in result.derived.items()},
        "correlation": result.correlation,
        "undetermined": list(result.undetermined),
        "singular_values": with_nulls(result.singular_values),
        "chi2_per_bin": result.chi2_per_bin,
        "rms_log_error": result.rms_log_error,
        "spectrum": {
            "frequency_hz": with_nulls(result.frequency_hz),
            "target": with_nulls(result.target.proportional_power),
            "fitted": with_nulls(result.fitted),
            "harmonic_share": with_nulls(result.harmonic_share),
            "residual": with_nulls(result.residual),
            "deviation": with_nulls(result.deviation),
        },
        "starts": [{"cost": s.cost, "success": s.success, "steps": s.steps} for s in result.starts],
        "stretch": {"time": with_nulls(result.stretch[0]), "output": with_nulls(result.stretch[1])},
        "profile": None
        if result.profile is None
        else {"frequency_hz": with_nulls(result.profile[0]), "chi2_rise": with_nulls(result.profile[1])},
        "harmonic_p_value": result.harmonic_p_value,
        "check": result.check,
        "notices": list(result.notices),
        "seed": result.seed,
        "settings": result.settings,
        "versions": result.versions,
        "target_table": result.target.to_table(),
        "task_table": task_to_table(result.task),
    }
    return table


def _task_name(task: AbstractTask) -> str:
    return next((name for name, kind in TASKS.items() if isinstance(task, kind)), type(task).__name__)


def load_result(path: str | Path) -> FitResult:
    """Read the `fit.json` at `path`. Raises `ResultError` naming the file and what is wrong with it."""
    return read_saved(path, _from_json, FORMAT, "a fit result", "FitResult.save")


def read_saved(path: str | Path, made: Callable[[dict[str, Any]], R], stamp: int | str, what: str, writer: str) -> R:
    """What is `made` of a JSON file of this format. Raises `ResultError` naming the file and what is wrong with it."""
    path = Path(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ResultError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise ResultError(f"{path}: is not JSON: {error}") from None
    if not isinstance(table, dict) or table.get("format") != stamp:
        raise ResultError(f"{path}: is not {what} of format {stamp}; write it with {writer}")
    try:
        return made(table)
    except KeyError as error:
        raise ResultError(f"{path}: has no entry {error}; {choices(str(error.args[0]), table)}") from None


def _from_json(table: dict[str, Any]) -> FitResult:
    spectrum, profile = table["spectrum"], table.get("profile")

    return FitResult(
        success=table["success"],
        message=table["message"],
        task=task_from_table(table["task_table"]),
        target=Target.from_table(table["target_table"]),
        method=table["method"],
        parameters={name: estimate_from_table(p) for name, p in table["parameters"].items()},
        derived={name: estimate_from_table(p) for name, p in table["derived"].items()},
        correlation=table["correlation"],
        undetermined=tuple(table["undetermined"]),
        singular_values=from_nulls(table["singular_values"]),
        chi2_per_bin=table["chi2_per_bin"],
        rms_log_error=table["rms_log_error"],
        fitted=from_nulls(spectrum["fitted"]),
        harmonic_share=from_nulls(spectrum["harmonic_share"]),
        residual=from_nulls(spectrum["residual"]),
        deviation=from_nulls(spectrum["deviation"]),
        starts=tuple(Start(s["cost"], s["success"], s["steps"]) for s in table["starts"]),
        stretch=(from_nulls(table["stretch"]["time"]), from_nulls(table["stretch"]["output"])),
        profile=None if profile is None else (from_nulls(profile["frequency_hz"]), from_nulls(profile["chi2_rise"])),
        harmonic_p_value=table.get("harmonic_p_value"),
        check=table.get("check", {}),
        notices=tuple(table["notices"]),
        seed=table["seed"],
        settings=table["settings"],
        versions=table["versions"],
    )
