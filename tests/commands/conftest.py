"""What a command replaces or removes, it has first held against what it reads."""

import importlib
import os
from pathlib import Path

import jax
import pytest
from typer.testing import CliRunner

# those that have the function by name
SPARING = [
    importlib.import_module(f"jaxmuscle.commands.{name}")
    for name in ("console", "analyse", "ensemble", "explore")
]


@pytest.fixture
def sparing():
    """The modules that have `spare`."""
    return SPARING


@pytest.fixture(autouse=True)
def keep_settings(monkeypatch):
    """Commands switch cache and precision; the tests keep theirs. Messages are not to be broken
    into lines."""
    monkeypatch.setenv("COLUMNS", "1000")
    names = ("jax_compilation_cache_dir", "jax_enable_x64")
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.fixture(autouse=True)
def what_commands_replace(monkeypatch):
    """Every command that a test of this folder runs: the files that go in a folder which it writes
    are those that it named before (`console.writable`, `console.spare`)."""
    named, gone, running = set(), set(), []
    spare, invoke = SPARING[0].spare, CliRunner.invoke
    replace, unlink, rename = os.replace, Path.unlink, Path.rename

    def spared(reads, paths):
        paths = list(paths)
        named.update(map(os.path.abspath, paths))
        spare(reads, paths)

    def note(path):
        if running and not Path(path).name.startswith("."):  # else a temporary one
            gone.add(os.path.abspath(path))

    def replaced(source, target, **kept):
        note(target)
        replace(source, target, **kept)

    def unlinked(path, missing_ok=False):
        if path.exists():
            note(path)
        unlink(path, missing_ok)

    def renamed(path, target):
        note(path)
        return rename(path, target)

    def invoked(*arguments, **keywords):
        named.clear()
        gone.clear()
        running.append(True)
        try:
            result = invoke(*arguments, **keywords)
        finally:
            running.clear()
        folders = {os.path.dirname(path) for path in named}
        unnamed = {path for path in gone if os.path.dirname(path) in folders} - named
        assert not unnamed, f"replaced, but not named in `writable`: {sorted(unnamed)}"
        return result

    for module in SPARING:
        monkeypatch.setattr(module, "spare", spared)
    monkeypatch.setattr(os, "replace", replaced)
    monkeypatch.setattr(Path, "unlink", unlinked)
    monkeypatch.setattr(Path, "rename", renamed)
    monkeypatch.setattr(CliRunner, "invoke", invoked)
