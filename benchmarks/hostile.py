"""What becomes of damaged recordings: mutants of small good files in every format, each read as
`load_recording` reads it.

    python benchmarks/hostile.py [--count 5000] [--only mat npz ...]

Each mutant is to be read, or refused in one sentence that names it. For each format: how many were
read, refused by the library, refused because they ended the process that reads (a crash), because
they held too much, because they took too long; and how many did anything else, which makes the exit
code 1. About ten minutes.
"""

import argparse
import collections
import random
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from hostile_files import TEXTS, WRITERS, answers, mutant, outcome, text_outcome

MOST = 64 << 20  # bytes that a file may hold
BATCH = 250
KINDS = (
    ("crashed", "its reader crashed"),
    ("too large", "it holds more than"),
    ("too long", "did not come to an end"),
    ("no answer", "ended without an answer"),
)


def fate(path: Path, said: str) -> str:
    """In one word, what the sentence of an error says; empty if the file was read."""
    if not said:
        return "read"
    if "\n" in said or not said.startswith(str(path.parent)):
        raise ValueError(f"not one sentence that names the file: {said!r}")
    return next((word for word, part in KINDS if part in said), "refused")


def binary(name: str, count: int, folder: Path) -> collections.Counter:
    good, kind = folder / f"good.{name}", "." + name.rpartition(".")[2]
    WRITERS[name](good)
    data, rng, fates = good.read_bytes(), random.Random(7), collections.Counter()
    for start in range(0, count, BATCH):
        files = [folder / f"{number}{kind}" for number in range(start, min(start + BATCH, count))]
        for path in files:
            path.write_bytes(mutant(data, rng))
        for path, code, said in answers(kind, good, files, MOST):
            try:
                fates[fate(path, outcome(path, kind, code, said))] += 1
            except Exception as error:  # what is looked for
                print(f"{name}: {type(error).__name__}: {error}", flush=True)
                fates["something else"] += 1
            path.unlink()
    return fates


def textual(name: str, count: int, folder: Path) -> collections.Counter:
    data, rng, fates = TEXTS[name], random.Random(7), collections.Counter()
    path = folder / (name.replace(" ", "-") + ".txt")
    for _ in range(count):
        try:
            fates[fate(path, text_outcome(path, mutant(data, rng)))] += 1
        except Exception as error:  # what is looked for
            print(f"{name}: {type(error).__name__}: {error}", flush=True)
            fates["something else"] += 1
    return fates


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=5000, help="mutants of every format")
    parser.add_argument("--only", nargs="*", default=[*WRITERS, *TEXTS], help="formats")
    given = parser.parse_args()
    wrong = 0
    words = ["read", "refused", *(word for word, _ in KINDS), "something else"]
    print(f"{'':14}" + "".join(f"{word:>15}" for word in words) + f"{'seconds':>10}")
    for name in given.only:
        begun = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            fates = (binary if name in WRITERS else textual)(name, given.count, Path(folder))
        counts = "".join(f"{fates[word]:15}" for word in words)
        print(f"{name:14}{counts}{time.monotonic() - begun:10.0f}", flush=True)
        wrong += fates["something else"]
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
