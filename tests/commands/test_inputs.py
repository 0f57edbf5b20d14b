"""No command replaces a file that it reads, whatever it is called and whatever is asked."""

import shutil

import numpy as np
import pytest
import typer
from in_process import write_recording, write_spectrum
from test_result import made_result
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app

COMMANDS = typer.main.get_group(app).commands
MADE = {name: command for name, command in COMMANDS.items() if not command.hidden}
# `{}` is the input that an output is named after; the others stand in their own folder
READS = {
    ("fit", "target"): ["spectrum.csv", "fit {} --segments 9"],
    ("fit", "target of several"): ["spectrum.csv", "fit {} vastus-lateralis-26mvc"],
    ("fit", "target that is a recording"): ["trial.csv", "fit {}"],
    ("fit", "hold"): ["trial.csv", "fit {in}/moved.csv --hold {}"],
    ("fit", "groups"): [
        "groups.csv",
        "fit fdi-abduction-45mvc vastus-lateralis-26mvc --groups {}",
    ],
    ("simulate", "preset"): ["preset.toml", "simulate {} --seeds 2"],
    ("ensemble", "preset"): ["preset.toml", "ensemble {} --seeds 2"],
    ("analyse", "paths"): ["trial.csv", "analyse {in}/trial.csv {}"],
    ("analyse", "paths of a moved insertion"): [
        "moved.csv",
        "analyse {} --force-column force_N --displacement x_mm",
    ],
    ("steadiness", "paths"): ["trial.csv", "steadiness {in}/trial.csv {}"],
    ("steadiness", "paths of a study"): ["study.csv", "steadiness {}"],
    ("posterior", "target"): ["spectrum.csv", "posterior {} --segments 9"],
    ("posterior", "target that is a fit"): ["fit.json", "posterior {}"],
    ("identifiability", "target"): ["spectrum.csv", "identifiability {} --segments 9"],
    ("identifiability", "target that is a fit"): ["fit.json", "identifiability {}"],
    ("design", "source"): ["preset.toml", "design {}"],
    ("compare", "target"): ["spectrum.csv", "compare {}"],
    ("study", "table"): ["study.csv", "study {}"],
    ("study", "table of a .toml"): ["study.csv", "study {in}/study.toml"],
    ("study", "table that names a recording"): ["trial.csv", "study {in}/named.csv"],
    ("explore", "what"): ["spectrum.csv", "explore {} --segments 9 --no-open"],
}
TAKEN_UP = {"posterior", "identifiability"}  # a fit.json stays where it is


class Asked(Exception):
    """A command has said what it will replace."""


def options_of(command):
    return {text for parameter in command.params for text in parameter.opts}


def reading(command):
    """The arguments of a command, and its options that name a file to read."""
    return {
        each.name
        for each in command.params
        if each.param_type_name == "argument"
        or (each.metavar == "FILE" and each.name not in ("output", "save_target"))
    }


def test_every_command_that_writes_is_tried():
    writing = {name for name, command in MADE.items() if "--out" in options_of(command)}
    wanted = {(name, parameter) for name in writing for parameter in reading(MADE[name])}
    assert {(name, words.split()[0]) for name, words in READS} == wanted


@pytest.fixture
def here(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    write_spectrum(folder / "spectrum.csv")
    write_recording(folder / "trial.csv")
    write_recording(folder / "moved.csv", x_mm=np.random.default_rng(1).standard_normal(2000))
    (folder / "groups.csv").write_text(
        "target,group\nfdi-abduction-45mvc,a\nvastus-lateralis-26mvc,b\n"
    )
    (folder / "study.csv").write_text(f"file,person\n{folder}/trial.csv,a\n{folder}/moved.csv,b\n")
    jm.Isometric().save(folder / "preset.toml")
    made_result().save(folder / "fit.json")
    return folder


def run(words, folder, path, out):
    """The command with that path as its input; what names it in its place, names it, too."""
    (folder / "study.toml").write_text(f"table = '{path}'\n")
    (folder / "named.csv").write_text(f"file,person\n{path},a\n{folder}/moved.csv,b\n")
    given = [word.replace("{}", str(path)).replace("{in}", str(folder)) for word in words.split()]
    return CliRunner().invoke(app, [*given, "--out", str(out), "--force"])


@pytest.mark.parametrize(("name", "words"), READS, ids=map(" ".join, READS))
def test_what_is_read_is_not_replaced(name, words, here, tmp_path, monkeypatch, sparing):
    """The input is called as each file that the command replaces or removes."""
    content, arguments = READS[name, words]
    out = tmp_path / ("page.html" if name == "explore" else "runs" if name == "ensemble" else "out")
    named = []

    def asked(reads, paths):
        named.extend(paths)
        raise Asked

    with monkeypatch.context() as patch:
        for module in sparing:
            patch.setattr(module, "spare", asked)
        result = run(arguments, here, here / content, out)
        assert isinstance(result.exception, Asked), result.output
    assert named and all(path == out or out in path.parents for path in named)
    told = []
    if words == "target of several":  # a spectrum of another name has another folder
        named = [path for path in named if path.stem in ("cohort", "differences", "spectrum")]
        named = [path for path in named if path.suffix == ".csv" and "vastus" not in str(path)]
    for path in named:
        if name in TAKEN_UP and path.name == content == "fit.json":
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(here / content, path)
        result = run(arguments, here, path, out)
        assert result.exit_code == 2, (path, result.output, result.exception)
        errors = [line for line in result.stderr.splitlines() if "notice:" not in line]
        assert len(errors) == 1 and errors[0].startswith("error: "), (path, result.stderr)
        told.append(f"the result would replace {path}, an input: write it to" in errors[0])
        assert path.read_bytes() == (here / content).read_bytes()
        path.unlink()
    # what is read before may be refused for its ending
    assert any(told) and all(
        said for path, said in zip(named, told, strict=False) if path.suffix == ".csv"
    )


def test_by_whatever_name(here, tmp_path):
    """Links, another folder in the path, and an input in a folder that is replaced as a whole."""
    out = tmp_path / "out"
    out.mkdir()
    shutil.copy(here / "trial.csv", out / "steadiness.csv")
    (here / "link.csv").symlink_to(out / "steadiness.csv")
    (tmp_path / "other").symlink_to(out)
    for given, folder in (
        (here / "link.csv", out),
        (out / "steadiness.csv", tmp_path / "other"),
        (out / ".." / "out" / "steadiness.csv", out),
    ):
        result = run("steadiness {}", here, given, folder)
        assert result.exit_code == 2 and f"would replace {given}" in result.stderr
    shutil.copy(here / "preset.toml", out)
    result = run("ensemble {} --seeds 2", here, out / "preset.toml", out)
    assert result.exit_code == 2 and f"would replace {out}/preset.toml" in result.stderr
    target = tmp_path / "held.toml"
    jm.load_target("vastus-lateralis-26mvc").save(target)
    result = run("analyse {} --save-target {}", here, target, out)
    assert result.exit_code == 2 and f"would replace {target}" in result.stderr


@pytest.mark.parametrize("name", sorted(TAKEN_UP))
def test_a_fit_that_is_taken_up_stays_as_it_is(name, here, tmp_path, monkeypatch):
    def long_work(*_, **__):
        raise jm.errors.SimulationError("the long work")

    monkeypatch.setattr(jm, name, long_work)
    out, path = tmp_path / "out", tmp_path / "out" / "fit.json"
    out.mkdir()
    path.write_text((here / "fit.json").read_text() + "\n\n")
    before = path.read_bytes()
    assert "the long work" in run(f"{name} {{}}", here, path, out).stderr
    assert path.read_bytes() == before
