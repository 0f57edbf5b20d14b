"""Several targets of one person fitted together, with shared parameters."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from jaxmuscle._common.environment import fitting
from jaxmuscle._common.progress import told
from jaxmuscle._common.text import choices
from jaxmuscle.data._frequency_response import FrequencyResponse
from jaxmuscle.data._target import Target
from jaxmuscle.model._noises import with_noise
from jaxmuscle.model._parameters import proper, unknown_parameter
from jaxmuscle.model._rungs import RUNGS, on_rung
from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.objective._arguments import (
    DAMPING,
    Plan,
    base_of,
    check_quantity,
    check_shared,
    free_names,
    joint_names,
    on_joint,
    planned,
    settings_of,
    target_of,
    with_masses,
    with_open_mass,
)
from jaxmuscle.objective._derived import MEAN
from jaxmuscle.objective._options import FitOptions
from jaxmuscle.objective._problem import FitProblem
from jaxmuscle.response._scaling import is_scalable, times_force

from ._model_choice import Models, first_rung
from ._perturbed import ANEW, aimed, alike, recordings_of, seen_with
from ._reflex import check_reflex, may_have_reflex, with_reflex
from ._result import FitResult
from ._search import search

Tasks = dict[str, AbstractTask]
FAR = 0.1  # of a stated mean force


def fit_jointly(
    tasks: Mapping[str, AbstractTask] | None,
    targets: Mapping[str, Any],
    progress: bool | Callable[[str, float], None],
    answer: Callable[[FitResult], None] | None,
    *,
    separate: Iterable[str] = (),
    proportional: Iterable[str] = (),
    mean_force: Mapping[str, tuple[float, float]] | None = None,
    **options: Any,
) -> FitResult:
    """The fit of several targets, see `fit`."""
    usual: dict[str, Any] = {"starts": 32, "seeds": 32, "check_seeds": 0}
    asked = FitOptions(**usual | options)
    rungs = asked.rungs or 0
    loaded = _loaded(targets, tasks or {})
    _check_named(loaded, {"task": tasks or {}, "mean_force": mean_force or {}})
    if rungs and (tasks or rungs >= len(RUNGS)):
        raise ValueError(
            f"rungs = {rungs}: give at most {len(RUNGS) - 1}, and no tasks: they are their own"
            " models"
        )
    moved = {
        name: found
        for name, given in targets.items()
        if (found := recordings_of(given, (tasks or {}).get(name)))
    }

    def as_seen(muscles: Tasks) -> dict[str, Target]:
        """The targets of the moved records, with the answer of these tasks taken off."""
        return {name: seen_with(muscles[name], moved[name]).with_measures() for name in moved}

    def all_models(loaded: dict[str, Target], options: FitOptions) -> Models:
        """The base model, and the richer ones."""
        base, means, carried = (
            _models(loaded, tasks or {}, asked.noise, asked.fix or {}),
            mean_force,
            (),
        )
        options = with_open_mass(options, joint=bool(_joint_of(loaded)))
        if means is None and not tasks and "P_w" not in map(base_of, asked.fix or ()):
            base, means, factor = _at_means(base, loaded)
            carried, options = tuple(means), dataclasses.replace(options, carried=factor)

        def on(rung: int) -> Tasks:
            return {name: on_rung(task, rung) for name, task in base.items()} if rung else base

        def plan_at(rung: int) -> Plan:
            made = on(rung)
            return planned_jointly(made, loaded, options, separate, proportional, means, carried)

        def renewed(muscles: tuple[AbstractTask, ...]) -> Models | None:
            options.progress(ANEW, 0.0)
            fitted = dict(zip(loaded, muscles, strict=True))
            again = loaded | as_seen(fitted)
            return (
                None
                if all(alike(loaded[name], again[name]) for name in moved)
                else all_models(again, options)
            )

        def reflexive(rung: int, seen_by: tuple[AbstractTask, ...]) -> Plan:
            how, made = options, on(rung)
            for name in answering:
                task, how = with_reflex(made[name], options)
                made = made | {name: task}
            aims = loaded | (as_seen(dict(zip(loaded, seen_by, strict=True))) if seen_by else {})
            return planned_jointly(made, aims, how, separate, proportional, means, carried)

        answering = [n for n, task in base.items() if may_have_reflex(task, loaded[n], options)]
        sought = check_reflex(options, possible=bool(answering))
        first = first_rung(list(loaded.values()), 0, rungs)
        return Models(
            first,
            0,
            rungs,
            plan_at,
            renewed if moved else None,
            reflexive if sought else None,
            options.reflex,
        )

    with told(progress, f"fitting {', '.join(loaded)}") as tell, fitting():
        models = all_models(loaded, dataclasses.replace(asked, progress=tell))
        several = rungs > 0 or models.with_reflex is not None
        result = search(models.plan_at(models.first), answer, models if several else None)
    left_out = () if mean_force is not None or not tasks else _far_from_means(result)
    return dataclasses.replace(result, notices=(*result.notices, *left_out))


def _far_from_means(result: FitResult) -> tuple[str, ...]:
    """What to say where the tasks that were given have another mean force than the targets
    state."""
    found = []
    for name, part in result.parts.items():
        stated, own = (
            part.target.mean_force,
            result.derived.get(f"{MEAN}@{name}" if len(result.parts) > 1 else MEAN),
        )
        if stated is not None and own is not None and abs(own.value - stated[0]) > FAR * stated[0]:
            found.append(
                f"{name}: the fitted muscle pulls with {own.value:.3g} N, the recording with"
                f" {stated[0]:.3g} N. The mean force is no datum of tasks that are given: scale"
                f" them (task.at_force), and give mean_force={{{name!r}: (mean, sd)}}. All newtons"
                " here are those of another muscle"
            )
    return tuple(found)


def planned_jointly(
    tasks: Tasks,
    targets: dict[str, Target],
    options: FitOptions,
    separate: Iterable[str] = (),
    proportional: Iterable[str] = (),
    mean_force: Mapping[str, tuple[float, float]] | None = None,
    carried: Iterable[str] = (),
) -> Plan:
    """The fit of several targets, its arguments checked (see `fit`). Needs double precision.

    `carried`: the targets whose P_w is free, too, since it follows from their mean force.
    """
    separate, proportional = tuple(map(proper, separate)), tuple(map(proper, proportional))
    bounds, priors, means = (
        dict(options.bounds or {}),
        dict(options.priors or {}),
        dict(mean_force or {}),
    )
    check_shared(tasks, separate, proportional)
    local = _local_free(
        tasks,
        targets,
        None if options.free is None else tuple(options.free),
        options.fix or (),
        tuple(carried),
        options.also_free,
    )
    names, moved = joint_names(local, tasks, separate), _any_moved(targets)
    known = list(dict.fromkeys(joint for of in names.values() for joint in of.values()))
    _check_known("bounds", bounds, known)
    _check_known("priors", priors, [*known, DAMPING])
    plans = {
        name: planned(
            tasks[name],
            target,
            dataclasses.replace(
                options,
                free=local[name],
                also_free=(),
                fix=None,
                bounds=_own(bounds, names[name]),
                priors=_own(priors, names[name] | {DAMPING: DAMPING}),
                mean_force=means.get(name),
            ),
            moved=moved,
        )
        for name, target in targets.items()
    }
    first = next(iter(plans.values()))
    if len(plans) == 1:
        return first
    problem = FitProblem.shared({name: plan.problem for name, plan in plans.items()}, names)
    settings = (
        first.settings
        | settings_of(problem, bounds)
        | {
            "separate": list(separate),
            "proportional": list(proportional),
            "coefficient_of_variation": {
                n: p.settings["coefficient_of_variation"] for n, p in plans.items()
            },
            "mean_force": {n: p.settings["mean_force"] for n, p in plans.items()},
            "spectrum": {n: p.settings["spectrum"] for n, p in plans.items()},
        }
    )
    return first._replace(problem=problem, settings=settings)


def _loaded(targets: Mapping[str, Any], tasks: Mapping[str, AbstractTask]) -> dict[str, Target]:
    if not targets:
        raise ValueError("target: none given: name at least one")
    for name in targets:
        if not name or "@" in name:
            raise ValueError(f"target: a name must not be empty nor contain '@', as {name!r} does")
    return {name: aimed(t, tasks.get(name)).with_measures() for name, t in targets.items()}


def _check_named(loaded: Mapping[str, Target], given: Mapping[str, Mapping[str, Any]]) -> None:
    for argument, named in given.items():
        for name in named:
            if name not in loaded:
                raise ValueError(
                    f"{argument}: no target is called {name!r}: {choices(name, loaded)}"
                )


def _joint_of(targets: Mapping[str, Target]) -> list[tuple[FrequencyResponse, float]]:
    """Responses that are of a joint, each with its lever arm."""
    answers = [t.stiffness for t in targets.values() if t.stiffness is not None]
    return [(one, one.lever_arm) for one in answers if one.lever_arm is not None]


def _any_moved(targets: Mapping[str, Target]) -> bool:
    """Whether the insertion was moved for one of the targets."""
    return any(target.stiffness is not None for target in targets.values())


def _models(
    targets: dict[str, Target],
    tasks: Mapping[str, AbstractTask],
    noise: Any,
    fix: Mapping[str, float],
) -> Tasks:
    """Every target's task with its noise, its fixed values and the target's settings."""
    found, fixed = (
        {},
        {t: {base_of(n): v for n, v in fix.items() if target_of(n) in ("", t)} for t in targets},
    )
    for name, target in targets.items():
        task = tasks[name] if name in tasks else target.task()
        check_quantity(task, target, name, f"give it a task: {{{name!r}: ...}}")
        found[name] = with_noise(task.with_parts(settings=target.settings), noise, fixed[name])
    held = {name: _holders("fix", name, found) for name in fix}
    return {
        t: task.replace(**{base_of(n): fix[n] for n in fix if t in held[n]})
        for t, task in found.items()
    }


def _holders(argument: str, name: str, tasks: Tasks) -> list[str]:
    """The targets whose task has a parameter, called by its name or as "name@target"."""
    base, target = base_of(name), target_of(name)
    if target and target not in tasks:
        raise ValueError(f"{argument}: {name!r} names no target: {choices(target, tasks)}")
    known = (
        tasks[target].parameter_names
        if target
        else dict.fromkeys(n for t in tasks.values() for n in t.parameter_names)
    )
    if base not in known:
        whose = f"task {target!r} has no parameter" if target else "no task has a parameter"
        raise ValueError(f"{argument}: {whose} {base!r}: {choices(base, known)}")
    return [t for t, task in tasks.items() if base in task.parameter_names and target in ("", t)]


def _local_free(
    tasks: Tasks,
    targets: dict[str, Target],
    free: Iterable[str] | None,
    fix: Iterable[str],
    carried: Iterable[str],
    also: Iterable[str],
) -> dict[str, tuple[str, ...]]:
    """The free parameters of every target's task."""
    found, moved = {}, _any_moved(targets)
    fixed, wanted = (
        {n: _holders(argument, n, tasks) for n in names or ()}
        for argument, names in (("fix", fix), ("free", free))
    )
    for t, task in tasks.items():
        here = [base_of(n) for n, holders in wanted.items() if t in holders]
        if free is not None and not here:
            raise ValueError(
                f"free: none of these belongs to the task of target {t!r}: free one, or leave the"
                " target out"
            )
        held = {base_of(n): 0.0 for n, holders in fixed.items() if t in holders}
        found[t] = free_names(task, None if free is None else here, held, targets[t], moved=moved)
        found[t] += ("P_w",) if t in carried and "P_w" not in found[t] else ()
        found[t] += tuple(n for n in also if n in task.parameter_names and n not in found[t])
    return found


