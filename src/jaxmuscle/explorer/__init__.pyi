"""Public names of this wing."""

from ._page import page as page
