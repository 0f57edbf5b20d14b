"""A study in words: the report on a terminal, and the tables that it shares with report.html."""

import math
import re
from collections import Counter
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmuscle._common.cards import Card
from jaxmuscle._common.text import WIDTH, folded
from jaxmuscle.data._measured import MEASURES
from jaxmuscle.data._recording import FOUND, SEVERAL
from jaxmuscle.fits._differences import Difference
from jaxmuscle.model._rungs import RUNGS

if TYPE_CHECKING:
    from jaxmuscle.data._target import Target
    from jaxmuscle.fits._study import StudyResult

# comparisons on a terminal: a study of two groups and two conditions has 24 lines
MOST, MOST_OF_MODEL = 5, 2
TREMOR = "tremor_frequency"
POWER, SHORT = "1e-6 mean²", "1e-6"
# quantities in words, their unit (None: their own), what the numbers are multiplied with
WORDS = {
    "mean": ("mean", None, 1.0),
    "standard_deviation": ("standard deviation", None, 1.0),
    "coefficient_of_variation": ("CV", "%", 100.0),
    "coefficient_of_variation_without_drift": ("CV without drift", "%", 100.0),
    "relative_power_4_8": ("power 4-8 Hz", POWER, 1e6),
    "relative_power_8_12": ("power 8-12 Hz", POWER, 1e6),
    "median_frequency": ("median frequency", "Hz", 1.0),
    "sample_entropy": ("sample entropy", "", 1.0),
    "tremor_frequency": ("tremor frequency", "Hz", 1.0),
    "tremor_size": ("tremor size", "% of mean", 100.0),
    "resonance_frequency": ("resonance", None, 1.0),
    "resonance_2_frequency": ("slower resonance", None, 1.0),
}
GLOSS = "CV: coefficient of variation"
REPORT_ONLY = (
    "standard_deviation",
    "coefficient_of_variation_without_drift",
    "relative_power_4_8",
    "tremor_size",
)
CORRECTED = {
    "holm": "Holm's correction",
    "fdr": "Benjamini and Hochberg's correction",
    "none": "not corrected",
}
WINDOWED = re.compile(r"([\d.]+) Hz, window ([\d.]+) s to ([\d.]+) s")  # in the source of a target


def study_card(study: "StudyResult") -> Card:
    """What a terminal shows."""
    return Card(folded(_lines(study)))


def _lines(study: "StudyResult") -> list[str]:
    found = clearest_first(study)
    measured = [d for d in found if d.quantity in MEASURES]
    of_model = [d for d in found if d.quantity not in MEASURES]
    lines = [
        f"STUDY  {people_in_words(study)}",
        f"  {trials_in_words(study)}",
        *_measured(study),
        *_differences(measured, MOST, study),
    ]
    if study.aic:
        lines += [
            f"MODEL  {RUNGS[study.rung]} (rung {study.rung}){_aic(study)}",
            f"  {study.cohort.verdict}{_clear_of_model(of_model, study)}",
            *([f"  {only_some}"] if (only_some := only_some_described(study)) else []),
            *(f"  not fitted: {name}: {why}" for name, why in study.cohort.failed.items()),
            *_comparisons(of_model[:MOST_OF_MODEL], study),
        ]
    missing = missing_in_words(study)
    return lines + [f"NOT KNOWN  {missing}"] * bool(missing)


def _measured(study: "StudyResult") -> list[str]:
    """Table 1 as far as a terminal shows it, as many columns beside each other as have room."""
    columns, rows = table_1(study, leave_out=REPORT_ONLY)
    rows = [(f"  {name.replace(POWER, SHORT)}", cells) for name, cells in rows]
    rows = [("", columns), *((n, [c.replace(" ± ", "±") for c in row]) for n, row in rows)]
    label = max(len(name) for name, _ in rows)
    room = WIDTH - label
    longest = max(len(cell) for _, cells in rows for cell in cells)
    apart = 2 if len(columns) * (longest + 2) <= room else 1
    wide = min(longest + apart, room)
    across = room // wide
    lines = ["MEASURED  mean ± SD of people. 1e-6: millionths of the squared mean"]
    for start in range(0, len(columns), across):
        for name, cells in rows:
            shown = cells[start : start + across]
            said = "".join(f"{cell[: wide - 1]:>{wide}}" for cell in shown)
            lines.append(f"{name:<{label}}{said}".rstrip())
    return lines


def _differences(found: list[Difference], most: int, study: "StudyResult") -> list[str]:
    """The clearest comparisons, and how many there are."""
    if not found:
        return ["DIFFERENCES  none: a comparison needs two people on each side"]
    more = "; all are in differences.csv" * (len(found) > most)
    rows = _comparisons(found[:most], study, "DIFFERENCES")
    return [*rows, f"  {clear_in_words(found, study)}{more}"]


