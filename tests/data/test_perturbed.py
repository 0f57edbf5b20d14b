"""Recordings of force and displacement: the response and its errors, sign, delay, units, files,
what is refused."""

import json
import re

import numpy as np
import pages
import pytest
import scipy.signal
import scipy.stats
from recorded import noticed
from refits import without_intervals
from typer.testing import CliRunner

import jaxmuscle as jm
from jaxmuscle.commands.main import app
from jaxmuscle.data._second_order import second_order_fit
from jaxmuscle.spectra._cross_spectrum import Response, response_of

RATE, SECONDS, SEEDS = 100.0, 60.0, 40
K, B, INERTIA = 1500.0, 25.0, 0.3
MEAN, DISPLACED, AR = 50.0, 1e-3, 0.95
CHANCE = 3.9  # standard errors that one draw in 10 000 exceeds
# resolves how the response bends
FINE = jm.SpectrumSettings(length=512, last_bin=50, filter_direction="both")


def stiffness(f):
    s = 2j * np.pi * f
    return K + s * B + s**2 * INERTIA


def spring_damper_mass(band=5.0, rate=RATE):
    """Filters from white noise to displacement and to force, by the exact step of x, x', x'', x'''
    (scipy, no jaxmuscle).

    The displacement is white noise, held for a sample, through an analog Butterworth filter of
    fourth order.
    """
    b, a = scipy.signal.butter(4, 2 * np.pi * band, analog=True)
    a_matrix = np.eye(4, k=1)
    a_matrix[3] = -a[:0:-1]
    outputs = b[-1] * np.array([[1.0, 0.0, 0.0, 0.0], [K, B, INERTIA, 0.0]])
    system = (a_matrix, np.eye(4)[:, [3]], outputs, np.zeros((2, 1)))
    step = scipy.signal.cont2discrete(system, 1 / rate)
    (x, force), poles = scipy.signal.ss2tf(*step[:4])
    return x, force, poles


def drawn(seeds, noise, rate=RATE, seed=0):
    """Displacement [m] and force [N] of some seeds, and the filters; the force has noise of density
    2 noise² / rate |A|²."""
    rng = np.random.default_rng(seed)
    x, force, poles = spring_damper_mass(rate=rate)
    scale = DISPLACED / np.sqrt(np.sum(scipy.signal.lfilter(x, poles, np.eye(1, 20_000)[0]) ** 2))
    kept = round(SECONDS * rate)
    white = rng.standard_normal((2, seeds, kept + round(5 * rate)))
    moved, pulled = (
        scale * scipy.signal.lfilter(f, poles, white[0])[:, -kept:] for f in (x, force)
    )
    return (
        moved,
        pulled + MEAN + scipy.signal.lfilter([noise], [1, -AR], white[1])[:, -kept:],
        (scale * x, poles),
    )


def recorded(displacement, force, rate=RATE, **options):
    return jm.data.PerturbedRecording.from_array(force, displacement, rate, **options)


@pytest.fixture(scope="module")
def responses():
    """Of all seeds: the frequency response in the bins that all have, and the second-order fits."""
    moved, force, _ = drawn(SEEDS, 0.2)
    recordings = [recorded(x, f, positive="lengthening") for x, f in zip(moved, force, strict=True)]
    found = [recording._response(FINE) for recording in recordings]
    bins = min(response.frequency.size for response in found)
    return recordings, found, bins


def test_response_equals_scipy():
    moved, force, _ = drawn(1, 0.2)
    settings = jm.SpectrumSettings(filter_cutoff=None)
    found = recorded(moved[0], force[0]).frequency_response(settings)
    options = {"fs": RATE, "nperseg": 256, "noverlap": 128, "window": "hann", "detrend": "constant"}
    bins = np.rint(found.frequency / settings.resolution).astype(int)
    cross = scipy.signal.csd(moved[0], force[0], **options)[1][bins]
    power = scipy.signal.welch(moved[0], **options)[1][bins]
    np.testing.assert_allclose(found.value, cross / power, rtol=1e-10)
    np.testing.assert_allclose(
        found.coherence, scipy.signal.coherence(moved[0], force[0], **options)[1][bins], rtol=1e-10
    )


def test_several_tapers_are_added_up():
    moved, force, _ = drawn(1, 0.2)
    settings = jm.SpectrumSettings.named("multitaper").replace(filter_cutoff=None)
    found = recorded(moved[0], force[0]).frequency_response(settings)
    tapers = scipy.signal.windows.dpss(1000, 2, 3)
    bins = np.rint(found.frequency / settings.resolution).astype(int)
    cross, power = (
        sum(
            scipy.signal.csd(moved[0], y, RATE, taper, 1000, 500, detrend="linear")[1][bins]
            for taper in tapers
        )
        for y in (force[0], moved[0])
    )
    np.testing.assert_allclose(found.value, cross / power, rtol=1e-9)


