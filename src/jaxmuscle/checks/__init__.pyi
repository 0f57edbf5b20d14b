"""Public names of this wing."""

from ._bootstrap import Bootstrap as Bootstrap
from ._bootstrap import bootstrap as bootstrap
from ._goodness import Goodness as Goodness
from ._goodness import GoodnessPart as GoodnessPart
from ._goodness import goodness as goodness
