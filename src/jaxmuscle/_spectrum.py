"""Force spectra as in the experiments: low-pass, Welch, bins, proportional power."""

import dataclasses
import difflib
import math
import numbers
from collections.abc import Callable, Mapping
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.fft
import scipy.signal
from jaxtyping import Array, Float, Real

Window = Literal["hann", "hamming", "boxcar"]
Detrend = Literal["constant", "linear", "none"]
FilterDirection = Literal["forward", "both"]
Sampling = Literal["instant", "average"]
_CHOICES = {"window": Window, "detrend": Detrend, "filter_direction": FilterDirection, "sampling": Sampling}


def _python(value: Any) -> Any:
    return value.item() if isinstance(value, np.number) else value


def require(holds: bool | np.bool, name: str, value: object, remedy: str) -> None:
    """Raises the `ValueError` of a wrong argument: its name, its value, and what would be right."""
    if not holds:
        raise ValueError(f"{name}={value!r}: {remedy}")


class SpectrumSettings(eqx.Module):
    """How a spectrum is estimated; every choice the papers leave open is a field.

    The defaults are the procedure of Slifkin & Newell (1999, J Exp Psychol HPP 25(3):837-851).

    | field | meaning |
    |---|---|
    | `rate` | sampling rate [Hz] |
    | `length` | samples per segment and transform; the resolution is `rate / length` |
    | `first_bin`, `last_bin` | bins kept, both included; bin k lies at `k * rate / length` |
    | `window`, `overlap` | taper (periodic, as in `scipy.signal`) and the fraction neighbours share |
    | `detrend` | what is removed from each segment: its mean, its straight line, or nothing |
    | `filter_order`, `filter_cutoff` | Butterworth low-pass; cut-off [Hz], or `None` for no filter |
    | `filter_direction` | `"forward"` (from rest), or `"both"` (zero phase, for recordings) |
    | `sampling` | `"instant"`, or the `"average"` over a sampling interval (an integrating sensor) |

    **Raises:** `ValueError` naming the field, its value and the remedy.
    """

    rate: float = eqx.field(static=True, default=100.0, converter=_python)
    length: int = eqx.field(static=True, default=256, converter=_python)
    first_bin: int = eqx.field(static=True, default=1, converter=_python)
    last_bin: int = eqx.field(static=True, default=30, converter=_python)
    window: Window = eqx.field(static=True, default="hann")
    overlap: float = eqx.field(static=True, default=0.5, converter=_python)
    detrend: Detrend = eqx.field(static=True, default="constant")
    filter_order: int = eqx.field(static=True, default=9, converter=_python)
    filter_cutoff: float | None = eqx.field(static=True, default=30.0, converter=_python)
    filter_direction: FilterDirection = eqx.field(static=True, default="forward")
    sampling: Sampling = eqx.field(static=True, default="instant")

    def __check_init__(self):
        def check(name: str, kind: type, valid: Callable[[Any], bool], remedy: str) -> None:
            value = getattr(self, name)
            require(isinstance(value, kind) and valid(value), name, value, remedy)

        half = self.length // 2 if isinstance(self.length, int) else 0
        check("rate", numbers.Real, lambda f: 0 < f < math.inf, "give a sampling rate above 0 Hz")
        check("length", int, lambda n: n >= 8, "give a whole number of samples, at least 8")
        check("last_bin", int, lambda k: 1 <= k <= half, f"give a bin from 1 to length // 2 = {half}")
        below = f"give a bin from 0 (the mean) to last_bin = {self.last_bin}"
        check("first_bin", int, lambda k: 0 <= k <= self.last_bin, below)
        check("overlap", numbers.Real, lambda x: 0 <= x < 1, "give a fraction of a segment, 0 to below 1")
        check("filter_order", int, lambda n: n >= 1, "give a whole number of at least 1")
        if self.filter_cutoff is not None:
            inside = f"give a frequency from 0 to rate / 2 = {self.rate / 2:g} Hz, or None for no filter"
            check("filter_cutoff", numbers.Real, lambda f: 0 < f < self.rate / 2, inside)
        for name, choice in _CHOICES.items():
            known = get_args(choice)
            check(name, str, known.__contains__, f"choose one of {', '.join(known)}")

    @classmethod
    def pwelch(cls) -> "SpectrumSettings":
        """MATLAB's `pwelch` defaults: Hamming window and no detrend, so the mean leaks into bin 1.

        Two details stay as they are here: `length` (MATLAB would cut the signal into eight segments) and the
        periodic form of the window (MATLAB's is symmetric).
        """
        return cls(window="hamming", detrend="none")

    @property
    def resolution(self) -> float:
        """Distance of neighbouring bins, `rate / length` [Hz]."""
        return self.rate / self.length

    @property
    def frequency(self) -> Float[np.ndarray, " bins"]:
        """Frequencies of the selected bins [Hz]."""
        return np.arange(self.first_bin, self.last_bin + 1) * self.resolution

    @property
    def step(self) -> int:
        """Samples from the start of one segment to the start of the next."""
        # 0.29 * 100 is 28.999..., and means 29 samples.
        return max(self.length - math.floor(self.overlap * self.length + 1e-9), 1)

    @property
    def taper(self) -> Float[np.ndarray, " length"]:
        """The window's values, one per sample of a segment."""
        return np.asarray(scipy.signal.get_window(self.window, self.length))

    @property
    def sections(self) -> Float[np.ndarray, "sections 6"] | None:
        """The low-pass as second-order sections of `scipy.signal.butter`; `None` without filter."""
        if self.filter_cutoff is None:
            return None
        order, cutoff = self.filter_order, self.filter_cutoff
        return np.asarray(scipy.signal.butter(order, cutoff, fs=self.rate, output="sos"))

    def segments(self, samples: int) -> int:
        """Number of whole Welch segments in a window of that many samples, 0 if it is too short for one."""
        return max((samples - self.length) // self.step + 1, 0)

    def degrees_of_freedom(self, segments: int) -> float:
        """Equivalent degrees of freedom ν of a bin averaged over K segments: power ~ S χ²_ν / ν.

        ν = 2K / (1 + 2 Σ_j (1 - j/K) ρ_j²), where ρ_j = Σ_m w_m w_{m + j step} / Σ_m w_m² correlates segments
        j apart, for a density that is flat across a bin; half-overlapping Hann segments have ρ_1 = 1/6 only.
        Independent trials add their ν.

        **Raises:** `ValueError` unless K >= 1. **Source:** Welch 1967, doi:10.1109/TAU.1967.1161901.
        """
        require(segments >= 1, "segments", segments, "give the number of averaged segments, at least 1")
        w, step = self.taper, self.step
        lags = range(1, min(segments - 1, (self.length - 1) // step) + 1)
        rho = [np.sum(w[: -j * step] * w[j * step :]) / np.sum(w**2) for j in lags]
        excess = sum((1 - j / segments) * float(r) ** 2 for j, r in zip(lags, rho, strict=True))
        return 2 * segments / (1 + 2 * excess)

    def to_dict(self) -> dict[str, Any]:
        """The fields as TOML and JSON hold them; no cut-off is `"none"`, since TOML has no null."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return values | ({"filter_cutoff": "none"} if self.filter_cutoff is None else {})

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SpectrumSettings":
        """Settings from a table as `to_dict` writes it; what it does not name keeps its default.

        **Raises:** `ValueError` for an unknown name, with the nearest known one, and for an invalid value.
        """
        known = [field.name for field in dataclasses.fields(cls)]
        for name, value in values.items():
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            remedy = f"no such spectrum setting, did you mean {near!r}? Known are {', '.join(known)}"
            require(name in known, name, value, remedy)
        unfiltered = {"filter_cutoff": None} if values.get("filter_cutoff") == "none" else {}
        return cls(**{**values, **unfiltered})

    def replace(self, **changes: Any) -> "SpectrumSettings":
        """A copy with some fields changed; raises as `from_dict` does."""
        return self.from_dict(self.to_dict() | changes)


class Spectrum(eqx.Module):
    """A one-sided power spectral density on bins.

    `frequency` [Hz] has one value per bin; `power` [`unit`²/Hz] may have leading axes (seeds, trials). The
    functions here take those themselves; `jax.vmap` would give `frequency` one as well.
    """

    frequency: Float[Array | np.ndarray, " bins"]
    power: Float[Array | np.ndarray, "*batch bins"]
    settings: SpectrumSettings = eqx.field(static=True)
    unit: str = eqx.field(static=True, default="N")

    @property
    def proportional(self) -> Float[Array, "*batch bins"]:
        """Power of each bin over the sum of all bins: p_k = P_k / Σ_j P_j, without unit."""
        power = jnp.asarray(self.power)
        return power / jnp.sum(power, axis=-1, keepdims=True)

    def mean(self) -> "Spectrum":
        """The average over all leading axes: of absolute power, to be normalised afterwards."""
        power = jnp.asarray(self.power)
        power = jnp.mean(power, axis=tuple(range(power.ndim - 1)))
        return Spectrum(self.frequency, power, self.settings, self.unit)

    def plot(self, ax: Any = None, *, log: bool = False, proportional: bool = True, label: str | None = None) -> Any:
        """Draws power over frequency and returns the axes, see `jaxmuscle.plot.spectrum`."""
        from . import plot

        return plot.spectrum(self, ax, log=log, proportional=proportional, label=label)


def floating(signal: Real[Array | np.ndarray, "*batch times"]) -> Float[Array, "*batch times"]:
    """The signal as an array of its own floating dtype; whole numbers get the default one."""
    signal = jnp.asarray(signal)
    samples = signal.ndim >= 1 and signal.shape[-1] >= 1 and not jnp.iscomplexobj(signal)
    require(samples, "signal", jax.typeof(signal), "give real samples along the last axis, at least one")
    return signal if jnp.issubdtype(signal.dtype, jnp.floating) else signal.astype(jnp.result_type(float))


def _impulse_response(sections: Float[np.ndarray, "sections 6"], samples: int) -> Float[np.ndarray, " times"]:
    return np.asarray(scipy.signal.sosfilt(sections, np.eye(1, samples)[0]))


def _convolve(signal: Float[Array, "*batch times"], response: Float[np.ndarray, " times"]) -> Float[Array, "*batch times"]:
    """y_n = Σ_m h_m x_{n - m}, for as many samples as both have."""
    samples = signal.shape[-1]
    size = scipy.fft.next_fast_len(2 * samples - 1, real=True)
    transform = jnp.fft.rfft(signal, size)
    transfer = jnp.asarray(np.fft.rfft(response, size), transform.dtype)
    return jnp.fft.irfft(transform * transfer, size)[..., :samples]


def lowpass(signal: Real[Array | np.ndarray, "*batch times"], settings: SpectrumSettings) -> Float[Array, "*batch times"]:
    """Butterworth low-pass along the last axis, differentiable and without a loop over time.

    y_n = Σ_m h_m x_{n - m}, h the impulse response. `"forward"` starts from rest as `scipy.signal.sosfilt`,
    `"both"` is `scipy.signal.sosfiltfilt` (odd extension, steady start, zero phase). One non-finite sample
    makes the whole output non-finite.

    **Arguments:** `signal` in any unit, time along the last axis, sampled at `settings.rate`; `settings`.

    **Returns:** the filtered signal, same shape, dtype and unit; the signal itself for `filter_cutoff=None`.

    **Raises:** `ValueError` if the signal is too short for the extension that `"both"` needs.
    """
    signal, sections = floating(signal), settings.sections
    if sections is None:
        return signal
    if settings.filter_direction == "both":
        return _forward_and_backward(signal, sections)
    response = _impulse_response(sections, signal.shape[-1])
    # Exact for every offset, which so needs no derivative; keeps single precision for the fluctuations.
    offset = jax.lax.stop_gradient(jnp.mean(signal, axis=-1, keepdims=True))
    return _convolve(signal - offset, response) + offset * jnp.asarray(np.cumsum(response), signal.dtype)


def _forward_and_backward(
    x: Float[Array, "*batch times"], sections: Float[np.ndarray, "sections 6"]
) -> Float[Array, "*batch times"]:
    first_order = min(np.sum(sections[:, 2] == 0), np.sum(sections[:, 5] == 0))
    edge = 3 * (2 * len(sections) + 1 - int(first_order))
    remedy = f"filter_direction='both' needs more than {edge} samples; use a longer signal or 'forward'"
    require(x.shape[-1] > edge, "signal length", x.shape[-1], remedy)
    left = 2 * x[..., :1] - x[..., edge:0:-1]
    right = 2 * x[..., -1:] - x[..., -2 : -edge - 2 : -1]
    extended = jnp.concatenate((left, x, right), axis=-1)
    response = _impulse_response(sections, extended.shape[-1])

    # The gain at zero frequency is one: a steady start passes the first value and filters what is left.
    def steady(x: Float[Array, "*batch longer"]) -> Float[Array, "*batch longer"]:
        return x[..., :1] + _convolve(x - x[..., :1], response)

    return steady(steady(extended)[..., ::-1])[..., ::-1][..., edge:-edge]


def _density(segments: Float[Array, "*batch length"], settings: SpectrumSettings) -> Float[Array, "*batch frequencies"]:
    """One-sided density of every segment: |Σ_m w_m x_m e^{-2πikm/n}|² / (rate Σ w²), doubled inside."""
    samples, dtype = segments.shape[-1], segments.dtype
    if settings.detrend != "none":
        segments = segments - jnp.mean(segments, axis=-1, keepdims=True)
    if settings.detrend == "linear":
        line = np.arange(samples) - (samples - 1) / 2
        line = jnp.asarray(line / np.linalg.norm(line), dtype)
        segments = segments - jnp.sum(segments * line, axis=-1, keepdims=True) * line
    taper = scipy.signal.get_window(settings.window, samples)
    taper = jnp.asarray(taper / np.sqrt(settings.rate * np.sum(taper**2)), dtype)
    transform = jnp.fft.rfft(segments * taper)
    sides = np.full(transform.shape[-1], 2.0)
    sides[[0, -1] if samples % 2 == 0 else [0]] = 1.0
    return (transform.real**2 + transform.imag**2) * jnp.asarray(sides, dtype)


def welch(signal: Real[Array | np.ndarray, "*batch times"], settings: SpectrumSettings) -> Float[Array, "*batch bins"]:
    """Welch estimate of the one-sided power spectral density in the selected bins, as `scipy.signal.welch`.

    P_k = 2 / (K rate Σ w²) Σ_s |Σ_m w_m x_{s,m} e^{-2πikm/n}|², x_s being segment s of K after detrending; no
    factor 2 in bin 0 and at half the rate. Nothing is filtered here.

    **Arguments:** `signal` [unit], time along the last axis, sampled at `settings.rate`; `settings`.

    **Returns:** density [unit²/Hz] at `settings.frequency`, bins along the last axis, dtype of the signal.

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
    """The spectrum of the whole signal as one segment ("FFT"), at all frequencies from 0 to half the rate.

    As `scipy.signal.periodogram` with the window and detrend of `settings`; resolution `rate / samples`.

    **Arguments:** as for `welch`. **Returns:** frequency [Hz] and density [unit²/Hz].
    """
    signal = floating(signal)
    return np.fft.rfftfreq(signal.shape[-1], 1 / settings.rate), _density(signal, settings)


@eqx.filter_jit
def filtered_power(signal: Any, settings: SpectrumSettings, edges: tuple[int, int] | None) -> Float[Array, "*batch bins"]:
    filtered = lowpass(signal, settings)
    return welch(filtered if edges is None else filtered[..., edges[0] : edges[1]], settings)


def spectrum_of(
    signal: Real[Array | np.ndarray, "*batch times"],
    settings: SpectrumSettings,
    window: tuple[float, float] | None = None,
    *,
    unit: str = "N",
) -> Spectrum:
    """The procedure of the experiments: low-pass the whole signal, cut the analysed window, then Welch.

    **Arguments:** `signal` [unit], time along the last axis, sampled at `settings.rate`; `settings`; the
    analysed `window` (start, stop) in s from the start of the signal, or all of it; `unit` of the signal.

    **Returns:** a `Spectrum` with the leading axes of the signal.

    **Raises:** `ValueError` if the window lies outside the signal or is shorter than one segment. **Source:**
    Slifkin & Newell 1999, J Exp Psychol HPP 25(3):837-851.
    """
    edges = None
    if window is not None:
        samples = np.shape(signal)[-1]
        start, stop = (round(time * settings.rate) for time in window)
        remedy = f"give 0 <= start < stop <= {samples / settings.rate:g} s, the duration of the signal"
        require(0 <= start < stop <= samples, "window", window, remedy)
        edges = (start, stop)
    power = filtered_power(signal, settings, edges)
    return Spectrum(jnp.asarray(settings.frequency, power.dtype), power, settings, unit)
