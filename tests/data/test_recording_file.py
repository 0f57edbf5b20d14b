"""Recordings in files: dialects, points, gaps, every kind of file, what is refused, and the
command."""

import json
import re

import matplotlib.image
import numpy as np
import pandas
import pytest
import scipy.io
import typer
from hypothesis import given
from hypothesis import strategies as st
from recorded import (
    assert_reads,
    noticed,
    refused,
    rows,
    save_columns,
    save_mat73,
    write,
)
from typer.testing import CliRunner

from jaxmuscle.commands.analyse import analyse
from jaxmuscle.data._recording import Recording
from jaxmuscle.data._recording_files import load_recording
from jaxmuscle.data._target import load_target
from jaxmuscle.data._trials import load_recordings

X = np.round(10 + np.random.default_rng(0).normal(size=40), 3)
TIME = np.arange(X.size) / 1000


def text(*columns, header="", sign=","):
    return f"{header}\n" * bool(header) + rows(*columns, sign=sign)


DIALECTS = {
    "comma": text(TIME, X, header="time,force"),
    "semicolon": text(TIME, X, header="time;force", sign=";"),
    "decimal comma": text(TIME, X, header="time;force", sign=";").replace(".", ","),
    "tab": text(TIME, X, header="Time (s)\tForce [N]", sign="\t"),
    "tab and decimal comma": text(TIME, X, header="time\tforce", sign="\t").replace(".", ","),
    "blanks": text(TIME, X, header="time force", sign="   "),
    "milliseconds": text(np.arange(X.size), X, header="time_ms,force"),
    "comments": "# subject 3\n# knee\n" + text(TIME, X, header="t,force  # names") + "\n# end\n",
    "savetxt": text(TIME, X, header="# t force", sign=" "),
    "no header": text(TIME, X),
    "windows": "\ufeff" + text(TIME, X, header='"time","force"').replace("\n", "\r\n"),
    "trailing comma": text(TIME, X, [""] * X.size, header="time,force,"),
    "trailing comma here and there": (
        "time,force\n"
        + "".join(
            f"{t:.6f},{x:.9f}{',' * (i % 2)}\n"
            for i, (t, x) in enumerate(zip(TIME, X, strict=True))
        )
    ),
    "more columns": text(TIME, X, X + 1, ["a"] * X.size, header="time,force,torque,note"),
}


@pytest.mark.parametrize("case", DIALECTS)
def test_dialects(case, tmp_path):
    column = "force" if case == "more columns" else None
    recording = load_recording(write(tmp_path, DIALECTS[case]), column=column)
    np.testing.assert_array_equal(recording.whole, X)
    unit = "N" if "[N]" in DIALECTS[case] else "a.u."  # which no other of these states
    assert (recording.rate, recording.unit, recording.name) == (1000.0, unit, "trial")
    assert recording.quantity == "force"


def test_coarse_times_are_no_jitter(tmp_path):
    time = np.round(np.arange(5000) / 2048, 3)
    path = write(tmp_path, text(time, np.resize(X, time.size), header="time,force"))
    assert load_recording(path).rate == pytest.approx(2048, rel=1e-3)
    assert load_recording(path, rate=2048).rate == 2048


@pytest.mark.parametrize("column", ["force", "FORCE", "Force (N)", 1, "1", -2])
def test_ways_to_name_a_column(column, tmp_path):
    path = write(tmp_path, text(TIME, X, X + 1, header="time,Force (N),torque (Nm)"))
    recording = load_recording(path, column=column)
    np.testing.assert_array_equal(recording.whole, X)
    assert load_recording(path, column="torque").quantity == "torque"


@pytest.mark.parametrize(
    "header",
    ["Time (s),Force (N),EMG_VL (mV),Trigger", "time,emg,Kraft,trigger", "time,a [mV],b [N],c"],
)
def test_the_only_column_of_force_is_found(header, tmp_path):
    """By its unit, else by its name; and said."""
    n = 500
    columns = np.stack(
        [np.arange(n) / 100, *np.random.default_rng(1).standard_normal((3, n))], axis=1
    )
    at = next(
        i
        for i, name in enumerate(header.split(","))
        if "N)" in name or "N]" in name or name == "Kraft"
    )
    path = tmp_path / "trial.csv"
    save_columns(path, header, *columns.T)
    found = load_recording(path, units="N")
    np.testing.assert_allclose(found.samples, columns[:, at], rtol=1e-8)
    assert any(notice.startswith("column ") and "taken, of " in notice for notice in found.notices)


