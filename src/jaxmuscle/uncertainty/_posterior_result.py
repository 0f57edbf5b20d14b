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
from jaxmuscle.fits._result import RELATIVE
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._derived import MEAN, unit_of

from ._chains import Chains
from ._posterior_checks import Replicates

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure


Mode = tuple[float, float, float, float]
Modes = tuple[Mode, ...]
Draws = Float[np.ndarray, "chains draws"]
Drawn = dict[str, Draws]
MODE = ("from_hz", "median_hz", "to_hz", "probability")
MIXING = ("r_hat", "ess_bulk", "ess_tail")
COLUMNS = ("quantity", "median", "2.5 %", "97.5 %", "R-hat", "ESS", "unit")
CELLS = ("{median:.4g}", "{low:.4g}", "{high:.4g}", "{r_hat:.3f}", "{ess:.0f}")
LINE = "  {:<24}{:>10}{:>10}{:>10}{:>7}{:>6}  {}"
FROM_PRIOR = "* not determined by the data: it comes from the prior. Do not interpret it"
PREDICTED = (
    "  {}posterior-predictive chi2: p = {:.2g} (near 0: the model does not describe the data)"
)


class PosteriorPart(eqx.Module):
    """One target of a posterior: its `task` at the medians; `replicates`, what spectra the
    posterior predicts.

    `replicates` has an entry for every draw: proportional powers `expected` by the model and
    `power` drawn about it; `chi2` of the measured and `chi2_drawn` of the drawn spectrum about the
    same model; and over all draws `p_value`, how often the drawn one is further away.
    """

    target: Target
    task: AbstractTask
    replicates: Replicates


