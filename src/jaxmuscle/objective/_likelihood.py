"""The likelihood of a Welch spectrum: chi-squared bins with their bias and correlation, and spectra
drawn from it."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import i0e
from jaxtyping import Array, Float
from scipy.special import gammaincinv, ndtr

from jaxmuscle._common.arrays import all_concrete, as_arrays
from jaxmuscle._common.programs import kept
from jaxmuscle._common.types import Scalar
from jaxmuscle.data._recording import Recording
from jaxmuscle.data._target import Target
from jaxmuscle.data._target_data import TargetData, precision_of
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.response._expected import Moments, check_line
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.response._input_response import parts_of_stiffness
from jaxmuscle.response._linearised import check_inputs
from jaxmuscle.response._second_order import warn_beyond
from jaxmuscle.spectra._bin_law import (
    LEAST,
    bin_statistics,
    recorded_interval,
    target_law,
)
from jaxmuscle.spectra._settings import WINDOW

from ._consequences import Expansion, expand
from ._problem import FitProblem, variation_under
from ._residuals import Residuals, data_residuals, further_residuals


def repeated(problem: FitProblem, tasks: Sequence[AbstractTask], count: int) -> tuple[Moments, ...]:
    """Moments of every part's task in linear response, in `count` rows; for `drawn_spectra`."""
    seen = expand(problem.linear(), problem.theta_of(tasks)[None])
    return jax.tree.map(lambda x: np.repeat(np.asarray(x), count, axis=0), seen.moments)


Powers = Float[Array | np.ndarray, " bins"]
ManyPowers = Float[Array | np.ndarray, "bins *many"]
Many = Float[Array, "*many"]
NEWTON = 12
HALF_LOG_2_PI = 0.5 * math.log(2 * math.pi)
NODES = 33
REACH = 6.0


class Bins(NamedTuple):
    """Measured log proportional powers with their law; `mask` is 0 for bins that are left out."""

    log_power: Float[Array | np.ndarray, "*rows bins"]
    half: Float[Array | np.ndarray, "*rows bins"]
    precision: Float[Array | np.ndarray, "*rows bins bins"]
    logdet: Float[Array | np.ndarray, "*rows"]
    mask: Float[Array | np.ndarray, "*rows bins"]


def require_spread(target: Target) -> None:
    """Raises `ValueError` for a target that states neither segments nor sigma."""
    if target.segments is None and target.sigma is None and len(target.bins):
        raise ValueError(
            f"{target.name}: states neither segments nor sigma, so how much its bins scatter is not"
            " known: give segments, the number of Welch segments that were averaged (--segments),"
            " or a sigma per bin"
        )


def measured_bins(target: Target, mask: np.ndarray | None = None) -> Bins:
    """A target's bins with their law, those with `mask` 0 left out. Raises `ValueError` for one
    that states no segments."""
    if target.segments is None:
        raise ValueError(
            f"{target.name}: does not state its segments, so how its bins scatter is not known;"
            " give segments"
        )
    law = target_law(target)
    kept = np.ones(len(target.bins)) if mask is None else np.asarray(mask, dtype=float)
    return Bins(
        np.log(target.proportional_power),
        law.degrees / 2,
        *precision_of(law.correlation, kept),
        kept,
    )


def log_density(bins: Bins, power: ManyPowers, line: ManyPowers, offset: Scalar) -> Many:
    """Log density of proportional powers p and of the log of their total, `offset` above the
    model's.

    `x_k = e^u (p_k / Σp) / (E_k / ΣE)` are gamma variables of shape ν_k/2 and mean 1, ν_k raised by
    1 / (1 - ρ_k²) where a line holds the share ρ_k of the bin. They are joined by a Gaussian
    copula: their normal scores (Wilson & Hilferty 1931, `z = 3 √a (x^⅓ - 1 + 1/(9a))`, a = ν/2)
    have the correlation matrix R of the bins. With a flat density of u the total, which
    proportional powers do not show, is integrated out by integrating over u. For many models at
    once their axes come last, so that sums over bins are sums of vectors.
    """
    return _log_density(power, line, offset, jax.lax.stop_gradient(bins))


@jax.custom_jvp
def _log_density(power: ManyPowers, line: ManyPowers, offset: Scalar, bins: Bins) -> Many:
    return _with_slopes(power, line, offset, bins)[0]


@_log_density.defjvp
def _slope(primals, tangents):
    value, slopes = _with_slopes(*primals)
    (by_power, by_line, by_offset), (power, line, offset) = slopes, tangents[:3]
    return value, jnp.sum(by_power * power + by_line * line, axis=0) + by_offset * offset


