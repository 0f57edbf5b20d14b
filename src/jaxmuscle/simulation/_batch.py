"""One chunk of an ensemble: the compiled program for some points and seeds, shared by the devices
of this process."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Integer, PRNGKeyArray

from jaxmuscle._common.environment import usable_cores
from jaxmuscle._common.programs import kept_simulation
from jaxmuscle.model._stream import Draws, Stream
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.spectra._decimation import at_every
from jaxmuscle.spectra._measures import coefficient_of_variation
from jaxmuscle.spectra._settings import SpectrumSettings
from jaxmuscle.spectra._welch import lowpass, welch

from ._grid import Grid

LANES = 1024
THREADED = ("cpu",)  # backends whose devices are cores
# In these versions of JAX an FFT waits for other threads of XLA's pool. If all of them wait, none
# goes on.
WAITING = ("0.11.1", "0.11.2")


class Recipe(eqx.Module):
    """What is computed of a seed: on which grid, sampled how, with states or not, Welch power and
    variation over `edges`.

    A device simulates at most `lanes` seeds side by side, what is more one block after the other.
    `every` is the ratio of the run's rate to the spectrum's; `edges` [samples] are None where no
    spectrum is asked for. `draws`: which random numbers.
    """

    grid: Grid
    sampling: str = eqx.field(static=True)
    states: bool = eqx.field(static=True)
    settings: SpectrumSettings
    lanes: int = eqx.field(static=True, default=LANES)
    every: int = eqx.field(static=True, default=1)
    edges: tuple[int, int] | None = eqx.field(static=True, default=None)
    draws: Draws = eqx.field(static=True, default=Draws())


def local_mesh() -> Mesh | None:
    """The GPUs of this process as one axis; None if there is one device. Cores of a CPU are shared
    by threads."""
    devices = jax.local_devices()
    return (
        Mesh(np.array(devices), ("lanes",))
        if len(devices) > 1 and jax.default_backend() not in THREADED
        else None
    )


def threads_of(wanted: int | None) -> int:
    """How many chunks run at the same time: one on each core of a CPU, or as many as wanted; two on
    other devices."""
    if jax.default_backend() not in THREADED:
        return 2
    threads = usable_cores() if wanted is None else wanted
    return min(threads, max(1, usable_cores() - 1)) if jax.__version__ in WAITING else threads


def _responses(task: AbstractTask, linear: Any, sources: Stream, recipe: Recipe) -> dict[str, Any]:
    """Of all seeds' random numbers along a leading axis."""
    from ._integrator import integrated  # and diffrax, which a program that is loaded does without

    tasks = (task,) if linear is None else (task, linear)
    states, outputs = integrated(tasks, sources, recipe.grid, recipe.sampling, states=recipe.states)
    finite = jnp.all(jnp.isfinite(outputs[0]), axis=1)
    if states is not None:
        finite &= jnp.all(jnp.isfinite(states), axis=(1, 2))
    found: dict[str, Any] = {
        "output": outputs[0],
        "finite": finite,
        "linear": None if linear is None else outputs[1],
        "states": states,
    }
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


@kept_simulation
def run_seeds(
    task: Any, linear: Any, key: Any, seeds: Any, recipe: Recipe, mesh: Mesh | None
) -> dict[str, Any]:
    """Output, finiteness and what else the recipe asks for, of one task and every seed."""

    def local(arrays, seeds):
        task, linear, key = eqx.combine(arrays, rest)

        def block(seeds):
            return _responses(task, linear, streams_of(key, seeds, recipe.draws), recipe)

        count = blocks(len(seeds), recipe.lanes)
        if count == 1 or len(seeds) % count:
            return block(seeds)
        found = jax.lax.map(block, seeds.reshape(count, -1))
        return jax.tree.map(lambda values: values.reshape(len(seeds), *values.shape[2:]), found)

    arrays, rest = eqx.partition((task, linear, key), eqx.is_array)
    return _shared(local, mesh, (P(), P("lanes")))(arrays, seeds)


@kept_simulation
def run_points(
    tasks: Any, linears: Any, key: Any, seeds: Any, recipe: Recipe, mesh: Mesh | None
) -> dict[str, Any]:
    """The same for every task along a leading axis of points; all of them get the same noise."""

    def local(moving, key, seeds):
        def one(moving):
            task, linear = eqx.combine(moving, rest)
            return _responses(task, linear, streams_of(key, seeds, recipe.draws), recipe)

        return jax.vmap(one)(moving)

    moving, rest = eqx.partition((tasks, linears), eqx.is_array)
    return _shared(local, mesh, (P("lanes"), P(), P()))(moving, key, seeds)


def streams_of(key: PRNGKeyArray, seeds: Integer[Array, " seeds"], draws: Draws) -> Stream:
    """Random numbers of every seed; those of seed i depend on nothing but the key and i."""
    return jax.vmap(lambda i: Stream.of(jax.random.fold_in(key, i), draws))(seeds)


def _shared(local: Any, mesh: Mesh | None, specs: tuple) -> Any:
    """Every device of the mesh does its part of the lanes, without talking to the others."""
    if mesh is None:
        return local
    return jax.shard_map(local, mesh=mesh, in_specs=specs, out_specs=P("lanes"), check_vma=False)
