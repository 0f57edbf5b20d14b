"""The result of a fit as text, and as a table in a notebook."""

import math
from collections.abc import Mapping

import numpy as np

from jaxmuscle._common.cards import Card
from jaxmuscle._common.text import folded
from jaxmuscle.data._measured import is_recorded, tremor_band
from jaxmuscle.data._measured_text import REGULAR, TREMOR, WORDS, measured_line, tremor_lines
from jaxmuscle.data._target import Target
from jaxmuscle.fits._result import RELATIVE, Estimate, FitResult, FittedPart, once
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._derived import MEAN, MEANINGS, VARIATION
from jaxmuscle.spectra._bin_law import ENOUGH
from jaxmuscle.spectra._fluctuations import BANDS, in_bands

from ._ladder_text import explain_choice, ladder_table

LENGTHS = ("x_ref_w", "x_ref_z")
OTHER_LENGTHS = (0.75, 1.5)  # times x_ref_w
BROAD = 1.7 * 3.92  # standard errors: an interval that is wider than theirs
# measured numbers that a fit prints, in words
SHOWN = {
    **{name: words for name, words in WORDS.items() if not name.endswith("_above_0.5")},
    "relative_power_4_8": "power 4-8 Hz, 1e-6 mean²",
    "relative_power_8_12": "power 8-12 Hz, 1e-6 mean²",
    **{name: REGULAR[name] for name in ("median_frequency", "sample_entropy")},
}
HALF_POWER = "half_power_frequency"
STATED = ("resonance_frequency", "resonance_2_frequency", "harmonic_frequency", HALF_POWER)
CAVEAT = "beside a strong tremor its interval is too narrow"
WITHIN = "± is from within the recording: between trials of one person we saw about twice as much"
CHOSEN = (
    "the model was chosen for this target alone: do not compare its numbers between fits;"
    " `jaxmuscle study` fits all people with one model"
)
EVERYTHING = (
    "all other numbers of the model: `jaxmuscle fit --all`, fit.json; in Python result.details()"
)
COLUMNS = ("name", "value", "95 % interval", "unit", "in the fit", "what it is")


def fit_card(result: FitResult) -> Card:
    """The result as text, and as a table of all its numbers: those that are measured first, then
    those that the data determine, at last what was fixed."""
    rows = [
        (name, m.in_words(), m.interval_in_words(), "" if m.unit == "1" else m.unit, "measured", "")
        for name, m in result.measured.items()
    ]
    # then it has no frequency
    silent = all(float(part.task.harmonic.amplitude) == 0 for part in result.parts.values())
    fixed = {name: p for name, p in result.parameters.items() if not p.free}
    of_model = []
    for name, p in result.as_shown(once(fixed, result.found)).items():
        if silent and base_of(name).startswith("harmonic_"):
            continue
        state = ("determined" if p.stderr is not None else "not determined") if p.free else "fixed"
        row, unit = PARAMETERS.get(base_of(name)), "" if p.unit == "1" else p.unit
        words = MEANINGS.get(base_of(name), "") if row is None else row.meaning.partition(";")[0]
        of_model.append((name, p.in_words(), p.interval_in_words(), unit, state, words))
    order = ("determined", "not determined", "fixed")
    rows += sorted(of_model, key=lambda row: order.index(row[4]))
    remarks = (
        f"{_head(result)}: {result.message}",
        *_choice(result),
        *result.advice,
        *result.notices,
        *result.remarks,
        *_held(result),
    )
    return Card(fit_text(result), _heading(result), COLUMNS, tuple(rows), remarks)


def _heading(result: FitResult) -> str:
    """The verdict as a sentence of its own."""
    if not result.success:
        return result.verdict[0].upper() + result.verdict[1:]
    subject = "The model" if result.adequate is not None else "Whether the model describes the data"
    return f"{subject} {result.verdict}"