def _with_slopes(
    power: ManyPowers, line: ManyPowers, offset: Scalar, bins: Bins
) -> tuple[Many, tuple[Array, Array, Array]]:
    """`log_density` and its slopes, by hand: a posterior's time goes there, and what JAX makes of
    it takes twice as long."""
    log_power, half, mask = (
        jnp.reshape(x, (-1,) + (1,) * (power.ndim - 1))
        for x in (bins.log_power, bins.half, bins.mask)
    )
    share = jnp.clip(line / power, 0.0, 1.0)
    scatters = 1 - share**2
    a = half / jnp.maximum(scatters, LEAST)
    total, whole = jax.nn.logsumexp(bins.log_power), jnp.sum(power, axis=0)
    log_x = (offset + jnp.log(whole) - total) + (log_power - jnp.log(power))
    root, width = jnp.exp(log_x / 3), jnp.sqrt(a)
    x, off = root**3, 1 / (9 * a)
    level, rise = _gamma_level(a)
    marginal = level + a * (log_x - x) - log_power
    z = mask * 3 * width * (root - 1 + off)
    turned = jnp.tensordot(bins.precision, z, 1)
    value = jnp.sum(mask * marginal - 0.5 * z * (turned - z), axis=0) - 0.5 * bins.logdet
    pull = mask * (z - turned)
    by_x = mask * a * (1 - x) + pull * width * root
    by_a = mask * (rise + log_x - x) + 1.5 * pull / width * (root - 1 - off)
    by_line = jnp.where(scatters > LEAST, 2 * by_a * a * share / scatters, 0.0) / power
    all_x = jnp.sum(by_x, axis=0)
    return value, (all_x / whole - by_x / power - share * by_line, by_line, all_x)


def _gamma_level(a: Many) -> tuple[Array, Array]:
    """`a ln a - ln Γ(a)` for a >= 0.5 to 1e-7, and its slope, by Stirling's series at a + 3: JAX's
    own takes longer."""
    b = a + 3
    r = 1 / b
    series = r * (1 / 12 - r**2 * (1 / 360 - r**2 / 1260))
    falling = r**2 * (1 / 12 - r**2 * (1 / 120 - r**2 / 252))
    ratio = jnp.log(a * r)
    level = (
        a * ratio + b - HALF_LOG_2_PI - series + jnp.log(a * (a + 1) * (a + 2) * r**2 * jnp.sqrt(r))
    )
    return level, ratio + 1 + 0.5 * r + falling + 1 / a + 1 / (a + 1) + 1 / (a + 2)


def likeliest_offset(bins: Bins, power: Powers, line: Powers) -> tuple[Scalar, Scalar]:
    """The u of highest density and its standard deviation by the curvature there."""
    slope = jax.grad(lambda u: log_density(bins, power, line, u))
    curvature = jax.grad(slope)
    # keeps Newton's steps finite far from the maximum
    least = 0.05 * jnp.sum(bins.mask * bins.half)

    def step(_, u):
        return u + jnp.clip(slope(u) / jnp.maximum(-curvature(u), least), -1.0, 1.0)

    u = jax.lax.fori_loop(0, NEWTON, step, jnp.zeros(()))
    return u, 1 / jnp.sqrt(jnp.maximum(-curvature(u), least))


@jax.jit  # a user calls it outside a program, too, and its loop would be traced anew each time
def log_marginal(bins: Bins, power: Powers, line: Powers) -> Scalar:
    """Log density of proportional powers: `log_density` integrated over the offset, by the
    trapezoidal rule."""
    middle, width = jax.tree.map(jax.lax.stop_gradient, likeliest_offset(bins, power, line))
    nodes = middle + width * jnp.linspace(-REACH, REACH, NODES)
    values = jax.vmap(lambda u: log_density(bins, power, line, u))(nodes)
    return jax.nn.logsumexp(values) + jnp.log(width * 2 * REACH / (NODES - 1))


AllBins = tuple[Bins | None, ...]


