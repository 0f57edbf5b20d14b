"""A muscle whose insertion is moved, in NumPy alone: a reference that shares no code with the
package."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.signal

import jaxmuscle as jm

DT = 0.00125  # s between samples of the inputs; a Runge-Kutta step takes two
MARGIN = 4.0  # s before and after the window
MOTION = (1e-3, 5.0)  # rms [m], highest frequency [Hz]
EVERY = 2  # steps from sample to sample of a recording


class Sines:
    """Lines of equal size and random phase in a band: rows of signals of 1 rms, of so many seconds
    each, that repeat."""

    def __init__(
        self,
        rng: np.random.Generator,
        seconds: float,
        rows: int,
        *,
        low: float = 0.1,
        high: float = 5.0,
    ):
        self.line = np.arange(np.ceil(low * seconds), np.floor(high * seconds) + 1).astype(int)
        self.f, self.samples = self.line / seconds, round(seconds / DT)
        self.coefficient = np.sqrt(2 / self.f.size) * np.exp(
            2j * np.pi * rng.uniform(size=(rows, self.f.size))
        )

    def __call__(self, gain: Any) -> np.ndarray:
        """The signals, shape (times, rows), every line times its complex gain."""
        spectrum = np.zeros((self.samples // 2 + 1, len(self.coefficient)), complex)
        spectrum[self.line] = (self.samples / 2 * gain * self.coefficient).T
        return np.fft.irfft(spectrum, self.samples, axis=0)


def force(
    task: jm.PrescribedLength,
    x: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    drive: np.ndarray,
    noise_w: np.ndarray,
    noise_z: np.ndarray,
) -> np.ndarray:
    """F_ext [N] by equations (1) and (2), one for two samples of x_z, its slopes, and what adds to
    P_w, K_w and K_z."""
    m_w, m_z, P_w = (float(task[name]) for name in ("m_w", "m_z", "P_w"))
    k_w, k_z, c_w, c_z = (float(task[name]) for name in ("k_w", "k_z", "c_w", "c_z"))
    x_ref_w, x_ref_z, v_ref_w, v_ref_z = (
        float(task[name]) for name in ("x_ref_w", "x_ref_z", "v_ref_w", "v_ref_z")
    )
    K_z, C_z = k_z * (x_ref_z**2 + x**2) + noise_z, c_z * (v_ref_z**2 + v**2)

    def slope(x_w: np.ndarray, v_w: np.ndarray, i: int) -> tuple[np.ndarray, np.ndarray]:
        own = (k_w * (x_ref_w**2 + x_w**2) + noise_w[i]) * x_w + c_w * (v_ref_w**2 + v_w**2) * v_w
        return v_w, (P_w + drive[i] - own + C_z[i] * (v[i] - v_w) + K_z[i] * (x[i] - x_w)) / m_w

    x_w, v_w = np.full(x.shape[1], 0.5 * P_w / (k_z * x_ref_z**2)), np.zeros(x.shape[1])
    found, h = [], 2 * DT
    for i in range(0, len(x) - 1, 2):
        found.append(-(m_z * a[i] + C_z[i] * (v[i] - v_w) + K_z[i] * (x[i] - x_w)))
        p1, q1 = slope(x_w, v_w, i)
        p2, q2 = slope(x_w + h / 2 * p1, v_w + h / 2 * q1, i + 1)
        p3, q3 = slope(x_w + h / 2 * p2, v_w + h / 2 * q2, i + 1)
        p4, q4 = slope(x_w + h * p3, v_w + h * q3, (i + 2) % len(x))
        x_w, v_w = (
            x_w + h / 6 * (p1 + 2 * p2 + 2 * p3 + p4),
            v_w + h / 6 * (q1 + 2 * q2 + 2 * q3 + q4),
        )
    return np.array(found)


def recorded(
    task: jm.PrescribedLength,
    rng: np.random.Generator,
    rows: int,
    seconds: float = 60.0,
    motion: tuple[float, float] = MOTION,
    *,
    reflex: Callable[[np.ndarray], np.ndarray] | None = None,
    mass: float = 0.0,
    line: float = 0.0,
) -> list[jm.data.PerturbedRecording]:
    """Recordings of the muscle with noise on its stiffnesses; `motion`, its rms [m] and highest
    frequency [Hz]; `reflex`, drive over lengthening;
    `mass` of a rig; `line`, of which relative amplitude a sine of 4.25 Hz is in both."""
    rms, high = motion
    sines = Sines(rng, seconds + 2 * MARGIN, rows, high=high)
    s = 2j * np.pi * sines.f
    x, v, a = (sines(rms * s**n) for n in range(3))
    low = scipy.signal.butter(2, 50.0, fs=1 / DT, output="sos")
    noise = []
    for j in "wz":  # the density of white noise that is drawn 100 times a second
        size = (
            float(task[f"noise_K_{j}"])
            * float(task[f"k_{j}"])
            * float(task[f"x_ref_{j}"]) ** 2
            / np.sqrt(100 * DT)
        )
        noise.append(size * scipy.signal.sosfilt(low, rng.standard_normal(x.shape), axis=0))
        beat = line * np.sin(2 * np.pi * 4.25 * DT * np.arange(len(x)))[:, None]
        noise[-1] += float(task[f"k_{j}"]) * float(task[f"x_ref_{j}"]) ** 2 * beat
    drive = np.zeros_like(x) if reflex is None else -sines(rms * reflex(s))
    pull = (force(task, x, v, a, drive, *noise) - mass * a[::2])[::EVERY]
    window = (MARGIN, MARGIN + seconds)
    return [
        jm.data.PerturbedRecording.from_array(
            pull[:, row],
            -x[:: 2 * EVERY, row],
            0.5 / DT / EVERY,
            name=f"r{row}",
            positive="lengthening",
            window=window,
        )
        for row in range(rows)
    ]
