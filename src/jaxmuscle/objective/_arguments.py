"""The arguments of a fit, checked."""

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxmuscle._common.arguments import require
from jaxmuscle._common.arrays import as_numbers, with_nulls
from jaxmuscle._common.keys import key_of
from jaxmuscle._common.units import LEVER_ARM
from jaxmuscle.data._frequency_response import FrequencyResponse, check_seen
from jaxmuscle.data._target import Target
from jaxmuscle.model._muscle import Muscle
from jaxmuscle.model._parameters import (
    PARAMETERS,
    USUALLY_FREE,
    unknown_parameter,
    usually_free,
)
from jaxmuscle.model._tasks import AbstractTask, Isometric, PrescribedLength
from jaxmuscle.response._expected import check_line
from jaxmuscle.response._linearised import has_response
from jaxmuscle.response._scaling import FORCES, is_scalable
from jaxmuscle.spectra._settings import WINDOW, samples_in

from ._coordinates import Coordinates
from ._options import FitOptions
from ._problem import FitProblem, Part, target_variation

COEFFICIENTS = ("k_w", "k_z", "c_w", "c_z")
# of the prior of ln ζ. Small movements of active human muscle, twitch and tissue together, follow a
# second-order response with two real time constants, 50 ms each (Zahalak & Heyman 1979,
# doi:10.1115/1.3426220): nothing in it swings.
DAMPING = "damping_ratio"
DAMPING_SD = 0.5
# of a joint's active mass: times the share that it has in the task, sd of its log
ACTIVE, ACTIVE_SD = 0.5, 0.7
# Hz, in which a fit holds resonances that begin there: the one that is called tremor, of force and
# of what moves, and the slower one
TREMOR = {"force": (6.0, 14.0)}
MOVING = (3.0, 20.0)
SLOWER = (0.5, 6.0)
# free where the insertion moves: a perturbation tells m_z, and m_w widens the errors
MASSES = ("m_w", "m_z")


def check_quantity(task: AbstractTask, target: Target, name: str, remedy: str) -> None:
    """Refuse a task whose output is not what the target measured."""
    what = target.quantity
    if task.quantity != ("force" if what == "torque" else what):
        raise ValueError(
            f"target {name!r} is a{'n' * (what[0] == 'a')} {what}, but its task"
            f" {type(task).__name__} gives {task.output_name} in {task.output_unit}: {remedy}"
        )


def check_stiffness(task: AbstractTask, target: Target) -> None:
    """Refuse a dynamic stiffness where the task moves no insertion, and one that chance alone
    explains."""
    if target.stiffness is None:
        return
    if not isinstance(task, PrescribedLength):
        raise ValueError(
            f"target {target.name!r} has a dynamic stiffness, which {type(task).__name__} cannot"
            " give: fit jaxmuscle.PrescribedLength()"
        )
    check_seen(target.stiffness, f"target {target.name!r}")


def free_names(
    task: AbstractTask,
    free: Iterable[str] | None,
    fix: Mapping[str, float],
    target: Target,
    *,
    moved: bool | None = None,
) -> tuple[str, ...]:
    """The parameters to fit, checked against the task, the fixed ones and the number of data.

    By default those of muscle, noise and rhythms; where the target has no spectrum those of the
    muscle alone. Where the insertion is moved, here or in another target of the same person, the
    masses, too.
    """
    moved = target.stiffness is not None if moved is None else moved
    known, bins = task.parameter_names, len(target.bins)
    if free is None and not bins:
        free = [n for n in (*COEFFICIENTS, *MASSES) if n in known and n not in fix]
    if target.stiffness is not None:
        bins += 2 * len(target.stiffness.known.frequency)
    if free is None:
        usual = (*USUALLY_FREE, *MASSES) if moved else USUALLY_FREE
        names = [name for name in usually_free(task, usual) if name not in fix]
    else:
        names = list(dict.fromkeys(free))
        check_names("free", names, known)
        both = sorted(set(names) & set(fix))
        if both:
            raise ValueError(f"{', '.join(both)} cannot be both free and fixed")
    if not names:
        raise ValueError("no parameter is free: name at least one in free")
    if bins < len(names):
        raise ValueError(
            f"{bins} bins cannot determine {len(names)} free parameters ({', '.join(names)}): fix"
            " some"
        )
    return tuple(names)


