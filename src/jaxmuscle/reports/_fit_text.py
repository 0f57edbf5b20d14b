"""The result of a fit as text, and as a table in a notebook."""

import math
from collections.abc import Iterable, Mapping

import numpy as np

from jaxmuscle._common.cards import Card
from jaxmuscle._common.text import WIDTH, folded, probability
from jaxmuscle.data._frequency_response import JOINT
from jaxmuscle.data._measured import is_recorded, tremor_band
from jaxmuscle.data._measured_text import (
    BY_ITSELF,
    REGULAR,
    WIDE,
    WITHIN,
    WORDS,
    heading,
    measured_line,
    read_line,
    scatter_of,
    tremor_lines,
)
from jaxmuscle.data._recording import FOUND, UNRAMPED
from jaxmuscle.data._second_order import UNITS
from jaxmuscle.data._target import Target
from jaxmuscle.fits._checks import CONVERGED
from jaxmuscle.fits._intervals import HALF_POWER
from jaxmuscle.fits._result import RELATIVE, Estimate, FitResult, FittedPart, once
from jaxmuscle.model._parameters import PARAMETERS
from jaxmuscle.model._rungs import REFLEX, model_name
from jaxmuscle.objective._arguments import base_of
from jaxmuscle.objective._derived import GAINS, LIMB, MEANINGS, PHASES, TISSUES, VARIATION
from jaxmuscle.spectra._bin_law import ENOUGH, samples_of_trials
from jaxmuscle.spectra._fluctuations import BANDS, in_bands

from ._ladder_text import explain_choice, ladder_table
from ._methods import windows_of

