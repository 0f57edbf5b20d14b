"""The paragraph for the methods section of a paper: of a study, and of a fit to one spectrum or to
trials of one person."""

import platform
from collections import Counter
from typing import TYPE_CHECKING

import scipy

from jaxmuscle._common.environment import versions
from jaxmuscle._common.text import probability
from jaxmuscle.data._measured import LEVEL, is_recorded, tremor_band
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._rungs import RUNGS
from jaxmuscle.spectra._settings import SpectrumSettings

from ._study_text import (
    counted,
    lengths_of_study,
    people_in_words,
    range_of,
    windows_chosen,
    windows_of,
)

if TYPE_CHECKING:
    from jaxmuscle.data._target import Target
    from jaxmuscle.fits._result import FitResult
    from jaxmuscle.fits._study import StudyResult

CORRECTIONS = {
    "holm": "by Holm's method (Holm 1979, Scand J Stat 6:65-70)",
    "fdr": (
        "by the method of Benjamini and Hochberg for the false discovery rate (1995, J R Stat Soc B"
        " 57:289-300)"
    ),
}
DETREND = {
    "constant": "mean of each segment removed",
    "linear": "straight line of each segment removed",
    "none": "no detrending",
}
TESTS = {
    "groups": "groups within each condition by Welch's t test for unequal variances",
    "conditions": "conditions within people by the paired t test",
    "interaction": "the change between conditions of two groups (interaction) by Welch's t test",
}
MODEL = (
    "stochastic rheological muscle model (Zagrodny, Wojnicz, Ludwicki and Barański, Enhancing"
    " rheological muscle models with stochastic processes)"
)


def study_methods(study: "StudyResult") -> str:
    """People, recordings, spectra, model, fit, statistics and versions, as the methods section of a
    paper says them."""
    target = study.cells[0].target
    rates = [r.rate for cell in study.cells for r in cell.recordings]
    trials = [cell.trials for cell in study.cells]
    segments = [sum(cell.target.segments or ()) for cell in study.cells]
    whose = "person and condition" if any(study.conditions) else "person"
    used = versions() if study.aic else {n: versions()[n] for n in ("jaxmuscle", "numpy")}
    unit = f" ({target.unit})" if target.unit else ""
    said = [
        (
            f"We recorded the {target.quantity}{unit} of {people_in_words(study)}:"
            f" {counted(sum(trials), 'recording')}, {range_of(trials)} per {whose}, sampled at"
            f" {range_of(rates)} Hz."
        ),
        _parts(study, sum(trials)),
        *_subtracted(study),
        _prepared(target.settings),
        _measured(target, several=max(trials) > 1),
        f"{_welch(target.settings)}, with {range_of(segments)} segments per {whose}.",
        *(
            ["Spectra of the trials were averaged, weighted by their number of segments."]
            * (max(trials) > 1)
        ),
        _tremor(target),
        *(_model(study) if study.aic else []),
        *_statistics(study),
        f"{_software(used)}, scipy {scipy.__version__}, Python {platform.python_version()}.",
    ]
    return " ".join(said)


def _parts(study: "StudyResult", number: int) -> str:
    """How the analysed part of every recording was chosen, how long it is."""
    chosen = windows_chosen(study)
    found, long = chosen["found"], f"were {range_of(lengths_of_study(study))} s long."
    if chosen["all"] == number:
        return f"Recordings were analysed as a whole. They {long}"
    long = f" These parts {long}"
    if not found:
        named = study.options["reading"].get("window")
        if isinstance(named, tuple | list) and chosen["given"] == number:
            return f"Recordings were analysed from {named[0]:g} s to {named[1]:g} s."
        return f"Recordings were analysed in parts that were specified.{long}"
    some = f"In {found} of {number} recordings the" if found < number else "The"
    others = "; in the others the part was specified, or all was analysed" * (found < number)
    return (
        f"{some} plateau was found automatically: the longest stretch in which the running median"
        " over 1 s stayed within 10 % of the contraction level, without one second beside each"
        f" ramp{others}.{long}"
    )


def _subtracted(study: "StudyResult") -> list[str]:
    """What was subtracted from recordings, as their notices say."""
    notices = [notice for cell in study.cells for notice in cell.target.notices]
    said = []
    if any(
        "This was subtracted" in notice or "subtracted as asked" in notice for notice in notices
    ):
        said.append("The level of the sensor at rest was subtracted where it was not zero.")
    if any("the straight line through" in notice for notice in notices):
        said.append("The straight line through the analysed part was subtracted.")
    return said


