"""Damaged and hostile files: each is one sentence that names the file, whatever the library for its
format does."""

import io
import os
import random
import socket
import subprocess
import sys
import threading
import zipfile

import hostile_files
import numpy as np
import pytest
import scipy.io

import jaxmuscle as jm
from jaxmuscle._common.inputs import ALLOWED
from jaxmuscle.data import _apart
from jaxmuscle.data._recording_channels import Channel, distinct
from jaxmuscle.data._recording_files import load_recording, read_table
from jaxmuscle.data._study_table import read_study

LIBRARIES = {"c3d": "ezc3d", "edf": "edfio", "tdms": "nptdms", "xlsx": "openpyxl"}
MUTANTS = 50  # of every format; benchmarks/hostile.py reads 5000
POSIX = pytest.mark.skipif(
    os.name != "posix", reason="named pipes, devices and limits of memory are those of POSIX"
)


def one_sentence(path, error):
    """The words of an error, which is one sentence that names the file."""
    words = str(error)
    assert words.startswith(str(path)) and "\n" not in words
    return words


# --- any change


@pytest.mark.slow
@POSIX
@pytest.mark.parametrize("name", hostile_files.WRITERS)
def test_mutants_are_read_or_refused_in_one_sentence(name, tmp_path):
    if name in LIBRARIES:
        pytest.importorskip(LIBRARIES[name])
    good, kind, rng = tmp_path / f"good.{name}", "." + name.rpartition(".")[2], random.Random(3)
    hostile_files.WRITERS[name](good)
    files = [tmp_path / f"{number}{kind}" for number in range(MUTANTS)]
    for path in files:
        path.write_bytes(hostile_files.mutant(good.read_bytes(), rng))
    found = {
        path: hostile_files.outcome(path, kind, code, said)
        for path, code, said in hostile_files.answers(kind, good, [good, *files], 64 << 20)
    }
    assert found.pop(good) == ""
    for path, words in found.items():
        assert not words or one_sentence(path, words)


@pytest.mark.slow
@pytest.mark.parametrize("name", hostile_files.TEXTS)
def test_mutants_of_texts_are_read_or_refused_in_one_sentence(name, tmp_path):
    data, path, rng = hostile_files.TEXTS[name], tmp_path / "trial.txt", random.Random(4)
    assert hostile_files.text_outcome(path, data) == ""
    for _ in range(2 * MUTANTS):
        words = hostile_files.text_outcome(path, hostile_files.mutant(data, rng))
        assert "\n" not in words and (not words or words.startswith(str(tmp_path)))


# --- what a library may do: here one in place of ezc3d, found where the process that reads finds
# its modules


DOES = {
    "crashes": (
        "import os, signal; os.kill(os.getpid(), signal.SIGSEGV)",
        "its reader crashed (SIGSEGV); the file is",
    ),
    "gives up": ("import os; os.abort()", "its reader crashed (SIGABRT)"),
    "never ends": (
        "import time; time.sleep(600)",
        "its reader did not come to an end within 1 s; the file is",
    ),
    "takes all time": ("while True: pass", "its reader did not come to an end within"),
    "takes all memory": (
        "import numpy; numpy.empty(3 << 30, 'u1')",
        "it holds more than 0.25 GiB, or says so because",
    ),
    "leaves": ("import os; os._exit(7)", "its reader ended without an answer (exit code 7)"),
    "recurses": ("f = lambda: f()\n    f()", "maximum recursion depth exceeded"),
    "says many lines": ("raise RuntimeError('one\\ntwo ' + 'x' * 9999)", "one two x"),
    "prints": ("print('{}' * 99999, flush=True); raise ValueError('printed')", "printed"),
    "talks to the terminal": ("raise ValueError('a\\x1b[2Jb')", "a\N{REPLACEMENT CHARACTER}[2Jb"),
    "writes files": ("open('left', 'wb', 0).write(b'x' * 99)", "File too large"),
}


