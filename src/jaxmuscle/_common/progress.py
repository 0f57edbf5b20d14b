"""Progress: told to a function, printed, or drawn as a bar."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from rich.console import Console


def teller(progress: bool | Callable[[str, float], None]) -> Callable[[str, float], None]:
    if callable(progress):
        return progress
    if not progress:
        return lambda text, share: None
    return lambda text, share: print(f"{100 * share:3.0f} %  {text}", flush=True)


@contextlib.contextmanager
def progress(title: str) -> Iterator[Any]:
    """A progress bar on a terminal, nothing elsewhere."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    screen = Console(stderr=True)
    columns = (TextColumn("{task.fields[title]}"), BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bar:
        row = bar.add_task("starting", total=1.0, title=title)
        yield lambda text, share: bar.update(row, description=text, completed=share)
