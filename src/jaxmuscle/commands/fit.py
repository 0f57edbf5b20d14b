"""`jaxmuscle fit`."""

import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

import jaxmuscle as jm
from jaxmuscle._common.progress import told

from .console import (
    CONVERGED,
    NOT_CONVERGED,
    REACHED,
    aim_of,
    aimed,
    err,
    fit_files,
    plain,
    record,
    reporting,
    say_written,
    show,
    writable,
    write_fit,
    write_reached,
)
from .options import (
    Fix,
    Force,
    Formats,
    Free,
    Holds,
    Json,
    MethodName,
    Mvc,
    Noise,
    NoiseName,
    Output,
    Quantity,
    ReflexName,
    Seed,
    Segments,
    TargetTask,
    TaskName,
    Window,
    fixed_values,
    formats_of,
    names_in,
)
from .recordings import (
    NO_MOTION,
    read_recordings,
    read_with_holds,
    reads_perturbed,
    require_files,
    unused,
)
from .signals import STAYS, interrupted, stays

RUNGS = 3  # richer models that may be tried
NOTHING = "nothing was written, the fit had no table yet"

NO_MVC = "--mvc gives the level of recordings of a held force, and there are none: leave it out"


@reads_perturbed
def fit(
    target: Annotated[
        list[str],
        typer.Argument(
            help=(
                "A bundled spectrum (see `jaxmuscle targets`), your spectra (.toml, .csv), or"
                " your recordings; or the fit.json of an earlier fit, to print it again."
            )
        ),
    ],
    *,
    window: Window = None,
    hold: Holds = None,
    task: TargetTask = None,
    method: Annotated[
        MethodName,
        typer.Option(
            help=(
                "linear: the model's spectrum comes from a formula, corrected by simulations at the"
                " end. montecarlo: it is "
                "simulated."
            )
        ),
    ] = MethodName.linear,
    noise: Noise = None,
    rungs: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=3,
            help=(
                "Richest model that may be tried: 0 slow part + regular rhythm, 1 with twitch, 2"
                " slow part + twitch + resonance, 3 with two resonances. If you give several"
                " spectra, all get exactly this model."
            ),
        ),
    ] = None,
    rung: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=3,
            help=(
                "Fit just this model: 0 slow part + regular rhythm, 1 with twitch, 2 slow part +"
                " twitch + resonance, 3 with two resonances."
            ),
        ),
    ] = None,
    free: Free = None,
    fix: Fix = None,
    starts: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=(
                "How many starting points the search has: 100 by default, 32 with --hold and for"
                " each richer model, "
                "8 if the task has no linear response."
            ),
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help=(
                "How many recordings are simulated, each with its own noise: 32 by default, 48 if"
                " the task has no linear "
                "response."
            ),
        ),
    ] = None,
    seed: Seed = 0,
    segments: Segments = None,
    quantity: Quantity = None,
    mvc: Mvc = None,
    dataset: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Which dataset to fit, if a digitised figure has several."
        ),
    ] = None,
    axis: Annotated[
        str | None,
        typer.Option(
            help=(
                "Of a digitised figure: log-log if its points are log10 of Hz and of power. Of a"
                " motion-capture point: "
                "x, y, z or principal."
            )
        ),
    ] = None,
    groups: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV with the columns target and group, to compare groups of spectra.",
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help=(
                "Leave out the simulated check, the harmonic's profile and p-value, figure and"
                " report."
            ),
        ),
    ] = False,
    verbose: Annotated[
        bool,
        typer.Option(
            "--verbose",
            "-v",
            help=(
                "Print all numbers of the model, too: parameters, what the data do not determine,"
                " the models that were tried."
            ),
        ),
    ] = False,
    reflex: Annotated[
        ReflexName | None,
        typer.Option(
            help=(
                "Of a moved limb: whether a stretch reflex is looked for beside the muscle, and"
                " fitted if it is seen (auto, the default), left out (none), or fitted in any case"
                " (linear)."
            )
        ),
    ] = None,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
    reading: dict[str, Any],
) -> None:
    """Fit the muscle to a force spectrum, to the recordings of one person, or to the spectra of
    many people.

    Recordings are trials of one person in one condition. Their spectra are averaged. Options such
    as --column say how they are read.

    If a motor moved the insertion, give recordings with a column of force (or torque) and one of
    displacement (or angle). Or give the frequency response: a CSV with the columns frequency, gain,
    phase, and coherence or stderr. Then DIR/stiffness.csv holds the dynamic stiffness, measured and
    fitted.

    With --hold recordings of the held insertion are fitted together with those of the moved one:
    same muscle, one P_w for the moved ones and one for the holds. Here the table is printed only at
    the end. The tables of the spectra are DIR/spectrum-moved.csv, DIR/spectrum-held.csv, and
    DIR/stiffness-moved.csv.

    Several spectra are taken as those of several people. They are fitted together, by the formula
    of the spectrum alone, without simulation.

    For one spectrum or person it prints a table as soon as the search has ended, then what the
    checks add. It writes DIR/fit.json, DIR/fit.png, DIR/spectrum.csv and DIR/report.html.

    For several spectra it writes a folder DIR/TARGET for each, DIR/cohort.csv, DIR/cohort.png and
    DIR/report.html; with --groups also DIR/differences.csv.

    Examples:

        jaxmuscle fit vastus-lateralis-26mvc --out out/fit

        jaxmuscle fit my-spectrum.csv --segments 12 --noise ornstein-uhlenbeck

        jaxmuscle fit fdi-abduction-45mvc --fix m_w=0.1 --free c_w,noise_K_w

        jaxmuscle fit trial1.csv trial2.csv trial3.csv --column force --rate 1000

        jaxmuscle fit perturbed.csv --task prescribed-length

        jaxmuscle fit pull1.csv pull2.csv --hold hold.csv --out out/both

        jaxmuscle fit people/*.toml --groups groups.csv --out out/cohort

        jaxmuscle fit figure.csv --dataset "95 MVC" --segments 6

        jaxmuscle fit out/fit/fit.json --verbose
    """
    with reporting(as_json):
        if len(target) == 1 and target[0].lower().endswith(".json"):
            _print_again(Path(target[0]), verbose=verbose)
        options: dict[str, Any] = {
            "fix": fixed_values(fix),
            "free": names_in(free),
            "noise": None if noise is None else str(noise),
            "starts": starts,
            "key": seed,
        }
        read = {
            "quantity": quantity,
            "segments": segments,
            "dataset": dataset,
            "axis": "linear" if axis is None else axis,
        }
        recorded = _are_recordings(target, hold)
        several = len(target) > 1 and not recorded
        _check_rung(rung, rungs, noise, several=several)
        figures = [] if quick else formats_of(formats)
        if several:
            from .cohort import fit_together

            unused(reading, "axis", "quantity", window=window, what="recordings; these are spectra")
            if verbose:
                raise ValueError("--verbose: of several spectra all numbers are in cohort.csv")
            if method != MethodName.linear or seeds is not None or quick:
                raise ValueError(
                    "several spectra are fitted in one go, without simulation: leave out --method,"
                    " --seeds and --quick, or fit them one at a time"
                )
            options |= {"rung": rungs or 0}
            raise typer.Exit(
                fit_together(target, read, task, groups, output, options, figures, force=force)
            )
        if groups is not None:
            raise ValueError(
                "--groups compares several spectra; to compare recordings of several people use"
                " `jaxmuscle study`"
            )
        _check_mvc(mvc, held=recorded and not hold)
        if recorded and (segments is not None or dataset is not None):
            raise ValueError(
                "--segments and --dataset belong to spectra, and these are recordings: leave"
                " them out"
            )
        options |= {"reflex": str(reflex)} if reflex is not None else {}
        if hold:
            _check_hold(method, options["fix"], task, quantity)
            most = 0 if rung is not None or noise is not None or options["free"] else RUNGS
            options |= {
                "rungs": most if rungs is None else rungs,
                "starts": starts or 32,
                "seeds": 0 if quick else seeds or 32,
            }
            given = read_with_holds(target, hold, reading, window)
            beside = [REACHED, *fit_files(output, ("moved", "held"))]
            writable(output, "fit.json", beside=beside, reads=[*target, *hold], force=force)
            bases = {"moved": jm.PrescribedLength(), "held": jm.Isometric()}
            models = (
                rung if rung is None else {n: jm.model.on_rung(t, rung) for n, t in bases.items()}
            )
            targets = {"moved": given[0], "held": given[1].target()}
            asked = partial(jm.fit, models, targets, **options)
            called = "the moved and the held record"
        else:
            options |= {
                "method": str(method),
                "seeds": seeds,
                "rungs": rungs if rung is None else 0,
            }
            options |= {"check_seeds": 0} if quick else {}
            seen, model = (
                _aim_at_recordings(
                    target, reading, window, task, {"quantity": quantity, "mvc": mvc}
                )
                if recorded
                else _aim_at_spectrum(target[0], reading, window, task, read)
            )
            beside = [REACHED, *fit_files(output)]
            writable(output, "fit.json", beside=beside, reads=target, force=force)
            if rung is not None:
                model = jm.model.on_rung(model, rung)
            asked = partial(jm.fit, model, seen, **options)
            called = seen[0].name if isinstance(seen, list) else seen.name
        converged = _fit_one(asked, called, output, figures, verbose=verbose)
    raise typer.Exit(CONVERGED if converged else NOT_CONVERGED)


