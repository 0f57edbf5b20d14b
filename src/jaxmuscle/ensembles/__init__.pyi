"""Public names of this wing."""

from ._chunks import Pace as Pace
from ._chunks import Watch as Watch
from ._ensemble import ensemble as ensemble
from ._opening import open_store as open_store
from ._speed import measure as measure
from ._store import attributes_of as attributes_of
from ._summary import EnsembleSummary as EnsembleSummary
from ._sweep import Population as Population
from ._sweep import Sweep as Sweep
