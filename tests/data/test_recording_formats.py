"""Files as laboratories save them: headers of many kinds, binary formats, tables, several columns,
memory."""

import functools
import sys
import tracemalloc
import types

import numpy as np
import pandas
import pytest
import recorded
from recorded import assert_reads, refused, write

from jaxmuscle.data._recording import Recording
from jaxmuscle.data._recording_files import load_columns, load_recording
from jaxmuscle.data._recording_formats import read_acq, read_smr
from jaxmuscle.data._recording_table import channels_table

X = np.round(10 + np.random.default_rng(0).normal(size=60), 4)
EMG = np.round(np.random.default_rng(1).normal(size=60), 4)
RATE = 500
TIME = np.arange(X.size) / RATE


rows = functools.partial(recorded.rows, sign="\t")


def clock_times(form, offset=0):
    start = np.datetime64("2026-11-22T10:00:00.001", "ms") + np.timedelta64(offset, "ms")
    moments = pandas.to_datetime(start + np.arange(X.size) * np.timedelta64(2, "ms"))
    return [f"{moment:{form}}"[:-3] for moment in moments]


ZONED = [time + "Z" for time in clock_times("%Y-%m-%dT%H:%M:%S.%f")]
LABCHART = """Interval=\t0.002 s
ExcelDateTime=\t4.5352000000000000e+04\t3/1/2024 10:00:00.000
TimeFormat=\tStartOfBlock
DateFormat=\tM/d/yyyy
ChannelTitle=\tForce\tEMG
Range=\t100.000 N\t10.000 mV
"""
VALUES = "UnitName=\tN\t*\nTopValue=\t100\t10\nBottomValue=\t0\t*\n"
SPIKE2 = """"INFORMATION"
"trial.smr"
""
""

"SUMMARY"
"1"\t"Waveform"\t"Force"\t" N"\t500\t500.000\t1\t0
"31"\t"Marker"\t"Keyboard"
"2"\t"Waveform"\t"EMG"\t" mV"\t500\t500.000\t1\t0

"CHANNEL"\t"1"
"Waveform"
"No comment"
"Force"

" N"\t500
"START"\t0.00000\t0.00200
{}
"CHANNEL"\t"31"
"Marker"
"No comment"
"Keyboard"

0.12\t65\t0

"CHANNEL"\t"2"
"Waveform"
"No comment"
"EMG"
" mV"\t500
"START"\t0.00000\t0.00200
{}"""
BIOPAC = """trial.acq
2 msec/sample
2 channels
Force - DA100C
N
EMG100C
mV
"""
DIADEM = """#BEGINGLOBALHEADER
1,WINDOWS
#ENDGLOBALHEADER
#BEGINCHANNELHEADER
200,Zeit
202,s
210,IMPLICIT
240,0
241,0.002
#ENDCHANNELHEADER
#BEGINCHANNELHEADER
200,Kraft
202,N
210,EXPLICIT
#ENDCHANNELHEADER
#BEGINCHANNELHEADER
200,Weg
202,mm
210,EXPLICIT
#ENDCHANNELHEADER
"""
HEADERS = {  # content; what column is asked for, unless None; the unit found, unless N
    "LabChart": (LABCHART + VALUES + rows(TIME, X, EMG), "Force"),
    "LabChart, units of the range": (LABCHART + rows(TIME, X, EMG), "Force"),
    "LabChart without times": (LABCHART + VALUES + rows(X, EMG), "Force"),
    "LabChart, one channel": ("Interval=\t2 ms\nChannelTitle=\tForce\nRange=\t100 N\n" + rows(X),),
    "LabChart with comments": (
        LABCHART + rows(TIME, X, EMG).replace("\n", "\t#* start\n", 1),
        "Force",
    ),
    "LabChart, decimal commas": (
        LABCHART.replace("0.002", "0,002") + rows(TIME, X, EMG, comma=True),
        "Force",
    ),
    "Spike2": (SPIKE2.format(rows(X), rows(EMG)), "force"),
    "Spike2, spreadsheet": ('"Time","1 Force"\n' + rows(TIME, X, sign=","), None, "a.u."),
    "AcqKnowledge": (BIOPAC + "CH1\tCH2\t\n60\t60\t\n" + rows(X, EMG, [""] * 60), "Force - DA100C"),
    "AcqKnowledge with times": (BIOPAC + "sec\tCH1\tCH2\n\t60\t60\n" + rows(TIME, X, EMG), 1),
    "AcqKnowledge in ms": (BIOPAC + "milliSec\tCH1\tCH2\n" + rows(np.arange(60) * 2.0, X, EMG), 1),
    "AcqKnowledge, commas": (BIOPAC + "sec,CH1,CH2\n,60,60\n" + rows(TIME, X, EMG, sign=","), 1),
    "DIAdem": (DIADEM + rows(X, EMG, comma=True), "Kraft"),
    "DIAdem, csv": ("Zeit;Kraft\ns;N\n" + rows(TIME, X, sign=";", comma=True), "Kraft"),
    "row of units": ("time,force,length\ns,N,mm\n" + rows(TIME, X, EMG, sign=","), "force"),
    "row of units in ms": ("time\tforce\n[ms]\t[N]\n" + rows(np.arange(60) * 2, X),),
    "empty column": ("X_Value\tForce\tComment\n" + rows(TIME, X, [""] * 60), None, "a.u."),
    "all quoted": (
        '"time","force"\n' + rows(*([f'"{x}"' for x in column] for column in (TIME, X)), sign=","),
        None,
        "a.u.",
    ),
    "for Excel": ("sep=;\nZeit;Kraft\n" + rows(TIME, X, sign=";"), None, "a.u."),
    "words above": (
        "Subject 3, left\nknee, 60 deg\n\ntime,force\n" + rows(TIME, X, sign=","),
        None,
        "a.u.",
    ),
    "Zeit [s]": ("Zeit [s];Kraft [N]\n" + rows(TIME, X, sign=";", comma=True), "kraft"),
    "temps (ms)": ("temps (ms)\tforce (N)\n" + rows(np.arange(60) * 2, X),),
    "only a unit": ("[s]\tForce / N\n" + rows(TIME, X), "force"),
    "unknown language": ("hora (ms),fuerza (N)\n" + rows(np.arange(60) * 2, X, sign=","),),
    "Windows-1252": (
        ("Zeit [s];Stärke [N]\n" + rows(TIME, X, sign=";")).encode("cp1252"),
        "Stärke",
    ),
    "ISO times": (
        "when,force\n" + rows(clock_times("%Y-%m-%dT%H:%M:%S.%f"), X, sign=","),
        None,
        "a.u.",
    ),
    "ISO times with a zone": ("when,f_N\n" + rows(ZONED, X, sign=","),),
    "date and time": (
        "Zeit;F\n" + rows(clock_times("%d.%m.%Y %H:%M:%S.%f"), X, sign=";"),
        None,
        "a.u.",
    ),
    "time of day": ("clock\tforce\n" + rows(clock_times("%H:%M:%S.%f"), X), None, "a.u."),
    "past midnight": (
        "clock\tforce\n" + rows(clock_times("%H:%M:%S.%f", 14 * 3_600_000 - 50), X),
        None,
        "a.u.",
    ),
    "rising evenly": ("a,b\n" + rows(TIME, X, sign=","), "b", "a.u."),
    "rising evenly, no header": (rows(TIME, X), None, "a.u."),
    "force_N": ("time_s,force_N\n" + rows(TIME, X, sign=","), "force"),
    "force_pctMVC": ("time_s,force_pctMVC\n" + rows(TIME, X, sign=","), "force", "% MVC"),
    "torque_Nm": ("t_ms,torque_Nm\n" + rows(np.arange(60) * 2, X, sign=","), "torque", "N m"),
    "load cell": ("time_s,force_kg\n" + rows(TIME, X, sign=","), "force", "kgf"),
    "pounds": ("time,Force (lbs)\n" + rows(TIME, X, sign=","), "Force", "lbf"),
    "position_mm": ("time,position_mm,note\n" + rows(TIME, X, ["rest"] * 60, sign=","), None, "mm"),
}


