"""The integrator: a Brownian path on the step grid and a sub-cycled Heun solver, for diffrax."""

import dataclasses
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._noise import Realisation
from ._signal import AbstractSignal, Constant, Tabulated
from ._task import AbstractTask


class Grid(eqx.Module):
    """Time steps of a simulation: `steps` of `dt` [s], every `every`-th kept, each integrated in `substeps` parts.

    The integration variable is the step number, which floating point represents exactly in either precision. `reverse`
    asks for a loop that reverse-mode differentiation can go through; the other is faster and has the forward mode only.
    """

    dt: float = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)
    reverse: bool = eqx.field(static=True, default=True)


class GridPath(dfx.AbstractBrownianPath):
    """Brownian motion given by its increments on the unit grid, linear in between (so sub-steps share one path)."""

    increments: Float[Array, "steps channels"]
    levy_area: ClassVar[Any] = dfx.BrownianIncrement

    @property
    def t0(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return 0

    @property
    def t1(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.increments.shape[0]

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        if t1 is None or use_levy:
            raise NotImplementedError("GridPath gives increments between two times of one step, without Lévy area")
        return self.increments[_whole(t0, self.t1 - 1)] * (t1 - t0)


class SubcycledHeun(dfx.AbstractStratonovichSolver):
    """Heun's method, `cycles` steps of size `size` in one solver step: second order in the drift.

    One diffrax step per saved sample keeps saving and reverse-mode checkpoints out of the inner loop.
    """

    cycles: int = eqx.field(static=True)
    size: float = eqx.field(static=True)
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
        def heun(y, start):
            stop = start + self.size
            control = terms.contr(start, stop)
            slope = terms.vf_prod(start, y, args, control)
            return y + 0.5 * (slope + terms.vf_prod(stop, y + slope, args, control)), None

        # Step numbers must be whole to find their noise, but diffrax rounds t0, a fraction of the interval; and XLA
        # rounds a product with `size`: so whole steps and parts of a step are counted in integers.
        dtype, parts = jnp.result_type(t0), round(1 / self.size)
        whole, part = jnp.divmod(jnp.arange(self.cycles), parts)
        starts = jnp.round(t0) + whole.astype(dtype) + part.astype(dtype) / parts
        y1, _ = jax.lax.scan(heun, y0, starts)
        return y1, None, {"y0": y0, "y1": y1}, None, dfx.RESULTS.successful


class GridTerm(dfx.AbstractTerm):
    """Drift and diffusion times increment, `f Δt + (∂f/∂u) scale ΔW`, from one linearisation of the vector field.

    What `MultiTerm(ODETerm, ControlTerm)` gives with two evaluations. Without a path it is the drift alone.
    """

    task: AbstractTask
    u: Any
    scale: Float[Array, "4"]
    path: GridPath | None
    dt: float = eqx.field(static=True)

    def vf(self, t, y, args):
        return self.dt * self.task.vector_field(t * self.dt, y, self.u(t))

    def contr(self, t0, t1, **kwargs):
        return t1 - t0, None if self.path is None else self.path.evaluate(t0, t1)

    def prod(self, vf, control):
        raise NotImplementedError("GridTerm offers vf_prod only")

    def vf_prod(self, t, y, args, control):
        steps, increment = control
        if increment is None:
            return steps * self.vf(t, y, args)
        field = lambda u: self.task.vector_field(t * self.dt, y, u)  # noqa: E731
        drift, diffusion = jax.jvp(field, (self.u(t),), (self.scale * increment,))
        return steps * self.dt * drift + diffusion


def _whole(s: Any, last: int) -> Any:
    return jnp.clip(jnp.floor(s).astype(int), 0, last)


def perturbation_at(task: AbstractTask, path: Realisation, grid: Grid) -> Any:
    """The perturbation u as a function of the step number: sampled noise (interpolated in sub-steps) and harmonic."""
    scale, harmonic = task.noise_scale(), _harmonic(task)

    def u(s):
        rhythm = harmonic(s * grid.dt)
        if path.values is None:
            return rhythm
        k = _whole(s, grid.steps)
        noise = path.values[k]
        if grid.substeps > 1:
            after = path.values[jnp.minimum(k + 1, grid.steps)]
            noise = noise + (s - k.astype(s.dtype)) * (after - noise)
        return scale * noise + rhythm

    return u


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
    brownian = None
    if path.increments is not None:
        brownian = GridPath(jnp.broadcast_to(path.increments, (grid.steps, 4)))
    task = tabulated(task, grid)
    solution = dfx.diffeqsolve(
        GridTerm(task, perturbation_at(task, path, grid), task.noise_scale(), brownian, grid.dt),
        SubcycledHeun(grid.every * grid.substeps, 1 / grid.substeps),
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
