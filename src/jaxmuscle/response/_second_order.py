"""Where first order ends: the power that the next order adds to the linear response, and
coefficients that turn negative."""

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.special import ndtr

from jaxmuscle._common.arrays import as_doubles
from jaxmuscle._common.environment import one_thread
from jaxmuscle._common.errors import FirstOrderWarning
from jaxmuscle._common.programs import kept
from jaxmuscle.model._activation import ACTIVE
from jaxmuscle.model._noise import ShapingFilter
from jaxmuscle.model._parameters import CHANNELS, INPUTS
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.model._white_noise import BandLimitedNoise, WhiteNoise
from jaxmuscle.spectra._settings import WINDOW, SpectrumSettings

from ._equilibrium import HOLD, mechanics, without_settings
from ._expected import Moments, covariance_operator, expected_powers, lags_of
from ._expected_moments import expected_moments
from ._harmonic_line import LONG
from ._linear_task import Linearisation
from ._linearised import linearisation

NOTICED = 0.1
NEGATIVE = 0.01
LINE_WIDTH = 0.3  # Hz; a line is a resonance narrower than a bin here
SAMPLES = 1024
FAINT = 1e-3


class SecondOrder(NamedTuple):
    """What the second order adds: `power`, to every bin over that of the linear response; `mean`,
    over the mean.

    A bin of the linear response counts for a thousandth of their mean at least, the mean for the
    standard deviation.
    """

    power: Float[np.ndarray, " bins"]
    mean: float

    @property
    def notices(self) -> tuple[str, ...]:
        """What has to be said before linear numbers are stated."""
        most = float(np.max(self.power))
        what = [f"adds about {100 * most:.2g} % to the power of a bin"] * (most > NOTICED)
        what += [f"changes the mean by about {100 * abs(self.mean):.2g} %"] * (
            abs(self.mean) > NOTICED
        )
        if not what:
            return ()
        return (
            (
                "the formula (linear response) is not exact here: what it leaves out"
                f" {' and '.join(what)}. Simulate (jaxmuscle ensemble), or fit by simulation"
                " (--method montecarlo, method='montecarlo')"
            ),
        )


@kept
def _hessians(task: AbstractTask, system: Linearisation) -> Float[Array, "outputs inputs inputs"]:
    """Second derivatives of the vector field, then of the output, with respect to (y, u, u') at the
    operating point."""
    n, t = len(system.point), jnp.asarray(HOLD, system.point.dtype)

    def both(given):
        y, u, du = given[:n], given[n : n + len(INPUTS)], given[n + len(INPUTS) :]
        return jnp.append(task.vector_field(t, y, u), task.output(t, y, u, du))

    return jax.hessian(both)(
        jnp.concatenate([system.point, jnp.zeros(2 * len(INPUTS), system.point.dtype)])
    )


class _Source(NamedTuple):
    """One scalar noise: its filter, what it adds to each of the inputs; the harmonic is a narrow
    resonance of its power."""

    filter: ShapingFilter
    weight: Any


class _Parts(NamedTuple):
    """The independent noises, the harmonic, matrix and input of the activation's states, base
    coefficients, the swing."""

    noises: tuple[_Source, ...]
    harmonic: _Source
    activation: Any
    base: Any
    swing: Any


@kept
def _parts(task: AbstractTask) -> _Parts:
    noises = []
    for noise in task.noise.components:
        scale, unit = task.noise_scale(noise), jnp.eye(len(INPUTS))[np.array(noise.acts_on)]
        if isinstance(noise, WhiteNoise):  # has no value: as its samples at `rate` have
            noise = BandLimitedNoise(
                noise.amplitude, rate=noise.rate, cutoff=noise.rate / 2, shared=noise.shared
            )
        rows = scale[:, None] * unit
        rows = jnp.sum(rows, axis=0, keepdims=True) if noise.shared else rows
        noises += [_Source(noise.shaping_filter(), row) for row in rows]
    harmonic = task.harmonic
    swing = harmonic.amplitude * harmonic.envelope(jnp.asarray(HOLD))
    omega, damping = 2 * jnp.pi * harmonic.frequency, 2 * np.pi * LINE_WIDTH
    F = jnp.stack([jnp.stack([0 * omega, omega]), jnp.stack([-omega, -damping + 0 * omega])])
    G = jnp.sqrt(damping) * jnp.abs(swing) * jnp.array([[0.0], [1.0]])
    line = _Source(ShapingFilter(F, G, jnp.array([1.0, 0.0]), jnp.zeros(1)), task.harmonic_base())
    states = None if task.activation is None else task.activation.states()
    return _Parts(tuple(noises), line, states, task.muscle.base(), swing)


