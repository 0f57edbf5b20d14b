"""Task 2 written by hand as batched scans, the fastest that we know: one array per state,
coefficients written out."""

from typing import Any

import jax
import jax.numpy as jnp
from handwritten import filter_matrices

import jaxmuscle as jm

SEEDS, DT, EVERY, STEPS = 1024, 1e-3, 10, 2000
BAND = (float(jm.BandLimitedNoise().rate), float(jm.BandLimitedNoise().cutoff))


def numbers(task: Any) -> tuple[Any, ...]:
    """Masses, factors and squared references of the paper's muscle."""
    m = task.muscle
    return (
        m.m_w,
        m.m_z,
        m.stiffness_w.k,
        m.stiffness_z.k,
        m.damping_w.c,
        m.damping_z.c,
        m.stiffness_w.x_ref**2,
        m.stiffness_z.x_ref**2,
        m.damping_w.v_ref**2,
        m.damping_z.v_ref**2,
    )


def _slope(p: tuple, inputs: tuple, y: tuple, noise: tuple) -> tuple:
    """Increment of (x_w, v_w, x_z, v_z), one array per state; `inputs` and `noise` (of K_w, K_z,
    C_w, C_z) times dt."""
    m_w, m_z, k_w, k_z, c_w, c_z, xw2, xz2, vw2, vz2 = p
    (x_w, v_w, x_z, v_z), (dt, P_w, F_ext, harmonic_w, harmonic_z) = y, inputs
    K_w = dt * k_w * (xw2 + x_w**2) + harmonic_w + noise[0]
    K_z = dt * k_z * (xz2 + x_z**2) + harmonic_z + noise[1]
    C_w, C_z = dt * c_w * (vw2 + v_w**2) + noise[2], dt * c_z * (vz2 + v_z**2) + noise[3]
    passive = C_z * (v_z - v_w) + K_z * (x_z - x_w)
    return (
        dt * v_w,
        (P_w - C_w * v_w - K_w * x_w + passive) / m_w,
        dt * v_z,
        -(F_ext + passive) / m_z,
    )


def grid_inputs(task: Any) -> list[Any]:
    """P_w, F_ext and the harmonic's part of K_w and K_z at the grid points."""
    times = jnp.arange(STEPS + 1) * DT
    wave, base = jax.vmap(task.harmonic)(times), task.muscle.base()
    return [jax.vmap(task.P_w)(times), jax.vmap(task.F_ext)(times), base[0] * wave, base[1] * wave]


def _inputs(task: Any) -> tuple:
    """Times dt, at the beginning and end of every step: dt and the inputs of the grid."""
    rows = [DT * row for row in (jnp.ones(STEPS + 1), *grid_inputs(task))]
    return tuple(jnp.stack([row[:-1], row[1:]], 1).reshape(-1, EVERY, 2) for row in rows)


def _heun(p: tuple, inputs: tuple, y: tuple, before: tuple, after: tuple) -> tuple:
    first = _slope(p, tuple(i[0] for i in inputs), y, before)
    moved = tuple(a + b for a, b in zip(y, first, strict=True))
    second = _slope(p, tuple(i[1] for i in inputs), moved, after)
    return tuple(a + 0.5 * (b + c) for a, b, c in zip(y, first, second, strict=True))


def _kept(step: Any, carry: Any, xs: Any) -> Any:
    def block(carry, x):
        carry, _ = jax.lax.scan(lambda c, x: (step(c, x), None), carry, x)
        return carry, carry[0]

    _, states = jax.lax.scan(block, carry, xs)
    return jnp.moveaxis(jnp.stack(states, -1), 0, 1)


def _drawn(key: Any, rows: int, count: int) -> Any:
    """Normals of JAX, (rows, count, seeds), from a key for every seed; eight seeds at a time, which
    stay in the cache."""
    one = lambda i: jax.random.normal(jax.random.fold_in(key, i), (rows, count))  # noqa: E731
    return jnp.moveaxis(jax.lax.map(one, jnp.arange(SEEDS), batch_size=8), 0, -1)


def white_by_hand(task: Any, key: Any) -> Any:
    """One array per state, seeds side by side, normals of all seeds drawn before."""
    scale = task.noise_scale() * jnp.sqrt(DT / task.noise.rate)
    normals = _drawn(key, STEPS, 4).reshape(-1, EVERY, 4, SEEDS)
    p, start = numbers(task), tuple(jnp.zeros(SEEDS) for _ in range(4))

    def step(carry, x):
        inputs, n = x
        noise = tuple(scale[i] * n[i] for i in range(4))
        return (_heun(p, inputs, carry[0], noise, noise),)

    return _kept(step, (start,), (_inputs(task), normals))


def band_by_hand(task: Any, key: Any) -> Any:
    """The same with the filter's recursion in the loop."""
    f, root, deviation = filter_matrices(*BAND, DT)
    scale = DT * deviation * task.noise_scale()
    normals = _drawn(key, STEPS + 1, 8)
    f, root = jnp.asarray(f, normals.dtype), jnp.asarray(root, normals.dtype)
    p, start = numbers(task), tuple(jnp.zeros(SEEDS) for _ in range(4))

    def step(carry, x):
        (y, n, slope), (inputs, kick) = carry, x
        new = tuple(f[0, 0] * n[i] + f[0, 1] * slope[i] + root[0, 0] * kick[i] for i in range(4))
        steep = tuple(
            f[1, 0] * n[i] + f[1, 1] * slope[i] + root[1, 0] * kick[i] + root[1, 1] * kick[4 + i]
            for i in range(4)
        )
        before, after = (tuple(scale[i] * values[i] for i in range(4)) for values in (n, new))
        return _heun(p, inputs, y, before, after), new, steep

    rows = tuple(normals[0, i] for i in range(8))
    return _kept(
        step, (start, rows[:4], rows[4:]), (_inputs(task), normals[1:].reshape(-1, EVERY, 8, SEEDS))
    )
