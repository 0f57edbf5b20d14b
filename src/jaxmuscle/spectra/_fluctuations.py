"""The fluctuations of a record: their variance by frequency, in bands, and how they grow with the
length of a window."""

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Real

from jaxmuscle._common.arguments import require

EDGES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0)  # Hz
BANDS = {f"band_{low:g}_{high:g}": (low, high) for low, high in itertools.pairwise(EDGES)}
GROWTH, WINDOWS = 1.2, 10  # of one window over the last; how many of the largest


def in_bands(frequency: Any, resolution: Any) -> Any:
    """How much of each bin lies in each band, from 0 to 1: a bin holds what is up to half the
    resolution away from it."""
    kind = np if isinstance(frequency, np.ndarray) else jnp
    edges = np.array(EDGES, frequency.dtype)[:, None]
    below = kind.clip((edges - frequency) / resolution + 0.5, 0.0, 1.0)
    return below[1:] - below[:-1]


def one_record(
    signal: Real[Array | np.ndarray, "..."], fewest: int, words: str = ""
) -> Float[np.ndarray, " times"]:
    """A record, checked."""
    x = np.asarray(signal, dtype=float)
    remedy = f"give one record of at least {words}{fewest} samples"
    require(x.ndim == 1 and x.size >= fewest, "signal shape", x.shape, remedy)
    require(np.all(np.isfinite(x)), "signal", x, "remove or interpolate what is not finite")
    require(np.ptp(x) > 0, "signal", x, "give a signal that is not constant")
    return x


def variance_spectrum(
    signal: Real[Array | np.ndarray, "..."], rate: float
) -> tuple[Float[np.ndarray, " frequencies"], Float[np.ndarray, " frequencies"]]:
    """The variance of one record by frequency, without loss: P_k = X_k² / N, Σ_k P_k = σ². Not
    traceable.

        frequency, variance = jm.spectra.variance_spectrum(np.sin(np.arange(1000.0)), 100.0)

    X_k = √(2/N) Σ_m (x_m - μ) cos(πk(m + ½)/N), the cosine transform (DCT-II), for k = 1 to N - 1;
    its frequency is k `rate` / 2N. The cosines continue the record as its mirror image, so that a
    drift makes no jump at the ends, which in a plain periodogram spreads over all frequencies. For
    a stationary Gaussian record the P_k are nearly independent, each with one degree of freedom.

    **Arguments:** `signal` (times,) [unit]; `rate`, samples per second [Hz].

    **Returns:** frequency [Hz] and power [unit²], of which sums over bands are the power in these
    bands.

    **Raises:** `ValueError` if the signal is constant, not finite, or has fewer than 2 samples.

    **Source:** Denis, Côté & Laprise 2002, Mon Weather Rev 130:1812-1829.
    """
    x = one_record(signal, 2)
    power = np.asarray(scipy.fft.dct(x - x.mean(), norm="ortho"))[1:] ** 2 / x.size
    return np.arange(1, x.size) * rate / (2 * x.size), power


def dfa(
    signal: Real[Array | np.ndarray, "..."], smallest: int = 4, largest: int | None = None
) -> float:
    """Exponent α of the detrended fluctuation analysis, F(n) ∝ n^α, of one record. Not traceable.

        jm.spectra.dfa(np.sin(np.arange(1000.0)))

    y_m = Σ_{j ≤ m} (x_j - μ) is cut into ⌊N/n⌋ windows of n samples, from its start on. A straight
    line (order 1) is taken off in each; F(n) is the root mean square of what is left in all of
    them. α is the slope of the least-squares line through ln F over ln n. The window sizes grow by
    a fifth from `smallest` to `largest`, rounded down, each once.

    White noise has α = 1/2, 1/f noise 1, a random walk 3/2. Below about 10 samples F is steeper
    than that by itself.

    **Arguments:**

    - `signal` (times,) in any unit
    - `smallest` window [samples], at least 4
    - `largest`: by default N/10

    **Raises:** `ValueError` if the signal is constant, not finite, or too short for two sizes of
    windows.

    **Source:** Peng et al. 1994, doi:10.1103/PhysRevE.49.1685.
    """
    require(
        smallest >= 4,
        "smallest",
        smallest,
        "give at least 4 samples: a line fits 2 of them exactly",
    )
    x = one_record(signal, 2)
    longest = x.size / WINDOWS if largest is None else largest
    steps = np.arange(int(np.log(max(longest / smallest, 1)) / np.log(GROWTH)) + 1)
    sizes = np.unique(np.floor(smallest * GROWTH**steps).astype(int))
    remedy = f"give smallest < largest <= {x.size}, the number of samples, or a longer signal"
    require(sizes.size >= 2 and longest <= x.size, "largest", longest, remedy)
    y = np.cumsum(x - x.mean())
    rest = [scipy.signal.detrend(y[: y.size - y.size % n].reshape(-1, n)) for n in sizes]
    fluctuation = np.array([np.sqrt(np.mean(r**2)) for r in rest])
    seen = fluctuation > 0
    return float(np.polyfit(np.log(sizes[seen]), np.log(fluctuation[seen]), 1)[0])
