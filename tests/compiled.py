"""Programs that a test runs a few times: without optimisation they compile in half the time."""

import os
from collections.abc import Callable
from typing import Any

import jax

OPTION = "xla_backend_optimization_level"


def once(function: Callable[..., Any]) -> Any:
    """As `jax.jit`; where the compiler does not know the option (conftest.py has tried it), exactly that."""
    known = OPTION in os.environ.get("XLA_FLAGS", "")
    return jax.jit(function, compiler_options={OPTION: 0} if known else None)