def fit_text(result: FitResult, *, everything: bool = False) -> str:
    """What is measured, whether the model describes it, and what then is known of the model: of
    recordings its rhythms, of a spectrum its parameters; or everything.

    The numbers of a model that does not describe the data are shown with everything only.
    """
    lines = [_head(result), *_measured(result), _heading(result)]
    lines += [f"  {result.message}"] * result.success
    if everything:
        lines += [f"  {row}" for row in ladder_table(result.ladder, _datum(result))]
        lines += [f"  {sentence}" for sentence in _choice(result)]
    lines += _fitted_targets(result)
    if not everything:
        lines += [f"  {sentence}" for sentence in result.advice]
    elif result.adequacy is not None and result.adequate is False:
        factor = result.adequacy.widening
        lines.append(
            f"  standard errors are widened by a factor of {factor:.2g}: it misses the data"
        )
    # the short text has no contraction time
    notices = [n for n in result.notices if everything or not n.startswith("contraction_time")]
    lines += [f"  note: {notice}" for notice in notices]
    lines += [f"  {sentence}" for sentence in result.remarks]
    if everything or (result.success and result.adequate is not False):
        whole = everything or len(result.parts) > 1 or result.only.stiffness is not None
        lines += _whole_model(result, everything) if whole else _short_model(result)
    return folded(lines)


def _measured(result: FitResult) -> list[str]:
    """The measured numbers that people state, of every target."""
    lines, several = [], len(result.parts) > 1
    for name, part in result.parts.items():
        target, found = part.target, part.target.measured
        if not found:
            continue
        of = f" of {name}" * several
        lines.append(f"{f'  measured{of}, without the model:':<56} 95 % interval")
        rows = [
            measured_line(words, key, found[key]) for key, words in SHOWN.items() if key in found
        ]
        if found.keys() >= TREMOR.keys():
            rows += tremor_lines(found, tremor_band(target.quantity))
        lines += [f"    {row}" for row in rows]
        if is_recorded(found) and len(target.segments or ()) < ENOUGH:
            lines.append(f"    {WITHIN}")
    return lines


def _fitted_targets(result: FitResult) -> list[str]:
    """How many trials every target has, and how well it is met."""
    single = len(result.parts) == 1
    lines = []
    if not single:
        lines += [
            f"  {name}: {p.target.name}, {p.model}{_closeness(p, ', ')}"
            for name, p in result.parts.items()
        ]
    lines += [
        f"  {'' if single else f'{name}: '}{words}"
        for name, p in result.parts.items()
        for words in _trials(p.target)
    ]
    if single and result.rms_log_error is not None:
        lines.append(f"  {_closeness(result.only, verdict=result.closeness)}")
    lines += [
        f"  {'' if single else f'{name}: '}{words}"
        for name, p in result.parts.items()
        for words in _stiffness(p)
    ]
    return lines


def _short_model(result: FitResult) -> list[str]:
    """The rhythms, and where half of the power is let through; of a spectrum without recordings
    also the parameters."""
    every, shown = result.as_shown(result.found), result.as_shown(result.determined)
    rows = {name: p for name, p in shown.items() if base_of(name) in STATED}
    lines = _table("of the model", rows, " 95 % interval") if rows else []
    if HALF_POWER in rows and ("resonance_share" in every or _trembles(result)):
        lines.append(f"  {HALF_POWER}: {CAVEAT}")
    bands = {name: p for name, p in shown.items() if base_of(name) in BANDS}
    lines += [f"  {sentence}" for sentence in _by_band(result, bands)]
    if not is_recorded(result.target.measured):
        own = {n: p for n, p in every.items() if n in result.free and n not in rows}
        known = [_in_short(n, p) for n, p in own.items() if p.stderr is not None]
        loose = [_in_short(n, p) for n, p in own.items() if p.stderr is None]
        of = _per_newton(result, own)
        lines += [f"  parameters{of}: {', '.join(known)}"] * bool(known)
        lines += [f"  not determined, one of many sets that fit{of}: {', '.join(loose)}"] * bool(
            loose
        )
        lines += [f"  {sentence}" for sentence in _of_scale(result)]
        every = {n: p for n, p in every.items() if n not in own}
    elif len(result.ladder) > 1:
        lines.append(f"  {CHOSEN}")
    if loose := [n for n, p in every.items() if p.stderr is None and p.free]:
        lines.append(f"  the data do not determine: {', '.join(loose)}")
    return [*lines, f"  {EVERYTHING}"]


