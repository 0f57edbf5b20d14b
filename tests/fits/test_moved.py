"""A fitted dynamic stiffness: what is stored, printed and drawn of it, from Python and from the
command line."""

import csv
import re

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.stats
from refits import without_intervals
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.console import write_fit
from jaxmuscle.commands.main import app
from jaxmuscle.data import kind_of_file
from jaxmuscle.data._perturbed import LINEAR
from jaxmuscle.fits import _perturbed
from jaxmuscle.fits._checks import reach_notices
from jaxmuscle.fits._perturbed import seen_with
from jaxmuscle.simulation._driven import driven

TASK = jm.PrescribedLength()
F = np.geomspace(0.2, 8.0, 17)
THREE = ("k_z", "c_z", "m_z")  # what a response surely determines


def response(seed=0, segments=40):
    """That of the default muscle with errors of 2 %."""
    with jax.enable_x64(True):
        true = np.asarray(jm.response.dynamic_stiffness(TASK, F))
    sd = 0.02 * np.abs(true)
    noise = np.random.default_rng(seed).standard_normal((2, F.size))
    return jm.data.FrequencyResponse(F, true + sd * (noise[0] + 1j * noise[1]), sd, name="figure")


def command(*arguments):
    return CliRunner().invoke(app, ["fit", *map(str, arguments)], env={"COLUMNS": "1000"})


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The folder that the command wrote, and what it printed."""
    folder = tmp_path_factory.mktemp("moved")
    response().save(folder / "figure.csv")
    options = ["--rungs", "0", "--starts", "8", "--out", folder / "out"]
    found = command(folder / "figure.csv", *options)
    assert found.exit_code == 0, found.output
    return folder / "out", found.output


def test_a_response_alone_knows_no_noise_that_would_limit_a_further_measurement(fitted):
    result = jm.load_result(fitted[0] / "fit.json")
    report = jm.identifiability(result)
    assert not report.designs
    assert "no further measurement is tried: the fit has no spectrum" in " ".join(
        str(report).split()
    )
    with pytest.raises(ValueError, match=r"result: no further measurement is tried.*fit of sev"):
        jm.uncertainty.design_input(result)


def test_a_tangent_stiffness_far_from_the_lowest_measured_one_is_called_extrapolated(fitted):
    result = jm.load_result(fitted[0] / "fit.json")
    part, known = result.only, result.only.target.stiffness.known
    lowest = float(np.real(part.stiffness[0]))
    near, far = (jm.fits.Estimate(lowest - 20.0, "N/m", stderr=error) for error in (15.0, 5.0))
    assert reach_notices({"tangent_stiffness": near}, result.parts) == ()
    assert (
        reach_notices({"tangent_stiffness": jm.fits.Estimate(lowest - 20.0, "N/m")}, result.parts)
        == ()
    )
    (said,) = reach_notices({"tangent_stiffness@moved": far}, {"moved": part, "held": part})
    assert (
        f"below {known.frequency[0]:.2g} Hz, where this muscle has {lowest:.4g} N/m" in said
        and "extrapolated" in said
    )


def read(path):
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_a_response_alone_is_fitted_from_the_command_line(fitted):
    folder, said = fitted
    assert {path.name for path in folder.iterdir()} == {
        "fit.json",
        "fit.png",
        "report.html",
        "stiffness.csv",
    }
    assert "dynamic stiffness, 0.2 to 8 Hz" in said
    assert "fit.json, fit.png, stiffness.csv" in said
    result, table, given = (
        jm.load_result(folder / "fit.json"),
        read(folder / "stiffness.csv"),
        response(),
    )
    np.testing.assert_allclose(table["frequency_hz"], F, rtol=1e-7)
    np.testing.assert_allclose(table["real"] + 1j * table["imaginary"], given.value, rtol=1e-7)
    np.testing.assert_allclose(table["stderr"], given.stderr, rtol=1e-7)
    with jax.enable_x64(True):
        own = np.asarray(jm.response.dynamic_stiffness(result.task, F))
    np.testing.assert_allclose(
        table["fitted_real"] + 1j * table["fitted_imaginary"], own, rtol=1e-6
    )
    again = jm.data.load_frequency_response(folder / "stiffness.csv")  # which can be fitted alone
    np.testing.assert_allclose(again.value, given.value, rtol=1e-7)
    np.testing.assert_allclose(again.stderr, given.stderr, rtol=1e-7)
    assert again.name == "stiffness"
    assert kind_of_file(folder / "stiffness.csv") == "frequency response"
    off = (given.value - own) / given.stderr
    np.testing.assert_allclose(result.only.stiffness_residual, off, rtol=1e-5, atol=1e-5)
    assert result.only.chi2_per_point == pytest.approx(
        np.sum(np.abs(off) ** 2) / (2 * F.size), rel=1e-5
    )
    assert result["K_w0"].stderr is not None and "chi2 per datum" in result.verdict
    assert f"dynamic stiffness  {F.size} points" in str(result.targets["figure"])


def test_its_figure_shows_gain_phase_and_residuals(fitted):
    result, given = jm.load_result(fitted[0] / "fit.json"), response()
    figure = result.plot()
    panels = {ax.get_ylabel(): ax for ax in figure.axes if ax.get_ylabel()}
    assert set(panels) == {"Gain (N/m)", "Phase (deg)", "Residual (SE)"}
    gain, phase, rest = panels.values()
    points, curve = (
        gain.containers[0][0],
        next(line for line in gain.lines if line.get_label() == "fit"),
    )
    np.testing.assert_allclose(points.get_ydata(), given.gain)
    x, y = curve.get_data()
    np.testing.assert_allclose(np.interp(F, x, y), np.abs(result.only.stiffness), rtol=1e-6)
    assert gain.get_xscale() == gain.get_yscale() == phase.get_xscale() == "log"
    np.testing.assert_allclose(phase.containers[0][0].get_ydata(), given.phase)
    lines = {line.get_label(): line.get_ydata() for line in rest.lines}
    np.testing.assert_allclose(
        lines["real (spring, mass)"], np.real(result.only.stiffness_residual)
    )
    np.testing.assert_allclose(
        lines["imaginary (damping)"], np.imag(result.only.stiffness_residual)
    )
    plt.close(figure)


def test_goodness_of_a_response_has_the_law_of_least_squares():
    """Three numbers that it determines are free: what a replicate's fit leaves is chi² of so many
    degrees fewer."""
    fit = jm.fit(TASK, jm.Target("figure", None, stiffness=response()), free=THREE, starts=8)
    found = jm.checks.goodness(fit, replicates=499)
    assert set(found.observed) == set(found.reference) == {"chi2_per_point", "largest_point"}
    rest = scipy.stats.chi2(2 * F.size - len(THREE))
    assert (
        scipy.stats.kstest(2 * F.size * found.reference["chi2_per_point"], rest.cdf).pvalue > 1e-4
    )
    share = np.mean(found.reference["chi2_per_point"] >= found.observed["chi2_per_point"])
    assert found.p_values["chi2_per_point"] == pytest.approx(share, abs=1 / 500)
    # A point off by a Rayleigh number of standard errors; the three numbers take up a tenth of the
    # squares.
    below = scipy.stats.rayleigh(scale=np.sqrt(1 - len(THREE) / (2 * F.size))).cdf(
        np.median(found.reference["largest_point"])
    )
    assert 0.3 < below**F.size < 0.7
    assert "17 points" not in str(found) and (
        "compared with 499 dynamic stiffnesses that were drawn from the fit and fitted again"
        in " ".join(str(found).split())
    )


def test_goodness_finds_the_point_that_is_off():
    true = response()
    value = true.value.copy()
    value[5] += 8 * true.stderr[5]
    odd = jm.data.FrequencyResponse(F, value, true.stderr, name="figure")
    fit = jm.fit(TASK, jm.Target("figure", None, stiffness=odd), free=THREE, starts=8)
    found = jm.checks.goodness(fit, replicates=499)
    assert found.p_values["largest_point"] == 1 / 500
    words = " ".join(str(found).split())
    assert re.search(
        rf"one point stands out: it is off by [5-9]\.\d standard errors at {F[5]:.2f} Hz", words
    )
    figure = found.plot()
    (panel,) = (ax for ax in figure.axes if ax.get_ylabel() == "|Residual| (SE)")
    (out,) = (line for line in panel.lines if line.get_label().startswith("above it"))
    assert F[5] in out.get_xdata()
    plt.close(figure)


def moved(folder, seconds=52.0):
    """A file of both channels of the simulated muscle. So long, its response has 47 points, as that
    of test_perturbed_fit.py: the fits of both are one program."""
    rng, rate = np.random.default_rng(3), 100
    time = np.arange(round((seconds + 8) * rate) + 1) / rate
    lines = np.arange(5, round(5 * seconds)) / seconds
    phase = rng.uniform(0, 2 * np.pi, lines.size)
    length = (
        1e-3
        * np.sqrt(2 / lines.size)
        * np.cos(2 * np.pi * np.outer(time, lines) + phase).sum(axis=1)
    )
    task = TASK.with_parts(x_z=jm.model.Sampled.through(time, -length))
    force = np.asarray(
        jm.simulate(task, jax.random.key(1), duration=float(time[-1]), rate=float(rate)).output
    )
    table = np.stack([time, force, 1e3 * length], axis=1)[3 * rate :]
    path = folder / "perturbed.csv"
    np.savetxt(
        path, table, delimiter=",", header="time,force_N,displacement_mm", comments="", fmt="%.8g"
    )
    return path


@pytest.mark.slow
def test_a_file_of_both_channels_is_fitted_from_the_command_line_alone_and_with_a_hold(tmp_path):
    path, folder = moved(tmp_path), tmp_path / "out"
    options = [
        "--task",
        "prescribed-length",
        "--rungs",
        "0",
        "--starts",
        "8",
        "--quick",
        "--out",
        folder,
    ]
    said = command(path, *options)
    assert said.exit_code == 0, said.output
    assert {file.name for file in folder.iterdir()} == {"fit.json", "spectrum.csv", "stiffness.csv"}
    result = jm.load_result(folder / "fit.json")
    for name, true in {"K_w0": 200.0, "K_z0": 200.0, "C_w0": 60.0, "C_z0": 5.0}.items():
        # 4 for chance, 0.5 for the muscle's curvature
        assert abs(result[name].value - true) < 4.5 * result[name].stderr
    figure = result.plot()
    shown = [ax.get_ylabel() for ax in figure.axes]
    assert {"Gain (N/m)", "Phase (deg)", "Residual (SE)", "Residual\n(SD)"} <= set(shown)
    plt.close(figure)
    hold = tmp_path / "hold.csv"
    force = np.asarray(
        jm.simulate(jm.Isometric(), jax.random.key(2), duration=40.0, rate=100.0).output
    )
    table = np.stack([np.arange(force.size) / 100, 1e3 * force], axis=1)[300:]
    # newtons all the same
    np.savetxt(hold, table, delimiter=",", header="time,force_mN", comments="", fmt="%.8g")
    said = command(path, "--hold", hold, *options[4:], "--force")
    assert said.exit_code == 0, said.output
    joint = jm.load_result(folder / "fit.json")
    assert list(joint.parts) == ["moved", "held"] and joint.parts["held"].target.name == "hold"
    assert joint.parts["moved"].stiffness is not None and joint.parts["held"].stiffness is None
    for name, true in {"K_w0": 200.0, "K_z0": 200.0, "C_w0": 60.0, "C_z0": 5.0}.items():
        assert abs(joint[name].value - true) < 4.5 * joint[name].stderr
        # more data; but each error is itself estimated
        assert joint[name].stderr < 1.02 * result[name].stderr
    words = " ".join(joint.details().split())
    known, fitted = joint.parts["moved"].target.stiffness.known, joint.parts["moved"].stiffness
    faint = int(np.sum(np.abs(fitted) < 2 * known.stderr))
    assert faint == 0 and "so they tell little" not in words  # beyond the motion there are none
    assert known.frequency[-1] < 5.5
    assert (
        "moved: dynamic stiffness: " in words
        and "report K_w_tangent (stiffness of the active tissue" in words
    )
    written = write_fit(joint, folder, ["png"], report=True)
    tables = ["spectrum-moved.csv", "stiffness-moved.csv", "spectrum-held.csv"]
    assert written == ["fit.json", "fit.png", *tables, "report.html"]
    # the tables of the fit alone are gone
    assert {file.name for file in folder.iterdir()} == set(written)
    assert set(write_fit(result, folder)) == {"fit.json", "spectrum.csv", "stiffness.csv"}
    assert {file.name for file in folder.iterdir()} == {"fit.json", "spectrum.csv", "stiffness.csv"}
    figure = joint.plot()
    titles = [ax.get_title(loc="left") for ax in figure.axes]
    assert {"moved", "held", "moved: dynamic stiffness"} <= set(titles)
    plt.close(figure)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["HOLD", "--hold", "HOLD"], "hold.csv: no displacement was found beside the force"),
        (
            ["vastus-lateralis-26mvc", "--hold", "HOLD"],
            "--hold belongs to records of a moved insertion",
        ),
        (
            ["PULL", "--hold", "HOLD", "--method", "montecarlo"],
            "by the formula of the spectrum: leave out --method",
        ),
        (["PULL", "--hold", "PULL"], "its column x_m moves by 1.02 mm rms, and in a hold"),
        (["PULL", "--hold", "HOLD", "--window", "1:9,2:9,3:9"], "3 windows for 2 recordings"),
        (
            ["PULL", "--hold", "TORQUE"],
            "torque: is in N m, and a moved record is fitted in N. Give --lever-arm",
        ),
        (["PULL", "--hold", "HOLD", "--task", "isometric"], "leave out --task and --quantity"),
        (
            ["PULL", "--hold", "HOLD", "--fix", "m_w@held=0.4"],
            "a fixed value holds for all records. Give --fix m_w=VALUE",
        ),
        (
            ["PULL", "--hold", "HOLD", "--segments", "5"],
            "--segments and --dataset belong to spectra",
        ),
        (["PULL", "--hold", "none.csv"], "none.csv"),
    ],
)
def test_a_hold_that_cannot_be_fitted_with_a_moved_record(tmp_path, given, message):
    files = written_records(tmp_path)
    named = ["--force-column", "force_N", "--displacement", "x_m"] if given[0] == "PULL" else []
    out = tmp_path / "out"
    said = command(*(files.get(x, x) for x in given), *named, "--out", out)
    assert said.exit_code == 2 and message in said.stderr, said.output
    assert not (out / "fit.json").exists()


def written_records(tmp_path):
    """Files of noise: a force, a torque, and a force with a displacement."""
    force = np.random.default_rng(0).normal(5.0, 0.1, (3000, 1))
    moving = np.concatenate([force, 1e-3 * np.random.default_rng(1).normal(size=(3000, 1))], axis=1)
    time = np.arange(3000)[:, None] / 100
    for name, columns, head in (
        ("HOLD", force, "force_N"),
        ("TORQUE", force, "torque_Nm"),
        ("PULL", moving, "force_N,x_m"),
    ):
        table = np.concatenate([time, columns], axis=1)
        np.savetxt(
            tmp_path / f"{name.lower()}.csv",
            table,
            delimiter=",",
            header=f"time_s,{head}",
            comments="",
        )
    return {name: str(tmp_path / f"{name.lower()}.csv") for name in ("HOLD", "TORQUE", "PULL")}


def test_one_model_of_the_ladder_is_fitted_with_a_hold(tmp_path, monkeypatch):
    files, seen = written_records(tmp_path), {}

    def fake(tasks, targets, **options):
        seen.update(options, tasks=tasks)
        raise ValueError("enough")

    monkeypatch.setattr(jm, "fit", fake)
    named = ["--force-column", "force_N", "--displacement", "x_m", "--out", tmp_path / "out"]
    given = [files["PULL"], "--hold", files["HOLD"], *named]
    for rung, rungs in (([], 3), (["--rung", "2"], 0), (["--rungs", "1"], 1)):
        seen.clear()
        assert "enough" in command(*given, *rung).stderr
        assert seen["rungs"] == rungs
        assert seen["tasks"] == (
            {
                "moved": jm.model.on_rung(jm.PrescribedLength(), 2),
                "held": jm.model.on_rung(jm.Isometric(), 2),
            }
            if rungs == 0
            else None
        )


def test_a_hold_is_not_taken_for_a_moved_record(tmp_path):
    """A displacement that was not found would else be an insertion at rest."""
    np.savetxt(
        tmp_path / "hold.csv",
        np.random.default_rng(0).normal(5.0, 0.1, 3000),
        header="force_N",
        comments="",
    )
    options = ["--rate", "100", "--task", "prescribed-length", "--out", tmp_path / "out"]
    said = command(tmp_path / "hold.csv", *options)
    assert (
        said.exit_code == 2
        and "hold.csv: no displacement was found beside the force" in said.stderr
    )
    assert (
        "--force-column and --displacement; a hold is fitted with --task isometric" in said.stderr
    )
    assert not (tmp_path / "out").exists()


def test_the_answer_of_a_light_and_damped_muscle_is_taken_off_whole(monkeypatch):
    """A muscle of 55 N and half a kilogram relaxes at 3100 /s: too fast for whole steps, at which
    no answer was finite."""
    stiff = {
        "k_w": 13.1e6,
        "k_z": 18.5e6,
        "c_w": 1470.0,
        "c_z": 95.0,
        "m_w": 0.5,
        "m_z": 0.2,
        "P_w": 98.6,
    }
    task = TASK.replace(**stiff, harmonic_amplitude=0.0)
    rate, rng = 1000.0, np.random.default_rng(8)
    time, lines = np.arange(64_001) / rate, np.arange(20, 401) / 40.0
    turns = [
        np.exp(1j * (2 * np.pi * line * time + phase))
        for line, phase in zip(lines, rng.uniform(0, 2 * np.pi, lines.size), strict=True)
    ]
    size = 0.8e-3 * np.sqrt(2 / lines.size)
    motion = np.array(
        [
            size
            * sum(
                np.real((2j * np.pi * f) ** n * turn) for f, turn in zip(lines, turns, strict=True)
            )
            for n in (0, 1, 2)
        ]
    )
    with jax.enable_x64(True):
        answer = driven(task, -motion, 1 / rate)
    noise = 0.005 * rng.standard_normal(answer.size)
    recording = jm.data.PerturbedRecording.from_array(
        55.0 + answer + noise, motion[0, ::2], rate / 2, positive="lengthening"
    )
    with jax.enable_x64(True):
        seen = seen_with(task, [recording.steady((2.0, 62.0))])
        monkeypatch.setattr(_perturbed, "driven", lambda *_: np.full(1, np.nan))
        linear = seen_with(task, [recording.steady((2.0, 62.0))])
    assert LINEAR not in seen.notices and LINEAR in linear.notices
    power, more = (
        np.mean(t.proportional_power[12:22] * t.coefficient_of_variation[0] ** 2)
        for t in (seen, linear)
    )
    # of the noise that was added, in a bin
    density = 0.005**2 / (rate / 4) * np.diff(seen.frequency)[0] / 55.0**2
    assert power < 2 * density and more > 100 * density


RATE, LENGTH = 500.0, 33_000
AT = np.fft.rfftfreq(LENGTH, 1 / RATE)
TURN = 2j * np.pi * AT
# [N/m] the model's active and passive tissue, both linear
PARTS = 2000 + 60 * TURN + 0.5 * TURN**2, 4000 + 15 * TURN
IN_SERIES = PARTS[0] * PARTS[1] / (PARTS[0] + PARTS[1]) + 0.5 * TURN**2


def specimen(seed, answer=None):
    """A specimen that is moved by 1 mm rms, linear unless its `answer` is given; and the
    fluctuations of its force alone."""
    rng = np.random.default_rng(seed)

    def shaped(gain):
        drawn = np.fft.irfft(np.fft.rfft(rng.standard_normal(LENGTH)) * gain, LENGTH)
        return drawn / np.std(drawn)

    x = 1e-3 * shaped(((AT >= 0.5) & (AT <= 10)).astype(float))
    own = 20 + 0.2 * shaped(1 / (1 + AT**2)) + 0.03 * rng.standard_normal(LENGTH)
    force = own + (
        np.fft.irfft(np.fft.rfft(x) * IN_SERIES, LENGTH) if answer is None else answer(x)
    )
    return (
        jm.data.PerturbedRecording.from_array(force, x, RATE, positive="lengthening").steady(
            (3.0, 63.0)
        ),
        own,
    )


def near_specimen():
    """A muscle that answers small movements as the specimen does; but it is nonlinear, as the model
    is."""
    x_w = 20 / 4000  # m, by which the mean force stretches the active tissue
    k_w, k_z = 2000 / (TASK["x_ref_w"] ** 2 + 3 * x_w**2), 4000 / TASK["x_ref_z"] ** 2
    values = {"k_w": k_w, "k_z": k_z, "c_w": 60.0, "c_z": 15.0, "m_w": 0.5, "m_z": 0.5}
    pull = 20 + k_w * (TASK["x_ref_w"] ** 2 + x_w**2) * x_w
    return TASK.replace(**values, P_w=pull, harmonic_amplitude=0.0)


def test_the_muscle_of_these_tests_answers_as_the_specimen():
    at = np.array([0.5, 2.0, 8.0])
    with jax.enable_x64(True):
        found = np.asarray(jm.response.dynamic_stiffness(near_specimen(), at))
    np.testing.assert_allclose(found, IN_SERIES[np.rint(at * LENGTH / RATE).astype(int)], rtol=1e-3)


@pytest.mark.parametrize("share", [0.0, 1.0, 2.0])
def test_what_is_taken_off_is_as_nonlinear_as_the_recording(share):
    """A specimen with none, all and twice of the model's nonlinear answer: each leaves the
    fluctuations that were put in."""
    muscle = near_specimen()

    def answer(x):
        """The linear answer, and the share of what the nonlinear muscle does beside it."""
        fine = 4 * LENGTH
        motion = np.array(
            [4 * np.fft.irfft(TURN**order * np.fft.rfft(x), fine) for order in (0, 1, 2)]
        )
        whole = np.asarray(
            driven(muscle, -np.append(motion, motion[:, :1], axis=1), 1 / (4 * RATE))
        )[::2][:LENGTH]
        linear = np.fft.irfft(np.fft.rfft(x) * IN_SERIES, LENGTH)
        return linear + share * (whole - linear)

    with jax.enable_x64(True):
        recording, own = specimen(3, answer)
        seen = seen_with(muscle, [recording])
    alone = jm.Recording(own, RATE).steady(recording.force.window).target(settings=seen.settings)
    apart = np.log(seen.proportional_power / alone.proportional_power)
    # left in, the nonlinear answer more than doubles the power near 5 Hz
    assert np.sqrt(np.mean(apart**2)) < 0.1
    assert np.std(own) / 20 == pytest.approx(seen.coefficient_of_variation[0], rel=0.05)
    said = [
        notice for notice in seen.notices if "nonlinearly than the muscle of the model" in notice
    ]
    assert len(said) == (share != 1.0)
    if said:
        assert ("less" if share < 1 else "more") in said[0] and "do not report K_w0" in said[0]
        found, error = map(float, re.search(r"shows (-?\d+) ± (\d+) % of it", said[0]).groups())
        assert f"subtracted {'that share' if share else 'none of it'} from the force" in said[0]
        assert abs(found - 100 * share) < 4 * error + 1 and error < 10


def test_fluctuations_of_another_origin_do_not_hide_the_answer_from_the_search():
    """They fall off at 1 Hz, the muscle relaxes at 5 Hz: a search that begins with both at once
    ends in a wrong muscle."""
    recording, _ = specimen(5)
    with without_intervals():
        result = jm.fit(jm.model.on_rung(TASK, 1), recording, starts=16, seeds=0, check_seeds=0)
    for name, true in {
        "K_w_tangent": 2000,
        "K_z0": 4000,
        "C_w0": 60,
        "C_z0": 15,
        "tangent_stiffness": 4000 / 3,
    }.items():
        found = result[name]
        assert found.stderr is None or abs(found.value - true) < 4 * found.stderr, name
    assert abs(result["tangent_stiffness"].value - 4000 / 3) < 0.02 * 4000 / 3
    assert result.only.chi2_per_point < 1.5
