"""The command: what it writes, its exit codes, and one line instead of a traceback for a user's
mistake."""

import csv
import dataclasses
import functools
import gc
import importlib
import inspect
import json
import os
import re
import signal
import subprocess
import sys
import types
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import typer
from in_process import GRID, POWER, refused, run
from processes import ended, python
from test_result import assert_equal, failed_result, made_result
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle import paper
from jaxmuscle._common.arrays import as_arrays
from jaxmuscle.commands.console import write_fit
from jaxmuscle.commands.main import app
from jaxmuscle.paper._claims import claims_json
from jaxmuscle.paper._verdicts import Row
from jaxmuscle.response._expected_moments import expected_moments
from jaxmuscle.spectra._settings import WINDOW


def csv_file(folder, rows=30, name="spectrum.csv", **changes):
    """A spectrum on the grid; `changes` replace data lines by number."""
    lines = [f"{f:.6f},{p:.6f}" for f, p in zip(GRID[:rows], POWER[:rows], strict=True)]
    for number, text in changes.items():
        lines[int(number.removeprefix("line"))] = text
    path = folder / name
    path.write_text("frequency_hz,proportional_power\n" + "\n".join(lines) + "\n")
    return path


# --- what a user tries first


def test_the_other_spelling_is_the_same_command():
    ours, other = (typer.main.get_group(app).commands[name] for name in ("analyse", "analyze"))
    assert (
        inspect.unwrap(ours.callback) is inspect.unwrap(other.callback)
        and other.hidden
        and not ours.hidden
    )
    said = run("analyse", "--help").output
    assert run("analyze", "--help").output == said.replace("analyse [OPTIONS]", "analyze [OPTIONS]")


@pytest.mark.parametrize(
    ("words", "meant"), [("jaxmuscle stu", "study"), ("jaxmuscle fit --start", "--starts")]
)
def test_the_shell_completes_commands_and_options(words, meant):
    asked = {
        "_JAXMUSCLE_COMPLETE": "complete_bash",
        "COMP_WORDS": words,
        "COMP_CWORD": str(words.count(" ")),
    }
    assert CliRunner().invoke(app, [], prog_name="jaxmuscle", env=asked).output.split() == [meant]


# --- a user's mistakes: exit code 2 and what would be right

