"""Simulation of a task: one seed or an ensemble, jitted, vmapped over seeds, in chunks that bound memory."""

import math
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ._linear import LinearTask, check_equilibrium, linearised
from ._noise import AbstractNoise, Realisation
from ._operating import OperatingPointError, fastest_rate
from ._parameter import as_arrays, as_numbers, is_concrete
from ._path import Grid, observe, solve
from ._task import AbstractTask
from ._trajectory import WINDOW, Trajectory, one, stack

MAX_RATE_STEP = 0.5
MAX_SUBSTEPS = 256
CHUNK = 32
DRAWN = 8
DURATION = 15.0
DT = 1e-3
TRANSIENT = 1e-3


class SimulationError(RuntimeError):
    """A trajectory did not stay finite; the message names seeds and parameters."""


def simulate(
    task: AbstractTask,
    key: PRNGKeyArray,
    *,
    seed: int = 0,
    duration: float = DURATION,
    dt: float = DT,
    rate: float | None = None,
    substeps: int | None = None,
    sampling: str | None = None,
) -> Trajectory:
    """Simulate one seed: the Stratonovich equation `dy = f(t, y, S) dt + (∂f/∂u) σ ∘ dW`, or with coloured noise in u.

    Heun's method at fixed steps in diffrax. Differentiable in both modes with respect to the task's parameters.

    **Arguments:** `task`; `key`, a `jax.random` key, from which seed i takes `fold_in(key, i)`; `seed`; `duration` [s];
    `dt` [s], the grid on which noise is drawn, which must divide the sampling interval; `rate` [Hz] of the samples
    returned, the task's spectrum settings by default; `substeps` per dt (by default as many as stability asks for,
    a power of two, so that max |eigenvalue| dt / substeps <= 0.5); `sampling`, "instant" or "average" over the sampling
    interval (the task's settings by default).

    **Returns:** a `Trajectory`. **Raises:** `ValueError` for a grid that does not fit, `SimulationError` if the result is
    not finite (not under a JAX transformation, where it is returned as it is).
    """
    seeds = jnp.atleast_1d(jnp.asarray(seed))
    grid, sampling, rate = _plan(task, duration, dt, rate, substeps, sampling)
    result = one(_run(task, key, seeds, grid, sampling, rate))
    _require_finite(result)
    return result


def ensemble(
    task: AbstractTask,
    key: PRNGKeyArray,
    *,
    seeds: int | Int[np.ndarray, " seeds"],
    duration: float = DURATION,
    dt: float = DT,
    rate: float | None = None,
    substeps: int | None = None,
    sampling: str | None = None,
    chunk: int = CHUNK,
    control: bool | None = None,
    progress: bool = False,
) -> Trajectory:
    """Simulate many seeds (0 to seeds - 1, or those given), `chunk` at a time; seed i is `simulate(..., seed=i)`.

    Arguments, returns and errors as in `simulate`; `progress` shows a bar. What does not stay finite is an error that
    names every such seed, never averaged in silently.

    `control` carries the linearised task along on the same noise paths, as control variate for
    `Trajectory.mean_spectrum`; None does so wherever it pays: the run covers the analysed window and the task has a
    stable equilibrium whose transients have decayed there.
    """
    numbers = np.arange(seeds) if isinstance(seeds, int) else np.asarray(seeds)
    if numbers.size == 0:
        raise ValueError("seeds = 0: an ensemble needs at least one seed")
    if chunk < 1:
        raise ValueError(f"chunk = {chunk} must be at least 1")
    grid, sampling, rate = _plan(task, duration, dt, rate, substeps, sampling)
    if not _all_concrete((task, key)):
        linear = LinearTask.of(as_arrays(task)) if control else None
        return _run(task, key, jnp.asarray(numbers), grid, sampling, rate, linear)
    linear = None if control is False else _companion(task, duration, required=control is True)
    size = min(chunk, 8 * math.ceil(numbers.size / 8))
    blocks = np.concatenate([numbers, np.full(-numbers.size % size, numbers[-1])]).reshape(-1, size)
    parts = (_run(task, key, jnp.asarray(block), grid, sampling, rate, linear) for block in blocks)
    found = stack(_progress(parts, len(blocks), numbers.size, progress), numbers.size)
    _require_finite(found)
    return found


def _companion(task: AbstractTask, duration: float, *, required: bool) -> LinearTask | None:
    """The linearised task, if its response is stationary in the analysed window; else None, or an error if required."""
    with jax.enable_x64(True):
        linear = linearised(as_arrays(task))
        try:
            slowest = check_equilibrium(task, np.asarray(linear.system.point), np.asarray(linear.system.A))
        except OperatingPointError:
            if required:
                raise
            return None
        moved = np.abs(np.asarray(as_arrays(task).initial_state()) - np.asarray(linear.system.point))
    # A task that starts settled has nothing to forget.
    left = math.exp(-slowest * WINDOW[0]) if np.max(moved) > 1e-9 else 0.0
    if duration < WINDOW[1] or left > TRANSIENT:
        if required:
            raise ValueError(
                f"control = True: duration = {duration} s must reach {WINDOW[1]} s, and by {WINDOW[0]} s the slowest motion "
                f"must have decayed to {TRANSIENT:g} of its start, but {left:.2g} is left: simulate settled(task)"
            )
        return None
    return linear


def _progress(parts: Iterable[Trajectory], count: int, total: int, show: bool) -> Iterable[Trajectory]:
    if not show:
        return parts
    from rich.progress import track

    return track(parts, description=f"simulating {total} seeds", total=count, transient=True)


