"""Text for terminals and notebooks: at most 80 columns."""

import difflib
import textwrap
from collections.abc import Iterable, Sequence

import numpy as np

WIDTH = 80


def folded(lines: Iterable[str]) -> str:
    """The lines as one text; what is longer than 80 columns goes on below, two columns further
    in."""
    return "\n".join(part for line in lines for part in _parts(line))


def _parts(line: str) -> list[str]:
    if len(line) <= WIDTH:
        return [line]
    indent = " " * (len(line) - len(line.lstrip()) + 2)
    return textwrap.wrap(
        line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def rounded(value: float, error: float) -> tuple[str, str]:
    """A value and its error as they are printed: the error to two digits, the value to as many
    places."""
    if not (np.isfinite(value) and np.isfinite(error) and error > 0):
        return digits(value), digits(error, 2)
    places = 1 - int(np.floor(np.log10(error)))
    if float(f"{error:.1e}") >= 10.0 ** (2 - places):  # 0.0996 is rounded up to 0.10
        places -= 1
    if not -4 <= places <= 7:
        return digits(value), digits(error, 2)
    # + 0: no -0.00
    shown = [f"{round(x, places) + 0.0:.{max(places, 0)}f}" for x in (value, error)]
    return shown[0], shown[1]


def digits(value: float, count: int = 3) -> str:
    """A number with so many significant digits, and with all those before the point: 100, and not
    1e+02."""
    shown = f"{value:.{count}g}"
    return f"{value:.0f}" if "e+" in shown and abs(value) < 1e9 else shown


def squared(unit: str) -> str:
    """The square of a unit, as "N^2" and "(m/s^2)^2"."""
    return f"{unit}^2" if unit.isalpha() else f"({unit})^2"


def probability(p: float) -> str:
    """In words, as in "p = 0.23"; "p <= 0.001" for what is the least that 999 replicates can
    show."""
    return "p <= 0.001" if p <= 0.001 else f"p = {p:.2g}"


def choices(word: object, options: Iterable[str]) -> str:
    """The end of a message about an unknown word: the nearest option, then all of them."""
    options = list(options)
    plain = {option.lower(): option for option in options}
    near = difflib.get_close_matches(str(word).lower(), plain, n=1, cutoff=0.4)
    return (
        f"did you mean {plain[near[0]]!r}? Known: {', '.join(options)}"
        if near
        else f"known are {', '.join(options)}"
    )


def listed(items: Sequence | np.ndarray, most: int = 10) -> str:
    """The first of some numbers or names, by default ten, and how many more there are."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return ", ".join(str(item) for item in items[:most]) + more


def printable(text: str) -> str:
    """Text out of a file without letters that would do something to a terminal or cannot be
    written."""
    return "".join(
        letter if letter.isprintable() else "\N{REPLACEMENT CHARACTER}" for letter in text
    )