def test_a_moved_insertion_beside_the_force_is_spoken_of(tmp_path):
    columns = np.stack(
        [np.arange(500) / 100, *np.random.default_rng(1).standard_normal((2, 500))], axis=1
    )
    for name, told in (("displacement (mm)", True), ("angle (deg)", True), ("EMG (mV)", False)):
        path = tmp_path / "moved.csv"
        save_columns(path, f"time,force (N),{name}", *columns.T)
        notices = " ".join(load_recording(path).notices)
        assert ("If a motor moved the muscle" in notices and "--displacement" in notices) == told


def test_several_columns_of_force_are_not_chosen_between(tmp_path):
    counts = np.arange(500)
    path = save_columns(
        tmp_path / "trial.csv", "time,Fx (N),Fy (N),Fz (N)", counts / 100, counts, counts, counts
    )
    with pytest.raises(ValueError, match="holds 3 columns besides the time; choose one"):
        load_recording(path)


def test_reference_is_subtracted(tmp_path):
    path = write(tmp_path, text(TIME, X, X**2, header="time,a,b"))
    np.testing.assert_array_equal(load_recording(path, column="a", reference="b").whole, X - X**2)


def test_rate_and_unit(tmp_path):
    path = write(tmp_path, text(X))
    assert load_recording(path, rate=2000, units="Nm").unit == "N m"
    (notice,) = load_recording(path, rate=2000).notices
    assert notice.startswith("no unit stated: numbers are relative to the mean")
    path = write(tmp_path, text(7 + TIME, X, header="time,force (N)"))
    assert load_recording(path).notices == (
        "the time column begins at 7 s; here times count from the first sample",
    )
    assert "unit mN as asked; the file says N" in load_recording(path, units="mN").notices
    counted = write(tmp_path, text(np.arange(X.size), X))
    assert load_recording(counted, column=1, rate=500).rate == 500


XYZ = np.random.default_rng(1).normal(size=(X.size, 3)) + np.array([0, 5, 10])
STAND = np.random.default_rng(2).normal(size=(X.size, 3))
NAMES = [f"{point}_{axis}" for point in ("finger", "stand") for axis in "xyz"]


@pytest.mark.parametrize(
    "suffixes", [("_x", "_y", "_z"), (".X", ".Y", ".Z"), (":0", ":1", ":2"), (" X", " Y", " Z")]
)
def test_points(suffixes, tmp_path):
    header = ",".join(
        ["time"] + [point + suffix for point in ("finger", "stand") for suffix in suffixes]
    )
    path = write(tmp_path, text(TIME, *XYZ.T, *STAND.T, header=header))
    for axis in range(3):
        one = load_recording(path, column="finger", axis="xyz"[axis], reference="stand", units="mm")
        np.testing.assert_array_equal(one.whole, XYZ[:, axis] - STAND[:, axis])
    assert one.quantity == "displacement"
    assert "point finger, axis z, minus stand" in one.source


def test_principal_axis(tmp_path):
    along = np.array([0.6, 0.0, -0.8])
    path = write(
        tmp_path, text(TIME, *(np.outer(X, along) + 1e-3 * XYZ).T, header="time,f_x,f_y,f_z")
    )
    principal = load_recording(path, axis="principal", units="mm").whole
    # The direction turns by about 1e-3, the ratio of the other motion to this one.
    np.testing.assert_allclose(principal - principal.mean(), -(X - X.mean()), atol=1e-2)


def test_short_gaps_are_closed_and_ends_cut(tmp_path):
    cells = [str(x) for x in X]
    cells[0], cells[5], cells[6], cells[20] = "NaN", "", "n/a", "nan"
    recording = load_recording(write(tmp_path, text(TIME, cells, header="time,force (N)")))
    expected = X.copy()
    expected[5:7] = X[4] + (X[7] - X[4]) * np.array([1, 2]) / 3
    expected[20] = (X[19] + X[21]) / 2
    np.testing.assert_allclose(recording.whole, expected[1:], rtol=1e-14)
    assert recording.start == 0.001
    assert recording.notices == (
        "1 samples without a number at the ends cut off (0.001 s)",
        "2 gaps (3 samples, longest 0.002 s) closed by straight lines",
    )


