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
_calls: Counter[str] = Counter()


def drawing(function: Callable[..., Any]) -> Any:
    """As `jax.jit`, but optimised as the package's own programs that draw: normals have single precision, and are rounded
    alike. Where the compiler does not know the option (conftest.py has tried it), exactly `jax.jit`.
    """
    return jax.jit(function, compiler_options={OPTIMISATION: 1} if OPTIMISATION in os.environ.get("XLA_FLAGS", "") else None)


def at_once(function: Callable[..., Any], *given: Any) -> Any:
    """`jax.jit(function)(*given)`, of arrays; the next run of the tests loads the program, and neither traces nor lowers it.

    It stands under the name of the test and the number of the call within it. What a test compiles follows from these, if
    the code of the package and of the tests and the versions of all libraries are the same: they are part of the name.
    """
    from jaxmuscle._common import programs

    leaves, structure = jax.tree.flatten(given)
    test = os.environ["PYTEST_CURRENT_TEST"]
    _calls[test] += 1
    kinds = [(np.shape(leaf), str(leaf.dtype)) for leaf in leaves]
    key = repr((_code(), test, _calls[test], kinds, programs._config(), programs._machine(), os.environ.get("XLA_FLAGS")))
    folder, tree = programs.program_folder(), None

    def flat(*leaves: Any) -> list[Any]:
        nonlocal tree
        found, tree = jax.tree.flatten(function(*jax.tree.unflatten(structure, leaves)))
        return found

    if folder is None:
        return jax.jit(function)(*given)
    place = folder / _code()[:16] / hashlib.sha256(key.encode()).hexdigest()
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
    """Digest of the code of the package and of the tests, and of the versions of what they call."""
    from jaxmuscle._common import programs

    digest = hashlib.sha256(programs._code().encode())
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