@pytest.mark.parametrize("case", HEADERS)
def test_headers(case, tmp_path):
    content, column, unit = (*HEADERS[case], *(None, "N")[len(HEADERS[case]) - 1 :])
    recording = load_recording(write(tmp_path, content), column=column)
    np.testing.assert_array_equal(recording.whole, X)
    assert recording.rate == pytest.approx(RATE, rel=1e-9)
    assert recording.unit == unit and recording.start == 0


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("end", ["\r\n", "\r"])
def test_encodings(encoding, end, tmp_path):
    content = HEADERS["LabChart"][0].replace("\n", end)
    np.testing.assert_array_equal(
        load_recording(write(tmp_path, content.encode(encoding)), column="Force").whole, X
    )


def test_spike2_has_a_rate_for_each_channel(tmp_path):
    content = SPIKE2.replace("500.000\t1\t0\n\n", "250.5\t1\t0\n\n").format(rows(X), rows(EMG[:30]))
    path = write(tmp_path, content)
    assert load_recording(path, column="Force").rate == 500
    second = load_recording(path, column="EMG")
    assert (second.rate, second.unit, second.whole.size) == (250.5, "mV", 30)


@pytest.mark.parametrize(
    ("kind", "layout"), [("REAL64", "CHANNEL"), ("REAL32", "BLOCK"), ("ASCII", "CHANNEL")]
)
def test_diadem_with_values_beside_it(kind, layout, tmp_path):
    extra = "211,values.bin\n213,{}\n214,{}\n220,60\n221,{}\n"
    header = DIADEM
    for number, unit in ((0, "N"), (1, "mm")):
        first = number + 1 if layout == "BLOCK" else 60 * number + 1
        header = header.replace(
            f"202,{unit}\n210,EXPLICIT\n",
            f"202,{unit}\n210,EXPLICIT\n" + extra.format(layout, kind, first),
        )
    both = np.stack([X, EMG], axis=1 if layout == "BLOCK" else 0).astype(
        "<f4" if kind == "REAL32" else "<f8"
    )
    (tmp_path / "values.bin").write_bytes(
        rows(X, EMG).encode() if kind == "ASCII" else both.tobytes()
    )
    recording = load_recording(write(tmp_path, header, "trial.dat"), column="Kraft")
    # single precision
    np.testing.assert_allclose(recording.whole, X, rtol=1e-7 if kind == "REAL32" else 0)
    assert (recording.rate, recording.unit) == (500, "N")
    (tmp_path / "values.bin").unlink()
    with pytest.raises(ValueError, match=r"its values are in values\.bin, which is not beside it"):
        load_recording(tmp_path / "trial.dat", column="Kraft")


