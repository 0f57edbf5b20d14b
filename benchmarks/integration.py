"""Rows 1 to 3: the ensemble engine against hand-written scans and against diffrax's own Brownian
paths."""

from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from handwritten import band_scan, drawn, filter_matrices, stock_diffrax, white_scan
from measure import DTYPES, Program, Row, Unequal, require_equal, seconds, speed_ratio, speeds
from noise_paths import respond

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.simulation._grid import Grid

SEEDS, DT, EVERY, STEPS = 64, 1e-3, 10, 15_000
GRID = Grid(DT, STEPS, EVERY, reverse=False)
EPSILONS = 200  # rounding of 15 000 steps, most of which the damping forgets
OURS, SCAN, LAST = "jaxmuscle", "vmapped lax.scan", "lax.scan, seed axis last"


def _agreement(group: str, states: dict[str, Any]) -> None:
    tolerance = EPSILONS * float(jnp.finfo(states[OURS].dtype).eps)
    for name in (SCAN, LAST):
        difference = require_equal(
            f"{group}, {OURS} against {name}", states[OURS], states[name], tolerance
        )
        print(f"{group}: {OURS} equals {name} within {difference:.1e} (tolerance {tolerance:.1e})")


def _compare(
    group: str, programs: dict[str, Program], repetitions: int, target: float
) -> list[Row]:
    steps = dict.fromkeys(programs, SEEDS * STEPS)
    taken = seconds(programs, repetitions)
    ratios = speed_ratio(group, taken, steps, (OURS, SCAN), target)
    ratios += speed_ratio(group, taken, steps, (OURS, LAST)) if LAST in programs else []
    return speeds(group, taken, steps) + ratios


def _against_scan(
    label: str, noise: Any, given: Any, scans: dict[str, Any], repetitions: int, target: float
) -> list:
    """Integration on given noise, then whole calls; `given` prepares the noise, `scans` integrate
    it."""
    task, key = as_arrays(jm.PrescribedForce(noise=noise)), jax.random.key(0)
    normals = jax.block_until_ready(given(key))

    @eqx.filter_jit
    def engine(task, normals):
        return jax.vmap(lambda z: respond(task, (z,), GRID)[0])(normals)

    integrate = {name: eqx.filter_jit(scan) for name, scan in scans.items()}
    programs = {OURS: lambda: engine(task, normals)} | {
        n: partial(s, task, normals) for n, s in integrate.items()
    }
    _agreement(label, {name: program() for name, program in programs.items()})

    @eqx.filter_jit
    def whole(task, key):
        states = scans[SCAN](task, given(key))
        return states, states[..., 2]

    calls = {
        OURS: lambda: (lambda r: (r.states, r.output))(
            jm.ensemble(task, key, seeds=SEEDS, control=False)
        ),
        SCAN: lambda: whole(task, key),
    }
    tolerance = EPSILONS * float(jnp.finfo(normals.dtype).eps)
    require_equal(f"{label}, whole call", calls[OURS]()[0], calls[SCAN]()[0], tolerance)
    rows = _compare(f"{label}, integration", programs, repetitions, target)
    return rows + _compare(f"{label}, whole call", calls, repetitions, target)


def white(dtype: str, repetitions: int) -> list[Row]:
    """Row 1."""
    noise = jm.WhiteNoise()
    size = np.sqrt(DT / noise.rate)

    def vmapped(task, normals):
        return jax.vmap(lambda z: white_scan(task, size * z[1:], DT, EVERY))(normals)

    def seeds_last(task, normals):
        increments = size * jnp.moveaxis(normals[:, 1:], 0, -1)
        return jnp.moveaxis(white_scan(task, increments, DT, EVERY), -1, 0)

    given = eqx.filter_jit(lambda key: drawn(noise, key, SEEDS, STEPS))
    return _against_scan(
        f"white, {dtype}", noise, given, {SCAN: vmapped, LAST: seeds_last}, repetitions, 0.75
    )


def band_limited(dtype: str, repetitions: int) -> list[Row]:
    """Row 2."""
    noise = jm.BandLimitedNoise()
    matrices = filter_matrices(float(noise.rate), float(noise.cutoff), DT)

    def vmapped(task, normals):
        return jax.vmap(lambda z: band_scan(task, z, matrices, DT, EVERY))(normals)

    def seeds_last(task, normals):
        return jnp.moveaxis(
            band_scan(task, jnp.moveaxis(normals, 0, -1), matrices, DT, EVERY), -1, 0
        )

    given = eqx.filter_jit(lambda key: drawn(noise, key, SEEDS, STEPS))
    return _against_scan(
        f"band-limited, {dtype}", noise, given, {SCAN: vmapped, LAST: seeds_last}, repetitions, 0.5
    )


def stock(dtype: str, repetitions: int) -> list[Row]:
    """Row 3: whole calls, since these paths draw as they go. The tree spans 15 s, of which 1 s is
    integrated."""
    group, short = f"stock, {dtype}, whole call", 1000
    noise = jm.WhiteNoise()
    task, key = as_arrays(jm.PrescribedForce(noise=noise)), jax.random.key(0)
    paths = {
        "UnsafeBrownianPath": (lambda k: dfx.UnsafeBrownianPath((4,), k), STEPS),
        "VirtualBrownianTree": (
            lambda k: dfx.VirtualBrownianTree(0.0, STEPS * DT, DT / 2, (4,), k),
            short,
        ),
    }

    @eqx.filter_jit
    def run(task, key, name):
        path, steps = paths[name]
        keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(SEEDS))
        return jax.vmap(lambda k: stock_diffrax(task, path(k), noise.rate, DT, steps, EVERY))(keys)

    programs = {OURS: lambda: jm.ensemble(task, key, seeds=SEEDS, control=False).states}
    programs |= {name: partial(run, task, key, name) for name in paths}
    steps = {OURS: SEEDS * STEPS} | {name: SEEDS * n for name, (_, n) in paths.items()}
    for name, (_, count) in paths.items():
        _same_spread(f"{group}, {name}", programs[OURS](), programs[name](), count // EVERY)
    taken = seconds(programs, repetitions)
    ratios = speed_ratio(group, taken, steps, (OURS, "UnsafeBrownianPath"), 4.0)
    ratios += speed_ratio(group, taken, steps, (OURS, "VirtualBrownianTree"))
    return speeds(group, taken, steps) + ratios


def _same_spread(what: str, ours: Any, other: Any, sample: int) -> None:
    """Other noise, same law: standard deviations over the seeds agree to half, four times their
    standard error."""
    spreads = [np.std(np.asarray(states)[:, sample, 2]) for states in (ours, other)]
    if not abs(np.log(spreads[0] / spreads[1])) < 0.5:
        raise Unequal(
            f"{what}: standard deviations {spreads[0]:.3g} and {spreads[1]:.3g} of x_z differ"
        )


def rows(which: str, repetitions: int) -> list[Row]:
    """`white`, `band-limited` or `stock`, in both precisions."""
    measure = {"white": white, "band-limited": band_limited, "stock": stock}[which]
    found: list[Row] = []
    for dtype in DTYPES:
        with jax.enable_x64(dtype == "float64"):
            found += measure(dtype, repetitions)
    return found