FILES = {
    "missing": (None, "spectrum.csv: no such file"),
    "header only": ("frequency_hz,proportional_power\n", "holds a header but no data"),
    "binary": (b"\x89PNG\r\n\x1a\n\xff\x00", "spectrum.csv: "),
    "negative power": (
        {"line3": "1.5625,-0.1"},
        "line 5: power -0.1 must be larger than 0. If it is in dB or a logarithm",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_bad_target_files(case, tmp_path):
    content, message = FILES[case]
    path = tmp_path / "spectrum.csv"
    if isinstance(content, dict):
        csv_file(tmp_path, **content)
    elif content is not None:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
    result = run("fit", path, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert message in result.stderr and str(path) in result.stderr
    assert not (tmp_path / "out").exists()


def test_a_folder_as_target(tmp_path):
    result = run("fit", tmp_path, "--out", tmp_path / "out")
    assert result.exit_code == 2 and str(tmp_path) in result.stderr


def test_broken_toml_as_target(tmp_path):
    path = tmp_path / "target.toml"
    path.write_text("name = [")
    refused(run("fit", path), f"{path}: is not valid TOML")


OPTIONS = {
    "unknown target": (["vastus-lateralis-26mv"], "did you mean 'vastus-lateralis-26mvc'"),
    "unknown free parameter": (["{csv}", "--free", "c_W"], "'c_W': did you mean 'c_w'"),
    "nothing free": (["{csv}", "--free", ","], "name at least one; put commas between several"),
    "unknown fixed parameter": (
        ["{csv}", "--fix", "k_ww=1"],
        "'k_ww' of Isometric: did you mean 'k_w'",
    ),
    "fix without value": (["{csv}", "--fix", "k_w"], "--fix 'k_w': write NAME=VALUE"),
    "fix with empty value": (["{csv}", "--fix", "k_w="], "--fix 'k_w=': write NAME=VALUE"),
    "fix without name": (["{csv}", "--fix", "=3"], "--fix '=3': write NAME=VALUE"),
    "fix with a word": (
        ["{csv}", "--fix", "k_w=stiff"],
        "--fix 'k_w=stiff': write NAME=VALUE with a number",
    ),
    "fix with two values": (["{csv}", "--fix", "k_w=1=2"], "--fix 'k_w=1=2': write NAME=VALUE"),
    "fix with nan": (["{csv}", "--fix", "k_w=nan"], "write NAME=VALUE with a number"),
    "fix twice, differently": (
        ["{csv}", "--fix", "k_w=1e5", "--fix", "k_w=2e5"],
        "--fix 'k_w=2e5': k_w is fixed twice",
    ),
    "unknown noise": (["{csv}", "--noise", "purple"], "'--noise'"),
    "one model and a richest one": (
        ["{csv}", "--rung", "2", "--rungs", "1"],
        "--rung fits one model to one spectrum",
    ),
    "one model for several spectra": (
        ["{csv}", "{csv}", "--rung", "2"],
        "--rung fits one model to one spectrum",
    ),
    "noise of a model that has its own": (
        ["{csv}", "--rung", "2", "--noise", "pink"],
        "--rung: the models with twitch",
    ),
    "unknown task": (["{csv}", "--task", "isotonic"], "'--task'"),
    "unknown method": (["{csv}", "--method", "linaer"], "'--method'"),
    # Typer words these; what matters is which option.
    "no starts": (["{csv}", "--starts", "0"], "--starts"),
    "no seeds": (["{csv}", "--seeds", "0"], "--seeds"),
    "no segments": (["{csv}", "--segments", "0"], "--segments"),
    "unknown quantity": (
        ["{csv}", "--quantity", "forces"],
        "unknown quantity 'forces'; did you mean 'force'",
    ),
    "same name twice": (["{csv}", "{csv}"], "two targets are called 'spectrum'"),
    "no target": ([], "Missing argument"),
    "unknown option": (["{csv}", "--start", "3"], "No such option"),
}


@pytest.mark.parametrize("case", OPTIONS)
def test_bad_options(case, tmp_path):
    arguments, message = OPTIONS[case]
    path = csv_file(tmp_path)
    refused(
        run("fit", *[a.format(csv=path) for a in arguments], "--out", tmp_path / "out"), message
    )
    assert not list(tmp_path.glob("out/**/fit.json"))


def test_out_is_a_file(tmp_path):
    path = csv_file(tmp_path)
    result = run("fit", path, "--out", path)
    assert (
        result.exit_code == 2
        and "--out" in result.stderr
        and "is a file; give the name of a folder" in result.stderr
    )
    below = run("fit", path, "--out", path / "folder")
    assert below.exit_code == 2 and str(path) in below.stderr


PRESETS = {
    "unknown": ("zagrodny-slifki", "unknown preset 'zagrodny-slifki'"),
    "missing file": ("{folder}/missing.toml", "missing.toml: no such file"),
    "folder": ("{folder}", "is a folder; give a preset (.toml) or a fit.json"),
    "empty file": ("{folder}/empty.toml", "empty.toml: is empty"),
    "broken file": ("{folder}/broken.toml", "broken.toml: is not valid TOML"),
    "broken fit.json": ("{folder}/fit.json", "fit.json: is not valid JSON"),
}


@pytest.mark.parametrize("case", PRESETS)
def test_bad_presets(case, tmp_path):
    (tmp_path / "empty.toml").write_text("")
    (tmp_path / "broken.toml").write_text("= 3")
    (tmp_path / "fit.json").write_text("{")
    given, message = PRESETS[case]
    refused(run("simulate", given.format(folder=tmp_path), "--out", tmp_path / "out"), message)


def test_the_nearest_preset_is_named(tmp_path):
    for name in jm.list_presets():
        result = run("simulate", name[:-1], "--out", tmp_path / "out")
        refused(result, f"did you mean '{name}'")


def test_a_preset_with_a_mean_force_is_simulated_at_it(tmp_path):
    """The same random numbers: the force of every instant is multiplied by the ratio of the
    means."""
    preset, found = tmp_path / "anna.toml", []
    jm.Isometric().save(preset)
    table = preset.read_text()
    expected = float(
        expected_moments(as_arrays(jm.Isometric()), jm.SpectrumSettings(), WINDOW)[0].mean
    )
    for stated in ("", 'mean = 4050\nunit = "mN"\n'):
        preset.write_text(stated + table)
        outcome = run(
            "simulate", preset, "--seeds", 4, "--json", "--force", "--out", tmp_path / "out"
        )
        assert outcome.exit_code == 0
        found.append(strict(outcome.stdout))
    # single precision
    assert found[1]["mean"] / found[0]["mean"] == pytest.approx(4.05 / expected, rel=1e-4)
    assert found[1]["coefficient_of_variation"] == pytest.approx(
        found[0]["coefficient_of_variation"], rel=1e-3
    )
    preset.write_text('mean = 30\nunit = "% MVC"\n' + table)
    refused(
        run("simulate", preset, "--out", tmp_path / "other"),
        "anna.toml: unit = '% MVC': the parameters of a task are in newtons",
    )


def test_what_is_observed_of_a_motion(tmp_path):
    arguments = [
        "simulate",
        "zagrodny-slifkin",
        "--observe",
        "acceleration",
        "--seeds",
        4,
        "--out",
        tmp_path,
    ]
    denied = run(*arguments)
    assert denied.exit_code == 2
    assert (
        "the output of PrescribedMotion is no motion; add --task prescribed-force" in denied.stderr
    )
    outcome = run(*arguments, "--task", "prescribed-force")
    assert (
        outcome.exit_code == 0
        and "a_z: mean" in outcome.stdout
        and "m/s^2, standard deviation" in outcome.stdout
    )


def test_a_moved_insertion_is_simulated(tmp_path):
    """The force of every instant long before and after a step is that of the muscle at rest at that
    length."""
    import xarray
    from scipy.optimize import brentq

    quiet = {
        "harmonic_amplitude": 0.0,
        "noise_K_w": 1e-4,
        "noise_K_z": 0.0,
        "noise_C_w": 0.0,
        "noise_C_z": 0.0,
    }
    task = jm.PrescribedLength(x_z=jm.model.SmoothStep(-0.004, 6.0, 1.0)).replace(**quiet)
    task.save(tmp_path / "moved.toml")
    arguments = ["--task", "prescribed-length", "--seeds", 4, "--json", "--out", tmp_path]
    found = strict(run("simulate", tmp_path / "moved.toml", *arguments).stdout)
    assert found["task"] == "PrescribedLength" and found["quantity"] == "F_ext"
    with xarray.open_dataset(tmp_path / "trajectories.nc", engine="h5netcdf") as data:
        force, time = np.asarray(data["F_ext"]), np.asarray(data["time"])
    k_w, k_z, P_w, x_ref = (float(task[name]) for name in ("k_w", "k_z", "P_w", "x_ref_w"))
    for x_z, when in ((0.0, (time > 4.0) & (time < 5.9)), (-0.004, time > 12.0)):
        tissue = k_z * (float(task["x_ref_z"]) ** 2 + x_z**2)
        x_w = brentq(
            lambda x, x_z=x_z, tissue=tissue: (
                k_w * (x_ref**2 + x**2) * x + tissue * (x - x_z) - P_w
            ),
            -0.1,
            0.1,
        )
        assert when.any()
        # the noise makes 1e-4
        np.testing.assert_allclose(force[:, when], tissue * (x_w - x_z), rtol=1e-3)


# --- listings


def test_listings_and_help_do_not_wait_for_jax():
    code = """
import sys
from typer.testing import CliRunner
from jaxmuscle.commands.main import app
helps = [["--help"], ["fit", "--help"], ["simulate", "--help"]]
for arguments in (["targets"], ["presets"], ["targets", "--json"], *helps):
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, (arguments, result.output)
    slow = {"jax", "numpy", "scipy", "matplotlib", "xarray"} & set(sys.modules)
    assert not slow, (arguments, slow)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


@pytest.mark.skipif(sys.platform == "win32", reason="has no SIGPIPE")
@pytest.mark.parametrize("arguments", [["targets"], ["targets", "--json"], ["fit", "--help"]])
def test_an_output_that_nobody_reads_ends_the_command_in_silence(arguments):
    """As in `jaxmuscle targets | head`; the shell calls it 141."""
    command = [sys.executable, "-m", "jaxmuscle", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(60) == -signal.SIGPIPE


def test_listings_name_everything():
    assert run("presets").exit_code == 0
    listed = run("targets").stdout
    for name in jm.list_targets():
        assert name in listed
    for provenance in ("measured", "reconstructed"):
        assert provenance in listed
    listed = run("presets").stdout
    for name in jm.list_presets():
        assert name in listed


# --- whole runs


def read_columns(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A small fit from a CSV file, by the command."""
    folder = tmp_path_factory.mktemp("fit")
    path = csv_file(folder)
    fast = ["--starts", 2, "--seeds", 8, "--segments", 12, "--seed", 5]
    result = run(
        "fit", path, "--free", "c_w, noise_K_w", "--fix", "m_w=0.4", *fast, "--out", folder / "out"
    )
    return result, folder / "out"


def test_a_fit_writes_result_table_and_figure(fitted):
    outcome, folder = fitted
    assert outcome.exit_code == 0
    assert sorted(p.name for p in folder.iterdir()) == [
        "fit.json",
        "fit.png",
        "report.html",
        "spectrum.csv",
    ]
    result = jm.load_result(folder / "fit.json")
    assert result.success and result.seed == 5 and result.free == ("c_w", "noise_K_w")
    assert result.parameters["m_w"].value == 0.4 and len(result.starts) == 2
    assert result.target.segments == (12,)
    columns = read_columns(folder / "spectrum.csv")
    np.testing.assert_allclose(columns["frequency_hz"], GRID, rtol=1e-7)
    # six decimals in the file
    np.testing.assert_allclose(columns["target"], POWER / POWER.sum(), rtol=1e-4)
    np.testing.assert_allclose(columns["fitted"], result.fitted, rtol=1e-7)
    assert (folder / "fit.png").read_bytes().startswith(b"\x89PNG")


def test_a_fit_prints_what_it_found(fitted):
    outcome, folder = fitted
    for part in (
        "median frequency",
        "half-power frequency",
        "MODEL  ",
        "NOT KNOWN from these data: ",
        f"{folder}/fit.json",
    ):
        assert part in outcome.stdout
    assert "rescaled to 1" in outcome.stderr
    # Nothing but the parameters that were fitted, and few of what follows from them.
    assert "m_w" not in outcome.stdout and "corner_frequency" not in outcome.stdout


def test_verbose_prints_everything(tmp_path, monkeypatch):
    monkeypatch.setattr(jm, "fit", lambda *_, **__: made_result())
    path = csv_file(tmp_path)
    short = run("fit", path, "--out", tmp_path / "short")
    whole = run("fit", path, "-v", "--out", tmp_path / "whole")
    assert short.exit_code == whole.exit_code == 0
    again = run("fit", tmp_path / "short" / "fit.json")
    assert again.exit_code == 0 and short.stdout.startswith(again.stdout)
    assert str(made_result()).splitlines()[:8] == again.stdout.splitlines()[:8]
    assert whole.stdout.startswith(made_result().details())
    assert "models tried" in whole.stdout and "models tried" not in short.stdout
    more = f"jaxmuscle fit {tmp_path / 'short' / 'fit.json'} -v"
    assert more in " ".join(short.stdout.split()) and "All numbers" not in whole.stdout
    assert (
        run("fit", tmp_path / "short" / "fit.json", "-v").stdout == made_result().details() + "\n"
    )
    kept, same = ((tmp_path / name / "fit.json").read_bytes() for name in ("short", "whole"))
    assert kept == same


def test_what_was_fitted_can_be_explored(fitted, tmp_path):
    _, folder = fitted
    assert (
        run("explore", folder / "fit.json", "--out", tmp_path / "page.html", "--no-open").exit_code
        == 0
    )
    (text,) = re.findall(
        r'id="content">(.*)</script>', (tmp_path / "page.html").read_text(encoding="utf-8")
    )
    state, result = json.loads(text)["state"], jm.load_result(folder / "fit.json")
    assert state["table"]["muscle"]["damping_w"]["c"] == result.parameters["c_w"].value
    assert (
        state["target"]["segments"] == [12]
        and state["target"]["proportional_power"] == result.target.proportional_power.tolist()
    )


@pytest.mark.filterwarnings("ignore:.*K_w is negative")  # so it is in this made-up spectrum
def test_what_to_measure_next_is_told_of_a_fit(fitted, tmp_path):
    _, folder = fitted
    outcome = run("identifiability", folder / "fit.json", "--out", tmp_path)
    assert outcome.exit_code == 0 and "most would be learnt from" in outcome.stdout
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "fit.json",
        "identifiability.json",
        "identifiability.png",
    ]
    found = jm.identifiability(jm.load_result(folder / "fit.json"))
    kept = json.loads((tmp_path / "identifiability.json").read_text())
    assert kept["present"]["determined"] == found.present.determined
    assert [design["name"] for design in kept["designs"]] == [
        design.name for design in found.designs
    ]
    assert (
        strict(
            run(
                "identifiability", tmp_path / "fit.json", "--out", tmp_path, "--force", "--json"
            ).stdout
        )
        == kept
    )
    refused(
        run("identifiability", folder / "fit.json", "--segments", 12, "--out", tmp_path / "new"),
        "is a fit; its task, parameters and target stay",
    )


@pytest.mark.parametrize(
    ("quantities", "told"),
    [
        ({"K_w0": types.SimpleNamespace(determined=False)}, True),
        ({"K_w0": types.SimpleNamespace(determined=True)}, False),
        ({}, False),
    ],
)
def test_where_the_stiffness_is_open_it_is_told_how_long_to_record(
    quantities, told, tmp_path, monkeypatch
):
    """What to ask for next, only where it would help."""
    made = types.SimpleNamespace(
        present=types.SimpleNamespace(quantities=quantities),
        plot=plt.figure,
        save=lambda path: path.write_text("{}"),
    )
    module = importlib.import_module("jaxmuscle.commands.identifiability")
    monkeypatch.setattr(module, "fit_into", lambda *_: None)
    monkeypatch.setattr(jm, "identifiability", lambda _: made)
    outcome = run("identifiability", "some.toml", "--out", tmp_path)
    assert outcome.exit_code == 0
    assert (
        f"jaxmuscle design {tmp_path}/fit.json --quantity K_w_tangent --error 10" in outcome.stdout
    ) == told
    assert ("How long must a record with a moved insertion be?" in outcome.stdout) == told


THREADS = ("OPENBLAS_NUM_THREADS", "PJRT_NPROC")


@pytest.mark.parametrize(
    ("command", "given", "expected"),
    [
        ("fit", {}, ("1", "1")),
        ("--quiet fit", {}, ("1", "1")),
        ("fit --seeds 4096", {}, ("1", None)),
        ("fit --seeds=4096", {}, ("1", None)),
        ("posterior", {}, ("1", "1")),
        ("check", {}, ("1", None)),
        ("ensemble", {}, ("1", None)),
        ("posterior", dict.fromkeys(THREADS, "3"), ("3", "3")),
    ],
)
def test_commands_set_of_the_environment_what_the_user_has_not(
    command, given, expected, monkeypatch
):
    """Before anything large is imported, and only as long as this test."""
    for name in THREADS:
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    seen, thresholds, handler = [], gc.get_threshold(), signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(
        "jaxmuscle.commands.main.main", lambda: seen.append(tuple(map(os.environ.get, THREADS)))
    )
    monkeypatch.setattr(sys, "argv", ["jaxmuscle", *command.split(), "target"])
    try:
        importlib.import_module("jaxmuscle.__main__").main()
    finally:
        gc.set_threshold(*thresholds)
        signal.signal(signal.SIGINT, handler)
    assert seen == [expected]


def test_what_was_fitted_can_be_simulated(fitted, tmp_path):
    import xarray

    _, folder = fitted
    outcome = run(
        "simulate", folder / "fit.json", "--seeds", 8, "--seed", 2, "--json", "--out", tmp_path
    )
    assert outcome.exit_code == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "simulate.png",
        "spectrum.csv",
        "trajectories.nc",
    ]
    task = jm.load_result(folder / "fit.json").task
    runs = jm.ensemble(task, jax.random.key(2), seeds=8)
    with xarray.open_dataset(tmp_path / "trajectories.nc", engine="h5netcdf") as data:
        np.testing.assert_array_equal(data["F_ext"], runs.output)
        assert json.loads(data.attrs["parameters"])["c_w"]["value"] == task["c_w"]
    columns = read_columns(tmp_path / "spectrum.csv")
    estimate = runs.mean_spectrum()
    np.testing.assert_allclose(columns["power"], estimate.power, rtol=1e-5)
    np.testing.assert_allclose(columns["power_stderr"], estimate.stderr, rtol=1e-5)
    assert np.all(columns["quantile_05"] < columns["quantile_95"])
    found = strict(outcome.stdout)
    assert (
        found["seeds"] == 8
        and found["unit"] == "N"
        and found["mean"] == pytest.approx(float(runs.filtered().mean()))
    )
    assert found["spectrum"].keys() == columns.keys() and all(
        Path(file).exists() for file in found["files"]
    )
    np.testing.assert_allclose(found["spectrum"]["power"], columns["power"], rtol=1e-7)


def test_several_targets_have_a_folder_each(tmp_path, monkeypatch):
    seen = []

    def fake(targets, *, task, noise, **options):
        seen.append((task, noise))
        a, b = targets
        return jm.fits.CohortResult(
            {a.name: made_result(target=a), b.name: failed_result()}, {}, {}
        )

    monkeypatch.setattr(jm, "fit_cohort", fake)
    paths = [csv_file(tmp_path, name=f"{name}.csv") for name in "ab"]
    arguments = (
        "--task",
        "prescribed-force",
        "--noise",
        "ornstein-uhlenbeck",
        "--out",
        tmp_path / "out",
    )
    outcome = run("fit", *paths, *arguments)
    assert outcome.exit_code == 1  # one of the two failed
    assert seen == [(jm.PrescribedForce, "ornstein-uhlenbeck")]
    assert jm.load_result(tmp_path / "out" / "a" / "fit.json").success
    assert not jm.load_result(tmp_path / "out" / "b" / "fit.json").success


@pytest.mark.parametrize(
    ("result", "code", "word"),
    [
        (made_result(), 0, "MODEL  slow part + regular rhythm: fits, p = 0.4"),
        (made_result(success=False), 1, "MODEL  not fitted: "),
        (failed_result(), 1, "MODEL  not fitted: "),
    ],
    ids=["converged", "not converged", "exploded"],
)
def test_the_exit_code_says_whether_it_converged(result, code, word, tmp_path, monkeypatch):
    monkeypatch.setattr(jm, "fit", lambda *_, **__: result)
    (tmp_path / "fit.png").write_text("of an earlier fit")
    outcome = run("fit", csv_file(tmp_path, name="mine.csv"), "--out", tmp_path)
    assert outcome.exit_code == code
    first, *rest = outcome.stdout.splitlines()
    assert first.startswith("made   spectrum of force (user)")
    assert any(line.startswith(word) for line in rest)
    assert result.success or result.message in " ".join(outcome.stdout.split())
    assert_equal(jm.load_result(tmp_path / "fit.json"), result)
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
    assert len(read_columns(tmp_path / "spectrum.csv")["fitted"]) == 30


def test_options_reach_the_fit(tmp_path, monkeypatch):
    seen = {}

    def fake(task, target, **options):
        seen.update(options, task=task, target=target)
        return made_result()

    monkeypatch.setattr(jm, "fit", fake)
    fixed = ("--fix", "noise_K_z=0", "--fix", "noise_C_z = 0")
    many = (
        "--free",
        " c_w ,k_w,",
        "--starts",
        3,
        "--seeds",
        9,
        "--seed",
        4,
        "--segments",
        7,
    )
    path = csv_file(tmp_path, name="mine.csv")
    assert run("fit", path, "--noise", "white", *fixed, *many, "--out", tmp_path).exit_code == 0
    expected = {
        "free": ["c_w", "k_w"],
        "fix": {"noise_K_z": 0.0, "noise_C_z": 0.0},
        "noise": "white",
        "starts": 3,
        "method": "linear",
        "seeds": 9,
        "key": 4,
    }
    assert {name: seen[name] for name in expected} == expected
    assert seen["target"].segments == (7,) and isinstance(seen["task"], jm.Isometric)


def test_one_model_of_the_ladder_is_fitted(tmp_path, monkeypatch):
    seen = {}

    def fake(task, target, **options):
        seen.update(options, task=task)
        return made_result()

    monkeypatch.setattr(jm, "fit", fake)
    assert (
        run(
            "fit", csv_file(tmp_path), "--rung", "2", "--quick", "--out", tmp_path / "out"
        ).exit_code
        == 0
    )
    assert seen["task"] == jm.model.on_rung(jm.Isometric(), 2) and seen["rungs"] == 0


def test_a_failing_simulation_is_not_a_users_mistake(tmp_path, monkeypatch):
    def explode(*_, **__):
        raise jm.errors.SimulationError("3 seed(s) did not stay finite [0, 1, 2]")

    monkeypatch.setattr(jm, "ensemble", explode)
    made_result().save(tmp_path / "fit.json")
    outcome = run("simulate", tmp_path / "fit.json", "--out", tmp_path / "out")
    assert (
        outcome.exit_code == 1
        and "failed: 3 seed(s) did not stay finite [0, 1, 2]" in outcome.stderr
    )


# --- for scripts: exit codes, JSON, what is there already


def raising(error):
    def instead(*_, **__):
        raise error

    return instead


REACHED = raising(jm.errors.SimulationError("the long work was reached"))
HALF = made_result(success=False, message="interrupted after 3 steps")
STOPPED = jm.fits.FitInterrupted((HALF.task,), lambda: HALF)
# What a fit does: exit code, whether there is a result.
ENDS = {
    "converged": (lambda *_, **__: made_result(), 0, True),
    "not converged": (lambda *_, **__: failed_result(), 1, True),
    "exploded": (REACHED, 1, False),
    "bad argument": (
        raising(ValueError("c_w = -1 N s^2/m^2 is outside its range, 0 or more")),
        2,
        False,
    ),
    "no file": (
        raising(FileNotFoundError(2, "No such file or directory", "spectrum.csv")),
        2,
        False,
    ),
    "interrupted": (raising(KeyboardInterrupt), 130, False),
    "interrupted with a result": (raising(STOPPED), 130, True),
}


def strict(text):
    """JSON without NaN and Infinity, which its standard does not know."""
    return json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is not JSON"))


@pytest.mark.parametrize("case", ENDS)
def test_exit_codes_and_json(case, tmp_path, monkeypatch):
    fake, code, there = ENDS[case]
    monkeypatch.setattr(jm, "fit", fake)
    path = csv_file(tmp_path)
    plain = run("fit", path, "--out", tmp_path / "text")
    outcome = run("fit", path, "--json", "--out", tmp_path / "json")
    assert plain.exit_code == outcome.exit_code == code
    assert outcome.stderr == plain.stderr.replace(str(tmp_path / "text"), str(tmp_path / "json"))
    assert "rescaled to 1" in outcome.stderr  # notices are for people
    if there:
        assert strict(outcome.stdout) == strict((tmp_path / "json" / "fit.json").read_text())
        assert outcome.stdout.count("\n") == 1
    else:
        assert outcome.stdout == "" and len(outcome.stderr.splitlines()) == 2
    assert "{" not in plain.stdout


@pytest.mark.parametrize(
    "arguments",
    [["fits"], ["fit"], ["targets", "--jason"], ["speed", "--seeds", "many"]],
    ids=" ".join,
)
def test_what_cannot_be_read_ends_with_2(arguments):
    outcome = run(*arguments)
    assert outcome.exit_code == 2 and outcome.stdout == "" and outcome.stderr.startswith("Usage: ")


def test_listings_as_json():
    found = strict(run("targets", "--json").stdout)["targets"]
    assert [entry["name"] for entry in found] == list(jm.list_targets())
    assert {entry["quantity"] for entry in found} <= {"force", "torque", "displacement"}
    assert [entry["name"] for entry in strict(run("presets", "--json").stdout)["presets"]] == list(
        jm.list_presets()
    )
    assert run("targets").stdout.startswith("Bundled targets")  # nothing of --json is left


GROUPS = {"a": "old", "b": "young"}


def test_a_cohort_as_json(tmp_path, monkeypatch):
    results = {"a": made_result(), "b": failed_result()}
    monkeypatch.setattr(
        jm, "fit_cohort", lambda *_, **__: jm.fits.CohortResult(results, GROUPS, {"c": "no file"})
    )
    outcome = run(
        "fit",
        *[csv_file(tmp_path, name=f"{name}.csv") for name in "ab"],
        "--json",
        "--out",
        tmp_path / "out",
    )
    assert outcome.exit_code == 2  # c could not be read
    found = strict(outcome.stdout)
    assert found["success"] is False and found["failed"] == {"c": "no file"}
    differences = [(row["quantity"], row["a"], row["b"]) for row in found["differences"]]
    measured = dict.fromkeys(row["quantity"] for row in found["table"] if row["kind"] == "measured")
    assert {"coefficient_of_variation", "share_8_12"} < set(measured)
    assert {row[1:] for row in differences} == {("old", "young")}
    assert [row[0] for row in differences if row[0] not in measured] == ["c_w"]
    # "a" has no scale of force: what has newtons is over its mean of 2.5 N. "b" failed: NaN is
    # null.
    assert [row["value"] for row in found["table"] if row["quantity"] == "model_mean"] == [None]
    assert next(
        row["value"] for row in found["table"] if row["quantity"] == "c_w"
    ) == pytest.approx(50 / 3 / 2.5)
    assert jm.load_result(found["fits"]["a"]).success
    assert (
        len(found["table"]) == len((tmp_path / "out" / "cohort.csv").read_text().splitlines()) - 1
    )
    assert (tmp_path / "out" / "differences.csv").exists()


def test_a_cohort_leaves_nothing_of_an_earlier_one(tmp_path, monkeypatch):
    """One without groups has no differences; what others wrote there stays."""
    for name in ("differences.csv", "mine.csv"):
        (tmp_path / name).write_text("of an earlier cohort")
    monkeypatch.setattr(
        jm, "fit_cohort", lambda *_, **__: jm.fits.CohortResult({"a": failed_result()}, {}, {})
    )
    assert (
        run(
            "fit", *[csv_file(tmp_path, name=f"{name}.csv") for name in "ab"], "--out", tmp_path
        ).exit_code
        == 1
    )
    assert not (tmp_path / "differences.csv").exists()
    assert (tmp_path / "mine.csv").read_text() == "of an earlier cohort"


def test_the_paper_as_json(tmp_path, monkeypatch):
    row = Row(
        "key", "fitted", "[30]", "says", "ours", (1.0, np.nan), "how", "does not agree", "why"
    )
    monkeypatch.setattr(paper, "reproduce", lambda *_, **__: None)
    monkeypatch.setattr(paper, "check", lambda found: (row,))
    found = strict(run("reproduce", "--json", "--out", tmp_path).stdout)
    assert found["claims"] == strict(claims_json((row,))) and found["claims"][0]["numbers"] == [
        1.0,
        None,
    ]
    assert found["summary"] == paper.counted([row])


# The long work of a command, its arguments, and what it would overwrite.
OVERWRITES = {
    "fit": ("fit", ["fit", "{csv}"], ["fit.json"]),
    "several": (
        "fit_cohort",
        ["fit", "{csv}", "vastus-lateralis-26mvc"],
        ["cohort.csv", "spectrum/fit.json", "vastus-lateralis-26mvc/fit.json"],
    ),
    "simulate": ("ensemble", ["simulate", "zagrodny-slifkin"], ["trajectories.nc"]),
    "analyse": (
        "load_recording",
        ["analyse", "{csv}", "--save-target", "{out}/held.toml"],
        ["analysis.json", "held.toml"],
    ),
    "posterior": (
        "fit",
        ["posterior", "{csv}", "--segments", "9"],
        ["fit.json", "posterior.nc", "posterior.json"],
    ),
    "identifiability": (
        "fit",
        ["identifiability", "{csv}", "--segments", "9"],
        ["fit.json", "identifiability.json"],
    ),
    "compare": ("comparison.compare_noise", ["compare", "{csv}"], ["compare.json"]),
    "reproduce": ("paper.reproduce", ["reproduce"], ["claims.json"]),
    "demo": ("ensemble", ["demo"], ["study.csv", "moved.csv", "README.txt", "sim06_tired_3.csv"]),
}


@pytest.mark.parametrize(
    ("case", "file"), [(case, file) for case, (*_, files) in OVERWRITES.items() for file in files]
)
def test_an_earlier_result_is_overwritten_by_force_only(case, file, tmp_path, monkeypatch):
    work, arguments, _ = OVERWRITES[case]
    monkeypatch.setattr(f"jaxmuscle.{work}", REACHED)
    out, path = tmp_path / "out", csv_file(tmp_path)
    arguments = [*(a.format(csv=path, out=out) for a in arguments), "--out", out]
    reached = run(*arguments)
    assert reached.exit_code == 1 and "the long work was reached" in reached.stderr
    (out / file).parent.mkdir(exist_ok=True)
    (out / file).write_text("a result")
    denied = run(*arguments)
    assert denied.exit_code == 2 and denied.stdout == ""
    assert f"{out / file}: is there already; overwrite it with --force" in denied.stderr
    assert (out / file).read_text() == "a result"
    assert run(*arguments, "--force").exit_code == 1
    assert (out / file).read_text() == "a result"  # until there is a new one


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("--error", "200", "--error 200: give a percentage between 0 and 100"),
        ("--error", "0", "--error 0: give a perc"),
        ("--rms", "-1", "--rms -1: give a number of mm above 0"),
        ("--acceleration", "0", "--acceleration 0: give a num"),
    ],
)
def test_design_refuses_numbers_in_the_units_of_its_options(option, value, words, tmp_path):
    denied = run("design", "zagrodny-slifkin", f"{option}={value}", "--out", tmp_path)
    assert denied.exit_code == 2 and words in " ".join(denied.stderr.split())


