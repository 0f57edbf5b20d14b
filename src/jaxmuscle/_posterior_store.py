"""A posterior as files: draws in ArviZ's layout, a summary in JSON."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray


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
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        datatree(found).to_netcdf(temporary, engine="h5netcdf")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


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
