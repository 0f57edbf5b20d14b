"""Many simulations: chunks, stores on disk, sweeps, several processes, running moments.

Seed i is the same path in whatever chunk or process it is computed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
