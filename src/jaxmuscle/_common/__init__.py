"""What every wing may use: errors, files that are written whole, folded text, trees of numbers,
progress.

It knows nothing of muscles, spectra or fits, and imports no other wing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
