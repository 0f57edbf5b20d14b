"""The integrator: tasks on one noise path of the step grid, and a sub-cycled Heun solver, for
diffrax."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle._common.programs import in_one_piece
from jaxmuscle._common.types import Scalar
from jaxmuscle.model._signals import AbstractSignal, Constant, Tabulated
from jaxmuscle.model._stream import Stream
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._decimation import decimated

from ._grid import Grid
from ._perturbation import Perturbation


class Moving(NamedTuple):
    """The state of the equation: those of every task and of what perturbs them, a vector along the
    seeds each.

    So they stay in a cache. `seen`: every task's output after every step of the last interval,
    where it is not sampled at instants.
    """

    tasks: tuple[tuple[Array, ...], ...]
    perturbation: Any
    seen: tuple[Array, ...]


class SubcycledHeun(dfx.AbstractStratonovichSolver):
    """Heun's method, all steps of a `GridTerm`'s interval in one solver step: second order in the
    drift.

    One diffrax step per saved sample keeps saving and reverse-mode checkpoints out of the inner
    loop.
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
        return terms.vf(t0, y0, args)  # diffrax asks for its shape only

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        y1 = terms.vf_prod(t0, y0, args, terms.contr(t0, t1))
        return y1, None, {"y0": y0, "y1": y1}, None, dfx.RESULTS.successful


