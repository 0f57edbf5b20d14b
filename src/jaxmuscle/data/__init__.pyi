"""Public names of this wing."""

from ._as_target import as_target as as_target
from ._file_kinds import kind_of_file as kind_of_file
from ._frequency_response import FrequencyResponse as FrequencyResponse
from ._frequency_response_files import load_frequency_response as load_frequency_response
from ._measure import Measure as Measure
from ._perturbed import PerturbedRecording as PerturbedRecording
from ._recording import Recording as Recording
from ._recording_choice import Movement as Movement
from ._recording_files import load_recording as load_recording
from ._recording_files import read_table as read_table
from ._recording_files import read_tables as read_tables
from ._recording_quality import RecordingSummary as RecordingSummary
from ._recording_table import Table as Table
from ._steadiness import Steadiness as Steadiness
from ._steadiness import steadiness as steadiness
from ._study_table import files_of_study as files_of_study
from ._target import Target as Target
from ._target import load_target as load_target
from ._target_data import TargetData as TargetData
from ._trials import Trials as Trials
from ._trials import load_recordings as load_recordings
from ._two_channels import movement as movement
from ._two_channels import two_channels as two_channels
