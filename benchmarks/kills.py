"""Is what was killed at random moments and started again equal to what ran in one go?

    python benchmarks/kills.py [parts] [--trials 20]
    python benchmarks/kills.py signals [--trials 12] [--command fit]

parts: four parts of a job array start at once, one of them ends by SIGKILL at a random moment (also while it starts) and is
run again, all are merged. Paths must be those of one run bit by bit, moments to 1e-6 of the largest value. Ten minutes.

signals: SIGINT, SIGTERM and SIGKILL in turn end a command at random moments, also while it imports. It must end within 10 s,
with its exit code and without a traceback. It is started again with --resume or --force. What it writes in the end must be
what a command that nobody disturbed writes. Ten minutes.
"""

import argparse
import collections
import multiprocessing
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import xarray

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


KILLS = signal.SIGINT, signal.SIGTERM, signal.SIGKILL
# Exit codes; while the interpreter itself starts the signal's own, which a shell calls by the same number.
ENDS = {signal.SIGINT: (130, -2), signal.SIGTERM: (143, -15), signal.SIGKILL: (-9,)}
LONGEST = 10.0  # seconds
SIMULATED = ["ensemble", "zagrodny-slifkin", "--duration", "1", "--chunk", "64"]
FITTED = ["--starts", "8"]
# Arguments, what makes a second start of it possible, and what it writes.
COMMANDS = {
    "ensemble": ([*SIMULATED, "--seeds", "8000"], "--resume", "out.zarr"),
    "reduce": ([*SIMULATED, "--seeds", "60000", "--reduce"], "--resume", "out.zarr"),
    "fit": (["fit", "vastus-lateralis-26mvc", *FITTED, "--seeds", "8"], "--force", "out"),
    "posterior": (["posterior", "vastus-lateralis-26mvc", "--chains", "2", "--draws", "100", "--warmup", "50"], "--force",
                  "out"),
    "cohort": (["fit", "vastus-lateralis-26mvc", "fdi-abduction-45mvc", *FITTED], "--force", "out"),
}  # fmt: skip


def begin(name: str, folder: Path) -> Any:
    """The process of a command."""
    arguments, again, out = COMMANDS[name]
    command = [sys.executable, "-m", "jaxmuscle", *arguments, again, "--out", out]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def written(name: str, folder: Path) -> dict[str, Any]:
    """What a command has written: the arrays of a store, else the texts of its folder."""
    out = folder / COMMANDS[name][2]
    if out.suffix != ".zarr":
        return {str(path.relative_to(out)): path.read_text() for path in sorted(out.rglob("*"))
                if path.suffix in (".json", ".csv") and path.name[0] != "."}  # fmt: skip
    store = xarray.open_zarr(out)
    assert store.attrs["complete"]
    return {name: np.asarray(values) for name, values in store.variables.items()}


def same(found: dict[str, Any], wanted: dict[str, Any]) -> bool:
    """Texts and trajectories bit by bit; moments to rounding, since chunks may be added in another order."""

    def alike(a: Any, b: Any) -> bool:
        return np.allclose(a, b, rtol=1e-9, atol=0, equal_nan=True) if isinstance(b, np.ndarray) else a == b

    return found.keys() == wanted.keys() and all(alike(found[key], wanted[key]) for key in wanted)


def killed(name: str, folder: Path, number: signal.Signals, moment: float) -> tuple[int, float, str]:
    """Exit code of a command that gets a signal at a moment [s], how long it took to end [s], and what it said."""
    process = begin(name, folder)
    time.sleep(moment)
    process.send_signal(number)
    sent = time.monotonic()
    said = process.communicate()[1]
    return process.returncode, time.monotonic() - sent, said


def signals(trials: int, chosen: str | None) -> bool:
    """All trials of all commands, or of one; whether all were good."""
    fine = True
    for name in COMMANDS if chosen is None else [chosen]:
        rng, codes, slowest, good = random.Random(name), collections.Counter(), 0.0, 0
        with tempfile.TemporaryDirectory() as parent:
            whole, folder = Path(parent) / "whole", Path(parent) / "killed"
            for place in (whole, folder):
                place.mkdir()
            begin(name, whole).communicate()  # compiles
            shutil.rmtree(whole / COMMANDS[name][2])
            start, process = time.monotonic(), begin(name, whole)
            process.communicate()
            usual, own, wanted = time.monotonic() - start, process.returncode, written(name, whole)
            for trial in range(trials):
                number = KILLS[trial % len(KILLS)]
                code, seconds, said = killed(name, folder, number, moment := rng.uniform(0, usual))
                ok = code in (*ENDS[number], own) and seconds < LONGEST and "Traceback" not in said
                if code == own:  # it was faster
                    ok = ok and same(written(name, folder), wanted)
                    shutil.rmtree(folder / COMMANDS[name][2])
                good, slowest = good + ok, max(slowest, seconds)
                codes[code] += 1
                if not ok:
                    print(f"{name}: {number.name} after {moment:.2f} s: exit code {code} after {seconds:.1f} s: {said}")
            begin(name, folder).communicate()
            equal = same(written(name, folder), wanted)
        fine = fine and equal and good == trials
        print(f"{name} ({usual:.0f} s): {good} of {trials} ended well; exit codes {dict(codes)}; the last end took "
              f"{slowest:.1f} s; {'equal' if equal else 'NOT EQUAL'} in the end", flush=True)  # fmt: skip
    return fine


def parts(trials: int) -> bool:
    """All trials; whether all were equal."""
    good = 0
    for reduce in (False, True):
        one, rng = whole(reduce), random.Random(int(reduce))
        alike, early_ends = [], 0
        with tempfile.TemporaryDirectory() as folder:
            longest = [undisturbed(Path(folder) / f"first-{turn}.zarr", reduce) for turn in range(2)][-1]  # once compiled
            for number in range(trials):
                found, early = trial(Path(folder) / f"{number}.zarr", reduce, rng, longest)
                early_ends += early
                alike.append(equal(found, one, reduce))
        good += sum(alike)
        kind = "reduced" if reduce else "trajectories"
        print(f"{kind}: {sum(alike)} of {trials} equal one run; {early_ends} killed on their way", flush=True)
    return good == 2 * trials


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("section", choices=["parts", "signals"], nargs="?", default="parts")
    parser.add_argument("--trials", type=int)
    parser.add_argument("--command", choices=COMMANDS)
    given = parser.parse_args()
    done = parts(given.trials or 20) if given.section == "parts" else signals(given.trials or 12, given.command)
    sys.exit(0 if done else 1)
