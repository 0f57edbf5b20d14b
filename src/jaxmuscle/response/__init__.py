"""What follows from the model without simulating it: equilibrium, linear response, expected
spectra, sensitivity, levels.

Small fluctuations about the operating point. Also presets, since their tasks are scaled to a mean
force.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
