"""Programs that a test compiles itself: made as the package's own, where they draw; kept for the next run."""

import functools
import hashlib
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

OPTIMISATION = "xla_backend_optimization_level"
UNREAD = {".pyc", ".png"}  # no test computes from such a file
_calls: Counter[str] = Counter()


def drawing(function: Callable[..., Any]) -> Any:
    """As `jax.jit`, but optimised as the package's own programs that draw: normals have single precision, and are rounded
    alike. Where the compiler does not know the option (conftest.py has tried it), exactly `jax.jit`.
    """
    return jax.jit(function, compiler_options={OPTIMISATION: 1} if OPTIMISATION in os.environ.get("XLA_FLAGS", "") else None)


def at_once(function: Callable[..., Any], *given: Any) -> Any:
    """`jax.jit(function)(*given)`, of arrays; the next run of the tests loads the program, and neither traces nor lowers it.

    It is found by the name of the test, the number of the call within it, and a digest of all files that a test can be made
    of. If one of these files has changed, the program is made anew.
    """
    from jaxmuscle._common import programs

    folder = programs.program_folder()
    if folder is None:
        return jax.jit(function)(*given)
    leaves, structure = jax.tree.flatten(given)
    test, tree = os.environ["PYTEST_CURRENT_TEST"], None
    _calls[test] += 1
    kinds = [(np.shape(leaf), str(leaf.dtype)) for leaf in leaves]
    key = repr((test, _calls[test], kinds, programs._config(), programs._machine(), os.environ.get("XLA_FLAGS")))
    place = folder / _code()[:16] / hashlib.sha256(key.encode()).hexdigest()

    def flat(*leaves: Any) -> list[Any]:
        nonlocal tree
        found, tree = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
        return found

    compiled = None
    if (entry := programs._read(place)) is not None:
        compiled, tree = programs._load(folder / entry[0]), entry[1]
    if compiled is None:
        flat.__name__ = "kept_in_test"
        lowered = jax.jit(flat, keep_unused=True).lower(*leaves)
        compiled = programs._compiled(lowered, {OPTIMISATION: 0}, place, tree)
    return jax.tree.unflatten(tree, compiled(*leaves))


@functools.cache
def _code() -> str:
    """Digest of what a test can be made of: the package with its data, tests, pages; and the versions of what they call."""
    from jaxmuscle._common import programs

    digest, root = hashlib.sha256(programs._code().encode()), Path(__file__).parents[1]
    files = [path for folder in ("src", "tests", "docs", "benchmarks", "fitting") for path in (root / folder).rglob("*")]
    for path in sorted(path for path in files if path.is_file() and path.suffix not in UNREAD):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