@pytest.mark.slow
@POSIX
@pytest.mark.parametrize("case", DOES)
def test_what_a_library_does_is_one_sentence(case, tmp_path, monkeypatch):
    done, message = DOES[case]
    (tmp_path / "ezc3d.py").write_text(f"def c3d(path):\n    {done}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    if "did not come to an end" in message:
        monkeypatch.setattr(_apart, "SECONDS", 0)
        monkeypatch.setattr(_apart, "EACH", 1)
    monkeypatch.setenv(ALLOWED, "0.25")
    path = tmp_path / "trial.c3d"
    path.write_bytes(b"c3d")
    with pytest.raises(ValueError) as caught:
        load_recording(path)
    words = one_sentence(path, caught.value)
    assert (
        words.startswith(f"{path}: cannot be read as .c3d: ")
        and message in words
        and len(words) < 1000
    )


def test_a_script_without_a_guard_reads_once(tmp_path):
    """Reading starts a process, which must not run the user's script again; nor is it stopped by
    threads."""
    hostile_files.write_npz(tmp_path / "trial.npz")
    (tmp_path / "script.py").write_text(
        "from pathlib import Path\nfrom jaxmuscle.data._apart import read_apart\n"
        "print(len(read_apart(Path('trial.npz'), '.npz')))\n"
    )
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "4\n"


def test_threads_read_beside_one_another(tmp_path):
    path, found = tmp_path / "trial.npz", []
    hostile_files.write_npz(path)
    threads = [
        threading.Thread(target=lambda: found.append(read_table(path).columns.keys()))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [found[0]] * 3


# --- what the process hands over is not trusted


ANSWERS = {
    "nothing": (b"", EOFError, ""),
    "no end": (b'{"channels": []', EOFError, ""),
    "no JSON": (b"\x80\x04\x95pickle\n", ValueError, "makes no sense"),
    "a list": (b"[1]\n", ValueError, "makes no sense"),
    "nested": (b"[" * 100_000 + b"\n", ValueError, "makes no sense"),
    "objects": (
        b'{"channels": [["a", "|O", 1, null, ""]]}\n' + bytes(8),
        ValueError,
        "makes no sense",
    ),
    "negative": (b'{"channels": [["a", "<f8", -1, null, ""]]}\n', ValueError, "makes no sense"),
    "huge rate": (
        b'{"channels": [["a", "<f8", 1, 1' + b"0" * 400 + b', ""]]}\n',
        ValueError,
        "makes no sense",
    ),
    "too much": (
        b'{"channels": [["a", "<f8", 99999999999, null, ""]]}\n',
        ValueError,
        "holds more than",
    ),
    "a text without end": (b'{"sheets": [["a", 1e3]]}\n', ValueError, "makes no sense"),
    "cut off": (b'{"channels": [["a", "<f8", 2, null, ""]]}\n' + bytes(9), EOFError, ""),
    "none": (b'{"channels": []}\n', ValueError, "holds no channels with numbers"),
}


@pytest.mark.parametrize("case", ANSWERS)
def test_answers_that_make_no_sense(case):
    said, kind, message = ANSWERS[case]
    with pytest.raises(kind) as caught:
        _apart.received(io.BytesIO(said), 1 << 20)
    assert message in str(caught.value)


def test_rates_and_names_of_an_answer_are_cleaned():
    said = (
        b'{"channels": [["a\\u001b", "<f8", 1, NaN, "\\udc80"], ["b", "<i2", 1, -5, "N"]]}\n'
        + bytes(10)
    )
    first, second = _apart.received(io.BytesIO(said), 1 << 20)
    assert (first.name, first.rate, first.unit) == (
        "a\N{REPLACEMENT CHARACTER}",
        None,
        "\N{REPLACEMENT CHARACTER}",
    )
    assert (second.name, second.rate, second.samples.dtype) == ("b", None, np.int16)


def test_a_channel_may_be_empty(tmp_path):
    path, nptdms = tmp_path / "trial.tdms", pytest.importorskip("nptdms")
    with nptdms.TdmsWriter(str(path)) as writer:
        empty = nptdms.ChannelObject("arm", "Empty", np.zeros(0))
        writer.write_segment(
            [nptdms.ChannelObject("arm", "Force", np.arange(3.0), {"wf_increment": 0.01}), empty]
        )
    table = read_table(path)
    assert table.columns["Empty"]().size == 0 and table.columns["Force"]().tolist() == [0, 1, 2]


# --- bombs


def zip_bomb(path):
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("force.npy", "w", force_zip64=True) as out,
    ):
        np.lib.format.write_array_header_1_0(
            out, {"descr": "<f8", "fortran_order": False, "shape": (5_000_000,)}
        )
        for _ in range(40):
            out.write(bytes(1_000_000))


def declared_npy(path):
    with path.open("wb") as out:
        np.lib.format.write_array_header_1_0(
            out, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
        )
        out.write(bytes(800))


def declared_hdf5(path):
    hostile_files.write_mat73(
        path, lambda file: file.create_dataset("a", (10**9, 1000), "<f8", chunks=(1000, 1000))
    )


def packed_mat(path):
    scipy.io.savemat(path, {"force": np.zeros(5_000_000)}, do_compression=True)


BOMBS = {
    "bomb.npz": (zip_bomb, "it holds more than 0.01 GiB"),
    "bomb.xlsx": (zip_bomb, "it holds more than 0.01 GiB"),
    "bomb.npy": (declared_npy, "it holds more than 0.01 GiB"),
    "bomb.mat": (packed_mat, "it holds more than 0.01 GiB"),
    "bomb73.mat": (declared_hdf5, "it holds more than 0.01 GiB"),
}


@pytest.mark.slow
@POSIX
@pytest.mark.parametrize("name", BOMBS)
def test_bombs(name, tmp_path, monkeypatch):
    make, message = BOMBS[name]
    if name.endswith("xlsx"):
        pytest.importorskip("openpyxl")
    path = tmp_path / name
    make(path)
    monkeypatch.setenv(ALLOWED, "0.01")
    with pytest.raises(ValueError) as caught:
        read_table(path)
    assert message in one_sentence(path, caught.value) and ALLOWED in str(caught.value)


# --- names of files


@POSIX
def test_names_of_files_that_cannot_be_printed_can_be_written(tmp_path):
    path = tmp_path / os.fsdecode(b"tri\xff\x1bal.csv")
    path.write_bytes(hostile_files.TEXTS["csv"])
    recording = load_recording(path)
    assert recording.name == "tri\N{REPLACEMENT CHARACTER}\N{REPLACEMENT CHARACTER}al"
    assert recording.name.encode() and recording.source.encode()


# --- HDF5 that points elsewhere; objects


def abroad(h5py, file, way, other):
    if way == "external link":
        file["trial/more"] = h5py.ExternalLink(str(other), "/force")
    elif way == "external storage":
        file.create_dataset("more", (64,), dtype="u1", external=[(str(other), 0, 64)])
    else:
        layout = h5py.VirtualLayout(shape=(120, 1), dtype="<f8")
        layout[:] = h5py.VirtualSource(str(other), "force", shape=(120, 1))
        file.create_virtual_dataset("more", layout)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["external link", "external storage", "virtual dataset"])
