"""A study in words: the report on a terminal, and the paragraph for a paper."""

import platform
from collections import Counter
from typing import TYPE_CHECKING, Any

import scipy

from jaxmuscle._common.environment import versions
from jaxmuscle.model._rungs import RUNGS
from jaxmuscle.spectra._settings import SpectrumSettings

from ._differences import Difference

if TYPE_CHECKING:
    from ._study import StudyResult

MOST = 12  # comparisons on a terminal
NAMES = {
    "holm": "Holm's method, which bounds the chance of any false positive",
    "fdr": "the method of Benjamini and Hochberg, which bounds the expected share of false positives",
}
DETREND = {"constant": "mean removed", "linear": "straight line removed", "none": "mean not removed"}
TESTS = {
    "groups": "groups within each condition by Welch's t test",
    "conditions": "conditions within people by the paired t test",
    "interaction": "the change between conditions of two groups by Welch's t test",
}


def report_lines(study: "StudyResult") -> list[str]:
    """What a terminal shows."""
    cohort, found = study.cohort, sorted(study.differences(), key=lambda d: (d.p_corrected, d.p))
    alpha = study.options["alpha"]
    clear = [d for d in found if d.p_corrected is not None and d.p_corrected < alpha]
    model = f"model of all: {study.rung}, {RUNGS[study.rung]}{_aic(study)}"
    lines = [f"Study: {_people(study)}", f"  {_trials(study)}", f"  {model}", f"  {cohort.verdict}"]
    lines += [f"  not fitted: {name}: {why}" for name, why in cohort.failed.items()]
    if not found:
        return [*lines, "  nothing to compare: no quantity is determined for two people on each side of a comparison"]
    families = Counter(d.kind for d in found)
    lines.append(f"  comparisons: {', '.join(f'{n} of {kind}' for kind, n in families.items())}; "
                 f"after correction ({study.options['correction']}) {len(clear)} have p < {alpha:g}")  # fmt: skip
    lines += [f"    {_sentence(d, alpha)}" for d in found[:MOST]]
    lines += [f"    and {len(found) - MOST} more"] if len(found) > MOST else []
    if any(d.left_out for d in found):
        lines.append("  People whose fits do not determine a quantity are left out of its comparisons. This is a selection "
                     "and can mislead")  # fmt: skip
    return lines


def _sentence(d: Difference, alpha: float) -> str:
    unit = "" if d.unit == "1" else f" {d.unit}"
    where = f", {d.where}" if d.where else ""
    people = " and ".join(map(str, d.members if d.kind != "conditions" else d.members[:1]))
    left = f", {d.left_out} left out" if d.left_out else ""
    return (f"{'*' if d.p_corrected is not None and d.p_corrected < alpha else ' '} {d.quantity}{where}: {d.b} - {d.a} = "
            f"{d.difference:.3g}{unit} ({d.low:.3g} to {d.high:.3g}), p = {d.p:.2g}, corrected "
            f"{d.p_corrected:.2g} ({people} people{left})")  # fmt: skip


def _people(study: "StudyResult") -> str:
    count = Counter(study.people.values())
    names = study.conditions
    groups = f" in {_count(len(count), 'group')} ({', '.join(f'{g} {n}' for g, n in count.items())})" if any(count) else ""
    conditions = f" in {_count(len(names), 'condition')} ({', '.join(names)})" if any(names) else ""
    return f"{len(study.people)} people{groups}{conditions}"


def _trials(study: "StudyResult") -> str:
    each = [cell.trials for cell in study.cells]
    segments = [sum(cell.target.segments or ()) for cell in study.cells]
    per = "person and condition" if any(study.conditions) else "person"
    return f"{sum(each)} recordings, {_range(each)} per {per}, {sum(segments)} Welch segments, {_range(segments)} per {per}"


def _aic(study: "StudyResult") -> str:
    if len(study.aic) < 2:
        return ""
    above = {number: aic - study.aic[study.rung] for number, aic in study.aic.items() if number != study.rung}
    more = ", ".join(f"model {number} has {aic:.0f} more" for number, aic in above.items())
    return f" (lowest AIC, summed over all spectra; {more})"


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + "s" * (number > 1)


