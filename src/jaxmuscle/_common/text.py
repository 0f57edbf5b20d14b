"""Text for terminals and notebooks: at most 80 columns."""

import difflib
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

WIDTH = 80


def folded(lines: Iterable[str]) -> str:
    """The lines as one text; what is longer than 80 columns goes on below, two columns further in."""
    return "\n".join(part for line in lines for part in _parts(line))


def _parts(line: str) -> list[str]:
    if len(line) <= WIDTH:
        return [line]
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.wrap(line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def choices(word: str, options: Iterable[str]) -> str:
    """The end of a message about an unknown word: the nearest option, then all of them."""
    options = list(options)
    near = difflib.get_close_matches(word.lower(), options, n=1, cutoff=0.4)
    hint = f"did you mean {near[0]!r}? " if near else ""
    return f"{hint}Known: {', '.join(options)}"


def listed(items: Sequence | np.ndarray) -> str:
    """The first ten of some numbers or names."""
    return ", ".join(str(item) for item in items[:10]) + (f" and {len(items) - 10} more" if len(items) > 10 else "")
