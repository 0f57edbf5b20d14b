"""A study in words: the report on a terminal."""

import math
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmuscle._common.cards import Card
from jaxmuscle._common.text import folded
from jaxmuscle.data._measured import MEASURES
from jaxmuscle.fits._differences import Difference
from jaxmuscle.model._rungs import RUNGS

if TYPE_CHECKING:
    from jaxmuscle.fits._study import StudyResult

MOST = 12  # comparisons on a terminal
TREMOR = "tremor_frequency"
LABEL, COLUMN, ACROSS, LONGEST = 32, 16, 3, 14  # letters, and columns beside each other
# Table 1: words, unit (None: that of the recordings) and what the numbers are multiplied with
SHOWN = {
    "mean": ("mean", None, 1.0),
    "standard_deviation": ("standard deviation", None, 1.0),
    "coefficient_of_variation": ("coefficient of variation", "%", 100.0),
    "coefficient_of_variation_without_drift": ("  without a drift", "%", 100.0),
    "relative_power_4_8": ("power 4-8 Hz", "1e-6 mean²", 1e6),
    "relative_power_8_12": ("power 8-12 Hz", "1e-6 mean²", 1e6),
    "median_frequency": ("median frequency", "Hz", 1.0),
    "sample_entropy": ("sample entropy", "", 1.0),
    "tremor_frequency": ("tremor frequency", "Hz", 1.0),
    "tremor_size": ("tremor size", "% of the mean", 100.0),
}


def study_card(study: "StudyResult") -> Card:
    """What a terminal shows."""
    return Card(folded(_lines(study)))


def _lines(study: "StudyResult") -> list[str]:
    lines = [f"Study: {people_in_words(study)}", f"  {trials_in_words(study)}"]
    columns, rows = table_1(study)
    lines.append("Table 1: mean ± SD of people; in brackets of how many, where some have no value")
    for start in range(0, len(columns), ACROSS):
        block = slice(start, start + ACROSS)
        heads = "".join(f"{head[:LONGEST]:>{COLUMN}}" for head in columns[block])
        lines.append(f"{'':<{LABEL}}{heads}".rstrip())
        for words, cells in rows:
            said = "".join(f"{cell:>{COLUMN}}" for cell in cells[block])
            lines.append(f"{f'  {words}':<{LABEL}}{said}".rstrip())
    alpha = study.options["alpha"]
    found = sorted(study.differences(), key=lambda d: (d.p_corrected, d.p))
    measured = [d for d in found if d.quantity in MEASURES]
    of_model = [d for d in found if d.quantity not in MEASURES]
    lines += _told(measured, "what is measured", study)
    if study.aic:
        lines += [
            f"Model of all people: {RUNGS[study.rung]} (rung {study.rung}){_aic(study)}",
            f"  {study.cohort.verdict}",
            *(f"  not fitted: {name}: {why}" for name, why in study.cohort.failed.items()),
            *_told(of_model, "the model's numbers", study),
        ]
    if any(d.left_out for d in found):
        lines.append(
            "People without a value are left out: of a tremor those who show none, of the model's"
            " numbers those whom it does not describe or whose data do not determine it. This is a"
            " selection and can mislead"
        )
    if any(d.p_corrected is not None and d.p_corrected < alpha for d in found):
        lines.append(f"* p < {alpha:g} after correction")
    return lines


def _told(found: list[Difference], what: str, study: "StudyResult") -> list[str]:
    if not found:
        return [f"Comparisons of {what}: none, nothing is known of two people on each side"]
    alpha, correction = study.options["alpha"], study.options["correction"]
    clear = sum(d.p_corrected is not None and d.p_corrected < alpha for d in found)
    kinds = ", ".join(f"{n} of {kind}" for kind, n in Counter(d.kind for d in found).items())
    more = len(found) - MOST
    return [
        f"Comparisons of {what}: {kinds}; after correction ({correction}) {clear} have"
        f" p < {alpha:g}",
        *(f"  {_sentence(d, alpha)}" for d in found[:MOST]),
        *([f"  and {more} more: differences(), differences.csv"] if more > 0 else []),
    ]


