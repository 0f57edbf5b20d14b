"""One hour of force at 2 kHz: processor time and memory from the text to the target."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from measure import Row

HOUR, RATE = 3600, 2000
STEPS = ("load", "steady", "spectrum", "target", "summary")
# Each step in turn in one fresh process; the peak of its memory is that above what the imports
# need.
PROGRAM = """
import json, resource, sys, time
import pandas, scipy.ndimage, scipy.signal
import jaxmuscle as jm
def peak():
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
jm.Recording(__import__("numpy").arange(9999) % 7, 100).summary()
before, taken, start = peak(), {}, time.process_time()
def step(name, result):
    global start
    taken[name], start = time.process_time() - start, time.process_time()
    return result
recording = step("load", jm.load_recording(sys.argv[1]))
taken["bytes"] = (peak() - before) / recording.whole.size
window = None if sys.argv[2] == "found" else (0.0, recording.stop)
recording = step("steady", recording.steady(window))
for name in ("spectrum", "target", "summary"):
    step(name, getattr(recording, name)())
print(json.dumps(taken))
"""


def rows() -> list[Row]:
    """Load, window, spectrum, target, summary; the window is given, and once found."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hour.csv"
        _write(path)
        given, found = (_taken(path, window) for window in ("given", "found"))
    name = "one hour at 2 kHz, text"
    return [
        Row(
            f"{name}: all steps, processor time",
            sum(given[step] for step in STEPS),
            "s",
            target=20,
            at_most=True,
        ),
        *(Row(f"{name}: {step}", given[step], "s") for step in STEPS),
        Row(f"{name}: steady, window found", found["steady"], "s"),
        Row(f"{name}: memory to load it", given["bytes"], "bytes a row", target=120, at_most=True),
    ]


def _write(path: Path) -> None:
    """Correlated force about 50 N; times with four decimals."""
    rng, previous = np.random.default_rng(0), 0.0
    with path.open("w", encoding="utf-8") as file:
        file.write("time,force_N\n")
        for begin in range(0, HOUR * RATE, 100 * RATE):
            noise = rng.standard_normal(100 * RATE)
            force = np.empty_like(noise)
            for i, z in enumerate(noise):  # a time constant of 50 ms
                previous = force[i] = 0.99 * previous + z
            time = (begin + np.arange(noise.size)) / RATE
            file.writelines(f"{t:.4f},{50 + x / 7:.5f}\n" for t, x in zip(time, force, strict=True))


def _taken(path: Path, window: str) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, path, window], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)