@pytest.mark.parametrize("force", [(), ("--force",)])
def test_a_spectrum_is_not_replaced_by_its_own_fit(tmp_path, force):
    path = csv_file(tmp_path)  # spectrum.csv, as a fit calls what it writes
    before = path.read_text()
    refused(
        run("fit", path, "--segments", "9", "--out", tmp_path, *force),
        f"the result would replace {path}",
    )
    assert path.read_text() == before


def test_the_spectrum_of_another_command_is_kept(tmp_path, capsys):
    """`fit`, `analyse` and `simulate` write different tables as spectrum.csv, by default into one
    folder."""
    path, result = tmp_path / "spectrum.csv", made_result()
    path.write_text("frequency_hz,power,proportional_power\n1,2,3\n")
    (tmp_path / "spectrum-other.csv").write_text("still another\n")
    write_fit(result, tmp_path)
    assert (
        " ".join(capsys.readouterr().err.replace(str(tmp_path), "").split())
        == "notice: /spectrum.csv was there, from another command. It is kept as"
        " /spectrum-other-2.csv."
    )
    assert path.read_text().startswith("frequency_hz,target,fitted,")
    assert (tmp_path / "spectrum-other.csv").read_text() == "still another\n"
    assert (
        tmp_path / "spectrum-other-2.csv"
    ).read_text() == "frequency_hz,power,proportional_power\n1,2,3\n"
    write_fit(result, tmp_path)  # its own is replaced
    assert capsys.readouterr().err == "" and len(list(tmp_path.glob("spectrum*.csv"))) == 3


