"""The arguments of a fit, checked."""

import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from jaxmuscle._common.arrays import as_numbers
from jaxmuscle._common.progress import teller
from jaxmuscle._common.text import choices
from jaxmuscle.data._target import Target
from jaxmuscle.model._noise import AbstractNoise
from jaxmuscle.model._parameters import PARAMETERS, USUALLY_FREE
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedForce, with_noise
from jaxmuscle.response._expected import check_line
from jaxmuscle.response._linearised import has_response

from ._coordinates import Coordinates
from ._problem import Setup, target_variation

RESIDUALS = ("log", "linear", "cumulative")
METHODS = ("linear", "montecarlo")
DT = 2.5e-3


def task_for(target: Target, *, noise: str | AbstractNoise | None = None) -> AbstractTask:
    """The task that a target measured: `Isometric` for force and torque, `PrescribedForce` for displacement.

    It has the target's spectrum settings and default parameters; `noise` is a name of `NOISES` or a noise object.
    """
    kind = PrescribedForce if target.quantity == "displacement" else Isometric
    return with_noise(kind(settings=target.settings), noise)


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


class Plan(NamedTuple):
    """A fit to be done."""

    setup: Setup
    starts: int
    max_steps: int
    check_seeds: int
    settings: dict
    seed: int | None


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


INPUTS = ("P_w", "F_ext", "x_z")
SAME = 1e-9


def base_of(name: str) -> str:
    """The parameter that a joint name stands for: "c_w" of "c_w@high"."""
    return name.partition("@")[0]


def target_of(name: str) -> str:
    """The target that a joint name belongs to, empty if it is shared."""
    return name.partition("@")[2]


def joint_names(
    free: Mapping[str, Iterable[str]], tasks: Mapping[str, AbstractTask], separate: Iterable[str]
) -> dict[str, dict[str, str]]:
    """The joint name of every target's free parameters.

    A parameter is shared under its own name if all tasks that have it let it be free, unless it is in `separate` or an
    input (`INPUTS`); then it is called "name@target", or by its own name if only one task has it.
    """
    found: dict[str, dict[str, str]] = {target: {} for target in free}
    for name in dict.fromkeys(n for names in free.values() for n in names):
        holders = [t for t, task in tasks.items() if name in task.parameter_names]
        letting = [t for t in holders if name in free[t]]
        own = name in separate or name in INPUTS or len(letting) < len(holders)
        for target in letting:
            found[target][name] = f"{name}@{target}" if own and len(holders) > 1 else name
    return found


def check_shared(tasks: Mapping[str, AbstractTask], separate: Iterable[str], proportional: Iterable[str]) -> None:
    """Refuse tasks that cannot be of one person: other values of what they share, other kinds of noise or muscle."""
    separate, proportional = set(separate), set(proportional)
    known = dict.fromkeys(n for task in tasks.values() for n in task.parameter_names)
    for argument, names in (("separate", separate), ("proportional", proportional)):
        for name in sorted(names - set(known)):
            raise ValueError(f"{argument}: no task has a parameter {name!r}: {choices(name, known)}")
    if both := sorted(separate & proportional):
        raise ValueError(f"{', '.join(both)} cannot be both separate and proportional")
    for (first, one), (target, other) in itertools.combinations(tasks.items(), 2):
        shared = [n for n in one.parameter_names if n in other.parameter_names and n not in separate and n not in INPUTS]
        for part, mine in (("noise", "noise_"), ("muscle", "")):
            names = [n for n in shared if n.startswith("noise_") == bool(mine) and not n.startswith("harmonic_")]
            a, b = getattr(one, part), getattr(other, part)
            if names and jax.tree.structure(a) != jax.tree.structure(b):
                kinds = f"{type(a).__name__} and {type(b).__name__}" if type(a) is not type(b) else "differently built"
                raise ValueError(f"the {part} of task {first!r} and that of {target!r} are {kinds}, so {names[0]} cannot be "
                                 f"shared: use the same {part}, or list {', '.join(names)} in separate")  # fmt: skip
        for name in shared:
            x, y = float(one[name]), float(other[name])
            if name not in proportional and abs(x - y) > SAME * max(abs(x), abs(y)):
                raise ValueError(f"{name} is {x:g} in task {first!r} and {y:g} in {target!r}, yet they share it: make them "
                                 "equal, or list it in separate (a value for each) or in proportional (the ratio "
                                 "kept)")  # fmt: skip
