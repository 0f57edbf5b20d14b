"""Compute, draw and write what the paper shows."""

import os
from pathlib import Path

import jax

from ._numbers import Reproduction, compute


def reproduce(
    out: str | os.PathLike[str],
    progress: bool = False,
) -> Reproduction:
    """Compute, draw and write the paper's figures and the table of its statements.

        from jaxmuscle import paper

        paper.reproduce("out/reproduce")

    Writes fig2, fig3, fig4a, fig4b, fig5, fig6a, fig6b, fig7, fig8 as .png and .pdf, claims.json
    and index.html.

    **Arguments:**

    - `out`: a folder
    - `progress`: a bar on a terminal
    """
    from jaxmuscle._common.progress import told

    from ._claims import check
    from ._figures import draw
    from ._page import write_page

    with told(progress, "reproduce") as report:
        found = compute(report)
        report("figures", 0.8)
        with jax.enable_x64(True):
            draw(found, Path(out))
            write_page(found, check(found), Path(out))
        report("done", 1.0)
    return found
