"""What was measured: targets (spectra to fit to) and recordings, with every format they are read
from.

A file is checked here once; what leaves is a `Target` or a `Recording`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
