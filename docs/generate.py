"""Writes docs/reference/parameters.md from the parameter table: `python docs/generate.py`."""

import math
from pathlib import Path

from jaxmuscle.model._parameters import DEFAULT_FREE, PARAMETERS, Parameter

PAGE = Path(__file__).parent / "reference" / "parameters.md"
HEAD = """# Parameters and units

One table holds every parameter: `jm.PARAMETERS[name]` is its row. `docs/generate.py` writes this page from it.

## One name everywhere

A parameter has the name of this table wherever you write it:

| to | write |
|---|---|
| make a task with it | `jm.Isometric(k_w=4e5, noise="pink")` |
| read it | `task["k_w"]`, `task.k_w`, `result["k_w"]` |
| change it | `task.replace(k_w=4e5)` |
| say how it is fitted | `free=("k_w",)`, `fix={"k_w": 4e5}`, `priors={"k_w": 0.5}`, `bounds={"k_w": (1e5, 1e6)}` |
| do so from a shell | `--free k_w`, `--fix k_w=4e5` |

- Two tissues, one letter: `_w` is the active tissue, `_z` the passive one. Small letters are factors (`k_w`, `c_w`). What
  begins with `noise_` is the noise on a coefficient (`noise_K_w`).
- Results call three parameters by the name that people use. Both names work everywhere: `tremor_frequency` is
  `resonance_frequency`, `tremor_width` is `resonance_width`, `contraction_time` is `activation_time`.
- `K_w0`, `K_z0`, `C_w0` and `C_z0`, stiffness and damping at rest, follow from parameters. You can read them
  (`task["K_w0"]`, `result["K_w0"]`), but not set or fit them.
- `P_w`, `F_ext` and `x_z` are inputs over time. `task["P_w"]` is the level that is held, `task.P_w` the whole signal.
- In a joint fit `c_w@high` is that of the target "high" alone.
- A wrong name is an error that says which one you may have meant.

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
