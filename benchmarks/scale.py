"""Ensembles at scale: against the best hand-written scans, numba and C; threads, processes, memory, single precision."""

import ctypes
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numba
import numpy as np
from batched import DT, SEEDS, STEPS, band_by_hand, grid_inputs, numbers, white_by_hand
from measure import Row, Unequal, require_equal, seconds, speed_ratio, speeds

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays

OURS, BEST = "jaxmuscle.ensemble", "hand-written batched lax.scan"
EPSILONS = 200


@numba.njit(fastmath=True)
def _numba_loop(rng, p, scale, P_w, F_ext, harmonic_w, harmonic_z, seeds, steps, dt, out):
    m_w, m_z, k_w, k_z, c_w, c_z, xw2, xz2, vw2, vz2 = p
    for seed in range(seeds):
        y, moved, first = np.zeros(4, np.float32), np.zeros(4, np.float32), np.zeros(4, np.float32)
        for k in range(steps):
            n0, n1 = scale[0] * rng.standard_normal(), scale[1] * rng.standard_normal()
            n2, n3 = scale[2] * rng.standard_normal(), scale[3] * rng.standard_normal()
            moved[:] = y
            for half in range(2):
                x_w, v_w, x_z, v_z = moved
                K_w = dt * (k_w * (xw2 + x_w * x_w) + harmonic_w[k + half]) + n0
                K_z = dt * (k_z * (xz2 + x_z * x_z) + harmonic_z[k + half]) + n1
                C_w, C_z = dt * c_w * (vw2 + v_w * v_w) + n2, dt * c_z * (vz2 + v_z * v_z) + n3
                passive = C_z * (v_z - v_w) + K_z * (x_z - x_w)
                a_w = (dt * P_w[k + half] - C_w * v_w - K_w * x_w + passive) / m_w
                a_z = -(dt * F_ext[k + half] + passive) / m_z
                if half == 0:
                    first[0], first[1], first[2], first[3] = dt * v_w, a_w, dt * v_z, a_z
                    moved[:] = y + first
                else:
                    y[0] += 0.5 * (first[0] + dt * v_w)
                    y[1] += 0.5 * (first[1] + a_w)
                    y[2] += 0.5 * (first[2] + dt * v_z)
                    y[3] += 0.5 * (first[3] + a_z)
        out[seed] = y[2]


def _anchors(task: Any) -> dict[str, Any]:
    """numba with PCG64, and C if there is a compiler; both return the last x_z of every seed."""
    inputs = [np.ascontiguousarray(row, np.float32) for row in grid_inputs(task)]
    p = tuple(np.float32(v) for v in numbers(task))
    scale = np.asarray(task.noise_scale() * np.sqrt(DT / float(task.noise.rate)), np.float32)

    def by_numba():
        out = np.empty(SEEDS, np.float32)
        _numba_loop(np.random.Generator(np.random.PCG64(1)), p, scale, *inputs, SEEDS, STEPS, np.float32(DT), out)
        return out

    compiler, found = shutil.which("gcc"), {"numba, PCG64": by_numba}
    if compiler is not None:
        folder = Path(tempfile.mkdtemp())
        source = Path(__file__).with_name("anchor.c")
        flags = ["-O3", "-march=native", "-ffast-math", "-shared", "-fPIC"]
        subprocess.run([compiler, *flags, str(source), "-o", str(folder / "anchor.so"), "-lm"], check=True)
        library = ctypes.CDLL(str(folder / "anchor.so"))
        library.simulate.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_float, *[ctypes.c_void_p] * 7]
        row = np.array(p, np.float32)

        def by_c():
            out = np.empty(SEEDS, np.float32)
            arrays = [array.ctypes.data for array in (row, scale, *inputs, out)]
            library.simulate(SEEDS, STEPS, DT, *arrays)
            return out

        found["C with SIMD"] = by_c
    return found