class Posterior(Shown, eqx.Module):
    """Draws from the posterior of a fit, of one target or of several; arrays have leading axes
    (chain, draw).

    `success` and `message`: whether the chains mixed, or why not; `parts`, a `PosteriorPart` for
    each target by name; `samples` of the free parameters and `derived` quantities in the units of
    the table of parameters; `diagnostics` {name: (R-hat, effective size of the bulk, of the
    tails)}; `determined`, the names that the data determine; `modes` {harmonic frequency:
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
    samples: Drawn
    derived: Drawn
    diagnostics: dict[str, tuple[float, float, float]]
    determined: tuple[str, ...]
    modes: dict[str, Modes]
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
    def quantities(self) -> Drawn:
        """Parameters, then derived quantities."""
        return self.samples | self.derived

    def summary(self) -> "Summary":
        """Mean, sd, median and 95 % interval of every quantity; where the fit had no mean force in
        newtons, forces, masses, stiffness and damping per newton of mean force. Raises
        `NotMixedError` if the chains did not mix."""
        if not self.success:
            raise NotMixedError(f"{self.title}: {self.message}")
        rows = {}
        relative = bool(self.settings.get("per_newton"))
        for name, draws in self.quantities.items():
            unit = self.unit(name)
            if relative and name == MEAN:
                continue
            if relative and unit in RELATIVE:
                draws, unit = draws / self.derived[MEAN], RELATIVE[unit]
            low, middle, high = np.quantile(draws, (0.025, 0.5, 0.975)).tolist()
            spread = {"mean": float(draws.mean()), "sd": float(draws.std(ddof=1))}
            rows[name] = {**spread, "median": middle, "low": low, "high": high}
            rows[name] |= dict(zip(MIXING, self.diagnostics[name], strict=True))
            rows[name] |= {"unit": unit, "determined": name in self.determined}
        return Summary(rows, self._text())

    def unit(self, name: str) -> str:
        """Unit of a parameter or derived quantity."""
        own = name.partition("@")[2]
        part = self.parts[own] if own else next(iter(self.parts.values()))
        return unit_of(name, part.task.output_unit) or "1"

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each draw: `chain`, `draw`, then every parameter and derived quantity;
        `summary()` has a table, too."""
        chain, draw = np.indices(self.chains.log_density.shape)
        columns = {"chain": chain, "draw": draw} | self.quantities
        return frame({name: np.ravel(x) for name, x in columns.items()})

    def to_datatree(self) -> "xarray.DataTree":
        """ArviZ's groups posterior, posterior_predictive, sample_stats, observed_data, over chain,
        draw, frequency.

        With several targets the spectra are called "expected@target" and so on, over
        "frequency@target".
        """
        import xarray

        made, pair = self.chains, ("chain", "draw")
        axes = {name: np.arange(n) for name, n in zip(pair, made.log_density.shape, strict=True)}
        named = {
            name: (pair, x, {"units": self.unit(name), "determined": int(name in self.determined)})
            for name, x in self.quantities.items()
        }
        stats = {
            "lp": made.log_density,
            "acceptance_rate": made.acceptance,
            "n_steps": made.steps,
            "diverging": made.diverging,
        }
        about = {
            "success": int(self.success),
            "message": self.message,
            "target": self.title,
            "seed": str(self.seed),
        }
        about |= {f"version_{name}": number for name, number in self.versions.items()}
        bins, expected, drawn, measured = {}, {}, {}, {}
        for name, part in self.parts.items():
            end = f"@{name}" if len(self.parts) > 1 else ""
            bin_axis, power = f"frequency{end}", f"proportional_power{end}"
            bins[bin_axis] = bin_axis, np.asarray(part.target.frequency), {"units": "Hz"}
            expected[f"expected{end}"] = (*pair, bin_axis), part.replicates.expected
            drawn[power] = (*pair, bin_axis), part.replicates.power
            measured[power] = bin_axis, np.asarray(part.target.proportional_power)
        groups = {
            "/": xarray.Dataset(attrs=about),
            "/posterior": xarray.Dataset(named | expected, axes | bins),
            "/posterior_predictive": xarray.Dataset(drawn, axes | bins),
            "/sample_stats": xarray.Dataset(
                {name: (pair, x) for name, x in stats.items()}, axes, {"step_size": made.step_size}
            ),
            "/observed_data": xarray.Dataset(measured, bins),
        }
        return xarray.DataTree.from_dict(groups)

    def save(self, path: str | Path) -> None:
        """Write the draws as netCDF, or a summary as JSON if the name ends in .json; replaces a
        file in one step."""
        if Path(path).suffix == ".json":
            return write_json(path, self._summary_table())
        tree = self.to_datatree()
        with replacing(path, room=tree.nbytes + 2**18) as temporary:
            tree.to_netcdf(temporary, engine="h5netcdf")
        return None

    def _summary_table(self) -> dict[str, Any]:
        """What `posterior.json` holds; `summary` is null where the chains did not mix."""
        modes, p_values, about = {}, {}, {}
        for name, found in self.modes.items():
            modes[name] = [dict(zip(MODE, mode, strict=True)) for mode in found]
        for name, part in self.parts.items():
            p_values[name] = part.replicates.p_value
            kinds = {"task": type(part.task).__name__, "noise": type(part.task.noise).__name__}
            about[name] = {"target": part.target.name} | kinds
        single = len(self.parts) == 1
        if single:
            (about,), (p_values,) = about.values(), p_values.values()
            modes = next(iter(modes.values()), [])
        return {
            "format": 1,
            "success": self.success,
            "message": self.message,
            **(about if single else {"parts": about}),
            "divergences": self.divergences,
            "diagnostics": {
                name: dict(zip(MIXING, found, strict=True))
                for name, found in self.diagnostics.items()
            },
            "summary": self.summary().rows if self.success else None,
            "modes": modes,
            "predictive_p_value": p_values if self.success else None,
            "seed": self.seed,
            "settings": self.settings,
            "versions": self.versions,
        }

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
        text = self._text()
        return self.summary()._card()._replace(text=text) if self.success else Card(text)

    def _text(self) -> str:
        """The posterior in a few lines."""
        count, draws = self.chains.log_density.shape
        lines = [
            f"{'posterior' if self.success else 'NO POSTERIOR'}: {self.title}, {self.model}",
            f"  {self.message}",
            f"  {count} chains of {draws} draws, {self.divergences} divergences",
        ]
        if not self.success:
            return folded(lines)
        for name, part in self.parts.items():
            whose = f"{name}: " * (len(self.parts) > 1)
            lines += [PREDICTED.format(whose, part.replicates.p_value)]
        for name, found in self.modes.items():
            listed = ", ".join(f"{mode[1]:.2f} Hz ({100 * mode[3]:.0f} %)" for mode in found)
            lines += [f"  {name} has several modes: {listed}"] * (len(found) > 1)
        return folded(lines)


class Summary(Shown, eqx.Module):
    """Table of a posterior: `rows` {name: {mean, sd, median, low (2.5 %), high (97.5 %), r_hat,
    ess_bulk, ess_tail, unit, determined}}; prints itself."""

    rows: dict[str, dict[str, Any]]
    title: str

    def __getitem__(self, name: str) -> dict[str, Any]:
        """What is known of one quantity. Raises `ValueError` for an unknown name."""
        if name not in self.rows:
            raise ValueError(
                f"unknown quantity {name!r} of the posterior: {choices(name, self.rows)}"
            )
        return self.rows[name]

    def to_dataframe(self) -> "pandas.DataFrame":
        """A row for each quantity: `quantity`, and what `summary[name]` has (`mean` to
        `determined`)."""
        return frame([{"quantity": name} | row for name, row in self.rows.items()])

    def _card(self) -> Card:
        rows = []
        for name, row in self.rows.items():
            ess, unit = min(row["ess_bulk"], row["ess_tail"]), row["unit"]
            cells = (cell.format(ess=ess, **row) for cell in CELLS)
            mark = "*" * (not row["determined"])
            rows.append((name + mark, *cells, "" if unit == "1" else unit))
        remarks = (FROM_PRIOR,) * any(not row["determined"] for row in self.rows.values())
        lines = [self.title, *(LINE.format(*row) for row in (("", *COLUMNS[1:]), *rows))]
        text = "\n".join([*lines, *(f"  {remark}" for remark in remarks)])
        return Card(text, self.title.partition("\n")[0], COLUMNS, tuple(rows), remarks)
