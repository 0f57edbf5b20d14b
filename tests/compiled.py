"""Programs of a test that draw random numbers, and are compared with programs of the package."""

import os
from collections.abc import Callable
from typing import Any

import jax

OPTIMISATION = "xla_backend_optimization_level"


def drawing(function: Callable[..., Any]) -> Any:
    """As `jax.jit`, but optimised as the package's own programs that draw: normals have single precision, and are rounded
    alike. Where the compiler does not know the option (conftest.py has tried it), exactly `jax.jit`.
    """
    return jax.jit(function, compiler_options={OPTIMISATION: 1} if OPTIMISATION in os.environ.get("XLA_FLAGS", "") else None)