def _trembles(result: FitResult) -> bool:
    """Whether a tremor is measured."""
    found = result.target.measured.get("tremor_frequency")
    return found is not None and math.isfinite(found.value)


def _in_short(name: str, p: Estimate) -> str:
    unit = "" if p.unit in ("1", "") else f" {p.unit}"
    return f"{name} {p.in_words()}{unit}"


def _whole_model(result: FitResult, everything: bool) -> list[str]:
    """All that the data determine; with everything also what they do not, and what they leave
    open."""
    every, shown = result.as_shown(result.found), result.as_shown(result.determined)
    intervals = any(p.interval is not None for p in shown.values())
    bands = {name: p for name, p in shown.items() if base_of(name) in BANDS}
    rows = {name: p for name, p in shown.items() if name not in bands}
    title = (
        "determined by the data"
        if result.adequate is not False
        else "would be determined if the model held"
    )
    lines = _table(title + _per_newton(result, rows), rows, " 95 % interval    " * intervals)
    lines += [f"  {sentence}" for sentence in (*_counted(rows, every), *_by_band(result, bands))]
    loose = {name: p for name, p in every.items() if name not in shown and p.free}
    if loose and everything:
        title = f"not determined: do not interpret these values{_per_newton(result, loose)}"
        lines += [*_table(title, loose), *(f"  {sentence}" for sentence in _counted(loose, every))]
    elif loose:
        lines.append(f"  the data do not determine: {', '.join(loose)}")
    lines += [f"  {sentence}" for sentence in _of_scale(result)]
    if result.undetermined and everything:
        whose = "the data leave" if len(result.parts) == 1 else "all targets together leave"
        lines += [f"  {whose} open:", *(f"    - {sentence}" for sentence in result.undetermined)]
    return lines if everything else [*lines, f"  {EVERYTHING}"]


def _of_scale(result: FitResult) -> list[str]:
    """What the scale of force stands on, and what was held."""
    lines = []
    if factor := result.settings.get("carried"):
        moved = any(part.stiffness is not None for part in result.parts.values())
        what = "P_w, stiffness" if moved else "P_w, masses (those that you did not fix), stiffness"
        lines.append(
            f"before the fit {what} and damping were multiplied by {factor:.3g}, so that the"
            " muscle has the measured mean force"
            + " (mean_force=False leaves the mean out)"
            * (not moved)
        )
    lines += _held(result)
    if result.per_newton:
        mean = f"{result.derived[MEAN].value:.3g} N"
        torque = any(part.target.quantity == "torque" for part in result.parts.values())
        given = " (of a torque it needs the lever arm: --lever-arm)" * torque
        lines.append(
            f"no mean force in newtons was given{given}, so the scale of force is unknown."
            " Forces, masses, stiffness and damping are stated here per newton of mean force. In"
            " fit.json (Python: result['K_w0'], to_dataframe()) they are those of a model muscle"
            f" that pulls with {mean}: divide by {mean}"
        )
    return lines


