"""Figures as files: in one or several formats, each whole or not there."""

import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from .files import replacing
from .text import choices

FORMATS = ("png", "pdf", "svg")
DPI = 300  # of a PNG: what journals ask for
# The same figure gives the same file, and its letters can be searched and changed.
SETTINGS: Any = {"svg.hashsalt": "jaxmuscle", "pdf.fonttype": 42}
UNDATED: dict[str, dict[str, Any]] = {
    "png": {},
    "pdf": {"CreationDate": None},
    "svg": {"Date": None},
}


def figure_files(*names: str) -> list[str]:
    """The files of these figures, in all formats."""
    return [f"{name}.{kind}" for name in names for kind in FORMATS]


def pixels_of(figure: Any) -> bytes:
    """A figure as PNG, to be drawn once and shown in several places."""
    import matplotlib

    made = io.BytesIO()
    with matplotlib.rc_context(SETTINGS):
        figure.savefig(made, format="png", dpi=DPI, metadata=UNDATED["png"])
    return made.getvalue()


def write_figure(
    figure: Any,
    folder: Path,
    name: str,
    formats: Iterable[str] = FORMATS[:1],
    *,
    pixels: bytes | None = None,
) -> list[str]:
    """Writes `name` in each format, closes the figure, removes an earlier one in other formats;
    returns the files' names.

    `pixels`: its PNG, where it has been drawn already.
    """
    import matplotlib
    import matplotlib.pyplot as plt

    wanted = list(dict.fromkeys(formats))
    unknown = [kind for kind in wanted if kind not in FORMATS]
    if unknown:
        raise ValueError(
            f"formats: {unknown[0]!r} is no format of a figure: {choices(unknown[0], FORMATS)}"
        )
    for kind in wanted:
        with replacing(folder / f"{name}.{kind}") as temporary, matplotlib.rc_context(SETTINGS):
            if kind == "png" and pixels is not None:
                temporary.write_bytes(pixels)
            else:
                figure.savefig(temporary, dpi=DPI, metadata=UNDATED[kind])
    plt.close(figure)
    remove_figures(folder, name, kept=wanted)
    return [f"{name}.{kind}" for kind in wanted]


def remove_figures(folder: Path, *names: str, kept: Iterable[str] = ()) -> None:
    """Remove these figures of an earlier result in all formats but those that are kept."""
    for name in names:
        for kind in FORMATS:
            if kind not in kept:
                (folder / f"{name}.{kind}").unlink(missing_ok=True)
