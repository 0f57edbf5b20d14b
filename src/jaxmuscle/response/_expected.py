"""The expected Welch spectrum of a task in linear response, in closed form."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float, Int

from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._activation import ACTIVE
from jaxmuscle.model._noise import AbstractNoise, ResonantNoise, ShapingFilter
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._bin_law import bin_rows
from jaxmuscle.spectra._settings import LONGEST, WINDOW, SpectrumSettings, samples_in
from jaxmuscle.spectra._welch import Spectrum

from ._harmonic_line import harmonic_line
from ._linearised import Linearisation, linearise

TAIL = 1e-13


class Moments(NamedTuple):
    """What a fit compares: Welch power per bin, that of the harmonic alone, mean and variance of a recording.

    The variance is that of the low-passed output, as a recording's: what lies above the low-pass is not in it. `rate` is
    the slowest of the operating point [1/s], `half` the frequency of half power of the slow part [Hz], where they were
    computed. `resonant`: Welch power per bin of every resonance alone.
    """

    power: Float[Array | np.ndarray, " bins"]
    line: Float[Array | np.ndarray, " bins"]
    mean: Float[Array | np.ndarray, ""]
    variance: Float[Array | np.ndarray, ""]
    rate: Float[Array | np.ndarray, ""] | float = np.nan
    half: Float[Array | np.ndarray, ""] | float = np.nan
    resonant: tuple[Float[Array | np.ndarray, " bins"], ...] = ()

    @property
    def proportional(self) -> Float[Array | np.ndarray, " bins"]:
        """Proportional power on the compared bins."""
        return self.power / self.power.sum()

    @property
    def variation(self) -> Scalar:
        """Coefficient of variation; infinite about a mean of zero."""
        with np.errstate(divide="ignore"):
            return self.variance**0.5 / abs(self.mean)


def _sylvester(A: Array, F: Array, Q: Array) -> Array:
    """X with `A X + X Fᵀ + Q = 0`; a leading axis of Q is a batch with the same matrices."""
    n, m = A.shape[0], F.shape[0]
    both = jnp.kron(A, jnp.eye(m, dtype=A.dtype)) + jnp.kron(jnp.eye(n, dtype=A.dtype), F)
    right = -Q.reshape(-1, n * m).T
    return jnp.linalg.solve(both, right).T.reshape(Q.shape)


class _Covariances(NamedTuple):
    """A linear system without input whose outputs sum to the autocovariance, `r(s) = Σ row exp(matrix s) start`."""

    matrix: Float[Array, "all all"]
    rows: Float[Array, "channels all"]
    start: Float[Array, "channels all"]


class _Chain:
    """Linear systems one behind the other, `x' = M x + Γ w`, and the stationary covariance P of their states, built up."""

    def __init__(self, F: Array, G: Array):
        self.matrix, self.white = F, G
        self.covariance = _sylvester(F, F, G @ G.T) if len(F) else F

    def add(self, A: Array, inflow: Array, white: Array) -> slice:
        """Another system `y' = A y + inflow x + white w`; where its states are. Its covariances follow one by one."""
        before, n = len(self.matrix), len(A)
        cross = jnp.zeros((n, 0), A.dtype)
        if before:
            cross = _sylvester(A, self.matrix, inflow @ self.covariance + white @ self.white.T)
        fed = inflow @ cross.T
        inner = _sylvester(A, A, fed + fed.T + white @ white.T)
        self.matrix = jnp.block([[self.matrix, jnp.zeros((before, n), A.dtype)], [inflow, A]]) if before else A
        self.covariance = jnp.block([[self.covariance, cross.T], [cross, inner]]) if before else inner
        self.white = jnp.concatenate([self.white, white])
        return slice(before, before + n)

    def unit(self, i: int) -> Array:
        """The row that reads one state."""
        return jnp.eye(len(self.matrix), dtype=self.matrix.dtype)[i]


def _covariances(task: AbstractTask, system: Linearisation) -> list[list[_Covariances]]:
    """The stationary response to the noise: of each of its components a sum of independent parts.

    The response `C (s - A)⁻¹ b + d + s e` to a scalar noise that acts on several inputs with b, d, e each: its states are
    those of the transposed system, `p' = Aᵀ p + Cᵀ N`, of which every input reads `b p + d N + e N'`. So all inputs that
    get a noise of the same colour have one small system, whatever their number.
    """
    found = []
    system = _balanced(system)
    for noise in task.noise.components:
        groups = [noise.acts_on]
        if task.activation is not None and not noise.shared:
            groups = [[i for i in noise.acts_on if (i in ACTIVE) == active] for active in (True, False)]
        found.append([_of_inputs(task, system, noise, tuple(inputs)) for inputs in groups if inputs])
    return found


def _balanced(system: Linearisation) -> Linearisation:
    """The system in units of its states in which rows and columns of A are of one size: single precision needs it."""
    A = jax.lax.stop_gradient(jnp.abs(system.A)) * (1 - jnp.eye(len(system.A), dtype=system.A.dtype))
    scale = jnp.ones(len(A), A.dtype)
    for _ in range(2):
        for i in range(len(A)):
            row, column = jnp.sum(A[i] * scale) / scale[i], jnp.sum(A[:, i] / scale) * scale[i]
            fits = (row > 0) & (column > 0)
            ratio = jnp.where(fits, row, 1.0) / jnp.where(fits, column, 1.0)
            scale = scale.at[i].multiply(jnp.sqrt(ratio))
    size = jax.lax.stop_gradient(jnp.linalg.norm(system.C * scale))
    size = jnp.where(size > 0, size, 1.0)
    A = system.A * scale / scale[:, None]
    return system._replace(A=A, B=size * system.B / scale[:, None], C=system.C * scale / size)


def _of_inputs(task: AbstractTask, system: Linearisation, noise: AbstractNoise, inputs: tuple[int, ...]) -> _Covariances:
    """The response to one component of the noise through some of its inputs."""
    scale = task.noise_scale(noise)[np.array([noise.acts_on.index(i) for i in inputs])]
    b, d, e = (x[..., np.array(inputs)] * scale for x in (system.B, system.D, system.E))
    made: ShapingFilter = jax.tree.map(lambda x: x.astype(b.dtype), noise.shaping_filter())
    F, G, H, L = made.F, made.G, made.H, made.L
    chain, A, C = _Chain(F, G), system.A, system.C
    # What a group of inputs gets: a row of the states and one of the white noise, its slope, and where its response is.
    plain = H, L, H @ F if len(F) else H
    kinds: dict[bool, Any] = {}
    active = [task.activation is not None and i in ACTIVE for i in inputs]
    if task.activation is not None and any(active):
        own, into = task.activation.states()
        own, into = own.astype(b.dtype), into.astype(b.dtype)
        at = chain.add(own, jnp.outer(into, H), jnp.outer(into, L))
        value = chain.unit(at.start)
        kinds[True] = value, jnp.zeros_like(L), value @ chain.matrix
    if not all(active):
        kinds[False] = tuple(jnp.pad(x, (0, len(chain.matrix) - len(x))) if i != 1 else x for i, x in enumerate(plain))
    rows: dict[int, Array] = {}
    for kind, (value, white, slope) in kinds.items():
        width = len(chain.matrix)
        value, slope = (jnp.pad(x, (0, width - len(x))) for x in (value, slope))
        at = chain.add(A.T, jnp.outer(C, value), jnp.outer(C, white))
        for j in (j for j, is_active in enumerate(active) if is_active == kind):
            seen = d[j] * value + e[j] * slope
            rows[j] = jnp.concatenate([seen, b[:, j]])
            assert at.stop == len(rows[j])
    whole = len(chain.matrix)
    stacked = jnp.stack([jnp.pad(rows[j], (0, whole - len(rows[j]))) for j in range(len(inputs))])
    stacked = jnp.sum(stacked, axis=0, keepdims=True) if noise.shared else stacked
    return _Covariances(chain.matrix, stacked, stacked @ chain.covariance)


class _Autocovariance(NamedTuple):
    """r of the sampled output: r(0), and `r(lΔ) = Σ row powers[0]^(l-1) next` beyond; powers[k] = powers[0]^(2^k)."""

    zero: Float[Array, ""]
    rows: Float[Array, "channels all"]
    powers: Float[Array, "doublings all all"]
    next: Float[Array, "channels all"]

    def lagged(self, lags: int) -> Float[Array, " lags"]:
        """r at lags 0, Δ, 2Δ ...: from few steps to the right and few long ones to the left, which meet in one product."""
        short = (lags.bit_length() + 1) // 2
        columns, rows = self.next[:, :, None], self.rows[:, None]
        for power in self.powers[:short]:
            columns = jnp.concatenate([columns, power @ columns], axis=2)
        for power in self.powers[short:]:
            if rows.shape[1] * columns.shape[2] >= lags - 1:
                break
            rows = jnp.concatenate([rows, rows @ power], axis=1)
        return jnp.concatenate([self.zero[None], jnp.sum(rows @ columns, axis=0).reshape(-1)])[:lags]

    def mean_variance(self, samples: Int[Array | np.ndarray, ""] | int) -> Float[Array, ""]:
        """Variance of the mean of that many successive samples, `Σ_l 2 (n - l) / n² r(lΔ) + r(0) / n`, l = 1 ... n - 1.

        Sums of `Φ^m v` and of `m Φ^m v` double their length from power to power; a block counts if its bit of n - 1 is set.
        """
        n, count, zero = jnp.asarray(samples, self.next.dtype), jnp.asarray(samples) - 1, jnp.zeros_like(self.next)

        def double(sums: Array, block: tuple[Array, Array]) -> tuple[Array, None]:
            power, bit = block
            sum_all, rise_all, sum_here, rise_here = sums
            length = (2**bit).astype(n.dtype)
            moved = jnp.stack([rise_all + length * sum_all, sum_all, rise_here + length * sum_here, sum_here]) @ power.T
            counts = (count >> bit) % 2 == 1  # this block, then what is there already
            both = jnp.stack([sum_here + moved[1], rise_here + moved[0]])
            return jnp.concatenate([jnp.where(counts, both, sums[:2]), sums[2:] + moved[:1:-1]]), None

        bits = jnp.arange(len(self.powers), dtype=count.dtype)
        sums, _ = jax.lax.scan(double, jnp.stack([zero, zero, self.next, zero]), (self.powers, bits))
        return self.zero / n + 2 / n**2 * jnp.sum(self.rows * ((n - 1) * sums[0] - sums[1]))


def _autocovariance(system: _Covariances, interval: float, lags: int, sampling: str) -> _Autocovariance:
    """Autocovariance of the sampled output, good for that many lags; not finite where it does not decay."""
    matrix, rows, start = system
    if sampling == "average":
        # Means over the interval: r(0) = 2/Δ² c ∫(Δ-s) e^(Ms) ds v and r(lΔ) = c J Φ^(l-1) J v / Δ², J = ∫ e^(Ms) ds.
        n = len(matrix)
        zero, eye = jnp.zeros_like(matrix), jnp.eye(n, dtype=matrix.dtype)
        blocks = jnp.block([[matrix * interval, eye, zero], [zero, zero, eye], [zero, zero, zero]])
        whole = jax.scipy.linalg.expm(blocks)
        step, mean, ramp = whole[:n, :n], whole[:n, n : 2 * n], whole[:n, 2 * n :]
        first, rows, following = 2 * jnp.sum(rows @ ramp * start), rows @ mean, start @ mean.T
    else:
        step = jax.scipy.linalg.expm(matrix * interval)
        first, following = jnp.sum(rows * start), start @ step.T
    count = (lags - 1).bit_length() + 1
    _, powers = jax.lax.scan(lambda power, _: (power @ power, power), step, length=count)
    # The last power carries an unstable system beyond any bound: no stationary covariance, so none is returned.
    stable = jnp.max(jnp.abs(powers[-1])) < 1e3
    return _Autocovariance(jnp.where(stable, first, jnp.nan), rows, powers, jnp.where(stable, following, jnp.nan))


def _autocovariances(
    task: AbstractTask, system: Linearisation, settings: SpectrumSettings, lags: int
) -> tuple[_Autocovariance, list[int]]:
    """Of every independent part of the noise, along a leading axis; which component of the noise each belongs to.

    All are filled up to one size, so that whatever follows is traced and compiled once, however many there are.
    """
    parts = [(own, i) for i, each in enumerate(_covariances(task, system)) for own in each]
    size = max(len(own.matrix) for own, _ in parts)
    count = max(len(own.rows) for own, _ in parts)

    def filled(own: _Covariances) -> _Covariances:
        more, less = size - len(own.matrix), count - len(own.rows)
        decaying = -settings.rate * jnp.eye(more, dtype=own.matrix.dtype)  # states that nothing drives or reads
        rows, start = (jnp.pad(x, ((0, less), (0, more))) for x in (own.rows, own.start))
        return _Covariances(jax.scipy.linalg.block_diag(own.matrix, decaying), rows, start)

    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(filled(own) for own, _ in parts))
    found = jax.vmap(lambda own: _autocovariance(own, 1 / settings.rate, lags, settings.sampling))(stacked)
    return found, [i for _, i in parts]


@functools.cache
def low_pass_spread(settings: SpectrumSettings) -> Float[np.ndarray, " lags"]:
    """ρ, the autocorrelation of the low-pass's impulse response at lags -m ... m: it turns r into `r * ρ`."""
    if settings.sections is None:
        return np.ones(1)
    impulse = scipy.signal.sosfilt(settings.sections, np.eye(1, 64 * settings.length)[0])
    spread = scipy.signal.correlate(impulse, impulse, method="fft")
    if settings.filter_direction == "both":
        spread = scipy.signal.correlate(spread, spread, method="fft")
    centre = len(spread) // 2
    reach = int(np.max(np.flatnonzero(np.abs(spread) > TAIL * np.abs(spread).max())) - centre)
    return spread[centre - reach : centre + reach + 1]


