"""The documentation against the package: every public name described once, links that lead somewhere, a current table."""

import ast
import importlib.util
import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "jaxmuscle"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def name_of(page):
    return str(page.relative_to(ROOT))


def imports(module):
    """What a module imports from its siblings: name to module."""
    tree = ast.parse(module.read_text(encoding="utf-8"))
    found = (node for node in tree.body if isinstance(node, ast.ImportFrom) and node.level == 1)
    return {alias.name: node.module for node in found for alias in node.names}


PUBLIC = imports(PACKAGE / "__init__.pyi")


def docstrings(name, module):
    """Docstrings of every definition of a public name, which a module may itself import from another."""
    if module is None:
        return [ast.get_docstring(ast.parse((PACKAGE / f"{name}.py").read_text(encoding="utf-8")))]
    path = PACKAGE / f"{module}.py"
    kinds = (ast.ClassDef, ast.FunctionDef)
    body = ast.parse(path.read_text(encoding="utf-8")).body
    found = [ast.get_docstring(node) for node in body if isinstance(node, kinds) and node.name == name]
    return found or docstrings(name, imports(path)[name])


def test_reference_describes_every_public_name_once():
    pages = "\n".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference").glob("*.md"))
    described = Counter(re.findall(r"^::: jaxmuscle\.(\w+)$", pages, re.MULTILINE))
    assert described == Counter(list(PUBLIC))


# Values, whose meaning stands on their page of the reference.
@pytest.mark.parametrize("name", sorted(set(PUBLIC) - {"__version__", "PARAMETERS"}))
def test_public_object_has_docstring(name):
    assert any(docstrings(name, PUBLIC[name]))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_relative_links_lead_to_files(page):
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    targets = [link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    missing = [link for link in targets if link and not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_names_in_pages_are_public(page):
    mentioned = set(re.findall(r"\bjm\.(\w+)", page.read_text(encoding="utf-8"))) - {"NAME"}
    assert mentioned <= set(PUBLIC)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_in_pages_parses(page):
    for block in re.findall(r"^( *)```python\n(.*?)^ *```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        indent, code = block
        ast.parse("".join(line.removeprefix(indent) for line in code.splitlines(keepends=True)))


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    assert set(re.findall(r"[\w/-]+\.md", navigation)) == pages


def test_the_citation_names_the_current_version():
    about = (PACKAGE / "__about__.py").read_text(encoding="utf-8")
    (version,) = re.findall(r'^__version__ = "(.+)"$', about, re.MULTILINE)
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_parameter_page_is_current():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None and spec.loader is not None
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    assert generate.PAGE.read_text(encoding="utf-8") == generate.page(), "run `python docs/generate.py`"
