"""Recordings of which nobody reads the entropies."""

import contextlib
from collections.abc import Iterator

import pytest

from jaxmuscle.data import _measured


@contextlib.contextmanager
def without_entropies() -> Iterator[None]:
    """Entropies and DFA take most of the time in which a recording is measured.
    tests/data/test_steadiness.py has them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_measured, "regularity", lambda x: (1.0, 1.0))
        patch.setattr(_measured, "dfa", lambda x: 1.0)
        yield
