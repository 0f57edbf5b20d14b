"""Units as files write them: of a signal, and of its times."""

import math
import re
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmuscle._common.arguments import require
from jaxmuscle._common.text import choices
from jaxmuscle._common.units import NEWTONS

if TYPE_CHECKING:
    from ._target_fields import Quantity

UNITS: "dict[str, Quantity | None]" = {
    "N": "force",
    "mN": "force",
    "kN": "force",
    "kgf": "force",
    "gf": "force",
    "lbf": "force",
    "% MVC": "force",
    "N m": "torque",
    "N cm": "torque",
    "N mm": "torque",
    "m": "displacement",
    "cm": "displacement",
    "mm": "displacement",
    "um": "displacement",
    "m/s^2": "acceleration",
    "mm/s^2": "acceleration",
    "g": "acceleration",
    "mg": "acceleration",
    "V": None,
    "mV": None,
    "a.u.": None,
}
# of a signal: what a load cell weighs
_SPELLINGS = {
    "nm": "N m",
    "ncm": "N cm",
    "nmm": "N mm",
    "%mvc": "% MVC",
    "pctmvc": "% MVC",
    "%": "% MVC",
    "\u03bcm": "um",
    "au": "a.u.",
    "newton": "N",
    "newtons": "N",
    "volt": "V",
    "volts": "V",
    "kg": "kgf",
    "kp": "kgf",
    "lb": "lbf",
    "lbs": "lbf",
}
_SI = {
    "force": NEWTONS,
    "torque": {"N m": 1.0, "N cm": 1e-2, "N mm": 1e-3},
    "displacement": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
    "angle": {"rad": 1.0, "deg": math.pi / 180},
}
_ANGLES = {
    "rad": "rad",
    "radian": "rad",
    "radians": "rad",
    "deg": "deg",
    "degree": "deg",
    "degrees": "deg",
    "°": "deg",
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
_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]()]+)[\])]\s*")
_SUFFIX = re.compile(
    r"(.+?)(?:_|\s*/\s*)(N|mN|kN|kgf?|gf|lbf|lbs?|pctMVC|Nm|Ncm|Nmm|m|cm|mm|um|µm|V|mV|s|ms|us|ns|deg|rad)\s*"
)


def known_unit(unit: str) -> str | None:
    """The unit as `UNITS` writes it (`Nm`, `N·m`, `N*m` are `N m`; `m/s²`, `m/s2` are `m/s^2`), or
    `None` if not there."""
    bare = "".join(
        unit.replace("μ", "µ")
        .replace("²", "2")
        .translate(str.maketrans("", "", "·*.^()[]"))
        .split()
    )
    exact = {"".join(name.replace(".", "").replace("^", "").split()): name for name in UNITS}
    return exact.get(bare) or _SPELLINGS.get(bare.casefold())


def quantity_of(unit: str) -> str | None:
    """What a unit measures: force, torque, displacement, angle, ...; `None` for an unknown one."""
    turned = unit.strip(" []()").casefold() in _ANGLES
    return "angle" if turned else UNITS.get(known_unit(unit) or "")


def seconds(unit: str | None) -> float | None:
    """How many seconds a unit of time has, or `None` for another unit."""
    return None if unit is None else SECONDS.get(unit.replace("μ", "µ").strip(" []().").casefold())


def name_and_unit(name: str) -> tuple[str, str | None]:
    """A column's name in small letters, and the unit it holds: `Force [N]`, `Kraft / N`, `force_N`,
    `torque_Nm`."""
    found = _BRACKETS.fullmatch(name) or _SUFFIX.fullmatch(name)
    return (
        (found[1].strip().casefold(), found[2].strip())
        if found
        else (name.strip().casefold(), None)
    )


def scale_to_si(unit: str, argument: str, quantity: str, lever_arm: Any) -> tuple[float, bool]:
    """What a force is multiplied with to be in N, a displacement to be in m; a torque or an angle
    needs a lever arm [m].

    **Returns:** the factor, and whether the lever arm is in it.

    **Raises:** `ValueError` that names `argument` for the unit of something else, and for a lever
    arm that is missing.
    """
    turned = {"force": "torque", "displacement": "angle"}[quantity]
    known = known_unit(unit) or _ANGLES.get(unit.strip(" []()").casefold())
    remedy = (
        f"give the unit of a {quantity} or of its {turned};"
        f" {choices(unit, (*_SI[quantity], *_SI[turned]))}"
    )
    if known in ("V", "mV"):
        remedy = (
            "a sensor gives volts. Multiply by its calibration first"
            f" ({'N' if quantity == 'force' else 'm'} for each volt), and name the column with the"
            f" new unit ({'force_N' if quantity == 'force' else 'displacement_m'})"
        )
    require(known in _SI[quantity] or known in _SI[turned], argument, unit, remedy)
    if known in _SI[quantity]:
        return _SI[quantity][str(known)], False
    remedy = (
        f"`{argument}` is {known}: give the distance from the axis to the insertion in m, as"
        " lever_arm=0.1; or, if nothing moved the insertion, the force alone, as `column`"
    )
    number = isinstance(lever_arm, int | float | np.number) and not isinstance(lever_arm, bool)
    require(number and 0 < lever_arm < math.inf, "lever_arm", lever_arm, remedy)
    scale, arm = _SI[turned][str(known)], float(lever_arm)
    return (scale / arm if quantity == "force" else scale * arm), True
