"""A cohort in words: a line for each target, and what differs between groups."""

from collections import Counter

from jaxmuscle._common.cards import Card, in_columns
from jaxmuscle._common.text import folded, rounded
from jaxmuscle.fits._cohort import CohortResult
from jaxmuscle.fits._differences import Difference
from jaxmuscle.fits._result import FitResult

from ._ladder_text import format_p

MOST = 6  # comparisons on a terminal
SHOWN = {"corner_frequency": "corner, Hz", "harmonic_frequency": "harmonic, Hz"}
COLUMNS = ("target", "group", *SHOWN.values(), "chi2/bin", "expected", "p", "model")

EXPECTED = ". In brackets: chi2 as expected"


def cohort_card(cohort: CohortResult) -> Card:
    """Every target with what is known of it and its verdict, why others were not fitted, and the
    clearest differences between groups."""
    rows = [
        (name, cohort.groups.get(name, ""), *_numbers(result), *judged_in_words(result))
        for name, result in cohort.results.items()
    ]
    groups = "; ".join(f"{group} {n}" for group, n in Counter(cohort.groups.values()).items())
    number = len(cohort.results) + len(cohort.failed)
    heading = f"{number} targets" + f" ({groups})" * bool(groups)
    lines = [folded([f"COHORT  {heading}", f"MODEL  {cohort.verdict}{EXPECTED}"])]
    if rows:
        lines += in_columns(*_shown(rows))
    lines.append(folded([f"  not fitted: {name}: {why}" for name, why in cohort.failed.items()]))
    lines.append(folded(_differences(cohort.differences())))
    none = ("",) * (len(COLUMNS) - 3)
    rows += [
        (name, cohort.groups.get(name, ""), *none, f"not fitted: {why}")
        for name, why in cohort.failed.items()
    ]
    return Card(
        "\n".join(filter(None, lines)), f"{heading}: {cohort.verdict}", COLUMNS, tuple(rows)
    )


def judged_in_words(result: FitResult) -> tuple[str, str, str, str]:
    """Chi² of the verdict per bin, its expected value, p, and whether the model describes the
    data."""
    judged = result.adequacy
    if judged is None or not result.success:
        return "", "", "", result.verdict
    said = "described" if judged.adequate else f"not described: {judged.misfit}"
    each = (judged.chi2 / result.data, judged.expected / result.data)
    return f"{each[0]:.2f}", f"{each[1]:.2f}", format_p(judged.p), said


def _numbers(result: FitResult) -> list[str]:
    """What the data determine of the shown quantities, if the model describes them."""
    known = {} if result.adequate is False else result.determined
    found = [known.get(name) for name in SHOWN]
    return ["" if e is None else " ± ".join(rounded(e.value, e.stderr or 0.0)) for e in found]


def _shown(rows: list[tuple[str, ...]]) -> tuple[list[str], list[list[str]]]:
    """As narrow as a terminal, without the columns that hold nothing."""
    columns = [name for name in COLUMNS if name != "expected"]
    narrow = [
        [
            *(cell.replace(" ± ", "±") for cell in first),
            f"{chi2} ({expected})" if chi2 else "",
            p,
            said,
        ]
        for *first, chi2, expected, p, said in rows
    ]
    held = [i for i in range(len(columns)) if any(row[i] for row in narrow)]
    return [columns[i] for i in held], [[row[i] for i in held] for row in narrow]


def _differences(found: tuple[Difference, ...]) -> list[str]:
    """Those with the smallest p first."""
    rows = [
        f"  {d.quantity}: {d.b} - {d.a} = {d.difference:.3g} ({d.low:.3g} to {d.high:.3g})"
        f" {'' if d.unit == '1' else d.unit}".rstrip()
        + f", n = {'+'.join(map(str, d.members))}"
        + f", {d.left_out} left out" * bool(d.left_out)
        for d in sorted(found, key=lambda d: d.p)[:MOST]
    ]
    if not rows:
        return []
    more = f"; all {len(found)} are in differences.csv" * (len(found) > MOST)
    return [f"DIFFERENCES  95 % intervals, not corrected for their number{more}", *rows]
