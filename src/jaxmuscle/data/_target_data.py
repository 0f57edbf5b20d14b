"""What a likelihood asks of a target, as arrays alone: a pytree that JAX traces and maps."""

from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmuscle._common.errors import TargetError
from jaxmuscle.spectra._bin_law import recorded_interval, samples_of_trials, target_law
from jaxmuscle.spectra._settings import SpectrumSettings

FEWEST = 4096  # samples: a program serves so many, or 4, 16 ... times as many, and all below


class Stiffness(NamedTuple):
    """A measured dynamic stiffness: `frequency` [Hz], `parts`, its real and imaginary part [N/m],
    and `stderr`, the standard error of each of the two [N/m]."""

    frequency: Float[Array | np.ndarray, " points"]
    parts: Float[Array | np.ndarray, "2 points"]
    stderr: Float[Array | np.ndarray, " points"]


class TargetData(eqx.Module):
    """The data of a target as arrays, for `log_likelihood` under `jit`, `grad` and `vmap`. Made by
    `Target.data`.

        person, other = (jm.load_target(name).data() for name in jm.list_targets()[:2])

    All numbers are arrays; the `settings` are static. So targets with the same settings, number of
    bins and number of trials share one compiled program. `jax.tree.map(lambda *x: jnp.stack(x),
    *people)` makes of many people's data one with an axis in front, for `jax.vmap`.

    - `settings`: how the spectrum was estimated
    - `longest`: how many samples a trial may have, in the program that serves these data
    - `chosen`: position of each bin among those of the settings
    - `log_power`: ln of the proportional power p_k
    - `half`: half the equivalent degrees of freedom of each bin, ν_k / 2
    - `precision`, `logdet`: inverse of the correlation matrix R of the bins, and ln |R|
    - `samples`: how many samples each trial has
    - `recorded`: interval [s] of the recording whose aliases are in the spectrum; 0 without aliases
    - `log_variation`: ln of the coefficient of variation of each trial, or None. Its standard
      deviation is not here: it follows from `samples` and the task
    - `stiffness`: the dynamic stiffness (`frequency` [Hz]; `parts`, real and imaginary [N/m], and
      `stderr` [N/m]), or None
    """

    settings: SpectrumSettings = eqx.field(static=True)
    longest: int = eqx.field(static=True)
    chosen: Int[Array | np.ndarray, "*people bins"]
    log_power: Float[Array | np.ndarray, "*people bins"]
    half: Float[Array | np.ndarray, "*people bins"]
    precision: Float[Array | np.ndarray, "*people bins bins"]
    logdet: Float[Array | np.ndarray, "*people"]
    samples: Int[Array | np.ndarray, "*people trials"]
    recorded: Float[Array | np.ndarray, "*people"]
    log_variation: Float[Array | np.ndarray, "*people values"] | None
    stiffness: Stiffness | None

    @classmethod
    def of(cls, target: Any) -> "TargetData":
        """Of a target. Raises `TargetError` for a spectrum without segments."""
        settings, counts, values = (
            target.settings,
            target.segments,
            target.coefficient_of_variation,
        )
        half, precision, logdet, stiffness = np.zeros(0), np.zeros((0, 0)), np.zeros(()), None
        if len(target.bins):
            if counts is None:
                raise TargetError(
                    f"{target.name}: does not state its segments, so how its bins scatter is not"
                    " known; give segments"
                )
            law = target_law(target)
            half, (precision, logdet) = law.degrees / 2, precision_of(law.correlation)
        if target.stiffness is not None:
            known = target.stiffness.known
            parts = np.stack([np.real(known.value), np.imag(known.value)])
            stiffness = Stiffness(known.frequency, parts, known.stderr)
        samples = samples_of_trials(target)
        return cls(
            settings=settings,
            longest=longest(max(samples)),
            chosen=target.bins - settings.first_bin,
            log_power=np.log(target.proportional_power),
            half=half,
            precision=precision,
            logdet=logdet,
            samples=np.array(samples),
            recorded=np.asarray(recorded_interval(target, settings)),
            # without segments nothing says how much it scatters
            log_variation=None if None in (values, counts) else np.log(np.asarray(values)),
            stiffness=stiffness,
        )


def longest(samples: int) -> int:
    """How many samples the program has that serves so many."""
    most = FEWEST
    while most < samples:
        most *= 4
    return most


def precision_of(
    correlation: Float[np.ndarray, "bins bins"], mask: Float[np.ndarray, " bins"] | None = None
) -> tuple[Float[np.ndarray, "bins bins"], Float[np.ndarray, ""]]:
    """Inverse of a correlation matrix and the log of its determinant, with zeros for bins that are
    left out."""
    kept = np.flatnonzero(np.ones(len(correlation)) if mask is None else mask)
    part = correlation[np.ix_(kept, kept)]
    whole = np.zeros_like(correlation)
    whole[np.ix_(kept, kept)] = np.linalg.inv(part)
    return whole, np.asarray(np.linalg.slogdet(part)[1])
