"""Files that are not text are read apart: in a process of its own, whose crash or hunger is one
sentence here.

The libraries for such files are not safe from damaged ones: some end the process, some take all
memory, some never end. The process gets limits of memory and time, and hands back lines of JSON and
plain numbers; nothing is unpickled.
"""

import contextlib
import io
import json
import math
import multiprocessing.spawn
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxmuscle._common.inputs import BEYOND, looked_at, most
from jaxmuscle._common.text import printable

from ._recording_channels import TYPES, Channel

BEGIN = """import json, sys
request = json.loads(sys.stdin.buffer.readline())
sys.path[:] = request["paths"]
from jaxmuscle.data._apart_child import main
main(request)"""
SECONDS, EACH = 60, 10  # for every file, and for each MiB of it
LINE = 1 << 26  # bytes of the longest answer that is not samples
ALONE = {
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "HDF5_PLUGIN_PRELOAD": "::",
}


def read_apart(
    path: Path, kind: str, instead: str = "a recording"
) -> list[Channel] | dict[str, bytes]:
    """The channels of the file at `path`, or the sheets that it is made of, read as `kind` in a
    process of its own. `instead`, as in `looked_at`.

    **Raises:** `ValueError` naming the file, also where that process crashes, needs too much memory
    or time; `ImportError` that says what to install.
    """
    size = looked_at(path, instead=instead)
    if size == 0:
        raise ValueError(f"{path}: is empty")
    seconds = SECONDS + EACH * math.ceil(size / 2**20)
    request = {
        "path": str(path.absolute()),
        "kind": kind,
        "most": most(),
        "seconds": seconds,
        "paths": [entry for entry in sys.path if isinstance(entry, str)],
    }
    with _start(request) as (process, late):
        answer = process.stdout
        return understood(
            path, kind, answer, lambda: _ended(process.wait(), seconds, late=late.is_set())
        )


def understood(
    path: Path, kind: str, stream: io.BufferedIOBase, ended: Callable[[], str]
) -> list[Channel] | dict[str, bytes]:
    """What the process that reads the file at `path` hands over by `stream`; `ended` says why it
    ended before.

    **Raises:** as `read_apart`.
    """
    try:
        return received(stream, most())
    except ImportError as reason:
        raise ImportError(f"{path}: {reason}") from None
    except (ValueError, EOFError) as reason:
        said = ended() if isinstance(reason, EOFError) else str(reason)
        said = said.replace(f"{path.absolute()}: ", "").replace(str(path.absolute()), str(path))
        raise ValueError(f"{path}: cannot be read as {kind}: {printable(said)}") from None


@contextlib.contextmanager
def _start(request: dict[str, Any]) -> Iterator[tuple[Any, threading.Event]]:
    """The process that reads, which is gone at the end, and whether it has taken too long."""
    command = [multiprocessing.spawn.get_executable(), "-B", "-P", "-c", BEGIN]
    try:
        process: Any = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | ALONE,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),  # of Windows
        )
    except OSError as reason:
        raise ValueError(
            f"{request['path']}: cannot be read: no process can be started for it: {reason}"
        ) from None
    late = threading.Event()

    def stop() -> None:
        late.set()
        process.kill()

    clock = threading.Timer(request["seconds"], stop)
    clock.daemon = True
    clock.start()
    try:
        # it has ended already, which is seen when it is asked for the answer
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.close()
        yield process, late
    finally:
        clock.cancel()
        process.kill()
        process.wait()
        process.stdout.close()


def received(stream: io.BufferedIOBase, allowed: int) -> list[Channel] | dict[str, bytes]:
    """What the process hands over; not trusted, since the file may have taken it over.

    **Raises:** `EOFError` where it ends before it has said all; `ValueError` with the words for
    what is wrong with the file; `ImportError`.
    """
    line = stream.readline(LINE)
    if not line.endswith(b"\n"):
        raise EOFError
    try:
        head = json.loads(line)
        large, missing, wrong = head.get("large"), head.get("missing"), head.get("wrong")
        sheets = [(printable(str(name)), _count(size)) for name, size in head.get("sheets", ())]
        described = [_described(*entry) for entry in head.get("channels", ())]
        total = sum(size for _, size in sheets)
        total += sum(np.dtype(kind).itemsize * count for _, kind, count, *_ in described)
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError):
        raise ValueError("it is damaged, and the answer of its reader makes no sense") from None
    if missing is not None:
        raise ImportError(printable(str(missing)))
    if wrong is not None:
        raise ValueError(str(wrong))
    if large or total > allowed:
        raise ValueError(
            f"it holds more than {allowed / 2**30:.3g} GiB, or says so because it is"
            f" damaged{BEYOND}"
        )
    if sheets:
        return {name: _filled(stream, "|u1", size).tobytes() for name, size in sheets}
    if not described:
        raise ValueError("holds no channels with numbers")
    return [
        Channel(name, _filled(stream, kind, count), rate, unit, alias)
        for name, kind, count, rate, unit, alias in described
    ]


def _count(size: Any) -> int:
    if not isinstance(size, int) or size < 0:
        raise TypeError
    return size


def _described(
    name: Any, kind: Any, count: Any, rate: Any, unit: Any, alias: Any = ""
) -> tuple[str, str, int, float | None, str, str]:
    if kind not in TYPES:
        raise TypeError
    stated = math.nan if rate is None else float(rate)
    name, unit, alias = (printable(str(text)) for text in (name, unit, alias))
    return name, kind, _count(count), stated if 0 < stated < math.inf else None, unit, alias


def _filled(stream: io.BufferedIOBase, kind: str, count: int) -> np.ndarray:
    array = np.empty(count, kind)
    # an empty array has no view of bytes
    view = array.data.cast("B") if count else memoryview(b"")
    while len(view):
        size = stream.readinto(view)
        if not size:
            raise EOFError
        view = view[size:]
    return array


def _ended(code: int, seconds: int, *, late: bool) -> str:
    """Why the process that reads ended without an answer."""
    if late or code == -getattr(signal, "SIGXCPU", 0):
        return (
            f"its reader did not come to an end within {seconds} s; the file is damaged, or made to"
            " do this"
        )
    if code < 0:
        return f"its reader crashed ({signal.Signals(-code).name}); the file is damaged"
    return (
        f"its reader ended without an answer (exit code {code}); the file is damaged, or Python"
        " cannot be started"
    )