BAD = {
    "rate of nameless times": (
        rows(TIME, X),
        {"rate": 2000},
        "rate=2000 Hz contradicts the time column '0', which",
    ),
    "rate of ISO times": (
        HEADERS["ISO times"][0],
        {"rate": 2000},
        "contradicts the time column 'when', which has 500 Hz",
    ),
    "rate of Zeit": (
        HEADERS["Zeit [s]"][0],
        {"rate": 2000},
        "contradicts the time column 'Zeit [s]', which has 500 Hz",
    ),
    "rate of LabChart": (
        HEADERS["LabChart"][0],
        {"rate": 99, "column": 1},
        "contradicts the time column 'time'",
    ),
    "second block": (
        LABCHART + rows(TIME, X, EMG) * 9 + LABCHART + rows(X),
        {"column": 1},
        "line 547: 2 of 3 columns found; a second block begins there; save each block on its own",
    ),
    "names of other width": (
        "Subject 3, left\n" + rows(TIME, X, EMG, sign=","),
        {},
        "write a # before lines that",
    ),
    "number among names": (
        "time,force\nhigh,1\n" + rows(TIME, X, sign=","),
        {},
        "line 2: '1' cannot be the name",
    ),
    "damaged clock": (
        HEADERS["time of day"][0].replace("10:00:00.005", "10.00,5"),
        {},
        "line 4: clock '10.00,5' is not",
    ),
    "bar in units row": (
        "time,force\ns,bar\n" + rows(TIME, X, sign=","),
        {},
        "force: unknown unit 'bar'; give `units`",
    ),
    "time asked for": (
        "a,b\n" + rows(TIME, X, sign=","),
        {"time": "c"},
        "no time 'c'; Known: a, b",
    ),
    "no waveform": (
        '"INFORMATION"\n"a.smr"\n"SUMMARY"\n',
        {},
        "holds no waveform; export one from Spike2",
    ),
    "gap in Spike2": (
        SPIKE2.format(rows(X) + '"START"\t9\t0.002\n', rows(EMG)),
        {"column": 0},
        "line 78: Force has a gap",
    ),
    "skip_rows": (rows(X), {"skip_rows": -1}, "skip_rows=-1: give a number of lines"),
    "all skipped": (rows(X), {"skip_rows": 60}, "holds no data, only comments"),
}