class GridTerm(dfx.AbstractTerm):
    """Tasks on the same perturbation, a step after the other: `dy = f(t, y, u) dt + (∂f/∂u) dW`, u
    by its own recursion.

    The noise filters and the activation are linear, and advanced exactly. Its control is the number
    of an interval's first step. Sub-steps share the noise of their step: u is interpolated, dW
    divided. The steps take the tasks with their inputs `looked_up` in tables, the outputs the tasks
    themselves, since they may need higher derivatives.

    Many seeds at once, what is `own` to each along a leading axis: an interval is mapped over the
    seeds. Were the whole solution mapped, JAX would trace every loop in it anew for the mapping:
    more than half of all operations traced.
    """

    tasks: tuple[AbstractTask, ...]
    looked_up: tuple[AbstractTask, ...]
    own: Perturbation
    shared: Perturbation
    grid: Grid = eqx.field(static=True)
    instants: bool = eqx.field(static=True)

    def vf(self, t, y, args):
        return y  # diffrax asks for its shape only

    def prod(self, vf, control):
        raise NotImplementedError("GridTerm moves whole intervals")

    def _mapped(self, function, *each):
        """A function of a seed's perturbation and of what else has an axis of seeds."""
        return jax.vmap(lambda own, *rest: function(eqx.combine(own, self.shared), *rest))(
            self.own, *each
        )

    def contr(self, t0, t1, **kwargs):
        # step numbers must be whole to find their noise
        number = jnp.round(t0).astype(jnp.int32) + self.grid.steps
        return jnp.clip(number, 0, self.grid.steps - self.grid.every)

    def start(self) -> Moving:
        """The state at t = 0."""
        states = tuple(tuple(task.initial_state()) for task in self.tasks)
        none = jnp.zeros(self.grid.every, jnp.result_type(float))

        def one(perturbation):
            return Moving(
                states, perturbation.start(), () if self.instants else (none,) * len(self.tasks)
            )

        return self._mapped(one)

    @eqx.filter_jit  # diffrax asks several times, and so it is traced once
    def vf_prod(self, t, y, args, control):
        """The state after an interval, not its change: what is advanced exactly has no need of a
        difference."""

        def one(perturbation, y):
            def step(state, given):
                state = self._step(perturbation, *state, *given)
                number = (given[0] + 1).astype(state[0][0][0].dtype)
                return state, (
                    () if self.instants else self._outputs(perturbation, Moving(*state, ()), number)
                )

            numbers = control + jnp.arange(self.grid.every, dtype=jnp.int32)
            made = perturbation.ahead(control, self.grid.every)
            (tasks, path), seen = jax.lax.scan(step, (y.tasks, y.perturbation), (numbers, made))
            return Moving(tasks, path, seen)

        return self._mapped(one, y)

    def _harmonic(self, step: Scalar) -> Array:
        return self.looked_up[0].harmonic(step * self.grid.dt)

    def _step(
        self, perturbation: Perturbation, tasks: tuple, path: Any, number: Array, made: Any
    ) -> tuple[tuple, Any]:
        parts, begun = self.grid.substeps, number.astype(tasks[0][0].dtype)
        wave, later = self._harmonic(begun), self._harmonic(begun + 1)
        after, kicks = perturbation.advance(path, made, wave, later)
        if parts == 1:
            u = perturbation.inputs(path, wave), perturbation.inputs(after, later)
            return (
                tuple(
                    self._heun(task, y, begun, *u, kicks)
                    for task, y in zip(self.looked_up, tasks, strict=True)
                ),
                after,
            )
        noise, noise_later = (
            perturbation.inputs(state, jnp.zeros_like(wave)) for state in (path, after)
        )
        parted = [None if kick is None else kick / parts for kick in kicks]

        def inputs(share: Array) -> list[Array]:
            still = self._harmonic(begun + share)
            found = [a + share * (b - a) for a, b in zip(noise, noise_later, strict=True)]
            return [
                x if i in perturbation.passing else x + perturbation.base[i] * still
                for i, x in enumerate(found)
            ]

        def part(tasks, i):
            share = i / parts
            u = inputs(share), inputs(share + 1 / parts)
            each = zip(self.looked_up, tasks, strict=True)
            return tuple(self._heun(task, y, begun + share, *u, parted) for task, y in each), None

        return jax.lax.scan(part, tasks, jnp.arange(parts, dtype=begun.dtype))[0], after

    def _heun(
        self, task: AbstractTask, y: tuple, at: Array, u: list, later: list, kicks: list
    ) -> tuple[Array, ...]:
        size = self.grid.dt / self.grid.substeps
        nothing = jnp.zeros_like(y[0])
        dW = (
            None
            if all(kick is None for kick in kicks)
            else jnp.stack([nothing if k is None else k for k in kicks])
        )

        def change(t, y, u):
            field = lambda u: task.vector_field(t * self.grid.dt, jnp.stack(y), u)  # noqa: E731
            if dW is None:
                return [size * slope for slope in field(jnp.stack(u))]
            drift, diffusion = jax.jvp(field, (jnp.stack(u),), (dW,))
            return [size * a + b for a, b in zip(drift, diffusion, strict=True)]

        first = change(at, y, u)
        second = change(
            at + 1 / self.grid.substeps, [a + b for a, b in zip(y, first, strict=True)], later
        )
        return tuple(a + 0.5 * (b + c) for a, b, c in zip(y, first, second, strict=True))

    @eqx.filter_jit
    def outputs(self, y: Moving, number: Array) -> tuple[Array, ...]:
        """Every task's output at a grid point."""
        return self._mapped(lambda perturbation, y: self._outputs(perturbation, y, number), y)

    def _outputs(self, perturbation: Perturbation, y: Moving, number: Array) -> tuple[Array, ...]:
        t = number * self.grid.dt
        wave, slope = jax.jvp(self.tasks[0].harmonic, (t,), (jnp.ones_like(t),))
        u = jnp.stack(perturbation.inputs(y.perturbation, wave))
        du = jnp.stack(perturbation.slopes(y.perturbation, slope))
        return tuple(
            task.output(t, jnp.stack(state), u, du)
            for task, state in zip(self.tasks, y.tasks, strict=True)
        )


