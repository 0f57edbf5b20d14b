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
FIT = (
    "import jaxmuscle as jm; t = jm.load_target('vastus-lateralis-26mvc');"
    " jm.fit(jm.task_for(t), t)"
)
TARGET = "vastus-lateralis-26mvc"
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
