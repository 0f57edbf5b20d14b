"""Are stores equal to one run whatever happens to those who write them?

    python benchmarks/kills.py [--trials 20] [--only parts runs writers]

`parts`: four parts start at once, one of them ends by SIGKILL at a random moment (also while it
starts) and is run again, all are merged. `runs`: one process ends by SIGKILL at a random moment,
twice, and is resumed. `writers`: two processes start on one reduced store, the second a random
moment later, with the same settings, or to overwrite it with others; whoever is refused must say
so. Paths must be those of one run bit by bit, moments of parts to 1e-6 of the largest value, all
others bit by bit. A quarter of an hour.
"""

import argparse
import multiprocessing
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxmuscle as jm
from jaxmuscle.ensembles import _run

PARTS, REFUSED = 4, 3
# so a process is a fork, without a device
PRELOADED = ["diffrax", "zarr", "xarray", "jaxmuscle.ensembles._run"]
OPTIONS: dict[str, Any] = {"seeds": 4000, "duration": 1.0, "chunk": 64}
ROUNDING = 1e-6  # of the largest value: tallies of parts are added in another order


def run(store: str, reduce: bool, key: int, given: dict[str, Any]) -> None:
    """One process; its tally is kept after every chunk."""
    _run.KEEP_EVERY = _run.KEEP_SHARE = 0
    try:
        jm.ensemble(jm.Isometric(), jax.random.key(key), store=store, reduce=reduce, **given)
    except jm.errors.StoreError as error:
        told = str(error)
        sys.exit(
            REFUSED
            if " is writing it" in told or "exists already" in told or "other settings" in told
            else told
        )


def whole(reduce: bool, key: int = 5) -> Any:
    """One run of all, in memory."""
    return jm.ensemble(
        jm.Isometric(),
        jax.random.key(key),
        reduce=reduce,
        **OPTIONS,
        **({} if reduce else {"control": False}),
    )


def begun(store: Path, reduce: bool, key: int = 5, **given: Any) -> Any:
    """The process that makes a store, or adds to it."""
    context: Any = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    process = context.Process(target=run, args=(str(store), reduce, key, OPTIONS | given))
    process.start()
    return process


def undisturbed(store: Path, reduce: bool) -> float:
    """How long all parts at once take [s]."""
    start = time.monotonic()
    ended([begun(store, reduce, part=(number, PARTS)) for number in range(1, PARTS + 1)])
    return time.monotonic() - start


def ended(processes: list[Any]) -> None:
    """Wait for processes that must not fail."""
    for process in processes:
        process.join()
        if process.exitcode:
            raise RuntimeError(f"a process ended with exit code {process.exitcode}")


def killed(process: Any, rng: random.Random, longest: float) -> bool:
    """Whether a process was killed before it had ended, at a moment before `longest` [s]."""
    process.join(rng.uniform(0, longest))
    process.kill()
    process.join()
    return process.exitcode != 0


def parts(store: Path, reduce: bool, rng: random.Random, longest: float) -> tuple[Any, bool]:
    """The merged store, and whether one part was killed."""
    numbers = rng.sample(range(1, PARTS + 1), PARTS)
    victim, *others = [begun(store, reduce, part=(number, PARTS)) for number in numbers]
    early = killed(victim, rng, longest)
    ended(others)
    # the second had ended: it only looks
    ended([begun(store, reduce, part=(number, PARTS)) for number in numbers[:2]])
    return jm.ensembles.merge(store), early


def runs(store: Path, reduce: bool, rng: random.Random, longest: float) -> tuple[Any, bool]:
    """The store of one process that was killed twice, and whether it was on its way."""
    early = [killed(begun(store, reduce, resume=True), rng, longest) for _ in range(2)]
    ended([begun(store, reduce, resume=True)])
    return jm.ensembles.open_store(store), any(early)


def writers(store: Path, rng: random.Random, longest: float) -> tuple[Any, int, bool]:
    """The store of two processes, the key of its noise, and whether one of them was refused."""
    other = rng.random() < 0.5
    first = begun(store, True, resume=True)
    first.join(rng.choice([0.0, rng.uniform(0, longest)]))
    second = begun(store, True, 6, overwrite=True) if other else begun(store, True, resume=True)
    for process in (first, second):
        process.join()
        if process.exitcode not in (0, REFUSED):
            raise RuntimeError(f"a writer ended with exit code {process.exitcode}")
    if first.exitcode == second.exitcode == REFUSED:
        raise RuntimeError("both writers were refused")
    key = 6 if other and second.exitcode == 0 else 5
    return jm.ensembles.open_store(store), key, REFUSED in (first.exitcode, second.exitcode)


def equal(found: Any, one: Any, reduce: bool, tolerance: float = ROUNDING) -> bool:
    """Whether a store is one run."""
    if not reduce:
        return np.array_equal(found["F_ext"], one.output)
    pairs = (
        (found["mean"], one.mean),
        (found["variance"], one.variance),
        (found["quantiles"], one.quantile),
    )
    return all(np.abs(np.asarray(a) - b).max() <= tolerance * np.abs(b).max() for a, b in pairs)


def killing(name: str, trial: Callable, trials: int, tolerance: float) -> bool:
    """Trials of both kinds of stores; whether all were equal."""
    good = 0
    for reduce in (False, True):
        one, rng = whole(reduce), random.Random(int(reduce))
        same, early = [], 0
        with tempfile.TemporaryDirectory() as folder:
            # once compiled
            longest = [
                undisturbed(Path(folder) / f"first-{turn}.zarr", reduce) for turn in range(2)
            ][-1]
            for number in range(trials):
                found, was_killed = trial(Path(folder) / f"{number}.zarr", reduce, rng, longest)
                early += was_killed
                same.append(equal(found, one, reduce, tolerance))
        good += sum(same)
        kind = "reduced" if reduce else "trajectories"
        print(
            f"{name}, {kind}: {sum(same)} of {trials} equal one run; {early} killed on their way",
            flush=True,
        )
    return good == 2 * trials


def writing(trials: int) -> bool:
    """Trials of two writers; whether none had wrong numbers."""
    ones, rng, same, refused = {key: whole(True, key) for key in (5, 6)}, random.Random(2), [], 0
    with tempfile.TemporaryDirectory() as folder:
        longest = [undisturbed(Path(folder) / f"first-{turn}.zarr", True) for turn in range(2)][-1]
        for number in range(trials):
            found, key, was_refused = writers(Path(folder) / f"{number}.zarr", rng, longest)
            refused += was_refused
            same.append(equal(found, ones[key], True, 0.0))
    print(
        f"writers: {sum(same)} of {trials} equal one run; one of the two was refused in {refused}",
        flush=True,
    )
    return all(same)


def main(trials: int, only: list[str]) -> bool:
    """All sections that are asked for; whether all were equal."""
    found = []
    if "parts" in only:
        found.append(killing("parts", parts, trials, ROUNDING))
    if "runs" in only:
        found.append(killing("runs", runs, trials, 0.0))
    if "writers" in only:
        found.append(writing(trials))
    return all(found)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument(
        "--only",
        nargs="+",
        choices=["parts", "runs", "writers"],
        default=["parts", "runs", "writers"],
    )
    given = parser.parse_args()
    sys.exit(0 if main(given.trials, given.only) else 1)