def _range(values: list[Any]) -> str:
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def methods_paragraph(study: "StudyResult") -> str:
    """People, recordings, spectra, model, fit, statistics and versions, in sentences."""
    s = study.cells[0].target.settings
    window = study.options["reading"].get("window")
    judged = [result.adequate for result in study.cohort.results.values() if result.adequate is not None]
    rates = [rate for cell in study.cells for rate in cell.rates]
    named = {None: "the steady part of each recording", "all": "each recording as a whole"}
    part = f"{window[0]:g} s to {window[1]:g} s" if isinstance(window, tuple | list) else named[window]
    low_pass = "not low-pass filtered" if s.filter_cutoff is None else (
        f"low-pass filtered (Butterworth, order {s.filter_order}, {s.filter_cutoff:g} Hz, "
        f"{'forwards and backwards' if s.filter_direction == 'both' else 'forwards'})")  # fmt: skip
    whose = "person and condition" if any(study.conditions) else "person"
    noise = "" if study.options["noise"] is None else f" with {study.options['noise']} noise"
    said = [
        f"We analysed {_people(study)}: {_trials(study)}.",
        f"Recordings (sampled at {_range(rates)} Hz) were resampled to {s.rate:g} Hz and {low_pass}; {part} was analysed "
        "unless another window was specified.",
        f"Power spectra were estimated by Welch's method ({_window(s)}, {s.length} samples, "
        f"{100 * s.overlap:g} % overlap, {DETREND[s.detrend]}) from {s.frequency[0]:.2f} to {s.frequency[-1]:.2f} Hz. "
        f"Spectra of trials of one {whose} were averaged, weighted by their number of Welch segments. Where trials "
        "scattered more than expected from these, all errors were widened accordingly.",
        f"A stochastic rheological muscle model{noise} was fitted to every averaged spectrum, its coefficient of variation "
        f"and, where recorded in newtons, its mean force (linear response, Levenberg-Marquardt, {study.options['starts']} "
        "starts, log power weighted by the scatter of Welch's estimate).",
        f"All spectra were fitted with the same model ({RUNGS[study.rung]}){_choice(study)}.",
        f"The model describes {sum(judged)} of {len(judged)} spectra (p >= 0.01); the errors of the others were widened.",
        *_statistics(study),
        f"Software: {', '.join(f'{name} {number}' for name, number in versions().items())}, scipy {scipy.__version__}, "
        f"Python {platform.python_version()}.",
    ]  # fmt: skip
    return " ".join(said)


def _window(s: SpectrumSettings) -> str:
    return f"{s.tapers} Slepian tapers" if s.window == "dpss" else f"{s.window.capitalize()} window"


def _choice(study: "StudyResult") -> str:
    if len(study.aic) < 2:
        return ""
    return (f", of the models tried ({'; '.join(RUNGS[n] for n in study.aic)}) the one with the lowest AIC summed over all "
            "spectra; groups and conditions had no part in this choice")  # fmt: skip


def _statistics(study: "StudyResult") -> list[str]:
    found = study.differences()
    if not found:
        return []
    families = Counter(d.kind for d in found)
    tests = "; ".join(f"{TESTS[kind]} ({_count(n, 'comparison')})" for kind, n in families.items())
    correction = NAMES.get(study.options["correction"])
    p = (f"p-values were corrected by {correction}, for all comparisons of the same kind together" if correction
         else "p-values are not corrected for the number of comparisons")  # fmt: skip
    left = [d.left_out for d in found if d.left_out]
    selected = (
        [f"A quantity that a person's fit does not determine was left out for that person (in {len(left)} of {len(found)} "
         f"comparisons, {_range(left)} people), which is a selection."]
        if left else []
    )  # fmt: skip
    return [
        f"We compared {tests}. In a comparison each person counted once; quantities were not log-transformed. Each "
        f"{100 * (1 - study.options['alpha']):g} % interval is for a single comparison; {p}.",
        *selected,
    ]
