"""`jaxmuscle fit`."""

from pathlib import Path
from typing import Annotated, Any

import typer

import jaxmuscle as jm
from jaxmuscle._common.progress import told

from .console import CONVERGED, INTERRUPTED, NOT_CONVERGED, aim_of, err, out, plain, reporting, show, writable, write_fit
from .options import (
    AxisName,
    Fix,
    Free,
    MethodName,
    Noise,
    Output,
    Quantity,
    ResidualName,
    Seed,
    Segments,
    TargetTask,
    fixed_values,
    names_in,
)


def fit(
    target: Annotated[
        list[str], typer.Argument(help="Bundled target (see `jaxmuscle targets`) or path of a .toml, .csv, .json, .tar.")
    ],
    task: TargetTask = None,
    method: Annotated[
        MethodName, typer.Option(help="Spectrum in linear response, then corrected; or simulated.")
    ] = MethodName.linear,
    noise: Noise = None,
    rungs: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=3,
            help="Richer models that may be tried: activation, tremor, a second one. Of several targets: what all get.",
        ),
    ] = None,
    residual: Annotated[ResidualName, typer.Option(help="What is compared.")] = ResidualName.log,
    free: Free = None,
    fix: Fix = None,
    starts: Annotated[
        int | None, typer.Option(min=1, help="Starting points; 100, or 8 where there is no linear response.")
    ] = None,
    seeds: Annotated[
        int | None, typer.Option(min=1, help="Noise paths; 32, or 48 where there is no linear response.")
    ] = None,
    seed: Seed = 0,
    segments: Segments = None,
    quantity: Quantity = None,
    dataset: Annotated[str | None, typer.Option(metavar="NAME", help="Which dataset of a digitised figure.")] = None,
    axis: Annotated[
        AxisName, typer.Option(help="log-log: a digitised figure's points are log10 of Hz and of power.")
    ] = AxisName.linear,
    groups: Annotated[
        Path | None, typer.Option(metavar="FILE", help="CSV with the columns target, group (several targets).")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Leave out simulated check, profile of the harmonic, p-value and figure.")
    ] = False,
    output: Output = Path("out"),
) -> None:
    """Fit the muscle to a target spectrum, or to those of many people together.

    Prints a table as soon as the search has ended, then what the checks on simulated seeds add. Writes DIR/fit.json,
    DIR/fit.png and DIR/spectrum.csv. Several targets: DIR/TARGET/... and DIR/cohort.csv, cohort.png (and differences.csv
    with groups); fitted in linear response, without its last checks.

    Examples:

        jaxmuscle fit vastus-lateralis-26mvc --out out/fit

        jaxmuscle fit my-spectrum.csv --segments 12 --noise ornstein-uhlenbeck

        jaxmuscle fit fdi-abduction-45mvc --fix m_w=0.1 --free c_w,noise_K_w

        jaxmuscle fit people/*.csv --groups groups.csv --out out/cohort

        jaxmuscle fit figure.tar --dataset "95 MVC" --segments 6
    """
    with reporting():
        from jaxmuscle._common.environment import keep_compiled_programs

        keep_compiled_programs()
        fixed = fixed_values(fix)
        names = names_in(free)
        read = {"quantity": quantity, "segments": segments, "dataset": dataset, "axis": str(axis)}
        options = {
            "free": names,
            "fix": fixed,
            "noise": None if noise is None else str(noise),
            "residual": str(residual),
            "starts": starts,
            "key": seed,
        }
        if len(target) > 1:
            from .cohort import fit_together

            if method != MethodName.linear or seeds is not None or quick:
                raise ValueError("several targets are fitted together in linear response, without checks: leave out "
                                 "--method, --seeds and --quick, or fit them one at a time")  # fmt: skip
            raise typer.Exit(fit_together(target, read, task, groups, output, options | {"rung": rungs or 0}))
        if groups is not None:
            raise ValueError("--groups needs several targets")
        options |= {"method": str(method), "seeds": seeds, "rungs": rungs}
        options |= {"check_seeds": 0} if quick else {}
        converged = _fit_one(*aim_of(target[0], task, read), output, options, quick=quick)
    raise typer.Exit(CONVERGED if converged else NOT_CONVERGED)


def _fit_one(target: Any, model: Any, folder: Path, options: dict[str, Any], *, quick: bool) -> bool:
    """The table as soon as the search has ended, then what the checks add; Ctrl-C in these keeps the fit."""
    writable(folder)
    printed = []

    def answer(result: Any) -> None:
        show(result, success=result.success and result.adequate is not False)
        printed.append(result)

    try:
        with told(True, f"fitting {target.name}") as tell:
            result = jm.fit(model, target, progress=tell, answer=answer, **options)
            tell("writing", 1.0)
            write_fit(result, folder, figure=not quick)
    except jm.fits.FitInterrupted as stop:
        write_fit(stop.result, folder, figure=False)
        err.print(f"interrupted: what had been reached is in {folder}")
        raise typer.Exit(INTERRUPTED) from None
    if not printed:
        answer(result)
    told_before = {*printed[0].remarks, *printed[0].notices}
    for sentence in (*result.remarks, *(f"note: {notice}" for notice in result.notices)):
        if sentence.removeprefix("note: ") not in told_before:
            out.print(plain(sentence), highlight=False)
    out.print(f"Written: {folder}/fit.json, {'' if quick else 'fit.png, '}spectrum.csv", highlight=False, soft_wrap=True)
    return result.success
