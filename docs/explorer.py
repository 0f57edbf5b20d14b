"""For mkdocs: the explorer as a page of the site, made of the package's own files."""

from typing import Any

from mkdocs.structure.files import File, Files

from jaxmuscle import explorer


def on_files(files: Files, config: Any) -> Files:
    """Adds the page."""
    files.append(File.generated(config, "explorer-page.html", content=explorer.page()))
    return files