def test_analyse_and_simulate_keep_the_spectrum_of_another_command(tmp_path):
    tremor = tmp_path / "trial.csv"
    time = np.arange(0, 20, 0.01)
    force = (
        10
        + 0.1 * np.sin(2 * np.pi * 8 * time)
        + 0.05 * np.random.default_rng(0).standard_normal(time.size)
    )
    tremor.write_text(
        "time_s,force_N\n" + "".join(f"{t:.2f},{f:.6f}\n" for t, f in zip(time, force, strict=True))
    )
    out = tmp_path / "out"
    assert run("analyse", tremor, "--out", out).exit_code == 0
    first = (out / "spectrum.csv").read_text()
    simulated = run("simulate", "zagrodny-slifkin", "--seeds", 2, "--out", out)
    assert simulated.exit_code == 0 and "It is kept as" in " ".join(simulated.stderr.split())
    assert (out / "spectrum-other.csv").read_text() == first
    second = (out / "spectrum.csv").read_text()
    again = run("analyse", tremor, "--out", out, "--force")
    assert again.exit_code == 0 and (out / "spectrum.csv").read_text() == first
    assert (out / "spectrum-other-2.csv").read_text() == second


def test_a_fit_that_is_taken_up_is_no_obstacle(tmp_path, monkeypatch):
    made_result().save(tmp_path / "fit.json")
    monkeypatch.setattr(jm, "posterior", REACHED)
    assert "was reached" in run("posterior", tmp_path / "fit.json", "--out", tmp_path).stderr
    (tmp_path / "posterior.json").write_text("a result")
    assert (
        "posterior.json: is there already"
        in run("posterior", tmp_path / "fit.json", "--out", tmp_path).stderr
    )


