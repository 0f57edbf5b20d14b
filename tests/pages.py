"""The Python blocks of a page, run as its reader would run them."""

import functools
import importlib.util
import re
import sys
import textwrap
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import nbformat
import numpy as np
from compiled import PAGE, kept_jit

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# the one with sliders, which test_notebooks.py runs as Jupyter does, too
IN_A_KERNEL = "03-three-tasks"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, language: str = "python") -> list[str]:
    """Its Python blocks in order, also those inside a list; those of the language `py` need what
    the tests do not install."""
    found = re.findall(
        rf"^( *)```{language}\n(.*?)^\1```",
        page.read_text(encoding="utf-8"),
        re.MULTILINE | re.DOTALL,
    )
    return [textwrap.dedent(code) for _, code in found]


def run(
    name: str, names: Mapping[str, Any] | None = None, smaller: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """Runs the blocks of a page in order in one namespace, in which `names` are there before, and
    returns that.

    `smaller` replaces texts, numbers that only make a block slow, each of which must be there.
    """
    return _executed(name, blocks(ROOT / name), dict(names or {}), smaller or {})


def run_cells(path: Path, smaller: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Runs the code cells of a notebook as `run` does the blocks of a page."""
    cells = [
        cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"
    ]
    return _executed(path.name, cells, {}, smaller or {})


def _executed(
    name: str, blocks: list[str], namespace: dict[str, Any], smaller: Mapping[str, str]
) -> dict[str, Any]:
    for old, new in smaller.items():
        assert any(old in code for code in blocks), f"{name} says no longer {old}"
        blocks = [code.replace(old, new) for code in blocks]
    namespace |= {"__name__": f"{PAGE}{name}", "kept_jit": kept_jit}
    for number, code in enumerate(blocks, 1):
        # What a page compiles itself is kept for the next run of the tests.
        code = re.sub(r"\bjax\.jit\b", "kept_jit", code)
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


def _is_key(x: Any) -> bool:
    return isinstance(x, jax.Array) and jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)


def _content(value: Any) -> Any:
    """What a value holds, so that equal ones are equal and can be looked up."""
    leaves, structure = jax.tree.flatten(value)
    arrays = [jax.random.key_data(x) if _is_key(x) else x for x in leaves]
    numbers = [
        (str(x.dtype), x.shape, np.asarray(x).tobytes()) if hasattr(x, "dtype") else repr(x)
        for x in arrays
    ]
    return str(structure), tuple(numbers)


class Once:
    """Public functions that pages call with the same arguments again and again, run once each;
    `last` result by name."""

    def __init__(self) -> None:
        self.last: dict[str, Any] = {}
        self.found: dict[Any, Any] = {}

    def of(self, name: str, function: Callable[..., Any], **fewer: Any) -> Callable[..., Any]:
        """`function` with `fewer` options where a page does not name them; what is written to disk
        is always run."""

        @functools.wraps(function)
        def inside(*given: Any, **options: Any) -> Any:
            options = fewer | options
            asked = (name, jax.config.jax_enable_x64, _content((given, options)))
            if asked not in self.found or "store" in options:
                self.found[asked] = function(*given, **options)
            self.last[name] = self.found[asked]
            return self.last[name]

        return inside
