"""The posterior of a fit's parameters: Hamiltonian chains, what they say, and whether they may be
believed."""

from collections.abc import Callable
from typing import Unpack

import jax
import numpy as np
from jaxtyping import Array

from jaxmuscle._common.arguments import check_options, require_extra
from jaxmuscle._common.environment import fitting, versions
from jaxmuscle._common.keys import fold_in, number_of
from jaxmuscle._common.programs import kept
from jaxmuscle._common.progress import told
from jaxmuscle._common.types import Key
from jaxmuscle.data._target import Target
from jaxmuscle.fits._reopened import ReopenOptions, bounds_of, reopened
from jaxmuscle.fits._result import FitResult
from jaxmuscle.objective._arguments import settings_of
from jaxmuscle.objective._consequences import expand, quantities
from jaxmuscle.objective._likelihood import Likelihood
from jaxmuscle.objective._problem import FitProblem

from ._chains import Chains, sample
from ._frequency_grid import edges_of
from ._posterior_checks import diagnose, diverges, modes_of, replicates, verdict
from ._posterior_density import PosteriorDensity, density_about
from ._posterior_result import Posterior, PosteriorPart

ROWS = 256
# Of a chain, unless a number is asked for: the next one as long as the chains have not mixed.
DRAWS = 600, 800, 1100, 1600, 2300, 3000


def posterior(
    result: FitResult,
    target: Target | None = None,
    *,
    key: Key = 0,
    chains: int = 4,
    draws: int | None = None,
    warmup: int = 400,
    progress: bool | Callable[[str, float], None] = False,
    **options: Unpack[ReopenOptions],
) -> Posterior:
    """Draw from the posterior of a fit's parameters in linear response, by Hamiltonian Monte Carlo
    from dispersed starts.

        print(jm.posterior(result, target, key=jax.random.key(2)).summary())

        p(θ | data) ∝ L(θ) Π_j exp(-θ_j² / 2)

    L is the likelihood of `log_likelihood`: gamma-distributed, correlated Welch bins, their unknown
    total sampled along; or Gaussian where the target states a sigma. θ are the free parameters'
    distances from the prior's centre in prior standard deviations (logarithms for positive ones;
    the parameter table has them). The harmonic's frequency, which has many modes, is summed over a
    grid while the chains run, and drawn for every state of theirs afterwards: no mode can be missed
    by chains that do not cross.

    **Arguments:**

    - `result` of `fit` (prior, bounds and free parameters are the fit's unless given) and its
      `target`
    - `key`: a `jax.random` key or a seed number
    - `chains`: how many
    - `draws` of each (by default 600, and as long as the chains have not mixed up to 3000)
    - `warmup` steps before them
    - `free`: names
    - `priors` {name: sd, or (centre, sd)}; None as sd: a flat prior, which needs bounds
    - `bounds` {name: (low, high)}
    - `progress`: True or a function of (text, share)

    **Returns:** a `Posterior`; check `success` or call `summary()`.

    **Raises:** `ValueError` for a target that states neither segments nor sigma, a prior centred
    outside its bounds, a flat one without bounds, a fit that failed, a task without linear
    response; `ImportError` without blackjax (extra `posterior`).

    **Source:** Neal 2011, arXiv:1206.1901 (Hamiltonian Monte Carlo, trajectories of random length);
    Vehtari et al. 2021, doi:10.1214/20-BA1221 (R-hat, effective sample size).
    """
    check_options(posterior, ReopenOptions, options)
    require_extra("posterior")
    lengths = DRAWS if draws is None else (draws,)
    for name, count, least in (
        ("chains", chains, 2),
        ("draws", lengths[0], 100),
        ("warmup", warmup, 1),
    ):
        if count < least:
            raise ValueError(f"{name} = {count} must be at least {least}")
    with told(progress, f"posterior of {result.title}") as tell, fitting():
        problem = reopened(result, target, key=key, **options)
        limits = bounds_of(result, problem.coordinates.names, options.get("bounds"))
        likelihood = Likelihood.of(problem)
        tell("searching the most probable parameters", 0.0)
        density, _, _ = density_about(
            problem, likelihood, problem.theta_of(tuple(result.tasks.values()))
        )
        attempts = (
            _report(problem, whitened, found, result, key, warmup, limits)
            for found, whitened in sample(
                density, fold_in(problem.key, 5), chains, lengths, warmup, tell
            )
        )
        drawn = next(attempts)
        while (
            not (drawn.success or diverges(drawn.chains))
            and (longer := next(attempts, None)) is not None
        ):
            drawn = longer
        return drawn