@pytest.mark.parametrize(
    "option", [("--noise", "pink"), ("--free", "k_w"), ("--fix", "k_w=4e5"), ("--segments", "9")]
)
def test_what_a_fit_has_settled_cannot_be_asked_for_again(option, tmp_path):
    made_result().save(tmp_path / "fit.json")
    refused(
        run("posterior", tmp_path / "fit.json", *option, "--out", tmp_path / "out"),
        f"stay as they are, so leave out {option[0]}",
    )


def made_comparison(target, *, success):
    """Two models; the search of the second one ended as told."""
    task = jm.model.on_rung(jm.Isometric(), 2)
    scores = np.linspace(-2.0, -1.0, len(target.bins))
    rows = [
        jm.comparison.ComparedModel(
            noise,
            False,
            -10.0,
            4.0,
            aic,
            aic - 28.0,
            weight,
            float(scores.sum()),
            0.0,
            0.0,
            1.0,
            0.4,
            settled,
            scores,
        )
        for noise, aic, weight, settled in (
            ("band-limited", 28.0, 0.9, True),
            ("resonance", 32.0, 0.1, success),
        )
    ]
    tasks = {("band-limited", False): jm.Isometric(), ("resonance", False): task}
    fitted = {(row.noise, row.harmonic): np.asarray(target.proportional_power) for row in rows}
    return jm.comparison.Comparison(target, tuple(rows), {}, tasks, fitted, 12.0, 3, 0)


