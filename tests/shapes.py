"""Shapes and types of what the package's functions take and return are checked while tests run: of
every function its first calls in each test, and some of the others.

A check takes longer than most small functions, and a fit calls these by the hundred thousand:
checked at every call they took more than half of its time. A function that gets or gives a wrong
shape does so at its first calls, too.
"""

import functools
import inspect
from typing import Any

import jaxtyping
from beartype.roar import BeartypeCallHintViolation
from jaxtyping import install_import_hook

try:
    from jaxtyping import _decorator
    from jaxtyping._decorator import _sentinel, jaxtyped
except ImportError:  # no public part of it
    _decorator = _sentinel = jaxtyped = None

# calls of a function that are checked in a test: so many, then one of so many
FIRST, EVERY = 4, 128
_calls: dict[int, int] = {}


def check(package: str) -> None:
    """From its import on; at every call where another version of jaxtyping is made otherwise."""
    if _decorator is not None:
        _decorator.jaxtyped = jaxtyping.jaxtyped = _sparingly
    install_import_hook(package, "beartype.beartype")


def begin_anew() -> None:
    """Another test."""
    _calls.clear()


def _of_types(function: Any, typechecker: Any) -> Any:
    """Checked without sizes; switched off and told as jaxtyping does."""
    checked = typechecker(function)

    def wrapper(*args: Any, **kwargs: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        try:
            return checked(*args, **kwargs)
        except BeartypeCallHintViolation as error:
            raise jaxtyping.TypeCheckError(str(error)) from error

    return wrapper


def _names_arrays(function: Any) -> bool:
    """Whether sizes are to be compared. Types alone are checked in a tenth of the time."""
    kinds = function.__annotations__.values()
    return any(
        isinstance(kind, str) or "jaxtyping" in repr(kind) or "~" in repr(kind) for kind in kinds
    )


def _sparingly(function: Any = _sentinel, *, typechecker: Any = _sentinel) -> Any:
    """As jaxtyping's decorator. What is no function itself (a class, a property) has it decorate
    its functions with this."""
    if not inspect.isfunction(function):
        return jaxtyped(function, typechecker=typechecker)
    if hasattr(function, "sparingly"):  # inherited
        return function
    # of a function within one the same at each of its calls
    code, checked = id(function.__code__), None

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        nonlocal checked
        _calls[code] = count = _calls.get(code, 0) + 1
        if count > FIRST and count % EVERY:
            return function(*args, **kwargs)
        if checked is None:
            arrays = _names_arrays(function)
            checked = (
                jaxtyped(function, typechecker=typechecker)
                if arrays
                else _of_types(function, typechecker)
            )
        return checked(*args, **kwargs)

    wrapper.sparingly = True  # pyright: ignore[reportAttributeAccessIssue]
    return wrapper
