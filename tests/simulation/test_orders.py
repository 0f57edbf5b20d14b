"""Strong orders of convergence on one noise path, and the round trip between Tasks 1 and 2."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import references
from compiled import at_once, kept_jit
from noise_paths import coarsen, draw_normals, respond

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.simulation._grid import Grid

KEY = jax.random.key(5)
FINE, SECONDS, SEEDS = 2**14, 0.25, 400


def strong_errors(task, factors):
    """Root mean square over seeds of the final state's distance from that of the finest grid."""
    steps = int(FINE * SECONDS)
    # displacement as velocity, eigenfrequency 30/s
    keys, scale = jax.random.split(KEY, SEEDS), np.array([30.0, 1.0])

    def final(factor):
        grid = Grid(factor / FINE, steps // factor, steps // factor)

        def ended(key):
            fine = draw_normals(task.noise, key, steps)
            states, _ = respond(task, coarsen(task.noise, fine, 1 / FINE, factor), grid)
            return states[-1] * scale

        return at_once(jax.vmap(ended), keys)

    reference = final(1)
    return [
        float(jnp.sqrt(jnp.mean(jnp.sum((final(factor) - reference) ** 2, axis=-1))))
        for factor in factors
    ]


ROUND, ROUND_SECONDS = 8000, 2.0  # steps per second of the finest path of the round trip


@functools.cache
def recorded(factor):
    """What a task gives on a grid of `factor` times the finest step, on the normals of one path of
    unit noise: one program for tasks of one structure."""
    steps, noise = int(ROUND_SECONDS * ROUND), jm.BandLimitedNoise(cutoff=10.0)
    grid = Grid(factor / ROUND, steps // factor, 1)

    def output(task, key):
        normals = coarsen(noise, draw_normals(noise, key, steps), 1 / ROUND, factor)
        return respond(task, normals, grid)[1]

    return kept_jit(lambda task: output(task, KEY))


def moving(noise):
    """An isometric muscle set free at 2 cm with 1 m/s, so that velocities matter, without its
    harmonic."""
    task = jm.Isometric(
        jm.model.Constant(2.0), noise=noise, harmonic=jm.Harmonic(0.0), initial=(0.02, 1.0)
    )
    return task.replace(c_w=8.0, c_z=1.0)


# 0.25 ms to 1 ms; what is between adds nothing to a slope over equal distances
FACTORS = np.array([4, 16])


@pytest.mark.parametrize(
    "noise, order",
    [
        # Stiffness noises multiply positions and push velocities: they commute, Heun is of order
        # one.
        (jm.WhiteNoise({"K_w": 1.0}), 1.0),
        # With damping noise they do not: without the Lévy area no more than one half.
        (jm.WhiteNoise({"K_w": 3.0, "C_w": 2.0}), 0.5),
        # Continuous, but the trapezoid's error of a Brownian bridge remains, √steps times
        # step^{3/2}.
        (jm.OrnsteinUhlenbeckNoise({"K_w": 0.6, "C_w": 0.3}, 0.05), 1.0),
        # Differentiable and exact on the grid: √steps times step^{5/2}, as Heun's own.
        (jm.BandLimitedNoise({"K_w": 3.0, "C_w": 0.5}, cutoff=20.0), 2.0),
    ],  # without noise: test_without_noise_the_result_is_scipys_to_second_order
    ids=["white stiffness", "white damping", "ornstein-uhlenbeck", "band-limited"],
)
def test_strong_order(x64, noise, order):
    errors = strong_errors(moving(noise), [int(factor) for factor in FACTORS])
    # The reference errs, too. Rough noise adds independent errors at every refinement, so that
    # squares subtract, h^2p - h_ref^2p; smooth errors subtract themselves.
    power = 2 * order if order < 2 else order
    steps = (FACTORS**power - 1) ** (1 / power)
    # Spread of a root mean square over 400 seeds 4 to 7 %, over a factor of four in the step; next
    # orders add as much.
    assert abs(references.observed_order(steps, errors) - order) < 0.15, errors


@pytest.mark.slow
@pytest.mark.parametrize(
    "amplitude, lowest, bound",
    [
        ((0.05, 0.0, 0.01, 0.0), 1.9, 1e-5),
        # P_w then contains N', as rough as Brownian motion: what its samples leave out between them
        # is of order one, give or take what one path happens to be.
        ((0.05, 0.05, 0.01, 0.01), 0.7, 3e-3),
    ],
    ids=["active", "active and passive"],
)
def test_what_task_1_asks_for_moves_task_2_the_same_way(x64, amplitude, lowest, bound):
    noise = jm.BandLimitedNoise(amplitude, cutoff=10.0)
    forward = jm.PrescribedMotion(
        jm.model.RampHold(0.005),
        jm.model.SmoothStep(2.0, 0.3, 1.0),
        noise=noise,
        harmonic=jm.Harmonic(0.02, 4.25, 0.4),
    )
    errors, dts = [], []
    for factor in (16, 4):
        force = np.asarray(recorded(factor)(as_arrays(forward)))
        dt = factor / ROUND
        time = dt * np.arange(len(force))
        pulled = jm.model.Sampled.through(time, force)
        back = forward.as_task(jm.PrescribedForce, P_w=pulled, F_ext=forward.F_ext)
        x_z = np.asarray(recorded(factor)(as_arrays(back)))
        expected = np.asarray(at_once(jax.vmap(forward.x_z), time))
        errors.append(np.abs(x_z - expected).max() / 0.005)
        dts.append(dt)
    assert errors[-1] < bound
    assert references.observed_order(dts, errors) > lowest, errors
