"""All figures. Nothing is shown, closed or configured globally.

What has one pair of axes draws into `ax` or a new figure and returns the axes. What has several
panels (`ax`: the place in a grid that they take) returns the figure, or the part of yours.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
