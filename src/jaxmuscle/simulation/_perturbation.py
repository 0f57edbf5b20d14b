"""What perturbs a task on the step grid: a noise path, drawn as it is needed or given, the
harmonic, the activation."""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle.model._activation import ACTIVE, Transition
from jaxmuscle.model._noise import AbstractNoise, Realisation, Recursion
from jaxmuscle.model._parameters import INPUTS
from jaxmuscle.model._stream import APART, START, Stream
from jaxmuscle.model._tasks import AbstractTask

# of every noise of a sum: an array for every channel, or none
Columns = tuple[tuple[Array, ...], ...]


class Drawn(eqx.Module):
    """A path that is drawn and filtered while a task is integrated: nothing of it is stored.

    Its state has the states of every channel's recursion, a number each.
    """

    stream: Stream
    recursions: tuple[Recursion, ...]
    channels: tuple[int, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, noise: AbstractNoise, stream: Stream, dt: float) -> "Drawn":
        """That of a seed's random numbers on a grid of step dt [s]."""
        parts = noise.components
        return cls(
            stream,
            tuple(part.recursion(dt) for part in parts),
            tuple(part.channels for part in parts),
        )

    @property
    def _counts(self) -> tuple[int, ...]:
        return tuple(
            made.numbers * n for made, n in zip(self.recursions, self.channels, strict=True)
        )

    def start(self) -> Any:
        """The state at t = 0."""
        drawn = (
            self.stream.normals(START, i * APART, count) for i, count in enumerate(self._counts)
        )
        return tuple(
            tuple(made.start(z[c::n]) for c in range(n))
            for made, n, z in zip(self.recursions, self.channels, drawn, strict=True)
        )

    def ahead(self, first: Array, steps: int) -> Any:
        """What is made for some steps at once, with a leading axis of steps."""
        firsts = tuple(i * APART for i in range(len(self._counts)))
        return self.stream.ahead(first + jnp.arange(steps, dtype=first.dtype), firsts, self._counts)

    def advance(self, state: Any, made: Any) -> tuple[Any, Columns]:
        """The state after a step, of what `ahead` has made for it, and the increments of white
        noise in it."""
        later, kicks = [], []
        for i, (own, n, count) in enumerate(
            zip(self.recursions, self.channels, self._counts, strict=True)
        ):
            z = self.stream.numbers(made, i, i * APART, count)
            later.append(tuple(own.advance(state[i][c], z[c::n]) for c in range(n)))
            kicks.append(() if own.direct is None else tuple(own.direct * z[c] for c in range(n)))
        return tuple(later), tuple(kicks)

    def values(self, state: Any) -> Columns:
        """Unit noise of every channel."""
        return tuple(tuple(made.value(q) for q in each if q) for made, each in self._each(state))

    def slopes(self, state: Any) -> Columns:
        """Its time derivatives."""
        return tuple(
            tuple(made.slope(q) for q in each if made.S) for made, each in self._each(state)
        )  # pyright: ignore[reportReturnType]

    def _each(self, state: Any) -> Iterable[tuple[Recursion, Any]]:
        return zip(self.recursions, state, strict=True)


class Given(eqx.Module):
    """A path that is known at all grid points. Its state are values and slopes of now, an array
    each."""

    parts: tuple[Realisation, ...]

    @classmethod
    def of(cls, path: Realisation) -> "Given":
        """That of a unit path, or of the paths of a sum."""
        return cls((path,) if path.parts is None else path.parts)

    def start(self) -> Any:
        """The state at t = 0."""
        return tuple((_row(part.values, 0), _row(part.slopes, 0)) for part in self.parts)

    def ahead(self, first: Array, steps: int) -> Any:
        """The rows of some steps."""
        return tuple(
            (
                _rows(part.values, first + 1, steps),
                _rows(part.slopes, first + 1, steps),
                _rows(part.increments, first, steps),
            )
            for part in self.parts
        )

    def advance(self, state: Any, made: Any) -> tuple[Any, Columns]:
        """The state after a step and the increments in it."""
        return tuple((values, slopes) for values, slopes, _ in made), tuple(
            kicks for _, _, kicks in made
        )

    def values(self, state: Any) -> Columns:
        """Unit noise of every channel."""
        return tuple(values for values, _ in state)

    def slopes(self, state: Any) -> Columns:
        """Its time derivatives."""
        return tuple(slopes for _, slopes in state)


def _row(table: Array | None, i: int) -> tuple[Array, ...]:
    return () if table is None else tuple(table[i])


def _rows(table: Array | None, first: Array, count: int) -> tuple[Array, ...]:
    return () if table is None else tuple(jax.lax.dynamic_slice_in_dim(table, first, count).T)


