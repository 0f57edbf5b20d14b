"""Damaged files by the hundred: small good ones of every format, mutants of them, and a reader that
outlives its crashes.

A process for each file takes a quarter of a second, most of it Python's start. Here one process
imports what is needed and forks for each file: the fork does what the process of `_apart` does,
within the same limits.
"""

import io
import json
import os
import random
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROWS = 120
SECONDS = 10
SERVE = """import json, sys
request = json.loads(sys.stdin.buffer.readline())
sys.path[:] = request["paths"]
import hostile_files
hostile_files.serve(request)"""
WORDS = (
    b"\0\0\0\0",
    b"\xff\xff\xff\xff",
    b"\xff\xff\xff\x7f",
    b"\0\0\0\x80",
    b"\x01\0\0\0",
    b"\0\0\1\0",
    b"\xff\xff\xff\xff\xff\xff\xff\x7f",
)


def signals() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {
        "force": 10 + rng.normal(size=ROWS),
        "Data": rng.normal(size=(ROWS, 3)),
        "fs": np.array(100.0),
    }


def write_mat(path: Path) -> None:
    import scipy.io

    scipy.io.savemat(path, signals() | {"trial": {"force": signals()["force"], "who": "anna"}})


def write_packed_mat(path: Path) -> None:
    import scipy.io

    scipy.io.savemat(path, signals(), do_compression=True)


def write_mat73(path: Path, add: Callable[[Any], object] = lambda file: None) -> None:
    """MATLAB's v7.3 is HDF5 behind a text of 512 bytes; `add` puts more into it."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in signals().items():
            file[name] = np.atleast_2d(values).T
        file["trial/force"] = signals()["force"][None]
        file.create_dataset("packed", data=signals()["Data"], compression="gzip")
        add(file)
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")


def write_npz(path: Path) -> None:
    np.savez_compressed(path, **signals())  # pyright: ignore[reportArgumentType]


def write_npy(path: Path) -> None:
    np.save(path, signals()["Data"])


def write_c3d(path: Path) -> None:
    import ezc3d  # pyright: ignore

    file = ezc3d.c3d()
    file["parameters"]["POINT"]["LABELS"]["value"] = ["finger"]
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["data"]["points"] = np.concatenate([signals()["Data"].T, np.ones((1, ROWS))])[:, None]
    file.write(str(path))


def write_edf(path: Path) -> None:
    import edfio

    force = edfio.EdfSignal(
        signals()["force"], 60, label="Force", physical_dimension="N", physical_range=(-20, 20)
    )
    edfio.Edf([force]).write(path)


def write_tdms(path: Path) -> None:
    import nptdms

    with nptdms.TdmsWriter(str(path)) as writer:
        writer.write_segment(
            [nptdms.ChannelObject("arm", "Force", signals()["force"], {"wf_increment": 0.01})]
        )


def write_xlsx(path: Path) -> None:
    import pandas

    pandas.DataFrame({"time": np.arange(ROWS) / 100, "force_N": signals()["force"]}).to_excel(
        path, index=False
    )


def write_program_mat(path: Path) -> None:
    """What Spike2, LabChart, AcqKnowledge and OTBioLab write, each in its part of the bytes."""
    import scipy.io

    force, cell = signals()["force"], np.empty((1, 1), object)
    cell[0, 0] = "Force[N]"
    channel = {"title": "Force", "interval": 0.01, "units": "N", "length": ROWS, "values": force}
    labchart = {"data": force, "datastart": 1, "dataend": ROWS, "titles": "F", "samplerate": 100}
    acq = {"data": force, "labels": "F", "units": "N", "isi": 10, "isi_units": "ms"}
    otb = {"Data": force, "Description": cell, "SamplingFrequency": 100.0}
    program = path.name.partition(".")[2].partition(".")[0]
    each = {"spike2": {"ch1": channel}, "labchart": labchart, "acq": acq, "otb": otb}
    scipy.io.savemat(path, each[program])


WRITERS: dict[str, Callable[[Path], None]] = {
    "mat": write_mat,
    "spike2.mat": write_program_mat,
    "labchart.mat": write_program_mat,
    "acq.mat": write_program_mat,
    "otb.mat": write_program_mat,
    "packed.mat": write_packed_mat,
    "v73.mat": write_mat73,
    "npz": write_npz,
    "npy": write_npy,
    "c3d": write_c3d,
    "edf": write_edf,
    "tdms": write_tdms,
    "xlsx": write_xlsx,
}


def mutant(data: bytes, rng: random.Random) -> bytes:
    """The bytes with one to four faults: bits flipped, bytes replaced, numbers made extreme, pieces
    lost or doubled."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        # Headers stand in front; a fault there does most.
        at = rng.randrange(min(len(changed), 512) if rng.random() < 0.4 else len(changed))
        kind = rng.randrange(6)
        if kind == 0:
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            changed[at] = rng.randrange(256)
        elif kind == 2:
            word = rng.choice(WORDS)
            changed[at : at + len(word)] = word
        elif kind == 3:
            changed[at : at + rng.randrange(1, 64)] = b""
        elif kind == 4:
            changed[at:at] = changed[at : at + rng.randrange(1, 64)]
        else:
            changed = changed[: at + 1]
        changed = changed or bytearray(1)
    return bytes(changed)


