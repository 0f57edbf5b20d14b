"""What a user waits for: processor time of whole processes, as a ratio to that of importing the
libraries."""

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from measure import Row

IMPORTS = "import jax, diffrax, optimistix, matplotlib.pyplot, scipy.signal"
FIT = "import jaxmuscle as jm; t = jm.load_target('vastus-lateralis-26mvc'); jm.fit(t.task(), t)"
TARGET = "vastus-lateralis-26mvc"
# The first fit of one's own data, with an empty cache: file, options, most times the imports. Data
# from outside the model: filtered noise, and a spring, a damper and a mass that a motor moves.
FIRST: dict[str, tuple[str, list[str], float]] = {
    "own spectrum, richer models": ("hilly.csv", [], 14.5),
    "own spectrum, base model": ("slow.csv", ["--noise", "ornstein-uhlenbeck"], 7.0),
    "moved record": ("moved.csv", ["--task", "prescribed-length"], 20.0),
}
RATE, COUNT = 100.0, 6000
# Name: command (its answer: the text of its output that ends the wait), most times the imports.
COMMANDS: dict[str, tuple[list[str], float]] = {
    "import jaxmuscle": (["-c", "import jaxmuscle"], 0.05),
    "jm.fit in a fresh process": (["-c", FIT], 2.5),
    "jaxmuscle fit, whole": (["-m", "jaxmuscle", "fit", TARGET, "--force"], 2.5),
    "jaxmuscle fit --quick (to the printed table)": (
        ["-m", "jaxmuscle", "fit", TARGET, "--quick", "--force"],
        1.7,
    ),
    "jaxmuscle posterior": (["-m", "jaxmuscle", "posterior", TARGET, "--force"], 10.0),
    "jaxmuscle compare": (["-m", "jaxmuscle", "compare", TARGET, "--force"], 10.0),
}


def rows(repetitions: int) -> list[Row]:
    """Medians of at most five runs, each after one that fills the cache of compiled programs.

    `import jaxmuscle` counts without Python's own start. A process of the quick fit ends soon after
    its table.
    """
    count = min(repetitions, 5)
    with tempfile.TemporaryDirectory() as folder:
        cache = {**os.environ, "XDG_CACHE_HOME": folder}
        cache.pop("JAX_COMPILATION_CACHE_DIR", None)
        cache.pop("JAXMUSCLE_CACHE", None)
        python = float(np.median([spent(["-c", "pass"], cache, folder) for _ in range(5)]))
        reference = float(np.median([spent(["-c", IMPORTS], cache, folder) for _ in range(count)]))
        found = [Row("imports of the libraries", reference, "s processor time")]
        write_records(Path(folder))
        for name, (file, options, most) in FIRST.items():
            with tempfile.TemporaryDirectory() as empty:
                command = ["-m", "jaxmuscle", "fit", file, *options, "--force"]
                time_first = spent(command, {**cache, "XDG_CACHE_HOME": empty}, folder)
            found.append(
                Row(
                    f"first fit: {name}", time_first / reference, "times", "the imports", most, True
                )
            )
        for name, (command, most) in COMMANDS.items():
            start = time.perf_counter()
            first = spent(command, cache, folder)
            wall = time.perf_counter() - start
            times = [spent(command, cache, folder) for _ in range(count)]
            base = python if name.startswith("import") else 0.0
            found += [
                Row(f"{name}: empty cache", first, f"s processor time ({wall:.0f} s)"),
                Row(
                    f"{name}: warm",
                    (float(np.median(times)) - base) / reference,
                    "times",
                    "the imports",
                    most,
                    True,
                ),
            ]
        return found


def write_records(folder: Path) -> None:
    """The files of `FIRST`: a force with hills in its spectrum, one with none, a moved record."""
    rng, time_s = np.random.default_rng(5), np.arange(COUNT) / RATE
    f = np.fft.rfftfreq(COUNT, 1 / RATE)

    def noise(power: np.ndarray) -> np.ndarray:
        drawn = rng.normal(size=f.size) + 1j * rng.normal(size=f.size)
        signal = np.fft.irfft(np.sqrt(power) * drawn, COUNT)
        return signal / signal.std()

    hills = ((0.25, 9.0, 0.8), (0.5, 3.2, 0.3), (0.15, 6.0, 0.4))
    power = 1 / (0.3 + f**1.6) + sum(a * np.exp(-0.5 * ((f - c) / w) ** 2) for a, c, w in hills)
    slow = noise(1 / (1 + (f / 0.7) ** 2))
    x = 0.002 * noise((f > 0.3) & (f < 12.0))
    v = np.gradient(x, 1 / RATE)
    force = 20.0 + 900.0 * x + 12.0 * v + 0.4 * np.gradient(v, 1 / RATE) + 0.15 * slow
    records = {
        "hilly.csv": {"force (N)": 5 * (1 + 0.02 * noise(power))},
        "slow.csv": {"force (N)": 5 * (1 + 0.02 * slow)},
        "moved.csv": {"force (N)": force, "displacement (mm)": 1e3 * x},
    }
    for name, columns in records.items():
        header = ",".join(["time (s)", *columns])
        rows = np.column_stack([time_s, *columns.values()])
        np.savetxt(folder / name, rows, delimiter=",", header=header, comments="", fmt="%.7f")


def spent(command: list[str], environment: dict[str, str], folder: str) -> float:
    """Processor time [s] of a Python process with that command line."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(
        [sys.executable, *command],
        env=environment,
        cwd=Path(folder),
        check=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
