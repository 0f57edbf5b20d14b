"""jaxmuscle: a differentiable stochastic rheological muscle, and its fit to measured force spectra.

The public names are listed in `__init__.pyi`; each is imported when it is first used, so that
`jaxmuscle targets` does not wait for JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
