"""For mkdocs: formulas as pictures, without the network. GitHub typesets the same sources by
itself.

In a page a formula is a fenced block of `math`, in a notebook it stands between dollars. It keeps
to what matplotlib can set. Lines of an aligned block become pictures one below the other.
"""

import base64
import io
import re

from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import math_to_image

BLOCK = re.compile(r"^( *)```math\n(.*?)\n\1```$", re.MULTILINE | re.DOTALL)
MATH = re.compile(r"\$\$(.+?)\$\$|\$([^$\n]+)\$", re.DOTALL)
CODE = re.compile(r"(`[^`]*`)")


def typeset(markdown: str) -> str:
    """A page with its blocks of formulas as pictures."""
    return BLOCK.sub(_block, markdown)


def typeset_prose(text: str) -> str:
    """The same of a notebook's cell, code left alone."""
    return "".join(
        piece if piece.startswith("`") else MATH.sub(_formula, piece) for piece in CODE.split(text)
    )


def _block(found: re.Match[str]) -> str:
    rows = "<br>".join(picture(row) for row in lines(found[2]))
    return f'{found[1]}<div class="formula">{rows}</div>'


def lines(latex: str) -> list[str]:
    """The lines of a displayed formula, each by itself, with fractions in full size."""
    latex = re.sub(r"\\(?:begin|end)\{aligned\}|&", "", latex).replace(r"\frac", r"\dfrac")
    return [" ".join(row.split()) for row in latex.split(r"\\") if row.strip()]


def _formula(found: re.Match[str]) -> str:
    if found[1] is None:
        return picture(found[2].strip())
    return f'\n\n<div class="formula">{"<br>".join(map(picture, lines(found[1])))}</div>\n\n'


def picture(latex: str) -> str:
    """An image, as high as the letters of the text around it."""
    image = io.BytesIO()
    depth = math_to_image(f"${latex}$", image, prop=FontProperties(size=12), dpi=72, format="svg")
    paper = b"fill: #ffffff"
    data = base64.b64encode(image.getvalue().replace(paper, b"fill: none")).decode()
    alt = latex.replace('"', "&quot;").replace("<", "&lt;")
    return (
        f'<img class="math" alt="{alt}" src="data:image/svg+xml;base64,{data}"'
        f' style="vertical-align: -{depth:.1f}pt">'
    )
