"""The designed motion against the flat one on simulated repeats: `python benchmarks/perturbed_design.py --repeats 300`.

Of the bundled knee extension, carried to nothing but its fit: for every repeat the force is drawn in the linear Gaussian law
(the dynamic stiffness at the fit times the motion, and noise of the model's density), and ln of the four coefficients is
found by least squares of the whitened ordinates, without a prior and with the noise known. Prints the variances.
"""

import argparse

import jax
import numpy as np
import scipy.optimize

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.response._input_response import parts_of_stiffness
from jaxmuscle.response._linearised import linearise

COEFFICIENTS = ("k_w", "k_z", "c_w", "c_z")


def repeats(task, made, power, count, seed):
    """ln of the coefficients over their true values, in repeats with these lines."""
    rng, f, seconds = np.random.default_rng(seed), made.frequency, made.lengthening.seconds
    sd = np.sqrt(np.asarray(jm.response.noise_density(task, f)) / (4 * seconds))
    moved = np.sqrt(2 * power) / 2
    true = np.array([float(task[name]) for name in COEFFICIENTS])

    @jax.jit
    def ordinates(x):
        changed = as_arrays(task).replace(**dict(zip(COEFFICIENTS, true * jax.numpy.exp(x), strict=True)))
        return parts_of_stiffness(changed, linearise(changed), f) * moved / sd

    slopes = jax.jit(jax.jacfwd(ordinates))
    reply = np.asarray(ordinates(np.zeros(4)))
    found = []
    for _ in range(count):
        seen = reply + rng.standard_normal(reply.shape)
        found.append(scipy.optimize.least_squares(
            lambda x, seen=seen: np.ravel(ordinates(x) - seen), np.zeros(4), lambda x: np.reshape(slopes(x), (-1, 4))
        ).x)  # fmt: skip
    return np.array(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=300)
    parser.add_argument("--fit", help="a fit.json instead of the bundled knee extension")
    asked = parser.parse_args()
    target = jm.load_target("vastus-lateralis-26mvc")
    result = jm.load_result(asked.fit) if asked.fit else jm.fit(jm.Isometric(), target, rungs=0)
    print("quantity  rms mm  band Hz   sd flat  sd designed  ratio of variances ± se  expected by design_input")
    with jax.enable_x64(True):
        for quantity, name in zip(("K_w0", "K_z0", "C_w0", "C_z0"), COEFFICIENTS, strict=True):
            made = jm.design_input(result, quantity)
            i = COEFFICIENTS.index(name)
            sd = [repeats(result.task, made, lines.power, asked.repeats, 1)[:, i].std(ddof=1)
                  for lines in (made.even, made.lengthening)]  # fmt: skip
            ratio = (sd[0] / sd[1]) ** 2
            band = f"{made.frequency[0]:g}-{made.frequency[-1]:g}"
            print(f"{quantity:8} {1e3 * made.rms:7.3g}  {band} {sd[0]:12.4f} {sd[1]:12.4f} "
                  f"{ratio:12.2f} ± {ratio * 2 / np.sqrt(asked.repeats - 1):.2f} {made.gain:16.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
