"""What a mean spectrum cannot show of the records behind it: a size that changes, a sharp line."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import scipy
from jaxtyping import Float

BAND = (0.5, 12.0)  # Hz, of what is whitened
ENVELOPE = 1.0  # Hz, up to which the size is followed
PARTS = 8  # of a trial, for its trend
LINE_OF_PARTS = np.linspace(-0.5, 0.5, PARTS)
TAPERED = 0.05  # of a trial, half of it at either end
# Hz, full widths of the bands whose mean is what is smooth about a frequency; of a line, left out
SMOOTH, ABOUT, LINE = 3.0, 2.0, 0.5
PADDED = 4  # times the samples, so that no line lies between two frequencies
LOWEST = 1.5  # Hz, from which on lines are looked for: below, a slow wander looks like one

Frequencies = Float[np.ndarray, " frequencies"]
Density = Callable[[Frequencies], Frequencies]
Records = Float[np.ndarray, "records times"]


def whiten(signals: Records, rate: float, density: Density) -> Records:
    """Records between 0.5 and 12 Hz over the root of a smooth spectrum, each of unit variance.

        w = FT⁻¹[X(f) / √(S(f) m(f))],    m = mean over ± 1.5 Hz of |X|² / S

    X is the transform of a record without its straight line, S the `density`, of any unit. The mean
    m of each record takes up where S is somewhat wrong. A stationary Gaussian record becomes band-
    limited white noise.
    """
    n = signals.shape[-1]
    f = np.fft.rfftfreq(n, 1 / rate)
    inside = (f >= BAND[0]) & (f < BAND[1])
    taper = scipy.signal.windows.tukey(n, TAPERED)
    X = np.fft.rfft(scipy.signal.detrend(signals) * taper)
    Z = X[..., inside] / np.sqrt(density(f[inside]))
    width = round(SMOOTH * n / rate)
    Z /= np.sqrt(scipy.ndimage.uniform_filter1d(np.abs(Z) ** 2, width, axis=-1))
    full = np.zeros_like(X)
    full[..., inside] = Z
    w = np.fft.irfft(full, n)
    return w / np.std(w, axis=-1, keepdims=True)


def envelope_power(w: Records, rate: float) -> Float[np.ndarray, " records"]:
    """How much the size of whitened records changes slowly: the mean of |FT(w² - 1)|² / n over the
    frequencies 0 < f <= 1 Hz.

    That is the density of w² near 0 Hz, per sample. So over n it is the variance of the mean of w²
    in a record of n samples, whether the record is steady or not. Of steady white noise that fills
    a band of B Hz it is about `rate / B`.

    Let x = a(t) y(t), where y is steady and a² has the mean 1 and changes slowly. The mean power of
    x in any band has the relative variance w² s² + v. Here s² is that of a steady record. It grows
    by w², since the large stretches count more than the small ones: w² = ⟨a⁴⟩ <= E / E₀, with E
    this function and E₀ its expectation in steady records. v = (E - E₀) / n is the variance of the
    mean of a², which is the same in all bands.
    """
    n = w.shape[-1]
    last = int(ENVELOPE * n / rate)
    return np.mean(np.abs(np.fft.rfft(w**2 - 1)[..., 1 : last + 1]) ** 2, axis=-1) / n


def log_powers(w: Records) -> Float[np.ndarray, "records parts"]:
    """The logarithms of the power of eight parts of whitened records, less their mean."""
    parts = np.array_split(w**2, PARTS, axis=-1)
    power = np.log(np.stack([np.mean(part, axis=-1) for part in parts], axis=-1))
    return power - np.mean(power, axis=-1, keepdims=True)


def slopes_of(parts: Float[np.ndarray, "records parts"]) -> Float[np.ndarray, " records"]:
    """By how much the straight line through the logarithms rises from the first part to the
    last."""
    return parts @ LINE_OF_PARTS / (LINE_OF_PARTS @ LINE_OF_PARTS)


def trend_p(parts: Float[np.ndarray, "trials parts"]) -> float:
    """Student's p of the mean slope, by how much the parts of all trials scatter about this line.

    That tells a trend, which all parts follow, from bursts, which they do not.
    """
    slope = np.mean(slopes_of(parts))
    degrees = parts.size - len(parts) - 1
    error = np.std(parts - slope * LINE_OF_PARTS) * math.sqrt(parts.size / degrees)
    t = abs(slope) / error * math.sqrt(len(parts) * (LINE_OF_PARTS @ LINE_OF_PARTS))
    return float(2 * scipy.special.stdtr(degrees, -t))


def sharpest(
    signals: Sequence[Float[np.ndarray, "draws _"]], rate: float, density: Density
) -> tuple[Float[np.ndarray, " draws"], Float[np.ndarray, " draws"]]:
    """Frequency [Hz] and height of what is sharpest in the mean spectrum of several trials.

        J(f) = Σ over the trials of |FT(h x)|² / S,    height = max J(f) / m(f)

    h is the Hann window of a trial, S the `density`, of any unit, m the mean of J within 1 Hz of
    f but for the nearest 0.25 Hz. The transforms are padded to four times the longest trial. Every
    trial has the same part in J.
    """
    size = PADDED * max(x.shape[-1] for x in signals)
    f = np.fft.rfftfreq(size, 1 / rate)
    inside = (f >= BAND[0]) & (f < BAND[1] + ABOUT / 2)
    J, smooth = 0.0, density(f[inside])
    for x in signals:
        taper = scipy.signal.get_window("hann", x.shape[-1])
        each = np.abs(np.fft.rfft(scipy.signal.detrend(x) * taper, size)[..., inside]) ** 2 / smooth
        J = J + each / np.mean(each, axis=-1, keepdims=True)
    f = f[inside]
    wide, narrow = (round(width * size / rate) | 1 for width in (ABOUT, LINE))
    around, near = (
        scipy.ndimage.uniform_filter1d(J, each, axis=-1) * each for each in (wide, narrow)
    )
    looked = (f >= LOWEST) & (f < BAND[1])
    height = (J * (wide - narrow) / np.maximum(around - near, 1e-12 * around))[..., looked]
    place = np.argmax(height, axis=-1)
    return f[looked][place], np.take_along_axis(height, place[..., None], -1)[..., 0]
