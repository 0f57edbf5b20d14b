"""Units as files write them: of a signal, and of its times; what the name of a column says it
holds."""

import math
import re
import unicodedata
from typing import Any

from jaxmuscle._common.arguments import is_real, require
from jaxmuscle._common.text import choices
from jaxmuscle._common.units import NEWTONS

# Each unit | what it measures (nothing: anything) | how else it is written, without blanks, in
# small letters. A load cell weighs in kg. Every unit may also be written in capitals or as it is.
_TABLE = """\
N | force | newton newtons
mN | force | millinewton millinewtons
kN | force | kilonewton kilonewtons
kgf | force | kg kp kgs kilogram kilograms kilopond kgforce kilogramforce
gf | force | gramforce gramsforce pond
lbf | force | lb lbs lbsf pound pounds poundforce poundsforce
% MVC | force | %mvc mvc% %ofmvc pctmvc percentmvc percentofmvc %mvf %mvic %mvt %
N m | torque | newtonmeter newtonmeters newtonmetre newtonmetres
mN m | torque |
N cm | torque |
N mm | torque |
kgf m | torque | kgm kpm
lbf ft | torque | ftlb ftlbs ftlbf lbft lbsft footpound footpounds poundfoot poundfeet
lbf in | torque | inlb inlbs inlbf lbin lbsin inchpound inchpounds
m | displacement | meter meters metre metres
cm | displacement | centimeter centimeters centimetre centimetres
mm | displacement | millimeter millimeters millimetre millimetres
um | displacement | micrometer micrometers micron microns
deg | angle | degree degrees ° grad
rad | angle | radian radians
m/s^2 | acceleration | ms2 m/s/s m/sec2 m/s2 ms^2 m/sec/sec mps2
mm/s^2 | acceleration | mms2 mm/s/s mm/sec2
g | acceleration | g's gs gn g0
mg | acceleration |
deg/s | angular velocity | dps °/s deg/sec degs1 degree/s degrees/s degps
rad/s | angular velocity | rads1 rad/sec radian/s radians/s radps
V |  | volt volts
mV |  | millivolt millivolts
uV |  | microvolt microvolts
a.u. |  | arb arbunits arbitraryunits counts count adc lsb bits"""
_ROWS = [[cell.strip() for cell in line.split("|")] for line in _TABLE.splitlines()]
UNITS = {unit: quantity or None for unit, quantity, _ in _ROWS}
SCALELESS = ("a.u.",)  # whose numbers say something only relative to their mean
# With a capital M these would be millions.
_SMALL = ("mN", "mN m")
# What a unit means in a column of that quantity; None where it is one that is not known here, as
# nm of a length are nanometres.
_MEANT = {
    ("force", "g"): "gf",
    ("force", "mg"): None,
    ("displacement", "N m"): None,
    ("magnetic field", "g"): None,
    ("magnetic field", "mg"): None,
}
_SI = {
    "force": NEWTONS,
    "torque": {
        "N m": 1.0,
        "mN m": 1e-3,
        "N cm": 1e-2,
        "N mm": 1e-3,
        "kgf m": NEWTONS["kgf"],
        "lbf ft": 0.3048 * NEWTONS["lbf"],
        "lbf in": 0.0254 * NEWTONS["lbf"],
    },
    "displacement": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "angle": {"rad": 1.0, "deg": math.pi / 180},
}
_SECONDS = {
    1.0: "s sec secs sek seg second seconds sekunden secondes segundos",
    60.0: "min minutes",
    3600.0: "h hr hours",
    1e-3: "ms msec msecs millisec milliseconds",
    1e-6: "us µs usec",
    1e-9: "ns nsec nanoseconds",
}
SECONDS = {name: scale for scale, names in _SECONDS.items() for name in names.split()}
# Words in the name of a column that say what it holds.
_WORDS = {
    "force": "force forces kraft load loadcell grip pinch fuerza forza forca kracht weight f fx fy"
    " fz",
    "torque": "torque torques moment moments drehmoment mx mz",
    "acceleration": "acc accel accelerometer acceleration accelerations beschleunigung ax ay az",
    "angular velocity": "angular gyro gyr gyroscope omega drehrate",
    "pressure": "pressure druck",
    "displacement": "position pos displacement disp length weg auslenkung",
    "angle": "angle winkel goniometer gonio",
    "velocity": "velocity speed vel",
    "magnetic field": "mag magnetometer",
    "electromyogram": "emg semg",
    "temperature": "temperature temp",
    "raw signal": "raw counts adc bits",
    "time": "time zeit t temps tiempo tempo tijd timestamp",
}
_QUANTITIES = {word: quantity for quantity, words in _WORDS.items() for word in words.split()}
# What another word in the name says better, the vaguest last.
_VAGUE = ("force", "raw signal", "time")
_WORD = re.compile(r"[A-Z]?[a-zäöüß]+|[A-ZÄÖÜ]+(?![a-zäöü])")
_BRACKETS = re.compile(r"\[([^\[\]]+)\]|\(([^()]+)\)")
# Where a name may end and its unit begin. A unit of several words is tried before its last word.
_BORDER = re.compile(r"\s*(?:[_/,;:.–—-]|\bin\b|\s)\s*")
# What a unit is by itself behind _ or /, whatever the name.
_PLAIN = re.compile("[mk]?N|kgf?|gf|lb[sf]?|pctMVC|N[cm]?m|[cmuµ]?m|m?V|[mun]?s|deg|rad")


def _squeezed(unit: str, slash: str) -> str:
    """A unit without blanks and signs between its parts; `slash` stands for `_`."""
    plain = unicodedata.normalize("NFKC", unit.replace("º", "°"))
    return re.sub(r"[\s·⋅∙•×*.^()\[\]−-]", "", plain.replace("μ", "u").replace("_", slash))


