"""Recordings in commands: the options with which they are read, the same for every command that does."""

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jaxmuscle as jm

from .options import PERTURBED, READING

if TYPE_CHECKING:
    from jaxmuscle import PerturbedRecording, Trials


def reads_recordings(command: Callable[..., None], options: Mapping[str, tuple[Any, Any]] = READING) -> Callable[..., None]:
    """Give a command options, by default those of `READING`; it gets their values together, as its argument `reading`.

    An option of that name which the command has itself serves both.
    """

    @functools.wraps(command)
    def with_options(**given: Any) -> None:
        reading = {name: given.get(name) for name in options}
        command(**{name: value for name, value in given.items() if name in kept}, reading=reading)

    signature = inspect.signature(command)
    own = [parameter for name, parameter in signature.parameters.items() if name != "reading"]
    kept = {parameter.name for parameter in own}
    keyword = inspect.Parameter.KEYWORD_ONLY
    added = [inspect.Parameter(name, keyword, default=default, annotation=annotation)
             for name, (annotation, default) in options.items() if name not in kept]  # fmt: skip
    parameters = [parameter.replace(kind=keyword) for parameter in own] + added
    setattr(with_options, "__signature__", signature.replace(parameters=parameters))  # noqa: B010
    with_options.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_options


def reads_perturbed(command: Callable[..., None]) -> Callable[..., None]:
    """The same with the options of `PERTURBED` as well."""
    return reads_recordings(command, READING | PERTURBED)


def perturbed(reading: dict[str, Any]) -> bool:
    """Whether the options name the two channels of a perturbation experiment."""
    return reading["force_column"] is not None or reading["displacement"] is not None


def moved(paths: Sequence[str], reading: dict[str, Any], task: str | None) -> bool:
    """Whether files are to be fitted as perturbation experiments: by the options, else by the task and their columns."""
    if perturbed(reading):
        return True
    if task not in (None, "prescribed-length") or reading["column"] is not None:
        return False
    return all(channels(path, reading) for path in paths)


def channels(path: str, reading: dict[str, Any]) -> dict[str, Any]:
    """The columns of force and displacement in a file; nothing where it has not both."""
    named = {"force": reading["force_column"], "displacement": reading["displacement"]}
    return jm.data.two_channels(path, **named, time=reading["time"], skip_rows=reading["skip_rows"])


def read_perturbed(paths: Sequence[str], reading: dict[str, Any], window: str | None = None) -> "list[PerturbedRecording]":
    """The recordings of force and displacement in files, each with its steady part as window."""
    options = {name: value for name, value in reading.items() if name not in ("force_column", "displacement")}
    named = {"force": reading["force_column"], "displacement": reading["displacement"]}
    return [read(path, options | (channels(path, reading) or named), window) for path in paths]


def read_trials(paths: Sequence[str], reading: dict[str, Any], window: str | None = None) -> "Trials":
    """The recordings of one condition, each with its steady part: several files, or all columns of one (`--column all`)."""
    if len(paths) > 1 or reading["column"] != "all":
        return jm.Trials([read(path, {name: reading[name] for name in READING}, window) for path in paths])
    edges = edges_of(window)
    options = {name: reading[name] for name in READING if name not in ("column", "reference")}
    trials = jm.load_recordings(paths[0], **options)
    return trials if edges == "all" else trials.steady(edges)


def read(path: str, reading: dict[str, Any], window: str | None = "all") -> Any:
    """The recording of a file, its steady part as window: the one that is given, `all`, or None to find it."""
    edges = edges_of(window)
    try:
        recording = jm.load_recording(path, **reading)
    except ImportError as error:
        raise ValueError(str(error)) from None
    return recording if edges == "all" else recording.steady(edges)


def edges_of(window: str | None) -> Any:
    """The window of --window in s, `all`, or None."""
    if window is None or window == "all":
        return window
    start, colon, stop = window.partition(":")
    try:
        if colon:
            return float(start), float(stop)
    except ValueError:
        pass
    raise ValueError(f"--window {window}: give start and end in s, as 8:25, or all")
