"""Units that several wings know."""

NEWTONS = {"N": 1.0, "mN": 1e-3, "kN": 1e3}  # those of a force, in newtons