_EXACT = {_squeezed(unit, ""): unit for unit in UNITS}
_SPELLED = {_squeezed(unit, "").casefold(): unit for unit in UNITS} | {
    word: unit for unit, _, words in _ROWS for word in words.split()
}


def known_unit(unit: str, name: str = "") -> str | None:
    """The unit as `UNITS` writes it (`Nm`, `N·m`, `N-M` are `N m`; `m/s²`, `ms-2` are `m/s^2`), or
    `None` if not there.

    Capitals do not matter (`G` is `g`), except that `MN` is not `mN`. The `name` of its column says
    which of two is meant: `g` of a force are grams, `nm` of a length nanometres.
    """
    for bare in (_squeezed(unit, "/"), _squeezed(unit, "")):
        found = _EXACT.get(bare) or _SPELLED.get(bare.casefold())
        if found is not None and not (found in _SMALL and bare.startswith("M")):
            return _MEANT.get((named_quantity(name) or "", found), found)
    return None


def quantity_of(unit: str, name: str = "") -> str | None:
    """What a unit measures: force, torque, displacement, angle, ...; `None` for an unknown one."""
    return UNITS.get(known_unit(unit, name) or "")


def named_quantity(name: str) -> str | None:
    """What the words in the name of a column say that it holds: `Right Force` a force, `acc_x` an
    acceleration, `Force Plate Moment` a torque; `None` where they say nothing."""
    words = (word.casefold() for word in _WORD.findall(name))
    found = [_QUANTITIES[word] for word in words if word in _QUANTITIES]
    rank = {quantity: place for place, quantity in enumerate(_VAGUE, 1)}
    return min(found, key=lambda quantity: rank.get(quantity, 0), default=None)


def units_for(quantity: str | None) -> list[str]:
    """The units that a quantity is likely to have; of what a converter hands over volts."""
    measured = None if quantity in ("raw signal", "electromyogram") else quantity or ""
    return [unit for unit, each in UNITS.items() if each == measured]


def seconds(unit: str | None) -> float | None:
    """How many seconds a unit of time has, or `None` for another unit."""
    return None if unit is None else SECONDS.get(unit.replace("μ", "µ").strip(" []().").casefold())


def name_and_unit(name: str) -> tuple[str, str | None]:
    """A column's name in small letters, and the unit it holds: `Force [N]`, `Kraft / N`, `force_N`,
    `Kraft in N`, `torque_nm`, `acc_ms2`, `Force %MVC`.

    What stands behind the name without brackets counts as its unit if the name says that it holds
    that quantity. So `acc_g` has a unit, and `trial_g` has none. A name may be a unit: `%MVC`.
    """
    for found in _BRACKETS.finditer(name):
        unit, rest = (found[1] or found[2]).strip(), name[found.end() :].strip()
        if not rest or known_unit(unit) or seconds(unit):
            return f"{name[: found.start()].strip()} {rest}".strip().casefold(), unit
    for border in _BORDER.finditer(name, 1):
        head, unit = name[: border.start()], name[border.end() :].strip()
        if head.strip() and _is_unit(unit, head, border[0].strip()):
            return head.strip().casefold(), unit
    whole = name.strip() if len(name.strip()) > 1 and quantity_of(name) else None
    return name.strip().casefold(), whole


def _is_unit(text: str, head: str, border: str) -> bool:
    """Whether a text behind the name `head` is its unit."""
    if name_and_unit(head)[1] or known_unit(head.split()[-1]):  # Nm/kg is no unit of kg
        return False
    if border in ("_", "/") and _PLAIN.fullmatch(text):
        return True
    named, unit = named_quantity(head), known_unit(text, head)
    if unit is None:
        return named == "time" and seconds(text) is not None
    if UNITS[unit] is None or named is None:
        return len(text) > 1 and (unit not in SCALELESS or _squeezed(text, "") == "au")
    return UNITS[unit] == named or (unit == "% MVC" and named == "torque")


def scale_to_si(unit: str, argument: str, quantity: str, lever_arm: Any) -> tuple[float, bool]:
    """What a force is multiplied with to be in N, a displacement to be in m; a torque or an angle
    needs a lever arm [m].

    **Returns:** the factor, and whether the lever arm is in it.

    **Raises:** `ValueError` that names `argument` for the unit of something else, and for a lever
    arm that is missing.
    """
    turned, si = {"force": ("torque", "N"), "displacement": ("angle", "m")}[quantity]
    known, straight = str(known_unit(unit)), _SI[quantity]
    if known in straight:
        return straight[known], False
    if known not in _SI[turned]:
        remedy = (
            "a sensor gives volts. Multiply by its calibration first"
            f" ({si} for each volt), and name the column with the new unit ({quantity}_{si})"
            if known in ("V", "mV", "uV")
            else f"give the unit of a {quantity} or of its {turned};"
            f" {choices(unit, (*straight, *_SI[turned]))}"
        )
        raise ValueError(f"{argument}={unit!r}: {remedy}")
    if lever_arm is None:
        other = "angle" if turned == "torque" else "torque"
        raise ValueError(
            f"the {quantity} is {'a torque' if turned == 'torque' else 'an angle'} in {known},"
            f" without {'an angle' if other == 'angle' else 'a torque'}: give the distance from the"
            " axis to the insertion in m, as lever_arm=0.1; or, if nothing moved the insertion, the"
            " force alone, as `column`"
        )
    remedy = "give the distance from the axis to the insertion in m, as lever_arm=0.1"
    require(is_real(lever_arm) and lever_arm > 0, "lever_arm", lever_arm, remedy)
    scale, arm = _SI[turned][known], float(lever_arm)
    return (scale / arm if quantity == "force" else scale * arm), True
