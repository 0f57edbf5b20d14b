"""Samples that cannot be are named and, if asked for, masked; what a sensor may read is not. A
cough or a slip in one trial is named with its time."""

import numpy as np
import pandas
import pytest
import scipy.signal
from recorded import noticed
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.data._recording_outliers import find_bursts, find_outliers

N, RATE = 2400, 100
T = np.arange(N) / RATE


def held(seed=0, sd=0.4, corner=2.0, rest=0.02, n=N):
    """Rest, ramp, hold at 40 N, ramp."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE
    x = scipy.signal.lfilter(*scipy.signal.butter(1, corner, fs=RATE), rng.normal(size=n + 300))[
        300:
    ]
    x = x / np.std(x) + 0.5 * np.sin(2 * np.pi * 8.5 * t)
    shape = np.interp(t, np.array([1.0, 2.4, 21.6, 23.0]) * n / N, [0.0, 1.0, 1.0, 0.0])
    return shape * (40 + sd * x) + rest * rng.normal(size=n)


CLEAN = jm.Recording(held(), RATE).steady((5, 20)).summary()


def write(folder, x, name="trial.csv"):
    path = folder / name
    pandas.DataFrame({"time_s": T[: len(x)], "force_N": x}).to_csv(path, index=False)
    return path


def placed(value, *rows):
    x = held()
    for row in rows:
        x[row] = value
    return x


MARKS = {
    "-9999, three": (placed(-9999, slice(800, 803)), "3 samples are -9999", "8.000 to 8.020 s"),
    "-9999, one": (placed(-9999, 800), "1 sample is -9999", "at 8.000 s"),
    "-999 twice": (
        placed(-999, 700, slice(900, 915)),
        "16 samples are -999",
        "7.000, 9.000 to 9.140",
    ),
    "9999": (placed(9999, slice(800, 806)), "6 samples are 9999", "8.000 to 8.050"),
    "1e30": (placed(1e30, 800, 900), "2 samples are 1e+30", "8.000, 9.000 s"),
    "rail": (placed(1250.0, slice(800, 812)), "12 samples are 1250", "8.000 to 8.110"),
    "rail of 16 bits": (placed(-32768, slice(800, 812)), "12 samples are -32768", "8.000 to 8.110"),
}
SPIKES = {
    "one": (held() + 25.0 * (np.arange(N) == 900), "1 sample lies", "at 9.000 s"),
    "down to 0": (placed(0.0, slice(900, 903)), "3 samples lie", "9.000 to 9.020 s"),
    "five": (
        held() - 15.0 * (np.arange(N) % 350 == 349) * (T < 18),
        "5 samples lie",
        "3.490, 6.990",
    ),
    "at rest": (held() + 3.0 * (np.arange(N) == 50), "1 sample lies", "at 0.500 s"),
    "filtered": (
        held() + 20 * np.convolve(np.arange(N) == 900, [0.5, 1, 0.5], "same"),
        "samples lie",
        "8.990 to 9.010 s",
    ),
}


@pytest.mark.parametrize("case", MARKS | SPIKES)
def test_samples_that_cannot_be_are_named_and_masked(case, tmp_path):
    x, what, when = (MARKS | SPIKES)[case]
    path = write(tmp_path, x)
    kept = jm.load_recording(path)
    (said,) = [notice for notice in kept.notices if "far outside" in notice]
    assert what in said and when in said and "--outliers mask" in said
    np.testing.assert_allclose(kept.whole, x, rtol=1e-12)
    assert not noticed(kept, "clipped")
    masked = jm.load_recording(path, outliers="mask")
    assert noticed(masked, "They count as missing")
    assert noticed(masked, "closed by straight lines")
    found = masked.steady((5, 20)).summary()
    assert found.mean == pytest.approx(CLEAN.mean, rel=1e-3)
    assert found.coefficient_of_variation == pytest.approx(CLEAN.coefficient_of_variation, rel=0.03)


def test_a_long_mark_is_a_gap_that_is_too_long(tmp_path):
    path = write(tmp_path, placed(-9999, slice(800, 850)))
    with pytest.raises(ValueError, match=r"gaps longer than max_gap=0.2 s at 8.000 s to 8.500 s"):
        jm.load_recording(path, outliers="mask")
    assert jm.load_recording(path, outliers="mask", max_gap=0.6).whole.size == N


def emg(rng, n):
    x = scipy.signal.lfilter(
        *scipy.signal.butter(2, [20, 450], "band", fs=2000), rng.normal(size=n)
    )
    return x / np.std(x)


REAL = {
    "normal noise": lambda rng, n: rng.normal(size=n),
    "normal noise about a level": lambda rng, n: 40 + 0.4 * rng.normal(size=n),
    "Laplace noise": lambda rng, n: rng.laplace(size=n),
    "EMG": emg,
    "bursts of EMG": lambda rng, n: emg(rng, n) * np.where(np.arange(n) // 200 % 4 == 0, 1, 0.02),
    "EMG of changing size": lambda rng, n: emg(rng, n) * np.exp(np.sin(np.arange(n) / 90)),
    "rectified EMG": lambda rng, n: np.abs(emg(rng, n)),
    "tremor": lambda rng, n: np.sin(0.53 * np.arange(n)) + 0.01 * rng.normal(size=n),
    "sine": lambda _, n: np.sin(0.53 * np.arange(n)),
    "whole numbers": lambda rng, n: np.round(0.3 * rng.normal(size=n)),
    "tenths": lambda rng, n: np.round(40 + 0.4 * rng.normal(size=n), 1),
    "step": lambda rng, n: 40.0 * (np.arange(n) > n // 2) + 0.01 * rng.normal(size=n),
    "ramp and hold": lambda _, n: np.interp(np.arange(n), [n // 5, n // 3], [0.0, 40.0]),
    "ramp, hold and fluctuations": lambda rng, n: held(int(rng.integers(1000)), n=n),
    "rest of exactly 0": lambda rng, n: np.where(np.arange(n) > n // 3, 40 + rng.normal(size=n), 0),
    "zeros at the end": lambda rng, n: np.where(np.arange(n) < 0.9 * n, 40 + rng.normal(size=n), 0),
    "contractions": lambda rng, n: np.where(
        np.arange(n) // 300 % 4 == 1, 40 + 0.3 * rng.normal(size=n), 0.01 * rng.normal(size=n)
    ),
    "pulse wave": lambda rng, n: (
        np.exp(-0.5 * ((np.arange(n) % 200 - 100) / 4.0) ** 2) + 0.01 * rng.normal(size=n)
    ),
    "twitch": lambda rng, n: (
        40 * (u := np.maximum(np.arange(n) - n // 2, 0) / 6) * np.exp(1 - u)
        + 0.01 * rng.normal(size=n)
    ),
    "steps of a motor": lambda rng, n: (
        np.repeat(rng.integers(0, 2, n // 20 + 1), 20)[:n] + 0.001 * rng.normal(size=n)
    ),
    "random walk": lambda rng, n: np.cumsum(rng.normal(size=n)),
}


@pytest.mark.parametrize("case", REAL)
def test_what_a_sensor_may_read_is_no_outlier(case):
    rng = np.random.default_rng(7)
    for n in (400, N, 20_000):
        for _ in range(8):
            x = np.asarray(REAL[case](rng, n), float)
            assert find_outliers(x[:, None], np.arange(n) / RATE)[1] == []


def test_false_alarms_are_as_rare_as_stated():
    """Of 2000 records of normal noise: the law allows 2 at most, on average; 8 has a probability
    of 1e-3."""
    rng = np.random.default_rng(8)
    alarms = sum(
        bool(find_outliers(rng.normal(size=(600, 1)), np.arange(600.0))[1]) for _ in range(2000)
    )
    assert alarms <= 8


def test_of_a_point_and_of_two_channels(tmp_path):
    rng = np.random.default_rng(2)
    x = 0.01 * np.cumsum(rng.normal(size=N))
    x[900] = -9999
    frame = pandas.DataFrame({"time_s": T, "force_N": 40 + rng.normal(size=N), "length_mm": x})
    frame.to_csv(tmp_path / "moved.csv", index=False)
    options = {"force": "force_N", "displacement": "length_mm", "outliers": "mask"}
    moved = jm.load_recording(tmp_path / "moved.csv", positive="lengthening", **options)
    assert np.all(np.abs(moved.displacement.whole) < 1)
    assert noticed(moved, "1 sample is -9999")
    masked = jm.Recording.from_dataframe(frame, column="length_mm", outliers="mask")
    assert np.all(np.abs(masked.whole) < 100)


def test_commands_and_studies_take_the_option(tmp_path):
    path = write(tmp_path, MARKS["-9999, three"][0])
    with pytest.raises(ValueError, match="outliers='drop': choose keep or mask"):
        jm.load_recording(path, outliers="drop")
    options = ["analyse", str(path), "--json", "--window", "5:20", "--out"]
    kept = CliRunner().invoke(app, [*options, str(tmp_path / "kept")])
    assert "leaves its level" not in kept.stderr
    assert kept.exit_code == 0 and "3 samples are -9999, far outside" in " ".join(
        kept.stderr.split()
    )
    masked = CliRunner().invoke(app, [*options, str(tmp_path / "masked"), "--outliers", "mask"])
    assert masked.exit_code == 0 and '"coefficient_of_variation": 0.01' in masked.stdout
    rows = [
        {"file": str(path), "person": person, "trial": person, "outliers": "mask"}
        for person in ("anna", "bert")
    ]
    from jaxmuscle.data._study_table import cells_of_study, read_study

    rows[1]["file"] = str(write(tmp_path, held(4), "other.csv"))
    for cell in cells_of_study(read_study(rows).rows, {"window": (5, 20)}):
        assert cell.target.coefficient_of_variation[0] < 0.02


EVENTS = {
    "cough": lambda t: 8 * np.exp(-0.5 * ((t - 6.2) / 0.15) ** 2),
    "slip": lambda t: -12.0 * ((t > 6.0) & (t < 7.0)),
}


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("case", EVENTS)
def test_a_cough_or_a_slip_is_named(case, count):
    t = np.arange(1500) / RATE
    holds = [held(seed)[400:1900] for seed in range(count)]
    holds[-1] = holds[-1] + EVENTS[case](t)
    trials = jm.data.Trials(
        [jm.Recording(x, RATE, name=f"trial{i}", window=(0, 15)) for i, x in enumerate(holds)]
    )
    (said,) = [n for n in trials.target().notices if "leaves its level" in n]
    assert "a cough, a slip?" in said and (count == 1 or said.startswith(f"trial{count - 1}: "))
    begin, stop = (float(word) for word in said.split(" from ")[1].split(" s,")[0].split(" to "))
    assert 5.0 <= begin <= 6.1 and 6.3 <= stop <= 7.6
    assert not noticed(trials.target(), "level goes from")
    without = jm.data.Trials(
        [*list(trials)[: count - 1], jm.Recording(holds[-1], RATE, window=(8, 15))]
    )
    assert not noticed(without.target(), "leaves its level")


def test_steady_trials_hold_no_cough():
    """Noise with corners from 0.3 to 3 Hz: at most 1 in 100 of 400 sets would be named."""
    alarms = 0
    for corner in (0.3, 1.0, 3.0, 10.0):
        for seed in range(100):
            holds = [held(100 * seed + k, corner=corner)[300:2000] for k in range(1 + seed % 3)]
            alarms += bool(find_bursts(holds, float(RATE)))
    assert alarms <= 4


def test_a_ramp_in_a_window_is_no_cough():
    recording = jm.Recording(held(), RATE, window=(0, 20))
    notices = recording.target().notices
    assert any("level goes from" in n for n in notices)
    assert not any("leaves its level" in n for n in notices)
