"""report.html of a fit, a cohort, a study and a posterior: verdict, numbers, figures, what to do,
how it was made."""

import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxmuscle._common import pages
from jaxmuscle._common.environment import versions
from jaxmuscle._common.figures import pixels_of
from jaxmuscle._common.pages import Html
from jaxmuscle.data._measure import Measure
from jaxmuscle.plot._numbers import in_print

from ._cohort_text import judged_in_words
from ._ladder_text import format_p
from ._study_text import (
    GLOSS,
    WORDS,
    clear_in_words,
    clearest_first,
    compared_in_words,
    difference_in_words,
    is_clear,
    missing_in_words,
    n_in_words,
    only_some_described,
    p_in_words,
    people_in_words,
    people_of_columns,
    study_notices,
    table_1,
    trials_in_words,
)

if TYPE_CHECKING:
    from jaxmuscle.fits._cohort import CohortResult
    from jaxmuscle.fits._result import FitResult
    from jaxmuscle.fits._study import StudyResult
    from jaxmuscle.uncertainty._posterior import Posterior

REPORT = "report.html"
WOULD = "What the data would determine if the model held"
# names of settings that say too little
SPELT_OUT = {"carried": "multiplied, to come to the mean force"}
OF_MODEL = ("rung", "noise", "starts", "key")  # options of a study
STATE = 4  # the column of a fit's card that says whether the data determine a number
PARAMETERS = ("name", "value", "95 % interval", "unit", "what it is")
COMPARED = (
    "quantity",
    "groups",
    "difference of means",
    "95 % interval",
    "unit",
    "n",
    "left out",
)
FIGURES = {
    "fit": (
        "Points: the data, with the range of one standard deviation. Blue line: fit. Bars:"
        " residuals, up where the data lie above the fit; the grey bands are one and two standard"
        " deviations. Orange-red bars are beyond them."
    ),
    "stiffness": (
        "Points: measured dynamic stiffness with two standard errors either way. Blue line: fit."
    ),
    "cohort": (
        "What the data of at least half of the targets determine, with standard errors. Spectra:"
        " every target (thin), the geometric mean of each group with its standard error (thick)."
    ),
    "quantities": (
        "What is compared. Small dots: people, joined from condition to condition. Beside them:"
        " their mean with its 95 % interval. Above: p of the difference within people, corrected."
    ),
    "spectra": (
        "Spectra of all people (thin), and their geometric mean with its standard error (thick)."
        " Triangles: tremors of people."
    ),
    "trials": (
        "All recordings. Shaded: what is analysed. Those of a person have one scale; the times and"
        " columns are in the table below."
    ),
    "corner": (
        "What the data determine. Diagonal: density, median and 95 % interval. Below it: regions of"
        " 50, 80 and 95 %."
    ),
    "predictive": "The target among spectra that the posterior predicts.",
    "chains": "Each line is a chain. Lines that lie upon each other agree.",
}


# what to do with draws that may not be believed (False), and with others (True)
AFTER_A_POSTERIOR = {
    True: (
        "Report medians with their 95 % intervals, R-hat and the effective sample sizes.",
        "All draws are in posterior.nc: `arviz.from_netcdf` reads it.",
    ),
    False: (
        "Do not use these draws.",
        "Draw longer: `--warmup 2000 --draws 4000`.",
        "Or fit again with some of the parameters fixed that the data do not determine"
        " (`jaxmuscle fit ... --fix NAME=VALUE`), and draw from that fit.",
    ),
}


def fit_report(result: "FitResult", figure: Any, folder: Path) -> None:
    """Write report.html of a fit of one target, or of several of one person."""
    card = result.summary()
    rows = {
        state: [row[:STATE] + row[STATE + 1 :] for row in card.rows if row[STATE] == state]
        for state in ("determined", "not determined", "fixed")
    }
    held = result.adequate is not False
    body = [
        _verdict(card.heading, good=False if not result.success else result.adequate),
        pages.picture(figure, FIGURES["fit" if _has_spectrum(result) else "stiffness"]),
        *_measured(result.measured),
        *_table(
            "What the data determine" if held else WOULD,
            PARAMETERS,
            rows["determined"],
            otherwise="Nothing.",
        ),
        *_tried(result),
        *_list("What to know about this fit", card.remarks),
    ]
    if result.undetermined:
        body += [pages.paragraph("The data leave open:"), pages.items(result.undetermined)]
    body += [
        *_list("What to do next", _after_a_fit(result, folder / "fit.json")),
        *_table(
            "What the data do not determine",
            PARAMETERS,
            rows["not determined"],
            said="Do not interpret these values.",
            summary=f"{len(rows['not determined'])} values",
        ),
        *_table(
            "What was fixed", PARAMETERS, rows["fixed"], summary=f"{len(rows['fixed'])} values"
        ),
    ]
    if methods := result.methods():
        body += [pages.heading("For your methods section"), pages.paragraph(methods)]
    body += _data(result.targets)
    body += _how(result.settings | {"method": result.method, "seed": result.seed}, result.versions)
    pages.write_page(folder / REPORT, result.title, body)


