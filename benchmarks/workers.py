"""One study in one process and on two workers: equal to the last bit? At what cost?

    python benchmarks/workers.py [--workers 2] [--people 4] [--trials 3] [--starts 32]

Two groups of simulated people (`study.py`), in files. The study is read, fitted and written three
times: by this process, which has made or loaded all programs before, by workers that begin, and by
the same workers once they have loaded all programs, too. The outcome stands in docs/study.md.
"""

import argparse
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from study import RATE, centre, person, recorded

import jaxmuscle as jm
from jaxmuscle.commands.cluster import workers_of


def written(table: Path, starts: int, client: Any, folder: Path) -> dict[str, bytes]:
    """What a study writes, but for its figures; says what it took."""
    begun, here = time.perf_counter(), time.process_time()
    there = 0.0 if client is None else sum(client.run(time.process_time).values())
    found = jm.run_study(table, rung=2, rate=RATE, units="N", starts=starts, executor=client)
    here, passed = time.process_time() - here, time.perf_counter() - begun
    if client is not None:
        there = sum(client.run(time.process_time).values()) - there
    print(f"{folder.name}: {passed:.0f} s; processor time {here:.1f} s here, {there:.1f} s there")
    found.save(folder)
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix != ".png"}


def main() -> None:
    parser = argparse.ArgumentParser()
    for name, number in (("workers", 2), ("people", 4), ("trials", 3), ("starts", 32)):
        parser.add_argument(f"--{name}", type=int, default=number)
    asked = parser.parse_args()
    task, rng = centre(), np.random.default_rng(0)
    tasks = {
        f"{g}-{i}": person(task, {}, rng) for g in ("young", "old") for i in range(asked.people)
    }
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table = recorded(tasks, asked.trials, 0, folder)
        written(table, 1, None, folder / "programs")
        alone = written(table, asked.starts, None, folder / "one process")
        with workers_of(asked.workers, None) as client:
            for which in ("workers", "the same workers"):
                found = written(table, asked.starts, client, folder / which)
                print({file: found[file] == alone[file] for file in sorted(alone)}, flush=True)


if __name__ == "__main__":
    main()
