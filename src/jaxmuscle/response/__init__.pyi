"""Public names of this wing."""

from ._autocovariance_at import autocovariance as autocovariance
from ._characteristics import StaticCharacteristics as StaticCharacteristics
from ._characteristics import static_characteristics as static_characteristics
from ._equilibrium import equilibrium as equilibrium
from ._expected_spectrum import expected_spectrum as expected_spectrum
from ._expected_spectrum import expected_variation as expected_variation
from ._input_response import dynamic_stiffness as dynamic_stiffness
from ._input_response import noise_density as noise_density
from ._linear_task import Linearisation as Linearisation
from ._linearised import linearise as linearise
from ._presets import load_preset as load_preset
from ._scaling import relative_variation as relative_variation
from ._sensitivity import Sensitivity as Sensitivity
from ._sensitivity import sensitivity as sensitivity
