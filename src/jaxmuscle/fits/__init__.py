"""Fits of one target, of several targets together and of a cohort; their checks, reports and result
files.

Searches start here; steps are made in `objective`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
