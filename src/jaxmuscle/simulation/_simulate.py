"""Simulation of a task: the grid, the sub-steps that keep it stable, one seed."""

import math
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from jaxmuscle._common.arguments import count, positive
from jaxmuscle._common.arrays import all_concrete, as_arrays, as_numbers, is_concrete
from jaxmuscle._common.errors import OperatingPointError, SimulationError
from jaxmuscle._common.keys import key_of, seed_of
from jaxmuscle._common.programs import kept
from jaxmuscle._common.text import listed
from jaxmuscle._common.types import Key, Seed
from jaxmuscle.model._stream import Draws
from jaxmuscle.model._task import AbstractTask, require_task
from jaxmuscle.response._equilibrium import fastest_rate, without_settings
from jaxmuscle.response._linear_task import LinearTask
from jaxmuscle.response._linearised import check_equilibrium, check_inputs, linearised
from jaxmuscle.spectra._settings import WINDOW, Sampling, SpectrumSettings

from ._batch import Recipe, run_seeds
from ._grid import Grid, parts_for
from ._trajectory import Trajectory

MAX_RATE_STEP = 0.5
MAX_SUBSTEPS = 256
MOST_STEPS = 2**31 - 1
DURATION = 15.0
DT = 1e-3
TRANSIENT = 1e-3


def simulate(
    task: AbstractTask,
    key: Key,
    *,
    seed: Seed = 0,
    duration: float = DURATION,
    dt: float = DT,
    rate: float | None = None,
    substeps: int | None = None,
    sampling: str | None = None,
) -> Trajectory:
    """Simulate one seed of the task's equation y' = f(t, y, u), in which noise and harmonic are
    part of u.

        run = jm.simulate(jm.Isometric(k_w=4e5), jax.random.key(0), seed=3)
        run.plot()

    y is the state, u the perturbation (docs/model.md, *Where noise enters*). Coloured noise has a
    value in u at every instant. White noise adds `(∂f/∂u) σ ∘ dW`, in the sense of Stratonovich: W
    are standard Wiener processes, and σ is the noise's amplitude, in the unit of its coefficient,
    over the root of the `rate` of the noise.

    Heun's method at fixed steps in diffrax. Differentiable in both modes with respect to the task's
    parameters, of which `output` is a function. `duration`, `dt`, `rate`, `substeps` and `sampling`
    are static: they decide the shape of the program.

    **Arguments:**

    - `task`: what is simulated, as `jaxmuscle.Isometric()`
    - `key`: a `jax.random` key, or a whole number n for `jax.random.key(n)`; seed i draws from
      `fold_in(key, i)`
    - `seed`: number of the noise path; for several use `ensemble`, or `jax.vmap`
    - `duration` [s]
    - `dt` [s]: the grid on which noise is drawn, which must divide the sampling interval
    - `rate` [Hz] of the samples returned, the task's spectrum settings by default
    - `substeps` per dt: by default as many as stability asks for, a power of two, so that max
      |eigenvalue| dt / substeps <= 0.5. That number hangs on the parameters. Where JAX traces them
      (jit, grad, vmap of the task) it cannot be known, and one is taken: a stiff or strongly damped
      muscle then gives nan. Give the number that `simulate(task, key).substeps` has for the
      stiffest values that you will try
    - `sampling`: as in `SpectrumSettings` (the task's by default): "filtered" needs two steps of dt
      or more per sample, and the first and last 10 samples feel the ends; at a higher rate than
      that of the settings "instant" takes its place, as the spectrum is then low-passed when it is
      made

    **Returns:** a `Trajectory`: its `output` at its `time` [s], the `states`.

    **Raises:** `ValueError` for a grid that does not fit, `SimulationError` if the result is not
    finite (not under a JAX transformation, where it is returned as it is).
    """
    require_task(task, "simulate(task, key)")
    if np.ndim(seed) > 0:
        raise ValueError(
            f"seed = {seed!r}: one simulation has one seed. For several use"
            " jaxmuscle.ensemble(task, key, seeds=...), or jax.vmap over seed"
        )
    seeds = (
        jnp.asarray([seed_of(seed)], jnp.uint32)
        if all_concrete(seed)
        else jnp.atleast_1d(jnp.asarray(seed))
    )
    result = trajectories(
        task, None, key_of(key), seeds, schedule(task, duration, dt, rate, substeps, sampling)
    )[0]
    require_finite(result)
    return result


def companion(task: AbstractTask, duration: float, *, required: bool) -> LinearTask | None:
    """The linearised task, if its response is stationary in the analysed window; else None, or an
    error if required."""
    with jax.enable_x64(True):
        linear = linearised(task)
        try:
            slowest = check_equilibrium(
                task, np.asarray(linear.system.point), np.asarray(linear.system.A)
            )
            check_inputs(task)
        except OperatingPointError:
            if required:
                raise
            return None
        moved = np.abs(np.asarray(_start(as_arrays(task))) - np.asarray(linear.system.point))
    # A task that starts settled has nothing to forget.
    left = math.exp(-slowest * WINDOW[0]) if np.max(moved) > 1e-9 else 0.0
    if duration < WINDOW[1] or left > TRANSIENT:
        if required:
            raise ValueError(
                f"control = True: duration = {duration} s must reach {WINDOW[1]} s, and by"
                f" {WINDOW[0]} s the slowest motion must have decayed to {TRANSIENT:g} of its"
                f" start, but {left:.2g} is left: simulate task.settled()"
            )
        return None
    return linear


@kept
def _start(task: AbstractTask) -> Array:
    return task.initial_state()


