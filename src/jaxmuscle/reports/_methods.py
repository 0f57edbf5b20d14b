"""The paragraph for the methods section of a paper: of a study, and of a fit to one spectrum or to
trials of one person."""

import platform
import re
from collections import Counter
from typing import TYPE_CHECKING

import scipy

from jaxmuscle._common.environment import versions
from jaxmuscle._common.text import probability
from jaxmuscle.data._measured import is_recorded, tremor_band
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._rungs import RUNGS
from jaxmuscle.spectra._settings import SpectrumSettings

from ._study_text import counted, people_in_words, range_of, trials_in_words

if TYPE_CHECKING:
    from jaxmuscle.data._target import Target
    from jaxmuscle.fits._result import FitResult
    from jaxmuscle.fits._study import StudyResult

NAMES = {
    "holm": "Holm's method, which bounds the chance of any false positive",
    "fdr": (
        "the method of Benjamini and Hochberg, which bounds the expected share of false positives"
    ),
}
DETREND = {
    "constant": "mean removed",
    "linear": "straight line removed",
    "none": "mean not removed",
}
TESTS = {
    "groups": "groups within each condition by Welch's t test",
    "conditions": "conditions within people by the paired t test",
    "interaction": "the change between conditions of two groups by Welch's t test",
}
WINDOWED = re.compile(r"([\d.]+) Hz, window ([\d.]+) s to ([\d.]+) s")  # in the source of a target


def study_methods(study: "StudyResult") -> str:
    """People, recordings, spectra, model, fit, statistics and versions, in sentences."""
    s = study.cells[0].target.settings
    window = study.options["reading"].get("window")
    judged = [
        result.adequate for result in study.cohort.results.values() if result.adequate is not None
    ]
    rates = [rate for cell in study.cells for rate in cell.rates]
    named = {None: "the steady part of each recording", "all": "each recording as a whole"}
    part = (
        f"{window[0]:g} s to {window[1]:g} s" if isinstance(window, tuple | list) else named[window]
    )
    whose = "person and condition" if any(study.conditions) else "person"
    used = versions() if study.aic else {n: versions()[n] for n in ("jaxmuscle", "numpy")}
    said = [
        f"We analysed {people_in_words(study)}: {trials_in_words(study)}.",
        (
            f"Recordings of {study.cells[0].target.quantity} (sampled at {range_of(rates)} Hz) were"
            f" resampled to {s.rate:g} Hz and"
            f" {_low_pass(s)}; {part} was analysed unless another window was specified."
        ),
        _welch(s),
        (
            f"Spectra of trials of one {whose} were averaged, weighted by their number of Welch"
            " segments; of what else was measured the trials' values were averaged."
        ),
        _measured(study.cells[0].target),
        *(_model(study, judged) if study.aic else []),
        *_statistics(study),
        f"{_software(used)}, scipy {scipy.__version__}, Python {platform.python_version()}.",
    ]
    return " ".join(said)


def _model(study: "StudyResult", judged: list[bool]) -> list[str]:
    """The model of all people, and how many it describes."""
    noise = "" if study.options["noise"] is None else f" with {study.options['noise']} noise"
    known = study.cells[0].target.mean_force is not None
    further = " and its coefficient of variation"
    if known:
        further = ", its coefficient of variation and its mean force"
    return [
        (
            f"A stochastic rheological muscle model{noise} was fitted to every averaged spectrum"
            f"{further} (linear response, Levenberg-Marquardt, {study.options['starts']} starts,"
            " log power weighted by the scatter of Welch's estimate)."
        ),
        f"All spectra were fitted with the same model ({RUNGS[study.rung]}){_choice(study)}.",
        (
            f"The model describes {sum(judged)} of {len(judged)} spectra (p >= 0.01); the model's"
            " numbers of the others were left out."
        ),
    ]


def _measured(target: "Target") -> str:
    """How what needs no model was measured."""
    low, high = tremor_band(target.quantity)
    power = "the discrete cosine transform (DCT-II) of the whole part, over the squared mean"
    return (
        "Mean, standard deviation and coefficient of variation (about the mean, and about a"
        f" straight line) are those of the filtered signal. Power by band is from {power}; the"
        " median frequency halves the power of the Welch spectrum; sample entropy has templates of"
        f" 2 samples and a tolerance of 0.2 standard deviations. A tremor from {low:g} to {high:g}"
        " Hz was stated where the averaged Welch spectrum had a peak that at most 1 % of simulated"
        " smooth spectra show; its frequency is the centre of the power above the smooth spectrum,"
        " its size the root of that power over the mean."
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
    how = "in linear response" if result.method == "linear" else "by simulation (Monte Carlo)"
    said = [
        _data(result),
        _welch(target.settings),
        *([_measured(target)] if is_recorded(target.measured) else []),
        (
            f"A stochastic rheological muscle model ({result.only.model}) was fitted to"
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
    read = [tuple(map(float, found)) for found in WINDOWED.findall(target.source)]
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
        f" s{' of each' * several}, after the recording had been resampled to {s.rate:g} Hz and"
        f" {_low_pass(s)}.{averaged}"
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
    units = {name: f" {row.unit}" * (row.unit != "1") for name, row in PARAMETERS.items()}
    priors = ", ".join(
        f"{name} {value:.4g}{units.get(name, '')} ({sd[name]:.2g})"
        for name, value in centre.items()
        if sd.get(name) is not None
    )
    silent = float(result.task.harmonic.amplitude) == 0
    held = [
        f"{name} = {p.value:.4g}{units.get(name, '')}"
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
        f"Power spectra were estimated by Welch's method ({_window(s)}, {s.length} samples,"
        f" {100 * s.overlap:g} % overlap, {DETREND[s.detrend]}) from {s.frequency[0]:.2f} to"
        f" {s.frequency[-1]:.2f} Hz."
    )


def _low_pass(s: SpectrumSettings) -> str:
    if s.filter_cutoff is None:
        return "not low-pass filtered"
    ways = "forwards and backwards" if s.filter_direction == "both" else "forwards"
    return (
        f"low-pass filtered (Butterworth, order {s.filter_order}, {s.filter_cutoff:g} Hz, {ways})"
    )


def _software(numbers: dict[str, str]) -> str:
    return f"Software: {', '.join(f'{name} {number}' for name, number in numbers.items())}"


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
    correction = NAMES.get(study.options["correction"])
    p = (
        f"p-values were corrected by {correction}, for all comparisons of the same kind together"
        + " (those of the model's numbers apart from those of measured ones)" * bool(study.aic)
        if correction
        else "p-values are not corrected for the number of comparisons"
    )
    left = [d.left_out for d in found if d.left_out]
    selected = (
        [
            "A quantity that is not known of a person (no tremor, not determined by the fit, or a"
            f" model that does not describe the spectrum) was left out for that person (in"
            f" {len(left)} of {len(found)} comparisons, {range_of(left)} people), which is a"
            " selection."
        ]
        if left
        else []
    )
    return [
        (
            f"We compared {tests}. In a comparison each person counted once; quantities were not"
            f" log-transformed. Each {100 * (1 - study.options['alpha']):g} % interval is for a"
            f" single comparison; {p}."
        ),
        *selected,
    ]
