"""What a target says that was measured: of recordings as steadiness does, of bins by their law;
what its files keep, and what they refuse."""

import itertools
import math

import numpy as np
import pytest
import scipy.optimize
import scipy.special
import scipy.stats
import tomli_w
from test_steadiness import CV, forces, trials

import jaxmuscle as jm
from jaxmuscle._common.errors import TargetError
from jaxmuscle.data import Measure
from jaxmuscle.data._target import load_target
from jaxmuscle.spectra import find_peaks
from jaxmuscle.spectra._bin_law import bin_statistics
from jaxmuscle.spectra._peak_test import measure_peak

RESOLUTION = 0.390625
FREQUENCY = RESOLUTION * np.arange(1, 31)
EDGES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0)
SMOOTH = 1 / (1 + FREQUENCY**2)
BELL = np.exp(-4 * np.log(2) * ((FREQUENCY - 9) / 1.8) ** 2)
BAND, SEGMENTS = (6.0, 12.0), (60,)


def rows(measures):
    """To be compared where NaN equals NaN."""
    return {name: m.row() for name, m in measures.items()}


def drawn(power, count, segments=SEGMENTS, seed=0):
    """Spectra that scatter about a power by the law of its bins, by SciPy."""
    law, rng = (
        bin_statistics(jm.Target("x", power, segments=segments)),
        np.random.default_rng(seed),
    )
    normal = rng.multivariate_normal(np.zeros(power.size), law.correlation, count)
    return power * scipy.stats.gamma.ppf(scipy.stats.norm.cdf(normal), law.half) / law.half


# --- of recordings


@pytest.mark.parametrize("count", [1, 3])
def test_a_target_of_recordings_carries_what_steadiness_measures(count, tmp_path):
    held = trials(count)
    wanted = jm.data.steadiness(held).measures
    target = (jm.data.Trials(held) if count > 1 else held[0]).target()
    assert list(target.measured) == list(wanted)
    np.testing.assert_equal(rows(target.measured), rows(wanted))
    assert target.with_measures() is target
    target.save(tmp_path / "kept.toml")
    again = load_target(tmp_path / "kept.toml")
    assert again == target and again.measures == target.measures


def test_they_are_of_the_recording_whatever_the_settings_of_the_spectrum():
    """Also in another unit, in whose quantity a tremor is looked for in another band."""
    settings = jm.SpectrumSettings(
        filter_direction="both", sampling="filtered", filter_cutoff=15.0, length=512, last_bin=40
    )
    held = jm.Recording(forces(3, 15.0)[0] - 10.0, 100.0, unit="mm")
    for recording in (trials()[0], held):
        target = recording.target(settings=settings)
        np.testing.assert_equal(rows(target.measured), rows(jm.data.steadiness(recording).measures))
    assert "tremor_size" in target.measured and target.measured["mean"].unit == "mm"


# --- of bins


def test_shares_and_median_are_those_of_even_bins():
    """A bin reaches half the resolution to both sides."""
    measured = jm.Target("bare", SMOOTH, segments=SEGMENTS).measured
    power = SMOOTH / SMOOTH.sum()
    low, high = FREQUENCY - RESOLUTION / 2, FREQUENCY + RESOLUTION / 2
    for start, stop in itertools.pairwise(EDGES):
        overlap = np.clip(np.minimum(high, stop) - np.maximum(low, start), 0, None)
        found = measured[f"share_{start:g}_{stop:g}"]
        assert found.value == pytest.approx(power @ overlap / RESOLUTION, rel=1e-9)
        assert found.error_from == "bins" and found.unit == "1"

    def surplus(f):
        return power @ np.clip((f - low) / RESOLUTION, 0, 1) - 0.5

    median = scipy.optimize.brentq(surplus, low[0], high[-1], xtol=1e-13)
    assert measured["median_frequency"].value == pytest.approx(median, rel=1e-9)
    assert not {"mean", CV, "standard_deviation"} & set(measured)


