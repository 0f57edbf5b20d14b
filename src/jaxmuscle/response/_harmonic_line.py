"""The harmonic's line in a Welch spectrum, and how a segment is transformed."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from jaxmuscle._common.matrices import exponential
from jaxmuscle.model._signals import Constant
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._bin_law import bin_rows, sides_of
from jaxmuscle.spectra._decimation import FINER, anti_alias
from jaxmuscle.spectra._settings import SpectrumSettings, tapers_of
from jaxmuscle.spectra._welch import lowpass, spectrum_of

from ._linear_task import Linearisation
from ._transfer import harmonic_system, times_i, transfer, turn_of

# samples of a segment: beyond, a fast Fourier transform takes the place of matrices, whose size is
# its square
LONG = 1024


def transformed(
    settings: SpectrumSettings, x: Float[Array, "*some samples"]
) -> Complex[Array, "*some bins"]:
    """Fourier transform of segments, at the bins."""
    return jnp.fft.rfft(x)[..., settings.first_bin : settings.last_bin + 1]


def removed(settings: SpectrumSettings) -> Float[np.ndarray, "directions samples"]:
    """What detrending removes of a segment: orthonormal directions."""
    m = np.arange(settings.length) - (settings.length - 1) / 2
    rows = {"none": [], "constant": [np.ones_like(m)], "linear": [np.ones_like(m), m]}[
        settings.detrend
    ]
    return np.array([row / np.linalg.norm(row) for row in rows]).reshape(-1, settings.length)


def _ordinates(
    settings: SpectrumSettings, x: Float[Array, " samples"]
) -> Complex[Array, "bins tapers"]:
    """`bin_rows(settings) @ x` of a long segment."""
    away, tapers = (
        jnp.asarray(a, x.dtype) for a in (removed(settings), tapers_of(settings, settings.length))
    )
    found = transformed(settings, tapers * (x - away.T @ (away @ x))).T
    return found * jnp.asarray(np.sqrt(sides_of(settings))[:, None], found.dtype)


def _low_pass(segments: "Segments", turn: Complex[Array, ""]) -> Complex[Array, ""]:
    """Frequency response of the digital low-pass at z = `turn`."""
    back = jnp.stack([jnp.ones_like(turn), 1 / turn, 1 / turn**2])
    sections = jnp.asarray(segments.sections, turn.dtype)
    gain = jnp.prod((sections[:, :3] @ back) / (sections[:, 3:] @ back))
    return jnp.where(segments.both > 0, gain * jnp.conj(gain), gain)


def _sampled(angle: Float[Array, ""], sampling: str) -> Complex[Array, ""]:
    """What sampling does to a line that turns by `angle` in an interval: the average before each
    sample, or the filter."""
    if sampling == "average":
        return (1 - turn_of(-angle)) / times_i(angle)
    taps = anti_alias(FINER) if sampling == "filtered" else np.ones(1)
    turns = turn_of(angle * jnp.asarray(np.arange(len(taps)) - len(taps) // 2, angle.dtype) / FINER)
    return jnp.asarray(taps, turns.dtype) @ turns


class Segments(NamedTuple):
    """How a signal becomes the segments of a Welch spectrum, as arrays: real and imaginary parts of
    the `bin_rows` (none of long segments), the sampling interval [s], where segments begin
    [samples] and how much each counts, sections of the low-pass, and whether it is passed both
    ways."""

    rows: Float[Array | np.ndarray, "bins parts samples"]
    interval: Float[Array | np.ndarray, ""]
    begins: Float[Array | np.ndarray, " segments"]
    weight: Float[Array | np.ndarray, " segments"]
    sections: Float[Array | np.ndarray, "sections 6"]
    both: Float[Array | np.ndarray, ""]

    def filled(self, bins: int, samples: int) -> "Segments":
        """In a larger shape: with bins that are zero, and what counts nothing."""
        more = -len(self.begins) % 64
        none = np.tile([1.0, 0, 0, 1, 0, 0], (max(8 - len(self.sections), 0), 1))
        zeros = ((0, bins - len(self.rows)), (0, 0), (0, samples - self.rows.shape[-1]))
        return Segments(
            np.pad(self.rows, zeros),
            self.interval,
            np.pad(self.begins, (0, more), mode="edge"),
            np.pad(self.weight, (0, more)),
            np.concatenate([self.sections, none]),
            self.both,
        )


@functools.cache
def segments_of(settings: SpectrumSettings, window: tuple[float, float]) -> Segments:
    """Those of some settings in a window."""
    start, stop = (round(edge * settings.rate) for edge in window)
    count = settings.segments(stop - start)
    rows = bin_rows(settings) if settings.length <= LONG else np.zeros((0, 0, 0))
    return Segments(
        np.concatenate([np.real(rows), np.imag(rows)], axis=1),
        np.array(1 / settings.rate),
        start + settings.step * np.arange(max(count, 1), dtype=float),
        np.full(max(count, 1), 1 / count if count else np.nan),
        np.zeros((0, 6)) if settings.sections is None else settings.sections,
        np.array(float(settings.filter_direction == "both")),
    )


class LineTable(NamedTuple):
    """What a line `Im(r e^(iωt))`, r = x + iy, of one frequency gives.

    Welch power `level · (x² + y², x² - y², 2xy)` in every bin, phase and leakage included; variance
    of a recording `½ |r|² passed - ½ Re(r² twice) - Im(r once)²`; both after the low-pass.
    """

    level: Float[Array, "3 bins *frequencies"]
    passed: Float[Array, "*frequencies"]
    once: Complex[Array, "*frequencies"]
    twice: Complex[Array, "*frequencies"]

    def power(self, reply: Complex[Array, "*frequencies"]) -> Float[Array, "bins *frequencies"]:
        """Welch power of every bin, in the precision of `level`."""
        x, y = jnp.real(reply), jnp.imag(reply)
        steady, turning, turned = (
            part.astype(self.level.dtype) for part in (x**2 + y**2, x**2 - y**2, 2 * x * y)
        )
        return jnp.maximum(
            steady * self.level[0] + turning * self.level[1] + turned * self.level[2], 0.0
        )

    def variance(self, reply: Complex[Array, "*frequencies"]) -> Float[Array, "*frequencies"]:
        """Variance of the recording."""
        return (
            0.5 * (jnp.abs(reply) ** 2 * self.passed - jnp.real(reply**2 * self.twice))
            - jnp.imag(reply * self.once) ** 2
        )


def _turns(
    turns: Float[Array, ""], start: Float[Array, ""], samples: Int[Array | np.ndarray, ""] | int
) -> Complex[Array, ""]:
    """Mean of `exp(2πi turns m)` over so many successive m from `start` on."""
    n = jnp.asarray(samples, turns.dtype)
    size = jnp.sinc(n * turns) / jnp.sinc(turns)
    spin = turn_of(2 * jnp.pi * turns * (start + 0.5 * (n - 1)))
    return spin * size.astype(spin.dtype)


def line_table(
    settings: SpectrumSettings,
    window: tuple[float, float],
    frequency: Float[Array, ""],
    samples: Int[Array | np.ndarray, ""] | int,
) -> LineTable:
    """The table for one frequency [Hz]: the line is sampled, low-passed, cut into segments, tapered
    and transformed.

    Segments are those of the window; its variance is that of so many samples from the window's
    begin on.
    """
    return _differentiable(settings, window, frequency, jnp.asarray(samples))


def _table(
    settings: SpectrumSettings,
    window: tuple[float, float],
    frequency: Float[Array, ""],
    samples: Int[Array, ""],
) -> LineTable:
    long = settings if settings.length > LONG else None
    return table_of(segments_of(settings, window), frequency, samples, settings.sampling, long)


def _wave(angle: Float[Array, ""], count: int) -> tuple[Array, Array]:
    """cos and sin of `angle m`, m = 0 ... count - 1: of few angles, whose sums give the others."""
    few = 1 << ((count - 1).bit_length() + 1) // 2
    fine = angle * np.arange(few, dtype=angle.dtype)
    coarse = (angle * few) * np.arange(-(-count // few), dtype=angle.dtype)[:, None]
    c, s, cos, sin = jnp.cos(fine), jnp.sin(fine), jnp.cos(coarse), jnp.sin(coarse)
    both = (cos * c - sin * s).reshape(-1), (sin * c + cos * s).reshape(-1)
    return both[0][:count], both[1][:count]


def table_of(
    segments: Segments,
    frequency: Float[Array, ""],
    samples: Int[Array, ""],
    sampling: str,
    long: SpectrumSettings | None,
) -> LineTable:
    """`line_table` of segments; of `long` ones with their settings."""
    interval = jnp.asarray(segments.interval, frequency.dtype)
    angle = 2 * jnp.pi * frequency * interval
    turn, gain = turn_of(angle), _sampled(angle, sampling)
    # With ahead, behind = rows @ e^(±i angle m) and z the same of the real and of the imaginary
    # rows, which takes no complex product: Σ |ahead|² + |behind|² = 2 Σ |z|² and Σ ahead
    # conj(behind) = Σ z².
    if long is not None:
        wave = _wave(angle, long.length)
        parts = [(jnp.real(x), jnp.imag(x)) for x in (_ordinates(long, own) for own in wave)]
        z = jax.lax.complex(*(jnp.concatenate(own, axis=1) for own in parts))
    else:
        rows = jnp.asarray(segments.rows, angle.dtype)
        cos, sin = _wave(angle, rows.shape[-1])
        z = jax.lax.complex(rows @ cos, rows @ sin)
    through = gain * _low_pass(segments, turn)
    level = 0.5 * jnp.abs(through) ** 2 * jnp.sum(jnp.abs(z) ** 2, axis=1)
    both = jnp.sum(z**2, axis=1)
    begins, weight = (jnp.asarray(x, angle.dtype) for x in (segments.begins, segments.weight))
    around = turn_of(2 * angle * begins)
    turning = 0.5 * through**2 * jnp.sum(weight.astype(around.dtype) * around) * both
    level = jnp.stack([level, -jnp.real(turning), jnp.imag(turning)])
    once, twice = (
        through**k * _turns(k * frequency * interval, begins[0], samples) for k in (1, 2)
    )
    return LineTable(level, jnp.abs(through) ** 2, once, twice)


_differentiable = jax.custom_jvp(_table, nondiff_argnums=(0, 1))


@_differentiable.defjvp
def _slope_of_table(
    settings: SpectrumSettings, window: tuple[float, float], at: Any, towards: Any
) -> tuple[Any, Any]:
    """The table depends on one number. So its slope is computed once, for however many
    directions."""
    frequency, samples = at
    one = jnp.ones_like(frequency)
    table, slope = jax.jvp(lambda f: _table(settings, window, f, samples), (frequency,), (one,))
    return table, jax.tree.map(lambda x: x * towards[0].astype(x.dtype), slope)


def harmonic_line(
    task: AbstractTask,
    system: Linearisation,
    settings: SpectrumSettings,
    window: tuple[float, float],
    samples: Int[Array | np.ndarray, ""] | int,
) -> tuple[Float[Array, " bins"], Float[Array, ""]]:
    """Welch power of the harmonic's response, phase and leakage included, and its variance in a
    recording.

    With an envelope that changes, its variance in the window.
    """
    harmonic = task.harmonic
    if not isinstance(harmonic.envelope, Constant):
        return _enveloped_line(task, system, settings, window)
    frequency = jnp.asarray(harmonic.frequency, system.A.dtype)
    table = line_table(settings, window, frequency, samples)
    reply = harmonic_size(task, system.A.dtype) * transfer(
        harmonic_system(task, system), 2 * jnp.pi * frequency
    )
    return table.power(reply), table.variance(reply)


def harmonic_size(task: AbstractTask, dtype: Any) -> Complex[Array, ""]:
    """Amplitude, steady envelope and phase of the harmonic as one complex number."""
    harmonic = task.harmonic
    assert isinstance(harmonic.envelope, Constant)
    size = jnp.asarray(harmonic.amplitude, dtype) * jnp.asarray(harmonic.envelope.level, dtype)
    turn = turn_of(jnp.asarray(harmonic.phase, dtype))
    return size.astype(turn.dtype) * turn


def _enveloped_line(
    task: AbstractTask,
    system: Linearisation,
    settings: SpectrumSettings,
    window: tuple[float, float],
) -> tuple[Float[Array, " bins"], Float[Array, ""]]:
    """The same for an envelope that changes: the deterministic response, slow in the frame that
    turns with the harmonic.

    `Y' = (A - iω) Y + B b a(t)` for y = Im(Y e^{i(ωt + φ)}) is stepped exactly for an envelope a
    linear between samples, from the steady state of its value at t = 0.
    """
    harmonic, dtype, A, b, c, d, e = task.harmonic, system.A.dtype, *harmonic_system(task, system)
    omega, interval = 2 * jnp.pi * jnp.asarray(harmonic.frequency, dtype), 1 / settings.rate
    start, stop = (round(edge * settings.rate) for edge in window)
    time = jnp.arange(stop, dtype=dtype) * interval
    level, slope = jax.vmap(lambda t: jax.jvp(harmonic.envelope, (t,), (jnp.ones_like(t),)))(time)
    whirl = times_i(omega)
    n, drive = len(A), b.astype(whirl.dtype)
    turning = A.astype(whirl.dtype) - whirl * jnp.eye(n, dtype=whirl.dtype)
    blocks = jnp.zeros((n + 2, n + 2), whirl.dtype)
    blocks = (
        blocks.at[:n, :n]
        .set(turning * interval)
        .at[:n, n]
        .set(drive * interval)
        .at[n, n + 1]
        .set(1.0)
    )
    whole = exponential(blocks)
    step, held, ramp = whole[:n, :n], whole[:n, n], whole[:n, n + 1]

    def advance(Y, pair):
        Y = step @ Y + held * pair[0] + ramp * (pair[1] - pair[0])
        return Y, Y

    pairs = jnp.stack([level[:-1], level[1:]], axis=1).astype(whirl.dtype)
    first = -jnp.linalg.solve(turning, drive * pairs[0, 0])
    _, later = jax.lax.scan(advance, first, pairs)
    Y = jnp.concatenate([first[None], later])
    around = turn_of(omega * time + jnp.asarray(harmonic.phase, dtype)) * _sampled(
        omega * interval, settings.sampling
    )
    direct = jax.lax.complex(d * level + e * slope, e * omega * level)
    z = jnp.asarray(harmonic.amplitude, dtype) * jnp.imag((Y @ c.astype(Y.dtype) + direct) * around)
    return jnp.asarray(spectrum_of(z, settings, window).power), jnp.var(
        lowpass(z, settings)[start:stop]
    )
