"""Numbers as figures print them: value, standard error, unit."""

import math
import re
from typing import Any

from jaxmuscle._common.text import rounded


def quantity(estimate: Any) -> tuple[str, str, str]:
    """Value, standard error and unit of an estimate in print: the error to two digits, the value to
    as many places."""
    value, stderr = float(estimate.value), estimate.stderr
    if not math.isfinite(value):
        return "not finite", "", unit_in_print(estimate.unit)
    stderr = float(stderr) if stderr is not None and 0 < stderr < math.inf else 0.0
    largest = max(abs(value), stderr)
    power = math.floor(math.log10(largest)) if largest > 0 else 0
    power = 0 if -2 <= power <= 3 else power
    value, stderr = value / 10.0**power, stderr / 10.0**power
    if estimate.identifiable and stderr > 0:
        shown, error = rounded(value, stderr)
        return shown, f"± {error}", unit_in_print(estimate.unit, power)
    error = "–" if estimate.identifiable else "not determined"
    return f"{value:#.3g}".rstrip("."), error, unit_in_print(estimate.unit, power)


BAND = re.compile(
    r"(?P<kind>band|share|relative_power|power)_(?P<low>[\d.]+|above)_(?P<high>[\d.]+)"
)
KINDS = {
    "band": "share of power",
    "share": "share of variance",
    "relative_power": "power",
    "power": "power",
}
RELATIVE_UNIT = "1e-6 mean²"  # of power over the squared mean
# what a number without a unit is a fraction of, and how it is printed
FRACTIONS = {
    "relative_power": (1e6, RELATIVE_UNIT),
    "coefficient_of_variation": (1e2, "% of mean"),
    "model_coefficient_of_variation": (1e2, "% of mean"),
    "tremor_size": (1e2, "% of mean"),
    "tremor_detectable": (1e2, "% of mean"),
    "share": (1e2, "%"),
    "band": (1e2, "%"),
    "level": (1e2, "% of maximum"),
}
DIGITS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def number_in_print(value: float) -> str:
    """A number of an axis: `20`, `0.0005`, `5e−5`. A raised exponent would be too small in a column
    of 85 mm."""
    digits, _, power = f"{value:g}".partition("e")
    return f"{digits}e{int(power)}".replace("-", "\N{MINUS SIGN}") if power else digits


def unit_in_print(unit: str, power: int = 0) -> str:
    raised = re.sub(r"\^(-?\d+)", lambda match: match[1].translate(DIGITS), unit)
    ten = f"10{str(power).translate(DIGITS)}" if power else ""
    return " ".join(part for part in (ten, raised if raised != "1" or not ten else "") if part)


def in_print(name: str, unit: str) -> tuple[float, str]:
    """The factor by which an axis shows a quantity, fractions in percent, and the axis's label."""
    starts = [kind for kind in FRACTIONS if name.startswith(kind)] if unit in ("", "1") else []
    factor, shown = FRACTIONS[starts[0]] if starts else (1.0, unit)
    return factor, in_words(name, shown)


def in_words(name: str, unit: str) -> str:
    """A quantity as the label of an axis, with its unit where it has one."""
    base, at, target = name.partition("@")
    words = re.sub(r"_(?![wz](\d|_|$))", " ", base)  # K_w is a symbol
    if found := BAND.fullmatch(base):
        low, high = (12, 30) if found["low"] == "above" else (found["low"], found["high"])
        words = f"{KINDS[found['kind']]}, {low} to {high}\N{NO-BREAK SPACE}Hz"
    if unit in ("", "1"):
        return f"{words}{at}{target}"
    shown = unit_in_print(unit)
    return f"{words}{at}{target} {shown if shown.startswith('(') else f'({shown})'}"