def test_longest_gap_is_an_argument(tmp_path):
    cells = [str(x) for x in X[:30]]
    cells[10:14] = [""] * 4
    path = write(tmp_path, text(np.arange(30) / 50, cells, header="time,force"))
    assert load_recording(path, max_gap=0.2).whole.size == 30
    with pytest.raises(ValueError, match=r"gaps longer than max_gap=0.05 s at 0.200 s to 0.280 s"):
        load_recording(path, max_gap=0.05)


EVERYWHERE = [
    {"outliers": "mask"},
    {"baseline": (0, 1)},
    {"units": "mN"},
    {"detrend": True},
    {"lever_arm": 0.1, "units": "N m"},
    {"time": "none", "rate": 50},
]


@pytest.mark.parametrize("options", EVERYWHERE)
def test_every_way_to_read_takes_the_options(options, tmp_path):
    """A path, several, one file of trials, a table in memory."""
    time, x = np.arange(300) / 100, np.round(40 + np.random.default_rng(3).normal(size=300), 4)
    x[200] = -9999
    path = save_columns(tmp_path / "trial.csv", "time_s,force_N", time, x)
    wanted = load_recording(path, **options)
    frame = pandas.DataFrame({"time_s": time, "force_N": x})
    for found in (
        load_recordings([path], **options)[0],
        load_recordings(path, **options)[0],
        Recording.from_dataframe(frame, **options),
    ):
        np.testing.assert_array_equal(found.whole, wanted.whole)
        assert (found.rate, found.unit, found.detrend) == (wanted.rate, wanted.unit, wanted.detrend)
        assert found.notices == wanted.notices


def arrays(folder, kind):
    """A file with a table, a struct, a time, a rate and a text, as the kind has them."""
    table, path = np.stack([X, X + 1, X + 2, X + 3], axis=1), folder / f"trial.{kind}"
    flat = {"Data": table, "force": X, "fs": 1000.0, "note": "text"}
    if kind == "npz":
        np.savez(path, **flat)
    elif kind == "mat":
        cell = np.empty((1, 1), object)
        cell[0, 0] = table
        scipy.io.savemat(path, flat | {"Cell": cell, "trial": {"force": X}, "Time": TIME})
    return path


ARRAYS = [("npz", name) for name in ("force", "Data:0", "Data:-4")]
ARRAYS += [("mat", name) for name in ("force", "Data:0", "Cell:0", "trial.force")]


@pytest.mark.parametrize(("kind", "column"), ARRAYS)
def test_arrays(kind, column, tmp_path):
    recording = load_recording(arrays(tmp_path, kind), column=column)
    np.testing.assert_array_equal(recording.whole, X)
    assert recording.rate == 1000


def test_stated_rate_gives_way(tmp_path):
    recording = load_recording(arrays(tmp_path, "npz"), column="force", rate=500)
    assert (
        recording.rate == 500
        and "rate 500 Hz as asked; the file states 1000 Hz" in recording.notices
    )


@pytest.mark.parametrize("shape", [(-1,), (-1, 1), (1, -1)])
def test_npy(shape, tmp_path):
    np.save(tmp_path / "a.npy", X.reshape(shape))
    np.testing.assert_array_equal(load_recording(tmp_path / "a.npy", rate=100).whole, X)
    np.save(tmp_path / "b.npy", XYZ)
    np.testing.assert_array_equal(
        load_recording(tmp_path / "b.npy", column=1, rate=100).whole, XYZ[:, 1]
    )
    np.testing.assert_array_equal(
        load_recording(tmp_path / "b.npy", axis="z", rate=100, units="m").whole, XYZ[:, 2]
    )


def test_mat_in_version_73(tmp_path):
    cell = np.empty((1, 1), object)
    cell[0, 0] = X[:, None]
    path = save_mat73(
        tmp_path / "trial.mat",
        {
            "Data": np.stack([X, X + 1], axis=1),
            "fs": 1000.0,
            "trial": {"force": X},
            "Cell": cell,
            "note": "AB",
        },
    )
    for column in ("Data:0", "trial.force", "Cell"):
        assert_reads(load_recording(path, column=column), X, 1000, "a.u.")
    with pytest.raises(ValueError, match=r"Known: Cell, Data:0 to Data:1, trial\.force"):
        load_recording(path, column="note")


