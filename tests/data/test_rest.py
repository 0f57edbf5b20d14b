"""The level at rest: found, said, subtracted where it is quiet; and a straight drift."""

import json

import numpy as np
import pytest
from recorded import noticed, save_columns
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.data._recording_quality import find_rest

RATE, LEVEL, CV = 100, 40.0, 0.0108
NODES = (0.0, 1.0, 3.0, 21.0, 23.0, 24.0)  # s: rest, ramp, hold, ramp, rest
T = np.arange(2400) / RATE
SHAPE = np.interp(T, NODES, [0, 0, 1, 1, 0, 0])
# No tighter: how the steady part is cut changes the variation by 2 %.
CUT = 0.02


def wander(seed=0):
    """Fluctuations of unit deviation below 0.5 Hz or so, in the hold."""
    white = np.random.default_rng(seed).normal(size=T.size + 2000)
    slow = np.convolve(white, np.exp(-np.arange(400) / 30), "same")[1000 : 1000 + T.size]
    hold = (T >= 4) & (T < 20)
    return (slow - slow[hold].mean()) / slow[hold].std()


NOISE = 0.02 * np.random.default_rng(9).normal(size=T.size)
HELD = LEVEL * SHAPE * (1 + CV * wander()) + NOISE
LIMB = 5 + 0.2 * np.sin(2 * np.pi * 1.1 * T)  # with the pulse of the arteries in it
TWO = np.interp(T, [0, 6, 7, 17, 18, 24], [20, 20, 40, 40, 20, 20]) * (1 + CV * wander(3)) + NOISE


def truth():
    return jm.Recording(HELD, RATE).steady()


SUBTRACTED = {
    "positive": HELD + 20,
    "negative, the hold nearer to zero": HELD - 30,
    "negative, as far as the hold": HELD - 20,
    "large, so that the ramp is a small part": HELD + 500,
    "rest before alone": (HELD + 20)[:2000],
    "rest before alone, negative": (HELD - 30)[:2000],
    "rest after alone": (HELD + 20)[500:],
    "slow drift of the zero": HELD + 20 + 0.01 * T,
}


@pytest.mark.parametrize("case", SUBTRACTED)
def test_a_quiet_rest_is_subtracted(case):
    found = jm.Recording(SUBTRACTED[case], RATE).steady()
    (notice,) = (said for said in found.notices if said.startswith("at rest"))
    assert "This was subtracted; --baseline none keeps it" in notice
    assert np.mean(found.samples) == pytest.approx(np.mean(truth().samples), rel=5e-3)
    variation = found.summary().coefficient_of_variation
    assert variation == pytest.approx(CV, rel=4 * CUT)


@pytest.mark.parametrize("rate", [1000, 2048])
def test_mains_hum_is_no_scatter(rate):
    """Neither is it in what is analysed."""
    t = np.arange(24 * rate) / rate
    x = np.interp(t, T, HELD) + 20 + 0.3 * np.sin(2 * np.pi * 50 * t)
    found = jm.Recording(x, rate)
    assert "This was subtracted" in found.notices[0]


def test_a_force_that_pulls_the_other_way():
    found = jm.Recording(-HELD - 20, RATE).steady()
    assert np.mean(found.samples) == pytest.approx(-LEVEL, rel=5e-3)


KEPT = {
    "weight of a limb": HELD + LIMB,
    "weight of a limb, downwards": HELD - 3 * LIMB,
    "two levels": TWO,
    "pre-tension": HELD + 10 + 0.1 * wander(5),
    "zero that jumps": HELD + 20 + 2 * (T > 12),
}


@pytest.mark.parametrize("case", KEPT)
def test_what_may_be_a_force_is_only_said(case):
    x = KEPT[case]
    found = jm.Recording(x, RATE)
    (notice,) = found.notices
    assert "not 0. This was not subtracted: it " in notice and "--baseline 0:" in notice
    np.testing.assert_array_equal(found.whole, x)
    # the remedies that it prints
    end = float(notice.split("--baseline 0:")[1].split()[0])
    for asked in (f"0:{end}", (0, end)):
        less = jm.Recording(x, RATE, baseline=asked)
        np.testing.assert_allclose(less.whole, x - np.mean(x[: round(end * RATE)]))
        assert less.notices[0].startswith("the mean from 0 s to ")
    assert jm.Recording(x, RATE, baseline="none").notices == ()


NOTHING = {
    "zero": HELD,
    "half a percent": HELD + 0.2,
    "no rest": (HELD + 20)[400:2000],
    "rest within a hold": np.where((T > 8) & (T < 9), 0, LEVEL * (1 + CV * wander())) + NOISE,
    "ramp without end": np.linspace(0, 40, 2400) + NOISE,
}


@pytest.mark.parametrize("case", NOTHING)
def test_a_rest_that_is_zero_says_nothing(case):
    found = jm.Recording(NOTHING[case], RATE)
    assert not noticed(found, "rest")
    np.testing.assert_array_equal(found.whole, NOTHING[case])


def test_what_has_no_force_keeps_its_level():
    """A position at rest is where the limb lies."""
    for unit in ("mm", "deg", "g", "deg/s"):
        assert jm.Recording(HELD + 20, RATE, unit=unit).notices == ()
    shifted = jm.Recording(HELD + 20, RATE, unit="mm", baseline=(0, 1))
    assert np.mean(shifted.whole[:100]) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("given", ["rest", (3, 1), (0, 99), (1,), "0:x"])
def test_a_baseline_that_is_none(given):
    with pytest.raises(ValueError, match=r"baseline=.*give a part in which the signal rests"):
        jm.Recording(HELD, RATE, baseline=given)


