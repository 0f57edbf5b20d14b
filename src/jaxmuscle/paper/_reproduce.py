"""Compute, draw and write what the paper shows."""

import os
from collections.abc import Sequence
from pathlib import Path

import jax

from jaxmuscle.data._recording import Recording

from ._numbers import Reproduction, compute, given_recordings


def reproduce(
    out: str | os.PathLike[str],
    recordings: Sequence[Recording | str | os.PathLike[str]] | None = None,
    progress: bool = False,
) -> Reproduction:
    """Compute, draw and write the paper's figures and the table of its statements.

        from jaxmuscle import paper

        paper.reproduce("out/reproduce")

    Writes fig2, fig3, fig4a, fig4b, fig5, fig6a, fig6b, fig7, fig8 as .png and .pdf, claims.json
    and index.html.

    **Arguments:**

    - `out`: a folder
    - `recordings`: three of your own (`Recording` or file) instead of the simulated ones of Figures
      7 and 8
    - `progress`: a bar on a terminal

    **Raises:** `ValueError` unless there are three recordings of one quantity, and for a file that
    cannot be read.
    """
    from jaxmuscle._common.progress import told

    from ._claims import check
    from ._figures import draw
    from ._page import write_page

    given = None if recordings is None else given_recordings(recordings)
    with told(progress, "reproduce") as report:
        found = compute(given, report)
        report("figures", 0.8)
        with jax.enable_x64(True):
            draw(found, Path(out))
            write_page(found, check(found), Path(out))
        report("done", 1.0)
    return found
