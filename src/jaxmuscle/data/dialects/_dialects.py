"""The table of dialects: a program is added here, and nowhere else."""

from ._acqknowledge import ACQKNOWLEDGE
from ._delsys import DELSYS
from ._diadem import DIADEM
from ._labchart import LABCHART
from ._labview import LABVIEW
from ._motion import OPENSIM, QUALISYS, TRC
from ._opensignals import OPENSIGNALS
from ._otb import OTB
from ._spike2 import SPIKE2
from ._vicon import VICON

# what to do with files of a format that is not read
EXPORTS = {
    ".adicht": "LabChart exports it as .mat or text (File, Export)",
    ".smrx": "Spike2 exports it as .mat or text (File, Export As)",
    ".hpf": "Delsys' EMGworks exports it as .csv (File Utility)",
    ".shpf": "Delsys' Trigno Discover exports it as .csv",
    ".nwb": "write its series into a .csv or .npz, with pynwb say",
    ".otb+": "OTBioLab+ exports it as .mat or .csv (File, Export)",
    ".otb4": "OTBioLab+ exports it as .mat or .csv (File, Export)",
    ".poly5": "TMSi's Polybench and SAGA interface convert it to .edf or .csv",
    ".xls": "Excel saves it as .xlsx or .csv (File, Save As)",
    ".xlsb": "Excel saves it as .xlsx or .csv (File, Save As)",
    ".ods": "LibreOffice saves it as .xlsx or .csv (File, Save As)",
    ".qtm": "Qualisys Track Manager exports it as .tsv, .mat or .c3d (File, Export)",
    ".x1d": "Vicon Nexus exports it as .csv or .c3d",
    ".x2d": "Vicon Nexus exports it as .csv or .c3d",
}

DIALECTS = (
    SPIKE2,
    DIADEM,
    LABCHART,
    ACQKNOWLEDGE,
    OTB,
    VICON,
    QUALISYS,
    OPENSIM,
    TRC,
    LABVIEW,
    OPENSIGNALS,
    DELSYS,
)