@pytest.mark.parametrize("success", [True, False])
def test_the_spectrum_of_a_fit_is_compared(success, tmp_path, monkeypatch):
    """`compare` takes a fit.json and says which search did not converge, in words and in the
    figure."""
    result, asked = made_result(), []

    def compared(task, target, **options):
        asked.append((task, target))
        return made_comparison(target, success=success)

    result.save(tmp_path / "fit.json")
    monkeypatch.setattr(jm.comparison, "compare_noise", compared)
    outcome = run("compare", tmp_path / "fit.json", "--out", tmp_path / "out")
    ((task, target),) = asked
    assert_equal(target, result.target)
    assert type(task) is type(result.task)
    unsettled = "the search did not converge for resonance, no harmonic. Do not use these rows"
    assert (outcome.exit_code, unsettled in outcome.output) == (
        (0, False) if success else (1, True)
    )
    assert (
        success
        or "fix a parameter of these models, for example --fix resonance_width=" in outcome.output
    )
    figure = made_comparison(target, success=success).plot()
    marks = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert ("not converged" in marks) is not success
    denied = run(
        "compare", tmp_path / "fit.json", "--segments", "12", "--out", tmp_path / "out", "--force"
    )
    assert (
        denied.exit_code == 2
        and "--segments: the spectrum of a fit states this already" in denied.stderr
    )


