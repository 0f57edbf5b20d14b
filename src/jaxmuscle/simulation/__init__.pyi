"""Public names of this wing."""

from ._simulate import simulate as simulate
from ._trajectory import Trajectory as Trajectory
