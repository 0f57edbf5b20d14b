"""The time grid of a simulation; apart from the integrator, so that who only loads a program does without diffrax."""

import equinox as eqx


class Grid(eqx.Module):
    """Time steps of a simulation: `steps` of `dt` [s], every `every`-th kept, each integrated in `substeps` parts.

    The integration variable is the step number, which floating point represents exactly in either precision. `reverse`
    asks for a loop that reverse-mode differentiation can go through; the other is faster and has the forward mode only.
    """

    dt: float = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    every: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True, default=1)
    reverse: bool = eqx.field(static=True, default=True)