def _inputs_of(
    parts: _Parts, sources: tuple[_Source, ...], states: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Noises as states beside `states` others: their matrix, density of what drives them, and (y,
    u, u') of all states.

    What the active tissue gets has passed the activation, if there is one: two more states for each
    noise that acts there.
    """
    k, active = len(INPUTS), np.isin(np.arange(len(INPUTS)), ACTIVE)
    blocks = []
    for source in sources:
        through = parts.activation is not None and bool(np.any(source.weight[active] != 0))
        blocks.append((source, through, len(source.filter.F) + 2 * through))
    total = states + sum(size for *_, size in blocks)
    matrix, white, inputs = (
        np.zeros((total, total)),
        np.zeros((total, total)),
        np.zeros((states + 2 * k, total)),
    )
    inputs[:states, :states] = np.eye(states)
    start = states
    for (made, weight), through, size in blocks:
        F, G, H, L = made.F, made.G, made.H, made.L
        n = len(F)
        own, later = slice(start, start + n), slice(start + n, start + size)
        matrix[own, own] = F
        gain = np.concatenate([G, np.zeros((size - n, G.shape[1]))])
        now = ~active if through else np.ones(k, bool)
        inputs[states : states + k, own] = np.outer(now * weight, H)
        inputs[states + k :, own] = np.outer(now * weight, H @ F)
        if through and parts.activation is not None:
            step, into = parts.activation
            matrix[later, later], matrix[later, own] = step, np.outer(into, H)
            gain[n:] = np.outer(into, L)
            inputs[states : states + k, later] = np.outer(active * weight, [1.0, 0.0])
            inputs[states + k :, later] = np.outer(active * weight, step[0])
        whole = slice(start, start + size)
        white[whole, whole] = gain @ gain.T
        start += size
    return matrix, white, inputs


class _Looked(NamedTuple):
    """A task in double precision, without its settings, and its noises as numbers."""

    task: AbstractTask
    parts: _Parts

    @classmethod
    def at(cls, task: AbstractTask) -> "_Looked":
        arrays = as_doubles(task)
        with jax.enable_x64(True):
            bare = without_settings(arrays)
            return cls(bare, jax.tree.map(np.asarray, _parts(bare)))


def negative_coefficients(task: AbstractTask) -> tuple[str, ...]:
    """Sentences about coefficients that noise and harmonic make negative for more than 1 % of the
    time."""
    with one_thread:
        return _negative(_Looked.at(task).parts)


def _negative(parts: _Parts) -> tuple[str, ...]:
    matrix, white, inputs = _inputs_of(parts, parts.noises, 0)
    rows = inputs[: len(CHANNELS)]
    covariance = solve_continuous_lyapunov(matrix, -white)
    sd = np.sqrt(np.maximum(np.einsum("ci,ij,cj->c", rows, covariance, rows), 0.0))
    turn = np.sin(2 * np.pi * (np.arange(64) + 0.5) / 64)
    level = parts.base[:, None] + parts.swing * parts.harmonic.weight[: len(CHANNELS), None] * turn
    share = np.mean(
        ndtr(level / -np.maximum(sd, 1e-12 * np.abs(parts.base) + 1e-300)[:, None]), axis=1
    )
    return tuple(
        f"{channel} is negative for {100 * part:.2g} % of the time, which is impossible: its noise"
        " or the harmonic is too strong. Lower one of them (in a fit, for example, --fix"
        f" noise_{channel}=VALUE)"
        for channel, part, base in zip(CHANNELS, share, parts.base, strict=True)
        if part > NEGATIVE and base > 0
    )


def second_order(
    task: AbstractTask, settings: SpectrumSettings | None = None, moments: Moments | None = None
) -> SecondOrder:
    """The power and the mean that the second order adds to the linear response of a task.

    With y₁ the linear response and u the perturbation, x = (y₁, u) Gaussian, M_a the Hessians of
    vector field and output,

        y₂' = A y₂ + ½ xᵀ M x,    z₂ = C y₂ + ½ xᵀ M₀ x
        Cov(xᵀM_a x(τ), xᵀM_b x(0)) = 2 tr(M_a R(τ) M_b R(τ)ᵀ)

    by Isserlis' theorem, R the autocovariance of x. The cross term of first and third order, of the
    same size, is left out, and the harmonic counts as a narrow resonance, which doubles its
    overtone: an indicator, good to a factor of two or so (docs/model.md has it beside simulations).
    White noise counts as its samples do.

    **Arguments:** `task`; `settings` (the task's own by default); `moments` in linear response with
    these settings, where they are known already: no other program is needed then.

    **Returns:** a `SecondOrder`. **Raises:** as `expected_spectrum` does.
    """
    with one_thread:
        return _second_order(
            _Looked.at(task), task.settings if settings is None else settings, moments
        )


def _second_order(
    looked: _Looked, settings: SpectrumSettings, moments: Moments | None
) -> SecondOrder:
    task, parts = looked
    with jax.enable_x64(True):
        system = linearisation(task)
        moments = expected_moments(task, settings, WINDOW)[0] if moments is None else moments
        hessians, system = jax.tree.map(np.asarray, (_hessians(mechanics(task), system), system))
    n = len(system.A)
    matrix, white, inputs = _inputs_of(parts, (*parts.noises, parts.harmonic), n)
    matrix[:n, :n] = system.A
    matrix[:n] += system.B @ inputs[n : n + len(INPUTS)]
    covariance = solve_continuous_lyapunov(matrix, -white)
    power, mean = _added(0.5 * inputs.T @ hessians @ inputs, matrix, covariance, system, settings)
    first, scale = (
        np.asarray(moments.power),
        max(abs(float(system.rest)), float(moments.variance) ** 0.5),
    )
    least = FAINT * np.mean(first)
    relative = (
        np.maximum(power, 0.0) / np.maximum(first, least) if least > 0 else np.zeros(len(first))
    )
    return SecondOrder(relative, mean / scale if scale > 0 else 0.0)


@kept
def _operator(settings: SpectrumSettings) -> Float[Array, "bins lags"]:
    """What turns an autocovariance into Welch powers; kept, since to make it takes scipy.signal,
    half a second to import."""
    return jnp.asarray(covariance_operator(settings)[:-2])


_powers = kept(expected_powers)


def _added(
    forms: np.ndarray,
    matrix: np.ndarray,
    stationary: np.ndarray,
    system: Any,
    settings: SpectrumSettings,
) -> tuple[np.ndarray, float]:
    """Welch power and mean of z₂."""
    with jax.enable_x64(True):
        operator = None if settings.length > LONG else np.asarray(_operator(settings))
    lags = lags_of(settings) if operator is None else operator.shape[1]
    count, interval = max(SAMPLES, 1 << int(np.ceil(np.log2(2 * lags)))), 1 / settings.rate
    step = expm(matrix * interval)
    each = np.empty((count // 2, *matrix.shape))
    each[0] = stationary
    for i in range(1, len(each)):
        each[i] = step @ each[i - 1]
    kinds, size = len(forms), len(matrix)
    # M_a R
    left = np.tensordot(forms, each, (2, 1)).transpose(2, 0, 1, 3).reshape(-1, kinds, size**2)
    # R M_b
    right = np.tensordot(each, forms, (2, 1)).transpose(0, 1, 3, 2).reshape(-1, size**2, kinds)
    covariance = 2 * left @ right
    half = interval * np.fft.rfft(covariance, count, axis=0)
    density = half + np.conj(np.swapaxes(half, 1, 2)) - interval * covariance[0]
    omega = 2 * np.pi * np.fft.rfftfreq(count, interval)
    n = len(system.A)
    row = np.linalg.solve(
        (1j * omega[:, None, None] * np.eye(n) - system.A).swapaxes(1, 2), system.C[:, None]
    )[..., 0]
    row = np.concatenate([row, np.ones((len(row), 1))], axis=1)
    seen = (row[:, None] @ density @ row.conj()[..., None])[:, 0, 0].real
    autocovariance = np.fft.irfft(seen, count)[:lags] / interval
    forced = np.einsum("aij,ij->a", forms, stationary)
    mean = float(forced[-1] - system.C @ np.linalg.solve(system.A, forced[:-1]))
    if operator is not None:
        return operator @ autocovariance, mean
    with jax.enable_x64(True):
        return np.asarray(_powers(settings, autocovariance))[:-2], mean


def warn_beyond(
    task: AbstractTask, settings: SpectrumSettings | None = None, moments: Moments | None = None
) -> None:
    """Warn (`FirstOrderWarning`) where the linear numbers of a task are not the model's; arguments
    of `second_order`."""
    with one_thread:
        looked = _Looked.at(task)
        found = _second_order(looked, task.settings if settings is None else settings, moments)
        notices = (*found.notices, *_negative(looked.parts))
    for notice in notices:
        warnings.warn(f"{type(task).__name__}: {notice}", FirstOrderWarning, stacklevel=3)
