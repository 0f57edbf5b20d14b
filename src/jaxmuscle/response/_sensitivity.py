"""Sensitivity of the expected spectrum to every parameter."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxmuscle import plot
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.cards import Card, Shown, in_columns
from jaxmuscle._common.programs import kept
from jaxmuscle.model._parameters import PARAMETERS, proper_names, set_parameters, unknown_parameter
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings

from ._expected import response
from ._expected_spectrum import expected_spectrum

if TYPE_CHECKING:
    import xarray


class Sensitivity(Shown, eqx.Module):
    """`d ln p_k / d ln v_j` of proportional power p_k with respect to parameters v_j, shape
    (parameters, bins).

    Where a parameter is zero, or may be negative and so has no logarithm, it is `d ln p_k / d v_j`.
    `relative` says for every parameter which of the two it is: True for the logarithm. `power` has
    the same of absolute power; `frequency` [Hz]; `names`, `values` and `units` of the parameters.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, " parameters"]
    relative: np.ndarray
    frequency: Float[np.ndarray, " bins"]
    proportional: Float[np.ndarray, "parameters bins"]
    power: Float[np.ndarray, "parameters bins"]

    def _card(self) -> Card:
        """Of every parameter the bin that changes most, those with a relative change first."""
        columns, rows, slopes = (
            ("parameter", "value", "largest change of a bin's share of the power"),
            [],
            self.proportional,
        )
        for i in np.lexsort((-np.abs(slopes).max(axis=1), ~np.asarray(self.relative))):
            k, unit = (
                int(np.argmax(np.abs(slopes[i]))),
                "" if self.units[i] == "1" else self.units[i],
            )
            change = (
                f"{slopes[i, k]:+.3g} % for 1 % more"
                if self.relative[i]
                else f"{100 * slopes[i, k]:+.3g} % per {unit}"
            )
            found = (
                f"{change}, at {self.frequency[k]:.3g} Hz"
                if np.abs(slopes[i, k]) > 1e-9
                else "none"
            )
            rows.append((self.names[i], f"{self.values[i]:.4g} {unit}".strip(), found))
        heading = "sensitivity of the expected spectrum, the most influential parameter first"
        return Card("\n".join([heading, *in_columns(columns, rows)]), heading, columns, tuple(rows))

    def to_xarray(self) -> "xarray.Dataset":
        """The table with its labels: dimensions parameter, frequency."""
        import xarray

        dims = ("parameter", "frequency")
        coordinates: dict[str, Any] = {
            "parameter": list(self.names),
            "frequency": ("frequency", self.frequency, {"units": "Hz"}),
            "value": ("parameter", self.values),
            "unit": ("parameter", list(self.units)),
            "relative": ("parameter", self.relative),
        }
        return xarray.Dataset(
            {"proportional": (dims, self.proportional), "power": (dims, self.power)}, coordinates
        )

    def plot(self, ax: Any = None) -> Any:
        """A heat map. Returns the axes."""
        return plot.sensitivity(self, ax)


def sensitivity(
    task: AbstractTask,
    names: Iterable[str] | None = None,
    settings: SpectrumSettings | None = None,
    window: tuple[float, float] = WINDOW,
) -> Sensitivity:
    """How every bin of the expected spectrum answers to every parameter, by forward-mode
    differentiation.

        jm.response.sensitivity(jm.Isometric(), ("k_w", "c_w")).plot()

    **Arguments:**

    - `task`: any with a linear response
    - `names` of parameters (all by default)
    - `settings` (the task's by default)
    - `window` [s]

    **Returns:** a `Sensitivity`. **Raises:** as `expected_spectrum`, and `ValueError` for an
    unknown name.
    """
    settings = task.settings if settings is None else settings
    expected_spectrum(task, settings, window)
    known = task.parameter_names
    chosen = proper_names(known if names is None else names) or ()
    for name in chosen:
        if name not in known:
            raise ValueError(unknown_parameter(name, known))
    with jax.enable_x64(True):
        values = np.array([float(task[name]) for name in chosen])
        slopes = np.asarray(_slopes(as_arrays(task), chosen, values, settings, window)).T
    positive = np.array([PARAMETERS[n].positive if n in PARAMETERS else True for n in chosen])
    relative = positive & (values > 0)
    slopes = np.where(relative[:, None], values[:, None], 1.0) * slopes
    bins = len(settings.frequency)
    rows = [(PARAMETERS[n].unit if n in PARAMETERS else "") for n in chosen]
    return Sensitivity(
        chosen,
        tuple(rows),
        values,
        relative,
        settings.frequency,
        slopes[:, bins:],
        slopes[:, :bins],
    )


@kept
def _slopes(task, names, values, settings, window):
    """Jacobian of log power and log proportional power."""

    def logs(values):
        power = response(
            set_parameters(task, dict(zip(names, values, strict=True))), settings, window
        )[0].power
        return jnp.concatenate([jnp.log(power), jnp.log(power / jnp.sum(power))])

    return jax.jacfwd(logs)(values)
