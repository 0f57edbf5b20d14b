"""Public names of this wing."""

from ._ensemble import ensemble as ensemble
from ._summary import EnsembleSummary as EnsembleSummary
from ._sweep import Population as Population
from ._sweep import Sweep as Sweep
