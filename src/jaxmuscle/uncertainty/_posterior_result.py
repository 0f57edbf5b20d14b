"""What a posterior says: draws, summary, and the file they are kept in."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.errors import NotMixedError
from jaxmuscle._common.files import replacing, write_json
from jaxmuscle._common.text import folded
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._consequences import UNITS, unit_of

from ._chains import Chains
from ._posterior_checks import Replicates

if TYPE_CHECKING:
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


CREDIBLE = (0.025, 0.975)


class Posterior(eqx.Module):
    """Draws from the posterior of a fit; arrays have leading axes (chain, draw).

    `success` and `message`: whether the chains mixed, or why not; `samples` of the free parameters and `derived` quantities
    in natural units; `diagnostics` {name: (R-hat, effective size of the bulk, of the tails)}; `determined`, the names that
    the data determine; `replicates`, what spectra the posterior predicts; `chains`, how it was drawn; `modes` of the
    harmonic's frequency [(Hz, Hz, Hz, probability)] as (from, median, to, share).
    """

    success: bool
    message: str
    task: AbstractTask
    target: Target
    samples: dict[str, Float[np.ndarray, "chains draws"]]
    derived: dict[str, Float[np.ndarray, "chains draws"]]
    diagnostics: dict[str, tuple[float, float, float]]
    determined: tuple[str, ...]
    modes: tuple[tuple[float, float, float, float], ...]
    replicates: Replicates
    chains: Chains
    settings: dict[str, Any]
    seed: int | None
    versions: dict[str, str]

    @property
    def divergences(self) -> int:
        """How many draws were divergent."""
        return int(self.chains.diverging.sum())

    @property
    def quantities(self) -> dict[str, Float[np.ndarray, "chains draws"]]:
        """Parameters, then derived quantities."""
        return self.samples | self.derived

    def summary(self) -> "Summary":
        """Mean, sd, median and 95 % interval of every quantity. Raises `NotMixedError` if the chains did not mix."""
        if not self.success:
            raise NotMixedError(f"{self.target.name}: {self.message}")
        rows = {}
        for name, draws in self.quantities.items():
            low, middle, high = np.quantile(draws, (CREDIBLE[0], 0.5, CREDIBLE[1]))
            rows[name] = (float(draws.mean()), float(draws.std(ddof=1)), float(middle), float(low), float(high))
        return Summary(rows, self.diagnostics, self.determined, {n: self.unit(n) for n in rows}, str(self))

    def unit(self, name: str) -> str:
        """Unit of a parameter or derived quantity."""
        return self.task.output_unit if name == "mean" else UNITS.get(name, unit_of(name) or "1")

    def task_of(self, chain: int, draw: int) -> AbstractTask:
        """The task with the parameters of one draw."""
        return self.task.replace(**{name: float(draws[chain, draw]) for name, draws in self.samples.items()})

    def to_datatree(self) -> "xarray.DataTree":
        """ArviZ's groups posterior, posterior_predictive, sample_stats, observed_data, over chain, draw, frequency."""
        return datatree(self)

    def save(self, path: str | Path) -> None:
        """Write the draws as netCDF, or a summary as JSON if the name ends in .json; replaces a file in one step."""
        if Path(path).suffix == ".json":
            write_json(path, summary_table(self))
        else:
            write_netcdf(path, self)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Corner figure of what the data determine. Raises `NotMixedError` if the chains did not mix."""
        return plot.posterior(self, ax)

    def plot_chains(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Traces of the chains, also of those that did not mix."""
        return plot.chains(self, ax)

    def plot_predictive(self, ax: "Axes | None" = None) -> "Axes":
        """The target among the spectra that the posterior predicts. Returns the axes."""
        return plot.predictive(self, ax)

    def __str__(self) -> str:
        count, draws = self.chains.log_density.shape
        lines = [f"{'posterior' if self.success else 'NO POSTERIOR'}: {self.target.name}, {type(self.task).__name__}, "
                 f"{type(self.task.noise).__name__}", f"  {self.message}",
                 f"  {count} chains of {draws} draws, {self.divergences} divergences"]  # fmt: skip
        if self.success:
            lines.append(f"  posterior-predictive chi2: p = {self.replicates.p_value:.2g}")
            if len(self.modes) > 1:
                told = ", ".join(f"{middle:.2f} Hz ({100 * share:.0f} %)" for _, middle, _, share in self.modes)
                lines.append(f"  harmonic_frequency has several modes: {told}")
        return folded(lines)