@functools.cache
def covariance_operator(settings: SpectrumSettings) -> Float[np.ndarray, "bins_and_two lags"]:
    """M with expected Welch power `E_k = Σ_l M_kl r(l Δ)`: low-pass, detrending, taper and transform.

    The low-pass turns r into `r * ρ` (`low_pass_spread`); a bin is `Σ_l α_k(l) r(l)`, α_k the sum of the autocorrelations of
    its `bin_rows`. Both are folded onto lags l >= 0. Two more rows: the variance of what has passed, (r * ρ)(0); and
    `Σ_l ((|·| * ρ)(l) - |l|) r(l)`, by which the low-pass lowers n² times the variance of the mean of n samples
    (`Σ_l (n - |l|) / n² r(l)` without it; where r has decayed at the n-th lag).
    """
    rows, spread = bin_rows(settings), low_pass_spread(settings)
    lagged = np.array([sum(scipy.signal.correlate(row, row, method="fft").real for row in each) for each in rows])
    lagged = np.concatenate([lagged, np.eye(1, lagged.shape[1], lagged.shape[1] // 2)])
    full = np.array([scipy.signal.convolve(row, spread, method="fft") for row in lagged])
    centre, reach = full.shape[1] // 2, len(spread) // 2
    lag = np.arange(-2 * reach, 2 * reach + 1)
    lowered = np.convolve(np.abs(lag), spread, mode="valid") - np.abs(lag[reach : lag.size - reach])
    full = np.concatenate([full, np.pad(lowered, centre - reach)[None]])
    folded = full[:, centre:].copy()
    folded[:, 1:] += full[:, centre - 1 :: -1]
    return folded


def noise_response(
    task: AbstractTask, system: Linearisation, settings: SpectrumSettings, samples: Int[Array | np.ndarray, ""] | int
) -> tuple[Float[Array, "components bins"], Float[Array, ""]]:
    """Expected Welch power of each component of the noise, and variance of so many low-passed samples about their mean."""
    operator = covariance_operator(settings)
    lags = operator.shape[1]
    each, of = _autocovariances(task, system, settings, max(lags, LONGEST))
    belongs = np.equal.outer(np.arange(len(task.noise.components)), of).astype(system.A.dtype)
    r = belongs @ jax.vmap(lambda own: own.lagged(lags))(each)
    found = jnp.stack([jnp.asarray(operator, system.A.dtype) @ own for own in r])
    slow = jnp.sum(jax.vmap(lambda own: own.mean_variance(samples))(each))
    whole = jnp.sum(found, axis=0)
    return found[:, :-2], whole[-2] - slow + whole[-1] / jnp.asarray(samples, found.dtype) ** 2


def noise_variance(task: AbstractTask, system: Linearisation) -> Float[Array, ""]:
    """Stationary variance of the output without the harmonic, at an instant, before any low-pass."""
    each = [own for component in _covariances(task, system) for own in component]
    return sum((jnp.sum(own.rows * own.start) for own in each), jnp.zeros((), system.A.dtype))


def response(
    task: AbstractTask,
    settings: SpectrumSettings,
    window: tuple[float, float],
    samples: Int[Array | np.ndarray, ""] | int | None = None,
) -> tuple[Moments, Linearisation]:
    """Expected moments of the linearised task in the window, and the linearisation. Not finite where it is unstable.

    The variance is that of so many samples from the window's begin on, by default as many as it has.
    """
    samples = samples_in(window, settings) if samples is None else samples
    system = linearise(task)
    noise, variance = noise_response(task, system, settings, samples)
    line, swing = harmonic_line(task, system, settings, window, samples)
    unknown = jnp.full((), jnp.nan, line.dtype)  # the slowest rate has no second derivative
    resonant = tuple(own for own, part in zip(noise, task.noise.components, strict=True) if isinstance(part, ResonantNoise))
    power = jnp.sum(noise, axis=0) + line
    return Moments(power, line, system.rest, variance + swing, unknown, unknown, resonant), system


_compiled_response = kept(response)


def expected_moments(
    task: AbstractTask,
    settings: SpectrumSettings,
    window: tuple[float, float],
    samples: Int[Array | np.ndarray, ""] | int | None = None,
) -> tuple[Moments, Linearisation]:
    """`response`, compiled once for all numbers of samples."""
    samples = samples_in(window, settings) if samples is None else samples
    return _compiled_response(as_arrays(task), settings, window, as_arrays(samples, int))


@kept
def log_variation_sd(task: AbstractTask, settings: SpectrumSettings, samples: int) -> Float[Array, ""]:
    """Standard deviation of the log of the coefficient of variation of so many successive samples, in linear response.

    For low-passed Gaussian noise of autocovariance r and a line of mean square h at the frequency f, s² that of both,

        Var s² = 2/n Σ_l (1 - |l|/n) r̃(lΔ)² + 4h/n Σ_l (1 - |l|/n) r̃(lΔ) cos(2πf lΔ),    r̃ = r - Var(mean),

    and sd(ln CV) = √(Var s²) / (2 s²). How the mean scatters is left out: it counts as CV² beside this.
    """
    system = linearise(task)
    spread = jnp.asarray(low_pass_spread(settings), system.A.dtype)
    reach = len(spread) // 2
    each, _ = _autocovariances(task, system, settings, samples + reach)
    r = jnp.sum(jax.vmap(lambda own: own.lagged(samples + reach))(each), axis=0)
    slow = jnp.sum(jax.vmap(lambda own: own.mean_variance(samples))(each))
    r = jnp.convolve(jnp.concatenate([r[reach:0:-1], r]), spread, mode="valid") - slow
    _, swing = harmonic_line(task, system, settings, WINDOW, samples)
    lag = jnp.arange(samples, dtype=r.dtype)
    weight = jnp.where(lag > 0, 2.0, 1.0) * (1 - lag / samples) / samples
    turning = jnp.cos(2 * np.pi * task.harmonic.frequency * lag / settings.rate)
    variance = jnp.sum(weight * (2 * r**2 + 4 * swing * r * turning))
    return 0.5 * jnp.sqrt(variance) / (r[0] + swing)


def linear_spectrum(task: AbstractTask, settings: SpectrumSettings, window: tuple[float, float] = WINDOW) -> Spectrum:
    """The expected Welch spectrum in linear response, of tasks that have one; not finite where they have not."""
    moments, _ = expected_moments(task, settings, window)
    frequency = jnp.asarray(settings.frequency, moments.power.dtype)
    return Spectrum(frequency, moments.power, settings, task.output_unit)


def check_power(task: AbstractTask, moments: Moments) -> None:
    """Refuse a spectrum that is zero but for rounding: fluctuations below the last digits of the mean."""
    power, mean = np.asarray(moments.power), float(moments.mean)
    least = (1e3 * np.finfo(power.dtype).eps * mean) ** 2
    if not np.sum(power) * task.settings.resolution > least:
        raise ValueError(f"the expected spectrum of this {type(task).__name__} is zero: it has neither noise nor a "
                         f"harmonic that moves {task.output_name}; set noise_K_w, say")  # fmt: skip


def check_line(task: AbstractTask, settings: SpectrumSettings) -> None:
    """Refuse a harmonic that sampling would fold to another frequency."""
    frequency = float(task.harmonic.frequency)
    if frequency >= settings.rate / 2 and float(task.harmonic.amplitude) > 0:
        raise ValueError(f"harmonic_frequency = {frequency} Hz is not below half the sampling rate of {settings.rate} Hz: "
                         "raise rate, or set harmonic_amplitude = 0")  # fmt: skip
