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
    "band": "power",
    "share": "share of variance",
    "relative_power": "power over mean²",
    "power": "power",
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


def in_words(name: str, unit: str) -> str:
    """A quantity as the label of an axis; what has no unit is a ratio."""
    base, at, target = name.partition("@")
    words = base if base[1:2] == "_" else base.replace("_", " ")
    if found := BAND.fullmatch(base):
        low, high = (12, 30) if found["low"] == "above" else (found["low"], found["high"])
        words = f"{KINDS[found['kind']]}, {low} to {high}\N{NO-BREAK SPACE}Hz"
    return f"{words}{at}{target} ({'ratio' if unit in ('', '1') else unit_in_print(unit)})"
