"""How a spectrum is estimated, and the window that is analysed."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any, Literal, get_args

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxmuscle._common.arguments import count, is_real, require
from jaxmuscle._common.cards import Spelled
from jaxmuscle._common.documents import converted
from jaxmuscle._common.text import choices

Window = Literal["hann", "hamming", "boxcar", "dpss"]
Detrend = Literal["constant", "linear", "none"]
FilterDirection = Literal["forward", "both"]
Sampling = Literal["instant", "average", "filtered"]
_CHOICES = {
    "window": Window,
    "detrend": Detrend,
    "filter_direction": FilterDirection,
    "sampling": Sampling,
}


COSINES: dict[Window, float] = {"hann": 0.5, "hamming": 0.54, "boxcar": 1.0}
_SLOW = {"length": 1000, "last_bin": 117, "detrend": "linear"}
NAMED: dict[str, dict[str, Any]] = {
    "standard": {},
    "slow": _SLOW,
    "multitaper": _SLOW | {"first_bin": 2, "window": "dpss", "tapers": 3},
    "pwelch": {"window": "hamming", "detrend": "none"},
}
# Rate [Hz], samples of a segment, order of the low-pass: more is a slip, and fills the memory.
FASTEST, LENGTH, ORDER = (1e9, 2**22, 50)
# of the signal, not of its spectrum
_AROUND = ("filter_order", "filter_cutoff", "filter_direction", "sampling")


def taper_of(window: Window, samples: int) -> Float[np.ndarray, " samples"]:
    """`a + (1 - a) cos x`, x from -π to π in so many steps: that of `scipy.signal`, which takes
    long to import."""
    a = COSINES[window]
    return a + (1 - a) * np.cos(np.linspace(-np.pi, np.pi, samples + 1)[:-1])


def _python(value: Any) -> Any:
    return value.item() if isinstance(value, np.number) else value


class SpectrumSettings(Spelled, eqx.Module):
    """How a spectrum is estimated; every choice the papers leave open is a field.

    The defaults are the procedure of Slifkin & Newell (1999, J Exp Psychol HPP 25(3):837-851);
    `named` has others.

    | field | meaning |
    |---|---|
    | `rate` | sampling rate [Hz] |
    | `length` | samples per segment and transform; the resolution is `rate / length` |
    | `first_bin`, `last_bin` | bins kept, both included; bin k lies at `k * rate / length` |
    | `window`, `overlap` | taper (periodic, as in `scipy.signal`) and the fraction neighbours share |
    | `tapers` | of the window `"dpss"`: how many Slepian tapers K, of time-bandwidth NW = (K + 1) / 2; else 1 |
    | `detrend` | what is removed from each segment: its mean, its straight line, or nothing |
    | `filter_order`, `filter_cutoff` | Butterworth low-pass; cut-off [Hz], or `None` for no filter |
    | `filter_direction` | `"forward"` (from rest), or `"both"` (zero phase, for recordings) |
    | `sampling` | `"instant"`, the `"average"` over a sampling interval, or `"filtered"`, before, against aliases |

    **Raises:** `ValueError` naming the field, its value and the remedy.
    """  # noqa: E501 (a row of a table is one line)

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
    tapers: int = eqx.field(static=True, default=1, converter=_python)

    def __check_init__(self):
        rate, overlap, cutoff, tapers = self.rate, self.overlap, self.filter_cutoff, self.tapers
        remedy = f"give a sampling rate above 0 Hz, at most {FASTEST:g} Hz"
        require(is_real(rate) and 0 < rate <= FASTEST, "rate", rate, remedy)
        count("length", self.length, 8, LENGTH)
        count("last_bin", self.last_bin, 1, self.length // 2)
        count("first_bin", self.first_bin, 0, self.last_bin)
        remedy = "give a fraction of a segment, 0 to below 1"
        require(is_real(overlap) and 0 <= overlap < 1, "overlap", overlap, remedy)
        count("filter_order", self.filter_order, 1, ORDER)
        if cutoff is not None:
            remedy = f"give a frequency from 0 to rate / 2 = {rate / 2:g} Hz, or None for no filter"
            require(is_real(cutoff) and 0 < cutoff < rate / 2, "filter_cutoff", cutoff, remedy)
        for name, choice in _CHOICES.items():
            value, known = getattr(self, name), get_args(choice)
            require(value in known, name, value, f"choose one of {', '.join(known)}")
        if self.window == "dpss":
            count("tapers", tapers, 2, max(self.length // 8, 2))
        else:
            require(
                type(tapers) is int and tapers == 1, "tapers", tapers, "give 1, or window='dpss'"
            )

    @classmethod
    def named(cls, name: str) -> "SpectrumSettings":
        """Settings by name.

        | name | spectrum |
        |---|---|
        | `"standard"` | the defaults: segments of 256 samples, bins of 0.39 Hz |
        | `"slow"` | below 1 Hz: segments of 10 s less their straight line, bins of 0.1 Hz from 0.1 to 11.7 Hz |
        | `"multitaper"` | the same with three Slepian tapers (NW = 2, bands of 0.4 Hz) from 0.2 Hz on |
        | `"pwelch"` | MATLAB's defaults: Hamming window and no detrend, so the mean leaks into bin 1 |

        Of `"pwelch"` two details stay as they are here: `length` (MATLAB would cut the signal into
        eight segments) and the periodic form of the window (MATLAB's is symmetric).

        **Raises:** `ValueError` for another name. **Source:** Thomson 1982,
        doi:10.1109/PROC.1982.12433 (multitaper).
        """  # noqa: E501 (a row of a table is one line)
        known = isinstance(name, str) and name in NAMED
        require(known, "settings", name, choices(str(name), NAMED))
        return cls(**NAMED[name])

    @property
    def name(self) -> str | None:
        """Which of the names of `named` these settings have, without regard to low-pass and
        sampling; `None` if none."""
        plain = self.replace(**{field: getattr(SpectrumSettings(), field) for field in _AROUND})
        return next((name for name in NAMED if plain == SpectrumSettings.named(name)), None)

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
    def sections(self) -> Float[np.ndarray, "sections 6"] | None:
        """The low-pass as second-order sections of `scipy.signal.butter`; `None` without filter."""
        if self.filter_cutoff is None:
            return None
        order, cutoff = self.filter_order, self.filter_cutoff
        return np.asarray(scipy.signal.butter(order, cutoff, fs=self.rate, output="sos"))

    def segments(self, samples: int) -> int:
        """Number of whole Welch segments in a window of that many samples, 0 if it is too short for
        one."""
        return max((samples - self.length) // self.step + 1, 0)

    def degrees_of_freedom(self, segments: int) -> float:
        """Equivalent degrees of freedom ν of a bin averaged over K segments: power ~ S χ²_ν / ν.

        ν = 2K / (ρ_0² + 2 Σ_j (1 - j/K) ρ_j²), where ρ_j² = Σ_tu (Σ_m w_tm w_{u, m + j step})²,
        Σ_tm w_tm² = 1, correlates segments j apart with tapers t and u, for a density that is flat
        across a bin; half-overlapping Hann segments have ρ_1 = 1/6 only, and T tapers ρ_0² = 1/T.
        Independent trials add their ν.

        **Raises:** `ValueError` unless K >= 1. **Source:** Welch 1967,
        doi:10.1109/TAU.1967.1161901.
        """
        remedy = "give the number of averaged segments, at least 1"
        require(segments >= 1, "segments", segments, remedy)
        w, n, step = tapers_of(self, self.length), self.length, self.step
        lags = range(min(segments - 1, (n - 1) // step) + 1)
        squares = [float(np.sum((w[:, : n - j * step] @ w[:, j * step :].T) ** 2)) for j in lags]
        beside = sum((1 - j / segments) * squares[j] for j in lags[1:])
        return 2 * segments / (squares[0] + 2 * beside)

    def to_dict(self) -> dict[str, Any]:
        """The fields as TOML and JSON hold them; no cut-off is `"none"`, as TOML has no null."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return values | ({"filter_cutoff": "none"} if self.filter_cutoff is None else {})

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], *, whole: bool = False) -> "SpectrumSettings":
        """Settings from a table as `to_dict` writes it; what it does not name keeps its default,
        unless the table has to be `whole`.

        **Raises:** `ValueError` for an unknown name, with the nearest known one, for one missing,
        and for an invalid value.
        """
        kinds: dict[str, Any] = {field.name: field.type for field in dataclasses.fields(cls)}
        for name in kinds if whole else ():
            if name not in values:
                raise ValueError(
                    f"has no key {name!r}: give it; a setting that is not there gets no default"
                )
        given = dict(values)
        if given.get("filter_cutoff") == "none":
            given["filter_cutoff"] = None
        for name, value in given.items():  # ranges are checked by the constructor
            remedy = f"no such spectrum setting; {choices(name, kinds)}"
            require(name in kinds, name, value, remedy)
            converted(_python(value), kinds[name], name)
        return cls(**given)

    def replace(self, **changes: Any) -> "SpectrumSettings":
        """A copy with some fields changed; raises as `from_dict` does."""
        return self.from_dict(self.to_dict() | changes)


@functools.lru_cache(maxsize=32)
def tapers_of(settings: SpectrumSettings, samples: int) -> Float[np.ndarray, "tapers samples"]:
    """Tapers for so many samples, one a row; all squares sum to 1, so power is `2 / rate Σ_t |Σ_m
    w_tm x_m e^..|²`."""
    if settings.window == "dpss":
        rows = np.asarray(
            scipy.signal.windows.dpss(samples, (settings.tapers + 1) / 2, settings.tapers)
        )
    else:
        rows = taper_of(settings.window, samples)[None]
    return rows / np.sqrt(np.sum(rows**2))


WINDOW = (5.0, 15.0)
LONGEST = 2**17  # samples of a recording; longer ones count as that long


def samples_in(window: tuple[float, float], settings: SpectrumSettings) -> int:
    """How many samples a window has."""
    return round(window[1] * settings.rate) - round(window[0] * settings.rate)
