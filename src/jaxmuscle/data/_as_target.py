"""Whatever a fit may be given as its data, made a target: spectra, recordings, names and paths of
both."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

from jaxmuscle._common.errors import TargetError
from jaxmuscle._common.units import LEVER_ARM

from ._file_kinds import are_recordings, kind_of_file
from ._frequency_response import JOINT, FrequencyResponse
from ._frequency_response_files import load_frequency_response
from ._perturbed import PerturbedRecording
from ._recording import Recording
from ._target import Target, load_target
from ._trials import Trials, load_recordings

# which options say how it is read
OPTIONS = {
    "a spectrum": ("quantity", "segments", "dataset", "axis"),
    "a frequency response": ("segments", "lever_arm"),
}


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
    if isinstance(given, str | os.PathLike):
        kind = kind_of_file(given)
        if kind == "study":
            raise TargetError(
                f"{os.fspath(given)}: is the table of a study, with recordings of several people:"
                " give it to `jaxmuscle study` (Python: jaxmuscle.run_study)"
            )
        _check_options(options, f"a {kind}")
        if kind == "spectrum":
            return load_target(given, **options)
        given = [given] if kind == "recording" else load_frequency_response(given, **options)
    else:
        read = isinstance(given, Target | FrequencyResponse)
        _check_options(options, "a target" if read else "a recording")
    if isinstance(given, Target):
        return given
    if isinstance(given, FrequencyResponse):
        given = given.at_lever_arm(LEVER_ARM) if given.unit == JOINT else given
        return Target(given.name, None, source=given.source, stiffness=given, notices=given.notices)
    if isinstance(given, Recording | Trials | PerturbedRecording):
        return given.target()
    if isinstance(given, Sequence) and len(given) > 0:
        if all(isinstance(one, Recording) for one in given):
            return Trials(given).target()
        if are_recordings(given):
            return load_recordings(given).steady().target()
    raise TargetError(_remedy(given))


def _check_options(options: Mapping[str, Any], what: str) -> None:
    """Refuse what does not say how this is read."""
    for name, value in options.items():
        if name not in OPTIONS.get(what, ()):
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
            " several people are fitted by fit_cohort, those of one person together as {name:"
            " target}"
        )
    return f"{what} {usual}"
