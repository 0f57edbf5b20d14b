"""The result of a fit as text, and as a table in a notebook."""

from collections.abc import Mapping

import numpy as np

from jaxmuscle._common.cards import Card
from jaxmuscle._common.text import folded
from jaxmuscle.data._target import Target
from jaxmuscle.fits._part import RELATIVE, Estimate, FittedPart, as_people_say, once
from jaxmuscle.fits._result import FitResult
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._derived import MEANINGS
from jaxmuscle.spectra._fluctuations import BANDS, in_bands

from ._ladder_text import gain_sentences, ladder_table, skipped_models

LENGTHS = ("x_ref_w", "x_ref_z")
OTHER_LENGTHS = (0.75, 1.5)  # times x_ref_w
BROAD = 1.7 * 3.92  # standard errors: an interval that is wider than theirs
COLUMNS = ("name", "value", "95 % interval", "unit", "in the fit", "what it is")


def fit_card(result: FitResult) -> Card:
    """The result as text, and as a table of all its numbers: those that the data determine first,
    then what was fixed."""
    rows = []
    # then it has no frequency
    silent = all(float(part.task.harmonic.amplitude) == 0 for part in result.parts.values())
    fixed = {name: p for name, p in result.parameters.items() if not p.free}
    for name, p in result.as_shown(once(fixed, result.found)).items():
        if silent and base_of(name).startswith("harmonic_"):
            continue
        state = ("determined" if p.stderr is not None else "not determined") if p.free else "fixed"
        row, unit = PARAMETERS.get(base_of(name)), "" if p.unit == "1" else p.unit
        words = MEANINGS.get(base_of(name), "") if row is None else row.meaning.partition(";")[0]
        rows.append((name, p.in_words(), p.interval_in_words(), unit, state, words))
    order = ("determined", "not determined", "fixed")
    rows.sort(key=lambda row: order.index(row[4]))
    remarks = (
        f"{_head(result)}: {result.message}",
        *_gains(result),
        *result.advice,
        *result.notices,
        *result.remarks,
        *_held(result),
    )
    return Card(_text(result), _heading(result), COLUMNS, tuple(rows), remarks)


def _heading(result: FitResult) -> str:
    """The verdict as a sentence of its own."""
    if not result.success:
        return result.verdict[0].upper() + result.verdict[1:]
    subject = "The model" if result.adequate is not None else "Whether the model describes the data"
    return f"{subject} {result.verdict}"


def _text(result: FitResult) -> str:
    """The verdict, what the data determine and what they do not, and what to know about it."""
    single = len(result.parts) == 1
    lines = [_heading(result), f"  {_head(result)}"]
    lines += [f"  {result.message}"] * result.success
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
    lines += [f"  {row}" for row in ladder_table(result.ladder, _datum(result))]
    lines += [f"  {sentence}" for sentence in skipped_models(result.ladder)]
    lines += [f"  {sentence}" for sentence in _gains(result)]
    lines += [f"  {sentence}" for sentence in result.advice]
    lines += [f"  note: {notice}" for notice in result.notices]
    if single and result.rms_log_error is not None:
        lines.append(f"  {_closeness(result.only, verdict=result.closeness)}")
    lines += [
        f"  {'' if single else f'{name}: '}{words}"
        for name, p in result.parts.items()
        for words in _stiffness(p)
    ]
    lines += [f"  {sentence}" for sentence in result.remarks]
    every, shown = result.as_shown(result.found), result.as_shown(result.determined)
    intervals = any(p.interval is not None for p in shown.values())
    bands = {name: p for name, p in shown.items() if base_of(name) in BANDS}
    rows = {name: p for name, p in shown.items() if name not in bands}
    title = (
        "determined by the data"
        if result.adequate is not False
        else "would be determined if the model held"
    )
    lines += _table(title + _per_newton(result, rows), rows, " 95 % interval    " * intervals)
    lines += [f"  {sentence}" for sentence in (*_counted(rows, every), *_by_band(result, bands))]
    fixed = [name for name in result.products if name not in result.parameters]
    said = (
        "products and ratios that the data determine, though not each factor alone (jaxmuscle"
        " identifiability has values)"
    )
    lines += [f"  {said}: {', '.join(map(as_people_say, fixed))}"] if fixed else []
    loose = {name: p for name, p in every.items() if name not in shown and p.free}
    title = f"not determined: do not interpret these values{_per_newton(result, loose)}"
    lines += _table(title, loose) if loose else []
    lines += [f"  {sentence}" for sentence in _counted(loose, every)]
    if factor := result.settings.get("carried"):
        moved = any(part.stiffness is not None for part in result.parts.values())
        what = "P_w, stiffness" if moved else "P_w, masses (those that you did not fix), stiffness"
        lines += [
            f"  before the fit {what} and damping were multiplied by {factor:.3g}, so that the"
            " muscle has the measured mean force"
            + " (mean_force=False leaves the mean out)"
            * (not moved)
        ]
    lines += [f"  {sentence}" for sentence in _held(result)]
    if result.per_newton:
        mean = f"{result.derived['mean'].value:.3g} N"
        torque = any(part.target.quantity == "torque" for part in result.parts.values())
        given = " (of a torque it needs the lever arm: --lever-arm)" * torque
        lines += [
            f"  no mean force in newtons was given{given}, so the scale of force is unknown."
            " Forces, masses, stiffness and damping are stated here per newton of mean force. In"
            " fit.json (Python: result['K_w0'], to_dataframe()) they are those of a model muscle"
            f" that pulls with {mean}: divide by {mean}"
        ]
    if result.undetermined:
        whose = "the data leave" if single else "all targets together leave"
        lines += [f"  {whose} open:", *(f"    - {sentence}" for sentence in result.undetermined)]
    return folded(lines)


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
    if base == "coefficient_of_variation":
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
        rhythm = every.get(f"tremor_frequency{at}{target}")
        if base == "tremor_share" and rhythm is not None:
            sentences.append(
                f"{name}: counted from {0.5 * rhythm.value:.2g} Hz on, half of the tremor's"
                " frequency"
            )
        if base == "high_frequency_floor" and rhythm is not None:
            sentences.append(
                f"{name}: is the mean of the highest third of the bins, tremor included. Do not"
                " report it beside the tremor"
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


def _gains(result: FitResult) -> tuple[str, ...]:
    """What the parts of the chosen model gain, where several models were tried."""
    return gain_sentences(result.ladder, describes=result.adequate, datum=_datum(result))


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
