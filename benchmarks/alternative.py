"""The same fit as one writes it without jaxmuscle: `least_squares` with finite differences over a
numba Monte Carlo loop.

Of jaxmuscle it takes the numbers only: default values, the target, and how its bins scatter.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numba
import numpy as np
import scipy.optimize
import scipy.signal
import scipy.stats
from fits import TARGETS
from handwritten import filter_matrices
from integration import DT, EPSILONS, EVERY, STEPS
from jaxtyping import Float
from measure import Row, Unequal, require_equal, seconds
from noise_paths import respond

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.model._parameters import DEFAULT_FREE
from jaxmuscle.objective._problem import target_variation
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.simulation._grid import Grid
from jaxmuscle.spectra._bin_law import bin_statistics, standardised
from jaxmuscle.spectra._settings import WINDOW

SEEDS, RATE, ROUNDS, DOUBT = 48, 100.0, 3, 0.01
# the default 1e-8 creeps along the ripples that fixed seeds leave in the cost, to the last
# evaluation allowed
FTOL = 1e-4
DEFAULTS = {name: parameter.default for name, parameter in jm.model.PARAMETERS.items()}
OURS, OTHER = "jaxmuscle", "scipy and numba"


@numba.njit
def _pull(x, v, P_w, coefficients, u):
    """Acceleration of the active mass and force at the insertion, equation (1a) with x_z = 0."""
    m_w, k_w, k_z, c_w, c_z, x_ref_w, x_ref_z, v_ref_w, v_ref_z = coefficients
    K_w, K_z = k_w * (x_ref_w**2 + x**2) + u[0], k_z * x_ref_z**2 + u[1]
    C_w, C_z = c_w * (v_ref_w**2 + v**2) + u[2], c_z * v_ref_z**2 + u[3]
    force = C_z * v + K_z * x
    return (P_w - C_w * v - K_w * x - force) / m_w, force


@numba.njit(parallel=True)
def _forces(coefficients, P_w, steady, scale, noise, dt, every):
    """Force of each seed at every `every`-th step, by Heun; `steady` is the harmonic's
    perturbation, `noise` for scale 1."""
    seeds, points, _ = noise.shape
    forces = np.zeros((seeds, (points - 1) // every + 1))
    for seed in numba.prange(seeds):
        x, v = 0.0, 0.0
        here = steady[0] + scale * noise[seed, 0]
        for i in range(points - 1):
            a, force = _pull(x, v, P_w[i], coefficients, here)
            if i % every == 0:
                forces[seed, i // every] = force
            for j in range(4):
                here[j] = steady[i + 1, j] + scale[j] * noise[seed, i + 1, j]
            after, _ = _pull(x + dt * v, v + dt * a, P_w[i + 1], coefficients, here)
            x, v = x + 0.5 * dt * (2.0 * v + dt * a), v + 0.5 * dt * (a + after)
        forces[seed, -1] = _pull(x, v, P_w[-1], coefficients, here)[1]
    return forces


@numba.njit(parallel=True)
def _unit_noise(normals, transition, root):
    """Band-limited noise (seeds, points, channels) of unit deviation from normals (seeds, points,
    2, channels)."""
    seeds, points, _, channels = normals.shape
    noise = np.empty((seeds, points, channels))
    for seed in numba.prange(seeds):
        for j in range(channels):
            n, slope = normals[seed, 0, 0, j], normals[seed, 0, 1, j]
            noise[seed, 0, j] = n
            for i in range(1, points):
                first, second = normals[seed, i, 0, j], normals[seed, i, 1, j]
                n, slope = (
                    transition[0, 0] * n + transition[0, 1] * slope + root[0, 0] * first,
                    transition[1, 0] * n
                    + transition[1, 1] * slope
                    + root[1, 0] * first
                    + root[1, 1] * second,
                )
                noise[seed, i, j] = n
    return noise


def draw_normals() -> Float[np.ndarray, "seeds points 2 channels"]:
    """The normals of the noise paths, which stay the same throughout a fit."""
    return np.random.default_rng(0).standard_normal((SEEDS, STEPS + 1, 2, 4))


def make_noise(
    normals: Float[np.ndarray, "seeds points 2 channels"],
) -> Float[np.ndarray, "seeds points channels"]:
    """Noise paths of these normals."""
    transition, root, deviation = filter_matrices(RATE, DEFAULTS["noise_cutoff"], DT)
    return deviation * _unit_noise(normals, transition, root)


def simulate(
    values: dict[str, float], noise: Float[np.ndarray, "seeds points channels"]
) -> Float[np.ndarray, "seeds samples"]:
    """Force at 100 Hz, isometric, under a smooth step of P_w from rest."""
    v, time = DEFAULTS | values, DT * np.arange(STEPS + 1)
    p = np.clip((time - 0.5) / 1.0, 0.0, 1.0)
    P_w = v["P_w"] * p**4 * (35 - p * (84 - p * (70 - 20 * p)))
    order = ("m_w", "k_w", "k_z", "c_w", "c_z", "x_ref_w", "x_ref_z", "v_ref_w", "v_ref_z")
    base = np.array(
        [v[f"k_{j}"] * v[f"x_ref_{j}"] ** 2 for j in "wz"]
        + [v[f"c_{j}"] * v[f"v_ref_{j}"] ** 2 for j in "wz"]
    )
    wave = v["harmonic_amplitude"] * np.sin(
        2 * np.pi * v["harmonic_frequency"] * time + v["harmonic_phase"]
    )
    scale = base * [v[f"noise_{channel}"] for channel in ("K_w", "K_z", "C_w", "C_z")]
    return _forces(
        tuple(v[n] for n in order),
        P_w,
        np.outer(wave, base * [1, 1, 0, 0]),
        scale,
        noise,
        DT,
        EVERY,
    )


def low_passed(
    forces: Float[np.ndarray, "seeds samples"], settings: Any
) -> Float[np.ndarray, "seeds times"]:
    """What the low-pass lets through, in the window."""
    sections = scipy.signal.butter(
        settings.filter_order, settings.filter_cutoff, fs=settings.rate, output="sos"
    )
    low_pass = (
        scipy.signal.sosfiltfilt if settings.filter_direction == "both" else scipy.signal.sosfilt
    )
    return low_pass(sections, forces)[
        :, round(WINDOW[0] * settings.rate) : round(WINDOW[1] * settings.rate)
    ]


def welch(held: Float[np.ndarray, "seeds times"], settings: Any) -> Float[np.ndarray, "seeds bins"]:
    """Power of each seed."""
    _, power = scipy.signal.welch(
        held, settings.rate, window=settings.window, nperseg=settings.length
    )
    return power[:, settings.first_bin : settings.last_bin + 1]


class Fitted(NamedTuple):
    """Where `least_squares` ended, and how many simulations that took."""

    values: dict[str, float]
    success: bool
    simulations: int


def fit(target: jm.Target, noise: Float[np.ndarray, "seeds points channels"]) -> Fitted:
    """From the default values, `θ = ln(v / default)` with a prior of deviation 1; the same
    residuals as `jm.fit`."""
    statistics, variation = bin_statistics(target), target_variation(target)
    start, simulations = np.array([DEFAULTS[n] for n in DEFAULT_FREE]), 0

    def values(theta):
        return dict(zip(DEFAULT_FREE, start * np.exp(theta), strict=True))

    def residuals(theta):
        nonlocal simulations
        simulations += 1
        forces = simulate(values(theta), noise)
        held = low_passed(forces, target.settings)
        power = welch(held, target.settings).mean(axis=0)
        rows = [standardised(target.proportional_power, power, statistics), theta]
        if variation is not None:
            spread = np.sqrt(held.var(axis=1).mean()) / abs(held.mean())
            rows.append([(np.log(spread) - variation[0]) / variation[1]])
        return np.concatenate(rows)

    found = scipy.optimize.least_squares(residuals, np.zeros(len(start)), jac="2-point", ftol=FTOL)
    return Fitted(values(found.x), bool(found.success), simulations)


def check(
    task: jm.model.AbstractTask, normals: Float[np.ndarray, "seeds points 2 channels"]
) -> None:
    """The loop must equal jaxmuscle's simulation on the same noise, and its spectrum the expected
    one within its error."""
    forces = simulate({}, make_noise(normals))
    grid, start = Grid(DT, STEPS, EVERY, reverse=False), round(WINDOW[0] * RATE)
    each = jax.vmap(lambda rows: respond(as_arrays(task), (rows,), grid)[1])
    ours = jax.jit(each)(jnp.asarray(normals.reshape(SEEDS, STEPS + 1, 8)))
    tolerance = EPSILONS * float(jnp.finfo(float).eps)
    difference = require_equal(
        "numba loop", forces[:, start:, None], ours[:, start:, None], tolerance
    )
    power = welch(low_passed(forces, task.settings), task.settings)
    error = power.std(axis=0, ddof=1) / np.sqrt(SEEDS)
    away = float(
        np.max(np.abs(power.mean(axis=0) - np.asarray(jm.expected_spectrum(task).power)) / error)
    )
    bound = float(scipy.stats.t.isf(0.5 * (1 - (1 - DOUBT) ** (1 / power.shape[1])), SEEDS - 1))
    print(
        f"numba loop: force equals jaxmuscle's within {difference:.1e} (tolerance {tolerance:.1e}),"
        f" spectrum the expected one within {away:.1f} standard errors (bound {bound:.1f})"
    )
    if not away <= bound:
        raise Unequal(
            f"spectrum of the numba loop: {away:.1f} standard errors from the expected one, more"
            f" than {bound:.1f}"
        )


def _chi2(task: jm.model.AbstractTask, target: jm.Target) -> float:
    """chi² per bin of a task's expected spectrum, whichever fit found it."""
    moments = expected_moments(as_arrays(task), target.settings, WINDOW)[0]
    power, line = np.asarray(moments.power), np.asarray(moments.line)
    residual = standardised(target.proportional_power, power, bin_statistics(target, line / power))
    return float(np.sum(residual**2) / (len(residual) - 1))