def _model(study: "StudyResult") -> list[str]:
    """The model of all people, and how many it describes."""
    judged = [r.adequate for r in study.cohort.results.values() if r.adequate is not None]
    noise = "" if study.options["noise"] is None else f" with {study.options['noise']} noise"
    known = study.cells[0].target.mean_force is not None
    further = ", its coefficient of variation and its mean force" * known
    others = "; the model's quantities of the others were left out" * (not all(judged))
    return [
        (
            f"A {MODEL}{noise} was fitted to the averaged spectrum of each person in each"
            f" condition{further or ' and its coefficient of variation'} (linear response,"
            f" Levenberg-Marquardt, {study.options['starts']} starts, log power weighted by the"
            " scatter of Welch's estimate)."
        ),
        f"All spectra were fitted with the same model ({RUNGS[study.rung]}){_choice(study)}.",
        (
            f"It described {sum(judged)} of {len(judged)} spectra (p >= 0.01 in a test of goodness"
            f" of fit by simulated replicates){others}."
        ),
    ]


def _measured(target: "Target", *, several: bool) -> str:
    """How what needs no model and no Welch spectrum was measured."""
    averaged = " Values of the trials were averaged." if several else ""
    return (
        "From the filtered signal we computed mean, standard deviation (SD) and coefficient of"
        " variation (CV = SD / mean; also after a straight line was removed); power by band, from"
        " the discrete cosine transform (DCT-II), over the squared mean; and sample entropy (m ="
        f" 2, r = 0.2 SD; Richman and Moorman 2000, Am J Physiol 278:H2039-H2049).{averaged}"
    )


def _tremor(target: "Target") -> str:
    """What was measured of the Welch spectrum."""
    low, high = tremor_band(target.quantity)
    return (
        "The median frequency halves the power of this spectrum. A tremor was stated where the"
        f" spectrum had a peak from {low:g} to {high:g} Hz that at most {100 * LEVEL:g} % of"
        " simulated smooth spectra show; its frequency is the centre of the power above the smooth"
        " spectrum, its size the root of that power over the mean."
    )


def fit_methods(result: "FitResult") -> str | None:
    """Data, spectrum, model, fit, verdict, what was assumed, versions; None for several targets and
    a moved insertion."""
    if (
        len(result.parts) > 1
        or not result.success
        or not result.only.fitted.size
        or result.only.stiffness is not None
    ):
        return None
    target, set_to = result.target, result.settings
    fitted = "the spectrum" + ", its coefficient of variation" * bool(
        set_to.get("coefficient_of_variation")
    )
    fitted += ", the mean force" * (set_to.get("mean_force") is not None)
    simulated = (
        f", corrected by {set_to['seeds']} simulations"
        if result.method == "linear" and set_to.get("seeds")
        else ""
    )
    checked = f" and checked by {set_to['check_seeds']} new ones" * bool(set_to.get("check_seeds"))
    recorded = is_recorded(target.measured)
    how = "in linear response" if result.method == "linear" else "by simulation (Monte Carlo)"
    said = [
        _data(result),
        *([_measured(target, several=len(target.segments or ()) > 1)] if recorded else []),
        f"{_welch(target.settings)}.",
        *([_tremor(target)] if recorded else []),
        (
            f"A {MODEL}, {result.only.model}, was fitted to"
            f" {' and '.join(fitted.rsplit(', ', 1))} {how} (Levenberg-Marquardt,"
            f" {set_to['starts']} starts, log power weighted by its scatter, seed"
            f" {result.seed}{simulated}{checked if simulated else ''})."
        ),
        *_tried(result),
        f"The model {result.verdict}.",
        *_assumed(result),
        f"{_software(result.versions)}.",
    ]
    return " ".join(said)


def _data(result: "FitResult") -> str:
    target, s = result.target, result.target.settings
    segments = "" if target.segments is None else f" ({sum(target.segments)} Welch segments)"
    read = windows_of(target)
    if not read:
        return f"We analysed the {target.quantity} spectrum {target.name}{segments}."
    lengths = [round(stop - start, 1) for _, start, stop in read]
    several = len(read) > 1
    averaged = (
        " Their spectra were averaged, weighted by their number of Welch segments."
        if several
        else ""
    )
    if target.dispersion is not None:
        averaged += (
            f" The scatter between trials was {target.dispersion[0]:.2f} ±"
            f" {target.dispersion[1]:.2f} times what the segments explain; all errors are widened"
            " by this factor if it exceeds 1."
        )
    return (
        f"We analysed {counted(len(read), 'recording')} of {target.quantity}{segments}, sampled at"
        f" {range_of([rate for rate, *_ in read])} Hz: a part of {range_of(lengths)}"
        f" s{' of each' * several}. {_prepared(s)}{averaged}"
    )