def tabulated(task: AbstractTask, grid: Grid) -> AbstractTask:
    """The task with its harmonic and inputs looked up on the grid of sub-steps.

    They are the same for every seed, but inside the loop they would be computed for each state of
    each seed. Not for the reverse mode, which would carry a gradient of the whole table through
    every step.
    """
    if grid.reverse:
        return task
    interval, points = grid.dt / grid.substeps, grid.steps * grid.substeps + 1
    names = [
        f.name
        for f in dataclasses.fields(task)
        if isinstance(getattr(task, f.name), AbstractSignal)
    ]
    names = [name for name in names if not isinstance(getattr(task, name), Constant)]
    parts = [
        Tabulated.of(signal, interval, points)
        for signal in (*(getattr(task, n) for n in names), task.harmonic)
    ]
    return eqx.tree_at(lambda t: [*(getattr(t, n) for n in names), t.harmonic], task, parts)


class Response(NamedTuple):
    """Of noise paths: the first task's states at the samples (None if not asked for), and every
    task's output."""

    states: Float[Array, "seeds samples states"] | None
    outputs: tuple[Float[Array, "seeds samples"], ...]


def integrated(
    tasks: tuple[AbstractTask, ...],
    streams: Stream,
    grid: Grid,
    sampling: str,
    *,
    states: bool,
    loud: Float[Array, " seeds"] | None = None,
) -> Response:
    """Tasks that share a perturbation (a task and its linearisation), on the seeds' random numbers.

    `streams` have a leading axis of seeds; `loud` multiplies the noise of each. What overflows is
    not finite, never an exception.
    """
    instants = sampling == "instant"
    looked_up = (tabulated(tasks[0], grid), *tasks[1:])
    own, shared = Perturbation.of(tasks[0], streams, grid.dt).apart(loud)
    term = GridTerm(tasks, looked_up, own, shared, grid, instants)
    begun = term.start()

    def kept(number: Array, y: Moving, args: None) -> dict[str, tuple]:
        number = jnp.round(number) + grid.steps
        seen = {"seen": term.outputs(y, number) if instants else y.seen}
        return seen | ({"states": y.tasks[0]} if states else {})  # diffrax takes no empty tuple

    # Time counts the steps that are left: diffrax joins a last step to one that ends within a
    # hundred units in the last place of its end, and of 131 200 in single precision these are two.
    solved = in_one_piece(
        lambda: (
            dfx.diffeqsolve(
                term,
                SubcycledHeun(),
                t0=-float(grid.steps),
                t1=0.0,
                dt0=float(grid.every),
                y0=begun,
                stepsize_controller=dfx.ConstantStepSize(),
                saveat=dfx.SaveAt(t0=True, steps=1, fn=kept),
                max_steps=grid.steps // grid.every,
                adjoint=dfx.DirectAdjoint() if grid.reverse else dfx.ForwardMode(),
                throw=False,
            ).ys
        )
    )
    found = jax.tree.map(
        lambda rows: jnp.moveaxis(rows[: grid.steps // grid.every + 1], 0, 1), solved
    )
    seen, path = found["seen"], jnp.stack(found["states"], axis=2) if states else None
    if instants:
        return Response(path, seen)
    started = term.outputs(begun, jnp.zeros((), begun.tasks[0][0].dtype))
    sampled = jax.vmap(lambda start, rows: _sampled(start, rows[1:], grid, sampling))
    return Response(
        path, tuple(sampled(one, rows) for one, rows in zip(started, seen, strict=True))
    )


def _sampled(
    start: Array, seen: Float[Array, "intervals every"], grid: Grid, sampling: str
) -> Float[Array, " samples"]:
    """Samples of the output at all grid points: their mean over each sampling interval, or
    low-passed."""
    fine = jnp.concatenate([start[None], seen.ravel()])
    if sampling == "filtered":
        return decimated(fine, grid.every)
    mean = jnp.mean(0.5 * (fine[1:] + fine[:-1]).reshape(-1, grid.every), axis=1)
    return jnp.concatenate([fine[:1], mean])
