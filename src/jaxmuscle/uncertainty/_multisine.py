"""The motion of a motor: what it may be, and a multisine with given lines whose peaks are low."""

import dataclasses
from typing import TypedDict

import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arguments import positive
from jaxmuscle._common.arrays import require

from ._lengthening import Lines, Samples, lines_in

STARTS, ROUNDS, CLIP = 16, 100, 0.9
FINE = 16  # samples per period of the fastest line
ENOUGH = 1e-6  # of a sample, relative
MOST = 10**8  # samples of a motion
LEAST_SECONDS = 8.0  # of a record, as a fit asks for


class MotionOptions(TypedDict, total=False):
    """What `design_input` takes as keywords of the motion."""

    rms: float
    band: tuple[float, float]
    seconds: float
    rate: float
    peak: float | None
    speed: float | None
    acceleration: float | None
    spread: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class Motion:
    """What is asked of a motion.

    Its limits `rms` [m], `peak` [m], `speed` [m/s] and `acceleration` [m/s²]; the `band` [Hz] of
    its lines; its period `seconds`; the `rate` [Hz] of the signal; the `spread`, which is the share
    of its mean square that is even over the band.
    """

    rms: float = 1e-3
    band: tuple[float, float] = (0.5, 5.0)
    seconds: float = 60.0
    rate: float = 1000.0
    peak: float | None = None
    speed: float | None = None
    acceleration: float | None = None
    spread: float = 0.1

    def __post_init__(self) -> None:
        for name in ("rms", "peak", "speed", "acceleration", "rate"):
            if getattr(self, name) is not None:
                positive(name, getattr(self, name))
        seconds, rate = self.seconds, self.rate
        require(0 <= self.spread <= 1, f"spread = {self.spread} must be a share, from 0 to 1")
        require(
            seconds >= LEAST_SECONDS,
            f"seconds = {seconds}: give at least {LEAST_SECONDS:g} s, since less holds no spectrum",
        )
        require(
            seconds * rate <= MOST,
            f"seconds = {seconds} at rate = {rate} Hz are more than {MOST} samples: make it"
            " shorter",
        )
        require(
            abs(self.samples - seconds * rate) < ENOUGH * self.samples,
            f"seconds = {seconds}: rate = {rate} Hz makes no whole number of samples of it",
        )
        require(
            2 * self.frequency[-1] < rate,
            f"band = {self.band} Hz reaches beyond half of rate = {rate} Hz: raise the rate",
        )

    @property
    def samples(self) -> int:
        """Of one period."""
        return round(self.seconds * self.rate)

    @property
    def frequency(self) -> Lines:
        """Frequencies of its lines [Hz]."""
        return lines_in(self.band, self.seconds)

    @property
    def limits(self) -> Float[np.ndarray, "3"]:
        """Largest displacement [m], speed [m/s] and acceleration [m/s²]; infinite without one."""
        limits = (self.peak, self.speed, self.acceleration)
        return np.array([np.inf if limit is None else limit for limit in limits])

    def realise(
        self, power: Lines, rng: np.random.Generator
    ) -> tuple[Samples, Float[np.ndarray, "3"]]:
        """One period of a motion of these lines, made smaller where a limit asks for it, and the
        crest factors of it and its derivatives."""
        lines = self.frequency * self.seconds
        motion = multisine(lines, power, self.seconds, self.samples, self.limits, rng)
        moved = derivatives(motion, self.seconds)
        tops = np.max(np.abs(moved), axis=1)
        return motion * min(1.0, *(self.limits / tops)), tops / np.sqrt(np.mean(moved**2, axis=1))


def derivatives(displacement: Samples, seconds: float) -> Float[np.ndarray, "3 samples"]:
    """One period of a motion, its speed and its acceleration."""
    n = len(displacement)
    rate = 2j * np.pi * np.arange(n // 2 + 1) / seconds
    return np.fft.irfft(np.fft.rfft(displacement) * rate ** np.arange(3)[:, None], n)


def multisine(
    lines: np.ndarray,
    power: Float[np.ndarray, " lines"],
    seconds: float,
    samples: int,
    limits: Float[np.ndarray, "3"],
    rng: np.random.Generator,
) -> Float[np.ndarray, " samples"]:
    """One period of `Σ_k √(2 p_k) cos(2π n_k t / T + φ_k)`, n_k the `lines`: whole numbers of
    periods in the record.

    The phases start at random. Then the highest peaks are clipped off and the phases of what is
    left are taken, again and again (time-frequency swapping): of position, velocity or
    acceleration, whichever is nearest to its limit ([m], [m/s], [m/s²]; infinite: none). Of several
    starts the best. The period begins near a zero of slow motion.

    **Source:** van der Ouderaa, Schoukens & Renneboog 1988, doi:10.1109/19.2679.
    """
    places, fine = np.rint(lines).astype(int), max(FINE * round(lines[-1]), 64)
    size, rate = np.sqrt(2 * power), 2j * np.pi * lines / seconds
    # Of every derivative that has a limit: what its spectrum is of that of the position, in units
    # of the limit.
    scales = [rate**order / limit for order, limit in enumerate(limits) if np.isfinite(limit)] or [
        np.ones_like(rate)
    ]
    phases = np.exp(2j * np.pi * rng.random((STARTS, len(lines))))
    best, lowest = phases, np.full((STARTS, 1), np.inf)
    for _ in range(ROUNDS):
        moved = np.stack([_wave(places, size * phases * scale, fine) for scale in scales])
        peaks = np.max(np.abs(moved), axis=2)
        nearest = np.argmax(peaks, axis=0)
        worst = np.max(peaks, axis=0)[:, None]
        best, lowest = np.where(worst < lowest, phases, best), np.minimum(worst, lowest)
        clipped = np.clip(moved[nearest, np.arange(STARTS)], -CLIP * worst, CLIP * worst)
        found = np.fft.rfft(clipped, axis=1)[:, places] / np.stack(scales)[nearest]
        phases = np.where(found == 0, phases, found / np.maximum(np.abs(found), 1e-300))
    chosen = best[np.argmin(lowest)][None]
    moved, speed = (_wave(places, size * chosen * d, samples)[0] for d in (1.0, rate))
    slow = np.abs(moved) / np.max(np.abs(moved)) + np.abs(speed) / np.max(np.abs(speed))
    return np.roll(moved, -int(np.argmin(slow)))


def _wave(places: np.ndarray, size: np.ndarray, samples: int) -> np.ndarray:
    spectrum = np.zeros((len(size), samples // 2 + 1), complex)
    spectrum[:, places] = 0.5 * samples * size
    return np.fft.irfft(spectrum, samples, axis=1)