@pytest.mark.parametrize("case", BAD)
def test_refused(case, tmp_path):
    content, arguments, message = BAD[case]
    with refused(message):
        load_recording(write(tmp_path, content), **arguments)


def test_time_and_skipped_rows(tmp_path):
    path = write(tmp_path, "Trial,3\nframe,clock,force\n" + rows(np.arange(60), TIME, X, sign=","))
    recording = load_recording(path, skip_rows=1, time="clock", column="force")
    np.testing.assert_array_equal(recording.whole, X)
    assert recording.rate == RATE


def test_guessed_milliseconds_need_the_rate(tmp_path):
    path = write(tmp_path, rows(TIME * 1000, X))
    recording = load_recording(path, rate=RATE)
    assert (
        recording.rate == RATE
        and "column 0 rises evenly and is taken as the time in ms" in recording.notices
    )


def test_lines_are_read_alike_quickly_and_slowly(tmp_path):
    """A cell that only the slow way understands changes nothing else: both give the same
    numbers."""
    cells = [
        *map(repr, np.random.default_rng(3).normal(size=300).tolist()),
        "1e-3",
        " 2.5 ",
        "NaN",
        "3",
    ]
    quick = load_recording(write(tmp_path, "\n".join(cells)), rate=100)
    mixed = load_recording(
        write(tmp_path, "a;b\n" + "\n".join(f"{cell};1,5" for cell in cells)), column="a", rate=100
    )
    np.testing.assert_array_equal(quick.whole, mixed.whole)


def test_all_columns(tmp_path):
    content = "time,one_N,two_N,note\n" + rows(TIME, X, EMG, ["rest"] * 60, sign=",")
    first, second = load_columns(write(tmp_path, content))
    np.testing.assert_array_equal(first.whole, X)
    np.testing.assert_array_equal(second.whole, EMG)
    assert (first.name, second.name, second.rate, second.unit) == (
        "trial one_N",
        "trial two_N",
        RATE,
        "N",
    )
    assert [r.name for r in load_columns(tmp_path / "trial.csv", ["two"])] == ["trial two_N"]
    np.savez(tmp_path / "trials.npz", Data=np.stack([X, EMG, X + EMG], axis=1), fs=200)
    assert [r.name for r in load_columns(tmp_path / "trials.npz")] == [
        f"trials Data:{i}" for i in range(3)
    ]
    assert {r.rate for r in load_columns(tmp_path / "trials.npz")} == {200}
    with pytest.raises(ValueError, match="give the names of the columns that are recordings"):
        load_columns(tmp_path / "trial.csv", [])


INDEXES = {
    "datetimes": pandas.DatetimeIndex(
        np.datetime64("2026-11-22T10:00", "ns") + np.arange(60) * np.timedelta64(2, "ms")
    ),
    "durations": pandas.TimedeltaIndex(np.arange(60) * np.timedelta64(2_000_000, "ns")),
    "seconds": pandas.Index(TIME),
    "milliseconds": pandas.Index(np.arange(60) * 2, name="time (ms)"),
}


