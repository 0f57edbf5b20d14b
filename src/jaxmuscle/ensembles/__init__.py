"""Many simulations: chunks, stores on disk, sweeps, running moments, workers on any machines.

Seed i is the same path in whatever chunk or worker it is computed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
