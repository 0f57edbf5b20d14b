"""The result of a joint fit: shared and separate parameters, and every target's spectrum."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import from_nulls, with_nulls
from jaxmuscle._common.files import write_json
from jaxmuscle._common.text import folded
from jaxmuscle.data._target import Target
from jaxmuscle.model._presets import task_from_table, task_to_table
from jaxmuscle.model._tasks import AbstractTask

from ._result import Estimate, Start, estimate_from_table, estimate_to_table, read_saved

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


FORMAT = "joint-1"
SPECTRUM = ("fitted", "harmonic_share", "residual", "deviation")


class JointPart(eqx.Module):
    """What a joint fit found of one target.

    Its fitted `task`; `chi2_per_bin` (None without knowledge of the spread) and `rms_log_error`; on the target's bins the
    `fitted` proportional power, `harmonic_share` of each bin's power, `residual` and `deviation` [standard deviations, log
    power]; `nonlinearity`, the largest relative distance of a bin between simulation and linear response (None if not
    simulated).
    """

    target: Target
    task: AbstractTask
    chi2_per_bin: float | None
    rms_log_error: float | None
    fitted: Float[np.ndarray, " bins"]
    harmonic_share: Float[np.ndarray, " bins"]
    residual: Float[np.ndarray, " bins"]
    deviation: Float[np.ndarray, " bins"] | None
    nonlinearity: float | None


class JointResult(eqx.Module):
    """What a joint fit found.

    `success` and `message` (in words); `parts`, a `JointPart` for each target by name; `parameters`, all of them, and
    `derived`, `Estimate`s in natural units: what belongs to one target is called "name@target", what is the same number
    for all by its own name; `correlation` of the free parameters; `undetermined`, sentences naming the directions that all
    targets together leave open; `singular_values` (residuals in standard deviations, parameters in the prior's); the table
    of `starts`; `notices`; `seed`; `settings`; `versions`.
    """

    success: bool
    message: str
    parts: dict[str, JointPart]
    parameters: dict[str, Estimate]
    derived: dict[str, Estimate]
    correlation: dict[str, Any]
    undetermined: tuple[str, ...]
    singular_values: Float[np.ndarray, " free"]
    starts: tuple[Start, ...]
    notices: tuple[str, ...]
    seed: int | None
    settings: dict[str, Any]
    versions: dict[str, str]

    @property
    def tasks(self) -> dict[str, AbstractTask]:
        """The fitted task of every target."""
        return {name: part.task for name, part in self.parts.items()}

    @property
    def targets(self) -> dict[str, Target]:
        """The targets."""
        return {name: part.target for name, part in self.parts.items()}

    @property
    def free(self) -> tuple[str, ...]:
        """Names of the fitted parameters."""
        return tuple(name for name, p in self.parameters.items() if p.free)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """One row per target: its spectrum with the fit, and the residuals; below, what was found."""
        return plot.joint(self, ax)

    def save(self, path: str | Path) -> None:
        """Write JSON atomically; `load_joint_result` reads it back equal."""
        write_json(path, _to_json(self))

    def __str__(self) -> str:
        verdict = "fitted together" if self.success else "NOT FITTED"
        lines = [f"{verdict}: {', '.join(self.parts)}", f"  {self.message}"]
        for name, part in self.parts.items():
            model = f"{type(part.task).__name__}, {type(part.task.noise).__name__}"
            fitted = "" if part.chi2_per_bin is None else f", chi2 per bin {part.chi2_per_bin:.2f}"
            error = "" if part.rms_log_error is None else f", rms log error {part.rms_log_error:.3f}"
            lines.append(f"  {name}: {part.target.name}, {model}{fitted}{error}")
            if part.nonlinearity is not None:
                lines.append(
                    f"    simulation and linear response differ by at most {100 * part.nonlinearity:.2g} % of a bin"
                )
        lines += [f"  note: {notice}" for notice in self.notices]
        wide = 2 + max(map(len, ("parameter", *self.free, *self.derived)))
        for title, table in (("parameter", {n: self.parameters[n] for n in self.free}), ("derived", self.derived)):
            lines.append(f"  {title:<{wide}}{'value':>12}   {'std. error':<14} unit")
            for name, p in table.items():
                unit = "" if p.unit == "1" else p.unit
                lines.append(f"  {name:<{wide}}{p.value:>12.5g}   {p.error_in_words(3):<14} {unit}".rstrip())
        if self.undetermined:
            lines.append("  all targets together leave open (the prior keeps these near their default):")
            lines += [f"    - {sentence}" for sentence in self.undetermined]
        return folded(lines)


def _to_json(result: JointResult) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "success": result.success,
        "message": result.message,
        "parameters": {name: estimate_to_table(p) for name, p in result.parameters.items()},
        "derived": {name: estimate_to_table(p) for name, p in result.derived.items()},
        "correlation": result.correlation,
        "undetermined": list(result.undetermined),
        "singular_values": with_nulls(result.singular_values),
        "parts": {
            name: {
                "chi2_per_bin": part.chi2_per_bin,
                "rms_log_error": part.rms_log_error,
                "frequency_hz": with_nulls(part.target.frequency),
                **{field: with_nulls(getattr(part, field)) for field in SPECTRUM},
                "nonlinearity": part.nonlinearity,
                "target_table": part.target.to_table(),
                "task_table": task_to_table(part.task),
            }
            for name, part in result.parts.items()
        },
        "starts": [{"cost": s.cost, "success": s.success, "steps": s.steps} for s in result.starts],
        "notices": list(result.notices),
        "seed": result.seed,
        "settings": result.settings,
        "versions": result.versions,
    }


def load_joint_result(path: str | Path) -> JointResult:
    """Read what `JointResult.save` wrote to `path`. Raises `ResultError` naming the file and what is wrong with it."""
    return read_saved(path, _from_json, FORMAT, "a joint result", "JointResult.save")


def _from_json(table: dict[str, Any]) -> JointResult:
    def part(p: dict[str, Any]) -> JointPart:
        spectra = {field: from_nulls(p[field]) for field in SPECTRUM}
        return JointPart(
            Target.from_table(p["target_table"]), task_from_table(p["task_table"]), p["chi2_per_bin"], p["rms_log_error"],
            **spectra, nonlinearity=p["nonlinearity"],
        )  # fmt: skip

    return JointResult(
        success=table["success"],
        message=table["message"],
        parts={name: part(p) for name, p in table["parts"].items()},
        parameters={name: estimate_from_table(p) for name, p in table["parameters"].items()},
        derived={name: estimate_from_table(p) for name, p in table["derived"].items()},
        correlation=table["correlation"],
        undetermined=tuple(table["undetermined"]),
        singular_values=from_nulls(table["singular_values"]),
        starts=tuple(Start(s["cost"], s["success"], s["steps"]) for s in table["starts"]),
        notices=tuple(table["notices"]),
        seed=table["seed"],
        settings=table["settings"],
        versions=table["versions"],
    )