@pytest.mark.parametrize("index", INDEXES)
def test_table_with_its_times_in_the_index(index):
    frame = pandas.DataFrame({"force_N": X, "note": "rest"}, index=INDEXES[index])
    recording = Recording.from_dataframe(frame, name="mine")
    np.testing.assert_array_equal(recording.whole, X)
    assert (recording.rate, recording.unit, recording.name) == (RATE, "N", "mine")
    with pytest.raises(ValueError, match="rate=99 Hz contradicts the time column"):
        Recording.from_dataframe(frame, rate=99)


def test_table_with_its_times_in_a_column():
    frame = pandas.DataFrame({"when": INDEXES["datetimes"], "force (N)": X, "length_mm": EMG})
    recording = Recording.from_dataframe(frame, column="force")
    assert_reads(recording, X, RATE, "N")
    assert Recording.from_dataframe(frame[["length_mm"]], rate=100).unit == "mm"
    assert Recording.from_dataframe(frame, column="length_mm", reference="force").unit == "mm"


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (X, "frame=ndarray: give a pandas DataFrame"),
        (
            pandas.DataFrame({"a": X})["a"],
            "frame=Series: give a pandas DataFrame, a single column as frame.to_frame()",
        ),
        (pandas.DataFrame(), "the table is empty"),
        (pandas.DataFrame({"a": X}), "does not state its rate"),
        (pandas.DataFrame(np.stack([X, EMG], axis=1), columns=["a", "a"]), "two columns 'a'"),
        (pandas.DataFrame({"time": TIME, "a": X, "b": X}), "choose one with `column`: a, b"),
        (
            pandas.DataFrame({"time": np.arange(60) ** 3 / 500, "a": X}),
            "is not uniform: after 0.390224 s (row 58)",
        ),
    ],
)
def test_bad_tables(frame, message):
    with refused(message):
        Recording.from_dataframe(frame)


def test_xlsx(tmp_path):
    pytest.importorskip("openpyxl")
    frame = pandas.DataFrame({"Zeit": ["s", *TIME], "Kraft": ["N", *X]})
    frame.to_excel(tmp_path / "trial.xlsx", index=False, startrow=2)
    recording = load_recording(tmp_path / "trial.xlsx")
    assert_reads(recording, X, RATE, "N")
    pandas.DataFrame({"when": INDEXES["datetimes"], "force": X}).to_excel(
        tmp_path / "dated.xlsx", index=False
    )
    assert load_recording(tmp_path / "dated.xlsx").rate == pytest.approx(RATE)
    frame.loc[5, "Kraft"] = "high"
    frame.to_excel(tmp_path / "trial.xlsx", index=False)
    with pytest.raises(ValueError, match="line 7: Kraft 'high' is not a number"):
        load_recording(tmp_path / "trial.xlsx")


@pytest.mark.parametrize(("kind", "bits"), [("edf", 16), ("bdf", 24)])
def test_edf(tmp_path, kind, bits):
    pyedflib, path = pytest.importorskip("pyedflib"), tmp_path / f"trial.{kind}"
    force, emg = np.tile(X, 50), np.tile(EMG, 10)
    with pyedflib.EdfWriter(
        str(path), 2, {"edf": pyedflib.FILETYPE_EDFPLUS, "bdf": pyedflib.FILETYPE_BDFPLUS}[kind]
    ) as writer:
        for i, (label, unit, rate, signal) in enumerate(
            (("Force", "N", 500, force), ("EMG", "mV", 100, emg))
        ):
            writer.setSignalHeader(
                i,
                pyedflib.highlevel.make_signal_header(
                    label,
                    dimension=unit,
                    sample_frequency=rate,
                    physical_min=-20,
                    physical_max=20,
                    digital_min=-(2 ** (bits - 1)),
                    digital_max=2 ** (bits - 1) - 1,
                ),
            )
            assert signal.size % rate == 0
        writer.writeSamples([force, emg])
        writer.writeAnnotation(0.5, -1, "go")  # a signal of its own in the file, which is none
    recording = load_recording(path, column="Force")
    np.testing.assert_allclose(recording.whole, force, atol=40 / 2**bits)
    assert (recording.rate, recording.unit) == (500, "N")
    assert load_recording(path, column="EMG").rate == 100


