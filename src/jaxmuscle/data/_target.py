"""Targets: a measured, digitised or reconstructed proportional power spectrum to fit a model to."""

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import tomli_w
from jaxtyping import Float, Int

from jaxmuscle import plot
from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.files import write_text
from jaxmuscle._common.text import folded
from jaxmuscle.spectra._bin_law import bin_statistics
from jaxmuscle.spectra._settings import SpectrumSettings

from . import _target_fields as check
from ._target_fields import GRID_TOLERANCE, PIXEL_OF_LOG, PIXEL_TOLERANCE, Provenance, Quantity
from ._target_files import KEYS, Raw, read_target

# A sum this near to 1 is rounding of the printed numbers, not another scale.
SUM_TOLERANCE = 1e-3


class Target(eqx.Module):
    """A proportional power spectrum p_k = P_k / Σ_j P_j on the bins k that are covered, and its origin.

    **Arguments:**

    - `name`: how reports call it.
    - `proportional_power`: p_k > 0, shape `(bins,)`; divided by its sum. At `frequency` [Hz] afterwards.
    - `bins`: bin numbers on the grid of `settings`, increasing; all selected bins by default.
    - `quantity`: what was recorded; torque is fitted as force, since p has no scale.
    - `provenance`, `source`: how and from where the numbers were obtained.
    - `reason`: what a reconstruction assumes.
    - `sigma`: standard deviation of p_k, scaled together with it.
    - `segments`: Welch segments K of each trial averaged.
    - `coefficient_of_variation`: standard deviation over mean of each trial, a fraction; of the force as the spectrum sees
      it, low-passed as `settings` say.
    - `mvc_fraction`: mean level as a fraction of the maximum voluntary contraction.
    - `settings`: how the spectrum was estimated, and thus how the model's is.
    - `notices`: what was done to the numbers, in sentences.

    **Raises:** `TargetError`, a `ValueError`, naming the argument, its value and the remedy.
    """

    frequency: Float[np.ndarray, " bins"]
    bins: Int[np.ndarray, " bins"]
    proportional_power: Float[np.ndarray, " bins"]
    sigma: Float[np.ndarray, " bins"] | None
    name: str = eqx.field(static=True)
    quantity: Quantity = eqx.field(static=True)
    provenance: Provenance = eqx.field(static=True)
    source: str = eqx.field(static=True)
    segments: tuple[int, ...] | None = eqx.field(static=True)
    coefficient_of_variation: tuple[float, ...] | None = eqx.field(static=True)
    mvc_fraction: float | None = eqx.field(static=True)
    reason: str | None = eqx.field(static=True)
    settings: SpectrumSettings = eqx.field(static=True)
    notices: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        proportional_power: Any,
        *,
        bins: Any = None,
        quantity: str = "force",
        provenance: str = "user",
        source: str = "given by the user",
        sigma: Any = None,
        segments: int | Sequence[int] | None = None,
        coefficient_of_variation: float | Sequence[float] | None = None,
        mvc_fraction: float | None = None,
        reason: str | None = None,
        settings: SpectrumSettings | None = None,
        notices: Iterable[str] = (),
    ):
        settings = SpectrumSettings() if settings is None else settings
        self.name, self.source = check.metadata("name", name), check.metadata("source", source)
        self.quantity = check.metadata("quantity", quantity)
        self.provenance = check.metadata("provenance", provenance)
        self.segments = check.metadata("segments", segments)
        self.coefficient_of_variation = check.metadata("coefficient_of_variation", coefficient_of_variation)
        self.mvc_fraction = check.metadata("mvc_fraction", mvc_fraction)
        self.reason = check.metadata("reason", reason)
        self.settings = settings
        selected = np.arange(settings.first_bin, settings.last_bin + 1)
        self.bins = check.frozen(selected if bins is None else check.bin_numbers(bins, settings))
        self.frequency = check.frozen(settings.frequency[self.bins - settings.first_bin])
        power = check.positive("proportional_power", proportional_power, self.bins.size)
        deviation = None if sigma is None else check.positive("sigma", sigma, self.bins.size)
        self.proportional_power, self.sigma = _normalised(power, deviation)
        own = _own_notices(self, float(np.sum(power)))
        self.notices = tuple(dict.fromkeys((*check.metadata("notices", list(notices)), *own)))

    @property
    def degrees_of_freedom(self) -> float | None:
        """Equivalent degrees of freedom ν of each bin, the sum over the trials; `None` without `segments`."""
        if self.segments is None:
            return None
        return float(sum(self.settings.degrees_of_freedom(K) for K in self.segments))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write TOML that `load_target` reads back equal; an existing file is replaced in one step.

        **Raises:** `TargetError` if the path does not end in .toml or cannot be written.
        """
        path = Path(path).expanduser()
        if path.suffix.lower() != ".toml":
            raise TargetError(f"{path}: a target is saved as TOML; give a name that ends in .toml")
        if not path.parent.is_dir():
            raise TargetError(f"{path}: cannot be written: there is no folder {path.parent}")
        try:
            write_text(path, tomli_w.dumps(self.to_table()))
        except OSError as error:
            raise TargetError(f"{path}: cannot be written: {error.strerror}") from None

    def sampling_band(self) -> tuple[Float[np.ndarray, " bins"], Float[np.ndarray, " bins"]] | None:
        """Lower and upper edge of p_k exp(-bias ± sd), where the expected spectrum lies within one standard deviation.

        `None` if nothing is known about the sampling error.
        """
        statistics = bin_statistics(self)
        if not statistics.known:
            return None
        centre = self.proportional_power * np.exp(-statistics.bias)
        return centre * np.exp(-statistics.sd), centre * np.exp(statistics.sd)

    def to_table(self) -> dict[str, Any]:
        """The target as the table that a TOML file holds."""
        sigma = None if self.sigma is None else self.sigma.tolist()
        arrays = {"frequency_hz": self.frequency.tolist(), "settings": self.settings.to_dict()}
        arrays |= {"proportional_power": self.proportional_power.tolist(), "sigma": sigma}
        table = {key: arrays[key] if key in arrays else getattr(self, key) for key in KEYS}
        return {key: value for key, value in table.items() if value not in (None, ())}

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> "Target":
        """The reverse of `to_table`; its frequencies lie on the bins."""
        fields = dict(table)
        settings = SpectrumSettings.from_dict(fields.pop("settings"))
        bins = np.rint(np.asarray(fields.pop("frequency_hz")) / settings.resolution).astype(int)
        return cls(**fields, bins=bins, settings=settings)

    def plot(self, ax: Any = None, *, log: bool = False) -> Any:
        """Draw the spectrum, see `jaxmuscle.plot.target`; `log`: both axes logarithmic. Returns the axes."""
        return plot.target(self, ax, log=log)

    def __str__(self) -> str:
        peak = int(np.argmax(self.proportional_power))
        f, p, settings = self.frequency, self.proportional_power, self.settings
        lines = [
            f"{self.name}: proportional power of {self.quantity}, {self.provenance}",
            f"  source    {self.source}",
            f"  spectrum  {settings.name or 'settings of its own'}",
            f"  bins      {f.size} of {settings.frequency.size}, {f[0]:.3f} to {f[-1]:.3f} Hz",
            f"  maximum   {p[peak]:.3f} at {f[peak]:.3f} Hz",
        ]
        if self.segments is not None:
            lines.append(f"  segments  {_words(self.segments)} ({self.degrees_of_freedom:.1f} degrees of freedom)")
        if self.coefficient_of_variation is not None:
            variation = ", ".join(f"{100 * value:.3g} %" for value in self.coefficient_of_variation)
            lines.append(f"  coefficient of variation  {variation}")
        if self.mvc_fraction is not None:
            lines.append(f"  level     {100 * self.mvc_fraction:.4g} % MVC")
        return folded(lines + [f"  notice    {notice}" for notice in self.notices])


def load_target(
    name_or_path: str | os.PathLike[str],
    *,
    quantity: str | None = None,
    segments: int | Sequence[int] | None = None,
    dataset: str | None = None,
    axis: str = "linear",
) -> Target:
    """Load a bundled target by name, or a .toml or .csv file or a digitised figure by path.

    A CSV has the columns `frequency_hz,proportional_power[,sigma]`, sorted and unique. A figure digitised with
    WebPlotDigitizer is its project (.json, .tar), its CSV of all datasets, or two columns without a header; its
    points are sorted and near-duplicates averaged (docs/digitise.md). Points off the grid are interpolated onto
    the bins in log power, and in log frequency from a logarithmic axis; bins that are not covered are left out,
    and power is rescaled to sum to 1 over the others. The target's `notices` say which of these happened.

    **Arguments:**

    - `name_or_path`: see `list_targets` for the names.
    - `quantity` and `segments` (Welch segments of each trial) replace what the file says.
    - `dataset`: which of several datasets of a figure.
    - `axis`: `"log-log"` if a figure's points are log10 of frequency [Hz] and of power, calibrated in decades.

    **Raises:** `TargetError`, a `ValueError`, naming file and line or key, what is wrong and what is right.
    """
    raw = read_target(name_or_path, dataset, axis)
    file, fields, notices = raw.file, raw.fields, raw.notices
    for key, value in (("quantity", quantity), ("segments", segments)):
        if value is None:
            continue
        asked = check.metadata(key, value)
        if fields.get(key, asked) != asked:
            notices.append(f"{key} {_words(asked)} as asked; the file says {_words(fields[key])}")
        fields[key] = asked
    try:
        points, more = _on_grid(raw, fields["settings"])
        notices = (*fields.pop("notices", ()), *notices, *more)
        return Target(**fields, **points._asdict(), notices=notices)
    except TargetError as error:
        raise TargetError(f"{file}: {error}") from None


def _words(value: str | tuple[int, ...]) -> str:
    return value if isinstance(value, str) else " + ".join(map(str, value))


class _Points(NamedTuple):
    bins: np.ndarray
    proportional_power: np.ndarray
    sigma: np.ndarray | None = None


def _on_grid(raw: Raw, settings: SpectrumSettings) -> tuple[_Points, list[str]]:
    """The rows on the bins they cover: as they are if all lie on bins, else interpolated in log power."""
    columns = raw.columns
    position = np.minimum(columns.frequency / settings.resolution, 1e9)
    tolerance = np.full(position.size, PIXEL_TOLERANCE if raw.digitised else GRID_TOLERANCE)
    if raw.log_frequency:
        tolerance = np.maximum(tolerance, PIXEL_OF_LOG * position)
    bins = np.rint(position).astype(int)
    first, last = settings.first_bin, settings.last_bin
    aligned = np.all(np.abs(position - bins) <= tolerance) and np.unique(bins).size == bins.size
    notices = []
    if aligned:
        inside = (bins >= first) & (bins <= last)
        sigma = None if columns.sigma is None else columns.sigma[inside]
        points = _Points(bins[inside], columns.power[inside], sigma)
        if (off := np.max(np.abs(position - bins)[inside], initial=0)) > GRID_TOLERANCE:
            notices.append(f"points up to {off:.2g} bins off the grid: taken as on the bins, within a pixel of a figure")
        if not np.all(inside):
            notices.append(f"rows outside bins {first} to {last} left out: {np.sum(~inside)}")
    else:
        every = np.arange(first, last + 1)
        low, high = position[0] - tolerance[0], position[-1] + tolerance[-1]
        covered = every[(every >= low) & (every <= high)]
        logs = [np.log(values) for values in (columns.power, columns.sigma) if values is not None]
        at, known = (np.log(covered), np.log(position)) if raw.log_frequency else (covered, position)
        points = _Points(covered, *(np.exp(np.interp(at, known, log)) for log in logs))
        gap, scale = f"{np.max(np.diff(columns.frequency), initial=0):.3g}", " and frequency" * raw.log_frequency
        notices.append(f"frequencies off the grid: interpolated onto the bins in log power{scale} (widest gap {gap} Hz)")
    if points.bins.size < 2:
        raise TargetError(
            f"covers {points.bins.size} of the bins {first} to {last} ({settings.frequency[0]:.4g} to "
            f"{settings.frequency[-1]:.4g} Hz), at least 2 are needed; frequencies are in Hz"
        )
    return points, notices


def _normalised(power: np.ndarray, sigma: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Both over the sum of the power, unless that is 1 to rounding: a saved target is read back exactly."""
    total = np.sum(power)
    total = 1.0 if abs(total - 1) < 1e-12 else total
    return check.frozen(power / total), None if sigma is None else check.frozen(sigma / total)


def _own_notices(target: Target, total: float) -> list[str]:
    settings, notices = target.settings, []
    missing = np.setdiff1d(np.arange(settings.first_bin, settings.last_bin + 1), target.bins)
    if missing.size:
        runs = np.split(missing, np.flatnonzero(np.diff(missing) > 1) + 1)
        spans = ", ".join(f"{run[0]}" if run.size == 1 else f"{run[0]} to {run[-1]}" for run in runs)
        notices.append(f"bins not covered and left out: {spans} (bin spacing {settings.resolution:g} Hz)")
    if abs(total - 1) > SUM_TOLERANCE:
        notices.append(f"proportional power summed to {total:.4g} over the bins covered: rescaled to 1")
    if target.provenance == "reconstructed":
        if target.reason is None:
            raise TargetError("a reconstructed target needs a reason: a sentence that says what was assumed")
        notices.append(f"reconstructed from what the text states, not measured: {target.reason}")
    return notices
