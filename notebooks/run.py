"""Runs the notebooks (all, or those named) and stores their outputs, pictures in few colours:
`python notebooks/run.py`."""

import base64
import io
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import nbformat
import zmq
from nbclient import NotebookClient
from PIL import Image

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "docs"))

from gallery import few_colours  # noqa: E402


def small(picture: str) -> str:
    """A PNG in base64, in its commonest colours."""
    found = io.BytesIO()
    few_colours(Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")).save(
        found, "PNG", optimize=True
    )
    return base64.b64encode(found.getvalue()).decode() + "\n"


class Client(NotebookClient):
    """Runs cells with widgets without waiting for replies that are there.

    nbclient answers an output widget on the socket on which it waits for a cell's reply. ZeroMQ
    tells only once that something came, and sending uses that up: the reply was noticed after the
    cell's whole timeout, in every second cell.
    """

    def process_message(self, msg: Any, cell: nbformat.NotebookNode, cell_index: int) -> Any:
        """As nbclient's; then the socket is asked anew whether something came."""
        try:
            return super().process_message(msg, cell, cell_index)
        finally:
            self.kc.shell_channel.socket.get(zmq.EVENTS)


def run(path: Path) -> None:
    """Execute a notebook in an empty folder and write it back when it is done."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        Client(
            notebook, timeout=900, kernel_name="python3", resources={"metadata": {"path": folder}}
        ).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = small(output.data["image/png"])
    notebook.metadata["language_info"] = {"name": "python"}
    nbformat.write(notebook, path)


if __name__ == "__main__":
    known = {path.stem: path for path in sorted(HERE.glob("*.ipynb"))}
    asked = [Path(name).stem for name in sys.argv[1:]] or list(known)
    if unknown := sorted(set(asked) - set(known)):
        sys.exit(f"no notebook is called {', '.join(unknown)}: choose among {', '.join(known)}")
    for name in asked:
        begun = time.monotonic()
        run(known[name])
        print(f"{name}: {time.monotonic() - begun:.1f} s", flush=True)
