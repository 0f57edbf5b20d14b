"""The notebooks: short, stored with their outputs, linked, and run."""

import ast
import re
import sys
import time
import types

import nbformat
import numpy as np
import pytest
from pages import IN_A_KERNEL, NOTEBOOKS, ROOT, module


def stored(path):
    """A notebook and the outputs of its code cells."""
    notebook = nbformat.read(path, as_version=4)
    return notebook, [output for cell in notebook.cells for output in cell.get("outputs", [])]


def test_the_notebooks_are_all_there_with_their_titles():
    titles = {
        path.stem: nbformat.read(path, as_version=4).cells[0].source.splitlines()[0]
        for path in NOTEBOOKS
    }
    assert titles == {
        "01-first-fit": "# A first fit",
        "02-monte-carlo-ensemble": "# A Monte Carlo ensemble",
        "03-three-tasks": "# One muscle, three tasks",
        "04-from-recording-to-parameters": "# From a recording to parameters",
        "05-uncertainty-and-noise-colour": "# How sure, and which noise?",
        "06-gradients-and-design": "# Gradients, and an experiment designed with them",
        "07-your-own-muscle": "# Your own muscle",
        "08-perturb-and-measure": "# Perturb and measure",
    }


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_a_notebook_can_be_read_without_running_it(path):
    notebook, outputs = stored(path)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    # A story that is read at one sitting; the formatter decides on lines, so that statements count.
    # The eighth has a story for each of two people.
    stories = 1 + (path.stem == "08-perturb-and-measure")
    written = [ast.walk(ast.parse(cell.source)) for cell in code]
    assert sum(isinstance(node, ast.stmt) for nodes in written for node in nodes) <= 52 * stories
    # run once, from top to bottom
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    assert not [
        output
        for output in outputs
        if output.output_type == "error" or output.get("name") == "stderr"
    ]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
    assert path.stat().st_size < 400_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda p: p.stem)
def test_the_links_of_a_notebook_lead_somewhere(path):
    text = "\n".join(cell.source for cell in stored(path)[0].cells if cell.cell_type == "markdown")
    missing = [
        link for link in re.findall(r"\]\(([^)#]+)\)", text) if not (path.parent / link).exists()
    ]
    assert not missing


def test_one_notebook_has_sliders():
    kinds = {
        kind for path in NOTEBOOKS for output in stored(path)[1] for kind in output.get("data", {})
    }
    assert "application/vnd.jupyter.widget-view+json" in kinds


def test_the_site_offers_every_notebook_for_download(monkeypatch):
    """Its page leads to the file as it is in the repository. Mkdocs itself is not needed for
    that."""
    files = types.ModuleType("mkdocs.structure.files")
    files.Files, files.File = (
        list,
        types.SimpleNamespace(generated=lambda config, uri, *, content: (uri, content)),
    )
    for name, made in (
        ("mkdocs", None),
        ("mkdocs.structure", None),
        ("mkdocs.structure.files", files),
    ):
        monkeypatch.setitem(sys.modules, name, made or types.ModuleType(name))
    made = dict(module(ROOT / "docs" / "notebooks.py").on_files([], None))
    for path in NOTEBOOKS:
        page = made[f"notebooks/{path.stem}.md"]
        assert (
            page.startswith("# ")
            and f"\n\n[Download this notebook]({path.name}){{ .md-button" in page
        )
        assert made[f"notebooks/{path.name}"] == path.read_bytes()


@pytest.mark.slow
def test_no_reply_of_a_cell_with_an_output_widget_is_missed(tmp_path):
    """With nbclient alone every second such cell waits for its whole timeout, which is an error
    here."""
    cells = ["import ipywidgets\nshown = ipywidgets.Output()"] + [
        "with shown:\n    print(1)\n    display(2)"
    ] * 20
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    client = module(ROOT / "notebooks" / "run.py").Client
    taken = []
    begun = time.monotonic()
    client(
        notebook,
        timeout=60,
        startup_timeout=300,
        resources={"metadata": {"path": str(tmp_path)}},
        on_cell_executed=lambda **_: taken.append(time.monotonic() - begun),
    ).execute()
    assert np.max(np.diff(taken)) < 50


@pytest.mark.slow
def test_a_notebook_runs_in_a_kernel(tmp_path, monkeypatch):
    """The one with sliders, without its simulations; test_pages.py runs all cells of all."""
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel's own, as a reader has it
    notebook, _ = stored(NOTEBOOKS[0].with_name(f"{IN_A_KERNEL}.ipynb"))
    simulated = [
        cell
        for cell in notebook.cells
        if cell.cell_type == "code" and "jm.simulate(" in cell.source
    ]
    assert len(simulated) == 3
    for cell in simulated:  # what they name stays
        cell.source = "\n".join(
            line for line in cell.source.splitlines() if line.startswith("sources = ")
        )
    client = module(ROOT / "notebooks" / "run.py").Client
    client(
        notebook,
        timeout=900,
        startup_timeout=300,
        iopub_timeout=60,
        resources={"metadata": {"path": str(tmp_path)}},
    ).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) >= 2
