"""The Python blocks of a page, run as its reader would run them."""

import importlib.util
import re
import sys
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path) -> list[str]:
    """Its Python blocks in order, also those inside a list."""
    found = re.findall(r"^( *)```python\n(.*?)^\1```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [textwrap.dedent(code) for _, code in found]


def run(name: str, names: Mapping[str, Any] | None = None, smaller: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Runs the blocks of a page in order in one namespace, in which `names` are there before, and returns that.

    `smaller` replaces texts, numbers that only make a block slow, each of which must be there.
    """
    namespace, page = dict(names or {}), ROOT / name
    whole = blocks(page)
    for old, new in (smaller or {}).items():
        assert any(old in code for code in whole), f"{name} says no longer {old}"
        whole = [code.replace(old, new) for code in whole]
    for number, code in enumerate(whole, 1):
        exec(compile(code, f"{name}, block {number}", "exec"), namespace)
    return namespace


def module(path: Path) -> Any:
    """A program of the documentation, as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = made
    spec.loader.exec_module(made)
    return made
