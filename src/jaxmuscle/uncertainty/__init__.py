"""What data leave open: profile likelihood, posterior, identifiability and measurements that would
help.

Takes a fit, never makes one.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