class Likelihood(eqx.Module):
    """Log likelihood of a fit's data as a function of its model's moments.

    Of a target with segments: the gamma law of Welch bins, with an offset of its own. Without, but
    with a sigma: Gaussian in the residual of the fit (`bins` is None there). Further residuals
    (coefficient of variation, mean) are Gaussian.
    """

    objective: Residuals
    bins: AllBins

    @classmethod
    def of(cls, problem: FitProblem) -> "Likelihood":
        """Of the problem's targets. Raises `ValueError` if one states neither segments nor
        sigma."""
        for part in problem.parts:
            require_spread(part.target)
        bins = (
            None if p.target.segments is None else as_arrays(measured_bins(p.target))
            for p in problem.parts
        )
        return cls(problem.linear(), tuple(bins))

    def filled(self) -> "Likelihood":
        """With the residuals `filled`, for a program that fits share."""
        return Likelihood(self.objective.filled(), self.bins)

    def at(
        self,
        moments: tuple[Moments, ...],
        offsets: Float[Array | np.ndarray, " parts"],
        bins: AllBins | None = None,
    ) -> Scalar:
        """Log density of data and offsets (which count in the gamma law only) where the model has
        these moments."""
        each = zip(range(len(self.bins)), moments, self.bins if bins is None else bins, strict=True)
        return sum((self.of_part(i, m, offsets[i], own) for i, m, own in each), start=jnp.zeros(()))

    def of_part(self, i: int, moments: Moments, offset: Scalar, bins: Bins | None) -> Scalar:
        """Log density of one target's data and offset."""
        if bins is None:
            part = self.objective.parts[i]
            return _gaussian(data_residuals(moments, part.data))
        return log_density(bins, moments.power, moments.line, offset) + self.further(i, moments)

    def further(self, i: int, moments: Moments) -> Scalar:
        """Log density of one target's coefficient of variation, mean and dynamic stiffness."""
        return _gaussian(further_residuals(moments, self.objective.parts[i].data))

    def marginal(self, moments: tuple[Moments, ...], bins: AllBins | None = None) -> Scalar:
        """The same with the offsets integrated out."""
        found = jnp.zeros(())
        for part, m, own in zip(
            self.objective.parts, moments, self.bins if bins is None else bins, strict=True
        ):
            if own is None:
                found += _gaussian(data_residuals(m, part.data))
            else:
                found += log_marginal(own, m.power, m.line) + _gaussian(
                    further_residuals(m, part.data)
                )
        return found

    def information(self, seen: Expansion, bins: AllBins | None = None) -> Float[Array, "all all"]:
        """Fisher information of (θ, offsets), `Jᵀ C⁻¹ J`: C the bins' covariance in the log, 2 R_kl
        / √(ν_k ν_l).

        What the line tells by how little a bin scatters is left out.
        """
        parts, bins = self.objective.parts, self.bins if bins is None else bins
        found = jnp.zeros((len(seen.theta) + len(parts),) * 2)
        for i, (part, own) in enumerate(zip(parts, bins, strict=True)):

            def rows(theta, i=i, part=part, own=own):
                moments = seen.near(theta)[i]
                return (
                    data_residuals(moments, part.data)
                    if own is None
                    else further_residuals(moments, part.data)
                )

            gaussian = jnp.pad(jax.jacfwd(rows)(seen.theta), ((0, 0), (0, len(parts))))
            found += gaussian.T @ gaussian
            if own is not None:
                m, slopes = seen.moments[i], seen.slopes[i]
                weight = own.mask * jnp.sqrt(
                    own.half / jnp.maximum(1 - jnp.clip(m.line / m.power, 0, 1) ** 2, LEAST)
                )
                logs = (
                    jnp.sum(slopes.power, axis=0) / jnp.sum(m.power)
                    - slopes.power / m.power[:, None]
                )
                offset = jnp.broadcast_to(jnp.eye(len(parts))[i], (len(logs), len(parts)))
                scaled = weight[:, None] * jnp.concatenate([logs, offset], axis=1)
                found += scaled.T @ own.precision @ scaled
        return found


def without_offsets(
    information: Float[np.ndarray, "all all"], free: int
) -> Float[np.ndarray, "free free"]:
    """Fisher information of θ where the offsets, the last coordinates, are unknown: its Schur
    complement."""
    inner, cross, own = (
        information[:free, :free],
        information[:free, free:],
        information[free:, free:],
    )
    return inner - cross @ np.linalg.pinv(own, hermitian=True) @ cross.T


def drawn_spectra(
    bins: Bins | None, target: Target, moments: Moments, key: Array
) -> Float[np.ndarray, "rows bins"]:
    """Proportional powers scattering about the model's: correlated gamma variables, or Gaussian in
    the log with a sigma."""
    normal = np.asarray(jax.random.normal(key, np.shape(moments.power)))
    power = np.asarray(moments.power)
    if bins is None:
        drawn = power * np.exp(normal * np.asarray(bin_statistics(target).sd))
    else:
        share = np.clip(np.asarray(moments.line) / power, 0.0, 1.0)
        half = np.asarray(bins.half) / np.maximum(1 - share**2, LEAST)
        root = np.linalg.cholesky(np.linalg.inv(np.asarray(bins.precision)))
        drawn = power * gammaincinv(half, ndtr(normal @ root.T)) / half
    return drawn / drawn.sum(axis=-1, keepdims=True)


def _gaussian(residuals: Float[Array | np.ndarray, " rows"]) -> Scalar:
    return -0.5 * jnp.sum(jnp.asarray(residuals) ** 2)


