"""Where a command prints and writes: streams that are closed, full or know few letters, disks that
are full, names that would do something there."""

import csv
import importlib.util
import os
import subprocess
import sys

import pytest
import tomli_w
from in_process import GRID, POWER, run, write_recording
from processes import ended, environment, python
from test_result import made_result

import jaxmuscle as jm
from jaxmuscle._common.tables import FORMULAS

SHELL = pytest.mark.skipif(os.name != "posix", reason="of a shell")
FULL = pytest.mark.skipif(not os.path.exists("/dev/full"), reason="of Linux")


def recording(folder, name="trial.csv"):
    return write_recording(folder / name, seed=sum(name.encode()))


# --- streams


def shell(redirected, *arguments, cwd=None, **changes):
    """`jaxmuscle arguments`, a true process, with streams as that end of a shell's line has
    them."""
    line = ["sh", "-c", f'"$@" {redirected}', "sh", sys.executable, "-m", "jaxmuscle"]
    return subprocess.run(
        [*line, *arguments],
        cwd=cwd,
        env=environment(**changes),
        capture_output=True,
        text=True,
        timeout=300,
    )


@SHELL
@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize("arguments", [["targets"], ["--version"], ["fit", "--help"]], ids=" ".join)
def test_a_closed_stream_is_no_obstacle(arguments, closed):
    done = shell(closed, *arguments)
    assert done.returncode == 0 and done.stderr == ""
    assert bool(done.stdout) == (" >&-" not in f" {closed}")


