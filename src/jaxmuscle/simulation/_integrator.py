"""The integrator: a task on a noise path of the step grid, and a sub-cycled Heun solver, for diffrax."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmuscle.model._activation import ACTIVE
from jaxmuscle.model._noise import Realisation
from jaxmuscle.model._parameters import INPUTS
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


class Forcing(eqx.Module):
    """The noise as the muscle gets it: columns of `values`, `slopes` and `increments` act on the inputs `acts_on`, one on
    all where it is shared.

    `scale` on each of them, None where it is in the columns already. The harmonic's part of the inputs is `rhythm` times the
    harmonic; with an activation that of the active tissue is in `values`.
    """

    values: Float[Array, "points columns"] | None
    slopes: Float[Array, "points columns"] | None
    increments: Float[Array, "steps columns"] | None
    scale: Float[Array, " acted"] | None
    rhythm: Float[Array, " inputs"]
    acts_on: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, task: AbstractTask, path: Realisation, grid: Grid) -> "Forcing":
        """Of a task on a unit path of its noise: scaled, summed and sent through the activation where there is more to do
        than to scale it in the loop."""
        base = task.harmonic_base()
        if path.parts is None and task.activation is None:
            return cls(path.values, path.slopes, path.increments, task.noise_scale(task.noise), base, task.noise.acts_on)
        paths, parts = (path,) if path.parts is None else path.parts, task.noise.components
        columns: dict[str, dict[int, list]] = {"values": {}, "slopes": {}, "increments": {}}
        for noise, own in zip(parts, paths, strict=True):
            scale = task.noise_scale(noise)
            for name, found in columns.items():
                given = getattr(own, name)
                if given is not None:
                    for j, i in enumerate(noise.acts_on):
                        found.setdefault(i, []).append(scale[j] * given[:, min(j, given.shape[1] - 1)])
        values, slopes, kicks = ({i: sum(found[1:], found[0]) for i, found in each.items()} for each in columns.values())
        if task.activation is not None:
            time = grid.dt * jnp.arange(grid.steps + 1, dtype=base.dtype)
            rhythm = jax.vmap(task.harmonic)(time)
            nothing = jnp.zeros(grid.steps)
            for i in ACTIVE:
                if i in (0, 2) or i in values or i in kicks:
                    whole = base[i] * rhythm + values.get(i, 0.0)
                    rough = kicks.pop(i, nothing) / grid.dt
                    a, b = task.activation.through((whole[:-1] + rough)[:, None], (whole[1:] + rough)[:, None], grid.dt)
                    values[i], slopes[i] = a[:, 0], b[:, 0]
            base = base.at[jnp.array(ACTIVE)].set(0.0)
        return cls(_table(values), _table(slopes), _table(kicks), None, base, tuple(range(len(INPUTS))))

    def inputs(self, rhythm: Float[Array, "times inputs"], noise: Array | None) -> tuple[Float[Array, " times"], ...]:
        """Every input: that of the harmonic plus that of noise with these columns."""
        return tuple(_plus(rhythm[:, i], self.column(noise, i)) for i in range(len(INPUTS)))

    def column(self, noise: Array | None, i: int) -> Float[Array, " times"] | None:
        """What of the noise acts on the i-th input."""
        if noise is None or i not in self.acts_on:
            return None
        j = self.acts_on.index(i)
        column = noise[:, min(j, noise.shape[1] - 1)]  # one for all if it is shared
        return column if self.scale is None else self.scale[j] * column


def _plus(a: Array, b: Array | None) -> Array:
    return a if b is None else a + b


def _table(columns: dict[int, Array]) -> Array | None:
    if not columns:
        return None
    nothing = jnp.zeros_like(next(iter(columns.values())))
    return jnp.stack([columns.get(i, nothing) for i in range(len(INPUTS))], axis=1)


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
    path: Forcing
    grid: Grid = eqx.field(static=True)

    def vf(self, t, y, args):
        task, time = self.task, t * self.grid.dt
        return self.grid.dt * task.vector_field(time, y, self.path.rhythm * task.harmonic(time))

    def contr(self, t0, t1, **kwargs):
        grid, path = self.grid, self.path
        parts, dtype = grid.substeps, jnp.result_type(t0)
        # diffrax rounds t0, a fraction of the run; step numbers must be whole to find their noise.
        first = jnp.clip(jnp.round(t0).astype(int), 0, grid.steps - grid.every)
        whole, part = np.divmod(np.arange(grid.every * parts + 1), parts)
        points = first.astype(dtype) + jnp.asarray(whole + part / parts, dtype)
        rhythm = jax.vmap(lambda t: path.rhythm * self.task.harmonic(t))(points * grid.dt)
        noise = None
        if path.values is not None:
            values = jax.lax.dynamic_slice_in_dim(path.values, first, grid.every + 1)
            noise = values[whole]
            if parts > 1:
                after = values[np.minimum(whole + 1, grid.every)]
                noise = noise + jnp.asarray(part / parts, dtype)[:, None] * (after - noise)
        u = path.inputs(rhythm, noise)
        increment = None
        if path.increments is not None:
            kicks = jax.lax.dynamic_slice_in_dim(path.increments, first, grid.every)[whole[:-1]]
            none = jnp.zeros(len(kicks), kicks.dtype)
            found = (path.column(kicks, i) for i in range(len(INPUTS)))
            increment = tuple(none if x is None else x / parts for x in found)
        return Interval(points[:-1], points[1:], tuple(x[:-1] for x in u), tuple(x[1:] for x in u), increment)

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


def solve(task: AbstractTask, path: Forcing, grid: Grid) -> Float[Array, "samples states"]:
    """States at every `every`-th grid point, the first included; what overflows is not finite, never an exception."""
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
    task: AbstractTask, path: Forcing, grid: Grid, states: Float[Array, "samples states"]
) -> Float[Array, " samples"]:
    """The task's output at the kept grid points."""
    kept = slice(None, None, grid.every)
    time = grid.dt * jnp.arange(0, grid.steps + 1, grid.every, dtype=states.dtype)
    harmonic = lambda t: path.rhythm * task.harmonic(t)  # noqa: E731
    rhythm, rhythm_slope = jax.vmap(lambda t: jax.jvp(harmonic, (t,), (jnp.ones_like(t),)))(time)
    u = jnp.stack(path.inputs(rhythm, None if path.values is None else path.values[kept]), axis=1)
    du = jnp.stack(path.inputs(rhythm_slope, None if path.slopes is None else path.slopes[kept]), axis=1)
    return jax.vmap(task.output)(time, states, u, du)