def _measured(measures: Mapping[str, Measure]) -> list[Html]:
    """What papers state; what else is measured, folded. In words, shares in percent."""
    columns = ("", *PARAMETERS[1 : STATE - 1])
    rows: dict[bool, list[tuple[str, ...]]] = {True: [], False: []}
    for name, m in measures.items():
        scale, words = in_print(name, m.unit)
        scaled = m.times(scale)
        rows[name in WORDS].append((words, scaled.in_words(), scaled.interval_in_words()))
    stated, others = rows[True], rows[False]
    body = _table("What is measured", columns, stated or others)
    if stated and others:
        body.append(pages.folded(f"{len(others)} more numbers", pages.table(columns, others)))
    return body


def _tried(result: "FitResult") -> list[Html]:
    """The models that were tried, where there were several."""
    rows = [
        (
            str(rung.number),
            rung.model,
            f"{rung.chi2_per_bin:.2f}",
            format_p(rung.p),
            f"{rung.aic:.1f}",
            "the result" if rung.chosen else "",
        )
        for rung in result.ladder
    ]
    return _table(
        "Models tried",
        ("", "model", "chi2 per bin", "p", "AIC", ""),
        rows if len(rows) > 1 else [],
        said="Simplest first. The numbers are those before the correction by simulation.",
    )


def cohort_report(cohort: "CohortResult", figure: Any | None, folder: Path) -> None:
    """Write report.html of a cohort."""
    numbers = [
        (
            row["target"],
            row["group"],
            row["quantity"],
            f"{row['value']:.3g} ± {row['stderr']:.2g}",
            _unit(row["unit"]),
        )
        for row in cohort.table()
        if row["stderr"] is not None
    ]
    card = cohort.summary()
    body = [
        _judged(cohort),
        *([pages.picture(figure, FIGURES["cohort"])] if figure is not None else []),
        pages.table(card.columns, card.rows),
    ]
    differences = [
        (
            d.quantity,
            f"{d.b} - {d.a}",
            f"{d.difference:.3g}",
            f"{d.low:.3g} to {d.high:.3g}",
            _unit(d.unit),
            n_in_words(d),
            str(d.left_out),
        )
        for d in cohort.differences()
    ]
    body += [
        *_table(
            "What differs between groups",
            COMPARED,
            differences,
            said="The intervals are not corrected for the number of comparisons.",
            summary=f"{len(differences)} comparisons",
        ),
        *_table(
            "What the data determine",
            ("target", "group", "quantity", "value", "unit"),
            numbers,
            otherwise="Nothing.",
            summary=f"{len(numbers)} numbers",
        ),
        *_list(
            "What to do next",
            (
                "Fit a target alone for the checks that a cohort leaves out: `jaxmuscle fit"
                " TARGET`.",
                "Do not interpret the numbers of a target that the model does not describe.",
                "All numbers are in cohort.csv; each fit is in the folder of its target.",
            ),
        ),
    ]
    first = next(iter(cohort.results.values()))
    body += _how(first.settings | {"method": first.method, "seed": first.seed}, first.versions)
    pages.write_page(folder / REPORT, f"{len(cohort.results)} targets", body)


# what a table of each kind of comparison is called, and what `where` is in it
KINDS = {
    "groups": ("Groups, in each condition", "condition"),
    "conditions": ("Conditions, within people", ""),
    "interaction": ("Change between conditions, of groups", "change"),
}
SIZES = ("difference", "interval", "p", "p corrected", "n", "left out")


