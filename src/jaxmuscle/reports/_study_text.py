"""A study in words: the report on a terminal."""

from collections import Counter
from typing import TYPE_CHECKING, Any

from jaxmuscle._common.cards import Card
from jaxmuscle._common.text import folded
from jaxmuscle.fits._differences import Difference
from jaxmuscle.model._rungs import RUNGS

if TYPE_CHECKING:
    from jaxmuscle.fits._study import StudyResult

MOST = 12  # comparisons on a terminal


def study_card(study: "StudyResult") -> Card:
    """What a terminal shows."""
    return Card(folded(_lines(study)))


def _lines(study: "StudyResult") -> list[str]:
    cohort, found = study.cohort, sorted(study.differences(), key=lambda d: (d.p_corrected, d.p))
    alpha = study.options["alpha"]
    clear = [d for d in found if d.p_corrected is not None and d.p_corrected < alpha]
    model = f"model of all: {study.rung}, {RUNGS[study.rung]}{_aic(study)}"
    lines = [
        f"Study: {people_in_words(study)}",
        f"  {trials_in_words(study)}",
        f"  {model}",
        f"  {cohort.verdict}",
    ]
    lines += [f"  not fitted: {name}: {why}" for name, why in cohort.failed.items()]
    if not found:
        return [
            *lines,
            (
                "  nothing to compare: no quantity is determined for two people on each side of a"
                " comparison"
            ),
        ]
    families = Counter(d.kind for d in found)
    lines.append(
        f"  comparisons: {', '.join(f'{n} of {kind}' for kind, n in families.items())}; "
        f"after correction ({study.options['correction']}) {len(clear)} have p < {alpha:g}"
    )
    lines += [f"    {_sentence(d, alpha)}" for d in found[:MOST]]
    lines += [f"    and {len(found) - MOST} more"] if len(found) > MOST else []
    if any(d.left_out for d in found):
        lines.append(
            "  People whose fits do not determine a quantity are left out of its comparisons. This"
            " is a selection and can mislead"
        )
    return lines


def _sentence(d: Difference, alpha: float) -> str:
    unit = "" if d.unit == "1" else f" {d.unit}"
    where = f", {d.where}" if d.where else ""
    people = " and ".join(map(str, d.members if d.kind != "conditions" else d.members[:1]))
    left = f", {d.left_out} left out" if d.left_out else ""
    return (
        f"{'*' if d.p_corrected is not None and d.p_corrected < alpha else ' '}"
        f" {d.quantity}{where}: {d.b} - {d.a} = {d.difference:.3g}{unit} ({d.low:.3g} to"
        f" {d.high:.3g}), p = {d.p:.2g}, corrected {d.p_corrected:.2g} ({people} people{left})"
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
