"""Public names of this wing."""

from ._arguments import task_for as task_for
from ._likelihood import log_likelihood as log_likelihood
