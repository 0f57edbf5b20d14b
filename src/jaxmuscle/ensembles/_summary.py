"""What is left of an ensemble that was reduced while it ran: moments, quantiles and the mean
spectrum."""

import json
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxmuscle import plot
from jaxmuscle._common.cards import Printed, Result
from jaxmuscle._common.text import folded, listed, squared
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._mean import SpectrumEstimate

from ._layout import Layout
from ._running_moments import RunningMoments, quantiles
from ._sweep import Sweep

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes


VARIATION = "coefficient_of_variation", "coefficient_of_variation_stderr"
# Fields of a spectrum, and their names as arrays.
SPECTRUM = {
    "power": "power",
    "stderr": "power_stderr",
    "plain_power": "plain_power",
    "plain_stderr": "plain_stderr",
    "expected": "power_expected",
}


class EnsembleSummary(Printed, Result, eqx.Module):
    """An ensemble reduced to its moments; of a sweep all arrays have a leading axis `point`.

    `mean` and `variance` of the output at every `time` [s] over the seeds that stayed finite,
    `quantile` at `levels`; `coefficient_of_variation` of single seeds, low-passed, in the analysed
    window with its standard error, `spectra` (one `SpectrumEstimate` per point): NaN and empty if
    the run does not cover the window; `seeds` per point; `failed`, rows (point, seed) of those that
    did not stay finite and were left out; `success`, whether there are none; `about`, how it was
    run.
    """

    task: AbstractTask | Sweep
    seeds: int
    time: Float[np.ndarray, " samples"]
    mean: Float[np.ndarray, "*points samples"]
    variance: Float[np.ndarray, "*points samples"]
    levels: tuple[float, ...]
    quantile: Float[np.ndarray, "*points levels samples"]
    coefficient_of_variation: Float[np.ndarray, "*points 2"]
    spectra: tuple[SpectrumEstimate, ...]
    failed: Int[np.ndarray, "failed 2"]
    about: dict[str, Any]

    @property
    def success(self) -> bool:
        """Whether every seed stayed finite."""
        return len(self.failed) == 0

    @property
    def message(self) -> str:
        """What failed, in words."""
        if self.success:
            return "every seed stayed finite"
        swept = isinstance(self.task, Sweep)
        names = [f"{seed} of point {point}" if swept else seed for point, seed in self.failed]
        return (
            f"{len(names)} seed(s) did not stay finite and are left out ({listed(names)}): lower"
            " the noise amplitude or dt"
        )

    @property
    def spectrum(self) -> SpectrumEstimate:
        """The mean spectrum of one task. Raises `ValueError` for a sweep (see `spectra`) and where
        there is none."""
        if isinstance(self.task, Sweep) or not self.spectra:
            reason = (
                "a sweep has one per point: use `spectra`"
                if self.spectra
                else "the run does not cover 5 s to 15 s"
            )
            raise ValueError(f"there is no single spectrum: {reason}")
        return self.spectra[0]

    @property
    def _first(self) -> AbstractTask:
        return self.task[0] if isinstance(self.task, Sweep) else self.task

    def plot(self, ax: "Axes | None" = None, point: int = 0) -> "Axes":
        """Median (or mean) and the band between the outermost quantiles against time. Returns the
        axes."""
        return plot.moments(self, ax, point)

    def to_xarray(self) -> "xarray.Dataset":
        """A Dataset with dimensions (point,) time, quantile, frequency; units, parameters and
        settings as attributes."""
        import xarray

        data = {
            name: (dims, values, {"units": units} if units else {})
            for name, (dims, values, units) in self.arrays().items()
        }
        return xarray.Dataset(data, attrs=self.attributes()).set_coords(self.coordinates())

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each (point and) time: `time`, `mean`, `variance`, and a column for each
        quantile, as `quantile_0.5`."""
        data = self.to_xarray()
        levels = {
            f"quantile_{level:g}": data["quantiles"].sel(quantile=level, drop=True)
            for level in self.levels
        }
        return data[["mean", "variance"]].assign(levels).to_dataframe().reset_index()

    def coordinates(self) -> list[str]:
        """Names of what labels the dimensions."""
        labels = list(self.task.labels) if isinstance(self.task, Sweep) else []
        return ["time", "quantile", *(["frequency"] if self.spectra else []), *labels]

    def attributes(self) -> dict[str, Any]:
        """What was run, and which seeds failed."""
        return self.about | {"failed": json.dumps(self.failed.tolist())}

    def arrays(self) -> dict[str, tuple[tuple[str, ...], np.ndarray, str]]:
        """Dimensions, values and unit of everything, by name."""
        unit, swept = self._first.output_unit, isinstance(self.task, Sweep)
        lead = ("point",) if swept else ()
        found: dict[str, tuple[tuple[str, ...], np.ndarray, str]] = {
            "time": (("time",), self.time, "s"),
            "quantile": (("quantile",), np.array(self.levels), "1"),
            "mean": ((*lead, "time"), self.mean, unit),
            "variance": ((*lead, "time"), self.variance, squared(unit)),
            "quantiles": ((*lead, "quantile", "time"), self.quantile, unit),
        }
        if self.spectra:
            found["frequency"] = ("frequency",), np.asarray(self.spectra[0].frequency), "Hz"
            for i, name in enumerate(VARIATION):
                found[name] = lead, self.coefficient_of_variation[..., i], "1"
            for name, label in SPECTRUM.items():
                rows = [getattr(spectrum, name) for spectrum in self.spectra]
                if rows[0] is not None:
                    values = np.stack(rows) if swept else rows[0]
                    found[label] = ((*lead, "frequency"), values, squared(unit) + "/Hz")
        if isinstance(self.task, Sweep):
            found |= {name: (("point",), values, "") for name, values in self.task.labels.items()}
        return found

    def __str__(self) -> str:
        swept = isinstance(self.task, Sweep)
        where = f", {len(self.task)} points" if isinstance(self.task, Sweep) else ""
        lines = [
            (
                f"ensemble: {type(self._first).__name__}, {self.seeds} seeds{where},"
                f" {self.time[-1]:g} s"
            ),
            f"  {self.message}",
        ]
        if self.spectra and not swept and self._first.quantity != "acceleration":
            value, error = self.coefficient_of_variation
            lines.append(f"  coefficient of variation {100 * value:.4g} % +- {100 * error:.2g} %")
        return folded(lines)


def computed(
    tally: RunningMoments,
    levels: tuple[float, ...],
    expected: Float[np.ndarray, "points bins"] | None,
) -> dict[str, Float[np.ndarray, "points ..."]]:
    """All that a tally says, by the names of `EnsembleSummary.arrays`; `expected`, the exact linear
    spectra or None."""
    samples = tally.low.shape[1]
    # then come power, what the linear response leaves of it, and variation
    bins = (tally.mean.shape[1] - samples) // 2
    with np.errstate(invalid="ignore", divide="ignore"):
        seen = np.where(tally.seeds > 0, tally.seeds, np.nan)[:, None]
        averages = tally.mean + 0 * seen
        variance = tally.squares / np.where(seen > 1, seen - 1, np.nan)
        stderr = np.sqrt(variance / seen)
    found = {
        "mean": averages[:, :samples],
        "variance": variance[:, :samples],
        "quantiles": quantiles(tally, levels),
    }
    if not bins:
        return found
    plain, left = slice(samples, samples + bins), slice(samples + bins, samples + 2 * bins)
    found |= dict(zip(VARIATION, (averages[:, -1], stderr[:, -1]), strict=True))
    found |= {"plain_power": averages[:, plain], "plain_stderr": stderr[:, plain]}
    if expected is None:
        return found | {"power": averages[:, plain], "power_stderr": stderr[:, plain]}
    return found | {
        "power": expected + averages[:, left],
        "power_stderr": stderr[:, left],
        "power_expected": expected,
    }


def summarised(
    layout: Layout,
    levels: tuple[float, ...],
    arrays: dict[str, np.ndarray],
    failed: Int[np.ndarray, "failed 2"],
    about: dict[str, Any],
) -> EnsembleSummary:
    """What `arrays` say, which are named and shaped as `EnsembleSummary.arrays` has them."""
    task, settings, spectra = layout.task, layout.recipe.settings, []
    if "power" in arrays:
        variation = np.stack([arrays[name] for name in VARIATION], axis=-1)
        rows = {n: np.atleast_2d(arrays[label]) for n, label in SPECTRUM.items() if label in arrays}
        for i in range(layout.points):
            row: dict[str, Any] = {"expected": None} | {n: values[i] for n, values in rows.items()}
            left = len(layout.seeds) - int(np.sum(failed[:, 0] == i))
            unit = layout.task_of(i).output_unit
            spectra.append(
                SpectrumEstimate(
                    settings.frequency, **row, seeds=left, settings=settings, unit=unit
                )
            )
    else:
        variation = np.full((*arrays["mean"].shape[:-1], 2), np.nan)
    return EnsembleSummary(
        task,
        len(layout.seeds),
        layout.time,
        arrays["mean"],
        arrays["variance"],
        levels,
        arrays["quantiles"],
        variation,
        tuple(spectra),
        failed,
        about,
    )
