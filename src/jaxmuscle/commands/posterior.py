"""`jaxmuscle posterior`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import jaxmuscle as jm
from jaxmuscle._common.progress import told

from .console import (
    CONVERGED,
    NOT_CONVERGED,
    REACHED,
    err,
    fit_into,
    fit_unless_taken_up,
    out,
    parts_of,
    plain,
    record,
    reporting,
    say_failure,
    show,
    writable,
)
from .options import (
    Fix,
    Force,
    Formats,
    Free,
    Json,
    Noise,
    Output,
    Quantity,
    Seed,
    Segments,
    TargetTask,
    formats_of,
)

if TYPE_CHECKING:
    from jaxmuscle.uncertainty import Posterior


def posterior(
    target: Annotated[
        str,
        typer.Argument(
            help="A bundled spectrum, the file of a spectrum or recording, or a fit.json."
        ),
    ],
    task: TargetTask = None,
    noise: Noise = None,
    free: Free = None,
    fix: Fix = None,
    segments: Segments = None,
    quantity: Quantity = None,
    chains: Annotated[int, typer.Option(min=2, max=10**6, help="How many chains are run.")] = 4,
    draws: Annotated[
        int | None,
        typer.Option(
            min=100,
            max=10**9,
            help=(
                "How many draws each chain makes. If you leave it out: 600, or more (up to 3000)"
                " until they mix."
            ),
        ),
    ] = None,
    warmup: Annotated[
        int,
        typer.Option(min=1, max=10**9, help="How many steps each chain makes before its draws."),
    ] = 400,
    seed: Seed = 0,
    output: Output = Path("out"),
    formats: Formats = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Draw the posterior of a fit: the probability of all its parameters together, given your data.

    Fits first (unless
    given a fit.json), then draws from the posterior with several random chains (Hamiltonian Monte
    Carlo). Writes DIR/fit.json, DIR/posterior.nc (for ArviZ), DIR/posterior.json, corner.png,
    predictive.png, chains.png and report.html. The exit code is 1 if the fit failed or the chains
    do not agree with each other. Then there is no summary.

    Examples:

        jaxmuscle posterior vastus-lateralis-26mvc --out out/posterior

        jaxmuscle posterior out/fit/fit.json --draws 4000

        jaxmuscle posterior my-spectrum.csv --segments 12 --noise ornstein-uhlenbeck
    """
    with reporting(as_json):
        from jaxmuscle._common.arguments import require_extra
        from jaxmuscle.reports import REPORT

        require_extra("posterior")
        several = [output / "posterior.json", *[Path(target)] * target.endswith(".json")]
        drawn = [f"predictive-{name}" for path in several for name in parts_of(path)]
        writable(
            output,
            *fit_unless_taken_up(output, target),
            "posterior.nc",
            "posterior.json",
            beside=[REACHED, REPORT],
            figures=["corner", "predictive", "chains", *drawn],
            reads=[target],
            force=force,
        )
        asked = {
            "task": task,
            "noise": None if noise is None else str(noise),
            "free": free,
            "fix": fix,
        }
        result = fit_into(output, target, {"segments": segments, "quantity": quantity}, asked, seed)
        try:
            with told(True, f"posterior of {result.title}") as tell:
                found = jm.posterior(
                    result, key=seed, chains=chains, draws=draws, warmup=warmup, progress=tell
                )
        except KeyboardInterrupt:
            folder = plain(output)
            err.print(
                f"the fit stays: go on with jaxmuscle posterior {folder}/fit.json --out {folder}",
                soft_wrap=True,
            )
            raise
        _write(found, output, formats_of(formats))
        record(output / "posterior.json")
        _show(found, output)
    raise typer.Exit(CONVERGED if found.success else NOT_CONVERGED)


def _write(found: "Posterior", folder: Path, formats: list[str]) -> None:
    from jaxmuscle._common.figures import pixels_of, remove_figures, write_figure
    from jaxmuscle._common.names import file_names
    from jaxmuscle.reports import posterior_report

    earlier = [f"predictive-{name}" for name in parts_of(folder / "posterior.json")]
    remove_figures(folder, "corner", "predictive", *earlier)
    found.save(folder / "posterior.nc")
    found.save(folder / "posterior.json")
    figures: dict[str, Any] = {}
    if found.success:
        figures |= {"corner": found.plot()}
        for name, called in file_names(found.parts).items():
            which = f"-{called}" * (len(found.parts) > 1)
            figures[f"predictive{which}"] = found.plot_predictive(target=name).figure
    figures["chains"] = found.plot_chains()
    drawn = {"chains": pixels_of(figures["chains"])}  # thousands of lines: they are drawn once
    posterior_report(found, figures, folder, drawn)
    for name, figure in figures.items():
        write_figure(figure, folder, name, formats, pixels=drawn.get(name))


def _show(found: "Posterior", folder: Path) -> None:
    if not found.success:
        say_failure(f"{found.message}; the chains are in {folder}")
        return
    show(found.summary(), success=True)
    out.print(f"written to {plain(folder)}", soft_wrap=True)
