"""Are stores equal to one run whatever happens to those who write them?

    python benchmarks/kills.py [--trials 20] [--only workers clients runs writers]

`workers`: two workers of Dask make a store, and one of them ends by SIGKILL at a random moment.
`clients`: the process that has them make it ends by SIGKILL at a random moment, twice, and is
resumed, while they go on with what they had begun. `runs`: the same for one process that works
alone. `writers`: two processes start on one reduced store, the second a random moment later, with
the same settings, or to overwrite it with others; whoever is refused must say so. All stores must
be those of one run bit by bit. A quarter of an hour.
"""

import argparse
import contextlib
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxmuscle as jm
from jaxmuscle.commands.cluster import workers_of
from jaxmuscle.ensembles import _run

REFUSED = 3
# so a process is a fork, without a device
PRELOADED = ["diffrax", "zarr", "xarray", "jaxmuscle.ensembles._run"]
OPTIONS: dict[str, Any] = {"seeds": 4000, "duration": 1.0, "chunk": 64}


def run(store: str, reduce: bool, key: int, given: dict[str, Any]) -> None:
    """One process, which has a scheduler's workers do it if one is given; its tally is kept after
    every chunk."""
    _run.KEEP_EVERY = _run.KEEP_SHARE = 0
    scheduler = given.pop("scheduler", None)
    with client_of(scheduler) if scheduler else contextlib.nullcontext() as executor:
        try:
            made(store, reduce, key, executor=executor, **given)
        except jm.errors.StoreError as error:
            told = str(error)
            sys.exit(
                REFUSED
                if " is writing it" in told or "exists already" in told or "other settings" in told
                else told
            )


def made(store: str | Path, reduce: bool, key: int, **given: Any) -> Any:
    """The ensemble of all trials, into a store."""
    return jm.ensemble(jm.Isometric(), jax.random.key(key), store=store, reduce=reduce, **given)


def client_of(scheduler: Any) -> Any:
    """A client of Dask."""
    from distributed import Client

    return Client(scheduler, set_as_default=False)


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


def workers(
    client: Any, store: Path, reduce: bool, rng: random.Random, longest: float
) -> tuple[Any, bool]:
    """The store that two workers made of which one was killed, and whether it was on its way."""
    hit: list[float] = []

    def kill() -> None:
        pids = client.run(os.getpid)
        os.kill(rng.choice(sorted(pids.values())), signal.SIGKILL)
        hit.append(time.monotonic())

    clock = threading.Timer(rng.uniform(0, longest), kill)
    clock.start()
    made(store, reduce, 5, executor=client, **OPTIONS)
    done = time.monotonic()
    clock.join()
    client.wait_for_workers(2)
    return jm.ensembles.open_store(store), hit[0] < done


def runs(
    client: Any, store: Path, reduce: bool, rng: random.Random, longest: float
) -> tuple[Any, bool]:
    """The store of one process that was killed twice, and whether it was on its way; with a client
    the process has the client's workers make it."""
    given = {"resume": True}
    if client is not None:
        given["scheduler"] = client.scheduler.address
    early = [killed(begun(store, reduce, **given), rng, longest) for _ in range(2)]
    ended([begun(store, reduce, **given)])
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


def equal(found: Any, one: Any, reduce: bool) -> bool:
    """Whether a store is one run, bit by bit."""
    if not reduce:
        return np.array_equal(found["F_ext"], one.output)
    pairs = (
        (found["mean"], one.mean),
        (found["variance"], one.variance),
        (found["quantiles"], one.quantile),
    )
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def killing(name: str, trial: Callable, trials: int, client: Any) -> bool:
    """Trials of both kinds of stores; whether all were equal."""
    good = 0
    for reduce in (False, True):
        one, rng = whole(reduce), random.Random(int(reduce))
        same, early, longest = [], 0, 0.0
        with tempfile.TemporaryDirectory() as folder:
            for turn in range(2):  # the second time it is compiled
                start = time.monotonic()
                if trial is workers:
                    made(Path(folder) / f"first-{turn}.zarr", reduce, 5, executor=client, **OPTIONS)
                else:
                    trial(client, Path(folder) / f"first-{turn}.zarr", reduce, rng, 0.0)
                longest = time.monotonic() - start
            for number in range(trials):
                store = Path(folder) / f"{number}.zarr"
                found, was_killed = trial(client, store, reduce, rng, longest)
                early += was_killed
                same.append(equal(found, one, reduce))
        good += sum(same)
        kind = "reduced" if reduce else "trajectories"
        print(
            f"{name}, {kind}: {sum(same)} of {trials} equal one run; {early} killed on their way",
            flush=True,
        )
    return good == 2 * trials


def writing(trials: int) -> bool:
    """Trials of two writers; whether none had wrong numbers."""
    ones, rng = {key: whole(True, key) for key in (5, 6)}, random.Random(2)
    same, refused, longest = [], 0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(2):
            start = time.monotonic()
            ended([begun(Path(folder) / f"first-{turn}.zarr", True)])
            longest = time.monotonic() - start
        for number in range(trials):
            found, key, was_refused = writers(Path(folder) / f"{number}.zarr", rng, longest)
            refused += was_refused
            same.append(equal(found, ones[key], True))
    print(
        f"writers: {sum(same)} of {trials} equal one run; one of the two was refused in {refused}",
        flush=True,
    )
    return all(same)


def main(trials: int, only: list[str]) -> bool:
    """All sections that are asked for; whether all were equal."""
    found = []
    if {"workers", "clients"} & set(only):
        with workers_of(2, None) as client:
            if "workers" in only:
                found.append(killing("workers", workers, trials, client))
            if "clients" in only:
                found.append(killing("clients", runs, trials, client))
    if "runs" in only:
        found.append(killing("runs", runs, trials, None))
    if "writers" in only:
        found.append(writing(trials))
    return all(found)


if __name__ == "__main__":
    sections = ["workers", "clients", "runs", "writers"]
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--only", nargs="+", choices=sections, default=sections)
    given = parser.parse_args()
    sys.exit(0 if main(given.trials, given.only) else 1)
