"""The time grid of a simulation; apart from the integrator, so that who only loads a program does
without diffrax."""

import math

import equinox as eqx


class Grid(eqx.Module):
    """Time steps of a simulation: `steps` of `dt` [s], every `every`-th kept, each integrated in
    `substeps` parts.

    The integration variable is the step number, which floating point represents exactly in either
    precision. `reverse` asks for a loop that reverse-mode differentiation can go through; the other
    is faster and has the forward mode only.
    """

    dt: float = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)
    reverse: bool = eqx.field(static=True, default=True)


def parts_for(rate: float, step: float, longest: float) -> int:
    """Into how many parts, a power of two, a step [s] is cut so that rate [1/s] times part is at
    most `longest`."""
    return 2 ** max(0, math.ceil(math.log2(max(rate * step / longest, 1.0))))
