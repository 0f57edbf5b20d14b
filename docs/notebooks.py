"""For mkdocs: every notebook of ../notebooks, with its stored outputs, as a page; formulas of all
pages typeset."""

import base64
import json
import re
import struct
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.append(str(Path(__file__).parent))
from formulas import typeset, typeset_prose

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
# pixels of a picture that a phone can show whole; how site.css knows others
NARROW, WIDE = 1000, "{ .wide }"


def on_files(files: Files, config: Any) -> Files:
    """Adds for each notebook a page, its pictures, and the notebook to download."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        text, pictures = page(json.loads(path.read_text(encoding="utf-8")), path.stem)
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=text))
        for name, content in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=content))
        files.append(File.generated(config, f"notebooks/{path.name}", content=path.read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Links to notebooks, which lead to files in the repository, lead to those pages; formulas are
    typeset."""
    markdown = re.sub(
        r"\]\((?:\.\./)+notebooks/([\w-]+)\.ipynb\)", rf"]({_up(page)}notebooks/\1.md)", markdown
    )
    return typeset(markdown)


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
                text = f"[{text}{WIDE}]({name})" if _width(pictures[name]) > NARROW else text
            elif "application/vnd.jupyter.widget-view+json" in data:
                text = "*Here are sliders when the notebook runs.*"
            else:
                text = (
                    "```text\n" + (text or "".join(data.get("text/plain", ""))).rstrip() + "\n```"
                )
            parts.append(text)
    where = (
        f'[Download this notebook]({stem}.ipynb){{ .md-button download="{stem}.ipynb" }}\n\nThis is'
        f" `notebooks/{stem}.ipynb` with its outputs. `make notebooks` opens all of them in"
        " JupyterLab, where you can run and change them."
    )
    title, *rest = parts[0].split("\n", 1)
    return "\n\n".join([title, where, *rest, *parts[1:]]) + "\n", pictures


def _width(png: bytes) -> int:
    """Of a picture [pixels], as its header says."""
    return struct.unpack(">I", png[16:20])[0]


def prose(text: str) -> str:
    """Formulas as pictures, code left alone; links as they are from a page of the site."""
    return re.sub(r"\]\(\.\./docs/", "](../", typeset_prose(text)).replace(".ipynb)", ".md)")
