"""Whatever a fit may be given as its data, made a target: spectra, recordings, names and paths of
both."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxmuscle._common.errors import TargetError

from ._frequency_response import FrequencyResponse
from ._frequency_response_files import is_frequency_response, is_response, load_frequency_response
from ._perturbed import PerturbedRecording
from ._recording import Recording
from ._recording_files import KINDS, ROWS, is_text
from ._target import Target, load_target
from ._target_csv import NAMES, column_role
from ._text_tables import TEXT, beginning, cells_of, is_number
from ._trials import Trials, load_recordings
from .dialects._dialects import EXPORTS

POINTS = 500  # more than a figure of a spectrum has


def as_target(
    given: Any,
    *,
    quantity: str | None = None,
    segments: int | Sequence[int] | None = None,
    dataset: str | None = None,
    axis: str | None = None,
    lever_arm: float | int | None = None,
) -> Target:
    """The target that is meant.

        target = jm.data.as_target("vastus-lateralis-26mvc")

    `given`: a `Target` is taken as it is. A `Recording`, `Trials` or several recordings of one
    condition give theirs (`Trials.target`), in the windows that they have; a `PerturbedRecording`
    gives its own, and a `FrequencyResponse` one without a spectrum. The path of a recording, or
    several of trials, is read, and the steady part of each found (`Recording.steady`). The path of
    a frequency response is read by `load_frequency_response`. Another path, or the name of a
    bundled target, is read as a spectrum.

    **Arguments:** `quantity`, `segments`, `dataset`, `axis`, how a spectrum is read, as in
    `load_target`; `segments`, `lever_arm`, how a frequency response is read, as in
    `load_frequency_response`.

    **Raises:** `TargetError`, a `ValueError`, for anything else, with the remedy.
    """
    asked = {
        "quantity": quantity,
        "segments": segments,
        "dataset": dataset,
        "axis": axis,
        "lever_arm": lever_arm,
    }
    options = {name: value for name, value in asked.items() if value is not None}
    if isinstance(given, Target):
        _check_options(options, (), "a target")
        return given
    if isinstance(given, Recording | Trials | PerturbedRecording):
        _check_options(options, (), "a recording")
        return given.target()
    if isinstance(given, str | os.PathLike) and is_frequency_response(given):
        _check_options(options, ("segments", "lever_arm"), "a frequency response")
        given = load_frequency_response(given, **options)
    if isinstance(given, FrequencyResponse):
        return Target(given.name, None, source=given.source, stiffness=given, notices=given.notices)
    if isinstance(given, str | os.PathLike):
        if not is_recording(given):
            _check_options(options, ("quantity", "segments", "dataset", "axis"), "a spectrum")
            return load_target(given, **options)
        given = [given]
    if isinstance(given, Sequence) and len(given) > 0:
        _check_options(options, (), "a recording")
        if all(isinstance(one, Recording) for one in given):
            return Trials(given).target()
        if all(isinstance(one, str | os.PathLike) and is_recording(one) for one in given):
            return load_recordings(given).steady().target()
    raise TargetError(_remedy(given))


def _check_options(options: Mapping[str, Any], known: tuple[str, ...], what: str) -> None:
    """Refuse what does not say how this is read."""
    for name, value in options.items():
        if name not in known:
            raise TargetError(f"{name} = {value!r}: does not belong to {what}; leave it out")


def _remedy(given: Any) -> str:
    what = f"target: this is of type {type(given).__name__}; give"
    usual = (
        "a Target, the name of a bundled one, a Recording, a list of the recordings of one"
        " condition, or their paths"
    )
    if hasattr(given, "columns") and hasattr(given, "index"):
        return f"{what} a recording made of it: jaxmuscle.Recording.from_dataframe(...)"
    if hasattr(given, "shape"):
        return (
            f"target: an array of shape {given.shape} does not say what it is. Samples of a force:"
            " give jaxmuscle.Recording(samples, rate). Powers of a spectrum: give"
            " jaxmuscle.Target(name, power, segments=...)"
        )
    if isinstance(given, Sequence) and len(given) > 0:
        return (
            "target: a list holds the recordings of one condition, or their paths; spectra of"
            " several people are fitted by fit_cohort, those of one person by fit_joint"
        )
    return f"{what} {usual}"


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Whether the file at `path` holds a recording rather than a spectrum: by its ending, a text by
    its header and rows.

        jm.data.is_recording("trial.csv")

    It is read for that.
    """
    path = Path(path).expanduser()
    kind = path.suffix.lower()
    if kind not in TEXT or not path.is_file():
        return (kind in (*KINDS, *EXPORTS) and kind != ".csv") or is_text(path)
    rows, names, delimiter = beginning(path)
    if not rows:
        return kind != ".csv"
    if is_response(names):
        return False
    if all(is_number(name, delimiter) for name in names):
        return len(rows) > (POINTS if kind == ".csv" else ROWS)
    # a column f beside a time is a force
    spectral = {column_role(name)[0] for name in names} >= set(NAMES[:2]) or any(
        name.startswith(("freq", "proportional", "power")) for name in names
    )
    # above the columns of a laboratory's text may stand a line "Frequency: 1000"
    if kind != ".csv":
        return not (
            spectral
            and len(names) > 1
            and all(is_number(cell, delimiter) for cell in cells_of(rows[1], delimiter))
        )
    figure = len(rows) > 1 and set(map(str.casefold, cells_of(rows[1], delimiter))) == {"x", "y"}
    return not spectral and not figure and len(rows) > ROWS
