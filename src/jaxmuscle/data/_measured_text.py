"""Measured numbers as lines of a table."""

import math

from jaxmuscle._common.text import probability, squared

from ._measure import Measure
from ._measured import FAST, LEVEL_NAME, MEAN, MEDIAN, RANGES, RECORDED, VARIATION, Measures

CUT_OFF = RECORDED.filter_cutoff or math.inf  # Hz, of the low-pass before everything
RELATIVE = "relative_power"
WIDE = 28
WORDS = {
    MEAN: "mean",
    "standard_deviation": "standard deviation",
    VARIATION: "coefficient of variation",
    f"{VARIATION}_without_drift": "  without a straight drift",
    f"{VARIATION}_above_{FAST:g}": f"  of what is above {FAST:g} Hz",
}
REGULAR = {
    MEDIAN: "median frequency",
    "approximate_entropy": "approximate entropy",
    "sample_entropy": "sample entropy",
    "dfa_exponent": "DFA exponent",
}
TREMOR = {
    "tremor_p": "tremor, {:g} to {:g} Hz",
    "tremor_frequency": "  frequency",
    "tremor_size": "  size{}",
    "tremor_detectable": "  size that would show",
}


def measured_lines(measures: Measures, band: tuple[float, float]) -> list[str]:
    """All measures with errors and intervals, under a heading."""
    # about a mean of zero there is nothing to relate a power to
    relative = math.isfinite(measures[VARIATION].value)
    square = squared(measures[MEAN].unit).replace("^2", "²")
    lines = [f"{'':<{WIDE}}{'value ± standard error':<25} 95 % interval"]
    lines += [measured_line(words, name, measures[name]) for name, words in WORDS.items()]
    if LEVEL_NAME in measures:
        lines.insert(2, measured_line("  over the MVC", LEVEL_NAME, measures[LEVEL_NAME]))
    kinds = {
        RELATIVE if relative else "power": (
            "power by band, in millionths of the squared mean"
            if relative
            else f"power by band [{square}]"
        ),
        "share": "share of the variance",
    }
    for kind, heading in kinds.items():
        lines.append(heading)
        for name, edges in RANGES.items():
            words = f"  {range_words(*edges)}"
            lines.append(measured_line(words, f"{kind}{name}", measures[f"{kind}{name}"]))
    lines += [measured_line(words, name, measures[name]) for name, words in REGULAR.items()]
    return lines + tremor_lines(measures, band)


def tremor_lines(
    measures: Measures, band: tuple[float, float], *, short: bool = False
) -> list[str]:
    """Whether there is one; its frequency and size, or the size that would have shown; `short`,
    without the p-value of one that is seen."""
    p, seen = measures["tremor_p"].value, measures["tremor_frequency"]
    first = TREMOR["tremor_p"].format(*band)
    of = " over the mean" * (measures["tremor_detectable"].unit == "1")
    if short and not math.isfinite(seen.value):
        least = measures["tremor_detectable"]
        told = measured_line("", "tremor_detectable", least).strip()
        would = f"; {told} would show" * math.isfinite(least.value)
        return [f"{first:<{WIDE}}none seen, {probability(p)}{would}"]
    if short:
        rows = {"tremor_frequency": first, "tremor_size": TREMOR["tremor_size"].format(of)}
        return [measured_line(words, name, measures[name]) for name, words in rows.items()]
    here = math.isfinite(seen.value)
    lines = [f"{first:<{WIDE}}{'seen' if here else 'none seen'}, {probability(p)}"]
    for name in list(TREMOR)[1:3] if here else list(TREMOR)[3:]:
        if math.isfinite(measures[name].value):
            lines.append(measured_line(TREMOR[name].format(of), name, measures[name]))
    return lines


def range_words(low: float, high: float) -> str:
    """A band in words."""
    return f"{low:g} to {min(high, CUT_OFF):g} Hz"


def measured_line(words: str, name: str, m: Measure) -> str:
    """A measure with its error and interval; the ends have as many places as value and error."""
    percent = name.startswith((VARIATION, LEVEL_NAME, "share")) or (
        name in TREMOR and m.unit == "1"
    )
    bare = m.unit == "1" or name.startswith("power")
    scale, unit = (
        (100.0, " %") if percent else (1.0, "" if bare else f" {m.unit.replace('^2', '²')}")
    )
    scaled = m.times(scale * (1e6 if name.startswith(RELATIVE) else 1.0))
    said = f"{scaled.in_words()}{unit * (not math.isnan(m.value))}"
    return f"{words:<{WIDE}}{said:<25} {scaled.interval_in_words()}".rstrip()
