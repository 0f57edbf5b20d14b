"""Force spectra as in the experiments: low-pass, Welch, bins, proportional power."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Real

from jaxmuscle import plot
from jaxmuscle._common.arguments import require
from jaxmuscle._common.arrays import is_concrete
from jaxmuscle._common.cards import Card, Shown, facts
from jaxmuscle._common.programs import kept

from ._settings import SpectrumSettings, tapers_of


class Spectrum(Shown, eqx.Module):
    """A one-sided power spectral density on bins.

    `frequency` [Hz] has one value per bin; `power` [`unit`²/Hz] may have leading axes (seeds,
    trials). The functions here take those themselves. `jax.vmap` gives `frequency` leading axes as
    well, with the same values in every row: `mean`, `plot` and print take it as one.
    """

    frequency: Float[Array | np.ndarray, " bins"]
    power: Float[Array | np.ndarray, "*batch bins"]
    settings: SpectrumSettings = eqx.field(static=True)
    unit: str = eqx.field(static=True, default="N")

    def _card(self) -> Card:
        if not all(map(is_known, (self.frequency, self.power))) or (
            self.frequency.shape[-1:] != self.power.shape[-1:]
        ):
            return Card(eqx.tree_pformat(self))  # a tree that JAX or Equinox took apart
        f, power, apart = np.asarray(self.bins), np.asarray(self.power), self.settings.resolution
        rows = [("bins", f"{f.size}, {f[0]:.3g} to {f[-1]:.3g} Hz, {apart:.3g} Hz apart")]
        if power.ndim > 1:
            rows.append(("spectra", f"{' x '.join(map(str, power.shape[:-1]))}; below, their mean"))
            power = power.mean(axis=tuple(range(power.ndim - 1)))
        square = f"({self.unit})^2" if "/" in self.unit else f"{self.unit}^2"
        top, share = f[np.argmax(power)], 100 * power.max() / power.sum()
        rows.append(("variance", f"{power.sum() * apart:.4g} {square} in these bins"))
        rows.append(("largest", f"bin at {top:.3g} Hz, {share:.3g} % of the power"))
        return facts(f"power spectral density [{square}/Hz]", rows)

    @property
    def bins(self) -> Float[Array | np.ndarray, " bins"]:
        """Their frequencies [Hz], without the leading axes that `jax.vmap` gives to `frequency`."""
        return self.frequency.reshape(-1, self.frequency.shape[-1])[0]

    @property
    def proportional(self) -> Float[Array, "*batch bins"]:
        """Power of each bin over the sum of all bins: p_k = P_k / Σ_j P_j, without unit."""
        power = jnp.asarray(self.power)
        return power / jnp.sum(power, axis=-1, keepdims=True)

    def mean(self) -> "Spectrum":
        """The average over all leading axes: of absolute power, to be normalised afterwards."""
        power = jnp.asarray(self.power)
        power = jnp.mean(power, axis=tuple(range(power.ndim - 1)))
        return Spectrum(self.bins, power, self.settings, self.unit)

    def plot(
        self,
        ax: Any = None,
        *,
        log: bool = False,
        proportional: bool = True,
        label: str | None = None,
    ) -> Any:
        """Draws power over frequency and returns the axes, see `jaxmuscle.plot.spectrum`."""
        return plot.spectrum(self, ax, log=log, proportional=proportional, label=label)


Samples = Real[Array | np.ndarray, "*batch times"]
Signals = Float[Array, "*batch times"]


def is_known(x: Any) -> bool:
    """Whether it is an array with values, and not something that JAX traces or took its place."""
    return isinstance(x, jax.Array | np.ndarray) and is_concrete(x)


def floating(signal: Samples) -> Signals:
    """The signal as an array of its own floating dtype; whole numbers get the default one."""
    signal = jnp.asarray(signal)
    samples = signal.ndim >= 1 and signal.shape[-1] >= 1 and not jnp.iscomplexobj(signal)
    remedy = "give real samples along the last axis, at least one"
    require(samples, "signal", jax.typeof(signal), remedy)
    known = jnp.issubdtype(signal.dtype, jnp.floating)
    return signal if known else signal.astype(float)


def _impulse_response(
    sections: Float[np.ndarray, "sections 6"], samples: int
) -> Float[np.ndarray, " times"]:
    return np.asarray(scipy.signal.sosfilt(sections, np.eye(1, samples)[0]))


def _along(values: np.ndarray, of: Array) -> Array:
    """Values for the last axes of an array, with as many axes: who forbids JAX to add any can call
    this, too."""
    return jnp.asarray(values, of.dtype).reshape((1,) * (of.ndim - values.ndim) + values.shape)


def _convolve(signal: Signals, response: Float[np.ndarray, " times"]) -> Signals:
    """y_n = Σ_m h_m x_{n - m}, for as many samples as both have."""
    samples = signal.shape[-1]
    size = scipy.fft.next_fast_len(2 * samples - 1, real=True)
    transform = jnp.fft.rfft(signal, size)
    transfer = _along(np.fft.rfft(response, size), transform)
    return jnp.fft.irfft(transform * transfer, size)[..., :samples]


def lowpass(
    signal: Real[Array | np.ndarray, "*batch times"], settings: SpectrumSettings
) -> Float[Array, "*batch times"]:
    """Butterworth low-pass along the last axis, differentiable and without a loop over time.

        smooth = jm.spectra.lowpass(np.sin(np.arange(1000.0)), jm.SpectrumSettings())

    y_n = Σ_m h_m x_{n - m}, h the impulse response. `"forward"` starts from rest as
    `scipy.signal.sosfilt`, `"both"` is `scipy.signal.sosfiltfilt` (odd extension, steady start,
    zero phase). One non-finite sample makes the whole output non-finite.

    **Arguments:** `signal` in any unit, time along the last axis, sampled at `settings.rate`;
    `settings`.

    **Returns:** the filtered signal, same shape, dtype and unit; the signal itself for
    `filter_cutoff=None`.

    **Raises:** `ValueError` if the signal is too short for the extension that `"both"` needs.
    """
    if settings.filter_cutoff is None:
        return floating(signal)
    return _lowpass(signal if isinstance(signal, jax.Array) else np.asarray(signal), settings)


@kept
def _lowpass(signal: Samples, settings: SpectrumSettings) -> Signals:
    signal, sections = floating(signal), settings.sections
    assert sections is not None
    if settings.filter_direction == "both":
        return _forward_and_backward(signal, sections)
    response = _impulse_response(sections, signal.shape[-1])
    # Exact for every offset, which so needs no derivative; keeps single precision for the
    # fluctuations.
    offset = jax.lax.stop_gradient(jnp.mean(signal, axis=-1, keepdims=True))
    return _convolve(signal - offset, response) + offset * jnp.asarray(
        np.cumsum(response), signal.dtype
    )


def _forward_and_backward(x: Signals, sections: Float[np.ndarray, "sections 6"]) -> Signals:
    first_order = min(np.sum(sections[:, 2] == 0), np.sum(sections[:, 5] == 0))
    edge = 3 * (2 * len(sections) + 1 - int(first_order))
    remedy = (
        f"filter_direction='both' needs more than {edge} samples; use a longer signal or 'forward'"
    )
    require(x.shape[-1] > edge, "signal length", x.shape[-1], remedy)
    left = 2 * x[..., :1] - x[..., edge:0:-1]
    right = 2 * x[..., -1:] - x[..., -2 : -edge - 2 : -1]
    extended = jnp.concatenate((left, x, right), axis=-1)
    response = _impulse_response(sections, extended.shape[-1])

    # The gain at zero frequency is one: a steady start passes the first value and filters what is
    # left.
    def steady(x: Float[Array, "*batch longer"]) -> Float[Array, "*batch longer"]:
        return x[..., :1] + _convolve(x - x[..., :1], response)

    return steady(steady(extended)[..., ::-1])[..., ::-1][..., edge:-edge]


def _density(
    segments: Float[Array, "*batch length"], settings: SpectrumSettings
) -> Float[Array, "*batch frequencies"]:
    """One-sided density of every segment: Σ_t |Σ_m w_tm x_m e^{-2πikm/n}|² / (rate Σ w²), doubled
    inside."""
    samples = segments.shape[-1]
    if settings.detrend != "none":
        segments = segments - jnp.mean(segments, axis=-1, keepdims=True)
    if settings.detrend == "linear":
        line = np.arange(samples) - (samples - 1) / 2
        line = _along(line / np.linalg.norm(line), segments)
        segments = segments - jnp.sum(segments * line, axis=-1, keepdims=True) * line
    each = segments[..., None, :]
    transform = jnp.fft.rfft(
        each * _along(tapers_of(settings, samples) / np.sqrt(settings.rate), each)
    )
    sides = np.full(transform.shape[-1], 2.0)
    sides[[0, -1] if samples % 2 == 0 else [0]] = 1.0
    density = jnp.sum(transform.real**2 + transform.imag**2, axis=-2)
    return density * _along(sides, density)


def welch(
    signal: Real[Array | np.ndarray, "*batch times"], settings: SpectrumSettings
) -> Float[Array, "*batch bins"]:
    """Welch estimate of the one-sided power spectral density in the selected bins, as
    `scipy.signal.welch`.

        power = jm.spectra.welch(np.sin(np.arange(1000.0)), jm.SpectrumSettings())

    P_k = 2 / (K rate Σ w²) Σ_s Σ_t |Σ_m w_tm x_{s,m} e^{-2πikm/n}|², x_s being segment s of K after
    detrending, w_t one of the tapers; no factor 2 in bin 0 and at half the rate. Nothing is
    filtered here.

    **Arguments:** `signal` [unit], time along the last axis, sampled at `settings.rate`;
    `settings`.

    **Returns:** density [unit²/Hz] at `settings.frequency`, bins along the last axis, dtype of the
    signal.

    **Raises:** `ValueError` if the signal is shorter than one segment. **Source:** Welch 1967,
    doi:10.1109/TAU.1967.1161901.
    """
    signal = floating(signal)
    samples, length = signal.shape[-1], settings.length
    remedy = f"one segment needs {length}; give a longer signal or window, or a shorter length"
    require(samples >= length, "signal length", samples, remedy)
    starts = settings.step * np.arange(settings.segments(samples))
    segments = signal[..., starts[:, None] + np.arange(length)]
    density = jnp.mean(_density(segments, settings), axis=-2)
    return density[..., settings.first_bin : settings.last_bin + 1]


def periodogram(
    signal: Real[Array | np.ndarray, "*batch times"], settings: SpectrumSettings
) -> tuple[Float[np.ndarray, " frequencies"], Float[Array, "*batch frequencies"]]:
    """The spectrum of the whole signal as one segment ("FFT"), at all frequencies from 0 to half
    the rate.

        frequency, power = jm.spectra.periodogram(np.sin(np.arange(1000.0)), jm.SpectrumSettings())

    As `scipy.signal.periodogram` with the window and detrend of `settings`; resolution `rate /
    samples`.

    **Arguments:** as for `welch`. **Returns:** frequency [Hz] and density [unit²/Hz].
    """
    signal = floating(signal)
    return np.fft.rfftfreq(signal.shape[-1], 1 / settings.rate), _density(signal, settings)


@kept
def filtered_power(
    signal: Any, settings: SpectrumSettings, edges: tuple[int, int] | None
) -> Float[Array, "*batch bins"]:
    filtered = lowpass(signal, settings)
    return welch(filtered if edges is None else filtered[..., edges[0] : edges[1]], settings)


def spectrum_of(
    signal: Real[Array | np.ndarray, "*batch times"],
    settings: SpectrumSettings,
    window: tuple[float, float] | None = None,
    *,
    unit: str = "N",
) -> Spectrum:
    """The procedure of the experiments: low-pass the whole signal, cut the analysed window, then
    Welch.

        spectrum = jm.spectra.spectrum_of(np.sin(np.arange(1500.0)), jm.SpectrumSettings())

    **Arguments:**

    - `signal` [unit]: time along the last axis, sampled at `settings.rate`
    - `settings`: how it is estimated
    - `window` (start, stop) [s] from the start of the signal, or all of it
    - `unit` of the signal

    **Returns:** a `Spectrum` with the leading axes of the signal.

    **Raises:** `ValueError` if the window lies outside the signal or is shorter than one segment.
    **Source:** Slifkin & Newell 1999, J Exp Psychol HPP 25(3):837-851.
    """
    edges = None
    if window is not None:
        samples = np.shape(signal)[-1]
        start, stop = (round(time * settings.rate) for time in window)
        remedy = (
            f"give window=(start, stop), 0 <= start < stop <= {samples / settings.rate:g} s, the"
            " duration of the signal"
        )
        require(0 <= start < stop <= samples, "window", window, remedy)
        edges = (start, stop)
    power = filtered_power(signal, settings, edges)
    return Spectrum(jnp.asarray(settings.frequency, power.dtype), power, settings, unit)
