"""What a posterior says: draws, summary, and the file they are kept in."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.cards import Card, Shown
from jaxmuscle._common.errors import NotMixedError
from jaxmuscle._common.files import replacing, write_json
from jaxmuscle._common.parts import of_only, only
from jaxmuscle._common.tables import frame
from jaxmuscle._common.text import choices, folded
from jaxmuscle.data._target import Target
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._derived import unit_of

from ._chains import Chains
from ._posterior_checks import Replicates

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


CREDIBLE = (0.025, 0.975)


Modes = tuple[tuple[float, float, float, float], ...]


class PosteriorPart(eqx.Module):
    """One target of a posterior: its `task` at the medians; `replicates`, what spectra the
    posterior predicts.

    `replicates` has an entry for every draw: proportional powers `expected` by the model and
    `power` drawn about it; `chi2` of the measured and `chi2_drawn` of the drawn spectrum about the
    same model; and over all draws `p_value`, how often the drawn one is further away.

    `names` {parameter of the task: name among the samples}.
    """

    target: Target
    task: AbstractTask
    replicates: Replicates
    names: dict[str, str]


class Posterior(Shown, eqx.Module):
    """Draws from the posterior of a fit, of one target or of several; arrays have leading axes
    (chain, draw).

    `success` and `message`: whether the chains mixed, or why not; `parts`, a `PosteriorPart` for
    each target by name; `samples` of the free parameters and `derived` quantities in the units of
    the table of parameters; `diagnostics` {name: (R-hat, effective size of the bulk, of the
    tails)}; `determined`, the names that the data determine; `frequency_modes` {harmonic frequency:
    ((from, median, to, probability), ...)}, of each mode its lowest draw, median and highest draw
    [Hz], and its share of the draws; `chains`, how the draws were made, with fields for every draw:
    `s`, its values in the sampler's own unbounded coordinates (`samples` has the same draw in
    units), `log_density` there, `acceptance`, `steps`, `diverging`; and for all together
    `step_size`; `settings`, how the draws were asked for: free parameters with prior and bounds,
    chains, draws, warm-up, and the spectrum settings.

    A posterior of one target has `target`, `task` and `replicates` of its own.
    """

    success: bool
    message: str
    parts: dict[str, PosteriorPart]
    samples: dict[str, Float[np.ndarray, "chains draws"]]
    derived: dict[str, Float[np.ndarray, "chains draws"]]
    diagnostics: dict[str, tuple[float, float, float]]
    determined: tuple[str, ...]
    frequency_modes: dict[str, Modes]
    chains: Chains
    settings: dict[str, Any]
    seed: int | None
    versions: dict[str, str]

    @property
    def only(self) -> PosteriorPart:
        """The part of a posterior of one target. Raises `AttributeError` where there are
        several."""
        return only(self.parts, "posterior")

    target = of_only("target", "The target.")
    task = of_only("task", "The task with the medians of the parameters.")
    replicates = of_only("replicates", "What spectra the posterior predicts.")

    @property
    def modes(self) -> Modes:
        """Modes of the harmonic's frequency:

        (lowest draw, median, highest draw, probability). Of the first where several are free.
        """
        return next(iter(self.frequency_modes.values()), ())

    @property
    def title(self) -> str:
        """Names of the targets."""
        return ", ".join(part.target.name for part in self.parts.values())

    @property
    def model(self) -> str:
        """Tasks and noises in words."""
        kinds = (
            f"{type(p.task).__name__}, {type(p.task.noise).__name__}" for p in self.parts.values()
        )
        return "; ".join(dict.fromkeys(kinds))

    @property
    def divergences(self) -> int:
        """How many draws were divergent."""
        return int(self.chains.diverging.sum())

    @property
    def quantities(self) -> dict[str, Float[np.ndarray, "chains draws"]]:
        """Parameters, then derived quantities."""
        return self.samples | self.derived

    def summary(self) -> "Summary":
        """Mean, sd, median and 95 % interval of every quantity. Raises `NotMixedError` if the
        chains did not mix."""
        if not self.success:
            raise NotMixedError(f"{self.title}: {self.message}")
        rows = {}
        for name, draws in self.quantities.items():
            low, middle, high = np.quantile(draws, (CREDIBLE[0], 0.5, CREDIBLE[1]))
            rows[name] = (
                float(draws.mean()),
                float(draws.std(ddof=1)),
                float(middle),
                float(low),
                float(high),
            )
        return Summary(
            rows, self.diagnostics, self.determined, {n: self.unit(n) for n in rows}, self._told()
        )

    def unit(self, name: str) -> str:
        """Unit of a parameter or derived quantity."""
        own = name.partition("@")[2]
        part = self.parts[own] if own else next(iter(self.parts.values()))
        return unit_of(name, part.task.output_unit) or "1"

    def task_of(self, chain: int, draw: int, target: str | None = None) -> AbstractTask:
        """The task with the parameters of one draw; of several targets, the named one's."""
        part = self.only if target is None else self.parts[target]
        values = {}
        for name, shared in part.names.items():
            draws = self.samples[shared]
            value, middle, own = (
                float(draws[chain, draw]),
                float(np.median(draws)),
                float(part.task[name]),
            )
            # A proportional parameter keeps its ratio to the first target's.
            values[name] = value if middle == own else value * own / middle
        return part.task.replace(**values)

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each draw: `chain`, `draw`, then every parameter and derived quantity;
        `summary()` has a table, too."""
        chain, draw = np.indices(self.chains.log_density.shape)
        return frame(
            {
                name: np.ravel(x)
                for name, x in ({"chain": chain, "draw": draw} | self.quantities).items()
            }
        )

    def to_datatree(self) -> "xarray.DataTree":
        """ArviZ's groups posterior, posterior_predictive, sample_stats, observed_data, over chain,
        draw, frequency."""
        return datatree(self)

    def save(self, path: str | Path) -> None:
        """Write the draws as netCDF, or a summary as JSON if the name ends in .json; replaces a
        file in one step."""
        if Path(path).suffix == ".json":
            write_json(path, summary_table(self))
        else:
            write_netcdf(path, self)

    def plot(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Corner figure of what the data determine. Raises `NotMixedError` if the chains did not
        mix."""
        return plot.posterior(self, ax)

    def plot_chains(self, ax: "Axes | None" = None) -> "Figure | SubFigure":
        """Traces of the chains, also of those that did not mix."""
        return plot.chains(self, ax)

    def plot_predictive(self, ax: "Axes | None" = None, target: str | None = None) -> "Axes":
        """The target (of several, the named one) among the spectra that the posterior predicts.
        Returns the axes."""
        return plot.predictive(self, ax, target)

    def _card(self) -> Card:
        if not self.success:
            return Card(self._told())
        shown = self.summary()._card()
        return shown._replace(text=self._told())

    def _told(self) -> str:
        """The posterior in a few lines."""
        count, draws = self.chains.log_density.shape
        lines = [
            f"{'posterior' if self.success else 'NO POSTERIOR'}: {self.title}, {self.model}",
            f"  {self.message}",
            f"  {count} chains of {draws} draws, {self.divergences} divergences",
        ]
        if self.success:
            for name, part in self.parts.items():
                whose = f"{name}: " if len(self.parts) > 1 else ""
                lines.append(
                    f"  {whose}posterior-predictive chi2: p = {part.replicates.p_value:.2g} (near"
                    " 0: the model does not describe the data)"
                )
            for name, modes in self.frequency_modes.items():
                if len(modes) > 1:
                    told = ", ".join(
                        f"{middle:.2f} Hz ({100 * share:.0f} %)" for _, middle, _, share in modes
                    )
                    lines.append(f"  {name} has several modes: {told}")
        return folded(lines)


