"""What a fit minimises or maximises: coordinates, predicted moments, residuals, likelihood, and the
steps that descend it.

Every fit, posterior and check is built on these.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