def test_a_fit_is_replaced(tmp_path, monkeypatch):
    for seed, force in ((1, ()), (2, ("--force",))):
        monkeypatch.setattr(jm, "fit", lambda *_, seed=seed, **__: made_result(seed=seed))
        assert (
            run("fit", csv_file(tmp_path, name="mine.csv"), "--out", tmp_path, *force).exit_code
            == 0
        )
        assert jm.load_result(tmp_path / "fit.json").seed == seed


@pytest.mark.parametrize("name", sorted(typer.main.get_group(app).commands))
def test_every_command_speaks_json_and_asks_before_it_overwrites(name):
    options = {
        text for option in typer.main.get_group(app).commands[name].params for text in option.opts
    }
    assert "--json" in options and ("--force" in options) == ("--out" in options)


# --- interruption


def test_an_interrupted_fit_writes_what_had_been_reached(tmp_path, monkeypatch):
    def report():
        # while programs are compiled, perhaps
        assert jm.load_preset(tmp_path / "out" / "reached.toml") == HALF.task
        return HALF

    monkeypatch.setattr(jm, "fit", raising(jm.fits.FitInterrupted((HALF.task,), report)))
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "fit.png").write_text("of an earlier fit")
    outcome = run("fit", csv_file(tmp_path), "--out", tmp_path / "out")
    assert outcome.exit_code == 130 and not (tmp_path / "out" / "fit.png").exists()
    assert f"what had been reached is in {tmp_path / 'out'}" in outcome.stderr
    assert not jm.load_result(tmp_path / "out" / "fit.json").success
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "fit.json",
        "spectrum.csv",
    ]