def test_errors_of_few_segments_are_not_too_small():
    """Of four segments the response takes up one; without that the stated variance would be a
    quarter too small."""
    x, noise = np.random.default_rng(4).standard_normal((2, 250, 640))
    # the response is 0
    found = [response_of(*pair, jm.SpectrumSettings()) for pair in zip(x, noise, strict=True)]
    seen = np.array([np.mean(np.abs(r.value) ** 2) for r in found])
    stated = np.array([np.mean(2 * r.stderr**2) for r in found])
    spread = np.std(seen / seen.mean() - stated / stated.mean()) / np.sqrt(len(found))
    assert seen.mean() / stated.mean() == pytest.approx(1, abs=CHANCE * spread)
    assert CHANCE * spread < 0.25


def test_one_standard_error_covers_what_it_should(responses):
    _, found, bins = responses
    error = np.array([((r.value - stiffness(r.frequency)) / r.stderr)[:bins] for r in found])
    within = np.concatenate([np.abs(error.real) < 1, np.abs(error.imag) < 1], axis=1)
    averages = FINE.degrees_of_freedom(FINE.segments(round(SECONDS * RATE))) / 2
    expected = scipy.stats.t.cdf(1, 2 * (averages - 1)) - scipy.stats.t.cdf(-1, 2 * (averages - 1))
    binomial = np.sqrt(expected * (1 - expected) / within.size)
    # neighbouring bins are correlated by 0.45, so whether they are covered by less than 0.45² = 0.2
    shared = 1.3
    assert abs(within.mean() - expected) < CHANCE * binomial * shared


def test_neighbouring_bins_share_errors_as_stated(responses):
    _, found, bins = responses
    error = np.array([((r.value - stiffness(r.frequency)) / r.stderr)[:bins] for r in found])
    seen = np.mean(np.real(error[:, 1:] * error[:, :-1].conj())) / 2
    stated = np.mean([np.real(np.diag(r.correlation, 1)[: bins - 1]) for r in found])
    assert stated == pytest.approx(0.45, abs=0.05)
    # E|e|⁴ = 2 (E|e|²)²: 0.7 to 1.5 a pair
    assert seen == pytest.approx(stated, abs=CHANCE * 1.5 / np.sqrt(error.size))


def test_coherence_is_that_of_theory(responses):
    _, found, bins = responses
    _, _, (x, poles) = drawn(1, 0.2)
    f = found[0].frequency[:bins]
    given = np.abs(scipy.signal.freqz(x, poles, 2 * np.pi * f / RATE)[1]) ** 2
    noise = 0.2**2 * np.abs(scipy.signal.freqz([1], [1, -AR], 2 * np.pi * f / RATE)[1]) ** 2
    follows = np.abs(stiffness(f)) ** 2 * given
    truth = follows / (follows + noise)
    averages = FINE.degrees_of_freedom(FINE.segments(round(SECONDS * RATE))) / 2
    seen = np.array([r.coherence[:bins] for r in found])
    # Bendat & Piersol 2010, section 9.2: the bias, and the spread below
    expected = truth + (1 - truth) ** 2 / averages
    spread = np.sqrt(2 * truth) * (1 - truth) / np.sqrt(averages)
    offset = (seen.mean(0) - expected) / (spread / np.sqrt(SEEDS))
    assert np.all(np.abs(offset) < 4.8)  # 50 bins, one draw in 10 000
    assert truth.min() < 0.8 < 0.95 < truth.max()


def test_periodic_input_has_honest_errors():
    """A multisine whose period is a segment: overlapping segments repeat the input, and so are
    worth less."""
    settings = jm.SpectrumSettings(window="boxcar", filter_cutoff=None)
    tones, time = np.arange(1, 25), np.arange(6000) / RATE
    f = tones * settings.resolution
    rng = np.random.default_rng(5)
    phases = np.exp(2j * np.pi * (f[:, None] * time + rng.uniform(size=(24, 1))))
    x, force = phases.real.sum(0), (stiffness(f)[:, None] * phases).real.sum(0)
    noise = scipy.signal.lfilter([300], [1, -AR], rng.standard_normal((60, 6500)))[:, 500:]
    error = np.array(
        [
            ((r := response_of(x, force + n, settings)).value - stiffness(f)) / r.stderr
            for n in noise
        ]
    )
    assert np.mean(np.abs(error) ** 2) / 2 == pytest.approx(
        1, abs=CHANCE * 1.5 / np.sqrt(error.size) + 0.03
    )


def test_second_order_and_its_errors(responses):
    recordings, found, _ = responses
    fits = [second_order_fit(r, False) for r in found]
    offset = np.array([(fit.value - (K, B, INERTIA)) / fit.stderr for fit in fits])
    # chi² of so many numbers, the errors being known to a few per cent themselves
    assert scipy.stats.chi2.sf(np.sum(offset**2) / 1.1, offset.size) > 1e-4
    assert scipy.stats.chi2.cdf(np.sum(offset**2), offset.size) > 1e-4
    assert np.mean([fit.chi2 for fit in fits]) == pytest.approx(1, abs=0.1)
    named = recordings[0].second_order(FINE)
    np.testing.assert_array_equal([m.value for m in named.values()], fits[0].value)
    assert [m.unit for m in named.values()] == ["N/m", "N s/m", "kg"]


