"""One chunk of an ensemble: the compiled program for some points and seeds, shared by the devices of this process."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Int, PRNGKeyArray

from jaxmuscle._common.programs import kept
from jaxmuscle.model._noise import AbstractNoise, Realisation
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._decimation import at_every, decimated
from jaxmuscle.spectra._measures import coefficient_of_variation
from jaxmuscle.spectra._settings import SpectrumSettings
from jaxmuscle.spectra._welch import lowpass, welch

from ._grid import Grid

DRAWN = 8
LANES = 1024


class Recipe(eqx.Module):
    """What is computed of a seed: on which grid, sampled how, with states or not, Welch power and variation over `edges`.

    A device simulates at most `lanes` seeds side by side, what is more one block after the other. `every` is the ratio of
    the run's rate to the spectrum's; `edges` [samples] are None where no spectrum is asked for.
    """

    grid: Grid
    sampling: str = eqx.field(static=True)
    states: bool = eqx.field(static=True)
    settings: SpectrumSettings
    lanes: int = eqx.field(static=True, default=LANES)
    every: int = eqx.field(static=True, default=1)
    edges: tuple[int, int] | None = eqx.field(static=True, default=None)


def local_mesh() -> Mesh | None:
    """The devices of this process as one axis; None if there is one."""
    devices = jax.local_devices()
    return Mesh(np.array(devices), ("lanes",)) if len(devices) > 1 else None


def draw(noise: AbstractNoise, key: PRNGKeyArray, seeds: Int[Array, " seeds"], steps: int) -> Any:
    """Normals of every seed; seed i depends on nothing but the key and i. Few at a time, which stay in the cache."""
    return _drawn(noise, key, seeds, steps, lambda normals: normals)


def _drawn(noise: AbstractNoise, key: PRNGKeyArray, seeds: Int[Array, " seeds"], steps: int, use: Callable) -> Any:
    """What `use` makes of the normals of every seed."""
    return jax.lax.map(lambda i: use(noise.draw(jax.random.fold_in(key, i), steps)), seeds, batch_size=DRAWN)


def respond(task: AbstractTask, path: Realisation, grid: Grid, sampling: str) -> tuple[Array, Array]:
    """States (samples, states), at instants, and sampled output (samples) of one noise path."""
    from ._integrator import Forcing, observe, solve  # and diffrax, which a program that is loaded does without

    given = Forcing.of(task, path, grid)
    if sampling == "instant":
        states = solve(task, given, grid)
        return states, observe(task, given, grid, states)
    fine = Grid(grid.dt, grid.steps, 1, grid.substeps, grid.reverse)
    states = solve(task, given, fine)
    output = observe(task, given, fine, states)
    if sampling == "filtered":
        return states[:: grid.every], decimated(output, grid.every)
    mean = jnp.mean(0.5 * (output[1:] + output[:-1]).reshape(-1, grid.every), axis=1)
    return states[:: grid.every], jnp.concatenate([output[:1], mean])


def _responses(task: AbstractTask, linear: Any, path: Realisation, recipe: Recipe) -> dict[str, Any]:
    """Of all paths along a leading axis of seeds."""

    def one(path):
        states, output = respond(task, path, recipe.grid, recipe.sampling)
        finite = jnp.all(jnp.isfinite(output)) & jnp.all(jnp.isfinite(states))
        beside = None if linear is None else respond(linear, path, recipe.grid, recipe.sampling)[1]
        return {"output": output, "finite": finite, "linear": beside, "states": states if recipe.states else None}

    found = jax.vmap(one)(path)
    if recipe.edges is not None:
        found["power"], found["variation"] = _seen(found["output"], recipe)
        found["linear_power"] = None if linear is None else _seen(found["linear"], recipe)[0]
    return found


def _seen(output: Array, recipe: Recipe) -> tuple[Array, Array]:
    """Welch power and coefficient of variation of what the low-pass lets through."""
    assert recipe.edges is not None
    at_rate = at_every(output, recipe.every, recipe.settings.sampling)
    passed = lowpass(at_rate, recipe.settings)[:, slice(*recipe.edges)]
    return welch(passed, recipe.settings), coefficient_of_variation(passed)


def blocks(seeds: int, lanes: int) -> int:
    """How many blocks of at most `lanes` seeds that makes."""
    return -(-seeds // lanes)


@kept
def run_seeds(task: Any, linear: Any, key: Any, seeds: Any, recipe: Recipe, mesh: Mesh | None) -> dict[str, Any]:
    """Output, finiteness and what else the recipe asks for, of one task and every seed."""

    def local(arrays, seeds):
        task, linear, key = eqx.combine(arrays, rest)

        def block(seeds):
            grid = recipe.grid
            paths = _drawn(task.noise, key, seeds, grid.steps, lambda normals: task.noise.realise(normals, grid.dt))
            return _responses(task, linear, paths, recipe)

        count = blocks(len(seeds), recipe.lanes)
        if count == 1 or len(seeds) % count:
            return block(seeds)
        found = jax.lax.map(block, seeds.reshape(count, -1))
        return jax.tree.map(lambda values: values.reshape(len(seeds), *values.shape[2:]), found)

    arrays, rest = eqx.partition((task, linear, key), eqx.is_array)
    return _shared(local, mesh, (P(), P("lanes")))(arrays, seeds)


@kept
def run_points(tasks: Any, linears: Any, key: Any, seeds: Any, recipe: Recipe, mesh: Mesh | None) -> dict[str, Any]:
    """The same for every task along a leading axis of points; all of them get the same normals."""

    def local(moving, key, seeds):
        def one(moving):
            task, linear = eqx.combine(moving, rest)
            return _responses(task, linear, jax.vmap(lambda z: task.noise.realise(z, recipe.grid.dt))(normals), recipe)

        normals = draw(eqx.combine(jax.tree.map(lambda x: x[0], moving), rest)[0].noise, key, seeds, recipe.grid.steps)
        return jax.vmap(one)(moving)

    moving, rest = eqx.partition((tasks, linears), eqx.is_array)
    return _shared(local, mesh, (P("lanes"), P(), P()))(moving, key, seeds)


def _shared(local: Any, mesh: Mesh | None, specs: tuple) -> Any:
    """Every device of the mesh does its part of the lanes, without talking to the others."""
    if mesh is None:
        return local
    return jax.shard_map(local, mesh=mesh, in_specs=specs, out_specs=P("lanes"), check_vma=False)
