"""The numbers of a recording: level, variability, regularity, spectral peaks."""

import dataclasses
import math
from typing import Any

import equinox as eqx

from ._metrics import Peaks


class RecordingSummary(eqx.Module):
    """Numbers of a window.

    Its `duration` [s] and Welch `segments`; `mean` and `standard_deviation` in `unit`; without unit
    `coefficient_of_variation`, its inverse `signal_to_noise`, `approximate_entropy` and `sample_entropy` (m = 2,
    r = 0.2 σ); `peaks` of the spectrum [Hz].
    """

    unit: str
    duration: float
    segments: int
    mean: float
    standard_deviation: float
    coefficient_of_variation: float
    signal_to_noise: float
    approximate_entropy: float
    sample_entropy: float
    peaks: Peaks

    def rows(self) -> list[tuple[str, str]]:
        """Name and value of every number, as tables print them."""
        local = ", ".join(f"{peak.interpolated:.3f}" for peak in self.peaks.local_maxima) or "none"
        return [
            ("window", f"{self.duration:.2f} s, {self.segments} Welch segments"),
            ("mean", f"{self.mean:.4g} {self.unit}"),
            ("standard deviation", f"{self.standard_deviation:.4g} {self.unit}"),
            ("coefficient of variation", f"{100 * self.coefficient_of_variation:.3g} %"),
            ("signal-to-noise ratio", f"{self.signal_to_noise:.4g}"),
            ("approximate entropy", f"{self.approximate_entropy:.4f}"),
            ("sample entropy", f"{self.sample_entropy:.4f}"),
            ("maximum", f"{self.peaks.maximum.interpolated:.3f} Hz, {self.peaks.maximum.power:.3f} of the power"),
            ("local maxima", f"{local} Hz" if self.peaks.local_maxima else local),
        ]

    def __str__(self) -> str:
        return "\n".join(f"{name:<26}{value}" for name, value in self.rows())

    def to_dict(self) -> dict[str, Any]:
        """The same for JSON, with `None` for what is not finite."""
        return _plain(dataclasses.asdict(self))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
