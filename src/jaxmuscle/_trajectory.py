"""What a simulation returns: states and output over time, for one seed or many."""

import functools
import json
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ._parameter import PARAMETERS, as_numbers
from ._spectrum import Spectrum, SpectrumSettings, spectrum_of
from ._task import AbstractTask

if TYPE_CHECKING:
    import xarray

WINDOW = (5.0, 15.0)


class Trajectory(eqx.Module):
    """States and output of a task, sampled at `rate` from t = 0; a leading axis of seeds if it is an ensemble.

    **Fields:** `task`; `states` [m, m/s], shape (seeds, samples, states) or (samples, states); `output` [N or m], shape
    (seeds, samples) or (samples,); `seeds`, the seed numbers; `rate` [Hz]; `dt` [s], `substeps` (integration steps per
    dt); `sampling`, "instant" or "average" over the sampling interval.
    """

    task: AbstractTask
    states: Float[Array | np.ndarray, "*seeds samples states"]
    output: Float[Array | np.ndarray, "*seeds samples"]
    seeds: Int[Array | np.ndarray, "*seeds"]
    rate: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    sampling: str = eqx.field(static=True)

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Sampling times [s]."""
        return np.arange(self.output.shape[-1]) / self.rate

    @property
    def finite(self) -> Bool[Array | np.ndarray, "*seeds"]:
        """Whether a seed's output and states stayed finite."""
        return jnp.isfinite(self.output).all(-1) & jnp.isfinite(self.states).all((-2, -1))

    def state(self, name: str) -> Float[Array | np.ndarray, "*seeds samples"]:
        """One state by name (`x_w`, `v_w`, `x_z`, `v_z`)."""
        if name not in self.task.state_names:
            raise ValueError(f"state {name!r}: {type(self.task).__name__} has {self.task.state_names}")
        return self.states[..., self.task.state_names.index(name)]

    def between(self, window: tuple[float, float] = WINDOW) -> Float[Array | np.ndarray, "*seeds samples"]:
        """The output inside a window (start s, stop s), by default the analysed 5 s to 15 s."""
        start, stop = round(window[0] * self.rate), round(window[1] * self.rate)
        if not 0 <= start < stop <= self.output.shape[-1]:
            raise ValueError(f"window {window} s does not lie in the simulated 0 to {self.time[-1]} s")
        return self.output[..., start:stop]

    def spectrum(self, settings: SpectrumSettings | None = None, window: tuple[float, float] = WINDOW) -> Spectrum:
        """Welch spectrum of the output per seed (see `Spectrum.mean`), low-pass filtered from t = 0, then windowed.

        **Arguments:** `settings` (the task's by default; their rate must divide this trajectory's); `window` [s].
        """
        settings = self.task.settings if settings is None else settings
        every = round(self.rate / settings.rate)
        if abs(every * settings.rate - self.rate) > 1e-9 * self.rate or every < 1:
            raise ValueError(
                f"a spectrum at {settings.rate} Hz needs a trajectory at a multiple of that rate, this has {self.rate} Hz"
            )
        spectrum = spectrum_of(self.output[..., ::every], settings, window)
        return Spectrum(spectrum.frequency, spectrum.power, settings, self.task.output_unit)

    def plot(self, ax: Any = None) -> Any:
        """Output against time: one line, or mean and quantile band over seeds. Returns the axes."""
        from .plot import trajectory

        return trajectory(self, ax)

    def to_xarray(self) -> "xarray.Dataset":
        """A Dataset with dimensions (seed,) time; units, parameters, settings and versions as attributes."""
        import xarray

        single = self.output.ndim == 1
        dims = ("time",) if single else ("seed", "time")
        task = self.task
        data = {task.output_name: (dims, np.asarray(self.output), {"units": task.output_unit})}
        for name, unit in zip(task.state_names, task.state_units, strict=True):
            data.setdefault(name, (dims, np.asarray(self.state(name)), {"units": unit}))
        parameters = {
            name: {"value": float(value), "unit": PARAMETERS[name].unit if name in PARAMETERS else ""}
            for name, value in as_numbers(self.task.parameters).items()
        }
        attributes = {
            "task": type(task).__name__,
            "noise": type(task.noise).__name__,
            "parameters": json.dumps(parameters),
            "spectrum_settings": json.dumps(task.settings.to_dict()),
            "dt": self.dt,
            "substeps": self.substeps,
            "sampling": self.sampling,
            "versions": json.dumps(versions()),
        }
        coordinates: dict[str, Any] = {"time": ("time", self.time, {"units": "s"}), "seed": np.asarray(self.seeds)}
        if not single:
            coordinates["seed"] = ("seed", np.asarray(self.seeds))
        return xarray.Dataset(data, coords=coordinates, attrs=attributes)


@functools.cache
def versions() -> dict[str, str]:
    """Versions of what computed a result."""
    return {name: version(name) for name in ("jaxmuscle", "jax", "diffrax", "optimistix", "equinox", "numpy")}


def stack(parts: list[Trajectory]) -> Trajectory:
    """Join trajectories along the seed axis."""
    joined = {
        name: np.concatenate([np.asarray(getattr(part, name)) for part in parts]) for name in ("states", "output", "seeds")
    }
    first = parts[0]
    return Trajectory(first.task, **joined, rate=first.rate, dt=first.dt, substeps=first.substeps,
                      sampling=first.sampling)  # fmt: skip


def one(trajectory: Trajectory) -> Trajectory:
    """The only seed of an ensemble of one, without its seed axis."""
    first = (trajectory.states[0], trajectory.output[0], trajectory.seeds[0])
    return eqx.tree_at(lambda t: (t.states, t.output, t.seeds), trajectory, first)