def _at_means(
    tasks: Tasks, targets: dict[str, Target]
) -> tuple[Tasks, dict[str, tuple[float, float]], float | None]:
    """All tasks scaled by one number to the first mean force that a target states, each P_w to its
    own, and carried to the response of a joint; means, number."""
    stated = {
        name: t.mean_force
        for name, t in targets.items()
        if t.mean_force is not None and tasks[name].output_unit == "N"
    }
    if not stated or not all(is_scalable(task.muscle) for task in tasks.values()):
        return tasks, {}, None
    first, (mean, _) = next(iter(stated.items()))
    factor = float(tasks[first].at_force(mean)["P_w"]) / float(tasks[first]["P_w"])
    scaled = {name: times_force(task, factor) for name, task in tasks.items()}
    if _any_moved(targets):
        scaled = {name: with_masses(task, tasks[name], factor) for name, task in scaled.items()}
    for answer, arm in _joint_of(targets)[:1]:
        scaled = {n: on_joint(tasks[n], task, answer, arm) for n, task in scaled.items()}
    own = {
        name: scaled[name].replace(P_w=float(scaled[name]["P_w"]) * value / mean)
        for name, (value, _) in stated.items()
    }
    return scaled | own, stated, factor


def _check_known(argument: str, given: Mapping[str, Any], known: list[str]) -> None:
    for name in given:
        if name not in known and name not in map(base_of, known):
            told = unknown_parameter(name, known, what="unknown or not free parameter")
            raise ValueError(f"{argument}: {told}")


def _own(given: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    """What is given for one target's parameters: by joint name, else by the parameter's own
    name."""
    return {
        local: given.get(joint, given.get(local))
        for local, joint in names.items()
        if joint in given or local in given
    }
