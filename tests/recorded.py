"""Files of recordings as tests write them, and what is asked of a recording that was read."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def write(folder: Path, content: str | bytes, name: str = "trial.csv") -> Path:
    """A file with this text, or these bytes."""
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def rows(*columns: Iterable[Any], sign: str = ",", comma: bool = False) -> str:
    """Columns as lines; `comma`: of decimals."""
    lines = "".join(sign.join(map(str, row)) + "\n" for row in zip(*columns, strict=True))
    return lines.replace(".", ",") if comma else lines


def save_columns(path: Path, header: str, *columns: Any, fmt: str | list[str] = "%.10g") -> Path:
    """A file of text with a header, "" for none, and these columns."""
    np.savetxt(path, np.stack(columns, axis=1), fmt, ",", header=header, comments="")
    return path


def save_mat73(path: Path, variables: dict[str, Any]) -> Path:
    """As MATLAB saves with -v7.3: arrays transposed, texts as numbers, cells as references."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        refs = file.create_group("#refs#")

        def put(group: Any, name: str, value: Any) -> None:
            if isinstance(value, dict):
                inner = group.create_group(name)
                for key, each in value.items():
                    put(inner, key, each)
            elif isinstance(value, str):
                item = group.create_dataset(
                    name, data=np.array([[ord(c)] for c in value], np.uint16)
                )
                item.attrs["MATLAB_class"] = np.bytes_("char")
            elif isinstance(value, np.ndarray) and value.dtype == object:
                cells = group.create_dataset(name, value.shape[::-1], dtype=h5py.ref_dtype)
                for i, each in enumerate(value.ravel()):
                    put(refs, f"{name}{i}", each)
                    cells[np.unravel_index(i, cells.shape)] = refs[f"{name}{i}"].ref
            elif isinstance(value, np.ndarray) and value.dtype.kind == "U":
                codes = np.array(
                    [[ord(c) for c in line.ljust(value.dtype.itemsize // 4)] for line in value]
                )
                item = group.create_dataset(name, data=codes.T.astype(np.uint16))
                item.attrs["MATLAB_class"] = np.bytes_("char")
            else:
                group[name] = np.atleast_2d(np.asarray(value)).T

        for name, value in variables.items():
            put(file, name, value)
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM"
    path.write_bytes(head.ljust(512, b"\0") + path.read_bytes()[512:])
    return path


def noticed(given: Any, words: str) -> bool:
    """Whether a notice of a recording, or of whatever has notices, holds these words."""
    return any(words in notice for notice in given.notices)


def refused(words: str) -> Any:
    """What is within raises a `ValueError` with these words."""
    return pytest.raises(ValueError, match=re.escape(words))


def assert_reads(recording: Any, samples: Any, rate: float, unit: str) -> None:
    """The recording has these samples, this rate and unit."""
    np.testing.assert_array_equal(recording.whole, samples)
    assert (recording.rate, recording.unit) == (pytest.approx(rate, rel=1e-9), unit)
