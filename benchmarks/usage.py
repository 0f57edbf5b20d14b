"""Row 5: what a user of simulations waits for. Compilation, ensembles, gradients."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from handwritten import drawn
from integration import DT, SEEDS, STEPS
from measure import DTYPES, Row, require_equal, seconds
from noise_paths import respond

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.model._parameters import DEFAULT_FREE
from jaxmuscle.simulation._grid import Grid

GRADIENT_SEEDS = 8


def ensembles(repetitions: int) -> list[Row]:
    """Row 5, first part: compile time, warm time, real-time factor of an ensemble of the default
    task."""
    found: list[Row] = []
    for dtype in DTYPES:
        with jax.enable_x64(dtype == "float64"):
            jax.clear_caches()
            program = lambda: jm.ensemble(jm.Isometric(), jax.random.key(0), seeds=SEEDS).output  # noqa: E731
            start = time.perf_counter()
            jax.block_until_ready(program())
            first = time.perf_counter() - start
            warm = float(np.median(seconds({"warm": program}, repetitions)["warm"].wall))
        group = f"ensemble of {SEEDS} seeds, {dtype}"
        found += [
            Row(f"{group}: compile time (first call - warm)", first - warm, "s"),
            Row(f"{group}: warm time", warm, "s"),
            Row(f"{group}: simulated time", SEEDS * STEPS * DT / warm, "times", "real time"),
            Row(f"{group}: speed", SEEDS * STEPS / warm / 1e6, "million steps/s"),
        ]
    return found


def gradients(repetitions: int) -> list[Row]:
    """Row 5, second part: Jacobians of the 30-bin spectrum with respect to 8 log parameters, on
    given normals."""
    with jax.enable_x64(True):
        task, grid = as_arrays(jm.Isometric()), Grid(DT, STEPS, 10)
        normals = drawn(task.noise, jax.random.key(0), GRADIENT_SEEDS, STEPS)

        def spectrum(theta, normals):
            scaled = {n: task[n] * jnp.exp(theta[i]) for i, n in enumerate(DEFAULT_FREE)}
            moved = task.replace(**scaled)
            path = jax.vmap(lambda z: respond(moved, (z,), grid)[1])(normals)
            power = jm.spectra.spectrum_of(path, task.settings, (5.0, 15.0)).power.mean(0)
            return power / power.sum()

        functions = {
            "spectrum": spectrum,
            "jacfwd": jax.jacfwd(spectrum),
            "jacrev": jax.jacrev(spectrum),
        }
        compiled = {name: eqx.filter_jit(f) for name, f in functions.items()}
        theta = jnp.zeros(len(DEFAULT_FREE))
        programs = {name: lambda f=f: f(theta, normals) for name, f in compiled.items()}
        require_equal("jacfwd against jacrev", programs["jacfwd"](), programs["jacrev"](), 1e-8)
        taken = seconds(programs, repetitions)
    cost = {
        name: float(np.median(taken[name].wall / taken["spectrum"].wall))
        for name in ("jacfwd", "jacrev")
    }
    return [
        Row(
            "30-bin spectrum, float64: forward time", float(np.median(taken["spectrum"].wall)), "s"
        ),
        *(
            Row(f"30-bin spectrum, 8 parameters: cost of {n}", c, "times", "the forward cost")
            for n, c in cost.items()
        ),
    ]
