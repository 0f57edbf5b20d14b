"""The posterior of a fit's parameters: NUTS chains, what they say, and whether they may be believed."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmuscle._common.environment import versions
from jaxmuscle._common.progress import teller
from jaxmuscle.data._target import Target
from jaxmuscle.fits._reopened import taken_up
from jaxmuscle.fits._result import FitResult
from jaxmuscle.objective._consequences import DERIVED, quantities, seen_at
from jaxmuscle.objective._likelihood import Likelihood
from jaxmuscle.objective._problem import Setup, theta_of

from ._chains import Chains, sample
from ._posterior_checks import diagnosed, modes_of, replicates, verdict
from ._posterior_density import Marginal, edges_of, marginal_of
from ._posterior_result import Posterior

ROWS = 256


def posterior(
    result: FitResult,
    target: Target | None = None,
    *,
    key: Array | int = 0,
    chains: int = 4,
    draws: int = 1000,
    warmup: int = 500,
    free: Iterable[str] | None = None,
    priors: Mapping[str, float | tuple[float, float | None] | None] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    progress: bool | Callable[[str, float], None] = False,
) -> Posterior:
    """Draw from the posterior of a fit's parameters in linear response, by NUTS from dispersed starts.

        p(θ | data) ∝ L(θ) Π_j exp(-θ_j² / 2)

    L is the likelihood of `log_likelihood`: gamma-distributed, correlated Welch bins, their unknown total sampled along; or
    Gaussian where the target states a sigma. θ are the free parameters' distances from the prior's centre in prior standard
    deviations (logarithms for positive ones; the parameter table has them). The harmonic's frequency, which has many modes,
    is summed over a grid while the chains run, and drawn for every state of theirs afterwards: no mode can be missed by
    chains that do not cross.

    **Arguments:** `result` of `fit` (prior, bounds and free parameters are the fit's unless given) and its `target`;
    `key`, a `jax.random` key or a seed number; `chains`, `draws` of each, `warmup` steps before; `free`, names;
    `priors` {name: sd, or (centre, sd)}; `bounds` {name: (low, high)}; `progress`, True or a function of (text, share).

    **Returns:** a `Posterior`; check `success` or call `summary()`.

    **Raises:** `ValueError` for a target without spread information, a prior outside its bounds or improper, a fit that
    failed, a task without linear response; `ImportError` without blackjax (extra `posterior`).

    **Source:** Hoffman & Gelman 2014 (NUTS); Vehtari et al. 2021, doi:10.1214/20-BA1221 (R-hat, effective sample size).
    """
    for name, count, least in (("chains", chains, 2), ("draws", draws, 100), ("warmup", warmup, 1)):
        if count < least:
            raise ValueError(f"{name} = {count} must be at least {least}")
    tell = teller(progress)
    with jax.enable_x64(True):
        setup = taken_up(result, target, free=free, priors=priors, bounds=bounds, key=key)
        likelihood = Likelihood.of(setup)
        tell("climbing to the maximum", 0.0)
        marginal, _, _ = marginal_of(setup, likelihood, theta_of(setup, result.task))
        found, marginal = sample(marginal, jax.random.fold_in(setup.key, 5), chains, draws, warmup, tell)
        return _reported(setup, marginal, found, result, key, warmup)


def _reported(
    setup: Setup, marginal: Marginal, found: Chains, result: FitResult, key: Array | int, warmup: int
) -> Posterior:
    shape = found.log_density.shape
    theta, s = _thetas(setup, marginal, found)
    found = found._replace(s=s)
    flat = theta.reshape(-1, theta.shape[-1])
    derived, moments = _consequences(marginal.likelihood.problem, flat)
    values = setup.coordinates.values_of(flat)
    samples = {name: values[:, i].reshape(shape) for i, name in enumerate(setup.coordinates.names)}
    known = {name: derived[name].reshape(shape) for name in DERIVED if name not in samples}
    determined = tuple(name for name in (*samples, *known)
                       if (name in result.derived and result.derived[name].stderr is not None)
                       or (name in result.parameters and result.parameters[name].stderr is not None
                           and result.parameters[name].free))  # fmt: skip
    diagnostics = {name: diagnosed(x) for name, x in (samples | known).items()}
    success, message = verdict(found, diagnostics, determined)
    settings = {
        "free": list(setup.coordinates.names), "chains": shape[0], "draws": shape[1], "warmup": warmup,
        "prior_centre": dict(zip(setup.coordinates.names, map(float, setup.coordinates.centre), strict=True)),
        "prior_sd": {n: float(sd) if p else None for n, sd, p in
                     zip(setup.coordinates.names, setup.coordinates.sd, setup.prior, strict=True)},
        "frequencies": len(np.unique(marginal.frequency)), "step_size": found.step_size,
        "residual": setup.residual, "spectrum": setup.target.settings.to_dict(),
    }  # fmt: skip
    modes = modes_of(samples["harmonic_frequency"].ravel()) if "harmonic_frequency" in samples else ()
    drawn = replicates(marginal.likelihood, setup.target, moments, shape, jax.random.fold_in(setup.key, 7))
    task = setup.task.replace(**{name: float(np.median(x)) for name, x in samples.items()})
    return Posterior(success, message, task, setup.target, samples, known, diagnostics, determined, modes, drawn, found,
                     settings, key if isinstance(key, int) else None, versions())  # fmt: skip


def _thetas(setup: Setup, marginal: Marginal, found: Chains) -> tuple[np.ndarray, np.ndarray]:
    """θ of every draw, the harmonic's frequency drawn from its grid given the rest, anywhere in its cell; s and offset."""
    coordinates, names = setup.coordinates, setup.coordinates.names
    both = found.s.reshape(-1, found.s.shape[-1])
    parts = [np.asarray(_placed(marginal, jnp.asarray(part))) for part in _filled(both)]
    s = np.concatenate(parts)[: len(both)]
    theta = np.asarray(coordinates.theta(s))
    if marginal.table is not None:
        white = np.linalg.solve(np.asarray(marginal.scale), (both - np.asarray(marginal.centre)).T).T
        heights = _heights(marginal, white)
        keys = jax.random.split(jax.random.fold_in(setup.key, 6))
        chosen = np.asarray(jax.random.categorical(keys[0], jnp.asarray(heights)))
        place = np.asarray(jax.random.uniform(keys[1], (len(both),)))
        edges = edges_of(np.asarray(marginal.frequency))
        frequency = edges[chosen] + place * (edges[chosen + 1] - edges[chosen])
        theta[:, names.index("harmonic_frequency")] = coordinates.theta_of("harmonic_frequency", frequency)
    shape = found.log_density.shape
    sampled = np.concatenate([s[:, list(marginal.columns)], both[:, len(marginal.columns) :]], axis=1)
    return theta.reshape(*shape, -1), sampled.reshape(*shape, -1)


@eqx.filter_jit
def _placed(marginal: Marginal, both: Array) -> Array:
    return jax.lax.map(lambda row: marginal.placed(row)[0], both, batch_size=16)


@eqx.filter_jit
def _frequencies(marginal: Marginal, white: Array) -> Array:
    return jax.lax.map(marginal.at_frequencies, white, batch_size=16)


def _heights(marginal: Marginal, white: np.ndarray) -> np.ndarray:
    parts = [_frequencies(marginal, jnp.asarray(part)) for part in _filled(white)]
    return np.concatenate(parts)[: len(white)]


def _filled(rows: np.ndarray) -> list[np.ndarray]:
    """Parts of `ROWS` rows, the last filled up, so that one program serves them all."""
    fill = np.broadcast_to(rows[-1], (-len(rows) % ROWS, *rows.shape[1:]))
    whole = np.concatenate([rows, fill])
    return np.split(whole, len(whole) // ROWS)


def _consequences(problem: Any, theta: np.ndarray) -> tuple[dict[str, np.ndarray], Any]:
    """Derived quantities and moments at every θ."""
    parts = []
    for part in _filled(theta):
        seen = seen_at(problem, part)
        parts.append((quantities(problem, seen)[0], seen.moments))
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(theta)], *parts)
