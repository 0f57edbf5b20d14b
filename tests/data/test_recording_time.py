"""Times as loggers write them: uneven, in packets, with lost rows and pauses, in units that the
file does not state. The recording is that of even times, or an error whose remedy works."""

import re

import numpy as np
import pandas
import pytest
from recorded import noticed, save_columns
from typer.testing import CliRunner

from jaxmuscle.commands.main import app
from jaxmuscle.data._recording import Recording
from jaxmuscle.data._recording_files import load_recording

N, STEP = 2400, 0.01
ROWS = np.arange(N)
T = STEP * ROWS
RNG = np.random.default_rng(65)
LINES = np.arange(0.05, 14.0, 0.05)
SIZES = 0.4 * RNG.normal(size=LINES.size) / np.sqrt(1 + (LINES / 1.5) ** 2) + 0.6 * (LINES == 8.5)
PHASES = RNG.uniform(0, 2 * np.pi, LINES.size)


def force(t):
    """Rest, ramp, hold at 40 N, ramp: known at any time."""
    turns = 2 * np.pi * np.outer(t, LINES) + PHASES
    hold = np.interp(t, [1.0, 2.4, 21.6, 23.0], [0.0, 1.0, 1.0, 0.0])
    return hold * (40 + 0.2 * np.sin(turns) @ SIZES) + 0.01 * np.sin(22.3 * t)


EVEN = Recording(force(T), 100).steady()
CV = EVEN.summary().coefficient_of_variation


def write(folder, time, x=None, header="time_s,force_N", name="trial.csv", digits="%.10g"):
    return save_columns(folder / name, header, time, force(time) if x is None else x, fmt=digits)


def kept(*lost):
    rows = np.ones(N, bool)
    for rows_lost in lost:
        rows[rows_lost] = False
    return rows


def is_the_even_one(recording, tolerance=0.005):
    """Mean, variation and spectrum of the hold, in the window of the even recording.

    `tolerance`: of the variation; straight lines through a gap of some samples change it by less.
    """
    held = recording.steady(EVEN.window)
    found = held.summary()
    assert found.mean == pytest.approx(EVEN.summary().mean, rel=1e-3)
    assert found.coefficient_of_variation == pytest.approx(CV, rel=tolerance)
    power, true = (np.asarray(r.spectrum().power) for r in (held, EVEN))
    # all bins below 12 Hz; a bin with next to no power holds what gaps leave of others
    np.testing.assert_allclose(power, true, rtol=0.02, atol=4 * tolerance * true.mean())
    return True


def jittered(most, seed=1):
    time = np.sort(T + STEP * np.random.default_rng(seed).uniform(-most, most, N))
    return time - time[0]


def stepping(most, seed=2):
    return np.cumsum(STEP * (1 + np.random.default_rng(seed).uniform(-most, most, N))) - STEP


UNEVEN = {
    "steps of 8 to 12 ms": stepping(0.2),
    "steps of 5 to 15 ms": stepping(0.5),
    "jitter of a fifth": jittered(0.3),
    "jitter of half an interval": jittered(0.5),
    "rounded to ms": stepping(0.3).round(3),
    "a clock that slows": T * 1.001 + 0.02 * np.sin(T / 5),
    "jitter and lost rows": jittered(0.4)[kept(300, 302, 900, 1500)],
}


@pytest.mark.parametrize("rate", [None, 100])
@pytest.mark.parametrize("case", UNEVEN)
def test_uneven_times_are_brought_to_even_ones(case, rate, tmp_path):
    time = UNEVEN[case][UNEVEN[case] <= T[-1]]
    recording = load_recording(write(tmp_path, time), rate=rate)
    assert is_the_even_one(recording) and any(
        re.search(r"times are uneven .* brought to .* Hz by cubic splines", notice)
        for notice in recording.notices
    )
    assert rate is None or recording.rate == rate


