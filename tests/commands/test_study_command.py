"""`jaxmuscle study`: mistakes in one line, a folder that is not overwritten unasked, what is
printed."""

import contextlib

import numpy as np
import pandas
import pytest
from in_process import run
from test_study import made_study
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle._common.errors import WorkersLostError
from jaxmuscle.commands import study as study_command
from jaxmuscle.commands.main import app


@pytest.fixture
def table(tmp_path):
    for name in "ab":
        np.save(
            tmp_path / f"{name}.npy", 5 + np.random.default_rng(ord(name)).standard_normal(1200)
        )
    path = tmp_path / "study.csv"
    path.write_text("file,person\na.npy,a\nb.npy,b\n")
    return path


def command(*arguments):
    return run("study", *arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "study.csv: line 2: "),  # no rate
        (("--rate", 100, "--axis", "q"), "study.csv: line 2: --axis 'q': choose one of x, y, z"),
        (("--rate", 100, "--rung", 7), "rung = 7: give a rung of the ladder"),
        (("--window", "early"), "--window early: give start and end in s"),
        (("--quantities", "tremor_frequenzy"), "did you mean 'tremor_frequency'?"),
    ],
)
def test_mistakes(options, message, table, tmp_path):
    result = command(table, "--out", tmp_path / "out", *options)
    assert result.exit_code == 2 and message in result.stderr, result.stderr
    assert not (tmp_path / "out" / "study.json").exists()


def test_other_processes_do_the_work(table, tmp_path, monkeypatch):
    asked = []

    @contextlib.contextmanager
    def workers_of(*given):
        asked.append(given)
        yield "client"

    def run_study(path, **options):
        asked.append(options["executor"])
        raise WorkersLostError("the workers are lost. Again")

    monkeypatch.setattr(study_command, "workers_of", workers_of)
    monkeypatch.setattr(jm, "run_study", run_study)
    lost = command(table, "--out", tmp_path / "out", "--scheduler", "host:8786")
    assert lost.exit_code == 1 and "failed: the workers are lost. Again" in lost.stderr
    command(table, "--out", tmp_path / "out", "--workers", 3)
    assert asked == [(None, "host:8786"), "client", (3, None), "client"]
    monkeypatch.undo()
    both = command(table, "--out", tmp_path / "out", "--workers", 2, "--scheduler", "host:8786")
    assert both.exit_code == 2 and "--workers 2 and --scheduler host:8786: give one" in both.stderr


def test_a_study_is_overwritten_only_with_force(table, tmp_path, monkeypatch):
    asked = {}

    def run_study(path, **options):
        asked.update(options)
        return made_study()

    monkeypatch.setattr(jm, "run_study", run_study)
    out = tmp_path / "out"
    first = command(
        table,
        "--out",
        out,
        "--rung",
        "2",
        "--window",
        "1:9",
        "--quantities",
        "mean, resonance_share",
        "--spectrum",
        "slow",
        "--skip-rows",
        2,
        "--time",
        "clock",
    )
    assert first.exit_code == 0, first.stderr
    assert (asked["rung"], asked["window"], asked["quantities"]) == (
        2,
        (1.0, 9.0),
        ["mean", "resonance_share"],
    )
    assert (asked["spectrum"], asked["skip_rows"], asked["time"]) == ("slow", 2, "clock")
    assert not {"max_gap", "axis"} & set(asked)  # of study.toml, if it states them
    assert "STUDY  10 people in 2 groups" in first.stdout and "differences.csv" in first.stdout
    before = (out / "study.json").read_bytes()
    again = command(table, "--out", out)
    assert again.exit_code == 2 and "overwrite it with --force" in again.stderr
    assert (out / "study.json").read_bytes() == before
    assert command(table, "--out", out, "--force").exit_code == 0


def test_steadiness_of_a_study_is_its_measured_part(table, tmp_path):
    out = tmp_path / "out"
    arguments = ["steadiness", table, "--rate", 100, "--window", "1:11", "--out", out]
    result = CliRunner().invoke(app, list(map(str, arguments)), env={"COLUMNS": "300"})
    assert result.exit_code == 0, result.stderr
    found = jm.run_study(table, fit=False, rate=100.0, window=(1.0, 11.0))
    assert "MEASURED  mean ± SD of people" in result.stdout and "MODEL" not in result.stdout
    assert f"Written: {out}/report.html, " in result.stdout
    written = pandas.read_csv(out / "table1.csv", keep_default_na=False)
    assert list(written["quantity"]) == [row["quantity"] for row in found.table_1()]
    values = written["mean"].replace("", "nan").astype(float)
    np.testing.assert_allclose(values, [row["mean"] for row in found.table_1()], rtol=1e-11)
    people = pandas.read_csv(out / "people.csv")
    assert set(people["kind"]) == {"measured"} and set(people["person"]) == {"a", "b"}
    again = CliRunner().invoke(app, [*map(str, arguments), "--force", "--band", "4:9"])
    assert again.exit_code == 2 and "--band: of a study leave it out" in again.stderr