def test_c3d(tmp_path):
    """As the library writes it, in single precision: a negative residual is a gap, analog channels
    have their own rate."""
    ezc3d = pytest.importorskip("ezc3d")
    file, path = ezc3d.c3d(), tmp_path / "trial.c3d"
    for group, labels, rate, units in (
        ("POINT", ["finger", "stand"], 100.0, ["mm"]),
        ("ANALOG", ["Fz", ""], 1000.0, ["N", ""]),
    ):
        for key, value in (("LABELS", labels), ("RATE", [rate]), ("UNITS", units)):
            file["parameters"][group][key]["value"] = value
    ones, force = np.ones((1, X.size)), np.arange(10.0 * X.size)
    file["data"]["points"] = np.stack([np.r_[XYZ.T, ones], np.r_[STAND.T, ones]], axis=1)
    file["data"]["meta_points"]["residuals"] = np.zeros((1, 2, X.size))
    file["data"]["meta_points"]["residuals"][0, 0, 7] = -1
    file["data"]["analogs"] = np.stack([force, force + 1])[None]
    file.write(str(path))
    recording = load_recording(path, column="finger", axis="y", reference="stand")
    expected = XYZ[:, 1] - STAND[:, 1]
    expected[7] = (expected[6] + expected[8]) / 2
    np.testing.assert_allclose(recording.whole, expected, atol=1e-5)
    assert (recording.rate, recording.unit) == (100.0, "mm")
    assert recording.notices == ("1 gap (1 samples, longest 0.01 s) closed by straight lines",)
    assert_reads(load_recording(path, column="Fz"), force, 1000.0, "N")
    assert_reads(load_recording(path, column="channel 1", units="N"), force + 1, 1000.0, "N")


