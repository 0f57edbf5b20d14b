"""Commands and hostile input: what is no file, a reader that crashes, and names that lead
elsewhere."""

import json
import os

import in_process
import pytest
import tomli_w
from in_process import POWER, run, write_spectrum
from test_result import made_result

import jaxmuscle as jm
from jaxmuscle._common import figures


def refused(result, words):
    """Exit code 2 and one sentence."""
    in_process.refused(result, words)
    assert len(result.stderr.strip().splitlines()) == 1


COMMANDS = {
    "fit": ("trial.mat", []),
    "fit a spectrum": ("spectrum.csv", []),
    "fit groups": ("groups.csv", ["fdi-abduction-45mvc", "vastus-lateralis-26mvc", "--groups"]),
    "analyse": ("trial.csv", []),
    "steadiness": ("trial.edf", []),
    "posterior": ("fit.json", []),
    "compare": ("target.toml", []),
    "identifiability": ("fit.json", []),
    "design": ("fit.json", []),
    "design a preset": ("preset.toml", []),
    "simulate": ("preset.toml", []),
    "ensemble": ("fit.json", ["--seeds", 2]),
    "speed": ("preset.toml", []),
    "study": ("study.csv", []),
}


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes are those of POSIX")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_does_not_wait_for_a_pipe(command, tmp_path):
    name, before = COMMANDS[command]
    path, out = tmp_path / name, [] if command == "speed" else ["--out", tmp_path / "out"]
    os.mkfifo(path)
    first = command.partition(" ")[0]
    refused(run(first, *before, path, *out), f"{path}: is a named pipe; give ")


NESTED = {
    "tables.json": '{"a":' * 100_000,
    "lists.json": "[" * 100_000,
    "lists.toml": "a=" + "[" * 50_000,
    "keys.toml": "a" + ".a" * 3000 + "=1",  # of 50 000 names tomllib makes 10 GB
    "quoted.toml": '["a"' + " . 'a'" * 3000 + "]",
    "inline.toml": 'a = {"\\"" = 1, ' + '"\\"".' * 3000 + "b = 1}",
}
# Of every command that reads JSON or TOML, what it reads of it.
DOCUMENTS = {
    "fit": (".toml",),
    "compare": (".toml",),
    "posterior": (".toml",),
    "identifiability": (".toml",),
    "explore": (".json", ".toml"),
    "simulate": (".json", ".toml"),
    "ensemble": (".json", ".toml"),
    "speed": (".json", ".toml"),
    "design": (".json", ".toml"),
    "study": (".toml",),
    "steadiness": (".toml",),
}


@pytest.mark.parametrize("file", NESTED)
@pytest.mark.parametrize("command", DOCUMENTS)
def test_a_nested_file_is_one_sentence(command, file, tmp_path):
    path = tmp_path / file
    if path.suffix not in DOCUMENTS[command]:
        pytest.skip("not read by this command")
    path.write_text(NESTED[file])
    seeds = ["--seeds", 2] if command == "ensemble" else []
    out = [] if command == "speed" else ["--out", tmp_path / "out.html"]
    result = run(command, path, *seeds, *out)
    refused(result, f"{path}: is nested too deeply")


def test_a_nested_result_is_no_obstacle(tmp_path, monkeypatch):
    """What an earlier fit.json says of other files, of which there may be none."""
    monkeypatch.setattr(jm, "fit", lambda *_, **__: made_result())
    (tmp_path / "fit.json").write_text(NESTED["tables.json"])
    path = write_spectrum(tmp_path / "mine.csv")
    assert run("fit", path, "--out", tmp_path, "--force").exit_code == 0


def test_a_nested_store_is_one_sentence(tmp_path):
    path = tmp_path / "runs.zarr"
    path.mkdir()
    (path / "zarr.json").write_text(NESTED["tables.json"])
    given = ["zagrodny-slifkin", "--seeds", 2, "--out", path, "--resume"]
    refused(run("ensemble", *given), f"{path}: is not a sto")


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_reader_that_crashes_is_exit_code_2(tmp_path, monkeypatch):
    (tmp_path / "ezc3d.py").write_text("import os\ndef c3d(path):\n    os.abort()\n")
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "trial.c3d"
    path.write_bytes(b"c3d")
    refused(
        run("analyse", path, "--out", tmp_path / "out"),
        f"{path}: cannot be read as .c3d: its reader crashed (SIGABRT)",
    )