def _comparisons(found: list[Difference], study: "StudyResult", head: str = "") -> list[str]:
    """A line for each comparison, below a head if there is one."""
    inside = 100 * (1 - study.options["alpha"])
    rows = [(head, f"with {inside:g} % interval", "p", "n")] * bool(head)
    for d in found:
        quantity, where, what = compared_in_words(d)
        if d.kind == "interaction" and len(study.conditions) == 2:
            where = "change"  # there is no other
        name = f"  {quantity}{f', {where}' * bool(where)}: {what}"
        size = "{} ({})".format(*difference_in_words(d)).replace(POWER, SHORT)
        of = f" of {sum(_people(d)) + d.left_out}" * bool(d.left_out)
        rows.append((name, size, p_in_words(d.p_corrected), n_in_words(d) + of))
    if not rows:
        return []
    name, *wide = (max(map(len, column)) + 2 for column in zip(*rows, strict=True))
    below = name + sum(wide) - 2 > WIDTH  # of long names the numbers stand in a line of their own
    lines = []
    for first, *cells in rows:
        said = "".join(f"{cell:<{w}}" for cell, w in zip(cells, wide, strict=True)).rstrip()
        lines += [first, f"    {said}"] if below else [f"{first:<{name}}{said}"]
    return lines


def clearest_first(study: "StudyResult") -> list[Difference]:
    """All comparisons, the smallest corrected p first."""
    return sorted(study.differences(), key=lambda d: (d.p_corrected, d.p))


def is_clear(d: Difference, alpha: float) -> bool:
    """Whether p after correction is below the level."""
    return d.p_corrected is not None and d.p_corrected < alpha


def clear_in_words(found: list[Difference], study: "StudyResult") -> str:
    """How many comparisons have a p below the level, after which correction."""
    alpha, correction = study.options["alpha"], study.options["correction"]
    clear = sum(is_clear(d, alpha) for d in found)
    return f"{clear} of {len(found)} have p < {alpha:g} ({CORRECTED[correction]})"


def only_some_described(study: "StudyResult") -> str:
    """What to do where the model misses some of the data; empty if it does not."""
    if all(result.adequate is not False for result in study.cohort.results.values()):
        return ""
    other = "" if study.options["rung"] == "auto" else " Another model: `--rung auto`."
    return f"Table 1 and the measured differences need no model: they stay.{other}"


def _clear_of_model(found: list[Difference], study: "StudyResult") -> str:
    alpha = study.options["alpha"]
    clear = sum(is_clear(d, alpha) for d in found)
    return f". Comparisons with p < {alpha:g}: {clear} of {len(found)}" * bool(found)


