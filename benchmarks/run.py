"""Measure speed as ratios within one run: `python benchmarks/run.py --out out/bench.json`."""

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import alternative
import fits
import history
import integration
import jax
import linear
import recordings
import scale
import usage
import waiting
from measure import DTYPES, Row, Unequal

import jaxmuscle as jm

SECTIONS: dict[str, Callable[[int], list[Row]]] = {
    "white": lambda n: integration.rows("white", n),
    "band-limited": lambda n: integration.rows("band-limited", n),
    "stock": lambda n: integration.rows("stock", n),
    "scale": scale.rows,
    "expected": linear.expected,
    "control": linear.control,
    "ensemble": usage.ensembles,
    "gradient": usage.gradients,
    "fit": lambda n: fits.fits(),
    "starts": fits.starts,
    "cohort": lambda n: fits.cohort(),
    "posterior": lambda n: fits.posterior(),
    "alternative": lambda n: alternative.rows(),
    "recordings": lambda n: recordings.rows(),
    "waiting": waiting.rows,
}


def machine() -> dict[str, Any]:
    """What the numbers depend on."""
    return {
        "cores": (
            len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        ),
        "processor": _processor(),
        "backend": jax.default_backend(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "jaxmuscle": jm.__version__,
        "dtypes": list(DTYPES),
    }


def _processor() -> str:
    facts = Path("/proc/cpuinfo")
    lines = facts.read_text().splitlines() if facts.exists() else []
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.processor(),
    )


def write(path: Path, value: Any) -> None:
    """Write JSON whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(
        "w", dir=path.parent, suffix=".json", delete=False, encoding="utf-8"
    ) as file:
        json.dump(value, file, indent=1)
    os.replace(file.name, path)


def main() -> int:
    """Run the chosen sections, print their rows, write the file. 1 if programs that must agree do
    not, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/bench.json"))
    parser.add_argument(
        "--repetitions", type=int, default=9, help="of each timed program (default 9)"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=SECTIONS,
        default=list(SECTIONS),
        metavar="SECTION",
        help=f"some of {', '.join(SECTIONS)} (default: all)",
    )
    parser.add_argument(
        "--history", action="store_true", help="append what was measured to benchmarks/history.csv"
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_compilation_cache", False)
    os.environ["JAXMUSCLE_CACHE"] = "off"  # what is measured here is compiled here
    facts, rows, unequal = machine() | {"load_before": os.getloadavg()}, [], []
    print(json.dumps(facts))
    for name in options.only:
        start = time.perf_counter()
        try:
            found = SECTIONS[name](options.repetitions)
        except Unequal as difference:
            unequal.append(str(difference))
            print(f"NOT EQUAL: {difference}")
            continue
        rows += found
        print(*found, f"({name}: {time.perf_counter() - start:.0f} s)", "", sep="\n", flush=True)
    facts["load_after"] = os.getloadavg()
    write(
        options.out, {"machine": facts, "unequal": unequal, "rows": [row.as_dict() for row in rows]}
    )
    if options.history:
        history.append(facts, rows)
    _conclude(rows, unequal, facts)
    return 1 if unequal else 0


def _conclude(rows: list[Row], unequal: list[str], facts: dict[str, Any]) -> None:
    asked = [row for row in rows if row.met is not None]
    missed = [row for row in asked if not row.met]
    print(f"load average {facts['load_before'][0]:.1f} before, {facts['load_after'][0]:.1f} after")
    print(f"{len(asked) - len(missed)} of {len(asked)} targets met")
    for row in missed:
        print(f"missed: {row}")
    for difference in unequal:
        print(f"not equal: {difference}")


if __name__ == "__main__":
    sys.exit(main())