class Summary(Shown, eqx.Module):
    """Table of a posterior: `rows` {name: (mean, sd, median, 2.5 %, 97.5 %)}; prints itself."""

    rows: dict[str, tuple[float, float, float, float, float]]
    diagnostics: dict[str, tuple[float, float, float]]
    determined: tuple[str, ...]
    units: dict[str, str]
    title: str

    def __getitem__(self, name: str) -> dict[str, float]:
        """What is known of one quantity. Raises `ValueError` for an unknown name."""
        if name not in self.rows:
            raise ValueError(
                f"unknown quantity {name!r} of the posterior: {choices(name, self.rows)}"
            )
        keys = ("mean", "sd", "median", "low", "high", "r_hat", "ess_bulk", "ess_tail")
        return dict(zip(keys, (*self.rows[name], *self.diagnostics[name]), strict=True))

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each quantity: `quantity`, what `summary[name]` has (`mean` to `ess_tail`),
        `unit`, `determined`."""
        return frame(
            [
                {
                    "quantity": n,
                    **self[n],
                    "unit": self.units[n],
                    "determined": n in self.determined,
                }
                for n in self.rows
            ]
        )

    def _card(self) -> Card:
        columns = ("quantity", "median", "2.5 %", "97.5 %", "R-hat", "ESS", "unit")
        rows, lines = (
            [],
            [
                self.title,
                f"  {'':<24}{'median':>10}{'2.5 %':>10}{'97.5 %':>10}{'R-hat':>7}{'ESS':>6}  unit",
            ],
        )
        for name, (_, _, middle, low, high) in self.rows.items():
            r_hat, bulk, tail = self.diagnostics[name]
            mark = "" if name in self.determined else "*"
            unit = "" if self.units[name] == "1" else self.units[name]
            cells = (
                f"{middle:.4g}",
                f"{low:.4g}",
                f"{high:.4g}",
                f"{r_hat:.3f}",
                f"{min(bulk, tail):.0f}",
            )
            rows.append((name + mark, *cells, unit))
            numbers = "".join(
                f"{cell:>{wide}}" for cell, wide in zip(cells, (10, 10, 10, 7, 6), strict=True)
            )
            lines.append(f"  {name + mark:<24}{numbers}  {unit}")
        said = ("* not determined by the data: it comes from the prior. Do not interpret it",)
        remarks = said * any(name not in self.determined for name in self.rows)
        text = "\n".join([*lines, *(f"  {remark}" for remark in remarks)])
        return Card(text, self.title.partition("\n")[0], columns, tuple(rows), remarks)


KEYS = ("r_hat", "ess_bulk", "ess_tail")


def datatree(found: Any) -> "xarray.DataTree":
    """Groups posterior, posterior_predictive, sample_stats, observed_data.

    With several targets the spectra are called "expected@target" and so on, over
    "frequency@target".
    """
    import xarray

    chains, draws = found.chains.log_density.shape
    axes = {"chain": np.arange(chains), "draw": np.arange(draws)}
    pair = ("chain", "draw")
    named = {
        name: (pair, x, {"units": found.unit(name), "determined": int(name in found.determined)})
        for name, x in found.quantities.items()
    }
    made = found.chains
    stats = {
        "lp": made.log_density,
        "acceptance_rate": made.acceptance,
        "n_steps": made.steps,
        "diverging": made.diverging,
    }
    told = {
        "success": int(found.success),
        "message": found.message,
        "target": found.title,
        "seed": str(found.seed),
    }
    told |= {f"version_{name}": number for name, number in found.versions.items()}
    bins, expected, drawn, measured = {}, {}, {}, {}
    for name, part in found.parts.items():
        end = f"@{name}" if len(found.parts) > 1 else ""
        bin_axis, power = f"frequency{end}", np.asarray(part.target.proportional_power)
        bins[bin_axis] = (bin_axis, np.asarray(part.target.frequency), {"units": "Hz"})
        expected[f"expected{end}"] = (*pair, bin_axis), part.replicates.expected
        drawn[f"proportional_power{end}"] = (*pair, bin_axis), part.replicates.power
        measured[f"proportional_power{end}"] = bin_axis, power
    groups = {
        "/": xarray.Dataset(attrs=told),
        "/posterior": xarray.Dataset(named | expected, axes | bins),
        "/posterior_predictive": xarray.Dataset(drawn, axes | bins),
        "/sample_stats": xarray.Dataset(
            {name: (pair, x) for name, x in stats.items()}, axes, {"step_size": made.step_size}
        ),
        "/observed_data": xarray.Dataset(measured, bins),
    }
    return xarray.DataTree.from_dict(groups)


def write_netcdf(path: str | Path, found: Any) -> None:
    """Write the tree to a temporary file beside `path`, then rename it."""
    tree = datatree(found)
    with replacing(path, room=tree.nbytes + 2**18) as temporary:
        tree.to_netcdf(temporary, engine="h5netcdf")


def summary_table(found: Any) -> dict[str, Any]:
    """What `posterior.json` holds; `summary` is null where the chains did not mix."""
    rows = None
    if found.success:
        summary = found.summary()
        rows = {
            n: summary[n] | {"unit": found.unit(n), "determined": n in found.determined}
            for n in summary.rows
        }
    single = len(found.parts) == 1
    keys = ("from_hz", "median_hz", "to_hz", "probability")
    modes = {
        name: [dict(zip(keys, m, strict=True)) for m in modes]
        for name, modes in found.frequency_modes.items()
    }
    p_values = {name: part.replicates.p_value for name, part in found.parts.items()}
    about = {
        name: {
            "target": part.target.name,
            "task": type(part.task).__name__,
            "noise": type(part.task.noise).__name__,
        }
        for name, part in found.parts.items()
    }
    return {
        "format": 1,
        "success": found.success,
        "message": found.message,
        **(next(iter(about.values())) if single else {"parts": about}),
        "divergences": found.divergences,
        "diagnostics": {n: dict(zip(KEYS, d, strict=True)) for n, d in found.diagnostics.items()},
        "summary": rows,
        "modes": next(iter(modes.values()), []) if single else modes,
        "predictive_p_value": (
            None if not found.success else found.replicates.p_value if single else p_values
        ),
        "seed": found.seed,
        "settings": found.settings,
        "versions": found.versions,
    }
