"""Fit of a task's parameters to a target spectrum, in linear response or by Monte Carlo."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from ._bundled import choices
from ._expected import check_line
from ._linear import has_response
from ._noise import AbstractNoise, BandLimitedNoise, OrnsteinUhlenbeckNoise, WhiteNoise
from ._objective import Coordinates
from ._parameter import CHANNELS, PARAMETERS, USUALLY_FREE, as_numbers
from ._pink import PinkNoise
from ._problem import Setup
from ._result import FitResult
from ._search import FitInterrupted as FitInterrupted
from ._search import Plan, search
from ._target import Target
from ._task import AbstractTask, Isometric, PrescribedForce
from ._uncertainty import target_variation

RESIDUALS = ("log", "linear", "cumulative")
NOISES: dict[str, type[AbstractNoise]] = {
    "white": WhiteNoise,
    "band-limited": BandLimitedNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckNoise,
    "pink": PinkNoise,
}
METHODS = ("linear", "montecarlo")
DT = 2.5e-3


def task_for(target: Target, *, noise: str | AbstractNoise | None = None) -> AbstractTask:
    """The task that a target measured: `Isometric` for force and torque, `PrescribedForce` for displacement.

    It has the target's spectrum settings and default parameters; `noise` is a name of `NOISES` or a noise object.
    """
    kind = PrescribedForce if target.quantity == "displacement" else Isometric
    return with_noise(kind(settings=target.settings), noise)


def with_noise(
    task: AbstractTask, noise: str | AbstractNoise | None, fix: Mapping[str, float] | None = None
) -> AbstractTask:
    """The task with another noise, at its default amplitudes except those that `fix` names."""
    if noise is None:
        return task
    if isinstance(noise, AbstractNoise):
        return task.with_parts(noise=noise)
    if noise not in NOISES:
        raise ValueError(f"noise = {noise!r}: {choices(noise, NOISES)}")
    kind: Any = NOISES[noise]
    made = kind().per_channel()
    values = {f"noise_{c}": float(made.amplitude[i]) for i, c in enumerate(CHANNELS)} | dict(fix or {})
    fixed = [values[f"noise_{c}"] for c in CHANNELS]
    return task.with_parts(noise=eqx.tree_at(lambda n: n.amplitude, made, np.array(fixed)))


def fit(
    task: AbstractTask,
    target: Target,
    *,
    free: Iterable[str] | None = None,
    fix: Mapping[str, float] | None = None,
    noise: str | AbstractNoise | None = None,
    method: str = "linear",
    residual: str = "log",
    starts: int | None = None,
    seeds: int | None = None,
    key: PRNGKeyArray | int = 0,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, float | None] | None = None,
    coefficient_of_variation: bool = True,
    mean_force: tuple[float, float] | None = None,
    max_steps: int = 40,
    dt: float = DT,
    check_seeds: int | None = None,
    progress: bool | Callable[[str, float], None] = False,
) -> FitResult:
    """Find the parameters whose expected spectrum is the target's: Levenberg-Marquardt from many starts.

    Minimises `½ Σ r_k² + ½ Σ θ_j²`, r the residuals in standard deviations of the target (log residual:
    `(z_k - z̄) / sd_k`, `z_k = ln(target_k / fitted_k) - bias_k`), θ the free parameters' distance from the task's own
    values in standard deviations of the prior.

    `method="linear"`: the model's spectrum is that of the linear response (`expected_spectrum`); the best minimum is then
    polished with the nonlinear model's correction to it, from `seeds` noise paths. `method="montecarlo"`: a mean over
    `seeds` noise paths that stay the same throughout (common random numbers), with the linear response as control variate
    where the task has one. The reported spectrum comes from `check_seeds` fresh paths of the nonlinear model.

    **Arguments:** `task` (its values are the prior's centre; `task_for(target)` makes one) and `target`, whose spectrum
    settings replace the task's; `free`, names to fit (default: `DEFAULT_FREE`, those of them that the task has);
    `fix`, values to set, which are then not free; `noise`, a name or an object; `residual`, "log", "linear" or
    "cumulative"; `starts` (100, or 8 for a task without linear response); `seeds` (32, or 48 then); `key`, a `jax.random`
    key or a seed number; `bounds` {name: (low, high)}; `priors` {name: sd in log, or None for a flat one};
    `coefficient_of_variation`, whether the target's, if it states one, is one more residual (it fixes the scale of the
    noise); `mean_force` (value, sd) [N] as a further residual; `max_steps` for each descent; `check_seeds` (64, or 200
    then); `dt` [s], noise grid of a Monte Carlo fit; `progress`, True or a function of (text, share).

    **Returns:** a `FitResult`; a fit that fails is one, too, and says why.

    **Raises:** `ValueError` for bad arguments (unknown names with the nearest known, too few bins, values outside
    bounds); `FitInterrupted` on Ctrl-C, with what was reached.
    """
    task, counts = with_noise(task, noise, fix), (starts, seeds, check_seeds)
    with jax.enable_x64(True):
        plan = planned(task, target, free=free, fix=fix, method=method, residual=residual, counts=counts, key=key,
                       bounds=bounds, priors=priors, coefficient_of_variation=coefficient_of_variation,
                       mean_force=mean_force, max_steps=max_steps, dt=dt, progress=progress)  # fmt: skip
        return search(plan)


def planned(
    task: AbstractTask,
    target: Target,
    *,
    free: Iterable[str] | None = None,
    fix: Mapping[str, float] | None = None,
    method: str = "linear",
    residual: str = "log",
    counts: tuple[int | None, int | None, int | None] = (None, None, None),
    key: PRNGKeyArray | int = 0,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, float | None] | None = None,
    coefficient_of_variation: bool = True,
    mean_force: tuple[float, float] | None = None,
    max_steps: int = 40,
    dt: float = DT,
    progress: bool | Callable[[str, float], None] = False,
) -> Plan:
    """The arguments of `fit`, checked (see there); `counts` are starts, seeds, check_seeds. Needs double precision."""
    if method not in METHODS:
        raise ValueError(f"method = {method!r}: {choices(method, METHODS)}")
    if residual not in RESIDUALS:
        raise ValueError(f"residual = {residual!r}: {choices(residual, RESIDUALS)}")
    for name, count in zip(("starts", "seeds", "check_seeds", "max_steps"), (*counts, max_steps), strict=True):
        if count is not None and count < 1:
            raise ValueError(f"{name} = {count} must be at least 1")
    task = as_numbers(task.with_parts(settings=target.settings).replace(**(fix or {})))
    names = free_names(task, free, fix or {}, len(target.bins))
    sds = {n: (priors or {}).get(n, PARAMETERS[n].prior_sd if n in PARAMETERS else 1.0) for n in names}
    _check_names("priors", priors or {}, names)
    _check_names("bounds", bounds or {}, names)
    check_line(task, target.settings)
    if not (np.any(np.asarray(task.noise.amplitude) > 0) or float(task.harmonic.amplitude) > 0):
        raise ValueError("the task has neither noise nor a harmonic, so its spectrum is zero: set noise_K_w, say")
    control = has_response(task, required=method == "linear")
    usual = (100, 32, 64) if control else (8, 48, 200)
    starts, seeds, check_seeds = (given or default for given, default in zip(counts, usual, strict=True))
    settings = {
        "free": list(names), "residual": residual, "starts": starts, "seeds": seeds, "dt": dt, "max_steps": max_steps,
        "check_seeds": check_seeds, "prior_centre": {n: float(task[n]) for n in names}, "prior_sd": sds,
        "bounds": {n: list(b) for n, b in (bounds or {}).items()},
        "coefficient_of_variation": coefficient_of_variation and target.coefficient_of_variation is not None,
        "mean_force": None if mean_force is None else list(mean_force), "spectrum": target.settings.to_dict(),
    }  # fmt: skip
    coordinates = Coordinates.of({name: float(task[name]) for name in names}, dict(bounds or {}),
                                 {n: sd or 1.0 for n, sd in sds.items()})  # fmt: skip
    prior = np.array([0.0 if sds[n] is None else 1.0 for n in names])
    extra = (target_variation(target) if coefficient_of_variation else None, mean_force)
    seed, key = (key, jax.random.key(key)) if isinstance(key, int) else (None, key)
    setup = Setup(task, target, coordinates, prior, extra, residual, method, dt, key, seeds, control, teller(progress))
    settings["steps_per_sample"] = setup.steps_per_sample
    return Plan(setup, starts, max_steps, check_seeds, settings, seed)


def free_names(task: AbstractTask, free: Iterable[str] | None, fix: Mapping[str, float], bins: int) -> tuple[str, ...]:
    """The parameters to fit, checked against the task, the fixed ones and the number of bins."""
    known = task.parameter_names
    if free is None:
        names = [n for n in USUALLY_FREE if n in known and n not in fix and float(task[n]) > 0]
    else:
        names = list(dict.fromkeys(free))
        _check_names("free", names, known)
        both = sorted(set(names) & set(fix))
        if both:
            raise ValueError(f"{', '.join(both)} cannot be both free and fixed")
    if not names:
        raise ValueError("no parameter is free: name at least one in free")
    if bins < len(names):
        raise ValueError(f"{bins} bins cannot determine {len(names)} free parameters ({', '.join(names)}): fix some")
    return tuple(names)


def _check_names(argument: str, names: Iterable[str], known: Iterable[str]) -> None:
    known = list(known)
    for name in names:
        if name not in known:
            raise ValueError(f"{argument}: unknown or not free parameter {name!r}: {choices(name, known)}")


def teller(progress: bool | Callable[[str, float], None]) -> Callable[[str, float], None]:
    if callable(progress):
        return progress
    if not progress:
        return lambda text, share: None
    return lambda text, share: print(f"{100 * share:3.0f} %  {text}", flush=True)
