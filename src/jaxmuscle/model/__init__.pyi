"""Public names of this wing."""

from ._muscle import AbstractLaw as AbstractLaw
from ._muscle import AbstractMuscle as AbstractMuscle
from ._muscle import Muscle as Muscle
from ._muscle import QuadraticDamping as QuadraticDamping
from ._muscle import QuadraticStiffness as QuadraticStiffness
from ._noise import AbstractNoise as AbstractNoise
from ._noise import BandLimitedNoise as BandLimitedNoise
from ._noise import OrnsteinUhlenbeckNoise as OrnsteinUhlenbeckNoise
from ._noise import WhiteNoise as WhiteNoise
from ._parameters import PARAMETERS as PARAMETERS
from ._parameters import Parameter as Parameter
from ._pink_noise import PinkNoise as PinkNoise
from ._presets import load_preset as load_preset
from ._presets import save_preset as save_preset
from ._signals import AbstractSignal as AbstractSignal
from ._signals import Constant as Constant
from ._signals import Decay as Decay
from ._signals import Harmonic as Harmonic
from ._signals import RampHold as RampHold
from ._signals import Sampled as Sampled
from ._signals import SmoothStep as SmoothStep
from ._tasks import TASKS as TASKS
from ._tasks import AbstractTask as AbstractTask
from ._tasks import Isometric as Isometric
from ._tasks import PrescribedForce as PrescribedForce
from ._tasks import PrescribedMotion as PrescribedMotion
