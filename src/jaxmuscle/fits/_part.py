"""What a fit found of one target, and numbers with their errors: as objects and as tables."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from jaxmuscle._common.arrays import from_nulls, with_nulls
from jaxmuscle._common.cards import Card, Shown
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import rounded
from jaxmuscle.data._target import Target
from jaxmuscle.model._task_tables import task_from_table, task_to_table
from jaxmuscle.model._tasks import TASKS, AbstractTask
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._derived import MEAN

from ._fit_file import EstimateTable, PartTable

if TYPE_CHECKING:
    import pandas

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
        known = [self.error_in_words()] if self.stderr is None else []
        known += (
            [f"95 % interval {self.interval_in_words()} {unit}".strip()]
            if self.interval_in_words()
            else []
        )
        return Card(
            f"{self.in_words()} {unit}".strip() + (f" ({'; '.join(known)})" if known else "")
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
        low, high = ("" if end is None else f"{end:.{self._digits(end)}g}" for end in self.interval)
        if low and high:
            return f"{low} to {high}"
        return f"above {low}" if low else f"below {high}" if high else "open"

    def _digits(self, end: float) -> int:
        """Three significant digits of an end of the interval, or more where both ends would else
        look the same."""
        low, high = self.interval or (None, None)
        if low is None or high is None or end == 0 or not 0 < high - low < math.inf:
            return 3
        return max(3, math.floor(math.log10(abs(end))) - math.floor(math.log10(high - low)) + 1)


class FittedPart(eqx.Module):
    """What a fit found of one target.

    Its fitted `task`; `chi2_per_bin` about `fitted` (None without knowledge of the spread) and
    `rms_log_error`, the standard deviation over the bins of ln(target / fitted); on the target's
    bins the `fitted` proportional power (of fresh seeds where they were simulated),
    `harmonic_share` of each bin's power; `residual`, target against fit [standard deviations];
    `deviation`, the standard deviation of each log power (None where it is unknown); `components`,
    what share of each bin's power the parts of the model have in linear response: the `relaxation`
    of the active tissue under its noise, the `floor` from noise on the passive one, the `harmonic`,
    the `resonance`, `resonance_2`; `stretch`, time and output of a few simulated seconds; `check`,
    how far linear response and nonlinear simulation differ; `further`, residuals of the coefficient
    of variation and of the mean, as far as they are data [standard deviations], positive where the
    model is above the data; `stiffness`, the fitted dynamic stiffness [N/m] at the frequencies of
    the target's.
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
    check: dict[str, float | int]
    further: dict[str, float]
    stiffness: Complex[np.ndarray, " points"] | None = None

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


def estimates_to_table(table: dict[str, Estimate]) -> dict[str, Any]:
    """For JSON, which knows no infinite numbers."""
    return {
        n: {
            "value": with_nulls(float(p.value)),
            "unit": p.unit,
            "stderr": p.stderr,
            "free": p.free,
            "identifiable": p.identifiable,
            "interval": None if p.interval is None else list(p.interval),
        }
        for n, p in table.items()
    }


def read_estimates(table: dict[str, EstimateTable]) -> dict[str, Estimate]:
    """The reverse of `estimates_to_table`."""
    return {
        n: Estimate(
            np.nan if p.value is None else p.value,
            p.unit,
            p.stderr,
            p.free,
            p.identifiable,
            p.interval,
        )
        for n, p in table.items()
    }


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
        "chi2_per_bin": part.chi2_per_bin,
        "rms_log_error": part.rms_log_error,
        "spectrum": {
            "frequency_hz": with_nulls(part.frequency_hz),
            "target": with_nulls(part.target.proportional_power),
            **{field: with_nulls(getattr(part, field)) for field in SPECTRUM},
            "components": {name: with_nulls(share) for name, share in part.components.items()},
        },
        "stretch": {"time": with_nulls(part.stretch[0]), "output": with_nulls(part.stretch[1])},
        "check": part.check,
        "further": part.further,
        "stiffness": (
            None
            if part.stiffness is None
            else [np.real(part.stiffness).tolist(), np.imag(part.stiffness).tolist()]
        ),
        "target_table": part.target.to_table(whole=True),
        "task_table": task_to_table(part.task),
    }


def read_part(table: PartTable) -> FittedPart:
    """The reverse of `part_to_table`."""
    spectrum, stretch, stiffness = table.spectrum, table.stretch, table.stiffness
    target = Target.from_table(table.target_table, whole=True)
    return FittedPart(
        target=target,
        task=task_from_table(table.task_table),
        chi2_per_bin=table.chi2_per_bin,
        rms_log_error=table.rms_log_error,
        **{field: from_nulls(getattr(spectrum, field)) for field in SPECTRUM},
        components={
            name: np.asarray(from_nulls(share)) for name, share in spectrum.components.items()
        },
        stretch=(from_nulls(stretch.time), from_nulls(stretch.output)),
        check=table.check,
        further=table.further,
        stiffness=(
            None if stiffness is None else np.array(stiffness[0]) + 1j * np.array(stiffness[1])
        ),
    )
