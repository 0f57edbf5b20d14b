"""Do commands that are ended at random moments end in time, and does starting them again give what
an undisturbed one gives?

    python benchmarks/signals.py [--trials 12] [--command fit]

SIGINT, SIGTERM and SIGKILL in turn end a command at random moments, also while it imports. It must
end within 10 s, with its exit code and without a traceback. It is started again with --resume or
--force. What it writes in the end must be what a command that nobody disturbed writes. Ten minutes.
"""

import argparse
import collections
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import xarray

KILLS = signal.SIGINT, signal.SIGTERM, signal.SIGKILL
# Exit codes; while the interpreter itself starts the signal's own, which a shell calls by the same
# number.
ENDS = {signal.SIGINT: (130, -2), signal.SIGTERM: (143, -15), signal.SIGKILL: (-9,)}
LONGEST = 10.0  # seconds
SIMULATED = ["ensemble", "zagrodny-slifkin", "--duration", "1", "--chunk", "64"]
FITTED = ["--starts", "8"]
# Arguments, what makes a second start of it possible, and what it writes.
COMMANDS = {
    "ensemble": ([*SIMULATED, "--seeds", "8000"], "--resume", "out.zarr"),
    "reduce": ([*SIMULATED, "--seeds", "60000", "--reduce"], "--resume", "out.zarr"),
    "fit": (["fit", "vastus-lateralis-26mvc", *FITTED, "--seeds", "8"], "--force", "out"),
    "posterior": (
        [
            "posterior",
            "vastus-lateralis-26mvc",
            "--chains",
            "2",
            "--draws",
            "100",
            "--warmup",
            "50",
        ],
        "--force",
        "out",
    ),
    "cohort": (["fit", "vastus-lateralis-26mvc", "fdi-abduction-45mvc", *FITTED], "--force", "out"),
}


def begin(name: str, folder: Path) -> Any:
    """The process of a command."""
    arguments, again, out = COMMANDS[name]
    command = [sys.executable, "-m", "jaxmuscle", *arguments, again, "--out", out]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def written(name: str, folder: Path) -> dict[str, Any]:
    """What a command has written: the arrays of a store, else the texts of its folder."""
    out = folder / COMMANDS[name][2]
    if out.suffix != ".zarr":
        return {
            str(path.relative_to(out)): path.read_text()
            for path in sorted(out.rglob("*"))
            if path.suffix in (".json", ".csv") and path.name[0] != "."
        }
    store = xarray.open_zarr(out)
    assert store.attrs["complete"]
    return {name: np.asarray(values) for name, values in store.variables.items()}


def same(found: dict[str, Any], wanted: dict[str, Any]) -> bool:
    """Texts and trajectories bit by bit; moments to rounding, since chunks may be added in another
    order."""

    def alike(a: Any, b: Any) -> bool:
        return (
            np.allclose(a, b, rtol=1e-9, atol=0, equal_nan=True)
            if isinstance(b, np.ndarray)
            else a == b
        )

    return found.keys() == wanted.keys() and all(alike(found[key], wanted[key]) for key in wanted)


def killed(
    name: str, folder: Path, number: signal.Signals, moment: float
) -> tuple[int, float, str]:
    """Exit code of a command that gets a signal at a moment [s], how long it took to end [s], and
    what it said."""
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
                    print(
                        f"{name}: {number.name} after {moment:.2f} s: exit code {code} after"
                        f" {seconds:.1f} s: {said}"
                    )
            begin(name, folder).communicate()
            equal = same(written(name, folder), wanted)
        fine = fine and equal and good == trials
        print(
            f"{name} ({usual:.0f} s): {good} of {trials} ended well; exit codes {dict(codes)}; the"
            f" last end took {slowest:.1f} s; {'equal' if equal else 'NOT EQUAL'} in the end",
            flush=True,
        )
    return fine


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=12)
    parser.add_argument("--command", choices=COMMANDS)
    given = parser.parse_args()
    sys.exit(0 if signals(given.trials, given.command) else 1)