def test_names_out_of_files_do_nothing_to_the_terminal(tmp_path):
    path = tmp_path / "trial.csv"
    path.write_text(
        "time,a\x1b[2J,b\n" + "".join(f"{i / 100},{i % 7},{i % 5}\n" for i in range(200))
    )
    result = run("analyse", path, "--out", tmp_path / "out")
    refused(result, "a\\x1b[2J")
    assert "\x1b" not in result.stderr


def test_a_message_quotes_no_whole_file(tmp_path):
    path = tmp_path / "study.csv"
    path.write_text("x" * 100_000)
    result = run("study", path, "--out", tmp_path / "out")
    refused(result, "line 1: needs a column file (found: xxx")
    assert len(result.stderr) < 1000


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"target,group\n\xff\xfe,a\n", "is not UTF-8 text"),
        (b"target,group\na\0,b\n", "is not UTF-8 text"),
        ("target,group\na,b\n".encode("utf-16"), "is not UTF-8 text"),
        (b"target,group\n" + b"a" * 200_000 + b",b\n", "is not CSV: field larger than field limit"),
        (b"", "is empty"),
    ],
)
def test_groups_that_are_no_text(text, message, tmp_path):
    path = tmp_path / "groups.csv"
    path.write_bytes(text)
    result = run(
        "fit",
        "fdi-abduction-45mvc",
        "vastus-lateralis-26mvc",
        "--groups",
        path,
        "--out",
        tmp_path / "out",
    )
    refused(result, f"{path}: {message}")


NAMES = {
    "../../x": "___.._x",
    "/absolute": "_absolute",
    "Anna": "Anna",
    "anna": "anna-2",
    "a/b": "a_b-2",
    "a_b": "a_b",
    "cohort.csv": "cohort.csv-2",
    "nul": "_nul",
    "a\0b\x1b[2J": "a_b_[2J",
    "..": "_",
    "x" * 300: "x" * 100,
}


def test_fits_of_many_targets_stay_in_their_folder(tmp_path, monkeypatch):
    """Whatever the targets are called; the numbers of the fit are not what is tested."""
    inner = tmp_path / "in" / "ner"
    inner.mkdir(parents=True)
    paths = [inner / f"{number}.toml" for number in range(len(NAMES))]
    for path, name in zip(paths, NAMES, strict=True):
        path.write_text(tomli_w.dumps(jm.Target("name", POWER).to_table() | {"name": name}))

    def fitted(targets, **options):
        return jm.fits.CohortResult({t.name: made_result() for t in targets}, {}, {})

    monkeypatch.setattr(jm, "fit_cohort", fitted, raising=False)

    def drawn(figure, folder, name, formats):
        (folder / f"{name}.png").touch()
        return [f"{name}.png"]

    monkeypatch.setattr(figures, "write_figure", drawn)
    before, out = set(tmp_path.rglob("*")), inner / "out"
    result = run("fit", *paths, "--out", out, "--json")
    assert result.exit_code in (0, 1)
    written = set(tmp_path.rglob("*")) - before
    assert all(path == out or out in path.parents for path in written)
    assert {path.name for path in out.iterdir() if path.is_dir()} == set(NAMES.values())
    places = {name: str(out / place / "fit.json") for name, place in NAMES.items()}
    assert json.loads(result.stdout.splitlines()[-1])["fits"] == places
    assert (
        "../../x: cannot be the name of a folder here; its fit is in" in result.stderr
        and "\x1b" not in result.stderr
    )
    assert "Anna: cannot" not in result.stderr
    again = run("fit", *paths, "--out", out)
    refused(again, "is there already; overwrite it with --force")
