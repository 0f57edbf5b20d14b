"""Ensembles at scale: against the best hand-written scans, numba and C; threads, processes, memory,
single precision."""

import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from anchors import ANCHOR, anchors
from batched import DT, EVERY, SEEDS, STEPS, band_by_hand, white_by_hand
from measure import Row, Unequal, seconds

import jaxmuscle as jm
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle._common.programs import kept_simulation
from jaxmuscle.model._stream import Draws, Stream
from jaxmuscle.simulation._grid import Grid
from jaxmuscle.simulation._integrator import integrated

OURS, WEAK, THREEFRY = "jaxmuscle, Gaussian", "jaxmuscle, weak", "jaxmuscle, threefry"
KEPT, BEST = "jaxmuscle, Gaussian, states kept", "hand-written batched lax.scan"


def _same_law(label: str, programs: dict[str, Any], ours: Any) -> None:
    """Other noise of the same law: the sd of 1024 seeds has a standard error of 2.2 %, the mean one
    of 3.1 % of it."""
    spread = float(np.std(ours))
    for name, program in programs.items():
        last = np.asarray(program())
        far = abs(float(np.mean(last)) - float(np.mean(ours))) / spread
        if not (abs(np.log(float(np.std(last)) / spread)) < 0.14 and far < 0.2):
            raise Unequal(
                f"{label}, {name}: mean {np.mean(last):.6g}, sd {np.std(last):.3g} of x_z, not sd"
                f" {spread:.3g}"
            )


def against(label: str, noise: Any, by_hand: Any, repetitions: int) -> list[Row]:
    """One block of seeds by diffrax with each kind of random numbers, by hand and by C, on one
    core.

    Every tenth output is kept, as for `reduce`; against the scan by hand, which does so, all
    states.
    """
    task, key = as_arrays(jm.PrescribedForce(noise=noise)), jax.random.key(0)
    hand, grid = eqx.filter_jit(by_hand), Grid(DT, STEPS, EVERY, reverse=False)

    @kept_simulation
    def ours(task, key, draws, states):
        streams = jax.vmap(lambda i: Stream.of(jax.random.fold_in(key, i), draws))(
            jnp.arange(SEEDS)
        )
        found = integrated((task,), streams, grid, "instant", states=states)
        return found.states if states else found.outputs[0]

    kinds = {OURS: Draws(), WEAK: Draws(increments="weak"), THREEFRY: Draws(generator="threefry")}
    programs: dict[str, Any] = {
        name: partial(ours, task, key, draws, False) for name, draws in kinds.items()
    }
    programs |= {KEPT: partial(ours, task, key, Draws(), True), BEST: partial(hand, task, key)}
    compared = anchors(task)
    last: dict[str, Any] = {
        name: lambda name=name: programs[name]()[:, -1] for name in (WEAK, THREEFRY)
    }
    last |= {name: lambda name=name: programs[name]()[:, -1, 2] for name in (KEPT, BEST)}
    _same_law(label, last | compared, np.asarray(programs[OURS]())[:, -1])
    programs |= compared
    with one_core():
        taken = seconds(programs, repetitions)
    steps = dict.fromkeys(programs, SEEDS * STEPS)
    found = [
        Row(
            f"{label}: {name}",
            float(np.median(each.processor) / steps[name] * 1e9),
            "ns per seed and step",
        )
        for name, each in taken.items()
    ]
    asked = [(KEPT, BEST, 2.0), (OURS, ANCHOR, 0.45), (WEAK, ANCHOR, 0.8), (THREEFRY, ANCHOR, None)]
    for name, other, target in asked:
        if other in taken:
            ratio = float(np.median(taken[other].processor / taken[name].processor))
            found.append(
                Row(f"{label}: speed of {name} by processor time", ratio, "times", other, target)
            )
    return found


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """All threads of this process on one core, where the system can do that."""
    everywhere = os.sched_getaffinity(0) if hasattr(os, "sched_setaffinity") else set()
    try:
        _pin({min(everywhere)} if everywhere else set())
        yield
    finally:
        _pin(everywhere)


def _pin(cores: set[int]) -> None:
    threads = Path("/proc/self/task")
    for thread in threads.iterdir() if cores and threads.exists() else ():
        os.sched_setaffinity(int(thread.name), cores)


def reduced(repetitions: int) -> list[Row]:
    """`ensemble(reduce=True)` of the default `Isometric` with its spectra and control variate; on
    one core."""
    task, key, seeds, found = jm.Isometric(), jax.random.key(0), 4096, []
    programs = {
        name: partial(jm.ensemble, task, key, seeds=seeds, reduce=True, increments=name)
        for name in ("gaussian", "weak")
    }
    with one_core():
        taken = seconds(
            {name: lambda run=run: run().mean for name, run in programs.items()}, repetitions
        )
    for name, each in taken.items():
        pace = float(np.median(each.processor)) / (seeds * 15_000) * 1e9
        found.append(Row(f"reduced Isometric, {name}", pace, "ns per seed and step"))
    ratio = float(np.median(taken["gaussian"].processor / taken["weak"].processor))
    return [
        *found,
        Row("reduced Isometric: speed of weak by processor time", ratio, "times", "gaussian"),
    ]


