"""How a figure moved from run to run: `python benchmarks/history.py "warm wall time"`.

Prints the figures whose names have these words, for each machine the oldest run first, each value
also over the first.
"""

import argparse
import csv
import subprocess
from collections.abc import Iterable
from datetime import date
from pathlib import Path
from typing import Any

import pandas as pd
from measure import Row

HISTORY = Path(__file__).with_name("history.csv")
COLUMNS = ("date", "commit", "machine", "load", "figure", "value", "unit")


def append(facts: dict[str, Any], rows: Iterable[Row], path: Path = HISTORY) -> None:
    """Append one line for each row of a run on the machine of `facts`."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=False,
    )  # a copy without a repository has no commit
    run = (
        date.today().isoformat(),
        described.stdout.strip(),
        f"{facts['cores']} cores of {facts['processor']}, {facts['backend']}",
        f"{max(facts['load_before'][0], facts['load_after'][0]):.1f}",
    )
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        if new:
            writer.writerow(COLUMNS)
        writer.writerows((*run, row.figure, f"{row.value:.4g}", row.unit) for row in rows)


def main() -> None:
    """Print the figures asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", help="part of the figures' names", nargs="?", default="")
    words: str = parser.parse_args().words
    table = pd.read_csv(HISTORY, keep_default_na=False)
    table = table[table["figure"].str.contains(words, regex=False)]
    if table.empty:
        parser.error(f'no figure has "{words}" in its name; without words, all are shown')
    for (figure, unit, machine), runs in table.groupby(["figure", "unit", "machine"], sort=False):
        moved = runs.assign(over_first=(runs["value"] / runs["value"].iloc[0]).round(3))
        shown = moved[["date", "commit", "load", "value", "over_first"]]
        print(f"{figure} [{unit}], {machine}", shown.to_string(index=False), "", sep="\n")


if __name__ == "__main__":
    main()
