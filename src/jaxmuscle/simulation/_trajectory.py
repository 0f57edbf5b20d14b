"""What a simulation returns: states and output over time, for one seed or many."""

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer

from jaxmuscle import plot
from jaxmuscle._common.arrays import _is_scalar, as_numbers, is_concrete, numpy_unless_traced
from jaxmuscle._common.cards import Card, Shown, facts
from jaxmuscle._common.environment import versions
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._stream import VERSION as STREAM
from jaxmuscle.model._task import is_batched
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._expected_moments import linear_spectrum
from jaxmuscle.spectra._decimation import at_every
from jaxmuscle.spectra._mean import SpectrumEstimate, estimated
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings
from jaxmuscle.spectra._welch import Spectrum, lowpass, spectrum_of

if TYPE_CHECKING:
    import xarray


class Trajectory(Shown, eqx.Module):
    """States and output of a task, sampled at `rate` from t = 0; a leading axis of seeds if it is
    an ensemble.

    **Fields:** `task`; `states` [m, m/s], shape (seeds, samples, states) or (samples, states);
    `output` [N or m], shape (seeds, samples) or (samples,); `seeds`, the seed numbers; `rate` [Hz];
    `dt` [s], `substeps` (integration steps per dt); `sampling` of the output, as in
    `SpectrumSettings` (states are always those of the instant); `linear`, the output of the
    linearised task on the same noise paths, or None.
    """

    task: AbstractTask
    states: Float[Array | np.ndarray, "*seeds samples states"]
    output: Float[Array | np.ndarray, "*seeds samples"]
    seeds: Integer[Array | np.ndarray, "*seeds"]
    rate: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    sampling: str = eqx.field(static=True)
    linear: Float[Array | np.ndarray, "*seeds samples"] | None = None

    analysed: ClassVar[tuple[float, float]] = WINDOW

    def _card(self) -> Card:
        if not isinstance(self.task, AbstractTask) or not _is_scalar(self.output):
            return Card(eqx.tree_pformat(self))  # a tree that JAX or Equinox took apart
        samples, name, unit = self.output.shape[-1], self.task.output_name, self.task.output_unit
        known = [
            ("task", type(self.task).__name__),
            ("time", f"0 to {(samples - 1) / self.rate:g} s at {self.rate:g} Hz"),
        ]
        known.append(("seeds", str(int(np.prod(self.output.shape[:-1], dtype=int)))))
        if is_concrete(self.output):
            # -0 is shown as 0
            low, high = (found(np.asarray(self.output)) + 0.0 for found in (np.min, np.max))
            known.append(("range", f"{low:.4g} to {high:.4g} {unit}"))
        return facts(f"trajectory of {name} [{unit}]", known)

    def __getitem__(self, place: int | slice | np.ndarray) -> "Trajectory":
        """The run of one seed by its place (`runs[0]`, `runs[-1]`), without the axis of seeds; or
        some: `runs[:10]`."""
        count = self.output.shape[0] if self.output.ndim > 1 else 0
        if not count:
            raise TypeError(
                "this trajectory is one run, without seeds to choose from: it is what [i] would"
                " give"
            )
        if isinstance(place, int | np.integer) and not -count <= place < count:
            raise IndexError(f"[{place}]: there are {count} seeds, 0 to {count - 1}")
        if is_batched(self.task):  # jax.vmap gives all numbers its axis
            return jax.tree.map(lambda x: x[place], self)

        def numbers(run):
            return [run.states, run.output, run.seeds, *[run.linear] * (run.linear is not None)]

        return eqx.tree_at(numbers, self, [x[place] for x in numbers(self)])

    def __len__(self) -> int:
        return self.output.shape[0] if self.output.ndim > 1 else 1

    @property
    def time(self) -> Float[np.ndarray, " samples"]:
        """Sampling times [s]."""
        return np.arange(self.output.shape[-1]) / self.rate

    @property
    def finite(self) -> Bool[Array | np.ndarray, "*seeds"]:
        """Whether a seed's output and states stayed finite."""
        if is_concrete(self.output) and is_concrete(self.states):  # NumPy needs no compilation
            output, states = np.asarray(self.output), np.asarray(self.states)
            return np.asarray(np.isfinite(output).all(-1) & np.isfinite(states).all((-2, -1)))
        return jnp.isfinite(self.output).all(-1) & jnp.isfinite(self.states).all((-2, -1))

    def state(self, name: str) -> Float[Array | np.ndarray, "*seeds samples"]:
        """One state by name (`x_w`, `v_w`, `x_z`, `v_z`)."""
        if name not in self.task.state_names:
            raise ValueError(
                f"state {name!r}: {type(self.task).__name__} has {self.task.state_names}"
            )
        return self.states[..., self.task.state_names.index(name)]

    def between(
        self, window: tuple[float, float] = WINDOW
    ) -> Float[Array | np.ndarray, "*seeds samples"]:
        """The output inside a window (start s, stop s), by default the analysed 5 s to 15 s."""
        start, stop = self._edges(window, self.rate)
        return self.output[..., start:stop]

    def _edges(self, window: tuple[float, float], rate: float) -> tuple[int, int]:
        start, stop = round(window[0] * rate), round(window[1] * rate)
        if not 0 <= start < stop <= self.output.shape[-1] * rate / self.rate:
            raise ValueError(
                f"window {window} s does not lie in the simulated 0 to {float(self.time[-1]):g} s:"
                " give another window, or simulate longer"
            )
        return start, stop

    def filtered(
        self, settings: SpectrumSettings | None = None, window: tuple[float, float] = WINDOW
    ) -> Float[Array | np.ndarray, "*seeds times"]:
        """What the spectra are made of: the output at the rate of the settings, low-passed from t =
        0, cut to the window.

        Its coefficient of variation is what a `Target` states and what a fit compares (see
        `Recording.filtered`).

        **Arguments:** `settings` (the task's by default; their rate must divide this trajectory's;
        if it is lower and their `sampling` is "filtered", the output is low-passed against aliases
        before it is brought down to that rate); `window` [s].
        """
        settings = self.task.settings if settings is None else settings
        passed = lowpass(self._at_rate_of(settings, self.output), settings)
        start, stop = self._edges(window, settings.rate)
        return numpy_unless_traced(passed)[..., start:stop]

    def spectrum(
        self, settings: SpectrumSettings | None = None, window: tuple[float, float] = WINDOW
    ) -> Spectrum:
        """Welch spectrum of the output per seed (see `Spectrum.mean`), low-pass filtered from t =
        0, then windowed.

        **Arguments:** `settings` (the task's by default; their rate must divide this trajectory's);
        `window` [s].
        """
        settings = self.task.settings if settings is None else settings
        return spectrum_of(
            self._at_rate_of(settings, self.output), settings, window, unit=self.task.output_unit
        )

    def mean_spectrum(
        self,
        settings: SpectrumSettings | None = None,
        window: tuple[float, float] = WINDOW,
        *,
        control: bool | None = None,
    ) -> SpectrumEstimate:
        """The expected spectrum, estimated from these seeds, with its standard error per bin.

            P_k = e_k + ⟨p_ik - l_ik⟩

        p_i is a seed's Welch power, l_i that of the linearised task on the same noise path, e its
        exact expectation (`expected_spectrum`): the linear part has no sampling error and no
        time-step error left. `control=False`, or a trajectory without `linear`, gives the plain
        mean ⟨p_ik⟩.

        **Raises:** `ValueError` for `control=True` without `linear`, or with another `sampling`
        than was simulated.
        """
        settings = self.task.settings if settings is None else settings
        plain = numpy_unless_traced(self.spectrum(settings, window).power)
        plain = plain.reshape(-1, plain.shape[-1])
        same = self.sampling == settings.sampling and self.rate == settings.rate
        if control and (self.linear is None or not same):
            raise ValueError(
                "control = True needs a trajectory simulated with control, and with the rate and"
                " sampling of the spectrum's settings"
            )
        if control is False or self.linear is None or not same:
            return estimated(plain, None, None, settings, self.task.output_unit)
        beside = numpy_unless_traced(self.beside().spectrum(settings, window).power).reshape(
            plain.shape
        )
        exact = numpy_unless_traced(linear_spectrum(self.task, settings, window).power)
        return estimated(plain, beside, exact, settings, self.task.output_unit)

    def beside(self) -> "Trajectory":
        """The linearised task on the same noise paths, as a trajectory. Raises `ValueError` if it
        was not carried."""
        if self.linear is None:
            raise ValueError(
                "this trajectory has no linear response beside it: simulate with control=True"
            )
        return eqx.tree_at(lambda t: t.output, self, self.linear)

    def _at_rate_of(self, settings: SpectrumSettings, output: Any) -> Any:
        every = round(self.rate / settings.rate)
        if abs(every * settings.rate - self.rate) > 1e-9 * self.rate or every < 1:
            raise ValueError(
                f"a spectrum at {settings.rate} Hz needs a trajectory at a multiple of that rate,"
                f" this has {self.rate} Hz"
            )
        return at_every(output, every, settings.sampling)

    def plot(self, ax: Any = None, *, window: tuple[float, float] | None = None) -> Any:
        """Output against time, or in a window [s]: one line, or mean and quantile band over seeds.
        Returns the axes."""
        return plot.trajectory(self, ax, window=window)

    def to_xarray(self) -> "xarray.Dataset":
        """A Dataset with dimensions (seed,) time; units, parameters, settings and versions as
        attributes."""
        import xarray

        single = self.output.ndim == 1
        dims = ("time",) if single else ("seed", "time")
        task = self.task
        data = {task.output_name: (dims, np.asarray(self.output), {"units": task.output_unit})}
        for name, unit in zip(task.state_names, task.state_units, strict=True):
            data.setdefault(name, (dims, np.asarray(self.state(name)), {"units": unit}))
        attributes = run_attributes(task, self.rate, self.dt, self.substeps, self.sampling)
        coordinates: dict[str, Any] = {
            "time": ("time", self.time, {"units": "s"}),
            "seed": np.asarray(self.seeds),
        }
        if not single:
            coordinates["seed"] = ("seed", np.asarray(self.seeds))
        return xarray.Dataset(data, coords=coordinates, attrs=attributes)


