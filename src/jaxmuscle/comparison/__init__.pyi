"""Public names of this wing."""

from ._compare import compare_noise as compare_noise
from ._comparison import ComparedModel as ComparedModel
from ._comparison import Comparison as Comparison
from ._comparison import Decision as Decision
