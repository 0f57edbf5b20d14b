"""Solutions of the stochastic differential equation: one seed or a batch of seeds, and what is read
off them.

No linearisation except as control variate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
