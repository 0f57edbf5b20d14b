"""The files with which the project is worked on agree with one another."""

import re
import tomllib

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from pages import ROOT

import jaxmuscle as jm

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PINS = [
    Requirement(line)
    for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    if not line.lstrip().startswith("#")
]
REQUIREMENTS = [
    Requirement(text)
    for texts in (
        PROJECT["project"]["dependencies"],
        *PROJECT["project"]["optional-dependencies"].values(),
        *PROJECT["dependency-groups"].values(),
    )
    for text in texts
    if isinstance(text, str)  # not the include of a group
]


def applies(requirement, environment):
    return requirement.marker is None or requirement.marker.evaluate(environment)


@pytest.mark.parametrize("python", ["3.11", "3.12", "3.13"])
@pytest.mark.parametrize("system", ["linux", "darwin", "win32"])
def test_each_requirement_is_met_by_its_pin(python, system):
    environment = {
        "python_version": python,
        "python_full_version": f"{python}.0",
        "sys_platform": system,
    }
    # A pin is an exact version: no address, no file.
    pins = {
        canonicalize_name(pin.name): str(pin.specifier).removeprefix("==")
        for pin in PINS
        if applies(pin, environment)
    }
    unmet = [
        f"{requirement}: {pinned}"
        for requirement in REQUIREMENTS
        if requirement.name != "jaxmuscle" and applies(requirement, environment)
        for pinned in [pins.get(canonicalize_name(requirement.name))]
        if pinned is None or pinned not in requirement.specifier
    ]
    assert not unmet, "run `make pins`"


def test_a_pin_is_one_version_without_an_address():
    for pin in PINS:
        assert pin.url is None and re.fullmatch(r"==[\w.]+", str(pin.specifier)), pin


def test_hooks_run_what_make_test_runs():
    hooks = (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (recipe,) = re.findall(r"^test test-all:.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    checks = re.findall(r"^\t@?\$\(BIN\)/((?!python)[\w -]+?)(?: &.*)?$", recipe, re.MULTILINE)
    assert re.findall(r"entry: \.venv/bin/([\w -]*\w)", hooks) == checks and len(checks) == 4


def test_changelog_and_citation_begin_with_the_current_version():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    (version, _), *_ = re.findall(
        r"^## \[(.+)\] - (unreleased|\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE
    )
    assert version == jm.__version__
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {jm.__version__}\n" in citation