H = "time,force\n"
ROWS = text(TIME, X)
HOLE = text(TIME / 0.1, [*map(str, X[:10]), *[""] * 25, *map(str, X[35:])], header="time,force")
POINT = text(TIME, *XYZ.T, *STAND.T, header="time," + ",".join(NAMES))
TWO = text(X, X + 1, header="force,torque")
BAD = {
    "empty": ("", {}, "trial.csv: is empty"),
    "blank": (" \n \n", {}, "trial.csv: is empty"),
    "comments only": ("# a\n", {}, "holds no data, only comments"),
    "header only": (H, {}, "holds a header (line 1) but no data"),
    "binary": (b"\x89PNG\r\n\x1a\n\0\0", {}, "is not UTF-8 text"),
    "zeros": (b"1\n\0\n", {}, "is not UTF-8 text"),
    "text in column": (
        H + "0,1\n# c\n0.001,high\n",
        {},
        "line 4: force 'high' is not a number; leave it empty",
    ),
    "text in time": (H + "0,1\n12:01,2\n", {}, "line 3: time '12:01' is not a number"),
    "underscore": (H + "0,1\n0.001,1_000\n", {}, "line 3: force '1_000' is not a number"),
    "infinite": (H + "0,1\n0.001,inf\n", {}, "line 3: force is infinite"),
    "ragged": (H + "0,1\n0.001\n", {}, "line 3: 1 of 2 columns found"),
    "decimal commas": (
        H + "0,0,1,5\n0,1,2,5\n",
        {},
        "line 2: 4 of 2 columns found; decimal commas need",
    ),
    "preamble": (
        "Subject 3, knee\n" + ROWS.replace(",", ",5,"),
        {},
        "line 2: 3 of 2 columns found; decimal commas need",
    ),
    "column twice": (
        "force,force\n1,2\n3,4\n",
        {"rate": 100},
        "choose one with `column`: force, force 2",
    ),
    "no rate": (text(X), {}, "does not state its rate (no time column found); give `rate` in Hz"),
    "rate zero": (text(X), {"rate": 0}, "rate=0: give samples per second [Hz], above 0"),
    "rate low": (
        text(X),
        {"rate": 9},
        "rate=9.0: too slow: half of it lies below what is to be seen of a force",
    ),
    "rate contradicts": (
        H + ROWS,
        {"rate": 2048},
        "rate=2048 Hz contradicts the time column 'time', which has 1000 Hz",
    ),
    "seconds or not": (
        text(np.arange(40), X, header="time,force"),
        {},
        "times look like ms or row numbers (40 rows",
    ),
    "time beyond all": (
        H + "1e400,1\n0.001,2\n0.002,3\n",
        {},
        "line 2: time column 'time' holds no number",
    ),
    "time nearly so": (
        H + "0,1\n0.001,2\n1e308,3\n",
        {},
        "is not uniform: after 0.001 s (line 3) comes 1e+308 s",
    ),
    "open quotation": (
        H + ROWS + '"0.040,1\n',
        {},
        "line 42: 1 of 2 columns found; a quotation mark",
    ),
    "time backwards": (
        H + "0,1\n0.002,2\n0.001,3\n",
        {},
        "line 4: time column 'time' runs backwards",
    ),
    "time missing": (H + "0,1\n,2\n0.002,3\n", {}, "line 3: time column 'time' holds no number"),
    "time stands": (H + "1,1\n1,2\n", {}, "time column 'time' stands still at 1"),
    "unknown column": (
        H + ROWS,
        {"column": "forse"},
        "no column 'forse'; did you mean 'force'? Known: time, force",
    ),
    "column number": (H + ROWS, {"column": 7}, "no column 7; Known: time, force"),
    "time as column": (
        H + ROWS,
        {"column": "time"},
        "column 'time' is the time; choose one of force",
    ),
    "which column": (
        TWO,
        {"rate": 100},
        "holds 2 columns besides the time; choose one with `column`: force, torque",
    ),
    "constant": (text(X * 0 + 3), {"rate": 100}, "column 0: samples: constant at 3"),
    "all empty": (
        text(TIME, [""] * 40, header="time,force"),
        {"column": 1},
        "holds no number, only gaps",
    ),
    "long gap": (
        HOLE,
        {},
        "gaps longer than max_gap=0.2 s at 0.100 s to 0.350 s; cut the recording there",
    ),
    "unit": (text(X), {"rate": 100, "units": "psi"}, "units='psi': known are N, mN"),
    "unit in header": (
        text(X, header="force (bar)"),
        {"rate": 100},
        "unknown unit 'bar'; give `units`",
    ),
    "axis": (POINT, {"axis": "w"}, "axis='w': choose one of x, y, z, principal"),
    "axis left out": (
        POINT,
        {"column": "finger"},
        "column='finger' is a point of three columns; give axis",
    ),
    "which point": (
        POINT,
        {"axis": "x"},
        "holds 2 points; choose one with `column`: finger, stand",
    ),
    "no point": (
        POINT,
        {"column": "thumb", "axis": "x"},
        "needs a point, three columns as thumb_x, thumb_y, thumb_z",
    ),
    "no reference": (
        POINT,
        {"column": "finger", "axis": "x", "reference": "base"},
        "no point 'base' as reference",
    ),
    "point unit": (
        POINT,
        {"column": "finger", "axis": "x"},
        "does not say in which unit finger is; give `units`",
    ),
    "reference": (
        TWO,
        {"rate": 100, "reference": "torq"},
        "no reference 'torq'; did you mean 'torque'?",
    ),
    "max_gap": (text(X), {"rate": 100, "max_gap": -1}, "max_gap=-1: give a time in s"),
}


@pytest.mark.parametrize(("unit", "scale"), [("Nm", 1.0), ("Ncm", 1e-2), ("Nmm", 1e-3)])
def test_a_torque_over_its_lever_arm_is_a_force(tmp_path, unit, scale):
    path = write(tmp_path, text(TIME, X, header=f"time,torque ({unit})"))
    torque, force = load_recording(path), load_recording(path, lever_arm=0.25)
    assert torque.quantity == "torque" and force.unit == "N" and force.quantity == "force"
    np.testing.assert_allclose(force.whole, scale * torque.whole / 0.25, rtol=1e-12)
    assert noticed(force, "divided by the lever arm of 0.25 m: a force in N")
    (trial,) = load_recordings([path], lever_arm=0.25)
    assert trial.unit == "N" and np.array_equal(trial.whole, force.whole)
    with pytest.raises(
        ValueError, match=r"trial.csv: lever_arm=-1: .*give the distance from the axis"
    ):
        load_recording(path, lever_arm=-1)


@pytest.mark.parametrize("case", BAD)
def test_bad_text(case, tmp_path):
    content, arguments, message = BAD[case]
    with refused(message) as caught:
        load_recording(write(tmp_path, content), **arguments)
    if not case.startswith(("axis", "rate zero", "max_gap", "unit")) or case == "axis left out":
        assert str(tmp_path / "trial.csv") in str(caught.value)