def _check_mvc(mvc: float | None, *, held: bool) -> None:
    """Raise a `ValueError` for an --mvc that is none, or without recordings of a `held` force."""
    from jaxmuscle._common.arguments import positive

    if mvc is not None:
        positive("--mvc", mvc)
        if not held:
            raise ValueError(NO_MVC)


def _are_recordings(targets: list[str], holds: list[str] | None) -> bool:
    """Whether the targets are recordings, not spectra; a `ValueError` for both at once, or for
    holds beside spectra."""
    recorded = [jm.data.kind_of_file(name) == "recording" for name in targets]
    # of several spectra the others are fitted all the same
    if len(targets) == 1 or any(recorded):
        require_files(targets)
    if any(recorded) and not all(recorded):
        raise ValueError(
            f"{targets[recorded.index(True)]} is a recording, {targets[recorded.index(False)]} a"
            " spectrum. They cannot be fitted together: fit one at a time, or first make a"
            " spectrum of each recording with `jaxmuscle analyse ... --save-target FILE.toml`"
        )
    if holds and not all(recorded):
        raise ValueError(NO_MOTION)
    return all(recorded)


def _check_rung(
    rung: int | None, rungs: int | None, noise: NoiseName | None, *, several: bool
) -> None:
    """Raise a `ValueError` for a --rung beside --rungs, `several` spectra or --noise."""
    if rung is not None and (rungs is not None or several):
        raise ValueError(
            "--rung fits one model to one spectrum or to recordings of one condition: leave out"
            " --rungs (with several spectra --rungs says which model)"
        )
    if rung and noise is not None:
        raise ValueError(
            "--rung: the models with twitch and resonance have noise of their own; leave out"
            " --noise"
        )


