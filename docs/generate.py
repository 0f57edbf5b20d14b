"""Writes docs/reference/parameters.md from the parameter table: `python docs/generate.py`."""

import math
from pathlib import Path

from jaxmuscle.model._parameters import DEFAULT_FREE, PARAMETERS, Parameter

PAGE = Path(__file__).parent / "reference" / "parameters.md"
HEAD = """# Parameters and units

One table holds every parameter: `jm.PARAMETERS[name]` is its row, `task[name]` its value in a task,
`task.replace(name=value)` a copy with another value, `--fix NAME=VALUE` and `--free NAMES` the same from a shell. This page
is written by `docs/generate.py` from that table.

## Values

*Bounds* are what is physically possible; a name with a dot (●) is free in a default fit.

| name | symbol | unit | default | bounds | meaning |
|---|---|---|---|---|---|
"""
FIT = """
## In a fit

A positive parameter is fitted in log space, and *prior sd* is the standard deviation of its logarithm about the value of the
task that is passed in; of the others it is in the parameter's own unit.

| name | log space | prior sd | reached by a fit | source of the default |
|---|---|---|---|---|
"""
TAIL = """
## Units

SI throughout: masses in kg, lengths in m, forces in N, times in s, frequencies in Hz, angles in rad. `k` [N/m³] times a
squared length is a stiffness [N/m], `c` [N s³/m³] times a squared velocity a damping coefficient [N s/m]. A unit of 1 is a
ratio: noise and harmonic amplitudes are fractions of the coefficient at rest.

::: jaxmuscle.PARAMETERS

The table by name, a dictionary of `Parameter`.

::: jaxmuscle.model.Parameter
"""
POWERS = str.maketrans("23", "²³")


def number(value: float) -> str:
    if math.isinf(value):
        return "∞" if value > 0 else "-∞"
    return f"{value:.4g}".replace("e+0", "e").replace("e-0", "e-")


def interval(low: float, high: float) -> str:
    left = "(" if math.isinf(low) else "["
    right = ")" if math.isinf(high) else "]"
    return f"{left}{number(low)}, {number(high)}{right}"


def unit(row: Parameter) -> str:
    """With powers as a reader writes them; a unit is not broken between lines."""
    text = row.unit.replace("^", "").translate(POWERS) if "^" in row.unit else row.unit
    return text.replace(" ", "&nbsp;")


def page() -> str:
    """The text of the page."""
    values, fits = [], []
    for row in PARAMETERS.values():
        name = f"`{row.name}`" + (" ●" if row.name in DEFAULT_FREE else "")
        bounds = interval(row.lower, row.upper)
        values.append(f"| {name} | {row.symbol} | {unit(row)} | {number(row.default)} | {bounds} | {row.meaning} |\n")
        reached = interval(row.fit_lower, row.fit_upper)
        log = "yes" if row.positive else "no"
        source = row.source.replace("^2", "²")
        fits.append(f"| `{row.name}` | {log} | {number(row.prior_sd)} | {reached} | {source} |\n")
    return HEAD + "".join(values) + FIT + "".join(fits) + TAIL


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