def _tried(result: "FitResult") -> list[str]:
    if len(result.ladder) < 2:
        return []
    each = "; ".join(
        f"{rung.model} (chi2 per bin {rung.chi2_per_bin:.2f}, {probability(rung.p)}, AIC"
        f" {rung.aic:.1f})"
        for rung in result.ladder
    )
    chosen = next(rung.model for rung in result.ladder if rung.chosen)
    return [f"Models were tried one after the other: {each}. We report the fit of: {chosen}."]


def _assumed(result: "FitResult") -> list[str]:
    """Priors of what was free, and the values of what was not."""
    centre, sd = (result.settings.get(name, {}) for name in ("prior_centre", "prior_sd"))

    def shown(name: str, value: float) -> str:
        """With its unit, per newton of force where the result is."""
        unit = PARAMETERS[name].unit if name in PARAMETERS else "1"
        scale, unit = result.scale_as_shown(unit)
        return f"{scale * value:.4g}{f' {unit}' * (unit != '1')}"

    priors = ", ".join(
        f"{name} {shown(name, value)} ({sd[name]:.2g})"
        for name, value in centre.items()
        if sd.get(name) is not None
    )
    silent = float(result.task.harmonic.amplitude) == 0
    held = [
        f"{name} = {shown(name, p.value)}"
        for name, p in result.parameters.items()
        if not p.free and not (silent and name.startswith("harmonic_"))
    ]
    stated = (
        "Priors (of positive parameters log-normal) had these centres (standard deviations):"
        f" {priors}."
    )
    ratio = (
        " The logarithm of the damping ratio had a normal prior, too, about that of these centres"
        f" (standard deviation {result.settings['damping_ratio_sd']:.2g}): it keeps the muscle from"
        " swinging."
        if result.settings.get("damping_ratio_sd")
        else ""
    )
    return [stated + ratio] * bool(priors) + (
        [f"Held fixed were {', '.join(held)}."] if held else []
    )


def _welch(s: SpectrumSettings) -> str:
    return (
        "Power spectra were estimated by Welch's method (Welch 1967, IEEE Trans Audio Electroacoust"
        f" 15:70-73; {_window(s)}, {s.length} samples or {s.length / s.rate:.3g} s,"
        f" {100 * s.overlap:g} % overlap, {DETREND[s.detrend]}) from {s.frequency[0]:.2f} to"
        f" {s.frequency[-1]:.2f} Hz"
    )


def _prepared(s: SpectrumSettings) -> str:
    if s.filter_cutoff is None:
        return f"Signals were resampled to {s.rate:g} Hz and not low-pass filtered."
    ways = "forwards and backwards" if s.filter_direction == "both" else "forwards"
    return (
        f"Signals were resampled to {s.rate:g} Hz and low-pass filtered (Butterworth, order"
        f" {s.filter_order}, {s.filter_cutoff:g} Hz, {ways})."
    )


def _software(numbers: dict[str, str]) -> str:
    used = [f"{name} {number}" for name, number in numbers.items() if name != "jaxmuscle"]
    own = f"jaxmuscle {numbers['jaxmuscle']} (The jaxmuscle developers; see its CITATION.cff)"
    return f"Software: {', '.join([own, *used])}"


def _window(s: SpectrumSettings) -> str:
    return f"{s.tapers} Slepian tapers" if s.window == "dpss" else f"{s.window.capitalize()} window"


def _choice(study: "StudyResult") -> str:
    if len(study.aic) < 2:
        return ""
    return (
        f", of the models tried ({'; '.join(RUNGS[n] for n in study.aic)}) the one with the lowest"
        " AIC summed over all spectra; groups and conditions had no part in this choice"
    )


def _statistics(study: "StudyResult") -> list[str]:
    found = study.differences()
    if not found:
        return []
    families = Counter(d.kind for d in found)
    tests = "; ".join(f"{TESTS[kind]} ({counted(n, 'comparison')})" for kind, n in families.items())
    correction = CORRECTIONS.get(study.options["correction"])
    apart = ", those of the model's quantities apart from those of measured ones"
    p = "p values are not corrected for the number of comparisons"
    if correction:
        p = f"p values were corrected {correction}, each of these kinds of comparison by itself"
        p += apart * bool(study.aic)
    alpha = study.options["alpha"]
    selected = []
    if left := [d.left_out for d in found if d.left_out]:
        selected.append(
            "Values that do not exist (no tremor, or a quantity that the fit does not determine)"
            f" were left out: in {len(left)} of {len(found)} comparisons, of at most"
            f" {counted(max(left), 'person', 'people')}."
        )
    return [
        (
            f"We compared {tests}. The unit of analysis was the person. Quantities were not"
            f" log-transformed. The level of significance was {alpha:g}; {p}. Intervals"
            f" ({100 * (1 - alpha):g} %) are not corrected."
        ),
        *selected,
    ]