def table_1(
    study: "StudyResult", leave_out: Collection[str] = ()
) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Mean ± SD of people: the names of groups and conditions, and of every quantity that a paper
    states its words and a cell for each of them."""
    found = {(r["group"], r["condition"], r["quantity"]): r for r in study.table_1()}
    columns = list(dict.fromkeys((group, condition) for group, condition, _ in found))
    lines = []
    for name, (words, unit, scale) in WORDS.items():
        rows = [found[(*column, name)] for column in columns if (*column, name) in found]
        if len(rows) < len(columns) or name in leave_out:
            continue
        if name == TREMOR:
            lines.append(("tremor seen in", [f"{row['n']} of {row['people']}" for row in rows]))
            if not any(row["n"] for row in rows):
                continue
        digits = _digits([scale * row["sd"] for row in rows])
        unit = rows[0]["unit"] if unit is None else unit
        head = words + f", {unit}" * bool(unit)
        lines.append((head, [_mean_in_words(row, scale, digits) for row in rows]))
    return [", ".join(filter(None, column)) or "all" for column in columns], lines


def people_of_columns(study: "StudyResult") -> list[int]:
    """How many people each column of Table 1 has."""
    parts = {(row["group"], row["condition"]): row["people"] for row in study.table_1()}
    return list(parts.values())


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


def compared_in_words(d: Difference) -> tuple[str, str, str]:
    """The quantity; in which condition, or the change between which; what is compared."""
    return WORDS.get(d.quantity, (d.quantity,))[0], d.where, f"{d.b} - {d.a}"


def difference_in_words(d: Difference) -> tuple[str, str]:
    """The difference with its unit; its interval."""
    _, unit, scale = WORDS.get(d.quantity, ("", None, 1.0))
    unit = ("" if d.unit == "1" else d.unit) if unit is None else unit
    sizes = [scale * x for x in (d.difference, d.low, d.high)]
    largest = max((abs(x) for x in sizes if math.isfinite(x)), default=0.0)
    if 1e-3 <= largest < 1e6:  # the same places behind the point
        places = max(0, 2 - math.floor(math.log10(largest)))
        middle, low, high = (f"{x:.{places}f}" for x in sizes)
    else:
        middle, low, high = (f"{x:.3g}" for x in sizes)
    times = "× " * (unit == POWER)
    return f"{middle} {times}{unit}".rstrip(), f"{low} to {high}"


def p_in_words(p: float | None) -> str:
    """A p-value of a comparison as it stands in a table."""
    if p is None:
        return ""
    return "<0.001" if p < 0.001 else f"{p:.3f}" if p < 0.1 else f"{p:.2f}"


def n_in_words(d: Difference) -> str:
    """How many people a comparison has, of two groups each."""
    return "+".join(map(str, _people(d)))


def _people(d: Difference) -> tuple[int, ...]:
    return d.members[:1] if d.kind == "conditions" else d.members


def missing_in_words(study: "StudyResult") -> str:
    """Which of the compared quantities are not known of all, and why; empty if all are."""
    missing, number = study.missing(), len(study.cells)
    said = []
    for name, count in missing.items():
        why = "the model misses the data, or they do not determine it"
        if name in MEASURES:
            why = "none seen" if name == TREMOR else "not measured"
        said.append(f"{WORDS.get(name, (name,))[0]} in {count} of {number} ({why})")
    return f"{'; '.join(said)}. Missing values can bias a comparison." if said else ""


def people_in_words(study: "StudyResult") -> str:
    """How many, in which groups and conditions."""
    number, names = Counter(study.people.values()), study.conditions
    groups = "; ".join(f"{group} {n}" for group, n in number.items())
    inside = [
        f"{counted(len(number), 'group')} ({groups})" * any(number),
        f"{counted(len(names), 'condition')} ({'; '.join(names)})" * any(names),
    ]
    return " in ".join([f"{len(study.people)} people", *filter(None, inside)])


def trials_in_words(study: "StudyResult") -> str:
    """How many recordings of what, how long the parts that are analysed."""
    target = study.cells[0].target
    each, lengths = [cell.trials for cell in study.cells], lengths_of_study(study)
    per = "condition" if any(study.conditions) else "person"
    of = f" of {target.quantity} ({target.unit})" if target.unit else ""
    said = f"{counted(sum(each), 'recording')}{of}, {range_of(each)} per {per}"
    what = "steady parts" if windows_chosen(study)["found"] else "parts"
    return f"{said}, {what} of {range_of(lengths)} s"


def windows_of(target: "Target") -> list[tuple[float, float, float]]:
    """Rate [Hz], start and stop [s] of every recording of a target that states a window."""
    return [(float(r), float(a), float(b)) for r, a, b in WINDOWED.findall(target.source)]


def lengths_of_study(study: "StudyResult") -> list[float]:
    """How long [s] the parts are that are analysed."""
    return [round(r.stop - r.start, 1) for cell in study.cells for r in cell.recordings]


def windows_chosen(study: "StudyResult") -> Counter[str]:
    """How many of the parts that are analysed were "found", "given" or "all"."""
    return Counter(r.chosen for cell in study.cells for r in cell.recordings)


def study_notices(study: "StudyResult") -> list[str]:
    """What is to be noticed of the recordings, each once, with whose they are; not that their
    steady parts were found, which the text says of all."""
    whose: dict[str, list[str]] = {}
    for cell in study.cells:
        for notice in cell.target.notices:
            if not notice.startswith(FOUND):
                whose.setdefault(notice, []).append(cell.target.name)
    every = len(study.cells)
    return _alike(study) + [
        f"{'all' if len(names) == every else '; '.join(names)}: {notice.removesuffix(SEVERAL)}"
        for notice, names in whose.items()
    ]


def _alike(study: "StudyResult") -> list[str]:
    """Names that differ only as somebody mistypes them."""
    said = []
    for what in ("person", "group", "condition"):
        spelled: dict[str, list[str]] = {}
        for name in dict.fromkeys(getattr(cell, what) for cell in study.cells):
            spelled.setdefault("".join(name.casefold().split()), []).append(f'"{name}"')
        said += [
            f"{what} {' and '.join(names)} are taken for different ones. If they are the same,"
            " write them alike in the table"
            for names in spelled.values()
            if len(names) > 1
        ]
    return said


def _aic(study: "StudyResult") -> str:
    if len(study.aic) < 2:
        return ""
    others = [f"{n} has {aic - study.aic[study.rung]:.0f} more" for n, aic in study.aic.items()]
    shown = [words for words, n in zip(others, study.aic, strict=True) if n != study.rung]
    return f"; lowest AIC over all spectra: {', '.join(shown)}"


def counted(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def range_of(values: list[Any]) -> str:
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