def study_report(study: "StudyResult", folder: Path) -> None:
    """Write report.html of a study."""
    import matplotlib.pyplot as plt

    figures = study.figures()
    # thousands of points: as SVG they are many times as large
    drawn = {"trials": pixels_of(figures["trials"])}
    picture = dict(zip(figures, _pictures(figures, drawn), strict=True))
    for figure in figures.values():
        plt.close(figure)
    heads, lines = table_1(study)
    heads = [f"{head} (n = {n})" for head, n in zip(heads, people_of_columns(study), strict=True)]
    missing = missing_in_words(study)
    options = {n: v for n, v in study.options.items() if study.aic or n not in OF_MODEL}
    body = [
        pages.items((people_in_words(study), trials_in_words(study))),
        *([_judged(study.cohort)] if study.aic else []),
        *(shown for name, shown in picture.items() if name != "trials"),
        *_table(
            "Table 1: mean ± SD of people",
            ("", *heads),
            [(words, *cells) for words, cells in lines],
            said=f"{GLOSS}. In brackets: n, where it is less than that of the column.",
        ),
        *_differences(study),
        *([pages.heading("What is not known"), pages.paragraph(missing)] if missing else []),
        *(_fits(study.cohort) if study.aic else []),
        pages.heading("For your methods section"),
        pages.paragraph(study.methods()),
        *_list(
            "What to do next",
            (
                "Report p corrected, n and how many people were left out of each comparison.",
                *([only_some] if (only_some := only_some_described(study)) else []),
                "All numbers are in table1.csv, people.csv, differences.csv and trials.csv.",
            ),
        ),
        *_recordings(study, picture["trials"]),
        *_how(options | {"source": study.source}, versions()),
    ]
    pages.write_page(folder / REPORT, "Study", body)


def _recordings(study: "StudyResult", picture: Html) -> list[Html]:
    """What was analysed, what is to be noticed of it."""
    rows = [
        (
            r["person"],
            ", ".join(filter(None, (r["group"], r["condition"]))),
            r["trial"],
            r["file"],
            r["column"],
            f"{r['rate_hz']:g}",
            f"{r['start_s']:.2f}",
            f"{r['stop_s']:.2f}",
            r["chosen"],
        )
        for r in study.trials()
    ]
    columns = ("person", "", "trial", "file", "column", "rate, Hz", "start, s", "stop, s", "part")
    notices = study_notices(study)
    return [
        pages.heading("What was analysed"),
        *([pages.items(notices)] if notices else []),
        picture,
        pages.folded(f"{len(rows)} recordings", pages.table(columns, rows)),
    ]


def _differences(study: "StudyResult") -> list[Html]:
    """A table of each kind of comparison, the clearest first; those that are not clear folded."""
    found, alpha = clearest_first(study), study.options["alpha"]
    if not found:
        return [pages.heading("What differs"), pages.paragraph("Nothing could be compared.")]
    body = [
        pages.heading("What differs"),
        pages.paragraph(
            f"{clear_in_words(found, study)}. The {100 * (1 - alpha):g} % intervals are of single"
            " comparisons. n: people."
        ),
    ]
    for kind, (title, where) in KINDS.items():
        columns = ("quantity", where, "compared", *SIZES)
        rows = {True: [], False: []}
        for d in found:
            if d.kind == kind:
                rows[is_clear(d, alpha)].append(
                    (
                        *compared_in_words(d),
                        *difference_in_words(d),
                        p_in_words(d.p),
                        p_in_words(d.p_corrected),
                        n_in_words(d),
                        str(d.left_out),
                    )
                )
        if any(rows.values()):
            body.append(pages.heading(title, 3))
        if rows[True]:
            body.append(pages.table(columns, rows[True]))
        if rows[False]:
            said = f"{len(rows[False])} with p >= {alpha:g}"
            body.append(pages.folded(said, pages.table(columns, rows[False])))
    return body


def _fits(cohort: "CohortResult") -> list[Html]:
    """What the verdict on each fit is, those that are not described first."""
    rows = [(name, *judged_in_words(result)) for name, result in cohort.results.items()]
    rows += [(name, "", "", "", f"not fitted: {why}") for name, why in cohort.failed.items()]
    rows.sort(key=lambda row: row[-1] == "described")
    columns = ("person and condition", "chi2 per bin", "expected", "p", "by the model")
    return [
        pages.heading("The fits"),
        pages.folded(f"{len(rows)} fits", pages.table(columns, rows)),
    ]


def _judged(cohort: "CohortResult") -> Html:
    """The verdict on all fits, in the colour of the worst of them."""
    judged = [result.adequate for result in cohort.results.values()]
    good = cohort.success and False not in judged
    return _verdict(cohort.verdict, good=None if good and None in judged else good)


