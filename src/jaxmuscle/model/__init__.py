"""The model: parameters, material laws, muscle, inputs over time, noises, tasks.

Equations of motion are written here and nowhere else.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
