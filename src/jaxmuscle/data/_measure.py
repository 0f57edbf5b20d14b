"""A measured number with its standard error and its 95 % interval."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
import scipy

from jaxmuscle._common.cards import Card, Shown
from jaxmuscle._common.text import digits, rounded
from jaxmuscle.spectra._bin_law import NORMAL, student

RARE = 0.01  # probability of so little scatter
FARTHEST = 300.0  # logarithm of a factor, so that no end overflows


class Measure(Shown, eqx.Module):
    """A `value` with its standard error `stderr` (`None` if there is none), both in `unit` ("1" for
    pure numbers).

    `error_from` says what the error stands on: "trials", the scatter between three or more trials;
    or, of fewer trials, what is within them: "spectrum", "parts" or "segments", see `steadiness`;
    "bins", where only a spectrum is known.
    `interval` has the ends of the 95 % interval, in `unit`, `None` where there is no error. A value
    that does not exist is NaN.
    """

    value: float
    stderr: float | None
    unit: str
    error_from: str
    interval: tuple[float, float] | None = None

    @classmethod
    def from_row(cls, row: Sequence[Any]) -> "Measure":
        """Of value, standard error, low and high end, unit and `error_from`, with `None` for what
        does not exist."""
        value, error, low, high, unit, error_from = row
        interval = None if low is None else (low, high)
        return cls(math.nan if value is None else value, error, unit, error_from, interval)

    def times(self, factor: float, unit: str | None = None) -> "Measure":
        """The number in another scale, and in another unit."""
        low, high = sorted(factor * end for end in self.interval or (math.nan, math.nan))
        error = None if self.stderr is None else abs(factor) * self.stderr
        return Measure(
            factor * self.value,
            error,
            unit or self.unit,
            self.error_from,
            self.interval and (low, high),
        )

    def in_words(self) -> str:
        """The value, rounded to its error where it has one."""
        if self.stderr is None:
            return "none" if math.isnan(self.value) else digits(self.value)
        return " ± ".join(rounded(self.value, self.stderr))

    def interval_in_words(self) -> str:
        """The 95 % interval, empty where there is none."""
        if self.interval is None or self.stderr is None:
            return ""
        return " to ".join(rounded(end, self.stderr)[0] for end in self.interval)

    def _card(self) -> Card:
        unit = "" if self.unit == "1" or math.isnan(self.value) else f" {self.unit}"
        interval = self.interval_in_words()
        return Card(
            f"{self.in_words()}{unit}" + f" (95 % interval {interval}{unit})" * bool(interval)
        )

    def row(self) -> dict[str, Any]:
        """As columns of a table, NaN for what does not exist."""
        low, high = self.interval or (math.nan, math.nan)
        error = math.nan if self.stderr is None else self.stderr
        return {
            "value": self.value,
            "stderr": error,
            "low": low,
            "high": high,
            "unit": self.unit,
            "error_from": self.error_from,
        }


def likelier_error(each: Sequence[Measure]) -> float | None:
    """The error of a mean by the own errors e of its values, if these scatter (s) so little that it
    must be chance.

    (n - 1) s² / e² has a chi-squared law of n - 1 degrees of freedom where nothing else than these
    errors acts, and a larger value where the values truly differ.
    """
    errors = np.array([math.nan if m.stderr is None else m.stderr for m in each])
    scatter = (
        (len(each) - 1) * float(np.var([m.value for m in each], ddof=1)) / float(np.mean(errors**2))
    )
    return (
        math.hypot(*errors) / len(each)
        if scipy.special.chdtr(len(each) - 1, scatter) < RARE
        else None
    )


def normal_interval(value: float, error: float) -> tuple[float, float]:
    """`value ± 1.96 error`, of a normal law."""
    return value - NORMAL * error, value + NORMAL * error


def student_interval(value: float, error: float, degrees: int) -> tuple[float, float]:
    """`value ± t error`, with the t of Student that so many degrees of freedom of the squared error
    ask for."""
    reach = student(degrees + 1) * error
    return value - reach, value + reach


def log_interval(value: float, error: float) -> tuple[float, float]:
    """`value · exp(± 1.96 error / value)`, normal in the logarithm; of 0, which has no error, 0 to
    0."""
    if value <= 0:
        return value, value
    factor = math.exp(min(NORMAL * error / value, FARTHEST))
    return value / factor, value * factor


def logit_interval(share: float, error: float) -> tuple[float, float]:
    """That of the odds p / (1 - p), normal in their logarithm, so that both ends are shares; of 0
    and 1, themselves."""
    if share >= 1:
        return share, share
    low, high = log_interval(share / (1 - share), error / (1 - share) ** 2)
    return low / (1 + low), high / (1 + high)
