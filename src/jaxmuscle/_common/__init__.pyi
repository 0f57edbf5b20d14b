"""What of this wing is public: `jaxmuscle.errors`."""

from . import errors as errors
