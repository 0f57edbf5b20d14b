"""The process that reads one file that is not text, for `_apart`: within limits, and nothing that
it holds is run.

It imports NumPy and the library for the format. Whatever that library does (crash, wait, take all
memory), it does here.
"""

import io
import json
import os
import signal
from collections.abc import Callable
from typing import Any

import numpy as np

from ._recording_channels import TYPES, Channel, TooLarge, distinct
from ._recording_formats import (
    read_acq,
    read_c3d,
    read_edf,
    read_mat,
    read_npy,
    read_npz,
    read_smr,
    read_tdms,
    read_xlsx,
)

LIBRARIES = 2 << 30  # bytes of address space that Python and the libraries take
COPIES = 2  # of what a file holds that a reader may have at once
WORDS = 300


READERS: dict[str, Callable[[str, int], list[Channel] | dict[str, bytes]]] = {
    ".xlsx": read_xlsx,
    ".xlsm": read_xlsx,
    ".mat": read_mat,
    ".npy": read_npy,
    ".npz": read_npz,
    ".c3d": read_c3d,
    ".edf": read_edf,
    ".bdf": read_edf,
    ".tdms": read_tdms,
    ".acq": read_acq,
    ".smr": read_smr,
}


def main(request: dict[str, Any]) -> None:
    """Answer on the standard output, which the libraries do not get: what they print there is
    lost."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)
        limit(request["most"], request["seconds"])
        answer(request, out)


def limit(most: int, seconds: int) -> None:
    """Limits of memory and processor time, none of files written and of core dumps; Windows has no
    such limits."""
    try:
        import resource
    except ImportError:
        return
    wanted = {
        resource.RLIMIT_AS: LIBRARIES + COPIES * most,
        resource.RLIMIT_CPU: seconds,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_FSIZE: 0,
    }
    for kind, value in wanted.items():
        highest = resource.getrlimit(kind)[1]
        value = value if highest == resource.RLIM_INFINITY else min(value, highest)
        try:
            resource.setrlimit(kind, (value, highest))
        except (ValueError, OSError):  # macOS has no limit of address space
            continue


def answer(request: dict[str, Any], out: io.BufferedIOBase) -> None:
    """One line of JSON that says what follows, or what is wrong; then the bytes of the sheets, or
    of all samples."""
    parts: list[Any] = []
    try:
        found = READERS[request["kind"]](request["path"], request["most"])
        if isinstance(found, dict):
            parts = [np.frombuffer(text, np.uint8) for text in found.values()]
            head = {"sheets": [(name, len(text)) for name, text in found.items()]}
        else:
            channels = [each._replace(samples=_plain(each.samples)) for each in distinct(found)]
            parts = [channel.samples for channel in channels]
            head = {"channels": [_described(channel) for channel in channels]}
        if sum(part.nbytes for part in parts) > request["most"]:
            raise TooLarge
        line = json.dumps(head)
    except (MemoryError, TooLarge):
        line, parts = json.dumps({"large": True}), []
    except ImportError as error:
        line, parts = json.dumps({"missing": str(error)}), []
    except Exception as error:  # damaged files make the libraries fail in any way
        words = " ".join(str(error).split()) or type(error).__name__
        line, parts = json.dumps({"wrong": words[:WORDS]}), []
    out.write(line.encode() + b"\n")
    for part in parts:
        if part.size:  # an empty array has no view of bytes
            out.write(np.ascontiguousarray(part).data.cast("B"))


def _plain(samples: Any) -> np.ndarray:
    """Samples in one of the types that are handed over."""
    array = np.asarray(samples).reshape(-1)
    little = array.dtype.newbyteorder("<")
    return array.astype(little if little.str in TYPES else float, copy=False)


def _described(channel: Channel) -> list[Any]:
    rate = None if channel.rate is None else float(channel.rate)
    samples = channel.samples
    return [channel.name, samples.dtype.str, samples.size, rate, channel.unit, channel.alias]
