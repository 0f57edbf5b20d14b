"""The closed form: the expected spectrum and its derivatives against Monte Carlo, and as control
variate of it."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from integration import SEEDS
from measure import Program, Row, Taken, require_equal, seconds

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.model._parameters import DEFAULT_FREE

BLOCK = 25  # calls in a row, for what takes less than a millisecond
TEN = (*DEFAULT_FREE, "m_w", "noise_cutoff")
ERROR = 0.01
WARM_CALL, GRADIENT = 1e-3, 5.0
PAPER = {"noise_K_w": 0.0016, "noise_K_z": 0.0016, "noise_C_w": 1e-4, "noise_C_z": 1e-4}
FITTED = {
    "k_w": 4.558e5,
    "k_z": 7.836e5,
    "c_w": 111.5,
    "c_z": 1.777,
    "noise_K_w": 0.2672,
    "noise_K_z": 0.00204,
    "harmonic_amplitude": 0.003256,
    "harmonic_frequency": 3.92,
}


def _cost(taken: Mapping[str, Taken], name: str, other: str) -> float:
    """Median over rounds of the ratio of wall times within a round."""
    return float(np.median(taken[name].wall / taken[other].wall))


def _in_a_row(program: Program) -> Program:
    return lambda: [jax.block_until_ready(program()) for _ in range(BLOCK)]


def expected(repetitions: int) -> list[Row]:
    """The default isometric task in float64: value, derivatives with respect to ten parameters,
    plain Monte Carlo."""
    group = "expected spectrum, float64"
    with jax.enable_x64(True):
        task = jm.Isometric()
        traced = as_arrays(task)

        def spectrum(values):
            return jm.expected_spectrum(traced.replace(**dict(zip(TEN, values, strict=True)))).power

        values = jnp.array([float(task[name]) for name in TEN])
        functions = {
            "value": spectrum,
            "jacfwd": jax.jacfwd(spectrum),
            "jacrev": jax.jacrev(spectrum),
        }
        compiled = {name: jax.jit(f) for name, f in functions.items()}
        programs = {name: lambda f=f: f(values) for name, f in compiled.items()}
        programs["call"] = lambda: jm.expected_spectrum(task).power
        require_equal(
            "spectrum inside jit against call", programs["value"](), programs["call"](), 1e-10
        )
        require_equal("jacfwd against jacrev", programs["jacfwd"](), programs["jacrev"](), 1e-8)
        taken = seconds(
            {name: _in_a_row(program) for name, program in programs.items()}, 2 * repetitions
        )
        call, busy = (float(np.median(times)) / BLOCK for times in taken["call"])
        inside = float(np.median(taken["value"].wall)) / BLOCK
        needed, wall = _plain(task, repetitions)
    cost = {name: _cost(taken, name, "value") for name in ("jacfwd", "jacrev")}
    limits = {min(cost, key=cost.__getitem__): GRADIENT}
    return [
        Row(f"{group}: warm call", call, "s", target=WARM_CALL, at_most=True),
        Row(f"{group}: warm call, processor time", busy, "s"),
        Row(f"{group}: inside one jit", inside, "s"),
        *(
            Row(
                f"{group}, {len(TEN)} parameters: cost of {name}",
                value,
                "times",
                "the value, both inside one jit",
                limits.get(name),
                at_most=True,
            )
            for name, value in cost.items()
        ),
        Row(f"plain Monte Carlo, {100 * ERROR:g} % standard error: seeds", needed, "1"),
        Row(f"plain Monte Carlo, {100 * ERROR:g} % standard error: time", wall, "s"),
        Row(
            f"plain Monte Carlo, {100 * ERROR:g} % standard error: time",
            wall / call,
            "times",
            "the closed form",
        ),
    ]


def _plain(task: jm.model.AbstractTask, repetitions: int) -> tuple[float, float]:
    """Seeds and time [s] that a plain mean needs for a standard error of `ERROR` in the median bin,
    from `SEEDS` seeds."""

    def program():
        return jm.ensemble(task, jax.random.key(0), seeds=SEEDS, control=False).mean_spectrum()

    estimate = program()
    relative = float(np.median(estimate.plain_stderr / estimate.plain_power))
    needed = SEEDS * (relative / ERROR) ** 2
    each = (
        float(np.median(seconds({"plain": lambda: program().power}, repetitions)["plain"].wall))
        / SEEDS
    )
    return needed, needed * each


def control(repetitions: int) -> list[Row]:
    """How much variance the linearised task on the same noise paths takes away, and what carrying
    it costs."""
    found: list[Row] = []
    isometric, force = jm.Isometric(), jm.PrescribedForce()
    cases: tuple[tuple[str, jm.model.AbstractTask, float | None], ...] = (
        ("preset zagrodny-slifkin", jm.load_preset("zagrodny-slifkin"), 10_000.0),
        ("Isometric, paper's noise", isometric.replace(**PAPER), None),
        ("PrescribedForce, paper's noise", force.replace(**PAPER), None),
        ("Isometric fitted to vastus-lateralis-26mvc", isometric.replace(**FITTED), 200.0),
    )
    with jax.enable_x64(True):
        for name, task, target in cases:
            runs = {
                kind: lambda t=task, c=c: (
                    jm.ensemble(t, jax.random.key(0), seeds=SEEDS, control=c).output
                )
                for kind, c in (("with", None), ("without", False))
            }
            estimate = jm.ensemble(task, jax.random.key(0), seeds=SEEDS).mean_spectrum()
            taken = seconds(runs, repetitions)
            found += [
                Row(
                    f"control, {name}: variance",
                    float(np.median(estimate.variance_reduction)),
                    "times less, median bin",
                    target=target,
                ),
                Row(
                    f"control, {name}: time",
                    _cost(taken, "with", "without"),
                    "times",
                    "the ensemble without",
                ),
            ]
    return found
