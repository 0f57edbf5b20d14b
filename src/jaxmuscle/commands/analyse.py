"""`jaxmuscle analyse`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .console import (
    SPECTRUM,
    absent,
    csv_text,
    keep_other_spectrum,
    out,
    plain,
    plain_lines,
    record,
    reporting,
    say_notice,
    say_written,
    spare,
    writable,
)
from .options import (
    READING,
    Force,
    Formats,
    Json,
    Mvc,
    Output,
    Recordings,
    SpectrumName,
    Window,
    formats_of,
)
from .recordings import (
    moved_by_motor,
    perturbed,
    read_perturbed,
    read_trials,
    reads_perturbed,
    tables_of,
    unused,
    windows_of,
)

if TYPE_CHECKING:
    from jaxmuscle.data import Measure, PerturbedRecording, Trials

FITTED = ("force", "torque", "displacement", "acceleration")
VAGUE = 0.05  # s, standard error of a delay that is none
# p below which K, B and I do not describe the points; chi² over its expectation, from which on
# they do not even nearly
UNLIKELY, MISSED = 0.01, 2.0


@reads_perturbed
def analyse(
    paths: Recordings,
    *,
    window: Window = None,
    spectrum: Annotated[
        SpectrumName,
        typer.Option(
            help=(
                "How the spectrum is estimated. standard: bins of 0.39 Hz. slow: bins of 0.1 Hz, to"
                " see below 1 Hz. "
                "multitaper: also below 1 Hz, for recordings shorter than 30 s. pwelch: as MATLAB's"
                " pwelch does."
            )
        ),
    ] = SpectrumName.standard,
    mvc: Mvc = None,
    output: Output = Path("out"),
    formats: Formats = None,
    save_target: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Save the spectrum as a .toml that `jaxmuscle fit` reads."
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
    reading: dict[str, Any],
) -> None:
    """Look at recordings: level, variability, spectrum. Of a moved limb: stiffness, damping, mass.

    Give one recording, or the trials of one person in one condition. The steady part of each is
    found automatically, unless --window gives it. The spectra of several trials are averaged.
    Writes DIR/analysis.json, DIR/spectrum.csv and DIR/analysis.png.

    Of a limb that a motor moved you get the dynamic stiffness instead, with stiffness K, damping B
    and mass I, in DIR/analysis.json, DIR/response.csv and DIR/analysis.png. A joint with torque and
    angle has them in N m/rad, N m s/rad and kg m². With --lever-arm they are in N/m, N s/m and kg,
    and those of the joint stand beside. The columns of force and displacement are found, or named
    with --force-column and --displacement. --column NAME analyses the force alone.

    Examples:

        jaxmuscle analyse trial.csv --column force --rate 2048 --save-target trial.toml

        jaxmuscle analyse trial1.csv trial2.csv trial3.csv --save-target anna.toml

        jaxmuscle analyse trial.csv --column force --spectrum slow --save-target slow.toml

        jaxmuscle analyse trial.c3d --column finger --axis principal --reference stand --window all

        jaxmuscle analyse moved.csv --force-column force_N --displacement displacement_mm
    """
    with reporting(as_json):
        if mvc is not None:
            from jaxmuscle._common.arguments import positive

            positive("--mvc", mvc)
        if save_target is not None and save_target.suffix.lower() != ".toml":
            raise ValueError(
                f"--save-target {save_target}: a target is saved as TOML; give a name that ends in"
                " .toml"
            )
        if save_target is not None:
            spare(paths, [save_target])
            absent(save_target, force=force)
        moved = perturbed(reading) or (
            save_target is None and mvc is None and moved_by_motor(paths, reading)
        )
        writable(
            output,
            "analysis.json",
            *["response.csv"] * moved,
            beside=[SPECTRUM] * (not moved),
            figures=["analysis"],
            reads=paths,
            force=force,
        )
        if moved:
            if save_target is not None or mvc is not None:
                raise ValueError(
                    "--save-target and --mvc belong to spectra, and this recording has a moved"
                    " insertion: leave them out"
                )
            tables = tables_of(paths, reading)
            if len(tables) > 1:
                what = "files are given" if len(paths) > 1 else "sheets hold a signal"
                raise ValueError(
                    f"{len(tables)} {what}; with force and displacement give one at a time"
                )
            return _write_perturbed(
                read_perturbed(tables, reading, windows_of(window, 1))[0],
                str(spectrum),
                output,
                formats_of(formats),
            )
        unused(
            reading,
            *READING,
            what="recordings of a moved insertion, which need --force-column and --displacement",
        )
        _write(
            read_trials(paths, reading, window),
            str(spectrum),
            mvc,
            output,
            formats_of(formats),
            save_target,
        )


def _write(
    trials: "Trials",
    settings: str,
    mvc: float | None,
    folder: Path,
    formats: list[str],
    save_target: Path | None,
) -> None:
    from rich.box import HEAVY_HEAD, SIMPLE_HEAD
    from rich.table import Table

    from jaxmuscle._common.figures import write_figure
    from jaxmuscle._common.files import write_json, write_text

    spectrum, summaries = (
        trials.spectrum(settings),
        [recording.summary(settings) for recording in trials],
    )
    proportional = spectrum.power / spectrum.power.sum()
    columns = {
        "frequency_hz": spectrum.frequency,
        "power": spectrum.power,
        "proportional_power": proportional,
    }
    names = ("name", "source", "unit", "rate", "window", "notices")
    each = [
        {"recording": {key: getattr(recording, key) for key in names}, "summary": summary.to_dict()}
        for recording, summary in zip(trials, summaries, strict=True)
    ]
    several = len(trials) > 1
    found = ({"trials": each} if several else each[0]) | {
        "settings": spectrum.settings.to_dict(),
        "spectrum": {key: values.tolist() for key, values in columns.items()},
    }
    target = None
    fits = trials[0].quantity in FITTED
    if save_target is not None or ((several or mvc is not None) and fits):
        target = trials.target(
            None if save_target is None else save_target.stem, settings=settings, mvc=mvc
        )
    if several and target is not None:
        found["dispersion"] = target.dispersion
    figures = write_figure(trials.plot(settings), folder, "analysis", formats)
    keep_other_spectrum(folder, columns)
    write_text(folder / "spectrum.csv", csv_text(columns))
    write_json(folder / "analysis.json", found)
    # prints its notices itself
    whole = target is not None and (several or target.mvc_fraction is not None)
    for notice in (
        ()
        if whole and not out.quiet
        else trials._notices(settings)
        if target is None
        else target.notices
    ):
        say_notice(notice)
    table = Table(
        title=plain(trials.name if several else trials[0].source),
        title_justify="left",
        show_header=several,
        box=SIMPLE_HEAD if several else HEAVY_HEAD,
        padding=(0, 1),
    )
    table.add_column("", no_wrap=True)
    for recording in trials:
        rest = recording.name.removeprefix(trials.name).strip("_- .") or recording.name
        table.add_column(plain(f"trial {rest}" if rest.isdigit() else rest))
    for row in zip(*(summary.rows() for summary in summaries), strict=True):
        table.add_row(row[0][0], *(plain(value) for _, value in row))
    out.print(table)
    if any(summary.peaks.local_maxima for summary in summaries):
        out.print(
            "Maxima are interpolated between bins. Local maxima are listed if they rise by at least"
            " 1 % of the highest power; they may be chance. A tremor is mostly smaller: jaxmuscle"
            " steadiness looks for its peak.",
        )
    if whole:
        out.print(plain_lines(target))
    written = ["analysis.json", "spectrum.csv", *figures]
    if target is not None and save_target is not None:
        save_target.parent.mkdir(parents=True, exist_ok=True)
        target.save(save_target)
        written.append(str(save_target))
    record(found)
    say_written(folder, *written)


def _write_perturbed(
    recording: "PerturbedRecording", settings: str, folder: Path, formats: list[str]
) -> None:
    from rich.table import Table

    from jaxmuscle._common.figures import write_figure
    from jaxmuscle._common.files import write_json
    from jaxmuscle._common.text import rounded

    response, (delay, vague) = recording.frequency_response(settings), recording.delay(settings)
    classical, (misfit, p) = (
        recording.second_order(settings),
        recording.second_order_misfit(settings),
    )
    numbers = {
        name: {"value": m.value, "stderr": m.stderr, "unit": m.unit}
        for name, m in classical.items()
    }
    numbers["delay"] = {"value": delay, "stderr": vague, "unit": "s"}
    beside = recording.second_order_of_joint(settings)
    figures = write_figure(recording.plot(settings), folder, "analysis", formats)
    response.save(folder / "response.csv")
    names = ("name", "source", "rate", "window", "notices")
    found = {
        "recording": {key: getattr(recording, key) for key in names},
        "response": response.to_table(),
        "second_order": numbers,
        "second_order_misfit": {"chi2_over_expected": misfit, "p": p},
        "passive": {"p": response.known.p_passive[0], "notices": list(response.activity)},
    }
    if beside:
        found["second_order_of_joint"] = {
            name: {"value": m.value, "stderr": m.stderr, "unit": m.unit}
            for name, m in beside.items()
        }
    write_json(folder / "analysis.json", found)
    out.print(plain_lines(recording))
    for line in str(response).splitlines():
        if line.startswith(("  gain", "  phase", "  coherence")):
            out.print(plain(line))
    title = "Spring K, damper B, mass I:\nH = K + iωB - ω²I\n(the delay is of a second fit)"
    table = Table(title=title, title_justify="left", show_header=False)
    for name, m in classical.items():
        table.add_row(name, *(cell for one in (m, beside.get(name)) if one for cell in _told(one)))
    told = " ± ".join(rounded(1e3 * delay, 1e3 * vague)), "ms"
    table.add_row("delay", *(told if vague < VAGUE else ("not determined by this response", "")))
    out.print(table)
    out.print(_described(misfit, p), soft_wrap=True)
    for notice in recording.late(settings):
        say_notice(notice)
    record(found)
    say_written(folder, "analysis.json", "response.csv", *figures)


def _told(measure: "Measure") -> tuple[str, str]:
    return measure.in_words(), measure.unit


def _described(misfit: float, p: float) -> str:
    """Whether a spring, a damper and a mass are the shape of the response."""
    from jaxmuscle._common.text import probability

    sizes = f"chi² is {misfit:.2g} times its expectation, {probability(p)}"
    if p >= UNLIKELY:
        return f"Spring, damper and mass describe the points: {sizes}."
    if misfit <= MISSED:
        return (
            f"Spring, damper and mass describe the points nearly: {sizes}. The errors of K, B and I"
            " contain that."
        )
    return (
        f"Spring, damper and mass do not describe the points: {sizes}. Do not interpret K, B and I."
        " Fit a muscle: jaxmuscle fit FILE --task prescribed-length"
    )
