"""What perturbs a task on the step grid: a noise path, drawn as it is needed, the harmonic, the
activation."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmuscle.model._activation import ACTIVE, Transition
from jaxmuscle.model._noise import Recursion
from jaxmuscle.model._parameters import INPUTS
from jaxmuscle.model._stream import APART, START, Stream
from jaxmuscle.model._tasks import AbstractTask

# of every noise of a sum: an array for every channel, or none
Columns = tuple[tuple[Array, ...], ...]


class Perturbation(eqx.Module):
    """The inputs u of a task: noise and harmonic, those of the active tissue through the activation
    if there is one.

    The noise is drawn and filtered while the task is integrated: nothing of it is stored. The state
    is that of every channel's recursion, a number for each of its states, and, of every input that
    passes the activation, the pair of the activation's states.

    `scale` of every noise on the inputs that it acts on; `base`, what the harmonic is a fraction
    of.
    """

    stream: Stream
    recursions: tuple[Recursion, ...]
    scale: tuple[Float[Array, "..."], ...]
    base: Float[Array, " inputs"]
    transition: Transition | None
    rate: Array | None  # 1 / contraction time
    channels: tuple[int, ...] = eqx.field(static=True)
    acts_on: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    passing: tuple[int, ...] = eqx.field(static=True)
    dt: float = eqx.field(static=True)

    @classmethod
    def of(cls, task: AbstractTask, stream: Stream, dt: float) -> "Perturbation":
        """Of a task on the random numbers of a seed; of one seed or of all, see `apart`."""
        parts, activation = task.noise.components, task.activation
        acts_on = tuple(part.acts_on for part in parts)
        acted = {i for each in acts_on for i in each} | {0}  # the harmonic acts on K_w
        return cls(
            stream,
            tuple(part.recursion(dt) for part in parts),
            tuple(task.noise_scale(part) for part in parts),
            task.harmonic_base(),
            None if activation is None else activation.transition(dt),
            None if activation is None else 1 / jnp.asarray(activation.time),
            tuple(part.channels for part in parts),
            acts_on,
            () if activation is None else tuple(i for i in ACTIVE if i in acted),
            dt,
        )

    def apart(self, loud: Float[Array, " seeds"] | None) -> tuple["Perturbation", "Perturbation"]:
        """What each seed has of its own, along a leading axis, and what all share; `loud`
        multiplies the noise of each.

        `equinox.combine` of both is the perturbation of a seed.
        """
        mine = jax.tree.map(lambda _: False, self)
        mine = eqx.tree_at(lambda p: p.stream, mine, True)
        if loud is None:
            return eqx.partition(self, mine)
        scale = tuple(own * jnp.expand_dims(loud, range(1, 1 + own.ndim)) for own in self.scale)
        changed = eqx.tree_at(lambda p: p.scale, self, scale)
        return eqx.partition(changed, eqx.tree_at(lambda p: p.scale, mine, True))

    @property
    def _counts(self) -> tuple[int, ...]:
        return tuple(
            made.numbers * n for made, n in zip(self.recursions, self.channels, strict=True)
        )

    def start(self) -> tuple[Any, Any]:
        """Its state at t = 0, with the activation at rest."""
        drawn = (
            self.stream.normals(START, i * APART, count) for i, count in enumerate(self._counts)
        )
        noise = tuple(
            tuple(made.start(z[c::n]) for c in range(n))
            for made, n, z in zip(self.recursions, self.channels, drawn, strict=True)
        )
        rest = jnp.zeros((), jnp.result_type(float))
        return noise, tuple((rest, rest) for _ in self.passing)

    def ahead(self, first: Array, steps: int) -> Any:
        """What is made for some steps at once, with a leading axis of steps."""
        firsts = tuple(i * APART for i in range(len(self._counts)))
        return self.stream.ahead(first + jnp.arange(steps, dtype=first.dtype), firsts, self._counts)

    def advance(
        self, state: tuple[Any, Any], made: Any, before: Array, after: Array
    ) -> tuple[tuple, list[Array | None]]:
        """The state after a step, of what `ahead` has made for it, in which the harmonic runs from
        `before` to `after`; and the white noise of the inputs in it."""
        noise, kicks = self._advance_noise(state[0], made)
        found = self._summed(kicks)
        if self.transition is None:
            return (noise, ()), found
        early, late, active = self._values(state[0]), self._values(noise), []
        for i, own in zip(self.passing, state[1], strict=True):
            kick, found[i] = found[i], None
            rough = 0.0 if kick is None else kick / self.dt
            n, m = (
                _plus(self.base[i] * wave, channels[i]) + rough
                for wave, channels in ((before, early), (after, late))
            )
            active.append(self.transition.advance(own, n, m))
        return (noise, tuple(active)), found

    def _advance_noise(self, state: Any, made: Any) -> tuple[Any, Columns]:
        """The recursions a step on, and the increments of white noise."""
        later, kicks = [], []
        for i, (own, n, count) in enumerate(
            zip(self.recursions, self.channels, self._counts, strict=True)
        ):
            z = self.stream.numbers(made, i, i * APART, count)
            later.append(tuple(own.advance(state[i][c], z[c::n]) for c in range(n)))
            kicks.append(() if own.direct is None else tuple(own.direct * z[c] for c in range(n)))
        return tuple(later), tuple(kicks)

    def _values(self, state: Any) -> list[Array | None]:
        """The noise of every input."""
        each = zip(self.recursions, state, strict=True)
        return self._summed(tuple(tuple(made.value(q) for q in own if q) for made, own in each))

    def inputs(self, state: tuple[Any, Any], harmonic: Array) -> list[Array]:
        """u, given the harmonic now."""
        noise = self._values(state[0])
        found = [_plus(self.base[i] * harmonic, noise[i]) for i in range(len(INPUTS))]
        for i, (a, _) in zip(self.passing, state[1], strict=True):
            found[i] = a
        return found

    def slopes(self, state: tuple[Any, Any], slope: Array) -> list[Array]:
        """du/dt, given that of the harmonic now."""
        each = zip(self.recursions, state[0], strict=True)
        noise = self._summed(
            tuple(tuple(made.slope(q) for q in own if made.S) for made, own in each)  # pyright: ignore[reportArgumentType]
        )
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