def table_1(study: "StudyResult") -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Mean ± SD of people: the names of groups and conditions, and of every quantity that a paper
    states its words and a cell for each of them."""
    found = {(r["group"], r["condition"], r["quantity"]): r for r in study.table_1()}
    columns = list(dict.fromkeys((group, condition) for group, condition, _ in found))
    lines = []
    for name, (words, unit, scale) in SHOWN.items():
        rows = [found[(*column, name)] for column in columns if (*column, name) in found]
        if len(rows) == len(columns):
            digits = _digits([scale * row["sd"] for row in rows])
            unit = rows[0]["unit"] if unit is None else unit
            head = words + f" [{unit}]" * bool(unit)
            lines.append((head, [_mean_in_words(row, scale, digits) for row in rows]))
        if name == TREMOR and rows:
            lines.append(("tremor seen in", [f"{row['n']} of {row['people']}" for row in rows]))
    return [", ".join(filter(None, column)) or "all" for column in columns], lines


def _digits(spreads: list[float]) -> int:
    """Places behind the point, the same in a row: two digits of the SD in its middle."""
    known = [sd for sd in spreads if sd > 0]
    return max(0, 1 - math.floor(math.log10(np.median(known)))) if known else 3


def _mean_in_words(row: Mapping[str, Any], scale: float, digits: int) -> str:
    if not row["n"]:
        return "none"
    mean, sd = scale * row["mean"], scale * row["sd"]
    said = f"{mean:.{digits}f}" + ("" if math.isnan(sd) else f" ± {sd:.{digits}f}")
    return said + (f" ({row['n']})" if row["n"] < row["people"] else "")


def difference_in_words(d: Difference) -> tuple[str, str]:
    """What is compared with what; the difference with its interval and unit."""
    _, unit, scale = SHOWN.get(d.quantity, ("", None, 1.0))
    unit = ("" if d.unit == "1" else d.unit) if unit is None else unit
    where = f", {d.where}" if d.kind == "groups" and d.where else ""
    of = f", change {d.where}" if d.kind == "interaction" else where
    middle, low, high = (f"{scale * x:.3g}" for x in (d.difference, d.low, d.high))
    return f"{d.quantity}{of}: {d.b} - {d.a}", f"{middle} ({low} to {high}) {unit}".rstrip()


def _sentence(d: Difference, alpha: float) -> str:
    people = " and ".join(map(str, d.members if d.kind != "conditions" else d.members[:1]))
    left = f", {d.left_out} left out" if d.left_out else ""
    said, number = difference_in_words(d)
    return (
        f"{'*' if d.p_corrected is not None and d.p_corrected < alpha else ' '} {said} = {number},"
        f" p = {d.p:.2g}, corrected {d.p_corrected:.2g} ({people} people{left})"
    )


def people_in_words(study: "StudyResult") -> str:
    number = Counter(study.people.values())
    names = study.conditions
    groups = (
        f" in {counted(len(number), 'group')} ({', '.join(f'{g} {n}' for g, n in number.items())})"
        if any(number)
        else ""
    )
    conditions = (
        f" in {counted(len(names), 'condition')} ({', '.join(names)})" if any(names) else ""
    )
    return f"{len(study.people)} people{groups}{conditions}"


def trials_in_words(study: "StudyResult") -> str:
    each = [cell.trials for cell in study.cells]
    segments = [sum(cell.target.segments or ()) for cell in study.cells]
    per = "person and condition" if any(study.conditions) else "person"
    return (
        f"{sum(each)} recordings, {range_of(each)} per {per}, {sum(segments)} Welch segments,"
        f" {range_of(segments)} per {per}"
    )


def _aic(study: "StudyResult") -> str:
    if len(study.aic) < 2:
        return ""
    above = {
        number: aic - study.aic[study.rung]
        for number, aic in study.aic.items()
        if number != study.rung
    }
    more = ", ".join(f"model {number} has {aic:.0f} more" for number, aic in above.items())
    return f" (lowest AIC, summed over all spectra; {more})"


def counted(number: int, what: str) -> str:
    return f"{number} {what}" + "s" * (number > 1)


def range_of(values: list[Any]) -> str:
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
