"""Does the model describe the data? Simulated checks of goodness, and refits of simulated data
(bootstrap).

Takes a fit, and fits replicates of it.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
