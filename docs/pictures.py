"""Draws the model for README, model.md and notebook 03: `python docs/pictures.py` writes
docs/muscle.svg and docs/tasks.svg.

A picture holds the digest of what is drawn, not of how this version of matplotlib writes it. By
that a stale one is found.
"""

import hashlib
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.text import Text

import jaxmuscle as jm

HERE = Path(__file__).parent
WIDE = 85 / 25.4  # inches: one column of a journal, or a telephone
SVG = {"svg.hashsalt": "jaxmuscle", "svg.fonttype": "path"}


def muscle() -> Figure:
    """The default muscle, its insertion held."""
    return jm.plot.schematic(jm.Isometric()).get_figure()  # pyright: ignore[reportReturnType]


def tasks() -> Figure:
    """What each task prescribes, and what it tells."""
    figure = plt.figure(figsize=(WIDE, 0.76 * WIDE))
    each = (jm.Isometric(), jm.PrescribedLength(), jm.PrescribedForce(), jm.PrescribedMotion())
    for i, task in enumerate(each):
        jm.plot.schematic(task, figure.add_axes((0.5 * (i % 2), 0.5 * (i < 2), 0.49, 0.49)))
    return figure


PICTURES = {"muscle.svg": muscle, "tasks.svg": tasks}


def digest(figure: Figure) -> str:
    """Of all words and lines with their places."""
    return hashlib.sha256("\n".join(_content(figure)).encode()).hexdigest()[:16]


def _content(figure: Figure) -> Iterator[str]:
    for artist in figure.findobj(lambda one: isinstance(one, Text | Line2D | Rectangle)):
        drawn: Any = artist
        if isinstance(artist, Text):
            shown = (
                artist.get_text(),
                artist.get_position(),
                getattr(artist, "xy", ()),
                artist.get_fontsize(),
            )
            yield repr(
                (
                    shown[0],
                    *(np.round(np.asarray(x, float), 6).tolist() for x in shown[1:]),
                    artist.get_color(),
                )
            )
        elif isinstance(artist, Line2D):
            yield repr(
                (
                    np.round(np.asarray(drawn.get_xydata(), float), 6).tolist(),
                    str(drawn.get_color()),
                )
            )
        else:
            yield repr(np.round(np.asarray(drawn.get_bbox().bounds, float), 6).tolist())


def stored(name: str) -> str:
    """The digest that a picture holds."""
    found = re.search(r"drawn: (\w+)", (HERE / name).read_text(encoding="utf-8"))
    return found[1] if found else ""


def write(name: str) -> None:
    """Stores a picture in twice its size, which a page makes smaller, its paths to a hundredth of a
    point."""
    with matplotlib.rc_context(SVG):
        figure, text = PICTURES[name](), io.StringIO()
        about = {"Date": None, "Description": f"drawn: {digest(figure)}"}
        figure.savefig(text, format="svg", facecolor="white", metadata=about)
    plt.close(figure)
    shorter = re.sub(
        r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text.getvalue()
    )
    larger = re.sub(
        r'(width|height)="([\d.]+)pt"',
        lambda side: f'{side[1]}="{2 * float(side[2]):.0f}pt"',
        shorter,
        count=2,
    )
    (HERE / name).write_text(larger, encoding="utf-8")


if __name__ == "__main__":
    for picture in PICTURES:
        write(picture)
        print(f"Written: docs/{picture}, {(HERE / picture).stat().st_size // 1024} KiB")