class Summary(eqx.Module):
    """Table of a posterior: `rows` {name: (mean, sd, median, 2.5 %, 97.5 %)}; prints itself."""

    rows: dict[str, tuple[float, float, float, float, float]]
    diagnostics: dict[str, tuple[float, float, float]]
    determined: tuple[str, ...]
    units: dict[str, str]
    title: str

    def __getitem__(self, name: str) -> dict[str, float]:
        keys = ("mean", "sd", "median", "low", "high", "r_hat", "ess_bulk", "ess_tail")
        return dict(zip(keys, (*self.rows[name], *self.diagnostics[name]), strict=True))

    def __str__(self) -> str:
        lines = [self.title, f"  {'':<24}{'median':>10}{'2.5 %':>10}{'97.5 %':>10}{'R-hat':>7}{'ESS':>6}  unit"]
        for name, (_, _, middle, low, high) in self.rows.items():
            r_hat, bulk, tail = self.diagnostics[name]
            mark = "" if name in self.determined else "*"
            unit = "" if self.units[name] == "1" else self.units[name]
            spread = f"{middle:>10.4g}{low:>10.4g}{high:>10.4g}"
            lines.append(f"  {name + mark:<24}{spread}{r_hat:>7.3f}{min(bulk, tail):>6.0f}  {unit}")
        if any(name not in self.determined for name in self.rows):
            lines.append("  * the data do not determine it: the prior keeps it where it is")
        return "\n".join(lines)


KEYS = ("r_hat", "ess_bulk", "ess_tail")


def datatree(found: Any) -> "xarray.DataTree":
    """Groups posterior, posterior_predictive, sample_stats, observed_data."""
    import xarray

    chains, draws = found.chains.log_density.shape
    axes = {"chain": np.arange(chains), "draw": np.arange(draws)}
    bins = axes | {"frequency": ("frequency", np.asarray(found.target.frequency), {"units": "Hz"})}
    pair, spectrum = ("chain", "draw"), ("chain", "draw", "frequency")
    measured = np.asarray(found.target.proportional_power)
    named = {name: (pair, x, {"units": found.unit(name), "determined": int(name in found.determined)})
             for name, x in found.quantities.items()}  # fmt: skip
    made = found.chains
    stats = {"lp": made.log_density, "acceptance_rate": made.acceptance, "n_steps": made.steps, "diverging": made.diverging}
    told = {"success": int(found.success), "message": found.message, "target": found.target.name, "seed": str(found.seed)}
    told |= {f"version_{name}": number for name, number in found.versions.items()}
    groups = {
        "/": xarray.Dataset(attrs=told),
        "/posterior": xarray.Dataset(named | {"expected": (spectrum, found.replicates.expected)}, bins),
        "/posterior_predictive": xarray.Dataset({"proportional_power": (spectrum, found.replicates.power)}, bins),
        "/sample_stats": xarray.Dataset({name: (pair, x) for name, x in stats.items()}, axes, {"step_size": made.step_size}),
        "/observed_data": xarray.Dataset({"proportional_power": ("frequency", measured)}, {"frequency": bins["frequency"]}),
    }
    return xarray.DataTree.from_dict(groups)


def write_netcdf(path: str | Path, found: Any) -> None:
    """Write the tree to a temporary file beside `path`, then rename it."""
    with replacing(path) as temporary:
        datatree(found).to_netcdf(temporary, engine="h5netcdf")


def summary_table(found: Any) -> dict[str, Any]:
    """What `posterior.json` holds; `summary` is null where the chains did not mix."""
    rows = None
    if found.success:
        summary = found.summary()
        rows = {n: summary[n] | {"unit": found.unit(n), "determined": n in found.determined} for n in summary.rows}
    return {
        "format": 1,
        "success": found.success,
        "message": found.message,
        "target": found.target.name,
        "task": type(found.task).__name__,
        "noise": type(found.task.noise).__name__,
        "divergences": found.divergences,
        "diagnostics": {n: dict(zip(KEYS, d, strict=True)) for n, d in found.diagnostics.items()},
        "summary": rows,
        "modes": [dict(zip(("from_hz", "median_hz", "to_hz", "probability"), m, strict=True)) for m in found.modes],
        "predictive_p_value": found.replicates.p_value if found.success else None,
        "seed": found.seed,
        "settings": found.settings,
        "versions": found.versions,
    }
