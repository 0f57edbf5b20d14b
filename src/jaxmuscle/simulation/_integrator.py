"""The integrator: a task on a noise path of the step grid, and a sub-cycled Heun solver, for diffrax."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle.model._noise import Realisation
from jaxmuscle.model._signals import AbstractSignal, Constant, Tabulated
from jaxmuscle.model._tasks import AbstractTask

from ._grid import Grid


class Interval(NamedTuple):
    """What drives the steps of one interval: an array over its steps for every coefficient.

    Where a step starts and stops, in grid steps; the perturbation (harmonic and sampled noise) at either time; and the
    increment of white noise in the coefficients' own units, or None.
    """

    start: Float[Array, " cycles"]
    stop: Float[Array, " cycles"]
    before: tuple[Float[Array, " cycles"], ...]
    after: tuple[Float[Array, " cycles"], ...]
    increment: tuple[Float[Array, " cycles"], ...] | None


class SubcycledHeun(dfx.AbstractStratonovichSolver):
    """Heun's method, all steps of a `GridTerm`'s interval in one solver step: second order in the drift.

    One diffrax step per saved sample keeps saving, the search for the noise and reverse-mode checkpoints out of the inner
    loop. That carries an array for each state, which under `vmap` is one vector along the seeds.
    """

    term_structure: ClassVar[Any] = dfx.AbstractTerm
    interpolation_cls: ClassVar[Any] = dfx.LocalLinearInterpolation

    def order(self, terms):
        return 2

    def strong_order(self, terms):
        return 0.5

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        def heun(y, part):
            slope = terms.vf_prod(part.start, y, args, (part.before, part.increment))
            moved = tuple(a + b for a, b in zip(y, slope, strict=True))
            again = terms.vf_prod(part.stop, moved, args, (part.after, part.increment))
            return tuple(a + 0.5 * (b + c) for a, b, c in zip(y, slope, again, strict=True)), None

        states, _ = jax.lax.scan(heun, tuple(y0), terms.contr(t0, t1))
        y1 = jnp.stack(states)
        return y1, None, {"y0": y0, "y1": y1}, None, dfx.RESULTS.successful


class GridTerm(dfx.AbstractTerm):
    """Drift and diffusion times increment of a task on a noise path, `f Δt + (∂f/∂u) scale ΔW`, by one linearisation.

    What `MultiTerm(ODETerm, ControlTerm)` gives with two evaluations. Its control is the `Interval` of `every` grid steps
    from t0 on, cut into sub-steps, which share the noise of their step: values are interpolated, increments divided.
    """

    task: AbstractTask
    path: Realisation
    grid: Grid = eqx.field(static=True)

    def vf(self, t, y, args):
        task, time = self.task, t * self.grid.dt
        return self.grid.dt * task.vector_field(time, y, _harmonic(task)(time))

    def contr(self, t0, t1, **kwargs):
        grid, scale = self.grid, self.task.noise_scale()
        parts, dtype = grid.substeps, jnp.result_type(t0)
        # diffrax rounds t0, a fraction of the run; step numbers must be whole to find their noise.
        first = jnp.clip(jnp.round(t0).astype(int), 0, grid.steps - grid.every)
        whole, part = np.divmod(np.arange(grid.every * parts + 1), parts)
        points = first.astype(dtype) + jnp.asarray(whole + part / parts, dtype)
        u = jax.vmap(_harmonic(self.task))(points * grid.dt)
        if self.path.values is not None:
            values = jax.lax.dynamic_slice_in_dim(self.path.values, first, grid.every + 1)
            noise = values[whole]
            if parts > 1:
                after = values[np.minimum(whole + 1, grid.every)]
                noise = noise + jnp.asarray(part / parts, dtype)[:, None] * (after - noise)
            u = u + scale * noise
        increment = None
        if self.path.increments is not None:
            kicks = jax.lax.dynamic_slice_in_dim(self.path.increments, first, grid.every)
            increment = _columns(scale / parts * kicks[whole[:-1]])
        return Interval(points[:-1], points[1:], _columns(u[:-1]), _columns(u[1:]), increment)

    def prod(self, vf, control):
        raise NotImplementedError("GridTerm offers vf_prod only")

    def vf_prod(self, t, y, args, control):
        u, increment = control
        y, size = jnp.stack(y), self.grid.dt / self.grid.substeps
        field = lambda u: self.task.vector_field(t * self.grid.dt, y, u)  # noqa: E731
        if increment is None:
            return tuple(size * slope for slope in field(jnp.stack(u)))
        drift, diffusion = jax.jvp(field, (jnp.stack(u),), (jnp.stack(increment),))
        return tuple(size * a + b for a, b in zip(drift, diffusion, strict=True))


def _columns(rows: Float[Array, "cycles coefficients"]) -> tuple[Float[Array, " cycles"], ...]:
    return tuple(rows[:, i] for i in range(rows.shape[1]))


def _harmonic(task: AbstractTask) -> Any:
    base = task.harmonic_base()
    return lambda t: base * task.harmonic(t)


def tabulated(task: AbstractTask, grid: Grid) -> AbstractTask:
    """The task with its harmonic and inputs looked up on the grid of sub-steps.

    They are the same for every seed, but inside the loop they would be computed for each state of each seed. Not for the
    reverse mode, which would carry a gradient of the whole table through every step.
    """
    if grid.reverse:
        return task
    interval, points = grid.dt / grid.substeps, grid.steps * grid.substeps + 1
    names = [f.name for f in dataclasses.fields(task) if isinstance(getattr(task, f.name), AbstractSignal)]
    names = [name for name in names if not isinstance(getattr(task, name), Constant)]
    parts = [Tabulated.of(signal, interval, points) for signal in (*(getattr(task, n) for n in names), task.harmonic)]
    return eqx.tree_at(lambda t: [*(getattr(t, n) for n in names), t.harmonic], task, parts)


def solve(task: AbstractTask, path: Realisation, grid: Grid) -> Float[Array, "samples states"]:
    """States at every `every`-th grid point, the first included; what overflows is not finite, never an exception."""
    if path.increments is not None:
        path = Realisation(increments=jnp.broadcast_to(path.increments, (grid.steps, 4)))
    solution = dfx.diffeqsolve(
        GridTerm(tabulated(task, grid), path, grid),
        SubcycledHeun(),
        t0=0.0,
        t1=float(grid.steps),
        dt0=float(grid.every),
        y0=task.initial_state(),
        stepsize_controller=dfx.ConstantStepSize(),
        saveat=dfx.SaveAt(t0=True, steps=1),
        max_steps=grid.steps // grid.every,
        adjoint=dfx.DirectAdjoint() if grid.reverse else dfx.ForwardMode(),
        throw=False,
    )
    states: Any = solution.ys
    return states[: grid.steps // grid.every + 1]


def observe(
    task: AbstractTask, path: Realisation, grid: Grid, states: Float[Array, "samples states"]
) -> Float[Array, " samples"]:
    """The task's output at the kept grid points."""
    kept = slice(None, None, grid.every)
    time = grid.dt * jnp.arange(0, grid.steps + 1, grid.every, dtype=states.dtype)
    rhythm, rhythm_slope = jax.vmap(lambda t: jax.jvp(_harmonic(task), (t,), (jnp.ones_like(t),)))(time)
    scale = task.noise_scale()
    u = rhythm if path.values is None else rhythm + scale * path.values[kept]
    du = rhythm_slope if path.slopes is None else rhythm_slope + scale * path.slopes[kept]
    return jax.vmap(task.output)(time, states, u, du)
