"""The demo: files that say what they are, commands that can be typed, and results near what is
true of the simulated people."""

import hashlib
import itertools
import shlex

import matplotlib.pyplot as plt
import numpy as np
import pages
import pytest
import typer
from in_process import refused, run

import jaxmuscle as jm
from jaxmuscle.commands import simulated
from jaxmuscle.commands.demo import try_it
from jaxmuscle.commands.main import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("here") / "demo"
    path.mkdir()
    simulated.write_demo(path, try_it("demo"))
    return path


@pytest.fixture(scope="module")
def study(folder):
    return jm.run_study(folder / "study.csv", fit=False)


def digests(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).digest() for path in folder.iterdir()}


def test_every_file_says_that_it_is_simulated(folder):
    files = sorted(folder.iterdir())
    assert len(files) == 39 and sum(path.stat().st_size for path in files) < 10e6
    for path in files:
        if path.name != "study.csv":
            assert "SIMULATED" in path.read_text().splitlines()[0]
    people = {row.split(",")[1] for row in (folder / "study.csv").read_text().splitlines()[1:]}
    assert people == {f"sim0{i}" for i in range(1, 7)}


def test_the_command_writes_the_same_files_again_and_only_if_it_may(folder, tmp_path):
    out = tmp_path / "demo"
    (out).mkdir()
    (out / "README.txt").write_text("mine")
    refused(run("demo", "--out", out), "README.txt: is there already; overwrite it with --force")
    assert [path.name for path in out.iterdir()] == ["README.txt"]
    assert run("demo", "--out", out, "--force").exit_code == 0
    assert digests(out) == digests(folder)


def test_the_commands_that_it_prints_can_be_typed(folder):
    lines = try_it("demo").splitlines()
    assert "\n".join(lines) in (folder / "README.txt").read_text()
    for line in lines:
        program, command, *arguments = shlex.split(line)
        assert program == "jaxmuscle" and command in typer.main.get_group(app).commands
        files = [text for text in arguments if text.startswith("demo/")]
        assert files and all(list(folder.parent.glob(text)) for text in files)


def test_people_are_as_the_readme_says(study, folder):
    """Six trials of a person: their mean is known to 1.5 % over the root of six."""
    text = (folder / "README.txt").read_text()
    measured = {(cell.person, cell.condition): cell.target.measured for cell in study.cells}
    for person in simulated.PEOPLE:
        assert f"{person.name}   {person.force:.0f} N" in text
        means = [measured[person.name, each.name]["mean"].value for each in simulated.CONDITIONS]
        assert np.mean(means) == pytest.approx(person.force, rel=4 * simulated.LEVEL / np.sqrt(6))
        tired = measured[person.name, "tired"]["tremor_frequency"]
        # the muscle smooths: the peak lies lower, by less than its width of 2 Hz
        assert person.tremor_frequency - 2 < tired.value < person.tremor_frequency + 0.4


def test_tired_people_are_less_steady(study):
    found = {each.quantity: each for each in study.differences()}
    for quantity in ("coefficient_of_variation", "relative_power_4_8"):
        assert found[quantity].difference > 0 and found[quantity].p_corrected < 0.05
    assert found["mean"].p > 0.05


def test_the_moved_limb_has_its_spring_damper_and_mass(folder, tmp_path):
    columns = jm.data.two_channels(folder / "moved.csv")
    recording = jm.load_recording(folder / "moved.csv", **columns).steady()
    for name, true in zip(
        "KBI", (simulated.STIFFNESS, simulated.DAMPING, simulated.MASS), strict=True
    ):
        found = recording.second_order()[name]
        assert abs(found.value - true) < 4 * found.stderr < 0.2 * true
    # so does the command find both columns, unless the force alone is asked for
    given = run("analyse", folder / "moved.csv", "--out", tmp_path / "both")
    assert "treated as one of a motor-driven limb" in given.stderr
    assert (tmp_path / "both" / "response.csv").exists()
    run("analyse", folder / "moved.csv", "--column", "force_N", "--out", tmp_path / "force")
    assert not (tmp_path / "force" / "response.csv").exists()


def quoted(page, first):
    """The lines of the block of a page that begins with these words."""
    lines = (pages.ROOT / page).read_text(encoding="utf-8").splitlines()
    block = lines[lines.index(f"    {first}") :]
    return [line[4:] for line in itertools.takewhile(lambda line: line.startswith("    "), block)]


def test_pages_quote_what_is_printed(folder, study, monkeypatch):
    """Each line of an output in README and tutorials; their Python is run."""
    monkeypatch.chdir(folder.parent)
    steadiness = pages.run("docs/tutorial-steadiness.md")["found"]
    measured = "sim01_tired   3 trials of force (N), 14.3 s each (steady part, automatic)"
    table = "STUDY  6 people in 2 conditions (rest; tired)"
    for page, first, result in (
        ("README.md", measured, steadiness),
        ("docs/tutorial-steadiness.md", measured, steadiness),
        ("docs/tutorial-steadiness.md", table, study),
    ):
        assert set(quoted(page, first)) <= set(str(result).splitlines()), (page, first)
    pages.run("docs/tutorial-study.md")
    assert (folder / "mine.csv").read_text() == (folder / "study.csv").read_text()
    (folder / "mine.csv").unlink()
    first = next(line for line in str(study).splitlines() if line.startswith("DIFFERENCES"))
    of_both = quoted("docs/tutorial-study.md", first)
    of_model = next(i for i, line in enumerate(of_both) if line.startswith("MODEL"))
    assert set(of_both[:of_model]) <= set(str(study).splitlines())
    analysed = run("analyse", "demo/moved.csv", "--out", "moved").stdout.splitlines()
    wanted = quoted(
        "docs/perturbed.md", "  gain       723.5 to 4897 N/m, standard error 4.7 % (median)"
    )
    assert set(wanted) <= {line.rstrip() for line in analysed}


def test_the_first_picture_is_drawn_of_them(folder):
    """Names of axes with their units, and what is stated in it is what was measured."""
    figure = pages.module(pages.ROOT / "docs" / "results.py").draw(folder)
    figure.draw_without_rendering()
    _, spectra, stiffness = figure.axes
    assert spectra.get_ylabel() == "Power (1e-6 mean²/Hz)" and "(N/m)" in stiffness.get_ylabel()
    (words,) = (text.get_text() for text in stiffness.texts)
    stated = float(words.removeprefix("K = ").partition(" ")[0])
    assert stated == pytest.approx(simulated.STIFFNESS, rel=0.05)
    assert "Simulated" in figure.get_supxlabel()
    plt.close(figure)