def _report(
    problem: FitProblem,
    density: PosteriorDensity,
    found: Chains,
    result: FitResult,
    key: Key,
    warmup: int,
    limits: dict[str, tuple[float, float]],
) -> Posterior:
    shape, names = found.log_density.shape, problem.coordinates.names
    theta, s = _thetas(problem, density, found)
    found = found._replace(s=s)
    flat = theta.reshape(-1, theta.shape[-1])
    objective = density.likelihood.objective
    seen = expand(objective, flat, slopes=False)
    derived, moments = quantities(objective, seen)[0], seen.moments
    values = problem.coordinates.values_of(flat)
    samples = {name: values[:, i].reshape(shape) for i, name in enumerate(names)}
    places = {name: problem.where(name) for name in result.derived_names if name not in samples}
    known = {name: derived[i][base].reshape(shape) for name, (i, base) in places.items()}
    determined = tuple(name for name in (*samples, *known) if name in result.determined)
    diagnostics = {name: diagnose(x) for name, x in (samples | known).items()}
    success, message = verdict(found, diagnostics, determined)
    settings = settings_of(problem, limits) | {
        "chains": shape[0],
        "draws": shape[1],
        "warmup": warmup,
        "per_newton": bool(result.per_newton),
        "step_size": found.step_size,
        "frequencies": max(1, sum(len(np.unique(band.frequency)) for band in density.bands)),
        "spectrum": {part.target.name: part.target.settings.to_dict() for part in problem.parts},
    }
    modes = {band.name: modes_of(samples[band.name].ravel()) for band in density.bands}
    parts = {}
    for i, (name, part) in enumerate(zip(result.parts, problem.parts, strict=True)):
        drawing = fold_in(problem.key, 7)
        drawing = fold_in(drawing, i) if i else drawing
        drawn = replicates(density.likelihood.bins[i], part.target, moments[i], shape, drawing)
        own = part.coordinates.values_of(part.own(flat))
        task = part.task.replace(
            **{n: float(np.median(own[:, j])) for j, n in enumerate(part.coordinates.names)}
        )
        parts[name] = PosteriorPart(part.target, task, drawn)
    return Posterior(
        success,
        message,
        parts,
        samples,
        known,
        diagnostics,
        determined,
        modes,
        found,
        settings,
        number_of(key),
        versions(),
    )


def _thetas(
    problem: FitProblem, density: PosteriorDensity, found: Chains
) -> tuple[np.ndarray, np.ndarray]:
    """θ of every draw, each harmonic's frequency drawn from its grid given the rest, anywhere in
    its cell; s and offsets."""
    coordinates, names = problem.coordinates, problem.coordinates.names
    both = found.s.reshape(-1, found.s.shape[-1])
    parts = [np.asarray(_placed(density, part)) for part in _in_batches(both)]
    s = np.concatenate(parts)[: len(both)]
    theta = np.asarray(coordinates.theta(s))
    if density.bands:
        white = np.linalg.solve(np.asarray(density.scale), (both - np.asarray(density.centre)).T).T
        for number, (band, heights) in enumerate(
            zip(density.bands, _heights(density, white), strict=True)
        ):
            key = fold_in(problem.key, 6)
            chosen, place = map(
                np.asarray, _cells(fold_in(key, number) if number else key, heights)
            )
            edges = edges_of(np.asarray(band.frequency))
            frequency = edges[chosen] + place * (edges[chosen + 1] - edges[chosen])
            theta[:, names.index(band.name)] = coordinates.theta_of(band.name, frequency)
    shape = found.log_density.shape
    sampled = np.concatenate([s[:, list(density.columns)], both[:, len(density.columns) :]], axis=1)
    return theta.reshape(*shape, -1), sampled.reshape(*shape, -1)


@kept
def _cells(key: Array, heights: Array | np.ndarray) -> tuple[Array, Array]:
    """A cell of the grid for every draw, and a place within it from 0 to 1."""
    keys = jax.random.split(key)
    return jax.random.categorical(keys[0], heights), jax.random.uniform(keys[1], heights.shape[:1])


@kept
def _placed(density: PosteriorDensity, both: Array | np.ndarray) -> Array:
    return jax.lax.map(lambda row: density.place(row)[0], both, batch_size=16)


@kept
def _frequencies(density: PosteriorDensity, white: Array | np.ndarray) -> tuple[Array, ...]:
    return jax.lax.map(density.at_frequencies, white, batch_size=16)


def _heights(density: PosteriorDensity, white: np.ndarray) -> tuple[np.ndarray, ...]:
    parts = [_frequencies(density, part) for part in _in_batches(white)]
    return tuple(np.concatenate(x)[: len(white)] for x in zip(*parts, strict=True))


def _in_batches(rows: np.ndarray) -> list[np.ndarray]:
    """Parts of `ROWS` rows, the last filled up, so that one program serves them all."""
    fill = np.broadcast_to(rows[-1], (-len(rows) % ROWS, *rows.shape[1:]))
    whole = np.concatenate([rows, fill])
    return np.split(whole, len(whole) // ROWS)