def _check_hold(
    method: MethodName,
    fixed: dict[str, float],
    task: str | None,
    quantity: str | None,
) -> None:
    """Raise a `ValueError` for an option that does not go with --hold."""
    if method != MethodName.linear:
        raise ValueError(
            "with --hold all records are fitted by the formula of the spectrum: leave out --method"
        )
    for name in fixed:
        if "@" in name:
            raise ValueError(
                f"--fix {name}: with --hold a fixed value holds for all records. Give --fix"
                f" {name.partition('@')[0]}=VALUE"
            )
    if task not in (None, "prescribed-length") or quantity is not None:
        raise ValueError(
            "with --hold the records are those of a moved insertion, and of the force in a"
            " hold: leave out --task and --quantity"
        )


def _aim_at_recordings(
    paths: list[str],
    reading: dict[str, Any],
    window: str | None,
    task: TaskName | None,
    known: dict[str, Any],
) -> tuple[Any, Any]:
    """Perturbed recordings, or the target that others give, and the task to fit to it."""
    found = read_recordings(paths, reading, window, task)
    if isinstance(found, list):
        if known["mvc"] is not None:
            raise ValueError(NO_MVC)
        return found, jm.model.TASKS[task or "prescribed-length"]()
    return aimed(found.target(**known), task)


def _aim_at_spectrum(
    name: str,
    reading: dict[str, Any],
    window: str | None,
    task: TaskName | None,
    read: dict[str, Any],
) -> tuple[Any, Any]:
    """The target of a spectrum or a frequency response, and the task to fit to it."""
    if jm.data.kind_of_file(name) != "frequency response":
        unused(reading, "axis", "quantity", window=window, what="recordings; this is a spectrum")
        return aim_of(name, task, read)
    what = "recordings; this is a frequency response"
    unused(reading, "axis", "lever_arm", "quantity", window=window, what=what)
    return aim_of(name, task, {"segments": read["segments"], "lever_arm": reading["lever_arm"]})


def _print_again(path: Path, *, verbose: bool) -> NoReturn:
    """Print an earlier fit, and end as that did."""
    result = jm.load_result(path)
    record(path)
    _say(result, path, verbose=verbose)
    raise typer.Exit(CONVERGED if result.success else NOT_CONVERGED)


def _say(result: Any, saved: Path, *, verbose: bool) -> None:
    from jaxmuscle.reports import fit_text

    text = result.details() if verbose else fit_text(result, str(saved))
    show(text, success=result.success and result.adequate is not False)


def _fit_one(
    fit: Callable[..., Any],
    called: str,
    folder: Path,
    formats: list[str],
    *,
    verbose: bool,
) -> bool:
    """Fit, write, print; the fit is written as soon as the search has ended, before its checks."""
    reached = []

    def answer(result: Any) -> None:
        write_fit(result, folder)  # a program of the checks may run longer than a signal can wait
        reached.append(result)
        stays(f"{STAYS}; not checked: {folder / 'fit.json'}")

    stays(NOTHING)
    try:
        with told(True, f"fitting {called}") as tell:
            result = fit(progress=tell, answer=answer)
            tell("writing", 1.0)
            files = write_fit(result, folder, formats, report=True)
    except jm.fits.FitInterrupted as stop:
        if not reached:
            write_reached(stop, folder)
        write_fit(stop.result, folder)
        record(folder / "fit.json")
        _say(stop.result, folder / "fit.json", verbose=verbose)
        err.print(f"interrupted: what had been reached is in {plain(folder)}")
        raise typer.Exit(interrupted()) from None
    except KeyboardInterrupt:
        if reached:
            raise
        with contextlib.suppress(OSError):
            folder.rmdir()  # made for this fit, and empty
        err.print(f"interrupted: {NOTHING}")
        raise typer.Exit(interrupted()) from None
    record(folder / "fit.json")
    _say(result, folder / "fit.json", verbose=verbose)
    say_written(folder, *files)
    return result.success