def _held(result: FitResult) -> list[str]:
    """The masses and lengths that a fit takes as given, where its stiffness in newtons depends on
    them."""
    whose = next((name for name, part in result.parts.items() if part.stiffness is not None), None)
    if not result.derived or (len(result.parts) > 1 and whose is None):
        return []
    moved, at = whose is not None, f"@{whose}" * (len(result.parts) > 1)
    task = (result.only if whose is None else result.parts[whose]).task
    if not moved and (task.output_unit != "N" or result.settings.get("mean_force") is None):
        return []
    names = ("m_w", *(("m_z",) if not moved else ()), *LENGTHS)
    if not set(names) <= set(task.parameter_names):
        return []
    free = {
        name.removesuffix(at) if at else name for name, p in result.parameters.items() if p.free
    }
    held = [name for name in names if name not in free]
    told = {
        name: (
            f"{name} = {1e3 * float(task[name]):.3g} mm"
            if name in LENGTHS
            else f"{name} = {float(task[name]):.3g} kg"
        )
        for name in held
    }
    if not moved:
        factor, usual = result.settings.get("carried") or 1.0, float(PARAMETERS["m_w"].default)
        carried = abs(factor - 1) > 0.005 and all(
            np.isclose(float(task[m]), factor * usual) for m in ("m_w", "m_z")
        )
        means = f"The masses are the usual {usual:g} kg times {factor:.3g}. " * carried
        means += (
            "They are no measurements: a held force tells no length and no mass. Half of both"
            " x_ref, with twice the stiffness, damping and masses, would fit as well"
        )
        return (
            [f"held fixed: {', '.join(told.values())}. {means}"]
            if {"m_w", *LENGTHS} <= set(held)
            else []
        )
    said = []
    if "m_w" in held:
        said += [
            f"held fixed: {told['m_w']}. The data do not determine it, and the verdict would not"
            " notice a wrong value. But a wrong m_w makes C_w0 and K_w0 wrong, too"
            " (docs/perturbed.md has by how much). Leave m_w free, as by default: then the errors"
            " contain this doubt"
        ]
    if "x_ref_w" in held and f"K_w_tangent{at}" in result.derived:
        base = result.derived["K_w0" if "K_w0" in result.derived else f"K_w0{at}"].value
        tangent = result.derived[f"K_w_tangent{at}"].value
        other = [
            f"{tangent / (1 + (tangent / base - 1) / times**2):.4g}" for times in OTHER_LENGTHS
        ]
        lengths = " or ".join(
            f"{1e3 * times * float(task['x_ref_w']):.3g}" for times in OTHER_LENGTHS
        )
        said += [
            f"held fixed: {told['x_ref_w']}. No record determines it, and K_w0 depends on it: with"
            f" {lengths} mm K_w0 would be {' or '.join(other)} N/m, and the fit as good. So report"
            " K_w_tangent (stiffness of the active tissue as displaced in the hold) and"
            " tangent_stiffness (that of both tissues) instead: these hardly change"
        ]
    return said


def _per_newton(result: FitResult, shown: Mapping[str, Estimate]) -> str:
    """What the heading of a table says if numbers in it are no newtons."""
    there = result.per_newton and any(result[name].unit in RELATIVE for name in shown)
    return " (per newton of mean force)" * bool(there)


def _table(title: str, table: dict[str, Estimate], column: str = "") -> list[str]:
    """Rows of name, value ± error, interval and unit."""
    indent, wide = 4, max([26, *(2 + len(name) for name in table)])
    value, beside = (
        1 + max([0, *map(len, each)])
        for each in (
            [p.in_words() for p in table.values()],
            [p.interval_in_words() for p in table.values()],
        )
    )
    if wide > 26:  # names of one of several targets: no wider than it must be
        indent, wide = 2, wide - 1
    else:
        value, beside = max(20, value), max(20, beside)
    lines = (
        [f"  {title}:"]
        if not column
        else [f"  {title + ': ':<{wide + value + indent}}{column.strip()}"]
    )
    for name, p in table.items():
        interval, unit = f"{p.interval_in_words():<{beside}}" if column else "", _beside(name, p)
        lines.append(f"{'':{indent}}{name:<{wide}}{p.in_words():<{value}}{interval}{unit}".rstrip())
    return lines if table else [*lines, "    nothing"]


def _beside(name: str, p: Estimate) -> str:
    """What stands behind a number: its unit; a variation in percent, too."""
    base, at, _ = name.partition("@")
    if base == VARIATION:
        return f"{'' if at else '= '}{100 * p.value:.3g} %"
    # A parameter of an own muscle has a unit that only its author knows: it is never divided by a
    # force.
    return {"1": "", "": "in its own unit"}.get(p.unit, p.unit)


def _counted(shown: Mapping[str, Estimate], every: Mapping[str, Estimate]) -> list[str]:
    """Which intervals are wider than their errors say, and what numbers count where the model has a
    tremor, in sentences."""
    sentences = []
    broad = [name for name, p in shown.items() if _is_broad(p)]
    if broad:
        sentences.append(
            f"{', '.join(broad)}: the interval is much wider than two standard errors to both"
            " sides. State the interval: the error holds only near the best value"
        )
    for name in shown:
        base, at, target = name.partition("@")
        rhythm = every.get(f"resonance_frequency{at}{target}")
        if base == "resonance_share" and rhythm is not None:
            sentences.append(
                f"{name}: counted from {0.5 * rhythm.value:.2g} Hz on, half of its frequency"
            )
    return sentences