def test_errors_of_bins_are_the_scatter_of_spectra():
    """The standard deviation of 4000 draws is known to 1.1 %; the errors are of first order, which
    leaves out about 1/60 of the variance at 60 segments."""
    close = 4.5 * 0.011 + 1 / 60
    measured = jm.Target("bare", SMOOTH, segments=SEGMENTS).measured
    low, high = FREQUENCY - RESOLUTION / 2, FREQUENCY + RESOLUTION / 2
    made = drawn(SMOOTH, 4000)
    made /= made.sum(axis=1, keepdims=True)
    for start, stop in itertools.pairwise(EDGES):
        overlap = np.clip(np.minimum(high, stop) - np.maximum(low, start), 0, None) / RESOLUTION
        error = measured[f"share_{start:g}_{stop:g}"].stderr
        assert error == pytest.approx(np.std(made @ overlap), rel=close)
    below = np.concatenate([np.zeros((4000, 1)), np.cumsum(made, axis=1)], axis=1)
    edges = np.append(low, high[-1])
    medians = [np.interp(0.5, each, edges) for each in below]
    # by 200 draws, of which the standard deviation is known to 5 %
    assert measured["median_frequency"].stderr == pytest.approx(np.std(medians), rel=4.5 * 0.05)


def test_a_share_of_bins_has_the_interval_of_its_odds():
    found = jm.Target("bare", SMOOTH, segments=SEGMENTS).measured["share_8_12"]
    logit, reach = scipy.special.logit(found.value), 1.96 * found.stderr
    reach /= found.value * (1 - found.value)
    assert found.interval == pytest.approx(scipy.special.expit([logit - reach, logit + reach]))


def test_a_tremor_of_bins_has_the_frequency_and_size_of_its_hill():
    """Its size is the standard deviation of the hill over the mean: the root of its share of the
    power, times the coefficient of variation."""
    hill = 3 * SMOOTH[22] * BELL
    power = drawn(SMOOTH + hill, 1, seed=1)[0]
    target = jm.Target("hill", power, segments=SEGMENTS, coefficient_of_variation=0.02)
    found, share = target.measured, hill.sum() / (SMOOTH + hill).sum()
    assert found["tremor_p"].value <= 0.001
    frequency, size = found["tremor_frequency"], found["tremor_size"]
    assert abs(frequency.value - 9) < 4.5 * frequency.stderr < 1.0
    # the cubic follows this floor to a few percent
    expected = 0.02 * math.sqrt(share)
    assert abs(size.value - expected) < 4.5 * size.stderr + 0.05 * expected < 0.6 * expected
    assert size.unit == "1" and found["tremor_detectable"].value < size.value
    tested = find_peaks(power, target.settings, SEGMENTS, BAND)
    assert frequency.value == pytest.approx(tested.peaks[0].frequency)
    own = [measure_peak(x / x.sum(), target.settings, SEGMENTS, BAND) for x in drawn(power, 400)]
    # standard deviations of 200 and of 400 draws, each to 1/√(2 n)
    apart = 4.5 * math.hypot(1 / math.sqrt(400), 1 / math.sqrt(800))
    assert frequency.stderr == pytest.approx(np.std([f for f, _ in own]), rel=apart)


def test_without_a_variation_a_tremor_has_no_size():
    found = jm.Target("hill", SMOOTH + 3 * SMOOTH[22] * BELL, segments=SEGMENTS).measured
    assert math.isfinite(found["tremor_frequency"].value)
    assert math.isnan(found["tremor_size"].value) and found["tremor_size"].interval is None


def test_what_is_unknown_of_a_spectrum_is_not_measured():
    """Without segments the scatter of the bins, and so no peak can be told from chance; with gaps
    the power between."""
    silent = jm.Target("silent", SMOOTH).measured
    assert all(m.stderr is None and m.interval is None for m in silent.values())
    assert "median_frequency" in silent and not any(name.startswith("tremor") for name in silent)
    known = jm.Target("sigma", SMOOTH, sigma=0.1 * SMOOTH).measured
    assert known["share_1_2"].stderr > 0 and "tremor_p" not in known
    bins = np.arange(1, 22)
    short = jm.Target("short", SMOOTH[:21], bins=bins, segments=SEGMENTS).measured
    assert "share_4_8" in short and not {"share_8_12", "median_frequency"} & set(short)
    alone = jm.Target(
        "none", None, stiffness=jm.data.FrequencyResponse([1.0, 2.0], [3.0, 4.0], [1, 1])
    )
    assert alone.measured == {}


