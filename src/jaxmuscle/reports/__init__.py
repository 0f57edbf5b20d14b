"""What fits, cohorts, studies and posteriors say: text, tables, pages, and the paragraph for the
methods section of a paper.

This wing reads results and computes nothing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
