"""Text for terminals and notebooks: at most 80 columns."""

import textwrap
from collections.abc import Iterable

WIDTH = 80


def folded(lines: Iterable[str]) -> str:
    """The lines as one text; what is longer than 80 columns goes on below, two columns further in."""
    return "\n".join(part for line in lines for part in _parts(line))


def _parts(line: str) -> list[str]:
    if len(line) <= WIDTH:
        return [line]
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.wrap(line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