def test_second_order_at_the_edges_of_the_input():
    """A multisine that ends between two bins: what an outer bin sees lies beside its middle. The
    exact limb is found."""
    rate, seconds = 200, 60
    f = np.arange(1, rate * seconds // 2) / seconds
    inside = (f >= 0.5) & (f <= 5.0)
    phase = np.exp(2j * np.pi * np.random.default_rng(8).uniform(size=f.size))
    tones = np.concatenate([[0], np.where(inside, phase, 0), [0]])
    s = np.concatenate([[0], 2j * np.pi * f, [0]])
    x, force = (
        np.fft.irfft(tones * gain, rate * seconds) for gain in (1.0, K + B * s + INERTIA * s**2)
    )
    scale = 1e-3 / np.std(x)
    noise = 1e-3 * np.random.default_rng(9).standard_normal(x.size)
    moved, pulled = (np.tile(part, 2) for part in (scale * x, scale * force + noise))
    record = recorded(
        moved, 10.0 + pulled, float(rate), positive="lengthening", window=(30.0, 90.0)
    )
    found = record.second_order()
    for name, true in (("K", K), ("B", B), ("I", INERTIA)):
        assert found[name].value == pytest.approx(true, rel=0.03), name
    response = response_of(
        record.displacement.filtered(jm.SpectrumSettings()),
        record.force.filtered(jm.SpectrumSettings()),
        jm.SpectrumSettings(),
    )
    middle = (response.frequency > 1.5) & (response.frequency < 4.2)
    # of a bin of 0.39 Hz
    np.testing.assert_allclose(response.centre[middle], response.frequency[middle], atol=0.12)
    beyond = response.centre[(response.frequency > 5.0) & (response.frequency < 5.6)]
    assert np.all((beyond > 4.5) & (beyond < 5.0))  # nothing moves above 5 Hz


def test_two_parts_in_series_are_not_of_second_order():
    """The numbers of docs/perturbed.md: a misfit that chi² shows, and a delay that is none."""
    f = jm.SpectrumSettings().frequency
    s = 2j * np.pi * f
    inner, outer = 0.5 * s**2 + 60 * s + 200, 5 * s + 200
    exact = inner * outer / (inner + outer) + 0.5 * s**2
    response = Response(
        f, exact, 0.02 * np.abs(exact), np.full(f.size, 0.98), np.eye(f.size) + 0j, f, f**2
    )
    fit = second_order_fit(response, True)
    assert f"{fit.value[0]:.0f} {fit.stderr[0]:.0f}" == "144 4"
    assert f"{1e3 * fit.value[3]:.1f} {1e3 * fit.stderr[3]:.1f}" == "-1.2 0.4"
    assert second_order_fit(response, False).chi2 == pytest.approx(19, abs=0.5)


def test_a_delay_is_found_and_taken_out():
    moved, force, _ = drawn(1, 0.03, rate=1000.0, seed=3)
    late = recorded(moved[0, 8:], force[0, :-8], 1000.0)
    value, stderr = late.delay(FINE)
    assert abs(value - 8e-3) < CHANCE * stderr < 4e-3
    whole = recorded(moved[0, 8:], force[0, :-8], 1000.0, delay=8e-3, start=1.0)
    np.testing.assert_allclose(whole.displacement.whole, moved[0, 8:-8], atol=1e-9)
    np.testing.assert_array_equal(whole.force.whole, force[0, 8:-8])
    assert whole.force.start == whole.displacement.start == pytest.approx(1.008)
    back, error = whole.delay(FINE)
    assert abs(back) < CHANCE * error
    assert noticed(whole, "lags by 8 ms")
    (said,) = late.late(FINE)
    assert re.match(
        r"the force comes [78]\.?\d* ± \S+ ms late, beyond what a spring", said
    ) and not whole.late(FINE)
    early = recorded(moved[0, :-8], force[0, 8:], 1000.0)
    assert (
        "ms early" in early.late(FINE)[0]
        and not recorded(moved[0, :300], force[0, :300], 1000.0).late()
    )


def test_part_of_a_sample_is_taken_out():
    time = np.arange(3000) / 200
    x, force = np.sin(2 * np.pi * 3 * time), np.cos(2 * np.pi * 3 * time)
    for delay in (0.0123, -0.0123):
        shifted = recorded(x, force, 200.0, delay=delay, positive="lengthening").displacement
        at = shifted.start + np.arange(shifted.whole.size) / 200 - delay
        inner = slice(20, -20)
        np.testing.assert_allclose(
            shifted.whole[inner], np.sin(2 * np.pi * 3 * at)[inner], atol=1e-6
        )


@pytest.mark.parametrize(
    ("seconds", "settings"), [(30, "standard"), (30, "slow"), (20, "standard")]
)
def test_unrelated_channels_have_no_response(seconds, settings):
    """Few averages and overlapping segments: of 40 pairs 2 are expected below 0.05, 9 hardly ever
    (p = 2e-4)."""
    count = round(seconds * RATE)
    moved, force, _ = drawn(40, 0.2)
    found = [
        recorded(x[:count], y[-count:], positive="lengthening").frequency_response(settings).p_none
        for x, y in zip(moved, force[::-1], strict=True)
    ]
    assert min(found) > 1e-3 and np.sum(np.array(found) < 0.05) < 9 and np.median(found) > 0.15
    related = [
        recorded(x[:count], y[:count]).frequency_response(settings).p_none
        for x, y in zip(moved, force, strict=True)
    ]
    assert max(related) <= 1e-3


def joint(moved, force, **options):
    """The recording of a joint: the same numbers in N m and, from degrees, in rad."""
    units = {"units": "N m", "displacement_units": "deg"}
    return recorded(np.degrees(moved), force, **units | options)


def test_a_joint_is_described_without_a_lever_arm():
    moved, force, _ = drawn(1, 0.2)
    angle = 20 * moved[0]
    turned, straight = joint(angle, force[0]), recorded(angle, force[0])
    assert (turned.force.unit, turned.displacement.unit) == ("N m", "rad") and turned.of_joint
    response = turned.frequency_response()
    np.testing.assert_allclose(response.value, straight.frequency_response().value, rtol=1e-9)
    assert response.unit == "N m/rad"
    numbers = turned.second_order()
    assert [m.unit for m in numbers.values()] == ["N m/rad", "N m s/rad", "kg m²"]
    for name, true in zip("KBI", (K, B, INERTIA), strict=True):
        assert abs(20 * numbers[name].value - true) < CHANCE * 20 * numbers[name].stderr, name
    assert turned.second_order_of_joint() == {}
    for arm in (0.05, 0.1):  # at a lever arm the joint's numbers stand beside, and are the same
        given = joint(angle, force[0], lever_arm=arm)
        np.testing.assert_allclose(given.second_order()["K"].value, numbers["K"].value / arm**2)
        for name, one in given.second_order_of_joint().items():
            assert (one.value, one.stderr) == pytest.approx(
                (numbers[name].value, numbers[name].stderr), rel=1e-9
            )
            assert one.unit == numbers[name].unit
        carried = turned.at_lever_arm(arm)
        np.testing.assert_allclose(carried.force.whole, given.force.whole)
        np.testing.assert_allclose(carried.displacement.whole, given.displacement.whole, atol=1e-15)
    assert "torque [N m] and lengthening [rad]" in str(turned) and "deg rms" in str(turned)
    labels = {ax.get_ylabel() for ax in turned.plot().axes}
    assert {"Torque (N m)", "Angle (deg)", "Gain (N m/rad)"} <= labels
    with pytest.raises(ValueError, match="only a torque has a lever arm"):
        straight.at_lever_arm(0.1)
    (size,) = joint(np.radians(angle), force[0]).notices
    assert size.endswith("give --displacement-units rad (Python: displacement_units=)")


def test_a_joint_as_a_file(tmp_path):
    moved, force, _ = drawn(1, 0.2)
    path, out = tmp_path / "ankle.csv", tmp_path / "out"
    save(path, time=np.arange(6000) / 100, torque_Nm=force[0] / 10, angle_rad=20 * moved[0])
    code, text = analyse(path, "--out", out)
    assert code == 0, text
    found = json.loads((out / "analysis.json").read_text())
    numbers = found["second_order"]
    assert [numbers[name]["unit"] for name in "KBI"] == ["N m/rad", "N m s/rad", "kg m²"]
    for name, true in zip("KBI", (K, B, INERTIA), strict=True):
        error = numbers[name]["value"] - true / 200
        assert abs(error) < CHANCE * numbers[name]["stderr"], name
    assert "describe the points" in text and found["second_order_misfit"]["p"] > 0.01
    assert "second_order_of_joint" not in found and found["passive"]["notices"] == []
    again = jm.data.load_frequency_response(out / "response.csv")
    table = jm.data.FrequencyResponse.from_table(found["response"])
    assert again.unit == table.unit == "N m/rad"
    np.testing.assert_allclose(again.value, table.value)
    at_arm = jm.data.load_frequency_response(out / "response.csv", lever_arm=0.1)
    np.testing.assert_allclose(at_arm.value, 100 * table.value)
    code, text = analyse(path, "--out", out, "--force", "--lever-arm", 0.1)
    beside = json.loads((out / "analysis.json").read_text())
    assert code == 0 and beside["second_order"]["K"]["unit"] == "N/m"
    for name in "KBI":
        assert list(beside["second_order_of_joint"][name].values())[:2] == pytest.approx(
            list(numbers[name].values())[:2], rel=1e-9
        )


def test_the_band_of_the_response(tmp_path):
    """By default as far as the motion excites, at most to 30 Hz; the spectrum has its own bins."""
    rng = np.random.default_rng(2)
    x = 1e-3 * rng.standard_normal(12_000)
    force = MEAN + K * x + 0.3 * rng.standard_normal(x.size)
    wide = recorded(x, force, 200.0)
    assert wide.frequency_response().frequency[[0, -1]] == pytest.approx([0.39, 30], abs=0.4)
    assert recorded(x, force, 50.0).frequency_response().frequency[-1] <= 20
    narrow = recorded(x, force, 200.0, band=(2, 10))
    assert narrow.frequency_response("slow").frequency[[0, -1]] == pytest.approx([2, 10])
    target = narrow.target()
    first, *_, last = target.stiffness.frequency  # groups are up to 12 % wide
    assert 2 <= first < 2 * 1.12**2 and 10 / 1.12 < last < 10 * 1.12
    assert len(target.bins) == 30
    assert wide.target().stiffness.frequency[-1] > 28
    within, _, _ = drawn(1, 0.2)
    still = recorded(within[0], force[: within[0].size])
    assert still.frequency_response().frequency[-1] < 25  # nothing moves above
    for band in ((5, 2), (1, 60), "x"):
        with pytest.raises(ValueError, match="give lowest and highest frequency"):
            recorded(x, force, 200.0, band=band)
    path = save(tmp_path / "x.csv", time=np.arange(12_000) / 200, force_N=force, x_m=x)
    named = ["--force-column", "force_N", "--displacement", "x_m", "--out", tmp_path / "out"]
    assert analyse(path, *named, "--band", "2:10")[0] == 0
    found = json.loads((tmp_path / "out" / "analysis.json").read_text())
    assert 2 <= found["response"]["frequency_hz"][0] < found["response"]["frequency_hz"][-1] <= 10
    code, text = analyse(path, *named, "--force", "--band", "10")
    assert code == 2 and "--band 10: give lowest and highest" in text


def test_p_of_the_shape_is_right(responses):
    """Uniform where a spring, a damper and a mass are the truth."""
    recordings, _, _ = responses
    p = [recording.second_order_misfit()[1] for recording in recordings]
    assert scipy.stats.kstest(p, "uniform").pvalue > 1e-4
    assert np.mean(np.array(p) < 0.05) < 0.2


def test_what_is_not_passive_is_seen():
    """A spring whose force is late; not one whose force is in time, though it does not damp."""
    moved, _, _ = drawn(40, 0.2, rate=1000.0)
    rng = np.random.default_rng(6)
    p, notices = [], []
    for x in moved:
        noise = scipy.signal.lfilter([0.06], [1, -0.99], rng.standard_normal(x.size))
        exact = recorded(x, MEAN + K * x + noise, 1000.0, positive="lengthening")
        p.append(exact.frequency_response().p_passive[0])
        notices += exact.frequency_response().activity
    # each below 0.01 with a probability of at most 0.01: five of 40 by one chance in 20 000
    assert len(notices) < 5 and np.sum(np.array(p) < 0.05) < 9
    x, noise = moved[0], 0.1 * rng.standard_normal(moved[0].size)
    late = recorded(x[30:], (MEAN + K * x + noise)[:-30], 1000.0, positive="lengthening")
    (said,) = late.frequency_response().activity
    assert "the imaginary part of the stiffness is negative" in said
    assert "a force channel that is late looks the same" in said
    assert said in late.target().notices
    heavy = MEAN + 3.0 * np.gradient(np.gradient(x, 1e-3), 1e-3) + noise
    early = recorded(x[:-10], heavy[10:], 1000.0, positive="lengthening")
    assert "a displacement channel that is late" in early.frequency_response().activity[0]


def test_sign():
    moved, force, _ = drawn(1, 0.2)
    straight, turned = recorded(moved[0], force[0]), recorded(-moved[0], force[0])
    np.testing.assert_array_equal(straight.displacement.whole, turned.displacement.whole)
    assert not straight.notices
    assert noticed(turned, "counts shortening as positive: its sign is turned")
    np.testing.assert_array_equal(
        recorded(moved[0], force[0], positive="shortening").displacement.whole, -moved[0]
    )
    np.testing.assert_array_equal(
        recorded(-moved[0], force[0], positive="lengthening").displacement.whole, -moved[0]
    )
    # above 2.3 Hz a mass
    heavy = force[0] + (7.5 - INERTIA) * np.gradient(np.gradient(moved[0], 1 / RATE), 1 / RATE)
    np.testing.assert_array_equal(recorded(moved[0], heavy).displacement.whole, moved[0])
    for sign in (1, -1):  # a negative pull is turned, then the lengthening is found as before
        pushed = recorded(sign * moved[0], -force[0])
        np.testing.assert_array_equal(pushed.force.whole, force[0])
        np.testing.assert_array_equal(pushed.displacement.whole, moved[0])
        assert noticed(pushed, "the mean force is negative: its sign is turned")
    stated = recorded(-moved[0], -force[0], positive="lengthening").notices
    assert any("mean force is negative" in notice and "turned" not in notice for notice in stated)
    for factor, unit in ((1e3, "mm"), (1e-3, "m")):  # the column's unit is another one than it says
        (size,) = recorded(factor * moved[0], force[0] / factor).notices
        assert size.endswith(f"give --displacement-units {unit} (Python: displacement_units=)")
    unrelated = recorded(moved[0], force[0, ::-1])
    assert noticed(unrelated, "--positive lengthening or --positive shortening")
    short = recorded(moved[0, :300], force[0, :300])
    assert noticed(short, "sign of the displacement is not checked")
    with pytest.raises(ValueError, match="positive='up'"):
        recorded(moved[0], force[0], positive="up")


def test_steady_part_and_window():
    moved, force, _ = drawn(1, 0.2)
    ramp = np.linspace(0, MEAN, 300)
    whole = recorded(
        np.concatenate([0 * ramp, moved[0], 0 * ramp]), np.concatenate([ramp, force[0], ramp[::-1]])
    )
    held = whole.steady()
    assert held.window is not None
    assert held.window == held.displacement.window
    assert 3 <= held.window[0] < 5 < 61 < held.window[1] <= 63
    assert sum("steady part" in notice for notice in held.notices) == 1
    given = whole.steady((10, 40))
    assert given.force.samples.size == given.displacement.samples.size == 3000
    f = given.frequency_response()
    assert f.source.endswith("window 10 s to 40 s")
    np.testing.assert_allclose(np.abs(f.value - stiffness(f.frequency)) / f.stderr, 0, atol=6)
    with pytest.raises(
        ValueError, match=r"a frequency response needs 512 at 100 Hz, 5\.12 s; give a longer window"
    ):
        whole.steady((10, 14)).frequency_response()


def test_the_hold_of_a_force_that_answers_as_no_spring_does():
    """An answer that comes 60 ms late and drifts, of 40 % of the force; a joint without a force."""
    moved, *_ = drawn(1, 0.05)
    x, still = moved[0], np.zeros(500)
    late = np.concatenate([np.zeros(6), x[:-6]])
    slow = scipy.signal.lfilter([0.02], [1, -0.98], np.random.default_rng(3).normal(size=x.size))
    slow *= 0.15 / slow.std()
    for weak in (3.0, 0.0):
        answer = weak * slow + (0.7 * late + 0.7 * np.roll(late, 40)) / np.std(x)
        ramp = np.linspace(0, weak, 500)
        noise = 0.01 * np.random.default_rng(4).standard_normal(x.size + 1000)
        whole = recorded(
            np.concatenate([still, x, still]),
            noise + np.concatenate([ramp, weak + answer, ramp[::-1]]),
            positive="lengthening",
        )
        held = whole.steady()
        assert held.window is not None and held.force.window == held.displacement.window
        a, b = held.window
        assert 4.9 < a < b < 65.1 and b - a > 45
        assert noticed(held, "where the insertion moves")
        kind = "within half of its level" if weak else "having no level of its own"
        assert noticed(held, kind)
    ramped = recorded(np.concatenate([still, x, still]), np.linspace(0, 50, x.size + 1000) ** 2)
    with pytest.raises(ValueError, match="no steady part was found"):
        ramped.steady()


def test_the_hold_of_a_weak_force_that_answers_with_half_of_itself():
    moved, force, _ = drawn(1, 0.05)
    weak, still = 3.0, 0 * np.linspace(0, 1, 300)
    ramp = np.linspace(0, weak, 300)
    whole = recorded(
        np.concatenate([still, moved[0], still]),
        np.concatenate([ramp, force[0] - MEAN + weak, ramp[::-1]]),
    )
    assert np.std(force[0]) > 0.3 * weak
    with pytest.raises(ValueError, match="no steady part was found"):
        whole.force.steady()
    held = whole.steady()
    assert held.window is not None and held.window == held.displacement.window
    assert 3 <= held.window[0] < 5 < 61 < held.window[1] <= 63
    # only looked for without the answer
    np.testing.assert_array_equal(held.force.whole, whole.force.whole)
    assert sum("steady part" in notice for notice in held.notices) == 1


UNITS = {  # units of the force's and of the displacement's column, lever arm, their scales
    "plain": ("N", "m", None, 1.0, 1.0),
    "small": ("mN", "mm", None, 1e3, 1e3),
    "cm": ("kN", "cm", None, 1e-3, 1e2),
    "um": ("N", "µm", None, 1.0, 1e6),
    "angle": ("N", "deg", 0.05, 1.0, 180 / np.pi / 0.05),
    "torque and angle": ("Nm", "rad", 0.05, 0.05, 1 / 0.05),
    "torque": ("N cm", "mm", 0.05, 100 * 0.05, 1e3),
}


@pytest.mark.parametrize("case", UNITS)
@pytest.mark.parametrize("header", [True, False])
def test_units(case, header, tmp_path):
    units, moved_units, arm, scale, reach = UNITS[case]
    time = np.arange(400) / 100
    x, force = 1e-3 * np.sin(2 * np.pi * time), 50 + 2 * np.sin(2 * np.pi * time)
    names = f"time,pull [{units}],way [{moved_units}]" if header else "time,pull,way"
    path = tmp_path / "perturbed.csv"
    np.savetxt(
        path,
        np.c_[time, force * scale, x * reach],
        delimiter=",",
        header=names,
        comments="",
        fmt="%.15g",
    )
    stated = {} if header else {"units": units, "displacement_units": moved_units}
    found = jm.load_recording(path, force="pull", displacement="way", lever_arm=arm, **stated)
    np.testing.assert_allclose(found.force.whole, force, rtol=1e-12)
    np.testing.assert_allclose(found.displacement.whole, x, atol=1e-15)
    assert (found.force.unit, found.displacement.unit, found.rate, found.name) == (
        "N",
        "m",
        100.0,
        "perturbed",
    )


def save(path, **columns):
    np.savetxt(
        path,
        np.stack(list(columns.values()), axis=1),
        delimiter=",",
        header=",".join(columns),
        comments="",
    )
    return path


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    moved, force, _ = drawn(1, 0.2)
    path = tmp_path_factory.mktemp("perturbed") / "perturbed.csv"
    return save(
        path,
        time=np.arange(6000) / 100,
        force_N=force[0],
        displacement_mm=1e3 * moved[0],
        angle_deg=moved[0],
        plain=moved[0],
        still_mm=0 * moved[0],
    )


def test_every_format_with_columns(file, tmp_path):
    wanted = jm.load_recording(file, force="force_N", displacement="displacement_mm")
    columns = dict(
        zip(
            ("force", "displacement"),
            (wanted.force.whole, 1e3 * wanted.displacement.whole),
            strict=True,
        )
    )
    np.savez(tmp_path / "a.npz", fs=100.0, **columns)
    np.save(tmp_path / "a.npy", np.stack(list(columns.values()), axis=1))
    for name, (force, displacement), options in (
        ("a.npz", columns, {}),
        ("a.npy", (0, 1), {"rate": 100}),
    ):
        found = jm.load_recording(
            tmp_path / name,
            force=force,
            displacement=displacement,
            units="N",
            displacement_units="mm",
            **options,
        )
        np.testing.assert_allclose(
            found.displacement.whole, wanted.displacement.whole, rtol=1e-12, atol=1e-18
        )
        np.testing.assert_array_equal(found.force.whole, wanted.force.whole)


def test_gaps_are_closed_in_both(tmp_path):
    moved, force, _ = drawn(1, 0.2)
    holes = force[0].copy()
    holes[:4], holes[100:103] = np.nan, np.nan
    path = save(
        tmp_path / "a.csv", time=np.arange(6000) / 100, force_N=holes, way_mm=1e3 * moved[0]
    )
    found = jm.load_recording(path, force="force", displacement="way")
    assert found.force.whole.size == found.displacement.whole.size == 5996
    assert found.displacement.start == 0.04
    assert noticed(found, "closed by straight lines")


REFUSED = {
    "only one": ({"force": "force_N"}, "give `force` and `displacement`"),
    "no such column": ({"force": "force_N", "displacement": "way"}, "no displacement 'way'"),
    "the time": (
        {"force": "force_N", "displacement": "time"},
        "displacement='time' is the time; choose one of",
    ),
    "twice the same": ({"force": "force_N", "displacement": "force_N"}, "are one column"),
    "lever arm missing": (
        {"force": "force_N", "displacement": "angle_deg"},
        "in m, as lever_arm=0.1",
    ),
    "lever arm of nothing": (
        {"force": "force_N", "displacement": "displacement_mm", "lever_arm": 0.1},
        "lever_arm=0.1: leave it out",
    ),
    "no unit": (
        {"force": "force_N", "displacement": "plain"},
        "give `displacement_units`, as displacement_units='mm'",
    ),
    "wrong unit": (
        {"force": "force_N", "displacement": "plain", "displacement_units": "kg"},
        "unit of a displacement or of its angle",
    ),
    "volts": (
        {"force": "force_N", "displacement": "plain", "displacement_units": "V"},
        "(m for each volt), and name",
    ),
    "force in mm": (
        {"force": "displacement_mm", "displacement": "plain", "displacement_units": "m"},
        "unit of a force",
    ),
    "constant": (
        {"force": "force_N", "displacement": "still_mm"},
        "m, so nothing moved the muscle. Take the force alone",
    ),
    "column as well": (
        {"column": "force_N", "force": "force_N", "displacement": "displacement_mm"},
        "column='force_N'",
    ),
    "lever arm of a force": (
        {"column": "force_N", "lever_arm": 0.1},
        "it turns a torque into a force, and column force_N",
    ),
    "delay too long": (
        {"force": "force_N", "displacement": "displacement_mm", "delay": 40.0},
        "delay=40.0",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case, file):
    options, words = REFUSED[case]
    with pytest.raises(ValueError) as error:
        jm.load_recording(file, **options)
    assert words in str(error.value)


def test_channels_must_be_alike():
    x = np.sin(np.arange(400.0))
    force, moved = jm.Recording(x, 100), jm.Recording(x, 100, unit="m")
    for other, words in (
        (force, "displacement.unit='N'"),
        (jm.Recording(x, 50, unit="m"), "displacement.rate=50.0"),
        (jm.Recording(x, 100, unit="m", window=(0, 2)), "displacement.window"),
        (jm.Recording(x[1:], 100, unit="m"), "399 samples"),
    ):
        with pytest.raises(ValueError) as error:
            jm.data.PerturbedRecording(force, other)
        assert words in str(error.value)
    assert jm.data.PerturbedRecording(force, moved, name="anna").name == "anna"
    with pytest.raises(ValueError, match="displacement='399 samples'"):
        recorded(x[1:], x)


def test_text_and_figure(file):
    recording = jm.load_recording(file, force="force_N", displacement="displacement_mm")
    text = str(recording)
    assert "columns force_N and displacement_mm" in text
    assert "mm rms" in text
    figure = recording.plot()
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert {"Force (N)", "Lengthening (mm)", "Gain (N/m)", "Phase (deg)", "Coherence γ²"} <= set(
        labels
    )


def analyse(*arguments):
    found = CliRunner().invoke(app, ["-q", "analyse", *map(str, arguments)])
    return found.exit_code, " ".join(found.output.split())


def test_the_command(file, tmp_path):
    columns = "--force-column", "force_N", "--displacement", "displacement_mm", "--out", tmp_path
    code, text = analyse(file, *columns)
    assert code == 0, text
    assert "H = K + iωB - ω²I" in text
    assert "analysis.json, response.csv, analysis.png" in text
    found = json.loads((tmp_path / "analysis.json").read_text())
    response = jm.data.FrequencyResponse.from_table(found["response"])
    held = jm.load_recording(file, force="force_N", displacement="displacement_mm").steady()
    np.testing.assert_allclose(response.value, held.frequency_response().value, rtol=1e-10)
    np.testing.assert_allclose(
        jm.data.load_frequency_response(tmp_path / "response.csv").value, response.value
    )
    wanted = {name: (m.value, m.stderr, m.unit) for name, m in held.second_order().items()}
    for name, numbers in wanted.items():
        assert tuple(found["second_order"][name].values()) == pytest.approx(numbers)
        value, error, _ = numbers
        assert held.second_order()[name].interval == pytest.approx(
            (value - 1.96 * error, value + 1.96 * error)
        )
    assert found["second_order"]["delay"]["unit"] == "s"
    code, text = analyse(file, *columns)
    assert code == 2
    assert "overwrite it with --force" in text
    assert (
        analyse(file, *columns, "--force", "--window", "5:55", "--positive", "lengthening")[0] == 0
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--force-column", "force_N"], "give --displacement, the name of one"),
        (["--force-column", "force_N", "--displacement", "angle_deg"], "as --lever-arm 0.1"),
        (
            ["--force-column", "force_N", "--displacement", "plain"],
            "give --displacement-units, as --displacement-units 'mm'",
        ),
        (
            ["--force-column", "force_N", "--displacement", "displacement_mm", "--mvc", "100"],
            "belong to spectra",
        ),
        (
            ["--force-column", "force_N", "--displacement", "displacement_mm", "--column", "plain"],
            "--column 'plain'",
        ),
    ],
)
def test_mistakes_at_the_command_line(arguments, words, file, tmp_path):
    code, text = analyse(file, *arguments, "--out", tmp_path / "out")
    assert code == 2
    assert words in text


@pytest.mark.usefixtures("as_fine_as_shipped")
@pytest.mark.slow
def test_the_page(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "perturbed.csv").write_bytes(file.read_bytes())
    page = (pages.ROOT / "docs" / "perturbed.md").read_text(encoding="utf-8")
    rows = [
        line.strip()
        for line in page.splitlines()
        if line.startswith(("    frequency_hz,", "    0.5,", "    1.0,", "    2.0,"))
    ]
    (tmp_path / "figure.csv").write_text("\n".join(rows))
    whole = "jm.fit(jm.PrescribedLength(), recording)"
    with without_intervals():
        names = pages.run(
            "docs/perturbed.md",
            None,
            {whole: f"{whole[:-1]}, rungs=0, starts=8, seeds=0, check_seeds=0)"},
        )
    assert names["published"].frequency.size == 3
    np.testing.assert_allclose(
        jm.data.load_frequency_response("response.csv").value, names["response"].value
    )
    assert (tmp_path / "perturbed.png").stat().st_size > 20_000
