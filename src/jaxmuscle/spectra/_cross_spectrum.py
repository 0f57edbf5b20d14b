"""How one signal follows another: the frequency response by Welch's segments, with its errors."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxmuscle._common.arguments import require

from ._bin_law import bin_rows
from ._settings import SpectrumSettings

LEAST_INPUT = 1e-4  # of the largest density of the input
FEWEST = 3  # segments times tapers


Bins = Float[np.ndarray, " bins"]
Times = Float[np.ndarray, " times"]


class Response(NamedTuple):
    """The response H of an output to an input in the bins that the input excites.

    `stderr` is the standard error of the real and of the imaginary part of `value`, `correlation`
    that of the errors of bins, `E e_k e_l* / √(E|e_k|² E|e_l|²)`. `centre` is where the input that
    a bin sees lies on the average [Hz]: at an edge of the input's band not in the middle of the
    bin, and to first order `value` is H at the centre. `square` is the mean of f² there [Hz²].
    """

    frequency: Bins
    value: Complex[np.ndarray, " bins"]
    stderr: Bins
    coherence: Bins
    correlation: Complex[np.ndarray, "bins bins"]
    centre: Bins
    square: Bins


def ordinates(
    signal: Times, settings: SpectrumSettings
) -> Complex[np.ndarray, "segments bins tapers"]:
    """The transforms of all segments, detrended and tapered; the mean of their squares, added over
    tapers, is the density.

    **Raises:** `ValueError` if the signal holds fewer than three, tapers counted.
    """
    count, rows, n = settings.segments(signal.size), bin_rows(settings), settings.length
    needed = n + (-(-FEWEST // settings.tapers) - 1) * settings.step
    seconds = f"{needed} at {settings.rate:g} Hz, {needed / settings.rate:g} s"
    remedy = f"a frequency response needs {seconds}; give a longer window"
    require(count * settings.tapers >= FEWEST, "samples", signal.size, remedy)
    pieces = signal[settings.step * np.arange(count)[:, None] + np.arange(n)]
    return np.tensordot(pieces, rows, (1, 2))


def response_of(
    given: Times,
    output: Times,
    settings: SpectrumSettings,
) -> Response:
    """The least-squares response `H_k = Σ X* Y / Σ |X|²` over segments and tapers, with the errors
    that noise in Y leaves.

    Given the input, the error of H_k is `Σ X* N / Σ |X|²`. The ordinates N of the noise are
    correlated by what segments, tapers and bins share, `E N_a N_b* = S g_ab` for a density S that
    is flat across a bin. So

        Cov(H_k, H_l) = √(S_k S_l) v_kl,   v_kl = Σ_ab X*_ak X_bl g_ab,kl / (Σ|X_k|² Σ|X_l|²),

    exactly for any input, periodic or random. S_k is the residual `Σ |Y - H X|²` over its
    expectation `Σ g_aa - v_kk Σ|X_k|²`. Bins with less than 1e-4 of the input's largest density are
    left out.
    """
    x, y = ordinates(given, settings), ordinates(output, settings)
    count, step, n = len(x), settings.step, settings.length
    power = np.sum(np.abs(x) ** 2, axis=(0, 2))
    kept = power >= LEAST_INPUT * power.max()
    x, y, power, rows = x[:, kept], y[:, kept], power[kept], bin_rows(settings)[kept]
    shape, flat, rows = rows.shape[:2], x.reshape(count, -1), rows.reshape(-1, n)
    v = np.zeros((shape[0], shape[0]), complex)
    # segments further apart share no samples
    for j in range(min(count - 1, (n - 1) // step) + 1):
        shared = rows[:, j * step :] @ rows[:, : n - j * step].conj().T
        part = (flat[: count - j].conj().T @ flat[j:] * shared).reshape(shape * 2).sum(axis=(1, 3))
        v += part if j == 0 else part + part.conj().T
    v /= np.outer(power, power)
    variance = np.real(np.diag(v))
    cross, total = np.sum(x.conj() * y, axis=(0, 2)), np.sum(np.abs(y) ** 2, axis=(0, 2))
    expected = count * np.sum(np.abs(rows.reshape(*shape, n)) ** 2, axis=(1, 2)) - variance * power
    noise = np.maximum(total - np.abs(cross) ** 2 / power, 0.0) / expected
    centre, square = _centres(given, rows.reshape(*shape, n), settings.rate)
    return Response(
        frequency=settings.frequency[kept],
        value=cross / power,
        stderr=np.sqrt(variance * noise / 2),
        coherence=np.abs(cross) ** 2 / (power * total),
        correlation=v / np.sqrt(np.outer(variance, variance)),
        centre=centre,
        square=square,
    )


def _centres(
    given: Times, rows: Complex[np.ndarray, "bins tapers n"], rate: float
) -> Float[np.ndarray, "2 bins"]:
    """`Σ f |W_k(f)|² S(f) / Σ |W_k(f)|² S(f)`, S the input's periodogram, W_k the transform of a
    bin's rows; the same of f²."""
    f, n = np.fft.rfftfreq(given.size, 1 / rate), given.size
    density = np.abs(np.fft.rfft(given - given.mean())) ** 2
    seen = (np.sum(np.abs(np.fft.fft(row.conj(), n)[:, : f.size]) ** 2, axis=0) for row in rows)
    means = ((share * density) @ np.stack([f, f**2], axis=1) / (share @ density) for share in seen)
    return np.stack(list(means), axis=1)