def _all_concrete(tree: Any) -> bool:
    return all(is_concrete(leaf) for leaf in jax.tree.leaves(tree))


def _plan(
    task: AbstractTask,
    duration: float,
    dt: float,
    rate: float | None,
    substeps: int | None,
    sampling: str | None,
) -> tuple[Grid, str, float]:
    rate = task.settings.rate if rate is None else rate
    sampling = task.settings.sampling if sampling is None else sampling
    if sampling not in ("instant", "average"):
        raise ValueError(f"sampling = {sampling!r} must be 'instant' or 'average'")
    if not (dt > 0 and rate > 0 and duration > 0):
        raise ValueError(f"dt = {dt} s, rate = {rate} Hz and duration = {duration} s must be positive")
    every = whole(1 / (rate * dt), f"dt = {dt} s does not divide the sampling interval {1 / rate} s: use one of "
                  f"{', '.join(f'{1 / rate / n:.6g}' for n in (1, 2, 4, 5, 10, 20))} s")  # fmt: skip
    samples = whole(duration * rate, f"duration = {duration} s is not a whole number of sampling intervals {1 / rate} s")
    if _all_concrete(task):
        task.noise.check_step(dt)
    if substeps is None:
        substeps = stable_substeps(task, dt, duration) if _all_concrete(task) else 1
    return Grid(dt, samples * every, every, substeps, reverse=not _all_concrete(task)), sampling, rate


def whole(value: float, message: str) -> int:
    """A number that must be whole (up to rounding) and positive, else a `ValueError` with the message."""
    if round(value) < 1 or abs(value - round(value)) > 1e-6 * max(1.0, value):
        raise ValueError(message)
    return round(value)


def stable_substeps(task: AbstractTask, dt: float, duration: float = DURATION) -> int:
    """The power of two of sub-steps that brings max |eigenvalue| dt to at most 0.5; Heun diverges above 2."""
    fastest = fastest_rate(as_numbers(task), duration)
    needed = fastest * dt / MAX_RATE_STEP
    substeps = 2 ** max(0, math.ceil(math.log2(max(needed, 1.0))))
    if substeps > MAX_SUBSTEPS:
        raise ValueError(
            f"this task has an eigenvalue of {fastest:.3g}/s, which asks for {substeps} sub-steps of dt = {dt} s "
            f"(at most {MAX_SUBSTEPS}): use heavier masses, less damping or a smaller dt"
        )
    return substeps


def draw(noise: AbstractNoise, key: PRNGKeyArray, seeds: Int[Array, " seeds"], steps: int) -> Float[Array, "..."]:
    """Normals of every seed; seed i depends on nothing but the key and i. Few at a time, which stay in the cache."""
    return jax.lax.map(lambda i: noise.draw(jax.random.fold_in(key, i), steps), seeds, batch_size=DRAWN)


def paths(noise: AbstractNoise, key: PRNGKeyArray, seeds: Int[Array, " seeds"], grid: Grid) -> Realisation:
    """Noise paths of every seed, drawn as in `draw`."""

    def one(seed):
        return noise.realise(noise.draw(jax.random.fold_in(key, seed), grid.steps), grid.dt)

    return jax.lax.map(one, seeds, batch_size=DRAWN)


def respond(
    task: AbstractTask, path: Realisation, grid: Grid, sampling: str
) -> tuple[Float[Array, "samples states"], Float[Array, " samples"]]:
    """States and sampled output of one noise path."""
    if sampling == "instant":
        states = solve(task, path, grid)
        return states, observe(task, path, grid, states)
    fine = Grid(grid.dt, grid.steps, 1, grid.substeps, grid.reverse)
    states = solve(task, path, fine)
    output = observe(task, path, fine, states)
    mean = jnp.mean(0.5 * (output[1:] + output[:-1]).reshape(-1, grid.every), axis=1)
    return states[:: grid.every], jnp.concatenate([output[:1], mean])


@eqx.filter_jit
def _simulate_seeds(task, linear, key, seeds, grid, sampling):
    def one(path):
        beside = None if linear is None else respond(linear, path, grid, sampling)[1]
        return *respond(task, path, grid, sampling), beside

    return jax.vmap(one)(paths(task.noise, key, seeds, grid))


def _run(
    task: AbstractTask,
    key: PRNGKeyArray,
    seeds: Any,
    grid: Grid,
    sampling: str,
    rate: float,
    linear: LinearTask | None = None,
) -> Trajectory:
    states, output, beside = _simulate_seeds(as_arrays(task), as_arrays(linear), key, seeds, grid, sampling)
    return Trajectory(task, states, output, seeds, rate, grid.dt, grid.substeps, sampling, beside)


def _require_finite(found: Trajectory) -> None:
    if not _all_concrete(found.output):
        return
    bad = np.atleast_1d(found.seeds)[~np.atleast_1d(np.asarray(found.finite))]
    if bad.size:
        values = ", ".join(f"{name} = {float(value):.6g}" for name, value in as_numbers(found.task.parameters).items())
        shown = ", ".join(str(int(s)) for s in bad[:10]) + (f" and {len(bad) - 10} more" if len(bad) > 10 else "")
        raise SimulationError(
            f"{len(bad)} seed(s) did not stay finite ({shown}) in {type(found.task).__name__} at dt = {found.dt} s, "
            f"{found.substeps} sub-step(s): lower the noise amplitude or dt. Parameters: {values}"
        )
