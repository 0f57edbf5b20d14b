"""Hamiltonian chains of a whitened density, in one program; step size and metric adapted on all of
them together."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmuscle._common.keys import fold_in
from jaxmuscle._common.programs import kept, kept_to_run_long

# has `size`, `centre`, `scale` that whiten, and `log_density` of whitened coordinates
Density = Any
BLOCK = 50
ADAPTATIONS = (2, 3, 5)  # blocks of warm-up; the metric is learnt after each but the last
TARGET_ACCEPTANCE = 0.95
# of a trajectory, in standard deviations; its length is drawn anew for every draw, from 0 on
LONGEST = 4.0
# autocorrelation of successive draws of the warm-up, from which on trajectories become twice as
# long
ALIKE = 0.5
MOST_STEPS = 128
SPREAD = 1.5
SHRINK = 20  # draws that the old metric counts for when a new one is learnt


class Chains(NamedTuple):
    """Draws of the unbounded coordinates and the offset, and how each was made; leading axes chain,
    draw."""

    s: Float[np.ndarray, "chains draws sampled"]
    log_density: Float[np.ndarray, "chains draws"]
    acceptance: Float[np.ndarray, "chains draws"]
    steps: Int[np.ndarray, "chains draws"]
    diverging: Bool[np.ndarray, "chains draws"]
    step_size: float


class _State(NamedTuple):
    """Of every chain position, log density and its gradient; and how far the step size is adapted.

    The fields of blackjax's own states without their classes, so that a program is kept, and loaded
    without blackjax.
    """

    chains: Any
    adaptation: Any


def _tools() -> tuple[Any, Any, Any, Any]:
    """HMC and the class of its states, dual averaging and the class of its states."""
    import blackjax
    from blackjax.adaptation.step_size import (
        DualAveragingAdaptationState,
        dual_averaging_adaptation,
    )
    from blackjax.mcmc.hmc import HMCState

    return (
        blackjax.hmc,
        HMCState,
        dual_averaging_adaptation(TARGET_ACCEPTANCE),
        DualAveragingAdaptationState,
    )


def _strong(tree: Any) -> Any:
    """Without weak types, with which every block would be compiled anew."""
    return jax.tree.map(lambda x: jnp.asarray(x, dtype=jnp.result_type(x)), tree)


@kept
def _first(density: Density, positions: Array | np.ndarray) -> Any:
    hmc, _, (start, _, _), _ = _tools()
    chains = jax.vmap(lambda x: hmc.init(x, density.log_density))(positions)
    return _strong(_State(tuple(chains), tuple(start(jnp.asarray(0.5)))))


@kept_to_run_long
def _block(
    density: Density,
    key: Array,
    state: Any,
    adapting: Array | np.ndarray,
    longest: Array | np.ndarray,
) -> tuple[Any, Any]:
    """`BLOCK` draws of every chain; while `adapting` the step size follows the mean acceptance of
    all chains.

    All chains make the same number of steps: none waits for another.
    """
    hmc, chain_state, (_, update, final), step_state = _tools()
    kernel = hmc.build_kernel()
    state = _State(chain_state(*state.chains), step_state(*state.adaptation))
    settled = final(state.adaptation)

    def one(state, key):
        size = jnp.where(adapting, jnp.exp(state.adaptation.log_step_size), settled)
        length, *keys = jax.random.split(key, 1 + len(state.chains.logdensity))
        steps = jnp.clip(
            jnp.ceil(jax.random.uniform(length) * longest / size), 1, MOST_STEPS
        ).astype(int)
        metric = jnp.ones(density.size)
        chains, info = jax.vmap(
            lambda key, chain: kernel(key, chain, density.log_density, size, metric, steps)
        )(jnp.stack(keys), state.chains)
        learnt = update(state.adaptation, jnp.mean(info.acceptance_rate))
        adaptation = jax.tree.map(
            lambda new, old: jnp.where(adapting, new, old), learnt, state.adaptation
        )
        made = (
            chains.position,
            chains.logdensity,
            info.acceptance_rate,
            jnp.broadcast_to(steps, info.acceptance_rate.shape),
            info.is_divergent,
        )
        return _State(chains, adaptation), (*made, size)

    state, made = jax.lax.scan(one, state, jax.random.split(key, BLOCK))
    return _strong(_State(tuple(state.chains), tuple(state.adaptation))), made


def _whiten_anew(density: Density, white: np.ndarray) -> Density:
    """Whitened anew by the covariance of draws, the old metric counting as `SHRINK` of them."""
    count = len(white)
    covariance = (count * np.cov(white.T, bias=True) + SHRINK * np.eye(white.shape[1])) / (
        count + SHRINK
    )
    scale = np.asarray(density.scale) @ np.linalg.cholesky(covariance)
    centre = np.asarray(density.centre) + np.asarray(density.scale) @ white.mean(axis=0)
    return eqx.tree_at(lambda m: (m.centre, m.scale), density, (centre, scale))


def _autocorrelation(density: Density, white: np.ndarray) -> float:
    """The largest autocorrelation of successive draws among the coordinates; axes draw, chain,
    coordinate."""
    away = (white - white.mean(axis=(0, 1))) @ np.asarray(density.scale).T
    return float(np.max(np.sum(away[1:] * away[:-1], axis=(0, 1)) / np.sum(away**2, axis=(0, 1))))


def _carry_over(old: Density, new: Density, white: Array) -> np.ndarray:
    both = np.asarray(old.centre) + np.asarray(white) @ np.asarray(old.scale).T
    return np.linalg.solve(np.asarray(new.scale), (both - np.asarray(new.centre)).T).T


def sample(
    density: Density,
    key: Array,
    chains: int,
    draws: Sequence[int],
    warmup: int,
    tell: Callable[[str, float], None],
) -> Iterator[tuple[Chains, Density]]:
    """Chains from dispersed starts, and the density whitened as they were drawn: at each of these
    rising numbers of draws.

    The longer chains go on where the shorter ones ended. `warmup` is rounded up to blocks. Needs
    double precision. Raises `ValueError` if no start has a finite density.
    """
    lengths = _sample(density, key, chains, draws, warmup, tell)
    for _ in draws:
        with jax.numpy_dtype_promotion("standard"):
            found = next(lengths)
        yield found


def _sample(
    density: Density,
    key: Array,
    chains: int,
    draws: Sequence[int],
    warmup: int,
    tell: Callable[[str, float], None],
) -> Iterator[tuple[Chains, Density]]:
    tell("compiling the sampler", 0.0)
    blocks = max(len(ADAPTATIONS), -(-warmup // BLOCK))
    shares = np.cumsum(ADAPTATIONS) / sum(ADAPTATIONS)
    renewals = {max(1, round(blocks * share)) for share in shares[:-1]}
    state = _first(density, _disperse(density, fold_in(key, 0), chains))
    longest = LONGEST
    recent: list[np.ndarray] = []
    kept: list[Any] = []
    done = 0
    for count in draws:
        total = blocks + -(-count // BLOCK)
        for number in range(done, total):
            adapting = number < blocks
            its, told = fold_in(key, number + 1), (np.asarray(adapting), np.asarray(longest))
            state, made = _block(density, its, state, *told)
            white = np.asarray(made[0])
            if not adapting:
                both = np.asarray(density.centre) + white @ np.asarray(density.scale).T
                kept.append((both, *map(np.asarray, made[1:])))
            elif number + 1 in renewals:
                recent.append(white)
                seen = np.concatenate(recent[-2:])
                if number + 1 == max(renewals) and _autocorrelation(density, seen) > ALIKE:
                    longest *= 2
                new = _whiten_anew(density, seen.reshape(-1, white.shape[-1]))
                state = _first(new, _carry_over(density, new, state.chains[0]))
                density, recent = new, []
            else:
                recent.append(white)
            doing = "drawing" if count == draws[0] else "the chains have not mixed yet, drawing"
            drawing = f"{doing}, block {number + 1 - blocks} of {total - blocks}"
            tell("warming up the chains" if adapting else drawing, (number + 1) / total)
        done = total
        parts = [np.concatenate([part[i] for part in kept])[:count] for i in range(6)]
        s, height, acceptance, steps, diverging = (np.swapaxes(part, 0, 1) for part in parts[:5])
        yield Chains(s, height, acceptance, steps, diverging, float(parts[5][-1])), density


def _disperse(density: Density, key: Array, chains: int) -> np.ndarray:
    """Starts about the maximum, wider than the posterior; nearer where the density is not
    finite."""
    away = SPREAD * np.asarray(_normal(key, (chains, density.size)))
    for _ in range(6):
        finite = np.isfinite(np.asarray(_first(density, away).chains[1]))
        if np.all(finite):
            return away
        away = np.where(finite[:, None], away, 0.5 * away)
    raise ValueError(
        "the posterior density is not finite about its maximum: the fitted task is at the edge of"
        " stability"
    )


@kept
def _normal(key: Array, shape: tuple[int, int]) -> Array:
    return jax.random.normal(key, shape)
