"""How fast this machine simulates."""

import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmuscle.model._tasks import AbstractTask
from jaxmuscle.simulation._batch import threads_of
from jaxmuscle.simulation._simulate import DT, schedule

from ._ensemble import ensemble

REPETITIONS = 3


def peak_memory() -> int:
    """Most memory [bytes] that this process ever had; 0 where the system does not tell."""
    try:  # not getrusage, whose maximum Linux hands on from the process that started this one
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:"))
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
        1 if sys.platform == "darwin" else 1024
    )


def measure(
    task: AbstractTask, seeds: int, duration: float, threads: int | None = None
) -> dict[str, Any]:
    """Compile time, speed and memory of a reduced ensemble, which is run four times.

    The median time of the last three gives the speed. What the first took beyond that is the
    compile time, or where the program was kept, the time to load it.

    **Arguments:**

    - `task`: what is simulated
    - `seeds`: how many
    - `duration` [s]
    - `threads`: how many cores of a CPU (None: all)

    **Returns:** a dictionary: what was run (`task`, `noise`, `precision`, `device`, `threads`,
    `seeds`, `duration_s`, `substeps`), `compile_s`, `warm_s` (the median), `seeds_per_s`,
    `million_steps_per_s`, `real_time_factor`, `memory_above_start_mib`, and
    `device_memory_peak_mib` if the device states it.
    """
    before = peak_memory()
    taken = []
    for turn in range(1 + REPETITIONS):
        begun = time.perf_counter()
        ensemble(
            task,
            jax.random.key(turn),
            seeds=seeds,
            duration=duration,
            reduce=True,
            control=False,
            threads=threads,
        )
        taken.append(time.perf_counter() - begun)
    warm = float(np.median(taken[1:]))
    plan = schedule(task, duration, DT, None, None, None)
    devices = jax.local_devices()
    found = {
        "task": type(task).__name__,
        "noise": type(task.noise).__name__,
        "precision": str(jax.numpy.result_type(float)),
        "device": f"{len(devices)} x {devices[0].device_kind}",
        "threads": threads_of(threads),
        "seeds": seeds,
        "duration_s": duration,
        "substeps": plan.grid.substeps,
        "compile_s": taken[0] - warm,
        "warm_s": warm,
        "seeds_per_s": seeds / warm,
        "million_steps_per_s": seeds * plan.grid.steps * plan.grid.substeps / warm / 1e6,
        "real_time_factor": seeds * duration / warm,
        "memory_above_start_mib": (peak_memory() - before) / 2**20,
    }
    stats = devices[0].memory_stats() or {}
    return found | (
        {"device_memory_peak_mib": stats["peak_bytes_in_use"] / 2**20}
        if "peak_bytes_in_use" in stats
        else {}
    )