@pytest.mark.parametrize("rows", [4, 10, 25])
@pytest.mark.parametrize("latency", [0.0, 0.01])
@pytest.mark.parametrize("within", [0.0, 2e-4])
def test_rows_that_come_in_packets_are_even(rows, latency, within, tmp_path):
    """All rows of a packet have the time of its arrival, or tiny steps; two packets are lost."""
    arrival = T[rows - 1 :: rows] + latency * np.random.default_rng(3).exponential(size=N // rows)
    for j in range(1, arrival.size):  # no packet overtakes another
        arrival[j] = max(arrival[j], arrival[j - 1] + rows * within)
    time = np.repeat(arrival, rows) + np.tile(within * np.arange(rows), N // rows)
    there = kept(slice(1200, 1200 + rows), slice(1600, 1600 + rows))
    recording = load_recording(
        write(tmp_path, time[there], force(T)[there]), max_gap=0.3, rate=100 if within else None
    )
    assert recording.rate == 100 and recording.whole.size == N
    head = f"rows come {rows} at a time: they count as even, at"
    assert any(notice.startswith(head) for notice in recording.notices)
    assert (
        f"{2 * rows} rows are missing in the times, the first after 11.990 s" in recording.notices
    )
    np.testing.assert_array_equal(recording.whole[1300:1600], force(T)[1300:1600].round(8))


LOST = {
    "one": [700],
    "one and two": [700, slice(1498, 1500)],
    "a third of all": [np.random.default_rng(5).choice(N - 2, 700, replace=False) + 1],
    "many single ones": [np.random.default_rng(4).choice(N - 2, 30, replace=False) + 1],
    "three": [500, 1217, 1600],
    "fifteen together": [slice(700, 715)],
}


@pytest.mark.parametrize("scale", [1.0, 1000.0])
@pytest.mark.parametrize("case", LOST)
def test_missing_rows_are_gaps(case, scale, tmp_path):
    there = kept(*LOST[case])
    head = "time_s,force_N" if scale == 1 else "time_ms,force_N"
    recording = load_recording(write(tmp_path, (scale * T[there]).round(6), force(T[there]), head))
    assert recording.rate == 100 and recording.whole.size == N
    np.testing.assert_allclose(recording.whole[there], force(T[there]), rtol=1e-8, atol=1e-9)
    lost = int(np.sum(~there))
    assert any(n.startswith(f"{lost} row") and "missing in" in n for n in recording.notices)
    assert noticed(recording, f"({lost} samples, longest")
    assert case == "a third of all" or is_the_even_one(recording, 0.02)


def test_lost_rows_of_a_rate_that_is_no_decimal(tmp_path):
    """60 Hz in whole ms: steps of 16 and 17 ms."""
    t = np.arange(1400) / 60
    there = np.isin(np.arange(1400), [200, 400, 401, 402, 600], invert=True)
    recording = load_recording(
        write(tmp_path, np.round(1000 * t[there]), force(t[there]), "millis,force_N")
    )
    assert recording.whole.size == 1400 and recording.rate == pytest.approx(60, rel=1e-4)
    assert noticed(recording, "5 rows are missing")


def test_rows_of_coarse_times_may_be_missing(tmp_path):
    """2048 Hz in ms: every second row has the time of the one before."""
    t = np.arange(12_000) / 2048
    there = np.isin(np.arange(12_000), np.arange(9000, 9100), invert=True)
    whole = load_recording(write(tmp_path, t.round(3), np.sin(t)))
    assert not any("missing" in n or "at a time" in n for n in whole.notices)
    recording = load_recording(write(tmp_path, t[there].round(3), np.sin(t[there])))
    assert recording.rate == 2048 and recording.whole.size == 12_000
    assert noticed(recording, "100 rows are missing")


def paused(at=1500, pause=7.3333):
    return T + pause * (at <= ROWS)


def test_a_pause_cuts_the_recording_and_windows_on_both_sides_work(tmp_path):
    path = write(tmp_path, paused(), force(T))
    recording = load_recording(path)
    assert (recording.start, recording.whole.size) == (0.0, 1500)
    (notice,) = recording.notices
    assert "cut into the parts 0:14.99, 22.3333:31.3233 s" in notice
    before, after = recording.steady((4, 14)), recording.steady((22.4, 28))
    np.testing.assert_array_equal(before.samples, force(T).round(8)[400:1400])
    assert after.start == pytest.approx(22.3333) and after.samples.size == 560
    assert after.notices == before.notices == recording.notices
    with pytest.raises(ValueError, match=r"0 <= start < stop <= 15 s, .*or 22.3333 <= .* 31.33"):
        recording.steady((10, 26))
    late = load_recording(write(tmp_path, paused(600, 3.0), force(T)))
    assert late.start == pytest.approx(9.0) and late.steady().window[0] >= 9
    assert late.steady((0.0, 5.0)).samples[0] == force(T[:1]).round(8)[0]


def test_the_longest_gap_says_what_a_pause_is(tmp_path):
    there = kept(slice(700, 740))
    path = write(tmp_path, T[there])
    assert load_recording(path).start == pytest.approx(7.4)
    assert load_recording(path, max_gap=0.5).whole.size == N


def test_a_pause_in_a_record_of_two_channels(tmp_path):
    rng = np.random.default_rng(1)
    x = np.cumsum(rng.normal(size=N)) * 1e-2
    frame = pandas.DataFrame({"time_s": paused(), "force_N": 40 + 5 * x, "displacement_mm": x})
    frame.to_csv(tmp_path / "moved.csv", index=False)
    options = {"force": "force_N", "displacement": "displacement_mm", "positive": "lengthening"}
    recording = load_recording(tmp_path / "moved.csv", **options)
    assert recording.force.whole.size == 1500
    after = recording.steady((23, 30))
    assert after.window == (23.0, 30.0) and after.displacement.start == pytest.approx(22.3333)


UNITS = {
    "epoch s": (1.7e9 + T, "s"),
    "epoch ms": (1.7e12 + 10 * ROWS, "ms"),
    "epoch us": (1.7e15 + 10_000 * ROWS, "us"),
    "epoch ns": (1.7e18 + 1e7 * ROWS, "ns"),
    "us": (10_000.0 * ROWS, "us"),
    "us since the board was started": (5e8 + 10_000 * ROWS, "us"),
    "us, uneven": (np.round(1e6 * jittered(0.02)) + 31, "us"),
    "ns": (1e7 * ROWS + 12345, "ns"),
    "ms, uneven": (np.round(1000 * stepping(0.2)), "ms"),
    "days of a spreadsheet": (45_000 + T / 86_400, "days"),
    "ms with decimals": (np.round(1000 * stepping(0.2), 2), "ms"),
}


@pytest.mark.parametrize("rate", [None, 100])
@pytest.mark.parametrize("name", ["time", "Timestamp", "sensor time"])
@pytest.mark.parametrize("case", UNITS)
def test_units_of_time_are_recognised_by_their_size(case, name, rate, tmp_path):
    time, unit = UNITS[case]
    seconds = (time - time[0]) * {"s": 1, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "days": 86_400}[unit]
    x = force(seconds)
    recording = load_recording(
        write(tmp_path, time, x, f"{name},force_N", digits=["%.19g", "%.10g"]), rate=rate
    )
    assert recording.rate == pytest.approx(100, rel=5e-3)
    assert is_the_even_one(recording)
    assert noticed(recording, f"is taken as {unit}") == (unit != "s")


def test_names_that_hold_the_unit(tmp_path):
    for name, factor in (
        ("millis", 1e3),
        ("micros", 1e6),
        ("time_ns", 1e9),
        ("Timestamp [us]", 1e6),
    ):
        recording = load_recording(
            write(tmp_path, np.round(factor * T), force(T), f"{name},force_N", digits="%.12g")
        )
        assert recording.rate == 100 and recording.notices == ()


def test_even_whole_steps_may_be_ms_or_a_count(tmp_path):
    path = write(tmp_path, 10 * ROWS, force(T), "time,force_N", digits="%.8g")
    with pytest.raises(ValueError, match="rate=100") as caught:
        load_recording(path)
    assert (
        "times look like ms (2400 rows, step 10): name the column time_ms or give rate=100"
        in str(caught.value)
    )
    by_rate = load_recording(path, rate=100)
    by_name = load_recording(
        write(tmp_path, 10 * ROWS, force(T), "time_ms,force_N", "named.csv", "%.8g")
    )
    assert "column time states no unit and is taken as ms (step 10)" in by_rate.notices
    for recording in (by_rate, by_name):
        np.testing.assert_allclose(recording.whole, force(T), atol=1e-6)
    done = CliRunner().invoke(app, ["analyse", str(path), "--out", str(tmp_path / "out")])
    said = " ".join(done.output.split())
    assert done.exit_code == 2 and "name the column time_ms or give --rate 100" in said


def test_a_column_of_time_that_counts_the_rows(tmp_path):
    path = write(tmp_path, ROWS, force(T), "time,force_N", digits="%.8g")
    with pytest.raises(ValueError, match=r"ms or row numbers .* or give rate=1000"):
        load_recording(path)
    assert load_recording(path, rate=1000).rate == 1000
    counted = load_recording(path, rate=100)
    assert counted.rate == 100 and counted.whole.size == N
    assert "column time counts the rows: their rate is 100 Hz as asked" in counted.notices


def test_a_nameless_first_column_of_uneven_times(tmp_path):
    recording = load_recording(write(tmp_path, stepping(0.2), header=""))
    assert noticed(recording, "column 0 rises") and is_the_even_one(recording)
    recording = load_recording(write(tmp_path, T[kept(700)], header=""))
    assert recording.whole.size == N


REFUSED = {
    "a clock that is set back": (np.where(ROWS < 1200, T, T - 1), "line 1202: .* runs backwards"),
    "times that restart": (
        np.where(ROWS < 1200, T, T - 12),
        "line 1202: .* runs backwards, from 11.99 to 0; a second recording may begin there",
    ),
    "a time that stands twice": (
        np.where(ROWS == 1200, T[1199], T),
        "line 1202: .* has the time of the row before again",
    ),
    "a row that stands twice": (np.sort(np.append(T[:-1], T[700])), "line 703: .* again"),
    "a time is missing": (np.where(ROWS == 5, np.nan, T), "line 7: .* holds no number"),
    "events": (np.cumsum(np.random.default_rng(3).exponential(0.01, N)), "is not uniform: after"),
    "another rate": (T, "rate=50 Hz contradicts the time column 'time_s', which has 100 Hz"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_times_that_are_refused_and_the_remedy_that_works(case, tmp_path):
    time, message = REFUSED[case]
    path, rate = write(tmp_path, time, force(T)), 50 if case == "another rate" else None
    with pytest.raises(ValueError, match=message) as caught:
        load_recording(path, rate=rate)
    assert "time='none'" in str(caught.value) and "`rate`" in str(caught.value)
    with pytest.raises(ValueError, match=r"time='none' leaves the times out\); give `rate`"):
        load_recording(path, time="none")
    recording = load_recording(path, time="none", rate=100)
    np.testing.assert_allclose(recording.whole, force(T), atol=1e-6)
    assert recording.notices == (
        "the times in column time_s are left out as asked: rows count as even",
    )
    assert recording.steady((5, 15)).samples.size == 1000
    options = [
        "--time",
        "none",
        "--rate",
        "100",
        "--window",
        "5:15",
        "--out",
        str(tmp_path / "out"),
    ]
    assert CliRunner().invoke(app, ["analyse", str(path), *options]).exit_code == 0


def test_tables_in_memory_follow_the_same_rules():
    def read(times, **options):
        frame = pandas.DataFrame({"time": times, "force_N": force(T[: len(times)])})
        return Recording.from_dataframe(frame, **options)

    assert read(T[kept(700)]).whole.size == N
    assert read(1e12 + 1e12 + 10 * ROWS).rate == 100
    assert read(paused()).whole.size == 1500
    stamps = np.datetime64("2026-11-22T10:00", "ns") + (1e9 * stepping(0.2)).astype("m8[ns]")
    assert noticed(read(pandas.DatetimeIndex(stamps)), "uneven")
    with pytest.raises(ValueError, match=r"the table, row 1200: .* runs backwards"):
        read(np.where(ROWS < 1200, T, T - 1))
    assert read(np.where(ROWS < 1200, T, T - 1), time="none", rate=100).whole.size == N


def test_clock_times_may_lack_rows_too(tmp_path):
    there = kept(700, 701)
    rows = [
        f"2026-11-22T10:{int(t // 60):02d}:{t % 60:06.3f},{x:.6f}"
        for t, x in zip(T[there], force(T[there]), strict=True)
    ]
    (tmp_path / "trial.csv").write_text("when,force_N\n" + "\n".join(rows) + "\n")
    recording = load_recording(tmp_path / "trial.csv")
    assert recording.whole.size == N and recording.rate == 100
    assert "2 rows are missing in the times, the first after 6.990 s" in recording.notices
