"""Measured numbers as lines of a table."""

import math
from collections.abc import Sequence

from jaxmuscle._common.text import probability, squared
from jaxmuscle.spectra._bin_law import ENOUGH

from ._measure import Measure
from ._measured import FAST, LEVEL_NAME, MEAN, MEDIAN, RANGES, RECORDED, VARIATION, Measures

CUT_OFF = RECORDED.filter_cutoff or math.inf  # Hz, of the low-pass before everything
RELATIVE = "relative_power"
WIDE = 28
BY_ITSELF = " (steady part, automatic)"
WITHIN = "± is from within one recording; between trials we saw about twice as much"
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
TREMOR = "tremor, {:g} to {:g} Hz"
TREMOR_SIZES = ("tremor_size", "tremor_detectable")


def read_line(
    name: str, count: int, quantity: str | None, unit: str | None, seconds: Sequence[float]
) -> str:
    """What was read: "p01_rest   3 trials of torque (N m), 13.4 s each"."""
    trials = f"{count} trials" if count > 1 else "1 trial"
    short, long = min(seconds), max(seconds)
    lasted = f"{short:.1f} s" + f" to {long:.1f} s" * (long > 1.01 * short)
    of = f"{quantity or 'signal'}{f' ({unit})' * (unit is not None)}"
    return f"{name}   {trials} of {of}, {lasted}{' each' * (count > 1)}"


def scatter_of(trials: int) -> str:
    """On what the errors stand, where trials tell them."""
    return f"  ± from the scatter of {trials} trials" * (trials >= ENOUGH)


def heading(title: str) -> str:
    """The heading of measured numbers, which stand two columns further in."""
    return f"{title:<{2 + WIDE + 25}} 95 % interval"


def measured_lines(measures: Measures, band: tuple[float, float]) -> list[str]:
    """All measures with errors and intervals, but for shares of the variance."""
    # about a mean of zero there is nothing to relate a power to
    relative = math.isfinite(measures[VARIATION].value)
    square = squared(measures[MEAN].unit).replace("^2", "²")
    lines = [measured_line(words, name, measures[name]) for name, words in WORDS.items()]
    if LEVEL_NAME in measures:
        lines.insert(1, measured_line("  over the MVC", LEVEL_NAME, measures[LEVEL_NAME]))
    lines.append(f"power by band, {'1e-6 mean²' if relative else square}")
    for name, edges in RANGES.items():
        key = f"{RELATIVE if relative else 'power'}{name}"
        lines.append(measured_line(f"  {range_words(*edges)}", key, measures[key]))
    lines += [measured_line(words, name, measures[name]) for name, words in REGULAR.items()]
    return lines + tremor_lines(measures, band)


def tremor_lines(measures: Measures, band: tuple[float, float]) -> list[str]:
    """The frequency of a tremor and its size, or that none is seen and which size would show."""
    first, least = TREMOR.format(*band), measures["tremor_detectable"]
    if math.isfinite(measures["tremor_frequency"].value):
        of = " over the mean" * (least.unit == "1")
        rows = {"tremor_frequency": first, "tremor_size": f"  size{of}"}
        return [measured_line(words, name, measures[name]) for name, words in rows.items()]
    told = measured_line("", "tremor_detectable", least).strip()
    would = f"; {told} would show" * math.isfinite(least.value)
    return [f"{first:<{WIDE}}none seen, {probability(measures['tremor_p'].value)}{would}"]


def range_words(low: float, high: float) -> str:
    """A band in words."""
    return f"{low:g} to {min(high, CUT_OFF):g} Hz"


def measured_line(words: str, name: str, m: Measure) -> str:
    """A measure with its error and interval; the ends have as many places as value and error."""
    percent = name.startswith((VARIATION, LEVEL_NAME, "share")) or (
        name in TREMOR_SIZES and m.unit == "1"
    )
    bare = m.unit == "1" or name.startswith("power")
    scale, unit = (
        (100.0, " %") if percent else (1.0, "" if bare else f" {m.unit.replace('^2', '²')}")
    )
    scaled = m.times(scale * (1e6 if name.startswith(RELATIVE) else 1.0))
    said = f"{scaled.in_words()}{unit * (not math.isnan(m.value))}"
    return f"{words:<{WIDE}}{said:<25} {scaled.interval_in_words()}".rstrip()
