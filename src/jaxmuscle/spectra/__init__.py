"""Power spectra as experiments estimate them (Welch), the sampling law of their bins, and measures
of variability.

It takes arrays and settings; it knows no muscle and no target.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
