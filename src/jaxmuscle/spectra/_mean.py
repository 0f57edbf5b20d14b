"""A mean spectrum with its standard error, with and without a control variate."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Card, Shown, facts

from ._settings import SpectrumSettings
from ._welch import Spectrum, is_known

Bins = Float[Array | np.ndarray, " bins"]


class SpectrumEstimate(Shown, eqx.Module):
    """A Monte Carlo estimate of an expected Welch spectrum.

    **Fields**, per bin: `frequency` [Hz]; `power` [`unit`²/Hz] and its standard error `stderr`,
    with the control variate where there is one; `plain_power`, `plain_stderr` without it;
    `expected`, the exact spectrum of the linear response, or None; `seeds`, how many; `settings`;
    `unit`.
    """

    frequency: Bins
    power: Bins
    stderr: Bins
    plain_power: Bins
    plain_stderr: Bins
    expected: Bins | None
    seeds: int = eqx.field(static=True)
    settings: SpectrumSettings = eqx.field(static=True)
    unit: str = eqx.field(static=True)

    def _card(self) -> Card:
        numbers = (self.power, self.stderr, self.plain_stderr)
        if not all(map(is_known, numbers)):
            return Card(eqx.tree_pformat(self))  # a tree that JAX or Equinox took apart
        power, *errors = (np.asarray(x) for x in numbers)
        error, plain = (100 * float(np.median(each / power)) for each in errors)
        rows = [("seeds", f"{self.seeds}"), ("error", f"{error:.2g} % of a bin (median)")]
        if self.expected is not None:
            rows.append(("control", f"linear response; without it the error is {plain:.2g} %"))
        spectrum = self.spectrum._card()
        return facts(f"mean {spectrum.heading}", [*rows, *spectrum.rows])  # pyright: ignore[reportArgumentType]

    @property
    def proportional(self) -> Bins:
        """Power of each bin over the sum of all bins."""
        return self.power / self.power.sum()

    @property
    def spectrum(self) -> Spectrum:
        """The estimate as a `Spectrum`."""
        return Spectrum(self.frequency, self.power, self.settings, self.unit)

    @property
    def nonlinearity(self) -> Bins:
        """What the linear response misses of each bin, `power / expected - 1`. Raises `ValueError`
        without control."""
        if self.expected is None:
            raise ValueError(
                "there is no control variate to compare with: simulate with control=True"
            )
        return self.power / self.expected - 1

    @property
    def variance_reduction(self) -> Bins:
        """How many times more seeds a plain mean would need for the same error, `(plain_stderr /
        stderr)²`."""
        return (self.plain_stderr / self.stderr) ** 2

    def plot(self, ax: Any = None, *, log: bool = False) -> Any:
        """Proportional power with its error band; `log`: both axes logarithmic. Returns the
        axes."""
        return plot.estimate(self, ax, log=log)


def estimated(
    plain: Float[Array | np.ndarray, "seeds bins"],
    beside: Float[Array | np.ndarray, "seeds bins"] | None,
    expected: Bins | None,
    settings: SpectrumSettings,
    unit: str,
) -> SpectrumEstimate:
    """From the Welch powers of every seed and, if there are any, those of the linearised task and
    their expectation."""
    count = len(plain)

    def summary(rows):
        known = count > 1
        spread = rows.std(axis=0, ddof=1) if known else np.full(rows.shape[1], np.nan)
        return rows.mean(axis=0), spread / count**0.5

    power, stderr = mean, error = summary(plain)
    if beside is not None and expected is not None:
        difference, stderr = summary(plain - beside)
        power = expected + difference
    known = None if beside is None else expected
    own = (power, stderr, mean, error, known, count)
    return SpectrumEstimate(settings.frequency, *own, settings, unit)