def _is_broad(p: Estimate) -> bool:
    """Whether its interval is much wider than its standard error says."""
    low, high = p.interval or (None, None)
    return (
        bool(p.stderr)
        and low is not None
        and high is not None
        and high - low > BROAD * (p.stderr or 0.0)
    )


def _by_band(result: FitResult, table: dict[str, Estimate]) -> list[str]:
    """The shares of power in bands, of fit and data, a sentence for each target."""
    sentences = []
    for name, part in result.parts.items():
        at, of = ("", "") if len(result.parts) == 1 else (f"@{name}", f" of {name}")
        shares = (
            in_bands(part.target.frequency, part.target.settings.resolution)
            @ part.target.proportional_power
        )
        fitted = [
            f"{100 * table[band + at].value:.2g} %" if band + at in table else "not determined"
            for band in BANDS
        ]
        each = [
            f"{low:g}-{high:g} Hz {own} ({100 * share:.2g} %)"
            for (low, high), own, share in zip(BANDS.values(), fitted, shares, strict=True)
        ]
        known = any(band + at in table for band in BANDS)
        sentences += [
            f"power by band{of}, fitted (measured): {', '.join(each)}; in percent of the power in"
            " the fitted bins"
        ] * known
    return sentences


def _head(result: FitResult) -> str:
    if len(result.parts) > 1:
        return f"together: {', '.join(result.parts)}"
    return (
        f"{result.target.name} ({result.target.provenance}), {result.only.model}, method"
        f" {result.method}"
    )


def _closeness(part: FittedPart, before: str = "", *, verdict: str = "") -> str:
    """χ² per bin and rms error of the fitted line, as far as they are known; no χ² that the verdict
    tells already."""
    own = "" if part.chi2_per_bin is None else f"chi2 per bin {part.chi2_per_bin:.2f}"
    mean = " (mean of new simulations)" if verdict.startswith("chi2 per bin") else ""
    said = [] if own in ("", verdict) else [own + mean]
    off = part.rms_log_error
    said += (
        []
        if off is None
        else [f"rms log error {off:.3f} (bins are off by a factor of {np.exp(off):.2f})"]
    )
    return before * bool(said) + ", ".join(said)


def _choice(result: FitResult) -> tuple[str, ...]:
    """Why the models were tried."""
    tremor = any(
        math.isfinite(part.target.measured["tremor_frequency"].value)
        for part in result.parts.values()
        if "tremor_frequency" in part.target.measured
    )
    return explain_choice(result.ladder, _datum(result), tremor=tremor)


def _datum(result: FitResult) -> str:
    """For what chi² of a model that was tried is counted: a bin, or also a point of the dynamic
    stiffness."""
    return "bin" if all(part.stiffness is None for part in result.parts.values()) else "datum"


def _trials(target: Target) -> list[str]:
    """How many trials and segments were averaged, and how much the trials differ; nothing of a
    single trial."""
    if target.segments is None or len(target.segments) < 2:
        return []
    counted = f"{len(target.segments)} trials, {sum(target.segments)} Welch segments"
    if target.dispersion is None:
        return [counted]
    spread = " ± ".join(f"{number:.2f}" for number in target.dispersion[:2])
    return [f"{counted}, dispersion {spread} (1 if they are alike)"]


def _stiffness(part: FittedPart) -> list[str]:
    """How many points of the dynamic stiffness were fitted, and how well."""
    if part.stiffness is None or part.target.stiffness is None:
        return []
    known = part.target.stiffness.known
    f, seen = known.frequency, int(np.sum(np.abs(part.stiffness) > 2 * known.stderr))
    faint = f" ({len(f) - seen} of them smaller than two standard errors, so they tell little)" * (
        seen < len(f)
    )
    return [
        f"dynamic stiffness: {len(f)} points from {f[0]:.2g} to {f[-1]:.2g} Hz{faint}, chi2 per"
        f" point {part.chi2_per_point:.2f}"
    ]
