"""What a file holds, found by one look at its ending and its first lines."""

import contextlib
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from jaxmuscle._common.files import expanded

from ._frequency_response import FITTED, HEADER
from ._target_csv import NAMES, column_role
from ._text_tables import TEXT, cells_of, delimiter_in, holds_text, is_number, lines_of
from .dialects._dialects import EXPORTS

Kind = Literal["recording", "spectrum", "frequency response", "study"]
BOOKS = (".xlsx", ".xlsm")
BINARY = (".mat", ".npy", ".npz", ".c3d", ".edf", ".bdf", ".tdms", ".acq", ".smr")
KINDS = (*TEXT, ".xlsx", *BINARY, ".xlsm", ".gz")
STUDY = ("file", "person")  # columns of the table of a study
LOOK = 1 << 16  # bytes of a file that say what it is
ROWS = 90  # that the shortest recording has
POINTS = 500  # more than a figure of a spectrum has
_STUDY_KEY = re.compile(rb"^[ \t]*(?:\[\[)?[ \t]*(?:table|recordings)\b", re.MULTILINE)


class FileLook(NamedTuple):
    """A `file` and its `ending` in small letters; whether it is a `text` with rows of numbers,
    whatever its ending says; what `kind` of data it holds."""

    file: Path
    ending: str
    text: bool
    kind: Kind


def look_at(path: str | os.PathLike[str]) -> FileLook:
    """What a `path` leads to; the file is read for that as far as is needed."""
    file = expanded(path)
    ending = file.suffix.lower()
    begin = b""
    # a .mat may be a text that MATLAB saved with -ascii
    if (ending in (*TEXT, ".mat", ".toml") or ending not in (*KINDS, ".json")) and file.is_file():
        with contextlib.suppress(OSError), file.open("rb") as stream:
            begin = stream.read(LOOK)
    if ending == ".toml":
        return FileLook(file, ending, False, "study" if _STUDY_KEY.search(begin) else "spectrum")
    if ending in TEXT:
        return FileLook(file, ending, True, _kind_of_text(begin, ending))
    text = holds_text(begin)
    recorded = text or ending in (*KINDS, *EXPORTS)
    return FileLook(file, ending, text, "recording" if recorded else "spectrum")


def kind_of_file(path: str | os.PathLike[str]) -> Kind:
    """What a `path` leads to, "recording", "spectrum", "frequency response" or "study", the table
    of one: by its ending, a text by its header and rows. What is no file is taken for the name of a
    spectrum.

        jm.data.kind_of_file("trial.csv")

    **Arguments:** `path` of the file, which is read for that.
    """
    return look_at(path).kind


def are_recordings(given: Sequence[Any]) -> bool:
    """Whether all of these are paths of recordings."""
    return all(
        isinstance(one, str | os.PathLike) and kind_of_file(one) == "recording" for one in given
    )


def _kind_of_text(begin: bytes, ending: str) -> Kind:
    """What a text holds, by its first rows and the cells of the first."""
    text = begin.decode("utf-8-sig", errors="replace")
    rows = [line.body for line in lines_of(text) if line.body.strip()]
    table = ending == ".csv"
    if not rows:
        return "spectrum" if table else "recording"
    delimiter = delimiter_in(rows[0])
    names = [cell.casefold() for cell in cells_of(rows[0], delimiter)]
    second = cells_of(rows[1], delimiter) if len(rows) > 1 else []
    if {*STUDY} <= {*names} or _names_files(names, second):
        return "study"
    roles = {match[1] for name in names if (match := HEADER.fullmatch(name))}
    responds = {"gain", "phase"} <= roles and not roles.isdisjoint(("frequency", "freq", "f"))
    if responds or {*FITTED} <= {*names}:
        return "frequency response"
    if all(is_number(name, delimiter) for name in names):
        return "recording" if len(rows) > (POINTS if table else ROWS) else "spectrum"
    # a column f beside a time is a force
    spectral = {column_role(name)[0] for name in names} >= {*NAMES[:2]} or any(
        name.startswith(("freq", "proportional", "power")) for name in names
    )
    if table:
        figure = {cell.casefold() for cell in second} == {"x", "y"}
        return "spectrum" if spectral or figure or len(rows) <= ROWS else "recording"
    # above the columns of a laboratory's text may stand a line "Frequency: 1000"
    spectral = spectral and len(names) > 1 and all(is_number(cell, delimiter) for cell in second)
    return "spectrum" if spectral else "recording"


def _names_files(names: Sequence[str], cells: Sequence[str]) -> bool:
    """Whether a column called file holds one, though the person may be called otherwise."""
    if STUDY[0] not in names or len(cells) != len(names):
        return False
    cell = cells[names.index(STUDY[0])]
    return Path(cell).suffix[1:].isalnum() and not is_number(cell, None)
