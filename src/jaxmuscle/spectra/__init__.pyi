"""Public names of this wing."""

from ._fluctuations import dfa as dfa
from ._fluctuations import variance_spectrum as variance_spectrum
from ._mean import SpectrumEstimate as SpectrumEstimate
from ._measures import approximate_entropy as approximate_entropy
from ._measures import coefficient_of_variation as coefficient_of_variation
from ._measures import peak_frequency as peak_frequency
from ._measures import peaks as peaks
from ._measures import sample_entropy as sample_entropy
from ._peak_test import Peak as Peak
from ._peak_test import PeakTest as PeakTest
from ._peak_test import find_peaks as find_peaks
from ._settings import SpectrumSettings as SpectrumSettings
from ._welch import Spectrum as Spectrum
from ._welch import lowpass as lowpass
from ._welch import periodogram as periodogram
from ._welch import spectrum_of as spectrum_of
from ._welch import welch as welch
