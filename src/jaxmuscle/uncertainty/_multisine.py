"""A motion with given lines: phases that keep its peaks low."""

import numpy as np
from jaxtyping import Float

STARTS, ROUNDS, CLIP = 16, 100, 0.9
FINE = 16  # samples per period of the fastest line


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


def speed_of(
    displacement: Float[np.ndarray, " samples"], seconds: float
) -> Float[np.ndarray, " samples"]:
    """Velocity of one period of a motion."""
    n = len(displacement)
    return np.fft.irfft(np.fft.rfft(displacement) * 2j * np.pi * np.arange(n // 2 + 1) / seconds, n)


def _wave(places: np.ndarray, size: np.ndarray, samples: int) -> np.ndarray:
    spectrum = np.zeros((len(size), samples // 2 + 1), complex)
    spectrum[:, places] = 0.5 * samples * size
    return np.fft.irfft(spectrum, samples, axis=1)