def posterior_report(
    found: "Posterior", figures: dict[str, Any], folder: Path, drawn: dict[str, bytes]
) -> None:
    """Write report.html of a posterior. `drawn` has the PNG of figures that have too many lines for
    SVG."""
    body = [_verdict(found.message, good=found.success)]
    if found.success:
        summary = found.summary()
        columns = ("name", "median", "95 % interval", "unit", "R-hat", "effective sample size")
        rows: dict[bool, list[tuple[str, ...]]] = {True: [], False: []}
        for name, told in summary.rows.items():
            unit, size = _unit(told["unit"]), min(told["ess_bulk"], told["ess_tail"])
            rows[told["determined"]].append(
                (
                    name,
                    f"{told['median']:.4g}",
                    f"{told['low']:.4g} to {told['high']:.4g}",
                    unit,
                    f"{told['r_hat']:.3f}",
                    f"{size:.0f}",
                )
            )
        body += _table("What the data determine", columns, rows[True], otherwise="Nothing.")
        body += _pictures(figures, drawn)
        body += _table(
            "What the data do not determine",
            columns,
            rows[False],
            said="These come from the prior. Do not interpret them.",
        )
    else:
        body += _pictures(figures, drawn)
    body += [
        pages.heading("What to know about this posterior"),
        pages.code(str(found)),
        *_list("What to do next", AFTER_A_POSTERIOR[found.success]),
        *_data({name: part.target for name, part in found.parts.items()}),
        *_how(found.settings | {"seed": found.seed}, found.versions),
    ]
    pages.write_page(folder / REPORT, f"Posterior of {found.title}", body)


def _table(
    title: str,
    columns: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    said: str = "",
    otherwise: str = "",
    summary: str = "",
) -> list[Html]:
    """A section with a table, folded behind its `summary` if it has one; without rows what is said
    `otherwise`, or nothing at all."""
    if not rows:
        return [pages.heading(title), pages.paragraph(otherwise)] if otherwise else []
    before = [pages.paragraph(said)] if said else []
    table = pages.table(columns, rows)
    return [pages.heading(title), *before, pages.folded(summary, table) if summary else table]


def _list(title: str, texts: Iterable[str]) -> list[Html]:
    """A section with a list."""
    return [pages.heading(title), pages.items(texts)]


def _unit(unit: str) -> str:
    return "" if unit == "1" else unit


def _pictures(figures: dict[str, Any], drawn: dict[str, bytes]) -> list[Html]:
    return [
        pages.picture(figure, FIGURES[name.partition("-")[0]], pixels=drawn.get(name))
        for name, figure in figures.items()
    ]


def _verdict(words: str, *, good: bool | None) -> Html:
    said = words[:1].upper() + words[1:]
    kind = "open" if good is None else "yes" if good else "no"
    return pages.paragraph(said if said.endswith(".") else f"{said}.", f"verdict {kind}")


def _after_a_fit(result: "FitResult", path: Path) -> list[str]:
    """What helps in this case, with the command."""
    if not result.success:
        return [
            "Do not use these numbers.",
            "Search from more starts: `--starts 400`.",
            "Or leave less to the search: `--fix NAME=VALUE`, `--free NAMES`.",
        ]
    if result.adequate is None:
        return [
            (
                "Say how much the powers scatter: `--segments N`, the number of Welch segments that"
                " were averaged."
            ),
            "Then the fit can be judged.",
        ]
    single = len(result.parts) == 1
    place, other = shlex.quote(str(path)), shlex.quote(str(path.parent / "compare"))
    if not result.adequate:
        return [
            "Report what is measured, and that the model does not describe the data.",
            "Look at the residuals: orange-red bars are where the model misses the data.",
            "See whether the recording drifts: `jaxmuscle analyse RECORDING`.",
            *(
                [
                    f"Try other noises: `jaxmuscle compare {place} --out {other}`. That takes as"
                    " long as all fits so far."
                ]
                if single and _has_spectrum(result)
                else []
            ),
        ]
    return [
        f"How sure is each number? `jaxmuscle posterior {place}` draws from the posterior.",
        *([f"Move the parameters yourself: `jaxmuscle explore {place}`."] if single else []),
        f"What should you measure to know the rest? `jaxmuscle identifiability {place}`.",
        (
            'In a paper, give the parameters under "What the data determine" with their intervals,'
            " unless a note says not to, beside those that are measured."
        ),
        "Name those that the data do not determine.",
    ]


def _has_spectrum(result: "FitResult") -> bool:
    return any(part.fitted.size > 0 for part in result.parts.values())


def _data(targets: dict[str, Any]) -> list[Html]:
    return [pages.heading("The data"), *(pages.code(str(target)) for target in targets.values())]


def _how(settings: dict[str, Any], versions: dict[str, str]) -> list[Html]:
    """The command, settings and versions."""
    return [
        pages.heading("How to repeat this"),
        pages.code(shlex.join(["jaxmuscle", *sys.argv[1:]])),
        pages.folded(
            f"{len(settings)} settings",
            pages.settings_table(
                {SPELT_OUT.get(name, name): value for name, value in settings.items()}
            ),
        ),
        pages.paragraph(
            "Versions: " + ", ".join(f"{name} {number}" for name, number in versions.items())
        ),
    ]