def _rows(label: str, noise: Any, by_hand: Any, target: float, repetitions: int, *, anchors: bool) -> list[Row]:
    task, key = as_arrays(jm.PrescribedForce(noise=noise)), jax.random.key(0)
    hand = eqx.filter_jit(by_hand)
    programs: dict[str, Any] = {
        OURS: lambda: jm.ensemble(task, key, seeds=SEEDS, duration=STEPS * DT, control=False).states,
        BEST: partial(hand, task, key),
    }
    tolerance = EPSILONS * float(jnp.finfo(jnp.float32).eps)
    ours, theirs = np.asarray(programs[OURS]())[:, 1:], np.asarray(programs[BEST]())
    require_equal(f"{label}: {OURS} against {BEST}", ours, theirs, tolerance)
    if anchors:
        programs |= _anchors(task)
        spread = float(np.std(ours[:, -1, 2]))
        for name in list(programs)[2:]:
            # Other noise of the same law: the sd of 1024 seeds has a standard error of 2.2 %, the mean one of 3.1 % of it.
            last = programs[name]()
            far = abs(float(np.mean(last)) - float(np.mean(ours[:, -1, 2]))) / spread
            if not (abs(np.log(float(np.std(last)) / spread)) < 0.14 and far < 0.2):
                raise Unequal(
                    f"{label}, {name}: mean {np.mean(last):.6g}, sd {np.std(last):.3g} of x_z, not sd {spread:.3g}"
                )
    steps = dict.fromkeys(programs, SEEDS * STEPS)
    taken = seconds(programs, repetitions)
    found = speeds(label, taken, steps) + speed_ratio(label, taken, steps, (OURS, BEST), target)
    for name in list(programs)[2:]:
        found += speed_ratio(label, taken, steps, (OURS, name))
    return found


WORKER = """
import json, os, sys, time
cores, devices, seeds = json.loads(sys.argv[1])
os.sched_setaffinity(0, cores)
import jax
jax.config.update("jax_num_cpu_devices", devices)
import jaxmuscle as jm
task, key = jm.PrescribedForce(noise=jm.WhiteNoise()), jax.random.key(0)
run = lambda: jm.ensemble(task, key, seeds=seeds, duration=1.0, control=False, reduce=True)
run()
print("ready", flush=True)
for line in sys.stdin:
    begun = time.perf_counter()
    run()
    print(time.perf_counter() - begun, flush=True)
"""