class Perturbation(eqx.Module):
    """The inputs u of a task: noise and harmonic, those of the active tissue through the activation
    if there is one.

    `scale` of every noise on the inputs that it acts on; `base`, what the harmonic is a fraction
    of. Its state is that of the path and, of every input that passes the activation, the pair of
    the activation's states.
    """

    path: Drawn | Given
    scale: tuple[Float[Array, "..."], ...]
    base: Float[Array, " inputs"]
    transition: Transition | None
    rate: Array | None  # 1 / contraction time
    acts_on: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    passing: tuple[int, ...] = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    @classmethod
    def of(cls, task: AbstractTask, source: Stream | Realisation, dt: float) -> "Perturbation":
        """Of a task on the random numbers of a seed, or on a unit path of its noise; of one seed or
        of all, see `apart`."""
        parts = task.noise.components
        path = Drawn.of(task.noise, source, dt) if isinstance(source, Stream) else Given.of(source)
        acts_on, activation = tuple(part.acts_on for part in parts), task.activation
        acted = {i for each in acts_on for i in each} | {0}  # the harmonic acts on K_w
        passing = () if activation is None else tuple(i for i in ACTIVE if i in acted)
        transition = None if activation is None else activation.transition(dt)
        rate = None if activation is None else 1 / jnp.asarray(activation.time)
        scale = tuple(task.noise_scale(part) for part in parts)
        return cls(path, scale, task.harmonic_base(), transition, rate, acts_on, passing, dt)

    def apart(self, loud: Float[Array, " seeds"] | None) -> tuple["Perturbation", "Perturbation"]:
        """What each seed has of its own, along a leading axis, and what all share; `loud`
        multiplies the noise of each.

        `equinox.combine` of both is the perturbation of a seed.
        """
        mine = jax.tree.map(lambda _: False, self)
        mine = eqx.tree_at(
            lambda p: p.path.stream if isinstance(p.path, Drawn) else p.path.parts, mine, True
        )
        if loud is None:
            return eqx.partition(self, mine)
        scale = tuple(own * jnp.expand_dims(loud, range(1, 1 + own.ndim)) for own in self.scale)
        changed = eqx.tree_at(lambda p: p.scale, self, scale)
        return eqx.partition(changed, eqx.tree_at(lambda p: p.scale, mine, True))

    def start(self) -> tuple[Any, Any]:
        """Its state at t = 0, with the activation at rest."""
        rest = jnp.zeros((), jnp.result_type(float))
        return self.path.start(), tuple((rest, rest) for _ in self.passing)

    def advance(
        self, state: tuple[Any, Any], made: Any, before: Array, after: Array
    ) -> tuple[tuple, list[Array | None]]:
        """The state after a step in which the harmonic runs from `before` to `after`, and the white
        noise of the inputs."""
        path, kicks = self.path.advance(state[0], made)
        found = self._summed(kicks)
        if self.transition is None:
            return (path, ()), found
        early, late, active = (
            self._summed(self.path.values(state[0])),
            self._summed(self.path.values(path)),
            [],
        )
        for i, own in zip(self.passing, state[1], strict=True):
            kick, found[i] = found[i], None
            rough = 0.0 if kick is None else kick / self.dt
            n, m = (
                _plus(self.base[i] * wave, noise[i]) + rough
                for wave, noise in ((before, early), (after, late))
            )
            active.append(self.transition.advance(own, n, m))
        return (path, tuple(active)), found

    def inputs(self, state: tuple[Any, Any], harmonic: Array) -> list[Array]:
        """u, given the harmonic now."""
        noise = self._summed(self.path.values(state[0]))
        found = [_plus(self.base[i] * harmonic, noise[i]) for i in range(len(INPUTS))]
        for i, (a, _) in zip(self.passing, state[1], strict=True):
            found[i] = a
        return found

    def slopes(self, state: tuple[Any, Any], slope: Array) -> list[Array]:
        """du/dt, given that of the harmonic now."""
        noise = self._summed(self.path.slopes(state[0]))
        found = [_plus(self.base[i] * slope, noise[i]) for i in range(len(INPUTS))]
        for i, (_, b) in zip(self.passing, state[1], strict=True):
            found[i] = b * self.rate
        return found

    def _summed(self, columns: Columns) -> list[Array | None]:
        """What all noises make of every input; the one channel of a shared noise acts on all of its
        inputs."""
        found: list[Array | None] = [None] * len(INPUTS)
        for scale, acts_on, own in zip(self.scale, self.acts_on, columns, strict=True):
            for j, i in enumerate(acts_on if own else ()):
                found[i] = _plus(scale[j] * own[min(j, len(own) - 1)], found[i])
        return found


def _plus(a: Array, b: Array | None) -> Array:
    return a if b is None else a + b