def test_the_steady_part_is_found_although_the_rest_is_kept():
    """A quiet rest further from zero than the hold is no hold."""
    kept = jm.Recording(HELD - 30, RATE, baseline="none").steady()
    assert kept.window == truth().window and np.mean(kept.samples) == pytest.approx(10, rel=0.02)


def write(folder, x, name="force_N", file="trial.csv"):
    return save_columns(folder / file, f"time_s,{name}", T[: len(x)], x, fmt="%.18e")


def test_commands_and_mvc(tmp_path):
    """The level over the MVC counts from rest."""
    path, out = write(tmp_path, HELD + 20), tmp_path / "out"
    run = CliRunner().invoke
    done = run(app, ["steadiness", str(path), "--mvc", "400", "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output
    measures = json.loads(done.stdout)["measures"]
    assert measures["level"]["value"] == pytest.approx(0.1, rel=5e-3)
    kept = ["--out", str(out), "--force", "--json", "--baseline", "none"]
    whole = run(app, ["analyse", str(path), "--mvc", "400", *kept])
    assert json.loads(whole.stdout)["summary"]["mean"] == pytest.approx(60, rel=5e-3)
    wrong = run(app, ["analyse", str(path), *kept[:-1], "30:40"])
    assert wrong.exit_code == 2 and "--baseline '30:40': give a part" in " ".join(
        wrong.output.split()
    )


def test_a_maximal_contraction_begins_at_rest():
    """No plateau is in it."""
    shape = np.interp(T, [0, 3, 4, 6, 8, 24], [0, 0, 0.9, 1, 0, 0])
    found = jm.Recording(20 + 400 * shape * (1 + 0.02 * wander(7)) + NOISE, RATE)
    assert "the signal is 20 N, not 0. This was subtracted" in found.notices[0]


def test_the_force_of_a_moved_record_counts_from_rest():
    moved = 1e-3 * np.random.default_rng(11).normal(size=T.size) * (SHAPE == 1)
    found = jm.data.PerturbedRecording.from_array(HELD - 60, moved, RATE, positive="lengthening")
    assert np.mean(found.steady((4, 20)).force.samples) == pytest.approx(LEVEL, rel=5e-3)
    assert not noticed(found, "mean force is negative")
    kept = jm.data.PerturbedRecording.from_array(
        HELD + 20, moved, RATE, positive="lengthening", baseline="none"
    )
    np.testing.assert_array_equal(kept.force.whole, HELD + 20)


def test_a_study_has_the_columns(tmp_path):
    for name in ("a.csv", "b.csv"):
        write(tmp_path, HELD + LIMB + 0.2 * T * SHAPE, file=name)
    table = tmp_path / "study.csv"
    table.write_text(
        "file,person,baseline,detrend\na.csv,anna,0:1,true\nb.csv,bert,none,no\n".replace(
            "b.csv,bert,none,no", "b.csv,bert,,"
        )
    )
    from jaxmuscle.data._study_table import cells_of_study, read_study

    first, second = (cell.target for cell in cells_of_study(read_study(table).rows, {}))
    assert first.mean is not None and second.mean is not None
    assert second.mean[0] - first.mean[0] == pytest.approx(5, rel=0.05)
    assert noticed(first, "straight line")
    table.write_text("file,person,detrend\na.csv,anna,perhaps\nb.csv,bert,\n")
    with pytest.raises(ValueError, match="line 2: detrend='perhaps': write true or false"):
        read_study(table)


def test_a_drift_is_taken_off_and_the_mean_kept():
    drift = 0.3 * (T - 12) * SHAPE
    held = jm.Recording(HELD + drift, RATE, detrend=True).steady((4, 20))
    alone = jm.Recording(HELD, RATE, detrend=True).steady((4, 20))
    np.testing.assert_allclose(held.samples, alone.samples, atol=2e-2)
    assert np.mean(held.samples) == pytest.approx(np.mean((HELD + drift)[400:2000]), rel=1e-9)
    slope = np.polyfit(T[400:2000], held.samples, 1)[0]
    assert abs(slope) < 1e-9 and not held.detrend
    assert "0.3" in held.notices[-1] and "the mean kept" in held.notices[-1]
    whole = jm.Recording(1 + T, RATE, detrend=False).steady("all")
    assert whole.window is None and whole.notices == ()
    flat = jm.Recording(HELD[400:2000] + T[400:2000], RATE, detrend=True).steady("all")
    assert abs(np.polyfit(flat.time, flat.samples, 1)[0]) < 1e-9


@pytest.mark.parametrize("command", ["analyse", "steadiness"])
def test_commands_detrend(command, tmp_path):
    path = write(tmp_path, HELD + 0.3 * (T - 12) * SHAPE)
    options = [command, str(path), "--out", str(tmp_path / "out"), "--window", "4:20"]
    done = CliRunner().invoke(app, [*options, "--detrend", "--json"])
    assert done.exit_code == 0, done.output
    told = done.stderr if command == "analyse" else done.stdout
    assert "the straight line through window 4 s to 20 s was subtracted" in " ".join(told.split())


def test_the_rest_is_the_quieter_end():
    found = find_rest(SUBTRACTED["rest after alone"], float(RATE))
    assert found is not None and found.begin > 18 and found.end == 19
    assert found.level == pytest.approx(20, abs=0.02)
    assert found.quiet and found.share == pytest.approx(0.04, abs=0.02)


def test_a_clipped_signal_is_said_once():
    found = jm.Recording(np.minimum(HELD, 39.9) + 20, RATE).steady()
    (said,) = (notice for notice in found.notices if "clipped" in notice)
    assert said.startswith("flat at its highest value 39.")
