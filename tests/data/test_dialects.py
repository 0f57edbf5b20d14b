"""What programs of laboratories write: text and .mat of each, workbooks, packed texts, and rates in
words. The layouts are those of the programs; the numbers are made here."""

import gzip
import json

import numpy as np
import pandas
import pytest
import scipy.io
from recorded import assert_reads, noticed, refused, rows, save_mat73, write

from jaxmuscle._common.inputs import ALLOWED
from jaxmuscle.data._recording_channels import Channel
from jaxmuscle.data._recording_choice import signals
from jaxmuscle.data._recording_files import load_columns, load_recording, read_table
from jaxmuscle.data._recording_table import channels_table
from jaxmuscle.data._study_table import read_study
from jaxmuscle.data._trials import load_recordings
from jaxmuscle.data._two_channels import perturbed_recordings

N, RATE = 120, 100
RNG = np.random.default_rng(7)
X, Y, Z = np.round(40 + RNG.normal(size=(3, N)), 4)
TIME = np.arange(N) / RATE


FRAMES, SUBS = np.repeat(np.arange(1, N + 1), 10)[:N], np.tile(np.arange(10), N)[:N]
VICON = "Devices,,,\n100,,,\n,,AMTI - Force,\nFrame,Sub Frame,Fx,Fz\n,,N,N\n"
PLATES = (
    "Devices\n100\n,,Plate 1 - Force,,Plate 2 - Force,\nFrame,Sub Frame,Fx,Fz,Fx,Fz\n,,N,N,N,N\n"
)
TRAJECTORIES = (
    "Trajectories,,,,\n50,,,,\n,,S01:finger,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n"
    + rows(np.arange(1, 61), [0] * 60, X[:60], Y[:60], Z[:60])
)
OUTPUTS = "Model Outputs\n50\n,,S01:LWristAngles\nFrame,Sub Frame,X\n,,deg\n" + rows(
    np.arange(1, 61), [0] * 60, Y[:60]
)
OLD_VICON = "ANALOG\n100,Hz\nSample #,Force.Fx1,Force.Fz1\nUnits:,N,N\n"
QUALISYS = """NO_OF_FRAMES\t120
NO_OF_CAMERAS\t8
NO_OF_MARKERS\t1
FREQUENCY\t100
NO_OF_ANALOG\t0
ANALOG_FREQUENCY\t0
DESCRIPTION\t--
TIME_STAMP\t2026-11-22, 10:00:00.000\t123.4
DATA_INCLUDED\t3D
MARKER_NAMES\tfinger
"""
QUALISYS_ANALOG = """NO_OF_SAMPLES\t120
TOT_NO_OF_CHAN\t2
FREQUENCY\t100
DESCRIPTION\t--
DATA_INCLUDED\tANALOG
CHANNEL_NAMES\tForce (N)\tEMG (mV)
"""
OPENSIM = """ground reaction
version=1
nRows=120
nColumns=3
inDegrees=yes

Units are S.I. units (second, meters, Newtons, ...)
endheader
time\tground_force_vy\tground_force_py
"""
COORDINATES = """Coordinates
version=1
nRows=120
nColumns=2
inDegrees=yes
endheader
time\twrist_flexion
"""
TRC = """PathFileType\t4\t(X/Y/Z)\ttrial.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
100.00\t100.00\t120\t{}\tmm\t100.00\t1\t120
Frame#\tTime\t{}
\t\t{}

"""
LVM = "LabVIEW Measurement\t\n***End_of_Header***\t\n\t\nX_Value\tForce\tComment\n"
LVM_TOP = """LabVIEW Measurement\t
Writer_Version\t2
Reader_Version\t2
Separator\tTab
Decimal_Separator\t{decimal}
Multi_Headings\t{several}
X_Columns\t{x}
Time_Pref\tAbsolute
***End_of_Header***\t
\t
"""
LVM_PACKET = """Channels\t2\t\t\t
Samples\t120\t120\t\t
Date\t2026/11/22\t2026/11/22\t\t
Time\t10:00:00\t10:00:00\t\t
Y_Unit_Label\tN\tmV\t\t
X_Dimension\tTime\tTime\t\t
X0\t0.0E+0\t0.0E+0\t\t
Delta_X\t0.01\t0.01\t\t
***End_of_Header***\t\t\t\t
{names}
"""
BIODEX = "Name: X\nDate: 01/01/2020\n\n   mSec    N-M  Degrees  Degrees  DEG/SEC\n"
BIODEX_NAMED = (
    "    TIME   TORQUE POSITION POS (ANAT) VELOCITY\n    mSec    N-M  Degrees  Degrees  DEG/SEC\n"
)
BITALINO = {
    "20:16:02:14:75:76": {
        "sensor": ["RAW", "EMG"],
        "device name": "20:16:02:14:75:76",
        "column": ["nSeq", "I1", "A1", "A2"],
        "sampling rate": 100,
        "label": ["A1", "A2"],
        "resolution": [4, 1, 10, 10],
    }
}
EMGWORKS = 'X[s],"EMG 1",X[s],"ACC.X 1",X[s],"Analog 12 (V)"\n'
TRIGNO = """Application:,Trigno Discover (2.1.0),,
Date/Time:,11/22/2026 10:00:00 AM,,
Collection Length (seconds):,1.2,,
Avanti Sensor 1 (82245),,Avanti Sensor 2 (82246),
sensor mode: 40,,sensor mode: 40,
EMG 1 Time Series (s),EMG 1 (mV),EMG 1 Time Series (s),EMG 1 (mV)
,50 Hz,,100 Hz
"""


