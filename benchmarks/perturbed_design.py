"""The designed motion against the flat one on simulated repeats: `python
benchmarks/perturbed_design.py --repeats 300`.

Of the bundled knee extension as fitted. For every repeat the force is drawn in the linear Gaussian
law: the dynamic stiffness at the fit times the motion, and noise of the model's density. ln of the
four coefficients and of both masses is found by least squares of the whitened ordinates. What is
known of them besides (the data of the fit, the prior, the fluctuations of the record) is an
estimate that is drawn, too, with that covariance. Prints the variances.
"""

import argparse

import jax
import numpy as np
import scipy.optimize

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.response._input_response import parts_of_stiffness
from jaxmuscle.response._linearised import linearise
from jaxmuscle.uncertainty._input_design import Experiment

COEFFICIENTS = ("k_w", "k_z", "c_w", "c_z")
MASSES = ("m_w", "m_z")
FREE = (*COEFFICIENTS, *MASSES)


def beside(result, made):
    """Information of ln of what is free, without the motion; noise and harmonic, which are not in
    the response, left out."""
    experiment = Experiment.of(result, made.quantity, made.even, None)
    names, sd = list(experiment.here.coordinates.names), experiment.here.coordinates.sd
    own = [names.index(name) for name in FREE]
    covariance = np.linalg.inv(experiment.apart)[np.ix_(own, own)] * np.outer(sd[own], sd[own])
    return np.linalg.inv(covariance)


def repeats(task, made, power, known, count, seed):
    """ln of what is free over its true value, in repeats with these lines."""
    rng, f, seconds = np.random.default_rng(seed), made.frequency, made.lengthening.seconds
    sd = np.sqrt(np.asarray(jm.response.noise_density(task, f)) / (4 * seconds))
    moved = np.sqrt(2 * power) / 2
    true = np.array([float(task[name]) for name in FREE])
    root = np.linalg.cholesky(known).T

    @jax.jit
    def data(x):
        changed = as_arrays(task).replace(**dict(zip(FREE, true * jax.numpy.exp(x), strict=True)))
        ordinates = parts_of_stiffness(changed, linearise(changed), f) * moved / sd
        return jax.numpy.concatenate([jax.numpy.ravel(ordinates), root @ x])

    slopes, none = jax.jit(jax.jacfwd(data)), np.zeros(len(FREE))
    reply = np.asarray(data(none))
    found = []
    for _ in range(count):
        seen = reply + rng.standard_normal(reply.shape)
        found.append(
            scipy.optimize.least_squares(lambda x, seen=seen: data(x) - seen, none, slopes).x
        )
    return np.array(found)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=300)
    parser.add_argument("--fit", help="a fit.json instead of the bundled knee extension")
    asked = parser.parse_args()
    target = jm.load_target("vastus-lateralis-26mvc")
    result = jm.load_result(asked.fit) if asked.fit else jm.fit(jm.Isometric(), target, rungs=0)
    print(
        "quantity  rms mm  band Hz   sd flat  sd designed  ratio of variances ± se  expected by"
        " design_input"
    )
    with jax.enable_x64(True):
        for quantity, name in zip(("K_w0", "K_z0", "C_w0", "C_z0"), COEFFICIENTS, strict=True):
            made = jm.uncertainty.design_input(result, quantity)
            i = COEFFICIENTS.index(name)
            known = beside(result, made)
            sd = [
                repeats(result.task, made, lines.power, known, asked.repeats, 1)[:, i].std(ddof=1)
                for lines in (made.even, made.lengthening)
            ]
            ratio = (sd[0] / sd[1]) ** 2
            band = f"{made.frequency[0]:g}-{made.frequency[-1]:g}"
            print(
                f"{quantity:8} {1e3 * made.rms:7.3g}  {band} {sd[0]:12.4f} {sd[1]:12.4f} "
                f"{ratio:12.2f} ± {ratio * 2 / np.sqrt(asked.repeats - 1):.2f} {made.gain:16.2f}"
            )


if __name__ == "__main__":
    main()
