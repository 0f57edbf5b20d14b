"""Public names of this wing."""

from ._designed_input import DesignedInput as DesignedInput
from ._designs import Design as Design
from ._identifiability import identifiability as identifiability
from ._identifiability import standard_designs as standard_designs
from ._identifiability_report import IdentifiabilityReport as IdentifiabilityReport
from ._identifiability_report import Outlook as Outlook
from ._input_design import design_input as design_input
from ._lengthening import Lengthening as Lengthening
from ._posterior import posterior as posterior
from ._posterior_result import Posterior as Posterior
from ._posterior_result import PosteriorPart as PosteriorPart
from ._profile import Profile as Profile
from ._profile import profile as profile