def test_mean_and_variation_are_those_that_the_target_states():
    means, variations = [10.0, 11.0, 12.5], [0.02, 0.03, 0.025]
    many = jm.Target(
        "many", SMOOTH, segments=[20] * 3, mean=means, coefficient_of_variation=variations, unit="N"
    ).measured
    for name, values, unit in (("mean", means, "N"), (CV, variations, "1")):
        found = many[name]
        assert (found.value, found.unit, found.error_from) == (np.mean(values), unit, "trials")
        assert found.stderr == pytest.approx(scipy.stats.sem(values))
        low, high = scipy.stats.t.interval(0.95, 2, found.value, found.stderr)
        assert found.interval == pytest.approx((max(low, 0) if name == CV else low, high), rel=1e-5)
    one = jm.Target("one", SMOOTH, segments=20, mean=10.0, unit="N").measured["mean"]
    assert (one.value, one.stderr, one.interval) == (10.0, None, None)


def test_with_measures_keeps_them_in_its_file(tmp_path):
    bare = jm.Target("bare", SMOOTH + 3 * SMOOTH[22] * BELL, segments=SEGMENTS)
    kept = bare.with_measures()
    assert bare.measures is None and kept.measures is not None
    np.testing.assert_equal(rows(kept.measured), rows(bare.measured))
    kept.save(tmp_path / "kept.toml")
    again = load_target(tmp_path / "kept.toml")
    assert again == kept
    np.testing.assert_equal(rows(again.measured), rows(bare.measured))


def test_a_measure_may_be_given_and_prints_itself():
    given = {"mean": Measure(10.0, 0.2, "N", "trials", (9.5, 10.5))}
    target = jm.Target("given", SMOOTH, measured=given)
    assert target.measured == given
    assert str(given["mean"]) == "10.00 ± 0.20 N (95 % interval 9.50 to 10.50 N)"


# --- damaged files

GOOD = {"value": 1.0, "stderr": 0.1, "low": 0.8, "high": 1.2, "unit": "N", "error_from": "trials"}
DAMAGED = {
    "a number": (3, "measured 3: give a table for each quantity, by its name"),
    "a list": ([1.0], r"measured \[1.0\]: give a table for each quantity"),
    "a number for a quantity": ({"mean": 1.0}, "measured.mean: needs a table with the keys"),
    "an unknown key": ({"mean": GOOD | {"values": 1.0}}, "did you mean 'value'?"),
    "no unit": (
        {"mean": {"value": 1.0, "error_from": "trials"}},
        "measured.mean: the key 'unit' is missing",
    ),
    "a text": (
        {"mean": GOOD | {"stderr": "big"}},
        "measured.mean: stderr must be a number, not a text",
    ),
    "yes": (
        {"mean": GOOD | {"value": True}},
        "measured.mean: value must be a number, not true",
    ),
    "a unit that is none": ({"mean": GOOD | {"unit": 3}}, "measured.mean: unit"),
    "no number": (
        {"mean": GOOD | {"value": math.nan}},
        "measured.mean.value = nan is not finite",
    ),
    "half an interval": (
        {"mean": {key: value for key, value in GOOD.items() if key != "high"}},
        "measured.mean: give both low and high, or neither",
    ),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_a_damaged_table_is_refused_by_its_key(case, tmp_path):
    measured, message = DAMAGED[case]
    table = jm.Target("damaged", SMOOTH, segments=SEGMENTS).to_table() | {"measured": measured}
    path = tmp_path / "damaged.toml"
    path.write_text(tomli_w.dumps(table))
    with pytest.raises(TargetError, match=message) as caught:
        load_target(path)
    assert "damaged.toml" in str(caught.value)


def test_numbers_that_do_not_exist_may_be_left_out(tmp_path):
    table = jm.Target("few", SMOOTH, segments=SEGMENTS).to_table()
    table["measured"] = {
        "tremor_frequency": {"unit": "Hz", "error_from": "bins"},
        "tremor_size": {"unit": "1", "error_from": "bins"},
    }
    path = tmp_path / "few.toml"
    path.write_text(tomli_w.dumps(table))
    for found in load_target(path).measured.values():
        assert math.isnan(found.value) and found.stderr is None and found.interval is None