BAD_FILES = {
    "missing": ("nowhere.csv", "nowhere.csv: no such file"),
    "folder": (".", "is a folder"),
    "kind": (
        "trial.xls",
        "a recording is one of .csv, .tsv, .txt, .dat, .asc, .xlsx, .mat, .npy, .npz, .c3d",
    ),
    "no kind": ("trial", "not one without ending"),
    "empty": ("empty.mat", "empty.mat: is empty"),
    "no mat": ("bad.mat", "bad.mat: cannot be read as .mat: "),
    "no npy": ("bad.npy", "bad.npy: cannot be read as .npy: "),
    "no npz": ("bad.npz", "bad.npz: cannot be read as .npz: "),
    "objects": ("object.npy", "cannot be read as .npy: Object arrays cannot be loaded"),
    "no numbers": (
        "words.npy",
        "cannot be read as .npy: holds no numbers in one or two dimensions",
    ),
    "table": ("table.npz", "column='a' has several columns; choose one, as a:0"),
    "beyond": ("table.npz", "no column 'a:4'; did you mean 'a:3'? Known: a:0 to a:3"),
    "infinite": ("infinite.npy", "sample 1: 0 is infinite"),
    "lengths": ("lengths.npz", "reference='b' has 30 samples, the column 40"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("trial.xls", "trial", "bad.mat", "bad.npy", "bad.npz"):
        write(tmp_path, b"neither this nor that", name)
    write(tmp_path, b"", "empty.mat")
    np.save("object.npy", np.array([{}, 1], object))
    np.save("words.npy", np.array(["a", "b"]))
    np.save("infinite.npy", np.array([1, np.inf, 2]))
    np.savez("table.npz", a=np.outer(X, [1, 2, 3, 4]))
    np.savez("lengths.npz", a=X, b=X[:30])
    name, message = BAD_FILES[case]
    choice = {
        "table": {"column": "a"},
        "beyond": {"column": "a:4"},
        "lengths": {"column": "a", "reference": "b"},
    }
    with refused(message):
        load_recording(name, rate=100, **choice.get(case, {}))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("#BEGINCHANNELHEADER\n200,force\n1\n2\n", "no #ENDCHANNELHEADER; save the file again"),
        (
            "#BEGINCHANNELHEADER\n200,force\n211,trial.csv\n#ENDCHANNELHEADER\n1\n2\n",
            "names the file itself for the values",
        ),
    ],
)
def test_a_header_of_channels_that_leads_nowhere(content, message, tmp_path):
    with pytest.raises(ValueError, match=f"trial.csv: its header.*{message}"):
        load_recording(write(tmp_path, content), rate=100)


SIGNS = ",;\t \n\r.0123456789eE-+naNif#\"'_tm:force()x"


@given(
    content=st.text(SIGNS, max_size=120) | st.binary(max_size=60),
    rate=st.sampled_from([None, 100.0]),
)
def test_any_text_gives_a_recording_or_a_message(content, rate, tmp_path_factory):
    path = write(tmp_path_factory.mktemp("any"), content)
    try:
        recording = load_recording(path, rate=rate)
    except (ValueError, OSError) as error:
        assert "trial.csv" in str(error)
    else:
        assert isinstance(recording, Recording) and np.all(np.isfinite(recording.whole))


VALUES = st.lists(st.floats(-1e12, 1e12), min_size=2, max_size=50).filter(
    lambda v: np.ptp(v) > 1e-9 * np.max(np.abs(v))
)


@given(
    values=VALUES,
    sign=st.sampled_from([",", ";", "\t"]),
    header=st.booleans(),
    comma=st.booleans(),
    timed=st.booleans(),
)
def test_values_come_back_exactly(values, sign, header, comma, timed, tmp_path_factory):
    rows = ([np.arange(len(values)) / 250, values] if timed else [values]) if header else [values]
    body = text(*[[repr(float(value)) for value in row] for row in rows], sign=sign)
    body = body.replace(".", ",") if comma and sign != "," and len(rows) > 1 else body
    path = write(
        tmp_path_factory.mktemp("exact"),
        (sign.join(["time", "force"][-len(rows) :]) + "\n") * header + body,
    )
    recording = load_recording(path, rate=None if len(rows) > 1 else 250)
    np.testing.assert_array_equal(recording.whole, values)
    assert recording.rate == 250


