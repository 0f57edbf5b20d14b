"""Fits that are made only to be looked at in a few of their numbers."""

import contextlib
from collections.abc import Iterator

import pytest

from jaxmuscle.fits._verdict import Endpoint


@contextlib.contextmanager
def without_intervals() -> Iterator[None]:
    """Fits whose 95 % intervals nobody reads: these take most of a refit's time.
    tests/fits/test_intervals.py has them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Endpoint, "intervals", lambda ended, names: {})
        yield
