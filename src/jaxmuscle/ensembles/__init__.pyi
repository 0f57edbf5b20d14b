"""Public names of this wing."""

from ._ensemble import ensemble as ensemble
from ._layout import Pace as Pace
from ._layout import Watch as Watch
from ._parts import PartReport as PartReport
from ._parts import merge as merge
from ._parts import open_store as open_store
from ._processes import join as join
from ._processes import launched as launched
from ._processes import leave as leave
from ._speed import measure as measure
from ._store import attributes_of as attributes_of
from ._summary import EnsembleSummary as EnsembleSummary
from ._sweep import Population as Population
from ._sweep import Sweep as Sweep