def rows() -> list[Row]:
    """Both measured targets with the default noise: all starts and checks of `jm.fit` against one
    start of the other."""
    with jax.enable_x64(True):
        normals = draw_normals()
        return [row for name in TARGETS for row in _compare(name, jm.load_target(name), normals)]


def _compare(
    name: str, target: jm.Target, normals: Float[np.ndarray, "seeds points 2 channels"]
) -> list[Row]:
    task = target.task()
    check(task, normals)
    noise = make_noise(normals)
    ends: dict[str, Any] = {}
    programs = {
        OURS: lambda: ends.update(ours=jm.fit(task, target)),
        OTHER: lambda: ends.update(other=fit(target, noise)),
    }
    taken = seconds(programs, ROUNDS)
    ours, other = ends["ours"], ends["other"]
    starts, ratio = len(ours.starts), float(np.median(taken[OTHER].wall / taken[OURS].wall))
    mine, group = f"{name}, jm.fit, {starts} starts", f"{name}, {OTHER}, 1 start"
    if not other.success:
        print(f"{group}: least_squares did not converge")
    return [
        Row(f"{mine}: warm wall time", float(np.median(taken[OURS].wall)), "s"),
        Row(f"{group}: wall time", float(np.median(taken[OTHER].wall)), "s"),
        Row(f"{group}: simulations of {SEEDS} seeds", other.simulations, "1"),
        Row(f"{group}: wall time", ratio, "times", f"jm.fit with {starts} starts and checks"),
        Row(f"{group}: wall time", ratio * starts, "times", "jm.fit per start"),
        Row(f"{mine}: chi2 per bin", _chi2(ours.task, target), "1 (expected spectrum)"),
        Row(
            f"{group}: chi2 per bin",
            _chi2(task.replace(**other.values), target),
            "1 (expected spectrum)",
        ),
    ]