def test_an_interruption_before_the_first_step_writes_nothing(tmp_path, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(jm, "fit", interrupted)
    outcome = run("fit", csv_file(tmp_path), "--out", tmp_path / "out")
    assert (
        outcome.exit_code == 130
        and "interrupted: nothing was written, the fit had no table yet" in outcome.stderr
    )
    assert not (tmp_path / "out").exists()


def test_ctrl_c(tmp_path):
    """A real signal, once the first steps have been taken."""
    code = """
import contextlib, signal, time
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
from jaxmuscle.__main__ import main
from jaxmuscle.commands import fit as _cli_fit, signals
signals.LIMIT = 200  # what reports a fit may have to be compiled

@contextlib.contextmanager
def loud(progress, title):
    def tell(text, share):
        print(text, flush=True)
        if text.startswith("searching from"):
            time.sleep(60)  # until the signal
    yield tell

_cli_fit.told = loud
main()
"""
    arguments = [
        "fit",
        str(csv_file(tmp_path)),
        "--free",
        "c_w,noise_K_w",
        "--starts",
        "4",
        "--seeds",
        "24",
    ]
    process = python(code, *arguments, "--out", str(tmp_path / "out"))
    for line in process.stdout:
        if line.startswith("searching from"):
            process.send_signal(signal.SIGINT)
            break
    _, errors = ended(process, 130)
    assert "Traceback" not in errors and "what had been reached" in errors
    result = jm.load_result(tmp_path / "out" / "fit.json")
    assert not result.success and "interrupted after" in result.message
    assert np.all(np.isfinite(read_columns(tmp_path / "out" / "spectrum.csv")["fitted"]))


def test_the_console_script_is_the_command():
    script = Path(sys.executable).with_name("jaxmuscle")
    done = subprocess.run(
        [script, "targets"], capture_output=True, text=True, env={**os.environ, "COLUMNS": "200"}
    )
    assert done.returncode == 0 and "vastus-lateralis-26mvc" in done.stdout
    wrong = subprocess.run([script, "tragets"], capture_output=True, text=True)
    assert wrong.returncode == 2 and "tragets" in wrong.stderr


@pytest.mark.usefixtures("as_fine_as_shipped")
def test_steadiness_of_trials(tmp_path):
    """The last one is too short."""
    rng, files = np.random.default_rng(0), []
    for i, seconds in enumerate([8, 8, 8, 3]):
        held = 10 + np.convolve(
            rng.standard_normal(100 * seconds + 99), np.ones(100) / 100, "valid"
        )
        rows = "".join(f"{k / 100:.2f},{x:.6f}\n" for k, x in enumerate(held))
        files.append(tmp_path / f"trial{i}.csv")
        files[-1].write_text(f"time (s),force (N)\n{rows}")
    result = run("steadiness", *files[:3], "--window", "0:8,1:8,0:8", "--out", tmp_path / "out")
    assert result.exit_code == 0 and "3 trials of force (N), 7.0 s to 8.0 s each" in result.stdout
    windows = ((0, 8), (1, 8), (0, 8))
    each = zip(files, windows, strict=False)
    found = jm.data.steadiness(
        [jm.load_recording(str(file)).steady(window) for file, window in each]
    )
    with open(tmp_path / "out" / "steadiness.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["trial"] for row in rows[:: len(found.measures)]] == [
        "trial0",
        "trial1",
        "trial2",
        "all",
    ]
    for row in rows[-len(found.measures) :]:
        measure = found[row["quantity"]]
        assert row["unit"] == measure.unit and row["error_from"] == "trials"
        assert (row["value"] == "" and np.isnan(measure.value)) or float(
            row["value"]
        ) == pytest.approx(measure.value)
        ends = tuple(float(row[end]) for end in ("low", "high") if row[end])
        assert ends == (() if measure.interval is None else pytest.approx(measure.interval))
    read = json.loads((tmp_path / "out" / "steadiness.json").read_text())
    assert read["measures"]["mean"]["stderr"] == pytest.approx(found["mean"].stderr)
    assert (tmp_path / "out" / "steadiness.png").stat().st_size > 10_000
    for arguments, message in (
        ((files[0], "--window", "0-8"), "--window 0-8: give start and end in s"),
        (
            (*files[:2], "--window", "0:8,1:8,2:8"),
            "--window 0:8,1:8,2:8: 3 windows for 2 recordings. Give one for all",
        ),
        ((files[0], files[3], "--window", "all"), "trial3 lasts 3 s; give at least 3.84 s"),
        ((files[0], tmp_path / "none.csv"), "none.csv"),
    ):
        wrong = run("steadiness", *arguments, "--out", tmp_path / "wrong")
        refused(wrong, message)


ASKED = (
    "--quantity",
    "K_w0,C_w0",
    "--rms",
    "0.5",
    "--peak",
    "0.9",
    "--band",
    "0.2:4",
    "--seconds",
    "20",
    "--rate",
    "50",
)


@functools.cache
def designed():
    """What these options ask for."""
    return jm.uncertainty.design_input(
        jm.Isometric(),
        ("K_w0", "C_w0"),
        rms=5e-4,
        peak=9e-4,
        band=(0.2, 4.0),
        seconds=20.0,
        rate=50.0,
        error=0.1,
    )


@pytest.fixture
def muscle(tmp_path):
    preset = tmp_path / "muscle.toml"
    jm.Isometric().save(preset)
    return preset


@pytest.mark.usefixtures("as_fine_as_shipped")
def test_a_designed_motion(muscle, tmp_path):
    result = run(
        "design",
        muscle,
        *ASKED,
        "--error",
        "10",
        "--out",
        tmp_path / "out",
        "--json",
    )
    assert result.exit_code == 0
    found = designed()
    table = json.loads(result.stdout)
    assert table == json.loads((tmp_path / "out" / "design.json").read_text())
    assert table["needed"] == {"error": 0.1, "seconds": pytest.approx(found.needed[1])}
    assert table["quantities"]["K_w0"]["stderr"] == pytest.approx(found.stderr["K_w0"])
    assert table["gain"] == pytest.approx(found.gain) and table["quantity"] == ["K_w0", "C_w0"]
    signal = np.loadtxt(tmp_path / "out" / "motor.csv", delimiter=",", skiprows=3)
    np.testing.assert_allclose(signal[:, 1], 1e3 * found.displacement, rtol=1e-6, atol=1e-9)
    assert (tmp_path / "out" / "design.png").stat().st_size > 10_000
    for arguments, message in (
        (("--out", tmp_path / "out"), "motor.csv: is there already; overwrite it with --force"),
        (
            ("--band", "5", "--out", tmp_path / "new"),
            "--band 5: give lowest and highest frequency in Hz, as --band 0.5:5",
        ),
        (("--quantity", "K", "--out", tmp_path / "new"), "quantity 'K' is unknown"),
    ):
        wrong = run("design", muscle, *arguments)
        refused(wrong, message)


def test_how_to_play_and_fit_a_designed_motion_is_told(muscle, tmp_path, monkeypatch):
    """Above is what was designed, found by the command itself."""
    longer = designed()
    once = dataclasses.replace(longer, needed=None)
    found = iter([once, longer])
    monkeypatch.setattr(jm.uncertainty, "design_input", lambda *_, **__: next(found))
    said = run("design", muscle, *ASKED, "--out", tmp_path / "out").stdout
    assert (
        "    jaxmuscle fit RECORD.csv --task prescribed-length --window 10:30 --out out/moved\n"
        in said
    )
    assert (
        "    jaxmuscle fit RECORD.csv --hold HOLD.csv --window 10:30,auto --out out/both\n" in said
    )
    assert "Play the motion for 32 s: motor.csv holds one period of 20 s" in " ".join(said.split())
    said = run(
        "design", muscle, *ASKED, "--error", "10", "--out", tmp_path / "out", "--force"
    ).stdout
    end = 10 + 20 * np.ceil(longer.needed[1] / 20)
    assert end > 30 and f"Play {end + 2:.3g} s and analyse 10 to {end:.3g} s" in " ".join(
        said.split()
    )
    assert f"--window 10:{end:g} --out out/moved\n" in said  # as long as is said above


def test_a_motion_is_designed_for_a_fit_and_not_for_a_spectrum(tmp_path):
    refused(
        run("design", "vastus-lateralis-26mvc", "--out", tmp_path),
        "jaxmuscle fit vastus-lateralis-26mvc --out out/fit",
    )


COMMANDS = sorted(typer.main.get_group(app).commands)
DRAWING = {
    "analyse",
    "analyze",
    "compare",
    "design",
    "fit",
    "identifiability",
    "posterior",
    "simulate",
    "steadiness",
    "study",
}


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_that_draws_has_formats(name):
    options = {
        text for option in typer.main.get_group(app).commands[name].params for text in option.opts
    }
    assert ("--format" in options) == (name in DRAWING)


@pytest.mark.parametrize(
    "arguments",
    [["--help"], *([name, "--help"] for name in COMMANDS), ["targets"], ["presets"]],
    ids=" ".join,
)
def test_output_fits_80_columns(arguments, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = run(*arguments).output.splitlines()
    assert len(lines) > 4 and max(map(len, lines)) <= 80
