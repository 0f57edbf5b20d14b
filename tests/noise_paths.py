"""Noise paths that a test knows: their normals, what the noise's own recursion makes of them, and
the same path on a coarser grid."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle.model._stream import APART, START, Stream
from jaxmuscle.simulation._integrator import integrated

Normals = tuple[Float[Array, "points numbers"], ...]


class Given(Stream):
    """A stream whose numbers are given, those of every noise of a sum: a row that begins it, and
    one for each step."""

    rows: Normals

    def ahead(self, steps, first, count):
        return tuple(rows[steps + 1] for rows in self.rows)

    def numbers(self, made, part, first, count):
        return tuple(made[part])

    def normals(self, step, first, count):
        assert step is START
        return tuple(self.rows[first // APART][0])


def draw_normals(noise, key, steps) -> Normals:
    """What a simulation draws for a seed, whose key this is: of every noise of a sum (steps + 1,
    numbers of a step times channels). White noise makes nothing of the first row."""
    stream, found = Stream.of(key), []
    for i, part in enumerate(noise.components):
        count = part.recursion(1e-3).numbers * part.channels
        begin = jnp.stack(stream.normals(START, i * APART, count))
        later = jnp.stack(stream.normals(jnp.arange(steps), i * APART, count), axis=1)
        found.append(jnp.concatenate([begin[None], later]))
    return tuple(found)


class Path(NamedTuple):
    """A unit path: `values` and `slopes` at the grid points, or `increments` of white noise between
    them; the `states` behind them, each (points, channels)."""

    values: Array | None
    slopes: Array | None
    increments: Array | None
    states: tuple[Array, ...]


def unit_path(noise, rows, dt) -> Path:
    """What a noise, no sum, makes of its normals on a grid of step dt [s]."""
    made = jax.tree.map(lambda x: jnp.asarray(x, rows.dtype), noise.recursion(dt))
    rows = rows.reshape(len(rows), made.numbers, -1)  # of every channel
    if made.direct is not None:
        return Path(None, None, made.direct * rows[1:, 0], ())
    begun = made.start(tuple(rows[0]))
    later = jax.lax.scan(lambda q, z: (made.advance(q, tuple(z)),) * 2, begun, rows[1:])[1]
    states = tuple(jnp.concatenate([a[None], b]) for a, b in zip(begun, later, strict=True))
    return Path(made.value(states), made.slope(states), None, states)


def draw_path(noise, key, steps, dt) -> Path:
    """The unit path of a seed."""
    (rows,) = draw_normals(noise, key, steps)
    return unit_path(noise, rows, dt)


def coarsen(noise, normals: Normals, dt, factor) -> Normals:
    """Normals that make the same path on a grid of `factor` times the step dt [s]."""
    return tuple(
        _coarsen(part, rows, dt, factor)
        for part, rows in zip(noise.components, normals, strict=True)
    )


def _coarsen(part, rows, dt, factor):
    made = part.recursion(factor * dt)
    if made.direct is not None:
        sums = rows[1:].reshape(-1, factor, rows.shape[1]).sum(axis=1)
        return jnp.concatenate([rows[:1], sums / factor**0.5])
    A, L = (
        jnp.array([[0.0 if x is None else x for x in row] for row in matrix])
        for matrix in (made.A, made.L)
    )
    q = jnp.stack(unit_path(part, rows, dt).states, axis=1)[::factor]
    z = jnp.linalg.solve(L, q[1:] - A @ q[:-1])
    return jnp.concatenate([q[:1], z]).reshape(len(q), -1)


def respond(task, normals: Normals, grid, sampling="instant"):
    """States (samples, states) and output (samples,) of a task on given normals."""
    known = Stream.of(jax.random.key(0))
    given = Given(known.key, known.words, known.draws, normals)
    one = jax.tree.map(lambda x: x[None], given)
    found = integrated((task,), one, grid, sampling, states=True)
    assert found.states is not None
    return found.states[0], found.outputs[0][0]
