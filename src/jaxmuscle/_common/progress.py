"""Progress of long work: a bar on a terminal and in a notebook, else a line every ten seconds
through `logging`."""

import contextlib
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

LOG = logging.getLogger("jaxmuscle")
EVERY = 10.0  # seconds between lines
Tell = Callable[[str, float], None]


def nothing(text: str, share: float) -> None:
    """Progress that nobody asked for."""


@contextlib.contextmanager
def told(progress: bool | Tell, title: str) -> Iterator[Tell]:
    """What a function calls with (text, share): the one that was given, nothing for False, for True
    what shows it.

    The bar of rich on a terminal and in a notebook; otherwise lines, also while nothing is told (a
    program compiles). The share never falls: work that turns out to be more than expected makes it
    wait.
    """
    if callable(progress):
        yield _rising(progress)
    elif not progress or _quiet():
        yield nothing
    else:
        from rich.console import Console

        screen = Console(stderr=True)
        with (_bar if screen.is_terminal or screen.is_jupyter else _lines)(title, screen) as tell:
            yield _rising(tell)


def _rising(tell: Tell) -> Tell:
    most = 0.0

    def rising(text: str, share: float) -> None:
        nonlocal most
        most = max(most, share)
        tell(text, most)

    return rising


@contextlib.contextmanager
def _bar(title: str, screen: "Console") -> Iterator[Tell]:
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.fields[title]}"),
        BarColumn(),
        TextColumn("{task.description}"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=screen, transient=True) as bar:
        row = bar.add_task("starting", total=1.0, title=title)
        yield lambda text, share: bar.update(row, description=text, completed=share)


@contextlib.contextmanager
def _lines(title: str, screen: "Console") -> Iterator[Tell]:
    """A line every ten seconds, by a thread of its own."""
    state: dict[str, Any] = {"text": "starting", "share": 0.0}
    start, ended = time.monotonic(), threading.Event()

    def tell(text: str, share: float) -> None:
        state.update(text=text, share=share)

    def watch() -> None:
        while not ended.wait(EVERY):
            seconds = time.monotonic() - start
            _say(f"{title}: {100 * state['share']:.0f} %, {state['text']} ({seconds:.0f} s)")

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield tell
    finally:
        ended.set()
        thread.join()


def _quiet() -> bool:
    """Whether logging is set up, and not for progress."""
    return LOG.hasHandlers() and LOG.level != logging.NOTSET and not LOG.isEnabledFor(logging.INFO)


def _say(line: str) -> None:
    """Through the logger `jaxmuscle`; where that would be lost, to the standard error, since it was
    asked for."""
    if LOG.hasHandlers() and LOG.isEnabledFor(logging.INFO):
        LOG.info(line)
    else:
        print(line, file=sys.stderr, flush=True)
