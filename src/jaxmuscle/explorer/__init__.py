"""The explorer: a page that computes expected spectra in a browser, while sliders move."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