WORKER = """
import json, os, sys, time
cores, threads, seeds = json.loads(sys.argv[1])
os.sched_setaffinity(0, cores)
import jax
import jaxmuscle as jm
task, key = jm.PrescribedForce(noise=jm.WhiteNoise()), jax.random.key(0)
run = lambda: jm.ensemble(
    task, key, seeds=seeds, duration=1.0, control=False, reduce=True, threads=threads
)
run()
print("ready", flush=True)
for line in sys.stdin:
    begun = time.perf_counter()
    run()
    print(time.perf_counter() - begun, flush=True)
"""


def _worker(cores: list[int], threads: int, seeds: int) -> subprocess.Popen:
    """An ensemble in a process."""
    program = [sys.executable, "-c", WORKER, json.dumps([cores, threads, seeds])]
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
    """A reduced ensemble on two threads of one process, on two processes of one, against one core;
    turn by turn."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        return []
    seeds = 524_288  # so many that start and end, where one core is idle, do not count
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
        Row(f"threads: {name}", seeds * 1e3 / np.median(times) / 1e6, "million steps/s")
        for name, times in taken.items()
    ]
    for name, target in (("two threads", 1.8), ("two processes", None)):
        ratio = float(np.median(np.array(taken["one core"]) / np.array(taken[name])))
        found.append(Row(f"threads: speed of {name}", ratio, "times", "one core", target))
    return found


class Pace(NamedTuple):
    """Of `jaxmuscle ensemble`: seconds of the whole command for few seeds; seeds per second of wall
    and of processor time.

    These are reckoned by how much longer it takes for many more.
    """

    short: float
    wall: float
    processor: float


def processes(repetitions: int) -> list[Row]:
    """`jaxmuscle ensemble` as one process with one thread, and with two workers."""
    ways = {"one thread": ("--threads", "1"), "two workers": ("--workers", "2")}
    turns = [{name: _pace(way) for name, way in ways.items()} for _ in range(repetitions)]
    found = []
    for name in ways:
        short, wall, processor = np.median([turn[name] for turn in turns], axis=0).tolist()
        found += [
            Row(f"processes: {name}, speed", wall, "seeds/s"),
            Row(f"processes: {name}, speed by processor time", processor, "seeds/s"),
            Row(f"processes: {name}, whole command with start", short, "s"),
        ]
    one, two = ([turn[name] for turn in turns] for name in ways)
    speed = float(np.median([b.wall / a.wall for a, b in zip(one, two, strict=True)]))
    time_ = float(np.median([a.processor / b.processor for a, b in zip(one, two, strict=True)]))
    return [
        *found,
        Row("processes: speed of two workers", speed, "times", "one thread", 1.7),
        Row(
            "processes: two workers, processor time",
            time_,
            "times",
            "one thread",
            1.2,
            at_most=True,
        ),
    ]


def _pace(way: tuple[str, ...]) -> Pace:
    few, many = 32_768, 425_984
    (short, busy), (long, busier) = (_command(way, seeds) for seeds in (few, many))
    return Pace(short, (many - few) / (long - short), (many - few) / (busier - busy))


def _command(way: tuple[str, ...], seeds: int) -> tuple[float, float]:
    """Wall and processor time [s] of the command and its workers."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "jaxmuscle", "ensemble", "zagrodny-slifkin", "--reduce"]
        given = ["--seeds", str(seeds), "--duration", "1", "--out", f"{folder}/a.zarr"]
        begun, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [*command, *given, *way], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if done.returncode:
            raise Unequal(f"processes: {' '.join(way)} failed")
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        return time.perf_counter() - begun, busy


MEMORY = """
import sys, threading, time, jax, jaxmuscle as jm
from jaxmuscle.ensembles._speed import peak_memory
jm.ensemble, jm.WhiteNoise
before = peak_memory()
task = jm.PrescribedForce(noise=jm.WhiteNoise())
found = jm.ensemble(task, jax.random.key(0), seeds=int(sys.argv[1]), duration=1.0,
                    control=False, reduce=True, threads=2)
assert found.success
print((peak_memory() - before) / 2**20)
"""


def memory() -> list[Row]:
    """Peak memory above import of a reduced ensemble of 1 s: 100 000 and 1 000 000 seeds."""
    found, values = [], []
    for seeds in (100_000, 1_000_000):
        begun = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", MEMORY, str(seeds)], capture_output=True, text=True, check=True
        )
        values.append(float(done.stdout))
        name = f"memory: {seeds} seeds of 1 s, reduced"
        found += [
            Row(name, values[-1], "MiB", target=307, at_most=True),
            Row(name, time.perf_counter() - begun, "s"),
        ]
    return [
        *found,
        Row(
            "memory: 1 000 000 seeds over 100 000",
            values[1] / values[0],
            "times",
            target=1.1,
            at_most=True,
        ),
    ]


def precision() -> list[Row]:
    """What single precision does to spectra on the same noise: the largest error of a bin, of 64
    seeds and of one."""
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
        found += [
            Row(f"{name}, mean of 64 seeds", float(mean), "largest relative error of a bin"),
            Row(f"{name}, single seeds", float(error), "largest relative error of a bin"),
        ]
    return found


def rows(repetitions: int) -> list[Row]:
    """Everything, in single precision."""
    with jax.enable_x64(False):
        found = against("scale, white", jm.WhiteNoise(), white_by_hand, repetitions)
        found += against("scale, band-limited", jm.BandLimitedNoise(), band_by_hand, repetitions)
        return (
            found
            + reduced(repetitions)
            + threads(repetitions)
            + processes(repetitions)
            + memory()
            + precision()
        )
