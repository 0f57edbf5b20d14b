"""Are the parts of a job array that are killed at random moments and started again equal to one run?

    python benchmarks/kills.py [--trials 20]

For each kind of store: four parts start at once, one of them ends by SIGKILL at a random moment (also while it starts) and
is run again, all are merged. Paths must be those of one run bit by bit, moments to 1e-6 of the largest value. Ten minutes.
"""

import argparse
import multiprocessing
import random
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxmuscle as jm
from jaxmuscle.ensembles import _run

PARTS = 4
OPTIONS: dict[str, Any] = {"seeds": 4000, "duration": 1.0, "chunk": 64}


def part(number: int, store: str, reduce: bool) -> None:
    """One part, in a process of its own; its tally is kept after every chunk."""
    _run.KEEP_EVERY = _run.KEEP_SHARE = 0
    jm.ensemble(jm.Isometric(), jax.random.key(5), part=(number, PARTS), store=store, reduce=reduce, **OPTIONS)


def whole(reduce: bool) -> Any:
    """One run of all."""
    return jm.ensemble(jm.Isometric(), jax.random.key(5), reduce=reduce, **OPTIONS, **({} if reduce else {"control": False}))


def begun(number: int, store: Path, reduce: bool) -> Any:
    """The process of a part."""
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["diffrax", "jaxmuscle.ensembles._ensemble"])  # so a process is a fork, without a device
    process = context.Process(target=part, args=(number, str(store), reduce))
    process.start()
    return process


def undisturbed(store: Path, reduce: bool) -> float:
    """How long all parts at once take [s]."""
    start = time.monotonic()
    ended([begun(number, store, reduce) for number in range(1, PARTS + 1)])
    return time.monotonic() - start


def ended(processes: list[Any]) -> None:
    """Wait for parts that must not fail."""
    for process in processes:
        process.join()
        if process.exitcode:
            raise RuntimeError(f"a part ended with exit code {process.exitcode}")


def trial(store: Path, reduce: bool, rng: random.Random, longest: float) -> tuple[Any, bool]:
    """The merged store, and whether one part was killed before it had ended: at a moment before `longest` [s]."""
    numbers = rng.sample(range(1, PARTS + 1), PARTS)
    victim, *others = [begun(number, store, reduce) for number in numbers]
    victim.join(rng.uniform(0, longest))
    victim.kill()
    victim.join()
    ended(others)
    ended([begun(number, store, reduce) for number in numbers[:2]])  # the second had ended: it only looks
    return jm.ensembles.merge(store), victim.exitcode != 0


def equal(found: Any, one: Any, reduce: bool) -> bool:
    """Whether a merged store is one run."""
    if not reduce:
        return np.array_equal(found["F_ext"], one.output)
    pairs = (found["mean"], one.mean), (found["variance"], one.variance), (found["quantiles"], one.quantile)
    return all(np.abs(np.asarray(a) - b).max() <= 1e-6 * np.abs(b).max() for a, b in pairs)


def main(trials: int) -> bool:
    """All trials; whether all were equal."""
    good = 0
    for reduce in (False, True):
        one, rng = whole(reduce), random.Random(int(reduce))
        same, killed = [], 0
        with tempfile.TemporaryDirectory() as folder:
            longest = [undisturbed(Path(folder) / f"first-{turn}.zarr", reduce) for turn in range(2)][-1]  # once compiled
            for number in range(trials):
                found, early = trial(Path(folder) / f"{number}.zarr", reduce, rng, longest)
                killed += early
                same.append(equal(found, one, reduce))
        good += sum(same)
        kind = "reduced" if reduce else "trajectories"
        print(f"{kind}: {sum(same)} of {trials} equal one run; {killed} killed on their way", flush=True)
    return good == 2 * trials


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=20)
    sys.exit(0 if main(parser.parse_args().trials) else 1)
