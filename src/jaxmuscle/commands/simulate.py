"""`jaxmuscle simulate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import jaxmuscle as jm

from .console import (
    SPECTRUM,
    csv_text,
    keep_other_spectrum,
    out,
    record,
    reporting,
    say_written,
    task_of,
    writable,
)
from .options import Force, Formats, Json, Observe, OtherTask, Output, Preset, Seed, formats_of

if TYPE_CHECKING:
    from jaxmuscle.model import AbstractTask


def simulate(
    preset: Preset,
    task: OtherTask = None,
    observe: Observe = None,
    seeds: Annotated[
        int, typer.Option(min=1, help="How many recordings to simulate, each with its own noise.")
    ] = 50,
    seed: Seed = 0,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Simulate a muscle in a task, from a bundled preset, a preset file or a fit.json.

    Writes DIR/trajectories.nc, DIR/spectrum.csv and DIR/simulate.png.

    Examples:

        jaxmuscle simulate zagrodny-slifkin --seeds 200 --out out/simulate

        jaxmuscle simulate out/fit/fit.json --task prescribed-force --observe acceleration
    """
    with reporting(as_json):
        model = task_of(preset, task, observe)
        writable(
            output,
            "trajectories.nc",
            beside=[SPECTRUM],
            figures=["simulate"],
            reads=[preset],
            force=force,
        )
        _simulate(model, seeds, seed, output, formats_of(formats))


def _simulate(
    model: "AbstractTask", seeds: int, seed: int, folder: Path, formats: list[str]
) -> None:
    import jax
    import numpy as np

    from jaxmuscle._common.figures import write_figure
    from jaxmuscle._common.files import replacing, write_text

    runs = jm.ensemble(model, jax.random.key(seed), seeds=seeds, progress=True)
    spectra = runs.spectrum()
    estimate = runs.mean_spectrum()
    mean = estimate.spectrum
    dataset = runs.to_xarray().assign_attrs(seed=seed)
    with replacing(folder / "trajectories.nc", room=dataset.nbytes + 2**16) as temporary:
        dataset.to_netcdf(temporary, engine="h5netcdf")
    low, high = np.quantile(np.asarray(spectra.proportional), [0.05, 0.95], axis=0)
    columns = {
        "frequency_hz": np.asarray(mean.frequency),
        "power": np.asarray(mean.power),
        "power_stderr": estimate.stderr,
        "proportional_power": np.asarray(mean.proportional),
        "quantile_05": low,
        "quantile_95": high,
    }
    keep_other_spectrum(folder, columns)
    write_text(folder / "spectrum.csv", csv_text(columns))
    figures = write_figure(jm.plot.simulation(runs), folder, "simulate", formats)
    files = ["trajectories.nc", "spectrum.csv", *figures]
    held = runs.filtered()
    found = jm.spectra.peaks(mean)
    still = model.quantity == "acceleration"  # about a mean of zero
    variation = None if still else float(np.mean(jm.spectra.coefficient_of_variation(held)))
    spread = "" if variation is None else f", coefficient of variation {100 * variation:.3g} %"
    record(
        {
            "task": type(model).__name__,
            "seeds": seeds,
            "seed": seed,
            "duration_s": float(runs.time[-1]),
            "quantity": model.output_name,
            "unit": model.output_unit,
            "mean": float(held.mean()),
            "standard_deviation": float(held.std()),
            "coefficient_of_variation": variation,
            "maximum_hz": float(found.maximum.frequency),
            "local_maxima_hz": [float(p.frequency) for p in found.local_maxima],
            "spectrum": {name: np.asarray(column).tolist() for name, column in columns.items()},
            "files": [str(folder / name) for name in files],
        }
    )
    out.print(f"{type(model).__name__}, {seeds} seeds of {runs.time[-1]:g} s")
    level = f"{held.mean():.4g} {model.output_unit}"
    spread = spread or f", standard deviation {held.std():.3g} {model.output_unit}"
    out.print(f"{model.output_name}: mean {level}{spread}")
    locals_ = ", ".join(f"{p.frequency:.3f}" for p in found.local_maxima) or "none"
    out.print(
        f"Spectrum: maximum at {found.maximum.frequency:.3f} Hz, local maxima at {locals_} Hz",
    )
    say_written(folder, *files)
