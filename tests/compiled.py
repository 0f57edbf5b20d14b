"""Programs that a test compiles itself: made as the package's own, where they draw; kept for the
next run."""

import functools
import hashlib
import os
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

OPTIMISATION = "xla_backend_optimization_level"
ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("src", "tests", "docs", "notebooks", "benchmarks", "fitting")
PAGE = "page "  # begins the name of the module that a page's blocks are
ARRAYS = (jax.Array, np.ndarray, np.generic)
UNREAD = {".pyc", ".png"}  # no test computes from such a file
_calls: Counter[tuple[str, str, int]] = Counter()


def drawing(function: Callable[..., Any]) -> Any:
    """As `kept_jit`, but optimised as the package's own programs that draw: normals have single
    precision, and are rounded alike. Where the compiler does not know the option (conftest.py has
    tried it), they all are compiled alike.
    """
    return kept_jit(function, level=1)


def at_once(function: Callable[..., Any], *given: Any) -> Any:
    """`jax.jit(function)(*given)`, of arrays; the next run of the tests loads the program, and
    neither traces nor lowers it.

    It is found by the test, the line that calls this (and how often the test has called it there),
    and a digest of all files that a test can be made of. If one of these files has changed, the
    program is made anew. It returns arrays, or tuples, lists and dictionaries of them: the tree of
    another class does not survive in a file.
    """
    return kept_jit(function)(*given)


def kept_jit(function: Callable[..., Any], *, level: int = 0, **options: Any) -> Callable[..., Any]:
    """`jax.jit(function)`, its programs found as those of `at_once`; with options, or traced by
    JAX, just that."""
    asked = (
        {OPTIMISATION: level} if level and OPTIMISATION in os.environ.get("XLA_FLAGS", "") else None
    )
    whole = jax.jit(function, compiler_options=asked, **options)
    place = os.environ["PYTEST_CURRENT_TEST"], *_line()
    _calls[place] += 1
    number, made = _calls[place], {}

    def inside(*given: Any, **named: Any) -> Any:
        from jaxmuscle._common import programs

        leaves, structure = jax.tree.flatten(given)
        leaves = [jnp.asarray(x) if isinstance(x, int | float) else x for x in leaves]
        folder = programs.program_folder()
        if options or named or folder is None or not all(map(_is_concrete, leaves)):
            return whole(*given, **named)
        known = (structure, tuple(map(programs._kind, leaves)), programs._config())
        if known not in made:
            name = *place, number, str(structure), *known[1:]
            made[known] = _program(function, leaves, structure, folder, level, name)
        compiled, tree = made[known]
        return jax.tree.unflatten(tree, compiled(*leaves))

    return inside


def _is_concrete(leaf: Any) -> bool:
    return isinstance(leaf, ARRAYS) and not isinstance(leaf, Tracer)


def _line() -> tuple[str, int]:
    """File and line outside this module that called it."""
    frame = sys._getframe()
    while frame.f_back is not None and frame.f_code.co_filename == __file__:
        frame = frame.f_back
    return Path(frame.f_code.co_filename).name, frame.f_lineno


def _program(
    function: Any,
    leaves: list[Any],
    structure: Any,
    folder: Path,
    level: int,
    name: tuple[Any, ...],
) -> tuple[Any, Any]:
    """A program of arrays, and the tree of what it returns."""
    from jaxmuscle._common import programs

    tree = None

    def flat(*leaves: Any) -> list[Any]:
        nonlocal tree
        found, tree = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
        return found

    key = repr((name, level, programs._machine(), os.environ.get("XLA_FLAGS")))
    place = folder / _code()[:16] / hashlib.sha256(key.encode()).hexdigest()
    if (entry := programs._read(place)) is not None and (
        compiled := programs._load(folder / entry[0])
    ) is not None:
        return compiled, entry[1]
    flat.__name__ = programs._unknown("in_test")
    lowered = jax.jit(flat, keep_unused=True).lower(*leaves)
    return programs._compiled(lowered, {OPTIMISATION: level}, folder, place, tree).call, tree


def keep_own_classes() -> None:
    """The package keeps no program of an own class, whose code may change without a sign. Of those
    in tests and pages all code is known: their programs are found by the digest of all files.
    """
    from jaxmuscle._common import programs

    place, lock = programs._place, threading.Lock()

    def placed(folder: Path, function: Any, signature: Any) -> Path | None:
        with lock:
            if (found := place(folder, function, signature)) is not None:
                return found
            known, code = programs._known, programs._code
            programs._known, programs._code = (lambda kind: known(kind) or _is_ours(kind)), _code
            try:
                return place(folder, function, signature)
            finally:
                programs._known, programs._code = known, code

    programs._place = placed


def _is_ours(kind: type) -> bool:
    """Whether a class stands in a test or on a page; not within a function, which might make it
    otherwise each time."""
    if "<locals>" in kind.__qualname__:
        return False
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    places = [ROOT / "tests", ROOT / "docs"]
    return kind.__module__.startswith(PAGE) or (
        file is not None and any(map(Path(file).is_relative_to, places))
    )


@functools.cache
def _code() -> str:
    """Digest of what a test can be made of: the package with its data, tests, pages; and the
    versions of what they call."""
    from jaxmuscle._common import programs

    digest = hashlib.sha256(repr(programs._versions()).encode())
    files = [
        ROOT / "README.md",
        *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*")),
    ]
    for path in sorted(path for path in files if path.is_file() and path.suffix not in UNREAD):
        digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
