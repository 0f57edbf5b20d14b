"""Units that several wings know."""

# Those of a force, in newtons. A kilogram-force is the weight of a kilogram at 9.80665 m/s^2 (CGPM
# 1901), a pound-force that of 0.45359237 kg.
KGF = 9.80665
NEWTONS = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "kgf": KGF, "gf": 1e-3 * KGF, "lbf": 0.45359237 * KGF}
LEVER_ARM = 0.05  # m, at which a joint in N m and rad is carried to the model's N and m