def test_hdf5_takes_nothing_from_other_files(way, tmp_path):
    h5py = pytest.importorskip("h5py")
    other, path = tmp_path / "other.mat", tmp_path / "trial.mat"
    hostile_files.write_mat73(other)
    hostile_files.write_mat73(path, lambda file: abroad(h5py, file, way, other))
    with pytest.raises(
        ValueError, match="takes its numbers from another file, which is not followed"
    ) as caught:
        read_table(path)
    assert one_sentence(path, caught.value)


def test_references_of_hdf5_may_lead_in_a_circle(tmp_path):
    h5py, path = pytest.importorskip("h5py"), tmp_path / "trial.mat"

    def circle(file):
        cell = file.create_dataset("cell", (1,), dtype=h5py.ref_dtype)
        cell[0] = cell.ref

    hostile_files.write_mat73(path, circle)
    assert set(read_table(path).columns) == {
        "force",
        "Data:0",
        "Data:1",
        "Data:2",
        "fs",
        "trial.force",
        "packed:0",
        "packed:1",
        "packed:2",
    } - {"fs"}


class Evil:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("name", ["trial.npy", "trial.npz"])
def test_nothing_is_unpickled(name, tmp_path):
    path, left = tmp_path / name, tmp_path / "left"
    save = np.save if name.endswith("npy") else np.savez
    save(path, np.array([Evil(left)], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match="Object arrays cannot be loaded") as caught:
        read_table(path)
    assert one_sentence(path, caught.value) and not left.exists()


# --- what is no file


READERS = {
    "trial.csv": load_recording,
    "trial.mat": load_recording,
    "trial.c3d": load_recording,
    "target.toml": jm.load_target,
    "spectrum.csv": jm.load_target,
    "preset.toml": jm.load_preset,
    "fit.json": jm.load_result,
    "study.csv": read_study,
    "study.toml": read_study,
    "response.csv": jm.data.load_frequency_response,
}


@POSIX
@pytest.mark.parametrize("name", READERS)
def test_pipes_sockets_devices_and_folders_are_refused_at_once(name, tmp_path):
    """A reader that opened the pipe would wait for ever."""
    path = tmp_path / name
    for make, word in (
        (os.mkfifo, "named pipe"),
        (os.mkdir, "folder"),
        (lambda p: os.symlink("/dev/zero", p), "device"),
    ):
        make(path)
        with pytest.raises(ValueError) as caught:
            READERS[name](path)
        assert f"is a {word}; give " in one_sentence(path, caught.value)
        path.rmdir() if word == "folder" else path.unlink()
    with socket.socket(socket.AF_UNIX) as bound:
        os.chdir(tmp_path)  # the names of sockets are short
        bound.bind(name)
        with pytest.raises(ValueError, match="is a socket; give "):
            READERS[name](path)


@pytest.mark.parametrize("name", READERS)
def test_sizes_are_limited_with_an_option(name, tmp_path, monkeypatch):
    path = tmp_path / name
    with path.open("wb") as file:
        file.truncate(3 << 30)  # of a sparse file, which takes no room
    with pytest.raises(ValueError) as caught:
        READERS[name](path)
    words = one_sentence(path, caught.value)
    assert (
        "has 3 GiB, more than the 2 GiB that may be read; if you trust the file, set the"
        " environment variable" in words
    )
    assert words.endswith(f"{ALLOWED} to more GiB")
    os.truncate(path, 2 << 20)
    for given, allowed in (("0.001", "0.001 GiB"), ("nonsense", ""), ("-1", "")):
        monkeypatch.setenv(ALLOWED, given)
        with pytest.raises(
            ValueError,
            match=f"more than the {allowed}" if allowed else f"{ALLOWED}={given}: give the size",
        ):
            READERS[name](path)


# --- texts


def test_a_header_of_diadem_points_to_no_other_folder(tmp_path):
    """The file of values is looked for beside the header, whatever folder the header names."""
    secret, folder = tmp_path / "values.bin", tmp_path / "trials"
    secret.write_bytes(hostile_files.X.tobytes())
    folder.mkdir()
    path = folder / "trial.dat"
    for name in ("../values.bin", str(secret), "..\\values.bin"):
        path.write_bytes(hostile_files.TEXTS["diadem beside"].replace(b"values.bin", name.encode()))
        with pytest.raises(
            ValueError, match=r"its values are in values\.bin, which is not beside it"
        ):
            load_recording(path)
    (folder / "values.bin").write_bytes(secret.read_bytes())
    np.testing.assert_array_equal(load_recording(path).whole, hostile_files.X)


TEXTS = {
    "NUL": b"time,force\n0,1\0\n",
    "a line without end": b"1," * 1_000_000,
    "a cell without end": b"time,force\n0," + b"1" * 1_000_000 + b"\n",
    "a quote without end": b'a,"' + b"x" * 300_000 + b"\n1,2\n",
    "random": bytes(random.Random(1).randbytes(5000)),
    "UTF-32": "time,force\n0,1\n".encode("utf-32"),
    "UTF-16, cut": "time,force\n0,1\n".encode("utf-16")[:-1],
    "UTF-16 without BOM": "time,force\n0,1\n".encode("utf-16-le"),
    "deep": b"[" * 100_000,
    "only quotes": b'"' * 5000,
}


@pytest.mark.parametrize("case", TEXTS)
@pytest.mark.parametrize(
    "name",
    [
        "trial.csv",
        "trial.txt",
        "spectrum.csv",
        "study.csv",
        "study.toml",
        "response.csv",
        "fig.json",
    ],
)
def test_texts_that_are_none(case, name, tmp_path):
    path = tmp_path / name
    path.write_bytes(TEXTS[case])
    reader = {"trial.txt": load_recording, "fig.json": jm.load_target}.get(name) or READERS[name]
    with pytest.raises(ValueError) as caught:
        reader(path)
    assert one_sentence(path, caught.value)


def test_channels_of_one_name_are_all_kept():
    """A format may have several channels of one name: none hides another."""
    found = distinct(
        [Channel("Force", np.zeros(2)), Channel("Force ", np.ones(2)), Channel("", np.ones(2))]
    )
    assert [channel.name for channel in found] == ["Force", "Force 1", "channel 2"]
