"""Figures and numbers of the paper that the model is from, made anew and compared with its claims.

Only commands stand above it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
