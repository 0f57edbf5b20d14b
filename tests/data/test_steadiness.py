"""Steadiness: each number against NumPy, SciPy or its expectation, the errors against the scatter,
what is refused."""

import functools
import json
import math
import re

import jaxtyping
import matplotlib.pyplot as plt
import numpy as np
import pandas
import pytest
import scipy.fft
import scipy.optimize
import scipy.signal
import scipy.special
import scipy.stats
from entropies import without_entropies
from hypothesis import given
from hypothesis import strategies as st
from recorded import noticed

import jaxmuscle as jm
from jaxmuscle.data import Measure, _measured_text, _steadiness
from jaxmuscle.data._measure import likelier_error, log_interval, logit_interval, student_interval
from jaxmuscle.data._measured import (
    RANGES,
    RECORDED,
    _error,
    _interval,
    _own,
    _segments,
    _stated,
    _together,
)
from jaxmuscle.objective._derived import derived_names
from jaxmuscle.spectra._bin_law import student
from jaxmuscle.spectra._fluctuations import dfa
from jaxmuscle.spectra._measures import approximate_entropy, sample_entropy

RATE, LEVEL, SD = 100.0, 10.0, 0.3
CV = "coefficient_of_variation"
TREMOR = {f"tremor_{name}" for name in ("p", "frequency", "size", "detectable")}
BY_SEGMENTS = {*TREMOR, "median_frequency"}


def density(f, tremor):
    """Of a force: a slow part, a floor, and a hill at 9 Hz; not normalised."""
    return 1 / (1 + f**2) ** 2 + 2e-5 + tremor * 0.004 * np.exp(-0.5 * (f - 9) ** 2)


@functools.cache
def forces(count, seconds, tremor=1, seed=0):
    """Stationary Gaussian forces with that density and standard deviation `SD`, cut from periods
    eight times as long."""
    n, rng = round(8 * seconds * RATE), np.random.default_rng(seed)
    f = np.fft.rfftfreq(n, 1 / RATE)
    power = density(f, tremor) * (f > 0)
    power *= SD**2 / power.sum()
    z = rng.standard_normal((count, f.size)) + 1j * rng.standard_normal((count, f.size))
    return (
        LEVEL
        + (np.fft.irfft(z * np.sqrt(power / 2), n) * n / np.sqrt(2))[:, : round(seconds * RATE)]
    )


def trials(count=3, seconds=15.0, rate=RATE, **fields):
    return [
        jm.Recording(x, rate, name=f"trial {i}", **fields)
        for i, x in enumerate(forces(count, seconds))
    ]


def first(less=0.0, **fields):
    return jm.Recording(forces(3, 15.0)[0] - less, RATE, **fields)


@pytest.fixture(scope="module")
def found():
    return jm.data.steadiness(trials())


