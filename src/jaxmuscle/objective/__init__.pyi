"""Public names of this wing."""

from ._free import Free as Free
from ._free import free as free
from ._likelihood import log_likelihood as log_likelihood
