"""Public names of this wing."""

from ._claims import check as check
from ._reproduce import reproduce as reproduce
from ._verdicts import counted as counted
