"""Which folders of tests see a wing: its own and those of the layers above it. `make test
WING=spectra` runs these.

python tests/wings.py spectra
"""

import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WHOLE = "whole"  # documentation, notebooks, the wheel: they see all wings


def layers() -> list[list[str]]:
    """The wings from the top to the ground, siblings together: the layers of import-linter's
    contract."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "importlinter"
    ]
    (rows,) = (
        contract["layers"] for contract in settings["contracts"] if contract["type"] == "layers"
    )
    return [row.replace(" ", "").split("|") for row in rows]


def seeing(wing: str) -> list[str]:
    """The folders of tests that see a wing. Raises `ValueError` for an unknown one."""
    rows = layers()
    if not any(wing in row for row in rows):
        raise ValueError(
            f"WING={wing}: there is no such wing; known:"
            f" {', '.join(w for row in rows for w in row)}"
        )
    above = [
        row for number, row in enumerate(rows) if not any(wing in lower for lower in rows[:number])
    ]
    found = [w for row in above for w in (row if wing not in row else [wing])]
    return [f"tests/{w}" for w in (*found, WHOLE) if (ROOT / "tests" / w).is_dir()]


if __name__ == "__main__":
    try:
        print(*(seeing(sys.argv[1]) if sys.argv[1:] and sys.argv[1] else ["tests"]))
    except ValueError as error:
        sys.exit(str(error))
