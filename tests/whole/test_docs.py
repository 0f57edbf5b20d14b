"""The documentation against the package: every public name described once, links that lead
somewhere, a current table."""

import ast
import contextlib
import dataclasses
import inspect
import operator
import re
import textwrap
import types
import typing
from collections import Counter

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
from pages import PAGES, ROOT, blocks, module, name_of

import jaxmuscle as jm
from jaxmuscle import explorer, paper
from jaxmuscle.objective._options import JointFitOptions, OneFitOptions

PACKAGE = ROOT / "src" / "jaxmuscle"


def vars_of(wing):
    """The public names of a wing: of its face, of the module of errors all classes."""
    if wing == "errors":
        return [name for name, value in vars(jm.errors).items() if inspect.isclass(value)]
    return getattr(jm, wing).__all__


def imports(module):
    """What a module imports from its siblings: name to module."""
    tree = ast.parse(module.read_text(encoding="utf-8"))
    found = (node for node in tree.body if isinstance(node, ast.ImportFrom) and node.level == 1)
    return {alias.name: node.module for node in found for alias in node.names}


TOP = imports(PACKAGE / "__init__.pyi")
WINGS = {name for name, module in TOP.items() if module is None} | {"errors"}
# Where a user finds a name: "fit", or "model.Decay" for what is not at the top.
PUBLIC = [name for name in TOP if name not in WINGS] + [
    f"{wing}.{name}"
    for wing in sorted(WINGS - {"plot"})
    for name in vars_of(wing)
    if name not in TOP
]
# of wings that are imported by their names: what they do is a command, too
COMMANDS = {"explorer": explorer, "paper": paper}
PUBLIC += ["explorer.page", "paper.reproduce"]


def test_reference_describes_every_public_name_once():
    pages = "\n".join(
        page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "reference").glob("*.md")
    )
    described = Counter(re.findall(r"^::: jaxmuscle\.([\w.]+)$", pages, re.MULTILINE))
    functions = [f"plot.{name}" for name in jm.plot.__all__ if callable(getattr(jm.plot, name))]
    assert described == Counter([*PUBLIC, "plot", *functions])


def test_the_top_has_the_names_of_everyday_work():
    assert 30 <= len(PUBLIC) - sum("." in name for name in PUBLIC) <= 32


# Values and the module of figures stand on their pages of the reference.
NAMES = sorted(set(PUBLIC) - {"__version__", "model.PARAMETERS", "model.TASKS"})
FIGURES = [
    name for name in jm.plot.__all__ if callable(getattr(jm.plot, name)) and name != "styled"
]
# Of results, which the types of these fields explain.
EVERYWHERE = {"ax", "seed", "settings", "target", "task", "versions"}


OPTIONS_SAID = (jm.fit, jm.profile, jm.posterior, jm.uncertainty.design_input)


def described(thing):
    """The words of a docstring, of a class also those of its public bases."""
    family = (
        [c for c in inspect.getmro(thing) if c.__module__.startswith("jaxmuscle")]
        if inspect.isclass(thing)
        else [thing]
    )
    return set(re.findall(r"\w+", " ".join(inspect.getdoc(one) or "" for one in family)))


@pytest.mark.parametrize("name", NAMES)
def test_public_object_is_documented(name):
    """A docstring that names every argument or field, and says which errors there are."""
    thing = operator.attrgetter(name)(jm)
    assert (inspect.getdoc(thing) or "").strip() and thing.__doc__
    if not inspect.isclass(thing):
        parameters = inspect.signature(thing).parameters
        given = {name for name in parameters if name != "options"}
        # others say that theirs are the same
        if "options" in parameters and thing is jm.fit:
            given |= OneFitOptions.__optional_keys__ | JointFitOptions.__optional_keys__
        elif "options" in parameters and thing in OPTIONS_SAID:
            (options,) = typing.get_args(parameters["options"].annotation)
            given |= options.__optional_keys__
        source = inspect.getsource(thing)
        assert "raise " not in source or "aises" in (inspect.getdoc(thing) or "")
    elif dataclasses.is_dataclass(thing):
        given = {field.name for field in dataclasses.fields(thing)}
    else:
        given = set(getattr(thing, "_fields", ()))
    words = described(thing)
    missing = {
        one
        for one in given - EVERYWHERE
        if one not in words and re.sub("_[wz]", "_j", one, count=1) not in words
    }
    assert not missing


@pytest.mark.parametrize(
    "name", [name for name in NAMES if inspect.isclass(operator.attrgetter(name)(jm))]
)
def test_public_methods_are_documented(name):
    thing = operator.attrgetter(name)(jm)
    kinds = (types.FunctionType, property, classmethod, staticmethod)
    public = [
        attribute
        for attribute, value in vars(thing).items()
        if attribute[0] != "_" and isinstance(value, kinds)
    ]
    assert not [attribute for attribute in public if not inspect.getdoc(getattr(thing, attribute))]