@kept
def _target_likelihood(task, data, variation):
    samples = jnp.round(jnp.mean(data.samples)).astype(data.samples.dtype)
    moments, system = expected_moments(task, data.settings, WINDOW, samples, data.recorded)
    found = jnp.zeros(())
    if len(data.chosen):
        bins = Bins(
            data.log_power, data.half, data.precision, data.logdet, jnp.ones_like(data.half)
        )
        found = log_marginal(bins, moments.power[data.chosen], moments.line[data.chosen])
    if data.stiffness is not None:
        f, measured, sd = data.stiffness
        found += jnp.sum(
            -0.5 * ((parts_of_stiffness(task, system, f) - measured) / sd) ** 2 - jnp.log(sd)
        )
    if variation is not None:
        found += _gaussian(
            ((jnp.log(moments.variation) - variation[0]) / variation[1])[None]
        ) - jnp.log(variation[1])
    return found


@kept
def _whittle(task, settings, power, window, recorded):
    moments = expected_moments(task, settings, window, None, recorded)[0]
    noise, line = moments.power - moments.line, moments.line
    argument = 2 * jnp.sqrt(power * line) / noise
    return jnp.sum(
        jnp.log(i0e(argument)) - jnp.log(noise) - (jnp.sqrt(power) - jnp.sqrt(line)) ** 2 / noise
    )


def log_likelihood(task: AbstractTask, data: Target | TargetData | Recording) -> Scalar:
    """Log likelihood of measured data under a task in linear response; differentiable in the task.

        target = jm.load_target("vastus-lateralis-26mvc")
        jm.objective.log_likelihood(target.task(), target)

    A `Target` with segments: its Welch bins are correlated gamma variables about the expected
    spectrum (docs/uncertainty.md, *The likelihood*), their unknown total integrated out; with its
    coefficient of variation as one more datum, Gaussian in the log with the standard deviation that
    it has under this task, if it states one; and with its dynamic stiffness, Gaussian in real and
    imaginary part with the errors that it states, if it has one. `target.data()` is the same as
    arrays, for an argument of what you compile: under `jit` it is traced once for all targets with
    the same settings, number of bins and number of trials, and `vmap` maps it over people. A
    `Recording`: the Whittle likelihood of the periodogram of its window, in its own units, between
    the first and last bin of the task's settings, about the *expected* periodogram of a window of
    that length (leakage and aliases included: debiased Whittle, Sykulski et al. 2019,
    doi:10.1093/biomet/asy071). With the periodogram I_k and its expectation E_k = N_k + L_k, N_k
    from the noise and L_k from the line,

        Σ_k [ln I0(2 √(I_k L_k) / N_k) - (I_k + L_k) / N_k - ln N_k],

    the noncentral chi-squared law with two degrees of freedom (I0 is the modified Bessel function);
    without a line `-Σ (ln E_k + I_k / E_k)`.

    **Raises:** `ValueError` for a target without segments, a harmonic beyond half the sampling
    rate, a recording whose window is constant, too short, or sampled too slowly for the bins, and
    for data of several people without `vmap`.
    """
    if isinstance(data, Target):
        if not all_concrete(data):
            raise ValueError(
                f"data: JAX is tracing the target {data.name!r}. Give its arrays instead:"
                " log_likelihood(task, target.data())"
            )
        data = data.data()
    if all_concrete(task):
        check_line(task, task.settings)
        check_inputs(task)
        warn_beyond(task, data.settings if isinstance(data, TargetData) else None)
    if isinstance(data, TargetData):
        if np.ndim(data.log_power) != 1:
            raise ValueError(
                f"data: these are of {len(data.log_power)} targets in one. Map over them:"
                " jax.vmap(jaxmuscle.objective.log_likelihood)(tasks, data), or, of one task, with"
                " in_axes=(None, 0)"
            )
        task, data = as_arrays(task.with_parts(settings=data.settings)), _as_arrays(data)
        variation = None
        if data.log_variation is not None:
            variation = as_arrays(
                variation_under(task, data.settings, data.log_variation, data.samples, data.longest)
            )
        return _target_likelihood(task, data, variation)
    whole = data.fft_spectrum(task.settings.replace(window="boxcar", tapers=1))
    duration = whole.settings.length / whole.settings.rate
    recorded = jnp.asarray(recorded_interval(data, whole.settings))
    return _whittle(
        as_arrays(task), whole.settings, jnp.asarray(whole.power), (0.0, duration), recorded
    )


def _as_arrays(data: TargetData) -> TargetData:
    """In the caller's precision, as `as_arrays`; whole numbers stay whole."""

    def array(leaf: Any) -> Any:
        whole = np.issubdtype(leaf.dtype, np.integer)
        return as_arrays(leaf, leaf.dtype if whole else None)

    return jax.tree.map(array, data)
