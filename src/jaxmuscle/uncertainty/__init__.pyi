"""Public names of this wing."""

from ._designs import Design as Design
from ._identifiability import identifiability as identifiability
from ._identifiability import standard_designs as standard_designs
from ._identifiability_report import IdentifiabilityReport as IdentifiabilityReport
from ._posterior import posterior as posterior
from ._posterior_result import Posterior as Posterior
from ._posterior_result import PosteriorPart as PosteriorPart
from ._profile import Profile as Profile
from ._profile import profile as profile
