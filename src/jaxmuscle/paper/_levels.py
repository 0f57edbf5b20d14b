"""The isometric muscle fitted to [30], at all its levels of contraction."""

import tomllib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.bundled import bundled_text
from jaxmuscle._common.programs import kept
from jaxmuscle.model._tasks import AbstractTask, Isometric
from jaxmuscle.response._expected import response
from jaxmuscle.spectra._measures import approximate_entropy
from jaxmuscle.spectra._settings import WINDOW
from jaxmuscle.spectra._welch import Spectrum

from ._readings import runs_of, within_bins

LEVELS = np.array([0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95])
STEADIEST, SMALLEST = 0.3, 0.017  # Taylor, Christou & Enoka 2003
ENTROPY_SEEDS = 16


PerLevel = Float[np.ndarray, " levels"]


class Levels(eqx.Module):
    """Fits to the reconstructed spectra of [30], scaled to other levels of contraction by
    `at_level`.

    **Fields:** `fractions` (levels,) of the MVC; of the fit at 95 %: `line`, the frequency of its
    harmonic [Hz], `within`, the share of its power in the compared bins, `power` (levels, bins),
    `variation` (levels,) with 1.7 % at 30 % MVC, `entropy` (levels, seeds), the approximate entropy
    of low-passed force, the same noise paths at every level; `at_35`, the spectrum of the fit at 35
    %, and `at_35_moved`, the same muscle at 95 %.
    """

    fractions: PerLevel
    power: Float[np.ndarray, "levels bins"]
    variation: PerLevel
    line: float
    within: float
    entropy: Float[np.ndarray, "levels seeds"]
    at_35: Spectrum
    at_35_moved: Spectrum

    @property
    def maxima(self) -> PerLevel:
        """Frequency [Hz] of the largest absolute power at every level."""
        return self.at_35.settings.frequency[np.argmax(self.power, axis=1)]

    @property
    def _proportional(self) -> Float[np.ndarray, "levels bins"]:
        return self.power / self.power.sum(1, keepdims=True)

    @property
    def shifted(self) -> PerLevel:
        """Share of the power that is in other bins than at 95 % MVC."""
        return 0.5 * np.abs(self._proportional - self._proportional[-1]).sum(1)

    @property
    def centroid(self) -> PerLevel:
        """Mean frequency [Hz] of the proportional power."""
        return self._proportional @ self.at_35.settings.frequency

    @property
    def entropy_rise(self) -> float:
        """By how many standard errors the largest mean entropy is above those of both ends of the
        levels; 0 at an end."""
        top = int(np.argmax(self.entropy.mean(1)))
        if top in (0, len(self.entropy) - 1):
            return 0.0
        rises = self.entropy[top] - self.entropy[[0, -1]]
        error = rises.std(axis=1, ddof=1) / np.sqrt(rises.shape[1])
        return float(np.min(rises.mean(axis=1) / error))


def fitted(level: int) -> AbstractTask:
    """`Isometric` as fitted to `slifkin-newell-1999-95mvc` or `-35mvc`: levels.toml, which
    fitting/expected.py writes."""
    return Isometric().replace(**tomllib.loads(bundled_text("levels", "paper"))[f"{level}"])


@kept
def _carry(
    task: AbstractTask, fractions: Float[Array, " levels"], reference: Float[Array, ""]
) -> tuple[Array, Array]:
    """Power and coefficient of variation at every level."""

    def one(fraction):
        moments, _ = response(
            as_arrays(task.at_level(fraction, reference=reference)), task.settings, WINDOW
        )
        return jnp.asarray(moments.power), jnp.asarray(moments.variation)

    return jax.vmap(one)(fractions)


def levels() -> Levels:
    """The fit at 95 % at the levels of [30], 5 to 95 % MVC; and the fit at 35 %, there and at 95
    %."""
    high, low = fitted(95), fitted(35)
    power, variation = _carry_to(high, [*LEVELS, STEADIEST], 0.95)
    entropy = [_entropies(high.at_level(fraction, reference=0.95)) for fraction in LEVELS.tolist()]
    louder = SMALLEST / variation[-1]  # to first order amplitudes and variation are proportional
    # as many levels as above, so that one program serves both
    beside, _ = _carry_to(low, [0.35] * len(LEVELS) + [0.95], 0.35)
    at_35, moved = (Spectrum(low.settings.frequency, row, low.settings) for row in beside[[0, -1]])
    return Levels(
        LEVELS,
        power[:-1] * louder**2,
        variation[:-1] * louder,
        float(high["harmonic_frequency"]),
        within_bins(high),
        np.array(entropy),
        at_35,
        moved,
    )


def _carry_to(
    task: AbstractTask, fractions: list[float], reference: float
) -> tuple[np.ndarray, np.ndarray]:
    found = _carry(as_arrays(task), jnp.asarray(fractions), jnp.asarray(reference))
    return np.asarray(found[0]), np.asarray(found[1])


def _entropies(task: AbstractTask) -> list[float]:
    """Approximate entropy of low-passed force, of every seed."""
    return [approximate_entropy(row) for row in runs_of(task, ENTROPY_SEEDS).filtered()]