def check_names(argument: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Refuse names that are not among the known ones."""
    known = list(known)
    for name in names:
        if name not in known:
            raise ValueError(
                f"{argument}:"
                f" {unknown_parameter(name, known, what='unknown or not free parameter')}"
            )


def at_mean(
    task: AbstractTask, target: Target, options: FitOptions
) -> tuple[AbstractTask, FitOptions]:
    """The task scaled to the target's mean force, where it states one in newtons, which then is
    data; P_w follows from it. A moved joint is carried to its response instead, and so is a moved
    limb whose force varies by more than its mean.

    Not where the fit is given a `mean_force` (or False), where P_w is fixed, nor for a muscle that
    is not the paper's.
    """
    if options.mean_force is not None:
        return task, dataclasses.replace(options, mean_force=options.mean_force or None)
    level = next((name for name in FORCES if name in task.parameter_names), None)
    stated = target.mean_force if task.output_unit == "N" and is_scalable(task.muscle) else None
    response = target.stiffness if is_scalable(task.muscle) else None
    arm = None if response is None else response.lever_arm
    varies = stated is not None and target.coefficient_of_variation is None
    if response is not None and varies:
        # a force that varies by more than its mean: that is no scale, and no datum
        stated, arm = None, arm or LEVER_ARM
    options = with_open_mass(options, joint=arm is not None)
    if stated is None or level is None or level in (options.fix or {}):
        return task if arm is None else on_joint(task, task, response, arm), options
    free = (*options.also_free, level)
    moved = task.at_force(stated[0])
    factor = float(moved["m_w"]) / float(task["m_w"])
    if target.stiffness is not None:
        moved = with_masses(moved, task, factor)
        if arm is not None:
            moved = on_joint(task, moved, response, arm)
            return moved, dataclasses.replace(options, mean_force=stated, also_free=free)
    return moved, dataclasses.replace(options, mean_force=stated, also_free=free, carried=factor)


def with_open_mass(options: FitOptions, *, joint: bool) -> FitOptions:
    """With the prior of a joint's active mass, where that is free: of what moves about the axis
    nobody knows which share lies between the tissues. It is that of the muscle, so rather less than
    that of the bones."""
    free = options.free is None or "m_w" in options.free
    if not joint or not free or "m_w" in (options.fix or {}):
        return options
    return dataclasses.replace(options, priors={"m_w": ACTIVE_SD, **(options.priors or {})})


def with_masses(carried: AbstractTask, task: AbstractTask, factor: float) -> AbstractTask:
    """A task that was carried to `factor` times the force, with the masses that it had: they are in
    no ratio to forces where displacements are known.

    Damping goes with √factor then. So the damping ratio C / 2√(K m) stays.
    """
    kept = {name: task[name] for name in MASSES}
    damping = {name: task[name] * np.sqrt(factor) for name in ("c_w", "c_z")}
    return carried.replace(**kept, **damping)


def on_joint(
    task: AbstractTask, moved: AbstractTask, stiffness: FrequencyResponse | None, arm: float
) -> AbstractTask:
    """The task as it is at the lever arm r of a joint, with spring K, damper and mass I of its
    response.

        x_ref, v_ref ∝ r,   m_z = m_z0 I / I₀,   m_w = m_w0 I / 2I₀
        K_0 = K_00 K / K₀,   C_0 = C_00 √(K I / (K₀ I₀))

    I₀ and K₀ are those of `task` (m_z; both stiffnesses in series), at the lever arm `LEVER_ARM`.
    P_w is that of `moved`, or in proportion if that is `task`. All of it is about the axis what it
    is at any other r.
    """
    assert stiffness is not None
    k, i = stiffness.spring_and_mass
    k_w, k_z, *_ = (float(value) for value in task.muscle.base())
    stiffer, heavier = k * (1 / k_w + 1 / k_z), i / float(task["m_z"])
    longer = arm / LEVER_ARM
    damped = math.sqrt(stiffer * heavier)
    factors = {
        "m_w": ACTIVE * heavier,
        "m_z": heavier,
        **dict.fromkeys(("x_ref_w", "x_ref_z", "v_ref_w", "v_ref_z"), longer),
        **dict.fromkeys(("k_w", "k_z"), stiffer / longer**2),
        **dict.fromkeys(("c_w", "c_z"), damped / longer**2),
        **({"P_w": stiffer * longer} if moved is task else {}),
    }
    return moved.replace(**{name: float(task[name]) * f for name, f in factors.items()})


class Plan(NamedTuple):
    """A fit to be done; `kinds`, how each of its starts was chosen, where they are known."""

    problem: FitProblem
    starts: int
    max_steps: int
    check_seeds: int
    settings: dict
    seed: int | None
    kinds: tuple[str, ...] = ()


def planned(
    task: AbstractTask, target: Target, options: FitOptions, *, moved: bool | None = None
) -> Plan:
    """The fit of one target, its arguments checked (see `fit`). Needs double precision.

    `moved`: whether the insertion was moved in this recording or in another one that is fitted
    together with it.
    """
    moved = target.stiffness is not None if moved is None else moved
    target = target.with_measures()  # starts and report look at them
    bounds, priors, fix = (
        dict(options.bounds or {}),
        dict(options.priors or {}),
        dict(options.fix or {}),
    )
    damping = priors.pop(DAMPING, DAMPING_SD)
    task = as_numbers(task.with_parts(settings=target.settings).replace(**fix))
    if "acceleration" in (task.quantity, target.quantity):
        check_quantity(
            task,
            target,
            target.name,
            "fit target.task(), or state the target's quantity",
        )
    check_stiffness(task, target)
    names = free_names(task, options.free, fix, target)
    names += tuple(name for name in options.also_free if name not in names)
    mean = options.mean_force if isinstance(options.mean_force, tuple) else None
    check_names("priors", priors, names)
    check_names("bounds", bounds, names)
    check_line(task, target.settings)
    spectral, settings = len(target.bins) > 0, target.settings
    require(
        not spectral or settings.segments(samples_in(WINDOW, settings)) > 0,
        "length",
        settings.length,
        "a fit simulates 10 s, which is shorter than a segment; analyse the data with shorter ones",
    )
    if spectral and not (
        np.any(np.asarray(task.noise.amplitude) > 0) or float(task.harmonic.amplitude) > 0
    ):
        raise ValueError(
            "the task has neither noise nor a harmonic, so its spectrum is zero: set noise_K_w, say"
        )
    _check_mean(task, names, mean)
    control = has_response(task, required=options.method == "linear")
    many = (
        {"starts": 100, "seeds": 32, "check_seeds": 64}
        if control
        else {"starts": 8, "seeds": 48, "check_seeds": 200}
    )
    many |= {} if spectral else {"seeds": 0, "check_seeds": 0}
    counts = {
        name: number if getattr(options, name) is None else getattr(options, name)
        for name, number in many.items()
    }
    if options.method == "montecarlo" and counts["seeds"] < 1:
        raise ValueError("seeds = 0: a Monte Carlo fit needs at least one")
    usual = {n: PARAMETERS[n].prior_sd if n in PARAMETERS else 1.0 for n in names}
    sds = {n: priors.get(n, usual[n]) for n in names}
    bounds = tremor_bounds(task, names) | bounds
    coordinates = Coordinates.of(
        {n: float(task[n]) for n in names}, bounds, {n: sd or 1.0 for n, sd in sds.items()}
    )
    variation = target_variation(target) if options.coefficient_of_variation else None
    part = Part("", task, target, coordinates, tuple(range(len(names))), variation, mean)
    key, prior = key_of(options.key), np.array([0.0 if sds[n] is None else 1.0 for n in names])
    problem = FitProblem(
        (part,),
        coordinates,
        prior,
        options.method,
        options.dt,
        key,
        counts["seeds"],
        control,
        options.progress,
        # else a muscle could swing as a tremor does; a response tells that apart
        damping_row(task, coordinates, None if moved or task.activation is None else damping),
    )
    settings = {
        **settings_of(problem, bounds),
        **counts,
        "max_steps": options.max_steps,
        "dt": options.dt,
        "coefficient_of_variation": variation is not None,
        "mean_force": None if mean is None else list(mean),
        "damping_ratio_sd": damping if problem.damping else None,
        "carried": options.carried,
        "spectrum": target.settings.to_dict(),
        "steps_per_sample": problem.steps_per_sample,
    }
    return Plan(
        problem, counts["starts"], options.max_steps, counts["check_seeds"], settings, options.seed
    )


def tremor_bounds(task: AbstractTask, names: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Bounds of the resonances among the names that begin in the band where people have them."""
    tremor = TREMOR.get(task.quantity, MOVING)
    bands = {"resonance_frequency": tremor, "resonance_2_frequency": SLOWER}
    return {
        name: band
        for name, band in bands.items()
        if name in names and band[0] < float(task[name]) < band[1]
    }


def damping_row(
    task: AbstractTask, coordinates: Coordinates, sd: float | None
) -> tuple[Float[np.ndarray, " free"], ...]:
    """How many of its standard deviations the damping ratio of the active mass changes with each θ.

        ζ = (C_w0 + C_z0) / (2 √((K_w0 + K_z0) m_w)),    row · θ = (ln ζ - ln ζ₀) / sd

    to first order about the task's own ζ₀ (2.3 by default). Nothing where `sd` is None, of a muscle
    that is not the paper's, and where none of these parameters is free.
    """
    if sd is None or not isinstance(task.muscle, Muscle):
        return ()
    k_w, k_z, c_w, c_z = (float(value) for value in task.muscle.base())
    slopes = {
        "c_w": c_w / (c_w + c_z),
        "c_z": c_z / (c_w + c_z),
        "k_w": -0.5 * k_w / (k_w + k_z),
        "k_z": -0.5 * k_z / (k_w + k_z),
        "m_w": -0.5,
    }
    row = np.array([slopes.get(name, 0.0) for name in coordinates.names]) * coordinates.sd / sd
    return (row,) if np.any(row) else ()


def _check_mean(
    task: AbstractTask, free: tuple[str, ...], mean: tuple[float, float] | None
) -> None:
    """Refuse a mean force that no stiffness can reach: at x_z = 0, `F_ext = P_w - K_w x_w` lies
    between 0 and P_w."""
    if mean is not None and task.quantity == "acceleration":
        raise ValueError(f"mean_force = {mean}: the mean of an acceleration is zero; leave it out")
    if mean is None or not isinstance(task, Isometric) or not isinstance(task.muscle, Muscle):
        return
    value, most = mean[0], float(task["P_w"])
    if float(task["x_z"]) != 0 or (value * most > 0 and (abs(value) < abs(most) or "P_w" in free)):
        return
    raise ValueError(
        f"mean_force = {value:g} N cannot be reached: in Isometric the measured force lies between"
        f" 0 and the active force, which is P_w = {most:g} N here, whatever the stiffnesses. Carry"
        f" the muscle to that force first: task = task.at_force({value:g})"
    )


def settings_of(problem: FitProblem, bounds: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    """What a result keeps of the free parameters' prior and bounds, to be taken up again."""
    c = problem.coordinates
    return {
        "free": list(c.names),
        "prior_centre": dict(zip(c.names, map(float, c.centre), strict=True)),
        "prior_sd": {
            n: float(sd) if p else None
            for n, sd, p in zip(c.names, c.sd, problem.prior, strict=True)
        },
        "bounds": {n: with_nulls(np.array(b, dtype=float)) for n, b in bounds.items()},
    }


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

    A parameter is shared under its own name if all tasks that have it let it be free, unless it is
    in `separate` or an input (`INPUTS`); then it is called "name@target", or by its own name if
    only one task has it.
    """
    found: dict[str, dict[str, str]] = {target: {} for target in free}
    for name in dict.fromkeys(n for names in free.values() for n in names):
        holders = [t for t, task in tasks.items() if name in task.parameter_names]
        letting = [t for t in holders if name in free[t]]
        own = name in separate or name in INPUTS or len(letting) < len(holders)
        for target in letting:
            found[target][name] = f"{name}@{target}" if own and len(holders) > 1 else name
    return found


def check_shared(
    tasks: Mapping[str, AbstractTask], separate: Iterable[str], proportional: Iterable[str]
) -> None:
    """Refuse tasks that cannot be of one person: other values of what they share, other kinds of
    noise or muscle."""
    separate, proportional = set(separate), set(proportional)
    known = dict.fromkeys(n for task in tasks.values() for n in task.parameter_names)
    for argument, names in (("separate", separate), ("proportional", proportional)):
        for name in sorted(names - set(known)):
            raise ValueError(f"{argument}: {unknown_parameter(name, known)}")
    if both := sorted(separate & proportional):
        raise ValueError(f"{', '.join(both)} cannot be both separate and proportional")
    for (first, one), (target, other) in itertools.combinations(tasks.items(), 2):
        shared = [
            n
            for n in one.parameter_names
            if n in other.parameter_names and n not in separate and n not in INPUTS
        ]
        for part, mine in (("noise", "noise_"), ("muscle", "")):
            names = [
                n
                for n in shared
                if n.startswith("noise_") == bool(mine) and not n.startswith("harmonic_")
            ]
            a, b = getattr(one, part), getattr(other, part)
            if names and jax.tree.structure(a) != jax.tree.structure(b):
                kinds = (
                    f"{type(a).__name__} and {type(b).__name__}"
                    if type(a) is not type(b)
                    else "differently built"
                )
                raise ValueError(
                    f"the {part} of task {first!r} and that of {target!r} are {kinds}, so"
                    f" {names[0]} cannot be shared: use the same {part}, or list {', '.join(names)}"
                    " in separate"
                )
        for name in shared:
            x, y = float(one[name]), float(other[name])
            if name not in proportional and abs(x - y) > SAME * max(abs(x), abs(y)):
                raise ValueError(
                    f"{name} is {x:g} in task {first!r} and {y:g} in {target!r}, yet they share it:"
                    " make them equal, or list it in separate (a value for each) or in"
                    " proportional (the ratio kept)"
                )