@SHELL
def test_nothing_is_printed_into_a_file_that_takes_the_place_of_a_closed_stream(tmp_path):
    done = shell("<&- >&- 2>&-", "steadiness", recording(tmp_path), "--out", tmp_path / "out")
    assert done.returncode == 0
    whole = run("steadiness", tmp_path / "trial.csv", "--out", tmp_path / "other")
    assert whole.exit_code == 0
    assert (tmp_path / "out" / "steadiness.png").read_bytes().startswith(b"\x89PNG")
    for name in ("steadiness.json", "steadiness.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "other" / name).read_bytes()


@SHELL
@FULL
@pytest.mark.parametrize(
    "arguments",
    [["targets"], ["presets", "--json"], ["--version"], ["fit", "--help"]],
    ids=" ".join,
)
def test_a_full_output_is_one_sentence(arguments):
    done = shell("> /dev/full", *arguments)
    assert (done.returncode, done.stderr) == (2, "error: the output: No space left on device\n")
    # where only messages are lost, the work is not
    assert shell("2> /dev/full", *arguments).returncode == 0


@SHELL
def test_letters_that_the_output_does_not_know(tmp_path):
    done = shell(
        "", "steadiness", recording(tmp_path), "--out", tmp_path / "out", PYTHONIOENCODING="ascii"
    )
    assert done.returncode == 0 and done.stderr.isascii()
    assert r"\xb1" in done.stdout and "Written: " in done.stdout


# --- disks

LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
from jaxmuscle.__main__ import main
main()
"""


@pytest.mark.skipif(sys.platform != "linux", reason="its limits, and its way to make room for HDF5")
@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        (["steadiness", "trial.csv", "--out", "out"], "out/steadiness.json"),
        (["analyse", "trial.csv", "--out", "out"], "out/analysis.png"),
        (["explore", "--no-open", "--out", "page.html"], "page.html"),
        (["simulate", "zagrodny-slifkin", "--seeds", "2", "--out", "out"], "out/trajectories.nc"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_where_a_file_cannot_be_written_it_is_named(arguments, file, tmp_path):
    """A limit acts as a full disk does."""
    recording(tmp_path)
    process = python(LIMITED, *arguments, cwd=tmp_path, JAXMUSCLE_CACHE="off")
    _, errors = ended(process, 2)
    assert f"error: {file}: File too large" in errors and "Traceback" not in errors
    assert not list(tmp_path.rglob(".*"))


@SHELL
@pytest.mark.parametrize("below", ["", "sub"])
def test_a_folder_behind_a_dangling_link(below, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "gone")
    result = run("steadiness", recording(tmp_path), "--out", link / below)
    assert result.exit_code == 2
    assert f"{link} is a link to {tmp_path}/gone, which is not there; make that" in result.stderr


# --- names


def cells_of(folder):
    return [
        cell
        for path in folder.rglob("*.csv")
        for row in csv.reader(path.read_text().splitlines())
        for cell in row
    ]


def assert_harmless(folder, *names):
    cells = cells_of(folder)
    for cell in cells:
        if cell.startswith(FORMULAS):
            float(cell)
    for name in names:
        assert f"'{name}" in cells


def test_names_are_no_formulas_for_a_spreadsheet(tmp_path, monkeypatch):
    """In every table with names out of files: of a study, of trials, of many spectra."""
    rows = [
        {"file": str(recording(tmp_path, f"{n}.csv")), "person": p, "group": g, "condition": c}
        for n, (p, g, c) in enumerate(
            (person, group, condition)
            for person, group in (
                ("=1+1", "@old"),
                ("+b", "@old"),
                ("\tc", "young"),
                ("-d", "young"),
            )
            for condition in ("=cmd|' /C calc'!A0", "rest")
        )
    ]
    (tmp_path / "study.toml").write_text(tomli_w.dumps({"recordings": rows}))
    study = tmp_path / "study"
    assert run("steadiness", tmp_path / "study.toml", "--out", study).exit_code == 0
    assert_harmless(study, "=1+1", "+b", "-d", "@old", "=cmd|' /C calc'!A0")
    assert {"people.csv", "table1.csv", "differences.csv"} <= {p.name for p in study.iterdir()}
    assert any(cell.startswith("-") for cell in cells_of(study))  # a number stays one

    trial = tmp_path / "trial"
    assert run("steadiness", recording(tmp_path, "=a.csv"), "--out", trial).exit_code == 0
    assert_harmless(trial, "=a")

    for name in ("@a", "=b"):
        target = jm.Target("x", POWER).to_table() | {"name": name}
        (tmp_path / f"{name}.toml").write_text(tomli_w.dumps(target))
    groups = {"@a": "+old", "=b": "-young"}
    monkeypatch.setattr(
        jm,
        "fit_cohort",
        lambda *_, **__: jm.fits.CohortResult({n: made_result() for n in groups}, groups, {}),
    )
    files = [tmp_path / f"{name}.toml" for name in groups]
    assert run("fit", *files, "--out", tmp_path / "cohort").exit_code == 0
    assert_harmless(tmp_path / "cohort", "@a", "=b", "+old", "-young")


@SHELL
def test_a_line_break_in_a_name_is_printed_as_its_escape(tmp_path, monkeypatch):
    monkeypatch.setattr(jm, "fit", lambda *_, **__: made_result())
    trial, out = recording(tmp_path, "a\nb.csv"), tmp_path / "o\nut"
    spectrum = tmp_path / "c\nd.csv"
    spectrum.write_text(
        "frequency_hz,proportional_power\n"
        + "".join(f"{f},{p}\n" for f, p in zip(GRID, POWER, strict=True))
    )
    for arguments in (
        ["steadiness", trial],
        ["analyse", trial, "--save-target", out / "t.toml"],
        ["fit", spectrum],
        ["explore", spectrum, "--segments", 9, "--no-open"],
    ):
        place = out / "e.html" if arguments[0] == "explore" else out / arguments[0]
        result = run(*arguments, "--out", place)
        assert result.exit_code == 0, result.output
        assert r"o\nut" in result.stdout
        for text in (result.stdout, result.stderr):
            for name in ("o\nut", "a\nb", "c\nd"):
                assert name not in text


# --- extras


def test_posterior_asks_for_its_extra_before_it_fits(tmp_path, monkeypatch):
    def fitted(*_, **__):
        raise AssertionError("the long work was reached")

    there = importlib.util.find_spec
    missing = ("blackjax", "arviz_stats")
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name in missing else there(name)
    )
    monkeypatch.setattr(jm, "fit", fitted)
    needed = 'posterior needs blackjax and arviz-stats: pip install "jaxmuscle[posterior]"'
    result = run("posterior", "vastus-lateralis-26mvc", "--out", tmp_path / "out")
    assert result.exit_code == 2 and result.stderr == f"error: {needed}\n"
    assert not (tmp_path / "out").exists()
    with pytest.raises(ImportError, match=r"jaxmuscle\[posterior\]"):
        jm.posterior(made_result())


@pytest.mark.parametrize("command", ["study", "steadiness", "analyse", "fit"])
def test_a_library_that_is_missing_is_one_sentence(command, tmp_path, monkeypatch):
    """In every command that reads recordings."""
    (tmp_path / "ezc3d.py").write_text("raise ImportError")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "trial.c3d"
    path.write_bytes(b"c3d")
    (tmp_path / "other.c3d").write_bytes(b"c3d")
    (tmp_path / "study.csv").write_text("file,person\ntrial.c3d,a\nother.c3d,b\n")
    given = {
        "study": [tmp_path / "study.csv"],
        "steadiness": [tmp_path / "study.csv"],
    }.get(command, [path])
    result = run(command, *given, "--out", tmp_path / "out")
    assert result.exit_code == 2 and f"{path}: reading C3D needs ezc3d" in result.stderr
