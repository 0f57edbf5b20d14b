"""Commands that take recordings: several trials make one target, spectra and recordings are not
mixed."""

import contextlib
import io
import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle._common.units import LEVER_ARM
from jaxmuscle.commands.main import app
from jaxmuscle.commands.options import PERTURBED, READING
from jaxmuscle.commands.recordings import read_recordings, read_with_holds
from jaxmuscle.data import _recording_files
from jaxmuscle.data._as_target import as_target
from jaxmuscle.fits._perturbed import recordings_of

RATE, LEVEL = 200, 40.5


def run(*arguments):
    return CliRunner().invoke(app, ["-q", *map(str, arguments)])


def force(seed, seconds=17.0):
    """A held force of 40.5 N whose fluctuation has a corner at 1 Hz."""
    decay = np.exp(-2 * np.pi / RATE)
    noise = np.random.default_rng(seed).normal(size=round(seconds * RATE) + 2000) * np.sqrt(
        1 - decay**2
    )
    x = np.zeros(noise.size)
    for i in range(1, noise.size):
        x[i] = decay * x[i - 1] + noise[i]
    return LEVEL + 0.6 * x[2000:]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five trials, one of them in another unit; and the first three as columns of one file."""
    made = tmp_path_factory.mktemp("trials")
    trials = [force(seed) for seed in range(5)]
    time = np.arange(trials[0].size) / RATE
    for number, x in enumerate(trials):
        np.savetxt(
            made / f"trial{number}.csv",
            np.column_stack([time, x]),
            delimiter=",",
            header="time,force (N)",
            comments="",
            fmt="%.6g",
        )
    np.savetxt(
        made / "all.csv",
        np.column_stack([time, *trials[:3]]),
        delimiter=",",
        header="time,a (N),b (N),c (N)",
        comments="",
        fmt="%.6g",
    )
    (made / "volts.csv").write_text((made / "trial0.csv").read_text().replace("(N)", "(V)"))
    return made


def paths(folder, count=5):
    return [folder / f"trial{number}.csv" for number in range(count)]


@pytest.mark.usefixtures("as_fine_as_shipped")
def test_trials_are_analysed_together(folder, tmp_path):
    found = run(
        "analyse",
        *paths(folder),
        "--out",
        tmp_path,
        "--save-target",
        tmp_path / "anna.toml",
        "--mvc",
        300,
    )
    assert found.exit_code == 0, found.output
    record = json.loads((tmp_path / "analysis.json").read_text())
    assert [trial["recording"]["name"] for trial in record["trials"]] == [
        f"trial{n}" for n in range(5)
    ]
    means = [trial["summary"]["mean"] for trial in record["trials"]]
    target = jm.load_target(tmp_path / "anna.toml")
    assert target.mean == pytest.approx(means) and len(target.segments) == 5
    assert list(target.dispersion) == record["dispersion"] and target.mvc_fraction == pytest.approx(
        np.mean(means) / 300
    )
    np.testing.assert_allclose(
        record["spectrum"]["proportional_power"], target.proportional_power, rtol=1e-9
    )
    assert (tmp_path / "analysis.png").stat().st_size > 20_000
    assert re.search(
        r"their spectra differ [\d.]+ ± [\d.]+ times as much as by chance",
        " ".join(found.output.split()),
    )


def test_a_column_for_each_trial(folder, tmp_path):
    found = run("analyse", folder / "all.csv", "--column", "all", "--out", tmp_path, "--json")
    assert found.exit_code == 0, found.output
    assert len(json.loads(found.stdout)["trials"]) == 3
    refused = run("analyse", folder / "all.csv", "--out", tmp_path, "--force")
    assert refused.exit_code == 2 and "--column" in refused.stderr


REFUSED = {
    "units": (("trial0.csv", "volts.csv"), (), "units N and V cannot be averaged"),
    "mixed": (
        ("trial0.csv", "fdi-abduction-45mvc"),
        (),
        "They cannot be fitted together: fit one at a time",
    ),
    "segments": (
        ("trial0.csv", "trial1.csv"),
        ("--segments", 6),
        "--segments and --dataset belong to spectra",
    ),
    "groups": (("trial0.csv",), ("--groups", "x.csv"), "--groups compares several spectra"),
    "missing": (("nothing.csv", "trial0.csv"), (), "nothing.csv"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_go_together_is_refused(case, folder, tmp_path):
    names, options, message = REFUSED[case]
    given = [name if "." not in name else folder / name for name in names]
    found = run("fit", *given, *options, "--out", tmp_path)
    assert found.exit_code == 2 and message in " ".join(found.stderr.split()), found.stderr


@pytest.fixture
def read(monkeypatch):
    """The files that are read, in turn."""
    files, original = [], _recording_files.read_csv

    def counted(data, file, skip_rows):
        files.append(file)
        return original(data, file, skip_rows)

    monkeypatch.setattr(_recording_files, "read_csv", counted)
    return files


def test_a_command_reads_a_file_once(folder, tmp_path, read):
    reading = {name: default for name, (_, default) in (READING | PERTURBED).items()}
    trials = read_recordings([str(path) for path in paths(folder, 3)], reading, None, None)
    assert isinstance(trials, jm.data.Trials) and read == [str(path) for path in paths(folder, 3)]
    x, noise = np.random.default_rng(9).standard_normal((2, 4000))
    columns = [np.arange(4000) / RATE, 40 + 0.3 * x + 0.1 * noise, x]
    path = str(tmp_path / "both.csv")
    np.savetxt(
        path,
        np.stack(columns, axis=1),
        delimiter=",",
        header="time,force_N,displacement_mm",
        comments="",
    )
    for options in ({}, {"displacement": "displacement_mm"}):
        read.clear()
        (found,) = read_recordings([path], reading | options, "2:18", "prescribed-length")
        assert (
            isinstance(found, jm.data.PerturbedRecording)
            and found.window == pytest.approx((2, 18))
            and read == [path]
        )
    read.clear()
    (force,) = read_recordings([path], reading | {"column": "force_N"}, "all", None)
    assert force.unit == "N" and read == [path]


def test_two_commands_from_raw_trials_to_a_fit(folder, tmp_path):
    """The mean of the fit is that of the recordings within its error."""
    target = tmp_path / "anna.toml"
    assert run("analyse", *paths(folder), "--out", tmp_path, "--save-target", target).exit_code == 0
    options = ("--quick", "--rungs", 0, "--starts", 16)
    assert run("fit", target, *options, "--out", tmp_path / "two").exit_code == 0
    result = jm.load_result(tmp_path / "two" / "fit.json")
    held = [jm.load_recording(path).steady() for path in paths(folder)]
    measured, mean = [np.mean(recording.samples) for recording in held], result["model_mean"]
    assert abs(mean.value - np.mean(measured)) < 2 * mean.stderr < 0.02 * LEVEL
    # One command does the same.
    assert run("fit", *paths(folder), *options, "--out", tmp_path / "one").exit_code == 0
    again = jm.load_result(tmp_path / "one" / "fit.json")
    assert again["model_mean"].value == pytest.approx(mean.value)
    assert again.chi2_per_bin == pytest.approx(result.chi2_per_bin)
    own = jm.data.steadiness(held)
    for name in ("mean", "coefficient_of_variation", "sample_entropy", "median_frequency"):
        assert again[name] == result[name] == own[name]


def with_angle(path, moves):
    """A trial as a dynamometer writes it: torque, and the angle of the joint, which moves by so
    many degrees."""
    torque = force(3)
    time = np.arange(torque.size)
    columns = [time / RATE, torque, 30 + moves * np.sqrt(2) * np.sin(time / 5)]
    np.savetxt(
        path,
        np.stack(columns, axis=1),
        delimiter=",",
        header="Time (s),Torque (Nm),Position (deg)",
        comments="",
    )
    return str(path)


def save_newtons(path, recording):
    np.savetxt(
        path,
        np.stack([recording.time, recording.samples], axis=1),
        delimiter=",",
        header="time,force_N",
        comments="",
    )
    return str(path)


def test_a_joint_that_is_held_needs_no_lever_arm(tmp_path):
    """A dynamometer records the angle of a held joint, too."""
    reading = {name: default for name, (_, default) in (READING | PERTURBED).items()}
    held, moved = with_angle(tmp_path / "held.csv", 0.05), with_angle(tmp_path / "moved.csv", 1.0)
    with contextlib.redirect_stderr(io.StringIO()):
        found = read_recordings([held], reading, None, None)
    assert isinstance(found, jm.data.Trials) and found[0].unit == "N m"
    assert recordings_of(held) == () and as_target(held).unit == "N m"
    with pytest.raises(
        ValueError,
        match=(
            r"held.csv: its column Position .deg. rests .* and that of .*moved.csv moves by 1 deg"
        ),
    ):
        read_recordings([moved, held], reading, None, None)
    with contextlib.redirect_stderr(io.StringIO()):
        (force,) = read_recordings([held], reading | {"lever_arm": 0.25}, None, None)
    assert force.unit == "N" and np.allclose(force.whole, found[0].whole / 0.25)
    reading |= {
        "force_column": "Torque (Nm)",
        "displacement": "Position (deg)",
        "lever_arm": 0.25,
        "positive": "lengthening",
    }
    newtons = save_newtons(tmp_path / "newtons.csv", force)
    for path in (held, newtons):  # a torque is divided, a force stays as it is
        pulls, (hold,) = read_with_holds([moved], [path], reading, "all")
        assert pulls[0].force.unit == hold.unit == "N"
        np.testing.assert_allclose(hold.whole, force.whole, rtol=1e-6)
    reading = {name: default for name, (_, default) in (READING | PERTURBED).items()}
    for paths, task in (([moved], None), ([held], "prescribed-length")):
        (found,) = read_recordings(paths, reading, None, task)
        assert found.of_joint
    pulls, (hold,) = read_with_holds([moved], [held], reading, "all")
    assert pulls[0].of_joint and hold.unit == "N"
    np.testing.assert_allclose(hold.whole, pulls[0].at_lever_arm(LEVER_ARM).force.whole)


@pytest.mark.parametrize(
    ("swing", "arm", "moved"),
    [(5.0, [], True), (5.0, ["--lever-arm", 0.3], True), (0.0, [], False)],
)
def test_torque_beside_an_angle_that_moves(swing, arm, moved, tmp_path):
    """As of a limb that a motor moves; where it rests, the torque alone."""
    x = force(7)
    time = np.arange(x.size) / RATE
    path = tmp_path / "joint.csv"
    np.savetxt(
        path,
        np.column_stack([time, x, swing * np.sin(np.pi * time)]),
        delimiter=",",
        header="time_s,torque_Nm,angle_deg",
        comments="",
    )
    assert run("analyse", path, "--out", tmp_path, *arm).exit_code == 0
    assert (tmp_path / "response.csv").exists() == moved
