"""The programs to compare with: Heun in `lax.scan`, and diffrax as its documentation shows it."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from jaxmuscle.model import AbstractNoise, AbstractTask

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from noise_paths import draw_normals


def drawn(
    noise: AbstractNoise, key: Any, seeds: int, steps: int
) -> Float[Array, "seeds points numbers"]:
    """Normals of every seed as jaxmuscle draws them, see `draw_normals`; few at a time, which stay
    in the cache."""
    return jax.lax.map(
        lambda i: draw_normals(noise, jax.random.fold_in(key, i), steps)[0],
        jnp.arange(seeds),
        batch_size=8,
    )


def _heun(
    slope: Callable[[Any, Any, Any], Any], t: Any, dt: float, y: Any, u: tuple[Any, Any]
) -> Any:
    before = slope(t, y, u[0])
    return y + 0.5 * (before + slope(t + dt, y + before, u[1]))


def _scan(step: Callable, carry: Any, xs: Float[Array, "steps ..."], dt: float, every: int) -> Any:
    """`step` at every grid time, keeping the first part of the carry after each `every`-th."""
    times = dt * jnp.arange(xs.shape[0], dtype=xs.dtype)
    blocks = jax.tree.map(lambda x: x.reshape(-1, every, *x.shape[1:]), (times, xs))

    def block(carry, inputs):
        carry, _ = jax.lax.scan(lambda c, x: (step(c, x), None), carry, inputs)
        return carry, carry[0]

    _, kept = jax.lax.scan(block, carry, blocks)
    return jnp.concatenate([carry[0][None], kept])


def _column(row: Any, like: Any) -> Any:
    """Four numbers, broadcast against an optional trailing axis of seeds."""
    return row.reshape(4, *(1,) * (like.ndim - 1))


def white_scan(
    task: AbstractTask, increments: Float[Array, "steps 4 *seeds"], dt: float, every: int
) -> Any:
    """Stratonovich Heun for white noise: one `jvp` gives drift and diffusion times increment."""
    start = jnp.zeros((4, *increments.shape[2:]), increments.dtype)
    base, scale = _column(task.harmonic_base()[:4], start), _column(task.noise_scale(), start)

    def step(carry, x):
        t, dw = x

        def slope(t, y, u):
            drift, diffusion = jax.jvp(lambda u: task.vector_field(t, y, u), (u,), (scale * dw,))
            return dt * drift + diffusion

        zero = jnp.zeros_like(dw)
        u = base * task.harmonic(t) + zero, base * task.harmonic(t + dt) + zero
        return (_heun(slope, t, dt, carry[0], u),)

    return _scan(step, (start,), increments, dt, every)


def filter_matrices(rate: float, cutoff: float, dt: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Exact transition of `(N, N'/ω)` in units of its stationary deviation, the root of its noise,
    that deviation."""
    omega = 2 * np.pi * cutoff
    transition = scipy.linalg.expm(omega * dt * np.array([[0.0, 1.0], [-1.0, -np.sqrt(2)]]))
    root = np.linalg.cholesky(np.eye(2) - transition @ transition.T)
    return transition, root, float(np.sqrt(omega / (2 * np.sqrt(2) * rate)))


def band_scan(
    task: AbstractTask,
    normals: Float[Array, "points 8 *seeds"],
    matrices: tuple[np.ndarray, np.ndarray, float],
    dt: float,
    every: int,
) -> Any:
    """Filter recursion and Heun in one scan."""
    (f, root, deviation), dtype = matrices, normals.dtype
    f, root = np.asarray(f, dtype), np.asarray(root, dtype)
    start = jnp.zeros((4, *normals.shape[2:]), dtype)
    base, scale = (
        _column(task.harmonic_base()[:4], start),
        _column(task.noise_scale(), start) * deviation,
    )

    def slope_of(t, y, u):
        return dt * task.vector_field(t, y, u)

    def step(carry, x):
        (y, n, slope), (t, kick) = carry, x
        n1 = f[0, 0] * n + f[0, 1] * slope + root[0, 0] * kick[:4]
        slope1 = f[1, 0] * n + f[1, 1] * slope + root[1, 0] * kick[:4] + root[1, 1] * kick[4:]
        u = base * task.harmonic(t) + scale * n, base * task.harmonic(t + dt) + scale * n1
        return _heun(slope_of, t, dt, y, u), n1, slope1

    return _scan(step, (start, normals[0, :4], normals[0, 4:]), normals[1:], dt, every)


def stock_diffrax(
    task: AbstractTask,
    path: dfx.AbstractBrownianPath,
    rate: float,
    dt: float,
    steps: int,
    every: int,
) -> Any:
    """White noise in plain diffrax: time in seconds, `Heun`, a path of diffrax's own, every
    `every`-th step saved."""
    scale, base = task.noise_scale() / np.sqrt(rate), task.harmonic_base()[:4]

    def drift(t, y, _):
        return task.vector_field(t, y, base * task.harmonic(t))

    def diffusion(t, y, _):
        field = lambda w, _: task.vector_field(t, y, base * task.harmonic(t) + scale * w)  # noqa: E731
        return lx.JacobianLinearOperator(field, jnp.zeros_like(scale))

    solution = dfx.diffeqsolve(
        dfx.MultiTerm(dfx.ODETerm(drift), dfx.ControlTerm(diffusion, path)),
        dfx.Heun(),
        t0=0.0,
        t1=steps * dt,
        dt0=dt,
        y0=jnp.zeros(4),
        saveat=dfx.SaveAt(t0=True, steps=every),
        max_steps=steps + every,
        adjoint=dfx.DirectAdjoint(),
    )
    assert solution.ys is not None
    return solution.ys