def run_attributes(
    task: AbstractTask,
    rate: float,
    dt: float,
    substeps: int,
    sampling: str,
    without: Iterable[str] = (),
) -> dict[str, Any]:
    """What a file says about how its trajectories were made; parameters `without` those that
    vary."""
    parameters = {
        name: {"value": float(value), "unit": PARAMETERS[name].unit if name in PARAMETERS else ""}
        for name, value in as_numbers(task.parameters).items()
        if name not in without
    }
    return {
        "task": type(task).__name__,
        "muscle": type(task.muscle).__name__,
        "noise": type(task.noise).__name__,
        "parameters": json.dumps(parameters),
        "spectrum_settings": json.dumps(task.settings.to_dict()),
        "rate": rate,
        "dt": dt,
        "substeps": substeps,
        "sampling": sampling,
        "stream": STREAM,
        "versions": json.dumps(versions()),
    }


def stack(parts: Iterable[Trajectory], count: int) -> Trajectory:
    """Join trajectories along the seed axis and keep the first `count` seeds."""
    parts = list(parts)
    first = parts[0]
    names = ("states", "output", "seeds") + (() if first.linear is None else ("linear",))
    joined: dict[str, Any] = {
        name: np.concatenate([np.asarray(getattr(part, name)) for part in parts])[:count]
        for name in names
    }
    joined.setdefault("linear", None)
    return Trajectory(
        first.task,
        **joined,
        rate=first.rate,
        dt=first.dt,
        substeps=first.substeps,
        sampling=first.sampling,
    )