def _worker(cores: list[int], devices: int, seeds: int) -> subprocess.Popen:
    program = [sys.executable, "-c", WORKER, json.dumps([cores, devices, seeds])]
    worker = subprocess.Popen(program, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert worker.stdout is not None and worker.stdout.readline().strip() == "ready"
    return worker


def _ask(workers: list[subprocess.Popen]) -> float:
    for worker in workers:
        assert worker.stdin is not None
        worker.stdin.write("go\n")
        worker.stdin.flush()
    return max(float(worker.stdout.readline()) for worker in workers if worker.stdout is not None)


def threads(repetitions: int) -> list[Row]:
    """A reduced ensemble on two devices of one process, on two processes of one, against one core; turn by turn."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return []
    seeds = 131_072
    groups = {
        "one core": [_worker(cores[:1], 1, seeds)],
        "two threads": [_worker(cores[:2], 2, seeds)],
        "two processes": [_worker([core], 1, seeds // 2) for core in cores[:2]],
    }
    taken: dict[str, list[float]] = {name: [] for name in groups}
    for _ in range(repetitions):
        for name, workers in groups.items():
            taken[name].append(_ask(workers))
    for worker in [worker for workers in groups.values() for worker in workers]:
        worker.kill()
        worker.wait()
    found = [
        Row(f"threads: {name}", seeds * 1e3 / np.median(times) / 1e6, "million steps/s") for name, times in taken.items()
    ]
    for name, target in (("two threads", 1.6), ("two processes", None)):
        ratio = float(np.median(np.array(taken["one core"]) / np.array(taken[name])))
        found.append(Row(f"threads: speed of {name}", ratio, "times", "one core", target))
    return found


def processes(repetitions: int) -> list[Row]:
    """`jaxmuscle ensemble` as 1, 2 and 4 processes on the loopback: the whole command, and its speed once compiled."""
    found, base = [], 0.0
    for count in (1, 2, 4):
        whole, speed = zip(*(_pace(count) for _ in range(max(1, repetitions // 3))), strict=True)
        found.append(Row(f"processes: {count}, speed", float(np.median(speed)), "seeds/s"))
        found.append(Row(f"processes: {count}, whole command with start and compilation", float(np.median(whole)), "s"))
        base = base or float(np.median(speed))
        if count > 1:
            found.append(Row(f"processes: efficiency of {count}", float(np.median(speed)) / base / count, "", "one process"))
    return found


def _pace(count: int) -> tuple[float, float]:
    """Seconds of the command for few seeds, and seeds per second: by how much longer it takes for many more."""
    few, many = 32_768, 425_984
    short, long = _command(count, few), _command(count, many)
    return short, (many - few) / (long - short)


def _command(count: int, seeds: int) -> float:
    """Seconds of the command."""
    folder = tempfile.mkdtemp()
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    command = [sys.executable, "-m", "jaxmuscle", "ensemble", "zagrodny-slifkin", "--seeds", str(seeds), "--reduce",
               "--duration", "1", "--devices", "1", "--out", f"{folder}/a.zarr"]  # fmt: skip
    each = [["--coordinator", f"127.0.0.1:{port}", "--processes", str(count), "--process-id", str(i)]
            for i in range(count)] if count > 1 else [[]]  # fmt: skip
    begun = time.perf_counter()
    workers = [subprocess.Popen([*command, *more], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) for more in each]
    if any([worker.wait() for worker in workers]):
        raise Unequal(f"processes: {count} processes failed")
    taken = time.perf_counter() - begun
    shutil.rmtree(folder)
    return taken


MEMORY = """
import sys, threading, time, jax, jaxmuscle as jm
from jaxmuscle.ensembles._speed import peak_memory
jax.config.update("jax_num_cpu_devices", 2)
jm.ensemble, jm.WhiteNoise
before = peak_memory()
found = jm.ensemble(jm.PrescribedForce(noise=jm.WhiteNoise()), jax.random.key(0), seeds=int(sys.argv[1]), duration=1.0,
                    control=False, reduce=True)
assert found.success
print((peak_memory() - before) / 2**20)
"""


def memory() -> list[Row]:
    """Peak memory above import of a reduced ensemble of 1 s: 100 000 and 1 000 000 seeds."""
    found, values = [], []
    for seeds in (100_000, 1_000_000):
        begun = time.perf_counter()
        done = subprocess.run([sys.executable, "-c", MEMORY, str(seeds)], capture_output=True, text=True, check=True)
        values.append(float(done.stdout))
        name = f"memory: {seeds} seeds of 1 s, reduced"
        found += [Row(name, values[-1], "MiB", target=1536, at_most=True), Row(name, time.perf_counter() - begun, "s")]
    return [*found, Row("memory: 1 000 000 seeds over 100 000", values[1] / values[0], "times", target=1.1, at_most=True)]


def precision() -> list[Row]:
    """What single precision does to spectra on the same noise: the largest error of a bin, of 64 seeds and of one."""
    found = []
    for task in (jm.Isometric(), jm.PrescribedForce()):
        powers = []
        for double in (False, True):
            with jax.enable_x64(double):
                runs = jm.ensemble(task, jax.random.key(0), seeds=64, control=False)
                powers.append(np.asarray(runs.spectrum().power, float))
        error = np.abs(powers[0] / powers[1] - 1).max()
        mean = np.abs(powers[0].mean(axis=0) / powers[1].mean(axis=0) - 1).max()
        name = f"precision: {type(task).__name__}, power in float32 against float64"
        found += [Row(f"{name}, mean of 64 seeds", float(mean), "largest relative error of a bin"),
                  Row(f"{name}, single seeds", float(error), "largest relative error of a bin")]  # fmt: skip
    return found


def rows(repetitions: int) -> list[Row]:
    """Everything, in single precision."""
    with jax.enable_x64(False):
        found = _rows("scale, white", jm.WhiteNoise(), white_by_hand, 0.9, repetitions, anchors=True)
        found += _rows("scale, band-limited", jm.BandLimitedNoise(), band_by_hand, 0.7, repetitions, anchors=False)
        return found + threads(repetitions) + processes(repetitions) + memory() + precision()