FUNCTIONS = [name for name in NAMES if inspect.isroutine(operator.attrgetter(name)(jm))]
# docs/ensembles.md
OF_COMMANDS = {"ensembles.measure"}
RUN = (
    "list_",
    "load_target",
    "load_preset",
    "model.on_rung",
    "data.as_",
    "response.",
    "spectra.",
)


def examples(name):
    """Indented code of a docstring that calls the function."""
    text = inspect.getdoc(operator.attrgetter(name)(jm)) or ""
    for block in re.findall(r"(?:^    .*\n?)+", text, re.MULTILINE):
        code = textwrap.dedent(block)
        with contextlib.suppress(SyntaxError):  # a formula
            calls = [
                ast.unparse(node.func)
                for node in ast.walk(ast.parse(code))
                if isinstance(node, ast.Call)
            ]
            if name.rpartition(".")[2] in {call.rpartition(".")[2] for call in calls}:
                yield code


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) - OF_COMMANDS))
def test_function_has_an_example(name, tmp_path, monkeypatch):
    """Those that need neither a file of the reader's nor a fit are run."""
    code = "\n".join(examples(name))
    assert code
    named = {
        f"{wing}.{one}" if one else wing
        for wing, one in re.findall(r"\bjm\.(\w+)(?:\.([a-z]\w*))?", code)
    }
    assert {one for one in named if one.partition(".")[0] not in TOP} == set()
    if name.startswith(RUN):
        monkeypatch.chdir(tmp_path)
        exec(compile(code, name, "exec"), {"jm": jm, "np": np, "jax": jax})


@pytest.mark.parametrize("name", FIGURES)
def test_figures_are_documented(name):
    """The first argument is what the first line speaks of."""
    figure = getattr(jm.plot, name)
    assert set(list(inspect.signature(figure).parameters)[1:]) - EVERYWHERE <= described(figure)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_relative_links_lead_to_files(page):
    text = re.sub(
        r"^```.*?^```|`[^`\n]*`",
        "",
        page.read_text(encoding="utf-8"),
        flags=re.MULTILINE | re.DOTALL,
    )
    targets = [
        link.partition("#")[0] for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link
    ]
    missing = [link for link in targets if link and not (page.parent / link).exists()]
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_names_in_pages_are_public(page):
    text = page.read_text(encoding="utf-8")
    of_wings = {
        f"{wing}.{name}"
        for wing, name in re.findall(r"\bjm\.(\w+)\.([A-Za-z]\w*)", text)
        if wing in WINGS - {"plot"}
    }
    mentioned = set(re.findall(r"\bjm\.(\w+)", text)) - {"NAME"} - WINGS
    assert mentioned | of_wings <= set(PUBLIC)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_in_pages_parses(page):
    for code in blocks(page):
        ast.parse(code)


def test_every_page_is_in_the_navigation():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    # made by docs/notebooks.py
    notebooks = {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert set(re.findall(r"[\w/-]+\.md", navigation)) == pages | notebooks


def test_every_formula_of_a_page_can_be_typeset():
    """As the site does without the network, in `docs/notebooks.py`; GitHub does it by itself."""
    formulas = module(ROOT / "docs" / "formulas.py")
    rows = [
        row
        for page in PAGES
        for found in formulas.BLOCK.finditer(page.read_text(encoding="utf-8"))
        for row in formulas.lines(found[2])
    ]
    assert len(rows) > 25
    for row in rows:
        assert formulas.picture(row).startswith('<img class="math"')
    assert sum(page.read_text(encoding="utf-8").count("```math") for page in PAGES) == sum(
        len(formulas.BLOCK.findall(page.read_text(encoding="utf-8"))) for page in PAGES
    )


def test_parameter_page_is_current():
    generate = module(ROOT / "docs" / "generate.py")
    assert generate.PAGE.read_text(encoding="utf-8") == generate.page(), (
        "run `python docs/generate.py`"
    )
    assert generate.FILES.read_text(encoding="utf-8") == generate.files_page(), (
        "run `python docs/generate.py`"
    )


def test_the_picture_of_the_layers_is_current():
    architecture = module(ROOT / "docs" / "architecture.py")
    assert architecture.PICTURE.read_text(encoding="utf-8") == architecture.picture(), (
        "run `python docs/architecture.py`"
    )
    assert set(architecture.HOLDS) == {wing for row in architecture.layers() for wing in row}


def test_the_pictures_of_the_model_are_current():
    pictures = module(ROOT / "docs" / "pictures.py")
    for name, draw in pictures.PICTURES.items():
        assert pictures.digest(draw()) == pictures.stored(name), "run `python docs/pictures.py`"
        assert (pictures.HERE / name).stat().st_size < 100_000
    plt.close("all")


def test_files_named_on_the_page_of_the_layers_exist():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w/]+\.pyi?)`", text))
    assert len(named) > 25
    assert not [name for name in named if not ((PACKAGE / name).exists() or (ROOT / name).exists())]