@pytest.fixture
def user_view():
    """As a user runs it: without the run-time type check, which would see a wrong argument
    first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


def test_the_simulated_forces_have_their_deviation():
    """The tests below stand on it: σ² of a record is that of the process less that of its mean."""
    x = forces(100, 60.0, seed=1)
    assert np.mean(x.var(axis=1) + (x.mean(axis=1) - LEVEL) ** 2) == pytest.approx(SD**2, rel=0.05)


def half_power(x):
    """Below which half of the power in the bins 1 to 30 of SciPy's Welch spectrum lies, each bin
    being even."""
    f, power = scipy.signal.welch(x, 100.0, "hann", 256, 128, detrend="constant")
    f, power, half = f[1:31], power[1:31], 0.5 * f[1]

    def surplus(at):
        return np.sum(power * np.clip((at - f + half) / (2 * half), 0, 1)) - np.sum(power) / 2

    return scipy.optimize.brentq(surplus, f[0] - half, f[-1] + half, xtol=1e-13)


def band_powers(x):
    """By name, of the cosine transform."""
    f = np.arange(x.size) * RATE / (2 * x.size)
    power = scipy.fft.dct(x - x.mean(), norm="ortho") ** 2 / x.size
    return {name: np.sum(power[(f >= low) & (f < high)]) for name, (low, high) in RANGES.items()}


def test_each_number_of_one_recording():
    recording = trials()[0]
    x, one = np.ascontiguousarray(recording.filtered()), jm.data.steadiness(recording)
    line = np.polyval(np.polyfit(np.arange(x.size), x, 1), np.arange(x.size))
    powers = band_powers(x)
    expected = {
        "mean": x.mean(),
        "standard_deviation": x.std(),
        CV: x.std() / x.mean(),
        f"{CV}_without_drift": np.std(x - line) / x.mean(),
        "approximate_entropy": approximate_entropy(x),
        "sample_entropy": sample_entropy(x),
        "dfa_exponent": dfa(x),
        "median_frequency": half_power(x),
    }
    expected |= {f"power{name}": power for name, power in powers.items()}
    expected |= {f"relative_power{name}": power / x.mean() ** 2 for name, power in powers.items()}
    expected |= {f"share{name}": power / x.var() for name, power in powers.items()}
    for name, value in expected.items():
        assert one[name].value == pytest.approx(value, rel=1e-9), name
    assert one.measures == one.trials["trial 0"]
    assert {
        name: m.error_from for name, m in one.measures.items() if m.error_from != "spectrum"
    } == {
        "approximate_entropy": "parts",
        "sample_entropy": "parts",
        "dfa_exponent": "parts",
    } | dict.fromkeys(BY_SEGMENTS, "segments")
    parts = [dfa(part) for part in np.array_split(x, 4)]
    assert one["dfa_exponent"].stderr == pytest.approx(scipy.stats.sem(parts))


def test_powers_add_up_to_the_variance(found):
    for measures in (*found.trials.values(), jm.data.steadiness(trials()[0]).measures):
        powers = [measures[f"power{name}"].value for name in RANGES]
        variance = measures["standard_deviation"].value ** 2
        assert sum(powers) == pytest.approx(variance, rel=1e-9) and min(powers) > 0
        assert sum(measures[f"share{name}"].value for name in RANGES) == pytest.approx(1, rel=1e-9)
        assert measures["share_8_12"].value == pytest.approx(
            measures["power_8_12"].value / variance
        )
        fast = math.sqrt(sum(powers[1:])) / measures["mean"].value
        assert measures[f"{CV}_above_0.5"].value == pytest.approx(fast, rel=1e-9)


def test_bands_are_those_of_a_fit(found):
    of_fits = {
        name.removeprefix("band")
        for name in derived_names(jm.Isometric())
        if name.startswith("band_")
    }
    assert set(RANGES) - {"_above_12"} == of_fits
    # what is above was filtered out
    assert _measured_text.CUT_OFF == 30.0 and "\n    12 to 30 Hz " in str(found)


@functools.cache
def simulated():
    """The measures of a hundred recordings of 10 s, entropies left out."""
    signals = [jm.Recording(x, RATE).filtered() for x in forces(100, 10.0, seed=2)]
    return [_own(x, "N") for x in signals]


@pytest.mark.parametrize("low, high", [edges for edges in RANGES.values() if edges[1] < 20])
def test_band_powers_are_the_integral_of_the_density(low, high):
    """The mean over recordings within 4.5 standard errors; the mean of a record takes half an
    ordinate, 0.025 Hz, away."""
    f = np.linspace(0, 50, 400_001)
    inside = (f >= max(low, 0.025)) & (f < high)
    expected = SD**2 * density(f, 1)[inside].sum() / density(f, 1).sum()
    values = [m[f"power_{low:g}_{high:g}"].value for m in simulated()]
    # The kernel is 0.05 Hz wide: it carries some of the power over the edges, 2 % where the density
    # is steep.
    assert abs(np.mean(values) - expected) < 4.5 * scipy.stats.sem(values) + 0.02 * expected


SURE = [
    "mean",
    "standard_deviation",
    CV,
    f"{CV}_without_drift",
    f"{CV}_above_0.5",
    "power_0_0.5",
    "power_1_2",
    "power_8_12",
    "relative_power_0_0.5",
    "relative_power_8_12",
    "share_0_0.5",
    "share_8_12",
    "median_frequency",
    "sample_entropy",
    "dfa_exponent",
]


@pytest.mark.parametrize("name", SURE)
def test_errors_of_one_recording_are_the_scatter_of_many(name):
    """The scatter of 100 is known to 7 %, and the errors are 0.85 to 1.05 of it
    (docs/recordings.md)."""
    values, errors = np.array([(m[name].value, m[name].stderr) for m in simulated()]).T
    assert 0.55 < np.sqrt(np.mean(errors**2)) / np.std(values, ddof=1) < 1.45


def test_the_error_of_a_sum_of_ordinates():
    """Of s χ²(1) the estimated variance is 2 Σ s² on the average."""
    s = 1 / np.arange(1.0, 30)
    draws = s * np.random.default_rng(0).chisquare(1, (20_000, s.size))
    squares = [_error(power) ** 2 for power in draws]
    assert abs(np.mean(squares) - 2 * np.sum(s**2)) < 4 * scipy.stats.sem(squares)


def test_three_trials_scatter_and_two_do_not(found):
    assert {m.error_from for m in found.measures.values()} == {"trials"}
    for name in set(found.measures) - TREMOR:
        values = [own[name].value for own in found.trials.values()]
        assert found[name].value == pytest.approx(np.mean(values))
        assert found[name].stderr == pytest.approx(scipy.stats.sem(values))
    two = jm.data.steadiness(trials()[:2])
    for name in set(two.measures) - TREMOR:
        values, errors = np.array(
            [(own[name].value, own[name].stderr) for own in two.trials.values()]
        ).T
        assert two[name].value == pytest.approx(np.mean(values))
        assert two[name].stderr == pytest.approx(np.hypot(*errors) / 2)
        assert two[name].error_from == two.trials["trial 0"][name].error_from


def test_the_interval_is_that_of_student(found):
    """With t the interval holds the expected value in 95 % of a thousand people with five trials,
    with 1.96 in 88 %."""
    low, high = found["mean"].interval
    assert (low, high) == pytest.approx(
        scipy.stats.t.interval(0.95, 2, found["mean"].value, found["mean"].stderr)
    )
    values = forces(5000, 10.0, seed=4).std(axis=1).reshape(1000, 5)
    far = np.abs(values.mean(axis=1) - values.mean()) / scipy.stats.sem(values, axis=1)
    held, too_few = (
        scipy.stats.binomtest(int(np.sum(far < reach)), 1000, 0.95).pvalue
        for reach in (student(5), 1.96)
    )
    assert held > 1e-3 > 1e-9 > too_few


def test_the_tremor_is_found_in_every_trial(found):
    """It has 14 % of the variance. In 15 s its frequency scatters by 0.2 Hz
    (docs/recordings.md)."""
    for measures in (found.measures, *found.trials.values()):
        frequency = measures["tremor_frequency"]
        assert measures["tremor_p"].value <= 0.001 and abs(frequency.value - 9) < 1
        assert 0 < frequency.stderr < 1
        assert measures["tremor_size"].value > 2 * measures["tremor_detectable"].value


def test_the_size_of_a_tremor_is_its_deviation_over_the_mean():
    """The hill of 30 recordings together, ± 2.7 Hz about 9 Hz, in closed form. Its power scatters
    by 2 % there, and a smooth spectrum that follows the floor imperfectly moves it by a few
    percent."""
    found = jm.data.steadiness([jm.Recording(x, RATE) for x in forces(30, 15.0)])
    f = np.linspace(0, 50, 400_001)
    hill = density(f, 1) - density(f, 0)
    near = np.abs(f - 9) < 2.7
    size = SD * math.sqrt(hill[near].sum() / density(f, 1).sum()) / LEVEL
    assert found["tremor_size"].value == pytest.approx(size, rel=0.1)
    assert found["tremor_frequency"].value == pytest.approx(9, abs=0.15)


def test_a_band_is_looked_through(found):
    """A hill at 9 Hz is none from 3 to 6 Hz; what moves is looked through from 3 to 20 Hz."""
    slower = jm.data.steadiness(trials(), band=(3.0, 6.0))
    assert slower.band == (3.0, 6.0) and not 8 < slower["tremor_frequency"].value < 10
    assert found.band == (6.0, 12.0) and "tremor, 6 to 12 Hz " in str(found)
    assert "size that would show" not in str(found)  # it shows
    moving = jm.data.steadiness(first(LEVEL, unit="mm"))
    assert moving.band == (3.0, 20.0) and moving["tremor_size"].unit == "mm"
    assert moving["tremor_frequency"].value == pytest.approx(9, abs=1)
    with pytest.raises(ValueError, match="band"):
        jm.data.steadiness(trials(), band=(30.0, 40.0))


def test_segments_average_to_the_welch_spectrum():
    recording = trials()[0]
    np.testing.assert_allclose(
        _segments(recording.filtered(), RECORDED).mean(axis=0),
        recording.spectrum().power,
        rtol=1e-9,
    )


def test_no_tremor_is_no_number():
    """A recording without one shows one in 1 of 100: of 30 more than 3 do once in 3000."""
    each = [jm.data.steadiness(jm.Recording(x, RATE)) for x in forces(30, 15.0, tremor=0, seed=3)]
    without = [one for one in each if math.isnan(one["tremor_frequency"].value)]
    assert len(without) >= 27
    none = without[0]
    assert none["tremor_frequency"].stderr is None and none["tremor_p"].value > 0.01
    assert none.to_dict()["measures"]["tremor_frequency"]["value"] is None
    seen = r"\n  tremor, 6 to 12 Hz +none seen, p = 0\.\d+; 0\.\d+ % would show\n"
    assert re.search(seen, str(none))


def test_rates_may_differ():
    x = forces(3, 15.0)[0]
    fine = scipy.signal.resample_poly(x, 10, 1, padtype="line")
    same, other = (
        jm.data.steadiness(jm.Recording(x, RATE)),
        jm.data.steadiness(jm.Recording(fine, 10 * RATE)),
    )
    for name in ("mean", CV, "power_0.5_1", "power_8_12", "dfa_exponent"):
        assert other[name].value == pytest.approx(same[name].value, rel=5e-3), name
    both = jm.data.steadiness([jm.Recording(x, RATE), jm.Recording(fine, 10 * RATE)])
    assert list(both.trials) == ["recording 1", "recording 2"]


def test_the_window_is_what_counts():
    x = np.concatenate([np.linspace(0, LEVEL, 500), forces(3, 15.0)[0]])
    held = jm.Recording(x, RATE).steady((5.0, 20.0))
    assert jm.data.steadiness(held)["mean"].value == pytest.approx(
        forces(3, 15.0)[0].mean(), rel=1e-3
    )


@pytest.mark.parametrize(
    "unit, square", [("% MVC", "(% MVC)²"), ("a.u.", "(a.u.)²"), ("N m", "(N m)²"), ("N", "N²")]
)
def test_units_are_said_as_they_are(unit, square):
    one = jm.data.steadiness(first(unit=unit))
    assert (
        one["mean"].unit == unit
        and one["power_0_0.5"].unit == square.replace("²", "^2")
        and one[CV].unit == "1"
    )
    text = str(one)
    assert f"({unit}), 15.0 s\n" in text and f" {unit}  " in text and square not in text
    assert "\n  power by band, 1e-6 mean²\n" in text
    assert max(len(line) for line in text.splitlines()) <= 80
    about = jm.data.steadiness(first(LEVEL, unit=unit))
    assert f"\n  power by band, {square}\n" in str(about) and math.isnan(
        about["relative_power_8_12"].value
    )


def test_mistakes_are_named(user_view):
    x = forces(3, 15.0)[0]
    newtons, share = jm.Recording(x, RATE, name="a"), jm.Recording(x, RATE, name="b", unit="% MVC")
    for wrong, message in (
        ([], "give at least one"),
        ([newtons, share], "units N and % MVC cannot be averaged; bring all trials to one unit"),
        ("trial.csv", r"load_recording\(...\) reads a file"),
        (jm.Recording(x[:300], RATE, name="c"), "c lasts 3 s; give at least 3.84 s"),
        (
            jm.Recording(np.concatenate([x, np.ones(600)]), RATE, window=(15.5, 20.5)),
            "is constant in the window",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            jm.data.steadiness(wrong)
    with pytest.raises(ValueError, match="did you mean 'sample_entropy'"):
        jm.data.steadiness(newtons)["sample_entrpy"]


def test_a_mean_near_zero_has_no_variation():
    about = jm.data.steadiness(first(LEVEL, unit="mm"))
    assert math.isnan(about[CV].value) and about["standard_deviation"].stderr > 0
    assert "near zero" in about.notices[-1] and "coefficient of variation    none" in str(about)


def test_a_level_that_wanders_is_noticed():
    """An F test at 5 %: of 40 steady recordings more than 7 are noticed once in 1400. A random
    walk's ordinates fall as 1/k², by a factor of 40 from the first four to the next eight: more
    than half of them are noticed."""
    walks = np.cumsum(np.random.default_rng(8).standard_normal((20, 1500)), axis=1) / 300 + LEVEL
    said = [
        any("level wanders" in n for n in _steadiness._notice_wandering([x]))
        for x in (*forces(40, 15.0, tremor=0, seed=9), *walks)
    ]
    assert sum(said[:40]) <= 7 and sum(said[40:]) >= 15
    (notice,) = _steadiness._notice_wandering([walks[int(np.flatnonzero(said[40:])[0])]])
    assert (
        notice
        in jm.data.steadiness(jm.Recording(walks[np.flatnonzero(said[40:])[0]], RATE)).notices
    )


def test_trials_of_different_length_are_noticed():
    long, short = (
        first(),
        jm.Recording(forces(3, 15.0)[1][:900], RATE),
    )
    assert "the trials last 9 s to 15 s" in jm.data.steadiness([long, short]).notices[-1]
    assert not jm.data.steadiness([long, jm.Recording(forces(3, 15.0)[1], RATE)]).notices


def test_a_window_with_a_ramp_is_noticed():
    """From rest to 10 N in 2 s, held for 15 s: all of it, a part with the ramp, and the steady
    part."""
    x = np.concatenate([np.zeros(200), np.linspace(0, LEVEL, 200), forces(1, 15.0)[0]])
    whole = jm.Recording(x, RATE, name="whole")
    for recording in (whole, whole.steady((2.5, 19.0))):
        (said,) = (notice for notice in jm.data.steadiness(recording).notices if "ramp" in notice)
        assert said.startswith("the level goes from ") and f"{LEVEL:.0f}" in said.split(" to ")[1]
        assert said in recording.target().notices
    assert not noticed(jm.data.steadiness(whole.steady()), "ramp counts")
    # a limb may move
    assert not noticed(jm.data.steadiness(jm.Recording(x, RATE, unit="mm")), "level goes")


def test_a_unit_that_says_nothing_is_noticed():
    """An EMG that was taken by mistake looks as any signal does."""
    said = jm.data.steadiness(jm.Recording(forces(1, 15.0)[0], RATE, unit="mV")).notices
    assert said[0].startswith("the unit mV does not say what was measured: is it the right column?")


def test_trials_that_agree_by_chance_are_noticed():
    """Of trials that scatter as their own errors say, 1 of 100 groups; where they truly differ,
    none."""
    alike = [Measure(value, 0.1, "N^2", "spectrum") for value in (1.0, 1.001, 0.999, 1.0)]
    assert likelier_error(alike) == pytest.approx(0.05)
    draws = np.random.default_rng(3).normal(1.0, 0.1, (4000, 4))
    found = [
        likelier_error([Measure(float(v), 0.1, "1", "spectrum") for v in row]) is not None
        for row in draws
    ]
    assert scipy.stats.binomtest(sum(found), 4000, 0.01).pvalue > 1e-4
    one = jm.data.steadiness(
        [jm.Recording(LEVEL + k + forces(1, 15.0)[0], RATE, name=f"{k}") for k in (0.0, 0.1, 0.2)]
    )
    (said,) = (notice for notice in one.notices if "agree much better" in notice)
    own = [trial["power_2_4"].stderr for trial in one.trials.values()]
    assert f"± {np.hypot.reduce(own) / 3:.2g} from 2 to 4 Hz" in said


def test_trials_that_are_no_trials_of_one_condition_are_noticed():
    first, second = (
        jm.Recording(x, RATE, name=name) for x, name in zip(forces(3, 15.0), "ab", strict=False)
    )
    strong = jm.Recording(3 * second.samples, RATE, name="strong")
    twice = jm.Recording(first.samples, RATE, name="again")
    notices = jm.data.steadiness([first, strong]).notices
    low, high = (f"{np.mean(r.filtered()):.4g} {r.unit}" for r in (first, strong))
    assert notices[0].startswith(
        f"the means of the trials reach from {low} (a) to {high} (strong): are they of one"
        " condition"
    )
    assert "three or more" in notices[1]
    assert (
        "a and again hold the same numbers" in jm.data.steadiness([first, twice, second]).notices[0]
    )
    assert noticed(jm.data.Trials([first, twice]).target(), "a and again hold the same numbers")
    assert noticed(jm.data.Trials([first, strong]).target(), "are they of one condition")
    assert not jm.data.Trials([first, second]).target().notices


def test_tables_and_files(found, tmp_path):
    table = found.to_dataframe()
    assert list(table) == [
        "trial",
        "duration_s",
        "quantity",
        "value",
        "stderr",
        "low",
        "high",
        "unit",
        "error_from",
    ]
    assert len(table) == 4 * len(found.measures) and list(table.trial.unique()) == [
        *found.trials,
        "all",
    ]
    wide = table.pivot(index="trial", columns="quantity", values="value")
    assert (
        wide.loc["all", CV] == found[CV].value
        and wide.loc["trial 1", CV] == found.trials["trial 1"][CV].value
    )
    assert table[table.trial == "all"].duration_s.unique() == [45.0]
    found.save(tmp_path / "steadiness.json")
    read = json.loads((tmp_path / "steadiness.json").read_text())
    assert (
        read["measures"][CV] == vars(found[CV]) | {"interval": list(found[CV].interval)}
        and found[CV].unit == "1"
    )
    assert (
        tuple(table[(table.trial == "all") & (table.quantity == CV)][["low", "high"]].iloc[0])
        == found[CV].interval
    )
    assert (
        read["trials"]["trial 2"]["duration_s"] == 15.0
        and read["unit"] == "N"
        and "jaxmuscle" in read["versions"]
    )
    assert isinstance(table, pandas.DataFrame)
    figure = found.plot()
    frequency, power, mean = found.spectrum
    together = jm.data.Trials(trials()).spectrum()
    np.testing.assert_allclose(mean[: together.power.size], together.power, rtol=1e-9)
    assert power.shape == (3, frequency.size) and 19.5 < frequency[-1] <= 20
    np.testing.assert_allclose(np.average(power, axis=0), mean)
    plt.close(figure)


# --- 95 % intervals

ROUNDED = 2e-5  # of 1.96, which is 1.959964
POSITIVE = st.floats(1e-12, 1e12)
PARTS = 1 - 1e-9


def expected_interval(name, m, count, segments):
    """The law of `docs/recordings.md`, by SciPy."""
    if count >= 3:
        degrees = count - 1
    elif name in ("approximate_entropy", "sample_entropy", "dfa_exponent"):
        degrees = 3 * count
    elif name == "mean":
        degrees = 4 * count
    elif name in BY_SEGMENTS:
        degrees = segments - 1
    elif name.startswith("share"):
        logit = scipy.special.logit(m.value)
        return scipy.special.expit(
            scipy.stats.norm.interval(0.95, logit, m.stderr / (m.value * (1 - m.value)))
        )
    else:
        return scipy.stats.lognorm.interval(0.95, m.stderr / m.value, scale=m.value)
    low, high = scipy.stats.t.interval(0.95, degrees, m.value, m.stderr)
    return max(low, 0), min(high, 1) if name.startswith("share") else high


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_error_has_the_interval_of_its_law(count, found):
    one = found if count == 3 else jm.data.steadiness(trials()[:count])
    segments = [recording.segments() for recording in trials()]
    for name, m in one.measures.items():
        if name in ("tremor_p", "tremor_detectable"):
            assert m.stderr is None and m.interval is None
            continue
        wanted = expected_interval(name, m, count, sum(segments[:count]))
        assert m.interval == pytest.approx(wanted, rel=3 * ROUNDED, abs=1e-12), name
    for i, own in enumerate(one.trials.values()):
        for name, m in own.items():
            assert (m.interval is None) == (m.stderr is None)
            if m.interval is not None:
                assert m.interval == pytest.approx(
                    expected_interval(name, m, 1, segments[i]), rel=3 * ROUNDED
                ), name


@given(POSITIVE, st.floats(0, 1e3))
def test_the_interval_in_the_logarithm(value, ratio):
    low, high = log_interval(value, ratio * value)
    assert 0 < low <= value <= high < math.inf
    assert low * high == pytest.approx(value**2)


@given(st.floats(1e-9, PARTS), st.floats(0, 1e3))
def test_the_interval_of_a_share(share, ratio):
    low, high = logit_interval(share, ratio * share * (1 - share))
    rounding = 1e-12
    assert 0 <= low <= share + rounding and share - rounding <= high <= 1
    assert logit_interval(1 - share, ratio * share * (1 - share)) == pytest.approx(
        (1 - high, 1 - low), abs=1e-6
    )


def test_the_limits_of_the_law():
    """A small share is as a power; what is certain has no width; many trials make t that of the
    normal law."""
    small = 1e-9
    assert logit_interval(small, 0.5 * small) == pytest.approx(
        log_interval(small, 0.5 * small), rel=1e-7
    )
    low, high = log_interval(small, 0.5 * small)
    assert [1 - end for end in logit_interval(1 - small, 0.5 * small)] == pytest.approx(
        [high, low], rel=1e-6
    )
    for certain in (0.0, 1.0, 1 + 1e-15):
        assert logit_interval(certain, 0.0) == (certain, certain) == log_interval(certain, 0.0)
    assert logit_interval(1.0, 1e-20) == (1.0, 1.0)
    assert student_interval(5.0, 0.0, 2) == (5.0, 5.0)
    assert student_interval(0.0, 1.0, 10**6) == pytest.approx((-1.96, 1.96), rel=1e-5 + ROUNDED)
    error = 1e-3
    assert log_interval(2.0, error) == pytest.approx(
        (2 - 1.96 * error, 2 + 1.96 * error), abs=4 * error**2
    )


def test_intervals_by_scatter_are_cut_where_no_value_can_lie():
    """Three trials: t is 4.3. A mean and a DFA exponent may be negative."""
    for name, value, error, ends in (
        ("power_1_2", 0.1, 0.1, (0.0, 0.1 + 0.1 * student(3))),
        ("share_1_2", 0.5, 0.2, (0.0, 1.0)),
        ("mean", 0.1, 0.1, (0.1 - 0.1 * student(3), 0.1 + 0.1 * student(3))),
        ("dfa_exponent", 0.1, 0.1, (0.1 - 0.1 * student(3), 0.1 + 0.1 * student(3))),
    ):
        assert _interval(name, Measure(value, error, "1", "trials"), 2) == pytest.approx(ends)
    assert _interval("mean", Measure(math.nan, None, "N", "trials"), 2) is None


@pytest.mark.parametrize("count", [1, 3])
def test_what_is_printed_is_what_is_saved(count, found):
    one = found if count == 3 else jm.data.steadiness(trials()[0])
    rows = re.findall(r"(\S+) ± (\S+)(?: N| %| Hz)? +(\S+) to (\S+)$", str(one), re.MULTILINE)
    bands = [f"relative_power{name}" for name in RANGES]
    tremor = ["tremor_frequency", "tremor_size"]
    names = [*_measured_text.WORDS, *bands, *_measured_text.REGULAR, *tremor]
    saved = one.to_dict()["measures"]
    unprinted = {"tremor_p", "tremor_detectable"}
    unprinted |= {f"{kind}{name}" for kind in ("power", "share") for name in RANGES}
    assert len(rows) == len(names) and set(saved) == {*names, *unprinted}
    for name, row in zip(names, rows, strict=True):
        scale = 100 if name.startswith((CV, "tremor_size")) else 1
        scale = 1e6 if name.startswith("relative_power") else scale
        numbers = [saved[name]["value"], saved[name]["stderr"], *saved[name]["interval"]]
        whole, _, decimals = row[1].partition(".")
        # of the error two digits are printed
        half_a_place = 0.5 * 10.0 ** (-len(decimals) if decimals else len(whole) - 2)
        np.testing.assert_allclose(
            [float(x) for x in row], np.multiply(scale, numbers), atol=1.001 * half_a_place, rtol=0
        )


CHANCE = 1e-4


def held(name, truth, measures):
    return sum(m[name].interval[0] <= truth <= m[name].interval[1] for m in measures)


def test_intervals_of_the_mean_hold_it():
    """Of a white signal the four slowest ordinates and the mean are independent, so t is exact;
    1.96 errors hold 88 %."""
    signals = LEVEL + SD * np.random.default_rng(6).standard_normal((400, 400))
    with without_entropies():
        own = [_own(x, "N") for x in signals]
    one = [_stated(m, 1, 2) for m in own]
    two = [
        _stated({"mean": _together([a["mean"], b["mean"]])}, 2, 4)
        for a, b in zip(own[::2], own[1::2], strict=True)
    ]
    for measures in (one, two):
        low, high = scipy.stats.binom.ppf([CHANCE / 2, 1 - CHANCE / 2], len(measures), 0.95)
        assert low <= held("mean", LEVEL, measures) <= high


@pytest.fixture(scope="module")
def recordings_of_20_s():
    with without_entropies():
        return [_stated(_own(x, "N"), 1, 2) for x in forces(200, 20.0, seed=7)]


@pytest.mark.parametrize(
    "name", ["power_0_0.5", "power_0.5_1", "power_1_2", "relative_power_1_2", "share_0.5_1", CV]
)
def test_intervals_of_a_power_hold_it(name, recordings_of_20_s):
    """91 % or more by the table in docs/recordings.md, of which 1 % is chance."""
    truth = np.mean([m[name].value for m in recordings_of_20_s])
    assert held(name, truth, recordings_of_20_s) >= scipy.stats.binom.ppf(
        CHANCE, len(recordings_of_20_s), 0.90
    )