def half(values):
    """The first half of a column, and empty cells."""
    return [*values[: N // 2], *[""] * (N - N // 2)]


def lvm(x, names, *columns, decimal=".", several="No", packets=1):
    top = LVM_TOP.format(decimal=decimal, several=several, x=x)
    parts = np.array_split(np.arange(N), packets)
    for part in parts:
        cells = [[column[i] for i in part] for column in columns]
        top += LVM_PACKET.format(names=names) + rows(*cells, sign="\t", comma=decimal == ",")
    return top


TEXTS = {  # content, and what is not that of `USUAL`: column, ending, unit
    "Vicon": (VICON + rows(FRAMES, SUBS, Y, X), "Fz"),
    "Vicon, semicolons": (
        VICON.replace(",", ";") + rows(FRAMES, SUBS, Y, X, sign=";", comma=True),
        "Fz",
    ),
    "Vicon, two plates": (PLATES + rows(FRAMES, SUBS, Y, Z, Z, X), "Plate 2 - Force Fz"),
    "Vicon, blocks": (
        OUTPUTS + "\n" + TRAJECTORIES + "\n" + VICON + rows(FRAMES, SUBS, Y, X),
        "Fz",
    ),
    "Vicon, blocks of another order": (
        VICON + rows(FRAMES, SUBS, Y, X) + ",,,\n\n" + TRAJECTORIES,
        "Fz",
    ),
    "Vicon, old": (OLD_VICON + rows(FRAMES, Y, X), "Force.Fz1"),
    "Qualisys": (QUALISYS + rows(Y, X, Z, sign="\t"), "finger Y", "tsv", "mm"),
    "Qualisys with names": (
        QUALISYS
        + "Frame\tTime\tfinger X\tfinger Y\tfinger Z\n"
        + rows(np.arange(1, N + 1), TIME, Y, X, Z, sign="\t"),
        "finger Y",
        "tsv",
        "mm",
    ),
    "Qualisys with times": (
        QUALISYS + rows(np.arange(1, N + 1), TIME, Y, X, Z, sign="\t"),
        "finger Y",
        "tsv",
        "mm",
    ),
    "Qualisys, analog": (QUALISYS_ANALOG + rows(X, Y, sign="\t"), "Force", "tsv"),
    "Qualisys, force": (
        QUALISYS_ANALOG.replace("CHANNEL_NAMES\tForce (N)\tEMG (mV)", "FORCE_PLATE_NAME\tPlate 1")
        + "SAMPLE\tTIME\tForce_X\tForce_Z\tMoment_X\n"
        + rows(np.arange(1, N + 1), TIME, Y, X, Z, sign="\t"),
        "Force_Z",
        "tsv",
    ),
    "Qualisys, one channel": (QUALISYS_ANALOG.replace("\tEMG (mV)", "") + rows(X), None, "tsv"),
    "OpenSim": (OPENSIM + rows(TIME, X, Y, sign="\t"), "ground_force_vy", "mot"),
    "OpenSim, position": (OPENSIM + rows(TIME, Y, X, sign="\t"), "ground_force_py", "sto", "m"),
    "trc": (
        TRC.format(1, "finger\t\t", "X1\tY1\tZ1")
        + rows(np.arange(1, N + 1), TIME, Y, Z, X, sign="\t"),
        "finger Z",
        "trc",
        "mm",
    ),
    "trc, as wide as its settings": (
        TRC.format(2, "thumb\t\t\tfinger\t\t", "X1\tY1\tZ1\tX2\tY2\tZ2")
        + rows(np.arange(1, N + 1), TIME, Y, Y, Y, Y, Z, X, sign="\t"),
        "finger Z",
        "trc",
        "mm",
    ),
    "LabVIEW": (LVM + rows(TIME, X, [""] * N, sign="\t"), None, "lvm", None),
    "LabVIEW, bare rows": (LVM + rows(TIME, X, sign="\t"), None, "lvm", None),
    "LabVIEW, comment": (
        LVM + rows(TIME, X, sign="\t").replace("\n", "\tgo\n", 1),
        None,
        "lvm",
        None,
    ),
    "LabVIEW, two headers": (
        lvm("One", "X_Value\tForce\tEMG\tComment", TIME, X, Y),
        "Force",
        "lvm",
    ),
    "LabVIEW, decimal commas": (
        lvm("One", "X_Value\tForce\tEMG\tComment", TIME, X, Y, decimal=","),
        "Force",
        "lvm",
    ),
    "LabVIEW, no times": (
        lvm("No", "X_Value\tForce\tEMG\tComment", [""] * N, X, Y),
        "Force",
        "lvm",
    ),
    "LabVIEW, times of each": (
        lvm("Multi", "X_Value\tForce\tX_Value\tEMG\tComment", TIME, X, TIME / 2, Y),
        "Force",
        "lvm",
    ),
    "LabVIEW, packets": (
        lvm("One", "X_Value\tForce\tEMG\tComment", TIME, X, Y, several="Yes", packets=3),
        "Force",
        "lvm",
    ),
    "EMGworks": (EMGWORKS + rows(TIME, Y, TIME / 2, Z, TIME, X), "Analog 12", "csv", "V"),
    "EMGworks, other lengths": (
        EMGWORKS + rows(half(TIME * 2), half(Y), half(TIME * 2), half(Z), TIME, X),
        "Analog 12",
        "csv",
        "V",
    ),
    "equal names, one time": ("time,EMG,EMG,force (N)\n" + rows(TIME, Y, Z, X), "force"),
    "rate in words": ("Sampling rate: 100 Hz\nForce [N]\n" + rows(X), None, "txt"),
    "rate in a row": ("Sample Rate (Hz),100\nForce [N],EMG\n" + rows(X, Y),),
    "rate of few letters": ("fs = 100\nForce [N]\n" + rows(X), None, "txt"),
    "rate in kHz": ("Frequency;0,1 kHz\nForce [N];EMG\n" + rows(X, Y, sign=";"), 0),
    "step in words": ("Subject: 3\nInterval: 10 ms\nForce [N]\n" + rows(X), None, "txt"),
    "step in s": ("Subject,3\ndt (s),0.01\nForce [N],EMG\n" + rows(X, Y),),
    "rate in kHz, decimal comma": (
        "Sampling Frequency\t0,100 kHz\nForce [N]\tEMG\n" + rows(X, Y, sign="\t"),
        0,
        "txt",
    ),
    "rate in a comment": ("# fs: 100\n# Force [N]\n" + rows(X), None, "txt"),
    "rate in another language": (
        "Fréquence d'échantillonnage : 100 Hz\nForce [N]\n" + rows(X),
        None,
        "txt",
    ),
    "rate behind a sign": ("%Sample Rate = 100 Hz\nForce [N], EMG\n" + rows(X, Y), 0, "txt"),
    "rate beside another frequency": (
        "Frequency: 50 Hz\nSampling frequency: 100 Hz\nForce [N]\n" + rows(X),
        None,
        "txt",
    ),
    "times of their own": (
        "Time Force (s),Force (N),Time EMG (s),EMG\n" + rows(TIME, X, TIME / 2, Y),
    ),
    "times of each sensor": (
        "Avanti 1: EMG 1: Time Series (s),EMG 1 (mV),Avanti 2: FSR: Time Series (s),Force (N)\n"
        + rows(TIME / 2, Y, TIME, X),
    ),
    "times of one name": ("t,EMG,t,Force (N)\n" + rows(TIME / 2, Y, TIME, X),),
    "row of rates": ("Force (N),EMG\n100 Hz,100 Hz\n" + rows(X, Y),),
}


USUAL = ("Force", "csv", "N")


@pytest.mark.parametrize("case", TEXTS)
def test_texts_of_programs(case, tmp_path):
    content, column, ending, unit = (*TEXTS[case], *USUAL[len(TEXTS[case]) - 1 :])
    recording = load_recording(write(tmp_path, content, f"trial.{ending}"), column=column)
    np.testing.assert_array_equal(recording.whole, X)
    assert recording.rate == pytest.approx(RATE, rel=1e-9)
    assert recording.unit == (unit or "a.u.") and recording.start == 0


def test_blocks_of_vicon_are_kept_apart(tmp_path):
    """Every block has its rate; points have their names."""
    path = write(tmp_path, TEXTS["Vicon, blocks"][0], "trial.csv")
    point = load_recording(path, column="S01:finger X")
    assert (point.rate, point.unit, point.whole.size) == (50, "mm", 60)
    np.testing.assert_array_equal(load_recording(path, column="S01:finger", axis="y").whole, Y[:60])
    table = read_table(path)
    assert table.rates["S01:LWristAngles X"] == 50 and table.rates["Fz"] == 100
    points = [f"S01:finger {axis}" for axis in "XYZ"]
    assert signals(table, None) == ["S01:LWristAngles X", *points, "Fx", "Fz"]


def test_a_workbook_of_vicon(tmp_path):
    lines = [line.split(",") for line in TEXTS["Vicon"][0].splitlines()]
    cells = [[float(c) if i > 4 else c or None for c in line] for i, line in enumerate(lines)]
    cells[1][0] = 100
    pandas.DataFrame(cells).to_excel(tmp_path / "trial.xlsx", index=False, header=False)
    recording = load_recording(tmp_path / "trial.xlsx", column="Fz")
    assert_reads(recording, X, RATE, "N")


def test_packets_of_labview_without_times_are_blocks(tmp_path):
    """Nothing says that one goes on where the other ends."""
    content = lvm("No", "X_Value\tForce\tEMG\tComment", [""] * N, X, Y, several="Yes", packets=2)
    path = write(tmp_path, content, "trial.lvm")
    second = load_recording(path, column="Force, block 2")
    assert_reads(second, X[N // 2 :], RATE, "N")


def test_packets_of_labview_whose_times_start_again_are_blocks(tmp_path):
    names = "X_Value\tForce\tEMG\tComment"
    again = np.concatenate([TIME[: N // 2], TIME[: N // 2] * 2])
    content = lvm("One", names, again, X, Y, several="Yes", packets=2)
    first, second = (
        load_recording(write(tmp_path, content, "trial.lvm"), column=f"Force, block {i}")
        for i in (1, 2)
    )
    np.testing.assert_array_equal(np.concatenate([first.whole, second.whole]), X)
    assert (first.rate, second.rate) == (RATE, RATE / 2)


def test_lines_of_packets_keep_their_numbers(tmp_path):
    content = lvm("One", "X_Value\tForce\tEMG", TIME, X, Y, several="Yes", packets=3)
    wrong = content.replace(f"{X[100]:g}", "high")
    number = next(i for i, line in enumerate(wrong.splitlines(), 1) if "high" in line)
    with pytest.raises(ValueError, match=f"line {number}: Force 'high' is not a number"):
        load_recording(write(tmp_path, wrong, "trial.lvm"), column="Force")


@pytest.mark.parametrize("header", [BIODEX, BIODEX_NAMED], ids=["units", "names and units"])
def test_biodex(header, tmp_path):
    angle = np.full(N, 30.0)
    content = header + rows(np.arange(N) * 10, X, angle, angle, np.zeros(N), sign="   ")
    path = write(tmp_path, content, "trial.txt")
    named = header is BIODEX_NAMED
    recording = load_recording(path, column="TORQUE" if named else "N-M", units="Nm")
    assert_reads(recording, X, RATE, "N m")
    table = read_table(path)
    assert table.units["TORQUE" if named else "N-M"] == "N-M"
    assert list(table.columns) == (
        ["TIME", "TORQUE", "POSITION", "POS (ANAT)", "VELOCITY"]
        if named
        else ["mSec", "N-M", "Degrees", "Degrees 2", "DEG/SEC"]
    )


def opensignals(devices, *columns):
    head = f"# OpenSignals Text File Format. Version 1\n# {json.dumps(devices)}\n# EndOfHeader\n"
    return head + rows(*columns, [""] * N, sign="\t")


def test_opensignals(tmp_path):
    sequence, digital = np.arange(N) % 16, np.zeros(N, int)
    path = write(tmp_path, opensignals(BITALINO, sequence, digital, X, Y), "trial.txt")
    recording = load_recording(path, column="A1")
    assert_reads(recording, X, RATE, "a.u.")
    assert noticed(recording, "counts of its converter")
    assert [r.name for r in load_columns(path)] == ["trial A1", "trial A2"]
    two = BITALINO | {"other": BITALINO["20:16:02:14:75:76"]}
    content = opensignals(two, sequence, digital, X, Y, sequence, digital, Y, X)
    assert np.array_equal(
        load_recording(write(tmp_path, content, "two.txt"), column="A2 2").whole, X
    )
    scaled = {"device": BITALINO["20:16:02:14:75:76"] | {"convertedValues": 1}}
    content = opensignals(scaled, sequence, digital, X, Y)
    assert load_recording(write(tmp_path, content, "c.txt"), column="A1", units="N").notices == ()


def test_trigno_discover(tmp_path):
    """Sensors of different rates, each with its times; two have a channel of one name."""
    body = rows(half(TIME * 2), half(Y), TIME, X)
    path = write(tmp_path, TRIGNO + body, "trial.csv")
    second = load_recording(path, column="Avanti Sensor 2 EMG 1")
    assert_reads(second, X, RATE, "mV")
    first = load_recording(path, column="Avanti Sensor 1 EMG 1")
    np.testing.assert_array_equal(first.whole, Y[: N // 2])
    assert first.rate == 50 and not noticed(first, "cut off")


def test_trigno_discover_with_markers_and_without_times(tmp_path):
    marks = TRIGNO + ",0.02,,0.01,Type,Name,Label,Time (s)\n"
    body = rows(TIME, Y, TIME, X).replace("\n", ",General,go,a,0.5\n", 1)
    recording = load_recording(
        write(tmp_path, marks + body, "trial.csv"), column="Avanti Sensor 2 EMG 1"
    )
    np.testing.assert_array_equal(recording.whole, X)
    head = TRIGNO.replace("EMG 1 Time Series (s),", "").replace(",50 Hz,,100 Hz", "50 Hz,100 Hz")
    head = head.replace("(82245),,", "(82245),")
    path = write(tmp_path, head + rows(half(Y), X), "bare.csv")
    assert load_recording(path, column=1).rate == RATE
    first = load_recording(path, column="Avanti Sensor 1 EMG 1")
    assert first.rate == 50 and first.whole.size == N // 2


def test_equal_names_are_numbered_with_a_notice(tmp_path):
    path = write(tmp_path, "time,Force [N],Force [N],Force [N]\n" + rows(TIME, Y, X, Z), "a.csv")
    recording = load_recording(path, column="force 2")
    np.testing.assert_array_equal(recording.whole, X)
    assert recording.unit == "N"
    assert "columns of one name are numbered: Force [N]" in recording.notices
    with pytest.raises(ValueError, match=r"choose one with `column`: Force \[N\], Force 2 \[N\]"):
        load_recording(path)


def test_a_rate_in_words_gives_way_to_times(tmp_path):
    for head in ("a,b\n", "time,force (N)\n"):
        path = write(tmp_path, "Sampling rate: 50\n" + head + rows(TIME, X), "a.csv")
        recording = load_recording(path, column=1)
        assert recording.rate == RATE
        assert not noticed(recording, "as the header says")


def test_a_rate_with_a_comma_for_thousands(tmp_path):
    path = write(tmp_path, "Sampling rate: 2,048 Hz\nForce [N]\n" + rows(X), "a.txt")
    recording = load_recording(path)
    assert recording.rate == 2048
    assert "rate 2048 Hz, as the header says: Sampling rate: 2,048 Hz" in recording.notices


def test_frequencies_as_names_are_no_rates(tmp_path):
    head = "Stimulation,,\n20 Hz,50 Hz,100 Hz\n"
    table = read_table(write(tmp_path, head + rows(X, Y, Z), "a.csv"))
    assert list(table.columns) == ["20 Hz", "50 Hz", "100 Hz"] and not table.rates


@pytest.mark.parametrize(
    "line",
    [
        "Stimulation frequency: 30",
        "Rate: fast",
        "Interval: 3 weeks",
        "Age: 27",
        "fs:",
        "Sampling rate: 100 Hz\nSampling rate: 200 Hz",
    ],
)
def test_other_lines_state_no_rate(line, tmp_path):
    path = write(tmp_path, f"{line}\nForce [N]\n" + rows(X), "a.txt")
    with pytest.raises(ValueError, match="does not state its rate"):
        load_recording(path)


# --- .mat


def column_of(lines):
    """A cell of texts, as MATLAB saves it."""
    cell = np.empty((len(lines), 1), object)
    cell[:, 0] = lines
    return cell


def tracks(*arrays):
    """A cell of arrays."""
    cell = np.empty((1, len(arrays)), object)
    for i, array in enumerate(arrays):
        cell[0, i] = array
    return cell


def labchart(starts, ends, titles=("Force ", "EMG   "), **more):
    """`starts` and `ends` of channels by blocks."""
    return {
        "data": np.concatenate([X, Y, Z, X])[None].astype(np.float32),
        "datastart": np.array(starts, float),
        "dataend": np.array(ends, float),
        "titles": np.array(titles),
        "unittext": np.array(["kg", "mV"]),
        "unittextmap": np.array([[1] * len(starts[0]), [2] * len(starts[0])][: len(titles)], float),
        "samplerate": np.full((len(titles), len(starts[0])), 100.0),
        "tickrate": 100.0,
        "blocktimes": np.full(len(starts[0]), 7e5),
        "rangemin": np.full((len(titles), len(starts[0])), -500.0),
        "com": np.zeros((0, 5)),
        **more,
    }


ACQ = {
    "data": np.stack([X, Y], axis=1),
    "isi": 10.0,
    "isi_units": "ms",
    "labels": np.array(["Force, DA100C ", "EMG, EMG100C  "]),
    "units": np.array(["N ", "mV"]),
    "start_sample": 0.0,
}


def spike2(title, values, units, **more):
    return {
        "title": title,
        "comment": "no comment",
        "interval": 0.01,
        "scale": 1.0,
        "offset": 0.0,
        "units": units,
        "start": 0.0,
        "length": float(N),
        "values": values[:, None],
        **more,
    }


OTB = {
    "Data": np.stack([Y, X], axis=1).astype(np.float32),
    "Time": TIME[:, None],
    "SamplingFrequency": 100.0,
    "Description": column_of(["Vastus - GR08MM1305 (1)[uV]", "acquired data[ %(MVC)]"]),
    "OTBFile": "unknown",
}
MATS = {  # variables, and what is not Force in N: column, unit
    "LabChart": (labchart([[1], [121]], [[120], [240]]), "Force", "kgf"),
    "LabChart, one channel": (
        labchart([[1]], [[120]], ["Force"], unittext="Kg", unittextmap=1.0),
        None,
        "kgf",
    ),
    "LabChart, block": (
        labchart([[1, 361], [121, 241]], [[120, 480], [240, 360]]),
        "Force, block 2",
        "kgf",
    ),
    "LabChart, block missing": (
        labchart([[-1, 1], [121, 241]], [[-1, 120], [240, 360]]),
        "Force, block 2",
        "kgf",
    ),
    "LabChart, a table for each block": (
        {
            "data_block1": np.stack([Y, Z]),
            "titles_block1": np.array(["Force", "EMG  "]),
            "ticktimes_block1": TIME,
            "data_block2": np.stack([X, Y]),
            "titles_block2": np.array(["Force", "EMG  "]),
            "units_block2": np.array(["N ", "mV"]),
            "ticktimes_block2": TIME,
        },
        "Force, block 2",
    ),
    "LabChart, whole numbers": (
        labchart(
            [[1], [121]],
            [[120], [240]],
            data=np.round(np.concatenate([X, Y])[None] * 1e4 - 7).astype(np.int32),
            scaleunits=np.full((2, 1), 1e-4),
            scaleoffset=np.full((2, 1), 7.0),
        ),
        "Force",
        "kgf",
    ),
    "AcqKnowledge": (ACQ, "Force, DA100C"),
    "AcqKnowledge, by number": (ACQ, "data:0"),
    "AcqKnowledge in seconds": (ACQ | {"isi": 0.01, "isi_units": "s"}, "data:0"),
    "AcqKnowledge, cells": (
        ACQ | {"labels": column_of(["Force", "EMG"]), "units": column_of(["N", "mV"])},
        "force",
    ),
    "Spike2": ({"t_Ch1": spike2("Force", X, "volt")}, None, "V"),
    "Spike2 with events": (
        {
            "t_Ch1": spike2("Force", X, "N"),
            "t_Ch2": spike2("EMG", Y, "mV"),
            "t_Ch31": {
                "title": "Keyboard",
                "length": 2.0,
                "times": np.ones((2, 1)),
                "codes": np.ones((2, 4)),
            },
            "file": {"name": "t.smrx"},
        },
    ),
    "Spike2, whole numbers": (
        {
            "t_Ch1": spike2(
                "Force", np.round((X - 3) * 65536 / 5).astype(np.int32), "N", scale=0.5, offset=3.0
            )
        },
        None,
    ),
    "OTB": (OTB, "acquired data", "% MVC"),
    "OTB, by number": (OTB, "Data:1", "% MVC"),
    "OTB, round brackets": (
        OTB | {"Description": column_of(["EMG (1)[uV]", "Force (%(MVC))"])},
        "force",
        "% MVC",
    ),
    "OTB, tracks": (
        {
            "Data": tracks(Y[:, None], X[:, None]),
            "SamplingFrequency": np.array([[100.0, 100.0]]),
            "Description": column_of(["EMG (1)[uV]", "Force[N]"]),
        },
    ),
    "OTB, newtons": (
        OTB | {"Description": column_of(["EMG (1)[uV]", "Acquired Force[N]"])},
        "Acquired Force",
    ),
    **{
        f"rate from {name}": ({"force": X, name: value}, None, None)
        for name, value in {
            "fsamp": 100.0,
            "FSAMP": 100,
            "Fs": 100.0,
            "fsample": 100.0,
            "sample_rate": 100.0,
            "sampleRate": 100.0,
            "sfreq": 100.0,
            "SR": 100.0,
            "samplingFrequency": 100.0,
            "fs_Hz": 100.0,
            "dt": 0.01,
            "Ts": 0.01,
            "interval": 0.01,
            "dt_ms": 10.0,
        }.items()
    },
    "rate of a struct": (
        {"force": {"data": X, "fs": 100.0}, "emg": {"data": Y, "fs": 2000.0}},
        "force.data",
        None,
    ),
    "rate named after the signal": (
        {"force": X, "force_fs": 100.0, "emg": Y, "emg_fs": 2000.0, "force_units": "N"},
        "force",
    ),
    "rate named before the signal": (
        {"force": X, "fs_force": 100.0, "emg": Y, "fs_emg": 2000.0},
        "force",
        None,
    ),
    "signal of reference": (
        {"SIG": tracks(Y), "IPTs": np.stack([Y, Z]), "REF_SIGNAL": X, "FSAMP": 100.0},
        None,
        None,
    ),
    "labels beside": (
        {
            "data": np.stack([Y, X], axis=1),
            "labels": column_of(["EMG", "Force"]),
            "units": column_of(["mV", "N"]),
            "fs": 100.0,
        },
    ),
    "labels in a struct": (
        {
            "trial": {
                "data": np.stack([Y, X]),
                "channels": column_of(["EMG", "Force"]),
                "units": column_of(["mV", "kg"]),
                "fs": 100.0,
            }
        },
        "Force",
        "kgf",
    ),
    "times of a struct": (
        {"trial": {"force": X, "time": TIME, "units": "kg"}, "other": {"emg": Y, "t": TIME * 3}},
        "trial.force",
        "kgf",
    ),
    "unit of a struct": (
        {"trial": {"force": X, "time": TIME, "units": "kg", "fs": 100.0}},
        "trial.force",
        "kgf",
    ),
}
CLOSE = {"LabChart, whole numbers": 1e-4, "Spike2, whole numbers": 1e-4}


def assert_mat(path, case):
    column, unit = (*MATS[case][1:], *("Force", "N")[len(MATS[case]) - 1 :])
    recording = load_recording(path, column=column)
    # LabChart and OTB save single precision
    np.testing.assert_allclose(recording.whole, X, rtol=1e-6, atol=CLOSE.get(case, 0))
    assert (recording.rate, recording.unit) == (pytest.approx(RATE), unit or "a.u.")


@pytest.mark.parametrize("case", MATS)
def test_mat_of_programs(case, tmp_path):
    scipy.io.savemat(tmp_path / "trial.mat", MATS[case][0])
    assert_mat(tmp_path / "trial.mat", case)


def test_other_rates_are_of_other_channels(tmp_path):
    """A rate that is named after one signal says nothing of another."""
    scipy.io.savemat(tmp_path / "trial.mat", {"force": X, "emg": Y, "emg_fs": 2000.0})
    assert load_recording(tmp_path / "trial.mat", column="emg", units="mV").rate == 2000
    with pytest.raises(ValueError, match="does not state its rate"):
        load_recording(tmp_path / "trial.mat", column="force")
    scipy.io.savemat(tmp_path / "trial.mat", {"force": X, "isi": 10.0, "heart_rate": 70.0})
    with pytest.raises(ValueError, match="does not state its rate"):
        load_recording(tmp_path / "trial.mat")


def test_blocks_of_labchart_are_trials(tmp_path):
    path = tmp_path / "trial.mat"
    scipy.io.savemat(path, labchart([[1, 361]], [[120, 480]], ["Force"], unittextmap=[[1.0, 1.0]]))
    with pytest.raises(
        ValueError, match="choose one with `column`: 'Force, block 1', 'Force, block 2'"
    ):
        load_recording(path)
    first, second = load_recordings(path)
    np.testing.assert_allclose(first.whole, second.whole)
    assert (first.name, first.unit, first.rate) == ("trial Force, block 1", "kgf", RATE)


@pytest.mark.parametrize(
    "case", [name for name in MATS if not name.startswith("rate from") and "missing" not in name]
)
def test_mat_of_programs_in_version_73(case, tmp_path):
    save_mat73(tmp_path / "trial.mat", MATS[case][0])
    assert_mat(tmp_path / "trial.mat", case)


def test_variables_of_npz(tmp_path):
    np.savez(tmp_path / "a.npz", force=X, fsamp=100.0, force_unit="kg")
    recording = load_recording(tmp_path / "a.npz")
    assert (recording.rate, recording.unit) == (RATE, "kgf")
    np.savez(tmp_path / "b.npz", data=np.stack([Y, X], axis=1), labels=["EMG", "Force"], dt=0.01)
    np.testing.assert_array_equal(load_recording(tmp_path / "b.npz", column="force").whole, X)
    assert load_recording(tmp_path / "b.npz", column="data:1").rate == pytest.approx(RATE)


# --- texts by what is in them


@pytest.mark.parametrize("name", ["a.log", "a.prn", "a.tab", "a.xls", "a.out", "trial", "a.mat"])
def test_texts_by_their_content(name, tmp_path):
    path = write(tmp_path, "time\tForce (N)\n" + rows(TIME, X, sign="\t"), name)
    np.testing.assert_array_equal(load_recording(path).whole, X)


def test_packed_texts(tmp_path, monkeypatch):
    text = VICON + rows(FRAMES, SUBS, Y, X)
    path = write(tmp_path, gzip.compress(text.encode()), "trial.csv.gz")
    recording = load_recording(path, column="Fz")
    np.testing.assert_array_equal(recording.whole, X)
    assert recording.rate == RATE
    utf16 = write(tmp_path, gzip.compress(text.encode("utf-16")), "trial.txt.gz")
    np.testing.assert_array_equal(load_recording(utf16, column="Fz", skip_rows=0).whole, X)
    for content, message in (
        (gzip.compress(bytes(range(256)) * 99), "holds no text with rows of numbers; unpack it"),
        (gzip.compress(text.encode())[:50], "cannot be unpacked: "),
        (b"\x1f\x8b" + bytes(99), "cannot be unpacked: "),
        (text.encode(), "cannot be unpacked: Not a gzipped file"),
    ):
        with pytest.raises(ValueError, match=message):
            load_recording(write(tmp_path, content, "bad.csv.gz"))
    bomb = write(tmp_path, gzip.compress(b"1\n" * 5_000_000), "bomb.csv.gz")
    monkeypatch.setenv(ALLOWED, "0.001")
    with pytest.raises(ValueError, match=r"bomb\.csv\.gz: it holds more than 0\.001 GiB"):
        load_recording(bomb, rate=100)


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        (".adicht", "LabChart exports it as .mat or text"),
        (".smrx", "Spike2 exports it as .mat or text"),
        (".hpf", "EMGworks exports it as .csv"),
        (".nwb", "into a .csv or .npz"),
        (".otb+", "OTBioLab+ exports it as .mat or .csv"),
        (".otb4", "OTBioLab+ exports it as .mat or .csv"),
        (".Poly5", "convert it to .edf or .csv"),
        (".xls", "Excel saves it as .xlsx or .csv"),
    ],
)
def test_what_to_export_instead(kind, what, tmp_path):
    path = write(tmp_path, b"\xd0\xcf\x11\xe0\0\0binary\0", f"trial{kind}")
    with pytest.raises(ValueError) as caught:
        load_recording(path)
    assert f"not {kind.lower()}; " in str(caught.value) and what in str(caught.value)


# --- workbooks


def book(path, **sheets):
    with pandas.ExcelWriter(path) as writer:
        for name, frame in sheets.items():
            frame.to_excel(writer, sheet_name=name, index=False)
    return path


def trial(values):
    return pandas.DataFrame({"Time (s)": TIME, "Force (N)": values})


INFO = pandas.DataFrame({"Subject": ["S01"], "MVC (N)": [410]})


def test_the_sheet_with_a_signal_is_found(tmp_path):
    path = book(tmp_path / "a.xlsx", Info=INFO, Trial1=trial(X))
    recording = load_recording(path)
    np.testing.assert_array_equal(recording.whole, X)
    assert (recording.rate, recording.unit, recording.name) == (RATE, "N", "a Trial1")
    assert "sheet Trial1 taken, of Info, Trial1" in recording.notices
    for sheet in ("Trial1", "trial1", 1, "1"):
        np.testing.assert_array_equal(load_recording(path, sheet=sheet).whole, X)
    with pytest.raises(ValueError, match=r"sheet='Trial2': did you mean .*Trial1"):
        load_recording(path, sheet="Trial2")


def test_empty_sheets_are_no_choice(tmp_path):
    empty = pandas.DataFrame()
    path = book(tmp_path / "a.xlsx", Sheet1=trial(X)[:60], Sheet2=empty, Sheet3=empty)
    recording = load_recording(path)
    assert recording.whole.size == 60 and recording.name == "a" and recording.notices == ()


def test_sheets_of_one_layout_are_trials(tmp_path):
    path = book(tmp_path / "a.xlsx", Info=INFO, T1=trial(X), T2=trial(Y), T3=trial(Z))
    with refused("holds 3 sheets with signals, T1, T2, T3; choose one with `sheet`, as sheet='T1'"):
        load_recording(path)
    for trials in (load_recordings(path), load_recordings([path])):
        assert [r.name for r in trials] == ["a T1", "a T2", "a T3"]
        np.testing.assert_array_equal(trials[1].whole, Y)
        assert "the sheets are trials, of Info, T1, T2, T3" in trials[0].notices
    assert len(load_recordings([path], sheet="T2")) == 1


def test_a_table_of_results_is_no_signal(tmp_path):
    results = pandas.DataFrame({"subject": [f"S{i}" for i in range(100)], "mvc": Y[:100]})
    path = book(tmp_path / "a.xlsx", Results=results, Force=trial(X))
    np.testing.assert_array_equal(load_recording(path).whole, X)


def test_a_workbook_of_trials_is_no_perturbation(tmp_path):
    path = book(tmp_path / "a.xlsx", T1=trial(X), T2=trial(Y))
    assert perturbed_recordings(path, files=True) == ()


def test_sheets_of_a_study(tmp_path):
    path = book(tmp_path / "a.xlsx", T1=trial(X), T2=trial(Y))
    write(tmp_path, f"file,person,sheet\n{path.name},anna,T1\n{path.name},berta,1\n", "study.csv")
    first, second = read_study(tmp_path / "study.csv").rows
    np.testing.assert_array_equal(load_recording(first.file, **first.reading).whole, X)
    np.testing.assert_array_equal(load_recording(second.file, **second.reading).whole, Y)


def test_sheets_of_other_layouts_are_asked_for(tmp_path):
    path = book(
        tmp_path / "a.xlsx", Force=trial(X), EMG=trial(Y).rename(columns={"Force (N)": "EMG"})
    )
    with pytest.raises(ValueError) as caught:
        load_recordings(path)
    message = str(caught.value)
    assert (
        "holds the sheets Force, EMG; with 90 rows of numbers or more: Force, EMG. Choose"
        in message
    )
    assert "sheet='Force'" in message
    np.testing.assert_array_equal(load_recording(path, sheet="Force").whole, X)
    nothing = book(tmp_path / "b.xlsx", Info=INFO, More=INFO)
    with pytest.raises(ValueError, match="rows of numbers or more: none"):
        load_recording(nothing)


def test_rows_of_a_sheet_keep_their_numbers(tmp_path):
    frame = trial(X).astype(object)
    frame.loc[50, "Force (N)"] = "high"
    with pandas.ExcelWriter(tmp_path / "a.xlsx") as writer:
        INFO.to_excel(writer, sheet_name="Info", index=False)
        frame.to_excel(writer, sheet_name="T1", index=False, startrow=4)
    with pytest.raises(ValueError, match=r"a\.xlsx, sheet T1, line 56: Force \(N\) 'high'"):
        load_recording(tmp_path / "a.xlsx")


@pytest.mark.parametrize("name", ["a.csv", "a.npz"])
def test_other_files_have_no_sheets(name, tmp_path):
    path = tmp_path / name
    write(tmp_path, "time,force\n" + rows(TIME, X), name) if name == "a.csv" else np.savez(path, X)
    with pytest.raises(ValueError, match=rf"sheet=1: leave it out: {name} has no sheets"):
        load_recording(path, sheet=1)


def test_analog_channels_are_named_before_points():
    """A .c3d has dozens of points."""
    names = [f"{point}_{axis}" for point in ("finger", "thumb") for axis in "xyz"]
    channels = [Channel(name, X, 100.0) for name in [*names, "EMG 1", "EMG 2"]]
    with pytest.raises(
        ValueError, match="choose one with `column`: EMG 1, EMG 2, finger_x, finger_y"
    ):
        load_recording(channels_table("trial.c3d", channels))
