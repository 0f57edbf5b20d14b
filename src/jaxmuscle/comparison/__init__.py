"""Which colour of noise describes the data best: fits, information criteria and held-out scores.

Takes targets, makes one fit for each noise.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
