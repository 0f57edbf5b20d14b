"""Wheel and sdist as a user gets them: built, installed into an empty environment, and used
there."""

import email
import json
import os
import re
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import numpy as np
import pytest

import jaxmuscle as jm

ROOT = Path(__file__).parents[2]
TARGET = "vastus-lateralis-26mvc"

pytestmark = pytest.mark.slow


def run(*command, cwd, **environment):
    kept = {
        name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PIP_"))
    }
    done = subprocess.run(
        [str(c) for c in command],
        cwd=cwd,
        env=kept | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with the sdist of the checkout and the wheel built from that sdist alone."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", folder, cwd=ROOT)
    (archive,) = folder.glob("*.tar.gz")
    with tarfile.open(archive) as sdist:
        sdist.extractall(folder / "unpacked", filter="data")
    (source,) = (folder / "unpacked").iterdir()
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=source)
    return folder


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """An environment with the wheel; what it depends on is borrowed from this one, whose editable
    install is not."""
    folder = tmp_path_factory.mktemp("installed")
    venv.create(folder / "clean", symlinks=True)
    (wheel,) = built.glob("*.whl")
    python = folder / "clean" / "bin" / "python"
    run(
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--no-deps",
        "--no-index",
        wheel,
        cwd=folder,
    )
    purelib = run(
        python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder
    ).strip()
    # A .pth file is not read in a folder that another .pth file names: the editable install stays
    # behind.
    borrowed = [path for path in sys.path if Path(path).name == "site-packages"]
    Path(purelib, "borrowed.pth").write_text("\n".join(borrowed), encoding="utf-8")
    return folder


@pytest.mark.slow
def test_wheel_holds_the_package_and_its_data_and_nothing_else(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    package = ROOT / "src" / "jaxmuscle"
    wanted = {
        f"jaxmuscle/{path.relative_to(package).as_posix()}"
        for path in package.rglob("*")
        if path.is_file()
    }
    wanted = {name for name in wanted if "__pycache__" not in name}
    assert {name for name in names if ".dist-info/" not in name} == wanted
    assert {
        "jaxmuscle/py.typed",
        f"jaxmuscle/targets/{TARGET}.toml",
        "jaxmuscle/presets/zagrodny-slifkin.toml",
    } <= wanted


def test_metadata_of_the_wheel(built):
    (wheel,) = built.glob("*.whl")
    archive = zipfile.ZipFile(wheel)
    folder = f"jaxmuscle-{jm.__version__}.dist-info"
    data = email.message_from_bytes(archive.read(f"{folder}/METADATA"))
    assert (data["Name"], data["Version"], data["License-Expression"]) == (
        "jaxmuscle",
        jm.__version__,
        "Apache-2.0",
    )
    assert data["Description-Content-Type"] == "text/markdown"
    # a page of an index has nothing beside it to which a relative link could lead
    text = data.get_payload()
    assert "make fit" in text
    assert not re.findall(r"\]\((?!https?://)[^)]*\)", text)
    pythons = {f"Programming Language :: Python :: 3.{minor}" for minor in (11, 12, 13)}
    assert pythons <= set(data.get_all("Classifier", []))
    assert set(data.get_all("Provides-Extra", [])) == {
        "all",
        "c3d",
        "dask",
        "kernel",
        "labs",
        "notebooks",
        "posterior",
    }
    assert f"{folder}/licenses/LICENSE" in archive.namelist()
    assert archive.read(f"{folder}/entry_points.txt").decode().split() == [
        "[console_scripts]",
        "jaxmuscle",
        "=",
        "jaxmuscle.__main__:main",
    ]


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="an unpacked sdist has no repository")
def test_sdist_holds_the_files_of_the_repository_and_nothing_else(built):
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}
    ours = run("git", "ls-files", "--cached", "--others", "--exclude-standard", cwd=ROOT)
    assert names == {*ours.splitlines(), "PKG-INFO"}


@pytest.mark.slow
def test_the_installed_package_is_the_wheels_and_has_one_version(installed):
    program = """
import importlib.metadata, json, sys, jaxmuscle as jm
version = importlib.metadata.version("jaxmuscle")
found = [sys.prefix, jm.__file__, version, jm.__version__, jm.list_targets(), jm.list_presets()]
print(json.dumps(found))
"""
    python = installed / "clean" / "bin" / "python"
    prefix, file, *rest = json.loads(run(python, "-c", program, cwd=installed))
    assert Path(prefix) == installed / "clean" and Path(file).is_relative_to(prefix)
    assert rest == [
        jm.__version__,
        jm.__version__,
        list(jm.list_targets()),
        list(jm.list_presets()),
    ]


@pytest.mark.slow
def test_the_installed_command_fits_a_bundled_target(installed):
    command = installed / "clean" / "bin" / "jaxmuscle"
    assert run(command, "--version", cwd=installed).split() == ["jaxmuscle", jm.__version__]
    users = {"XLA_FLAGS": ""}  # not the tests' quick compiler
    assert "simulate.png" in run(
        command, "simulate", "zagrodny-slifkin", "--seeds", "2", cwd=installed, **users
    )
    assert (installed / "out" / "simulate.png").read_bytes().startswith(b"\x89PNG")
    printed = run(command, "fit", TARGET, "--starts", "20", "--out", "out", cwd=installed)
    assert (installed / "out" / "spectrum-other.csv").exists()  # that of the simulation
    assert max(map(len, printed.splitlines())) <= 80
    assert TARGET in printed and "Written: out/fit.json" in printed
    result = jm.load_result(installed / "out" / "fit.json")
    assert result.success and result.target == jm.load_target(TARGET).with_measures()
    assert result.chi2_per_bin is not None and result.chi2_per_bin <= 1.3
    table = np.genfromtxt(installed / "out" / "spectrum.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["target"], result.target.proportional_power, rtol=1e-5)
    assert (installed / "out" / "fit.png").read_bytes().startswith(b"\x89PNG")