def run(*arguments):
    app = typer.Typer()
    app.command()(analyse)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def trial(folder):
    rng = np.random.default_rng(5)
    t = np.arange(20 * 200) / 200
    force = 50 * np.clip(np.minimum(t - 1, 19 - t) / 2, 0.02, 1) + 0.3 * np.convolve(
        rng.normal(size=t.size), np.ones(20) / 4, "same"
    )
    return write(folder, text(t, force.round(5), header="time,force (N)"))


@pytest.mark.usefixtures("as_fine_as_shipped")
def test_command(tmp_path):
    path, out = trial(tmp_path), tmp_path / "out"
    done = run(
        path,
        "--column",
        "force",
        "--window",
        "4:16",
        "--out",
        out,
        "--save-target",
        tmp_path / "held.toml",
    )
    assert done.exit_code == 0, done.output
    assert re.search(r"window \(s\)[ │]+12\.00\b", done.output) and re.search(
        r"Welch segments[ │]+8\b", done.output
    )
    assert {file.name for file in out.iterdir()} == {
        "analysis.json",
        "analysis.png",
        "spectrum.csv",
    }
    saved, record = (
        load_target(tmp_path / "held.toml"),
        json.loads((out / "analysis.json").read_text()),
    )
    held = load_recording(path, column="force").steady((4, 16))
    np.testing.assert_allclose(
        saved.proportional_power, held.target().proportional_power, rtol=1e-12
    )
    np.testing.assert_allclose(record["spectrum"]["power"], held.spectrum().power, rtol=1e-12)
    assert (
        record["recording"]["window"] == [4.0, 16.0]
        and record["summary"] == held.summary().to_dict()
    )
    assert (saved.name, saved.provenance) == ("held", "measured")
    assert matplotlib.image.imread(out / "analysis.png").shape[1] == 4.4 * 300
    found = run(path, "--out", out, "--force", "--json", "--format", "pdf", "--format", "svg")
    assert found.exit_code == 0 and "found automatically" in found.stderr
    assert json.loads(found.stdout) == json.loads((out / "analysis.json").read_text()) != record
    assert {file.name for file in out.iterdir()} == {
        "analysis.json",
        "analysis.pdf",
        "analysis.svg",
        "spectrum.csv",
    }
    options = "--out", out, "--force", "--format", "svg", "--save-target", tmp_path / "slow.toml"
    slow = run(path, "--window", "4:16", "--spectrum", "slow", *options)
    assert slow.exit_code == 0 and re.search(r"Welch segments[ │]+1\b", slow.output)
    assert load_target(tmp_path / "slow.toml") == held.target("slow", settings="slow")
    assert json.loads((out / "analysis.json").read_text())["settings"]["length"] == 1000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--window", "8-9"), "--window 8-9: give start and end in s"),
        (("--window", "1:2"), "Welch segments needed"),
        (("--column", "forse"), "did you mean 'force (N)'"),
        (("--rate", "2048"), "--rate 2048 Hz contradicts the time column"),
        (("--rate", "0"), "--rate 0.0: give samples per second"),
        (("--axis", "w"), "--axis 'w': choose one of"),
        (("--max-gap", "-1"), "--max-gap -1.0: give a time in s"),
        (("--skip-rows", "9999"), "holds no data"),
        (("--time", "clock"), "no time 'clock'"),
        (("--units", "psi"), "--units 'psi': known are"),
        (("--save-target", "held.csv"), "a target is saved as TOML"),
    ],
)
def test_command_exits_with_2_and_one_line(arguments, message, tmp_path):
    done = run(trial(tmp_path), "--out", tmp_path / "out", *arguments)
    assert done.exit_code == 2
    assert message in " ".join(done.output.split()) and "Traceback" not in done.output


def test_command_without_ezc3d(tmp_path, monkeypatch):
    write(tmp_path, b"raise ImportError", "ezc3d.py")
    monkeypatch.syspath_prepend(tmp_path)
    done = run(write(tmp_path, b"c3d", "trial.c3d"), "--out", tmp_path / "out")
    assert done.exit_code == 2 and "pip install ezc3d" in " ".join(done.output.split())
