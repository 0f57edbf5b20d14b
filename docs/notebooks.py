"""For mkdocs: every notebook of ../notebooks, with its stored outputs, as a page of the site."""

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

from matplotlib.font_manager import FontProperties
from matplotlib.mathtext import math_to_image
from mkdocs.structure.files import File, Files

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
MATH = re.compile(r"\$\$(.+?)\$\$|\$([^$\n]+)\$", re.DOTALL)
CODE = re.compile(r"(`[^`]*`)")


def on_files(files: Files, config: Any) -> Files:
    """Adds a page and its pictures for each notebook."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        text, pictures = page(json.loads(path.read_text(encoding="utf-8")), path.stem)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links to notebooks, which lead to files in the repository, lead to those pages."""
    return re.sub(r"\]\((?:\.\./)+notebooks/([\w-]+)\.ipynb\)", rf"]({_up(page)}notebooks/\1.md)", markdown)


def _up(page: Any) -> str:
    return "../" * page.file.src_uri.count("/")


def page(notebook: dict[str, Any], stem: str) -> tuple[str, dict[str, bytes]]:
    """Markdown, and pictures by name."""
    parts, pictures = [], {}
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(prose(source))
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            text = "".join(output.get("text", ""))
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{stem}-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode(data["image/png"])
                text = f"![What the code above draws]({name})"
            elif "application/vnd.jupyter.widget-view+json" in data:
                text = "*Here are sliders when the notebook runs.*"
            else:
                text = "```text\n" + (text or "".join(data.get("text/plain", ""))).rstrip() + "\n```"
            parts.append(text)
    where = f"This is `notebooks/{stem}.ipynb` with its outputs: open it in Jupyter to run and change it."
    title, *rest = parts[0].split("\n", 1)
    return "\n\n".join([title, where, *rest, *parts[1:]]) + "\n", pictures


def prose(text: str) -> str:
    """Formulas as pictures, code left alone; links as they are from a page of the site."""
    pieces = [piece if piece.startswith("`") else MATH.sub(formula, piece) for piece in CODE.split(text)]
    return re.sub(r"\]\(\.\./docs/", "](../", "".join(pieces)).replace(".ipynb)", ".md)")


def formula(found: re.Match[str]) -> str:
    """An image in the text, as high as its letters; a displayed one in a line of its own."""
    shown, latex = found[1] is not None, (found[1] or found[2]).strip()
    image = io.BytesIO()
    depth = math_to_image(f"${latex}$", image, prop=FontProperties(size=12), dpi=72, format="svg")
    paper = b"fill: #ffffff"
    data = base64.b64encode(image.getvalue().replace(paper, b"fill: none")).decode()
    alt = latex.replace('"', "&quot;")
    tag = f'<img class="math" alt="{alt}" src="data:image/svg+xml;base64,{data}" style="vertical-align: -{depth:.1f}pt">'
    return f"\n\n{tag}\n\n" if shown else tag
