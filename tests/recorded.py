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