def serve(request: dict[str, Any]) -> None:
    """In the process that forks: for each file a line of how it ended and how many bytes were said,
    and these."""
    from jaxmuscle.data import _apart_child

    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # imports
    _apart_child.answer(
        {"kind": request["kind"], "path": request["good"], "most": request["most"]}, io.BytesIO()
    )
    for path in request["files"]:
        end, start = os.pipe()
        child = os.fork()
        if child == 0:
            signal.alarm(2 * SECONDS)
            with os.fdopen(start, "wb") as stream:
                _apart_child.limit(request["most"], SECONDS)
                _apart_child.answer(
                    {"kind": request["kind"], "path": path, "most": request["most"]}, stream
                )
            os._exit(0)
        os.close(start)
        with os.fdopen(end, "rb") as stream:
            said = stream.read()
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        out.write(struct.pack("<iq", code, len(said)) + said)
    out.close()


def answers(
    kind: str, good: Path, files: list[Path], most: int
) -> Iterator[tuple[Path, int, bytes]]:
    """How the reading of each file ended, and what was handed over."""
    request = {
        "paths": [str(Path(__file__).parent), *sys.path],
        "kind": kind,
        "good": str(good),
        "most": most,
        "files": list(map(str, files)),
    }
    done = subprocess.run(
        [sys.executable, "-c", SERVE],
        input=json.dumps(request).encode() + b"\n",
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    stream = io.BytesIO(done.stdout)
    for path in files:
        code, size = struct.unpack("<iq", stream.read(12))
        yield path, code, stream.read(size)


def outcome(path: Path, kind: str, code: int, said: bytes) -> str:
    """Read, or the sentence of the error; any other exception than the documented ones goes up."""
    from jaxmuscle.data._apart import _ended, understood
    from jaxmuscle.data._recording_csv import read_csv
    from jaxmuscle.data._recording_files import load_columns
    from jaxmuscle.data._recording_table import channels_table

    try:
        found = understood(
            path,
            kind,
            io.BytesIO(said),
            lambda: _ended(code, SECONDS, late=code == -signal.SIGALRM),
        )
        tables = (
            [read_csv(sheet, str(path)) for sheet in found.values()]
            if isinstance(found, dict)
            else [channels_table(str(path), found)]
        )
        for table in tables:
            load_columns(table, units="N", rate=100 if kind == ".npy" else None)
    except ValueError as error:
        return str(error)
    return ""


def _rows(*columns: Any, sign: str = "\t") -> str:
    return "".join(sign.join(map(str, row)) + "\n" for row in zip(*columns, strict=True))


TIME = np.arange(ROWS) / 500
X, Y = np.round(signals()["force"], 3), np.round(signals()["Data"][:, 0], 3)
_TEXTS = {
    "csv": "time,force_N\n" + _rows(TIME, X, sign=","),
    "labchart": (
        "Interval=\t0.002 s\nChannelTitle=\tForce\tEMG\nRange=\t100.000 N\t10.000"
        " mV\nUnitName=\tN\t*\n" + _rows(TIME, X, Y)
    ),
    "spike2": (
        '"INFORMATION"\n"trial.smr"\n\n"SUMMARY"\n"1"\t"Waveform"\t"Force"\t"'
        ' N"\t500\t500.0\t1\t0\n\n"CHANNEL"\t"1"\n"Waveform"\n"No comment"\n"Force"\n"'
        ' N"\t500\n"START"\t0.00000\t0.00200\n' + _rows(X)
    ),
    "acqknowledge": (
        "trial.acq\n2 msec/sample\n2 channels\nForce\nN\nEMG\nmV\nCH1\tCH2\t\n60\t60\t\n"
        + _rows(X, Y, [""] * ROWS)
    ),
    "diadem": (
        "#BEGINCHANNELHEADER\n200,Zeit\n202,s\n210,IMPLICIT\n240,0\n241,0.002\n#ENDCHANNELHEADER\n"
        "#BEGINCHANNELHEADER\n200,Kraft\n202,N\n210,EXPLICIT\n#ENDCHANNELHEADER\n" + _rows(X)
    ),
    "diadem beside": (
        "#BEGINCHANNELHEADER\n200,Zeit\n202,s\n210,IMPLICIT\n240,0\n241,0.002\n#ENDCHANNELHEADER\n"
        "#BEGINCHANNELHEADER\n200,Kraft\n202,N\n210,EXPLICIT\n211,values.bin\n213,CHANNEL\n214,REAL64\n220,120\n221,1\n"
        "#ENDCHANNELHEADER\n"
    ),
    "vicon": (
        "Model Outputs\n50\n,,a\nFrame,Sub Frame,X\n,,deg\n1,0,2\n2,0,3\n\nDevices\n100\n,,Plate\n"
        "Frame,Sub Frame,Fz\n,,N\n" + _rows(range(ROWS), [0] * ROWS, X, sign=",")
    ),
    "qualisys": (
        "NO_OF_FRAMES\t120\nFREQUENCY\t100\nDATA_INCLUDED\t3D\nMARKER_NAMES\ta\n" + _rows(X, Y, X)
    ),
    "trc": (
        "PathFileType\t4\t(X/Y/Z)\ta.trc\nDataRate\tCameraRate\tUnits\n100\t100\tmm\n"
        "Frame#\tTime\ta\t\t\n\t\tX1\tY1\tZ1\n\n" + _rows(range(ROWS), TIME, X, Y, X)
    ),
    "labview": (
        "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\n\t\n"
        + 2
        * (
            "Channels\t1\t\nY_Unit_Label\tN\nDelta_X\t0.002\n***End_of_Header***\t\t\n"
            "X_Value\tForce\tComment\n" + _rows([""] * ROWS, X)
        )
    ),
    "opensignals": (
        '# OpenSignals Text File Format\n# {"a": {"sensor": ["RAW"], "column": ["nSeq", "A1"],'
        ' "sampling rate": 100}}\n# EndOfHeader\n' + _rows([1, 2] * (ROWS // 2), X, [""] * ROWS)
    ),
    "trigno": (
        "Application:,Trigno Discover\nSensor (1),,Sensor (2),\n"
        "EMG 1 Time Series (s),EMG 1 (mV),EMG 1 Time Series (s),EMG 1 (mV)\n,500 Hz,,500 Hz\n"
        + _rows(TIME, X, TIME, Y, sign=",")
    ),
    "words": "Sampling rate: 500 Hz\nforce [N]\tforce [N]\n" + _rows(X, Y),
    "clock": "clock;F\n" + _rows([f"10:00:{t:06.3f}" for t in TIME], X, sign=";"),
}
TEXTS = {name: text.encode() for name, text in _TEXTS.items()}


def text_outcome(path: Path, data: bytes) -> str:
    """As `outcome`, of a text."""
    from jaxmuscle.data._recording_files import load_columns

    path.write_bytes(data)
    (path.parent / "values.bin").write_bytes(X.tobytes())
    try:
        load_columns(path, units="N")
    except ValueError as error:
        return str(error)
    return ""