class Schedule(NamedTuple):
    """On which grid a task is simulated and how it is sampled, at which rate [Hz]."""

    grid: Grid
    sampling: str
    rate: float


def schedule(
    task: AbstractTask,
    duration: float,
    dt: float,
    rate: float | None,
    substeps: int | None,
    sampling: str | None,
) -> Schedule:
    """The plan of a simulation. Raises `ValueError` for a grid that does not fit."""
    own = task.settings
    if sampling is None:  # a finer run is low-passed when its spectrum is made
        sampling = (
            "instant"
            if own.sampling == "filtered" and rate is not None and rate > own.rate
            else own.sampling
        )
    rate = own.rate if rate is None else rate
    if sampling not in get_args(Sampling):
        raise ValueError(f"sampling = {sampling!r} must be one of {', '.join(get_args(Sampling))}")
    for name, value in (("dt", dt), ("rate", rate), ("duration", duration), ("substeps", substeps)):
        if not is_concrete(value):
            raise ValueError(
                f"{name} is traced by JAX, and decides how many steps there are: close over it, or"
                " make it one of the static_argnames of jax.jit"
            )
        if name != "substeps":
            positive(name, value)
    if substeps is not None:
        count("substeps", substeps, 1, MAX_SUBSTEPS)
    if all_concrete(task):
        task.check_step(dt)
    every = steps_per_sample(rate, dt, sampling)
    samples = whole(
        float(duration) * rate,
        f"duration = {duration} s is not a whole number of sampling intervals {1 / rate} s",
    )
    if samples * every > MOST_STEPS:
        raise ValueError(
            f"duration = {duration} s at dt = {dt} s makes {samples * every} steps, at most"
            f" {MOST_STEPS} are possible: give a shorter duration or a larger dt"
        )
    if substeps is None:
        substeps = stable_substeps(task, dt, duration) if all_concrete(task) else 1
    return Schedule(
        Grid(dt, samples * every, every, substeps, reverse=not all_concrete(task)), sampling, rate
    )


def steps_per_sample(rate: float, dt: float, sampling: str) -> int:
    """Steps of dt in a sampling interval. Raises `ValueError` if dt does not divide it, or leaves
    nothing to be filtered."""
    least = max(math.ceil(1 / (rate * dt)), 1 + (sampling == "filtered"))
    # a larger dt may not do for the noise
    finer = sorted({least, *(n for n in (2, 4, 5, 10, 20, 50, 100) if n > least)})
    choices = f"{', '.join(f'{1 / rate / n:.9g}' for n in finer[:4])} s"
    apart = f"the sampling interval {1 / rate:.9g} s"
    every = whole(1 / (rate * dt), f"dt = {dt} s does not divide {apart}: use one of {choices}")
    if every == 1 and sampling == "filtered":
        raise ValueError(
            f"dt = {dt} s is a whole sampling interval, but sampling = 'filtered' needs points"
            " between the samples: use half of it or less, or sampling = 'instant'"
        )
    return every


def whole(value: float, message: str) -> int:
    """A number that must be whole (up to rounding) and positive, else a `ValueError` with the
    message."""
    if (
        not math.isfinite(value)
        or round(value) < 1
        or abs(value - round(value)) > 1e-6 * max(1.0, value)
    ):
        raise ValueError(message)
    return round(value)


def stable_substeps(task: AbstractTask, dt: float, duration: float = DURATION) -> int:
    """The power of two of sub-steps that brings max |eigenvalue| dt to at most 0.5; Heun diverges
    above 2."""
    fastest = fastest_rate(task, duration)
    substeps = parts_for(fastest, dt, MAX_RATE_STEP)
    if substeps > MAX_SUBSTEPS:
        raise ValueError(
            f"this task has an eigenvalue of {fastest:.3g}/s, which asks for {substeps} sub-steps"
            f" of dt = {dt} s (at most {MAX_SUBSTEPS}): use heavier masses, less damping or a"
            " smaller dt"
        )
    return substeps


def trajectories(
    task: AbstractTask,
    linear: LinearTask | None,
    key: PRNGKeyArray,
    seeds: Any,
    plan: Schedule,
    mesh: Any = None,
    draws: Draws = Draws(),  # noqa: B008
) -> Trajectory:
    """Every seed of one task in one program, finite or not; arrays stay where they were
    computed."""
    recipe = Recipe(plan.grid, plan.sampling, True, SpectrumSettings(), draws=draws)
    found = run_seeds(
        without_settings(task),
        None if linear is None else without_settings(linear),
        key,
        seeds,
        recipe,
        mesh,
    )
    grid = plan.grid
    return Trajectory(
        task,
        found["states"],
        found["output"],
        seeds,
        plan.rate,
        grid.dt,
        grid.substeps,
        plan.sampling,
        found["linear"],
    )


def require_finite(found: Trajectory, where: str = "") -> None:
    """Raises `SimulationError` for seeds that did not stay finite, as far as the values are
    known."""
    if not all_concrete(found.output):
        return
    bad = np.atleast_1d(found.seeds)[~np.atleast_1d(np.asarray(found.finite))]
    if bad.size:
        raise SimulationError(
            f"{len(bad)} seed(s) did not stay finite ({listed(bad)}) in"
            f" {type(found.task).__name__}{where} at dt = {found.dt} s, {found.substeps}"
            " sub-step(s): lower dt or the noise amplitude, or leave substeps out. Parameters:"
            f" {told(found.task)}"
        )


def told(task: AbstractTask) -> str:
    """Parameters with their values."""
    return ", ".join(
        f"{name} = {float(value):.6g}" for name, value in as_numbers(task.parameters).items()
    )