def test_tdms(tmp_path):
    nptdms, path = pytest.importorskip("nptdms"), tmp_path / "trial.tdms"
    with nptdms.TdmsWriter(str(path)) as writer:
        step = {"wf_increment": 1 / RATE}
        writer.write_segment(
            [
                nptdms.ChannelObject("arm", "Force", X, step | {"unit_string": "N"}),
                nptdms.ChannelObject("leg", "Force", EMG, step),
                nptdms.ChannelObject("leg", "note", ["a", "b"]),
            ]
        )
    recording = load_recording(path, column="arm/Force")
    assert_reads(recording, X, RATE, "N")
    assert [r.name for r in load_columns(path)] == ["trial arm/Force", "trial leg/Force"]


def test_acq(monkeypatch):
    """No library writes .acq: this is the documented part of what bioread returns."""
    channel = types.SimpleNamespace(name="Force", data=X, samples_per_second=500.0, units="Volts")
    fake = types.SimpleNamespace(read_file=lambda path: types.SimpleNamespace(channels=[channel]))
    monkeypatch.setitem(sys.modules, "bioread", fake)
    recording = load_recording(channels_table("trial.acq", read_acq("trial.acq", 0)))
    assert_reads(recording, X, 500, "V")


def test_smr(monkeypatch):
    """No library writes .smr: neo's own signals, in place of what it reads."""
    neo, quantities = pytest.importorskip("neo"), pytest.importorskip("quantities")
    signal = neo.AnalogSignal(
        np.stack([X, EMG], axis=1),
        units="N",
        sampling_rate=0.5 * quantities.kHz,
        array_annotations={"channel_names": ["Force", "Other"]},
    )
    segment = neo.Segment()
    segment.analogsignals.append(signal)
    blocks = types.SimpleNamespace(segments=[segment])
    monkeypatch.setattr(
        "neo.io.Spike2IO", lambda filename: types.SimpleNamespace(read_block=lambda lazy: blocks)
    )
    recording = load_recording(
        channels_table("trial.smr", read_smr("trial.smr", 0)), column="Force"
    )
    assert_reads(recording, X, 500, "N")
    blocks.segments.append(segment)
    with pytest.raises(ValueError, match="holds 2 stretches with gaps between"):
        read_smr("trial.smr", 0)


LIBRARIES = {
    "c3d": "ezc3d",
    "xlsx": "openpyxl",
    "edf": "edfio",
    "tdms": "nptdms",
    "acq": "bioread",
    "smr": "neo.io",
}


@pytest.mark.parametrize("kind", LIBRARIES)
def test_without_library(kind, tmp_path, monkeypatch):
    """Files are read in a process of its own, which finds modules where this one does."""
    library = LIBRARIES[kind].partition(".")[0]
    write(tmp_path, b"raise ImportError", f"{library}.py")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ImportError, match=f"needs {library}: pip install {library}"):
        load_recording(write(tmp_path, b"any", f"trial.{kind}"))


@pytest.mark.parametrize("kind", LIBRARIES)
def test_damaged_files(kind, tmp_path):
    pytest.importorskip(LIBRARIES[kind])
    with pytest.raises(ValueError, match=rf"trial\.{kind}: cannot be read as \.{kind}: "):
        load_recording(write(tmp_path, b"neither this nor that" * 99, f"trial.{kind}"))


LONG = 80_000  # rows: more than are read at once
BYTES_PER_ROW = 120


def test_memory_of_text(tmp_path):
    """What Python and NumPy allocate at most while a text is read, the text itself included."""
    force = np.round(np.resize(X, LONG), 4)
    path = write(tmp_path, "time,force_N\n" + rows(np.arange(LONG) / 2000, force, sign=","))
    np.testing.assert_array_equal(load_recording(path).whole, force)  # imports pandas, too
    tracemalloc.start()
    try:
        assert load_recording(path).rate == 2000
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most / LONG < BYTES_PER_ROW
