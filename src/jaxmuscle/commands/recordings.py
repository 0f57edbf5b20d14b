"""Recordings in commands: the options with which they are read, the same for every command that does."""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jaxmuscle as jm

from .options import READING

if TYPE_CHECKING:
    from jaxmuscle import Recording, Trials


def reads_recordings(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of `READING`; it gets their values together, as its argument `reading`.

    An option of that name which the command has itself serves both.
    """

    @functools.wraps(command)
    def with_options(**given: Any) -> None:
        reading = {name: given.get(name) for name in READING}
        command(**{name: value for name, value in given.items() if name in kept}, reading=reading)

    signature = inspect.signature(command)
    own = [parameter for name, parameter in signature.parameters.items() if name != "reading"]
    kept = {parameter.name for parameter in own}
    keyword = inspect.Parameter.KEYWORD_ONLY
    added = [inspect.Parameter(name, keyword, default=default, annotation=annotation)
             for name, (annotation, default) in READING.items() if name not in kept]  # fmt: skip
    parameters = [parameter.replace(kind=keyword) for parameter in own] + added
    setattr(with_options, "__signature__", signature.replace(parameters=parameters))  # noqa: B010
    with_options.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return with_options


def read_trials(paths: Sequence[str], reading: dict[str, Any], window: str | None = None) -> "Trials":
    """The recordings of one condition, each with its steady part: several files, or all columns of one (`--column all`)."""
    if len(paths) > 1 or reading["column"] != "all":
        return jm.Trials([read(path, reading, window) for path in paths])
    edges = edges_of(window)
    options = {name: value for name, value in reading.items() if name not in ("column", "reference")}
    trials = jm.load_recordings(paths[0], **options)
    return trials if edges == "all" else trials.steady(edges)


def read(path: str, reading: dict[str, Any], window: str | None = "all") -> "Recording":
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