LENGTHS = ("x_ref_w", "x_ref_z")
OTHER_LENGTHS = (0.75, 1.5)  # times x_ref_w
BROAD = 1.7 * 3.92  # standard errors: an interval that is wider than theirs
# measured numbers in words: all that a fit prints, those of its short text, and those that are left
# there where the model does not fit
ALL = {
    **{name: words for name, words in WORDS.items() if not name.endswith("_above_0.5")},
    "relative_power_4_8": "power 4-8 Hz, 1e-6 mean²",
    "relative_power_8_12": "power 8-12 Hz, 1e-6 mean²",
    **{name: REGULAR[name] for name in ("median_frequency", "sample_entropy")},
}
SHOWN = {name: words for name, words in ALL.items() if name != "standard_deviation"}
FEW = {n: SHOWN[n] for n in ("mean", "coefficient_of_variation", "relative_power_8_12")}
# numbers of the model that it prints, in words: of a held force, and of a moved limb
REFLEX_ROWS = {
    "reflex_gain": "reflex, gain",
    "reflex_delay": "reflex, delay",
    "reflex_time": "reflex, contraction time",
}
RHYTHMS = {
    "resonance_frequency": "resonance of the drive",
    "resonance_2_frequency": "second resonance",
    "harmonic_frequency": "regular rhythm",
    "half_power_frequency": "half-power frequency",
    **REFLEX_ROWS,
}
OF_LIMB = {
    "tangent_stiffness": "tangent_stiffness, H(0)",
    "B0": "B0, damping as f -> 0",
    "m_z": "m_z, moved mass",
}
IN_SERIES_ONLY = "if there are two tissues in series and nothing beside them:"
# what a number that the data do not determine belongs to, by the beginning of its name
KINDS = {
    "active stiffness": ("k_w", "K_w"),
    "passive stiffness": ("k_z", "K_z"),
    "active damping": ("c_w", "C_w"),
    "passive damping": ("c_z", "C_z"),
    "stiffness of the limb": ("tangent_stiffness", "gain_"),
    "damping of the limb": ("B0", "phase_"),
    "mass of the active tissue": ("m_w",),
    "moved mass": ("m_z",),
    "lengths": ("x_ref",),
    "nervous drive": ("P_w",),
    "noise": ("noise_",),
    "twitch": ("activation_time", "contraction_time"),
    "corner frequency": ("corner_frequency",),
    "half-power frequency": ("half_power_frequency",),
    "regular rhythm": ("harmonic_",),
    "stretch reflex": ("reflex_",),
    "second resonance": ("resonance_2_",),
    "resonance": ("resonance_",),
    "": ("model_", *BANDS),  # these are measured
}
MOST, LINES = 3, 24  # checks that are printed, lines of one target
CHOSEN = (
    "the model was chosen for these data alone: `jaxmuscle study` fits all people with one model"
)
IN_SERIES = "active and passive tissue in series"  # where no spectrum was fitted
REPORT = "Report only what is measured."
# share of the variance of a half that was not fitted, from which on a model of a moved limb that
# does not fit is described
MOSTLY = 0.8
AS_FAR = "Its numbers describe the limb as far as that goes:"
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
        state = "not determined" if p.interval is None else "interval alone"
        state = ("determined" if p.stderr is not None else state) if p.free else "fixed"
        row, unit = PARAMETERS.get(base_of(name)), "" if p.unit == "1" else p.unit
        words = MEANINGS.get(base_of(name), "") if row is None else row.meaning.partition(";")[0]
        of_model.append((name, p.in_words(), p.interval_in_words(), unit, state, words))
    order = ("determined", "interval alone", "not determined", "fixed")
    rows += sorted(of_model, key=lambda row: order.index(row[4]))
    remarks = (
        f"{_head(result)}: {result.message}",
        *_choice(result),
        *result.advice,
        *result.notices,
        *result.unstated,
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


def fit_text(result: FitResult, saved: str | None = None) -> str:
    """What was read, what is measured, whether the model describes it, what then is known of the
    model, and what is not; at most 24 lines for one target, 12 where the model does not fit.

    `saved`: the file of the result, for whoever reads this in a terminal.

    The numbers of a model that does not describe the data are left to `fit_details`.
    """
    missed = result.success and result.adequate is False
    lines = [line for name, part in result.parts.items() for line in _read(result, name, part)]
    for name, part in result.parts.items():
        words = FEW if missed else SHOWN
        if len(result.parts) > 1 or (part.stiffness is not None and not missed):
            words = {n: FEW[n] for n in ("mean", "coefficient_of_variation")}
        lines += _measured(result, name, part, words)
        lines += _measured_response(part) if missed else []
    lines += _judged(result)
    if result.success and not missed:
        lines += _results(result, saved)
    elif _is_described(result):
        lines += _description(result)
    checks = _checks(result)
    several, hidden = len(result.parts) > 1, len(checks)
    if not missed:
        room = LINES - 1 - len(folded(lines).splitlines())
        shown = 1 if several else max(1, min(MOST, room))
        lines, hidden = [*lines, *checks[:shown]], max(0, hidden - shown)
    more = "print(result.details())" if saved is None else f"jaxmuscle fit {saved} -v"
    noted = f", {hidden} more notice{'s' * (hidden > 1)}" * (hidden > 0)
    return folded([*lines, f"All numbers{noted}: {more}"])


def _read(result: FitResult, name: str, part: FittedPart) -> list[str]:
    """The data in a line: name, trials, quantity, length; of a moved one also its response."""
    target, called = part.target, part.target.name
    if len(result.parts) > 1 and name != called:
        called = f"{name}: {called}"
    bins, found = len(target.bins), []
    if bins and is_recorded(target.measured):
        # a spectrum keeps the windows of its trials in words, or only how many segments they have
        seconds = [stop - start for _, start, stop in windows_of(target)] or [
            samples / target.settings.rate for samples in samples_of_trials(target)
        ]
        count = len(target.segments or ())
        line = read_line(called, count, target.quantity, target.unit, seconds)
        chosen = any(notice.startswith(FOUND) for notice in target.notices)
        found.append(f"{line}{BY_ITSELF * chosen}")
    elif bins:
        spectrum = f"spectrum of {target.quantity} ({target.provenance})"
        found.append(f"{called}   {spectrum}, {bins} bins")
        if target.segments is not None:
            found.append(f"{sum(target.segments)} segments")
    if part.stiffness is not None and target.stiffness is not None:
        f = target.stiffness.known.frequency
        said = f"dynamic stiffness, {f[0]:.2g} to {f[-1]:.2g} Hz"
        found.append(said if found else f"{called}   {said}")
    return [", ".join(found)]


def _measured(
    result: FitResult, name: str, part: FittedPart, words: Mapping[str, str]
) -> list[str]:
    """Measured numbers of one target by these words, then its tremor."""
    found = part.target.measured
    rows = [measured_line(said, key, found[key]) for key, said in words.items() if key in found]
    if "tremor_frequency" in found:
        lines = tremor_lines(found, tremor_band(part.target.quantity))
        rows += lines if len(result.parts) == 1 else lines[:1]
    if not rows:
        return []
    of = f" of {name}" * (len(result.parts) > 1)
    return [
        heading(f"MEASURED{of}{scatter_of(len(part.target.segments or ()))}"),
        *(f"  {row}" for row in rows),
    ]


def _measured_response(part: FittedPart) -> list[str]:
    """The dynamic stiffness that was measured, in the thirds of the band."""
    if part.target.stiffness is None or not part.thirds:
        return []
    found = part.target.stiffness.known
    arm, unit = found.lever_arm or 1.0, JOINT if found.lever_arm else "N/m"
    lines = []
    for f in dict.fromkeys(part.thirds):
        i = int(np.argmin(np.abs(found.frequency - f)))
        gain = Estimate(float(found.gain[i]), "N/m", float(found.stderr[i])).times(arm**2, unit)
        phase = Estimate(float(found.phase[i]), "deg", float(found.phase_stderr[i]))
        lines.append(f"  {f'H({f:.2g} Hz)':<{WIDE}}{_briefly(gain)}, {_briefly(phase)}")
    return lines


def _explained(part: FittedPart) -> list[str]:
    """Which share of the variance of the force the response explains."""
    shares = part.explained
    if not shares:
        return []
    said = (
        f"explains {100 * shares['together']:.1f} % of the variance of the force,"
        f" {shares['low']:.2g} to {shares['high']:.2g} Hz"
    )
    if "reflex" in shares:
        alone, more = 100 * shares["tissues"], 100 * shares["reflex"]
        said += f" (tissues {alone:.1f} %, reflex {more:.1f} %)"
    if "other_half" in shares:
        said += f"; {100 * shares['other_half']:.1f} % in the half that is not fitted"
    return [f"  {said}"]


def _is_described(result: FitResult) -> bool:
    """Whether a model of a moved limb foretells most of what it was not fitted to."""
    each = [part.explained for part in result.parts.values() if part.stiffness is not None]
    return bool(each) and all(one.get("other_half", 0.0) >= MOSTLY for one in each)


def _description(result: FitResult) -> list[str]:
    """What holds of the limb whatever its tissues are, and the reflex."""
    shown = _about_axis(result, result.as_shown(result.found))
    limb = {n: p for n, p in shown.items() if base_of(n) in set(LIMB) - {*GAINS, *PHASES}}
    known = {n: p for n, p in shown.items() if base_of(n) in REFLEX_ROWS and p.stderr is not None}
    return [*_of_limb(result, limb), *(_row(n, p, REFLEX_ROWS) for n, p in known.items())]


def _judged(result: FitResult) -> list[str]:
    """The model, and whether it describes the data."""
    if not result.success:
        return [f"MODEL  {result.verdict}"]
    parts = [part for part in result.parts.values() if part.fitted.size]
    name = " and ".join(dict.fromkeys(model_name(part.task) for part in parts))
    if not parts:
        reflex = "reflex_gain" in result.parameters
        name = IN_SERIES + f" + {REFLEX}" * reflex
    verdict = result.adequacy
    shares = [line for part in result.parts.values() for line in _explained(part)]
    if verdict is None:
        return [f"MODEL  {name}: {result.verdict}", *shares]
    if verdict.adequate:
        return [f"MODEL  {name}: fits, {probability(verdict.p)}", *shares]
    closing = AS_FAR if _is_described(result) else REPORT
    return [
        f"MODEL  {name}: does NOT fit, {probability(verdict.p)}",
        *shares,
        f"  {verdict.misfit[0].upper()}{verdict.misfit[1:]}. {closing}",
    ]


def _results(result: FitResult, saved: str | None) -> list[str]:
    """What is known of the model, in rows, and what these data do not tell."""
    every, shown = (
        _about_axis(result, result.as_shown(table)) for table in (result.found, result.determined)
    )
    recorded = any(is_recorded(part.target.measured) for part in result.parts.values())
    several = len(result.parts) > 1
    moved = any(part.stiffness is not None for part in result.parts.values())
    limb = {n: p for n, p in every.items() if base_of(n) in {*LIMB, *TISSUES}} if moved else {}
    rhythms = {n: words for n, words in RHYTHMS.items() if not (moved and n == HALF_POWER)}
    rows = {
        name: p
        for name, p in shown.items()
        if base_of(name) in rhythms
        or ((several or not recorded) and not moved and name in result.free)
        or (base_of(name) not in {*PARAMETERS, *MEANINGS})  # of an own muscle
    }
    lines = _of_limb(result, limb)
    if (p := result.harmonic_p_value) is not None:
        seen = "seen" if p < 0.05 else "none seen"
        lines.append(f"  {'regular rhythm (harmonic)':<{WIDE}}{seen}, {probability(p)}")
    lines += [_row(name, p, rhythms) for name, p in rows.items()]
    rows |= {n: p for n, p in limb.items() if _is_known(p)}
    lines += [f"   {_per_newton(result, rows)}"] * bool(_per_newton(result, rows))
    if recorded and not moved and len(result.ladder) > 1:
        lines.append(f"  {CHOSEN}")
    loose = [n for n, p in every.items() if p.stderr is None and p.free and n not in rows]
    if unknown := unknown_kinds(loose, rows):
        lines.append(f"NOT KNOWN from these data: {', '.join(unknown)}")
        command = f"jaxmuscle identifiability {saved}"
        lines.append(
            f"  What would tell: {'jm.identifiability(result)' if saved is None else command}"
        )
    return lines


def _is_known(p: Estimate) -> bool:
    return p.stderr is not None or p.interval is not None


def _of_limb(result: FitResult, found: Mapping[str, Estimate]) -> list[str]:
    """First what holds of a moved limb whatever its tissues are, then what if there are two in
    series; of what is known the value with its error, or the interval alone."""
    known = {n: p for n, p in found.items() if _is_known(p)}
    whatever = [n for base in LIMB for n in known if base_of(n) == base]
    lines = [_row(n, known[n], OF_LIMB) for n in whatever if base_of(n) not in {*GAINS, *PHASES}]
    for key, part in result.parts.items():
        at = f"@{key}" * (len(result.parts) > 1)
        # of few points some are the same; of a held record there is none
        pairs = dict(zip(part.thirds, zip(GAINS, PHASES, strict=True), strict=False))
        for f, pair in pairs.items():
            both = [_briefly(known[n + at]) for n in pair if n + at in known]
            lines += [f"  {f'H({f:.2g} Hz)':<{WIDE}}{', '.join(both)}"] * bool(both)
    tissues = [_row(n, known[n], {}) for base in TISSUES for n in known if base_of(n) == base]
    return [*lines, *[f" {IN_SERIES_ONLY}"] * bool(tissues), *tissues]


def _row(name: str, p: Estimate, words: Mapping[str, str], wide: int = WIDE) -> str:
    """A number with its interval."""
    base, at, target = name.partition("@")
    said = words.get(base, base) + f", {target}" * bool(at)
    interval = p.interval_in_words() if p.stderr is not None else ""
    return f"  {said + ' ':<{wide}}{_briefly(p):<25} {interval}".rstrip()


def _briefly(p: Estimate) -> str:
    """Value and error, or the interval alone where no error describes it."""
    alone = p.stderr is None and p.interval is not None
    said = p.interval_in_words() if alone else p.in_words()
    return said + f" {p.unit}" * (p.unit not in ("1", ""))


def _lever_arm(result: FitResult) -> float | None:
    """At which distance [m] from the axis of a joint its numbers in N and m are; None of others."""
    responses = (part.target.stiffness for part in result.parts.values())
    return next((one.lever_arm for one in responses if one is not None and one.lever_arm), None)


def _about_axis(result: FitResult, table: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Numbers of a limb, those of a joint about its axis: stiffness, damping and mass times the
    square of the lever arm."""
    arm = _lever_arm(result)
    units = dict(zip(UNITS["N/m"], UNITS[JOINT], strict=True))
    own = {*LIMB, *TISSUES, "reflex_gain"}
    return {
        n: p.times(arm**2, units[p.unit]) if arm and base_of(n) in own and p.unit in units else p
        for n, p in table.items()
    }


def unknown_kinds(loose: Iterable[str], known: Iterable[str]) -> list[str]:
    """What loose quantities belong to, in words, each once, without those of known ones; a quantity
    of an own muscle by its name."""
    found, stated = dict.fromkeys(map(_kind, loose)), {"", *map(_kind, known)}
    words = [kind for kind in found if kind not in stated]
    for what in ("stiffness", "damping"):
        if {f"active {what}", f"passive {what}"} <= set(words):
            words[words.index(f"active {what}")] = what
            words.remove(f"passive {what}")
    return words


def _kind(name: str) -> str:
    base = base_of(name)
    return next((kind for kind, begins in KINDS.items() if base.startswith(begins)), base)


def _checks(result: FitResult) -> list[str]:
    """The first sentences of what should be looked at, the gravest first."""
    within = any(map(_is_within, result.parts.values()))
    poor = [] if not result.success or result.message.startswith(CONVERGED) else [result.message]
    # the windows stand in the first line
    seen = [n for n in result.notices if FOUND not in n and UNRAMPED not in n]
    return [f"CHECK  {_in_short(said)}" for said in (*poor, *seen, *[WITHIN] * within)]


def _in_short(notice: str) -> str:
    """Its first sentence; of a long one what stands before its last colon, if that says enough."""
    first = notice.partition(". ")[0]
    before = first.rpartition(": ")[0]
    return before if len(first) > WIDTH - len("CHECK  ") and len(before) > WIDTH / 3 else first


def _is_within(part: FittedPart) -> bool:
    """Whether trials are too few for errors from what differs between them."""
    return is_recorded(part.target.measured) and len(part.target.segments or ()) < ENOUGH


def fit_details(result: FitResult) -> str:
    """All that is measured and all that the fit found: also the models that were tried, every
    parameter, what the data do not determine and what they leave open."""
    lines = [_head(result)]
    for name, part in result.parts.items():
        lines += _measured(result, name, part, ALL)
        if _is_within(part):
            lines.append(f"  {WITHIN}")
    lines += _judged(result)
    if result.adequacy is not None:
        lines.append(
            f"  {result.closeness} (expected {result.adequacy.expected / result.data:.2f})"
        )
    lines += [f"  {result.message}"] * result.success
    lines += [f"  {row}" for row in ladder_table(result.ladder, _datum(result))]
    lines += [f"  {sentence}" for sentence in _choice(result)]
    lines += _fitted_targets(result)
    if result.adequacy is not None and result.adequate is False:
        factor = result.adequacy.widening
        lines.append(
            f"  standard errors are widened by a factor of {factor:.2g}: it misses the data"
        )
    lines += [f"  note: {notice}" for notice in (*result.notices, *result.unstated)]
    lines += [f"  {sentence}" for sentence in result.remarks]
    return folded([*lines, *_whole_model(result)])


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


def _trembles(result: FitResult) -> bool:
    """Whether a tremor is measured of a target."""
    return any(
        math.isfinite(part.target.measured["tremor_frequency"].value)
        for part in result.parts.values()
        if "tremor_frequency" in part.target.measured
    )


def _whole_model(result: FitResult) -> list[str]:
    """All that the data determine, what they do not, and what they leave open."""
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
    joint = _about_axis(result, every)
    turned = [_row(n, p, {}, 18) for n, p in joint.items() if p is not every[n] and _is_known(p)]
    if turned:
        at = f"those in N and m are at {_lever_arm(result):g} m from it"
        lines += [f"  about the axis of the joint ({at}):", *turned]
    lines += [f"  {sentence}" for sentence in (*_counted(rows, every), *_by_band(result, bands))]
    loose = {name: p for name, p in every.items() if name not in shown and p.free}
    alone = {name: p for name, p in loose.items() if p.interval is not None}
    if alone:
        title = "state the interval alone: no error describes it"
        lines += _table(title, alone, " 95 % interval    ")
    loose = {name: p for name, p in loose.items() if name not in alone}
    if loose:
        title = f"not determined: do not interpret these values{_per_newton(result, loose)}"
        lines += [*_table(title, loose), *(f"  {sentence}" for sentence in _counted(loose, every))]
    lines += [f"  {sentence}" for sentence in _of_scale(result)]
    if result.undetermined:
        whose = "the data leave" if len(result.parts) == 1 else "all targets together leave"
        lines += [f"  {whose} open:", *(f"    - {sentence}" for sentence in result.undetermined)]
    return lines


def _of_scale(result: FitResult) -> list[str]:
    """What the scale of force stands on, and what was held."""
    lines = []
    if factor := result.settings.get("carried"):
        moved = any(part.stiffness is not None for part in result.parts.values())
        times = f"multiplied by {factor:.3g}"
        what = (
            f"P_w and stiffness were {times}, damping by its root {np.sqrt(factor):.3g}"
            if moved
            else f"P_w, masses (those that you did not fix), stiffness and damping were {times}"
        )
        lines.append(
            f"before the fit {what}, so that the muscle has the measured mean force"
            + " (mean_force=False leaves the mean out)" * (not moved)
        )
    lines += _held(result)
    if result.per_newton:
        torque = any(part.target.quantity == "torque" for part in result.parts.values())
        given = " (of a torque it needs the lever arm: --lever-arm)" * torque
        lines.append(
            f"no mean force in newtons was given{given}, so the scale of force is unknown. Forces,"
            " masses, stiffness and damping are stated per newton of mean force"
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
    own = result.parameters | result.derived
    there = result.per_newton and any(own[name].unit in RELATIVE for name in shown)
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
    return explain_choice(result.ladder, _datum(result), tremor=_trembles(result))


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
