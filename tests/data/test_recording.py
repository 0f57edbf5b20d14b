"""Recordings: resampling and spectra against scipy, the plateau, what a target gets, what is
refused."""

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.signal
from matplotlib.figure import Figure
from recorded import noticed, refused

from jaxmuscle.data._recording import LOWEST_RATE, UNITS, Recording, known_unit
from jaxmuscle.data._target import Target
from jaxmuscle.spectra._measures import peaks
from jaxmuscle.spectra._settings import SpectrumSettings

# Float64 through a filter of order 18 and a transform: a few thousand times the rounding of one
# operation.
EXACT = 1e-10


def noisy(seconds=20.0, rate=2048.0, level=50.0, sd=0.5, seed=0):
    """A held level with a first-order fluctuation of 2 Hz and a sine at 8 Hz."""
    n = round(seconds * rate)
    decay = np.exp(-2 * np.pi * 2 / rate)
    white = np.random.default_rng(seed).normal(size=n + 2000)
    slow = scipy.signal.lfilter([np.sqrt(1 - decay**2)], [1, -decay], white)[2000:]
    return level + sd * (slow + 0.3 * np.sin(2 * np.pi * 8 * np.arange(n) / rate))


def ramp_and_hold(rest=1.0, up=5.0, hold=20.0, down=5.0, pause=3.0, rate=500.0, level=50.0, sd=0.5):
    """The signal and its nodes: rest, ramp, hold, ramp, rest."""
    nodes = np.cumsum([0, pause, up, hold, down, pause])
    t = np.arange(round(nodes[-1] * rate)) / rate
    shape = np.interp(t, nodes, [rest, rest, level, level, rest, rest])
    return shape + noisy(nodes[-1], rate, 0.0, sd) * np.clip(shape / level, 0.02, None), nodes


def by_scipy(x, window, rate=2048, segments=256):
    """The documented procedure with scipy alone: proportional power of bins 1 to 30, density, the
    analysed signal."""
    up, down = (int(v) for v in np.array([100, rate]) // np.gcd(100, rate))
    even = scipy.signal.resample_poly(x, up, down, padtype="line")
    low = scipy.signal.sosfiltfilt(scipy.signal.butter(9, 30, fs=100, output="sos"), even)
    cut = low[round(window[0] * 100) : round(window[1] * 100)]
    power = scipy.signal.welch(cut, 100, nperseg=segments)[1][1:31]
    return power / power.sum(), power, cut


@pytest.mark.parametrize("rate", [2048, 1000, 240, 100, 60])
def test_pipeline_equals_scipy(rate):
    x, window = noisy(rate=rate), (3.0, 17.5)
    part = Recording(x, rate).steady(window)
    p, power, cut = by_scipy(x, window, rate)
    np.testing.assert_allclose(part.filtered(), cut, rtol=EXACT)
    np.testing.assert_allclose(part.spectrum().power, power, rtol=EXACT)
    np.testing.assert_allclose(part.target().proportional_power, p, rtol=EXACT)


@pytest.mark.parametrize(
    "window", [(2.0, 19.0), (2.0, 12.24)], ids=["bins of its own", "ends of the settings"]
)
def test_fft_equals_scipy(window):
    """Of 10.24 s the fourth and the 120th frequency are the first and the last of the settings:
    both belong to it."""
    x = noisy(rate=1000)
    fft = Recording(x, 1000).steady(window).fft_spectrum()
    frequency, power = scipy.signal.periodogram(by_scipy(x, window, 1000)[2], 100, window="hann")
    inside = (frequency > 0.390624) & (frequency < 11.71876)
    np.testing.assert_allclose(fft.frequency, frequency[inside], rtol=EXACT)
    np.testing.assert_allclose(fft.power, power[inside], rtol=EXACT)


@pytest.mark.parametrize("rate", [2048, 1000, 1925.925926, 44100, 50])
def test_resampled_keeps_a_sine_and_removes_aliases(rate):
    t = np.arange(round(10 * rate)) / rate
    even = Recording(10 + np.sin(2 * np.pi * 7 * t), rate).resampled()
    middle = even.time[100:-100]
    # The filter's ripple of 0.1 %; from 50 Hz the image at 43 Hz as well, in the transition band.
    np.testing.assert_allclose(
        even.whole[100:-100] - 10, np.sin(2 * np.pi * 7 * middle), atol=2e-3 if rate > 100 else 1e-2
    )
    if rate > 200:
        alias = Recording(10 + np.sin(2 * np.pi * 93 * t), rate).resampled()
        # Without the filter this would be a sine of 7 Hz; its Kaiser window (β = 5) stops to -50
        # dB.
        assert np.std(alias.whole[100:-100]) < 10 ** (-50 / 20)


def test_resampled_to_its_own_rate_is_itself():
    recording = Recording(noisy(rate=100), 100)
    assert recording.resampled(100) is recording
    assert recording.resampled(50).whole.size == recording.whole.size / 2


def test_window_is_cut_after_the_filters():
    x = noisy(rate=1000)
    x[:5000] += 30.0
    cut = Recording(x, 1000).steady((6.0, 18.0))
    alone = Recording(x[6000:18000], 1000)
    np.testing.assert_allclose(cut.samples, alone.whole)
    assert not np.allclose(cut.filtered()[:5], alone.filtered()[:5], rtol=1e-6)
    np.testing.assert_allclose(cut.filtered(), by_scipy(x, (6, 18), 1000)[2], rtol=EXACT)


@pytest.mark.parametrize("level", [50.0, -50.0, 0.4])
@pytest.mark.parametrize("up", [0.5, 5.0])
def test_plateau_of_ramp_and_hold(level, up):
    x, nodes = ramp_and_hold(up=up, level=level, rest=0.02 * level, sd=0.01 * abs(level))
    a, b = Recording(x, 500).steady().window
    # Inside the hold, and at most the band (a tenth of the ramp), one second and the median's half
    # second shorter.
    assert nodes[2] - 0.1 * up <= a <= nodes[2] + 2
    assert nodes[3] - 2 <= b <= nodes[3] + 0.5


def test_plateau_survives_a_spike_and_a_cut_end():
    x, nodes = ramp_and_hold()
    x = x[: round(500 * (nodes[3] - 1))]
    x[7000:7040] += 200
    a, b = Recording(x, 500).steady().window
    assert a < nodes[2] + 2 and b == pytest.approx(nodes[3] - 1)


def test_all_of_a_record_without_ramp_is_steady():
    part = Recording(noisy(), 2048).steady()
    assert part.window == (0.0, 20.0) and "no ramp found" in part.notices[-1]
    np.testing.assert_array_equal(part.samples, part.whole)


T = np.arange(0, 60, 0.01)
NO_PLATEAU = {
    "ramp": T,
    "sine": 10 + 9 * np.sin(2 * np.pi * 0.1 * T),
    "three holds": np.array([1.0, 30, 40, 50])[(T // 15).astype(int)] + 0.1 * np.sin(T * 20),
    "wandering": np.cumsum(np.random.default_rng(3).normal(size=T.size)),
    "short hold": 1 + 9 * ((T > 30) & (T < 33)) + 0.1 * np.sin(T * 20),
}


@pytest.mark.parametrize("case", NO_PLATEAU)
def test_no_plateau_is_said(case):
    with pytest.raises(
        ValueError, match=r"no steady part was found.* give the part yourself|Welch segments needed"
    ):
        Recording(NO_PLATEAU[case], 100, name=case).steady()


def test_summary_against_its_sources():
    import antropy  # takes 7 s: not in every worker

    x, window = noisy(seed=4), (2.0, 18.0)
    part = Recording(x, 2048).steady(window)
    cut, summary = np.ascontiguousarray(by_scipy(x, window)[2]), part.summary()
    assert summary.mean == pytest.approx(cut.mean(), rel=EXACT)
    assert summary.coefficient_of_variation == pytest.approx(cut.std() / cut.mean(), rel=1e-9)
    assert summary.signal_to_noise == pytest.approx(cut.mean() / cut.std(), rel=1e-9)
    # Agreement with another implementation on counts of matches; a pair at the radius may fall
    # either way.
    assert summary.approximate_entropy == pytest.approx(antropy.app_entropy(cut), abs=1e-6)
    assert summary.sample_entropy == pytest.approx(antropy.sample_entropy(cut), abs=1e-6)
    assert summary.peaks == peaks(part.spectrum())
    assert summary.segments == part.segments() == (1600 - 256) // 128 + 1
    assert any(abs(peak.interpolated - 8) < 0.1 for peak in summary.peaks.local_maxima)
    table = summary.to_dataframe().set_index("quantity")
    assert list(table["value"].loc[["segments", "mean", "sample_entropy"]]) == [
        11,
        summary.mean,
        summary.sample_entropy,
    ]
    assert (
        table["value"]["maximum"] == summary.peaks.maximum.interpolated
        and table["unit"]["maximum"] == "Hz"
    )
    assert (
        "coefficient of variation" in str(summary)
        and summary.to_dict()["peaks"]["maximum"]["bin"] >= 1
    )


def test_a_target_says_that_most_of_its_variation_is_drift():
    time = np.arange(40960) / 2048
    steady = Recording(noisy(), 2048).target()
    drifting = Recording(noisy() + 0.5 * (time - time.mean()), 2048).target()
    assert not noticed(steady, "drift")
    (said,) = (notice for notice in drifting.notices if "drift" in notice)
    with_it, without = (target.coefficient_of_variation[0] for target in (drifting, steady))
    assert f"{with_it:.3g} with the drift" in said and with_it > 2 * without
    assert float(said.split(" with the drift, ")[1].split(" ")[0]) == pytest.approx(
        without, rel=0.01
    )


def test_a_recording_that_begins_later_has_the_same_window_later():
    """Times of a recorder that ran before: nothing but the times moves."""
    x = noisy(seed=2)
    early, late = (
        Recording(x, 2048).steady((2, 18)),
        Recording(x, 2048, start=30.0).steady((32, 48)),
    )
    np.testing.assert_array_equal(early.samples, late.samples)
    np.testing.assert_allclose(late.time - early.time, 30.0, rtol=1e-12)
    np.testing.assert_array_equal(early.spectrum().power, late.spectrum().power)
    assert early.summary().coefficient_of_variation == late.summary().coefficient_of_variation


def test_target_carries_what_is_known(tmp_path):
    part = Recording(noisy(), 2048, name="trial", source="a file").steady((2, 18))
    target = part.target(mvc=100.0)
    assert (target.name, target.provenance, target.quantity) == ("trial", "measured", "force")
    assert target.segments == (11,) and target.settings.filter_direction == "both"
    assert target.coefficient_of_variation == (part.summary().coefficient_of_variation,)
    assert target.mvc_fraction == pytest.approx(part.summary().mean / 100)
    assert target.source == "a file, window 2 s to 18 s"
    target.save(tmp_path / "trial.toml")
    assert part.target("other", provenance="user").provenance == "user"


@pytest.mark.parametrize(
    ("unit", "quantity"),
    [("N", "force"), ("Nm", "torque"), ("N·m", "torque"), ("mm", "displacement")],
)
def test_quantity_follows_the_unit(unit, quantity):
    target = Recording(noisy(rate=200), 200, unit=unit).target()
    assert target.quantity == quantity
    assert (target.coefficient_of_variation is None) == (quantity == "displacement")


@pytest.mark.parametrize("unit", ["m/s^2", "m/s²", "(m/s2)", "mm/s^2", "g", "mg"])
def test_an_acceleration_is_steady_and_has_no_variation(unit):
    """About zero, or about a part of gravity, which an accelerometer reads too."""
    for level in (0.0, 9.81):
        recording = Recording(noisy(level=level, rate=200), 200, unit=unit)
        part = recording.steady()
        assert part.window == (0.0, 20.0) and recording.quantity == "acceleration"
        target = part.target()
        assert (target.quantity, target.coefficient_of_variation) == ("acceleration", None)
        assert ("none, the mean is near zero" in str(part.summary())) == (level == 0.0)
    with pytest.raises(ValueError, match="the mean of an acceleration is zero; leave it out"):
        Target(
            "x", target.proportional_power, quantity="acceleration", coefficient_of_variation=0.01
        )


def test_level_of_a_recording_in_percent():
    assert Recording(
        noisy(level=26, rate=200), 200, unit="%MVC"
    ).target().mvc_fraction == pytest.approx(0.26, rel=1e-2)


def test_every_unit_knows_itself():
    assert all(known_unit(unit) == unit for unit in UNITS)
    assert known_unit("[N m]") == "N m" and known_unit("Mn") is None


def test_own_settings():
    settings = SpectrumSettings(rate=200.0, length=512, last_bin=20, filter_cutoff=None)
    x = noisy(rate=1000)
    power = scipy.signal.welch(
        scipy.signal.resample_poly(x, 1, 5, padtype="line"), 200, nperseg=512
    )[1][1:21]
    recording = Recording(x, 1000)
    np.testing.assert_allclose(recording.spectrum(settings).power, power, rtol=EXACT)
    assert recording.target(settings=settings).settings == settings


def test_spectra_by_name():
    recording = Recording(noisy(rate=200), 200)
    for name in ("standard", "slow", "multitaper"):
        target = recording.target(settings=name)
        assert target.settings == SpectrumSettings.named(name).replace(
            filter_direction="both", sampling="filtered"
        )
        assert f"  spectrum  {name}\n" in str(target)
        power = recording.spectrum(target.settings).power
        np.testing.assert_allclose(target.proportional_power, power / np.sum(power), rtol=EXACT)
        assert target.segments == (target.settings.segments(2000),)
    assert recording.target().settings.name == "standard"
    assert "  spectrum  settings of its own\n" in str(
        recording.target(settings=target.settings.replace(last_bin=50))
    )
    with pytest.raises(ValueError, match=r"settings='slwo'.*'slow'"):
        recording.spectrum("slwo")


def test_float64_whatever_the_flag():
    recording = Recording(noisy(rate=200), 200)
    with jax.enable_x64(False):
        narrow = recording.spectrum().power
    with jax.enable_x64(True):
        wide = recording.spectrum().power
    assert narrow.dtype == np.float64
    np.testing.assert_array_equal(narrow, wide)


def test_notices():
    x = np.clip(noisy(rate=1000), None, 50.4)
    (clipped,) = Recording(x, 1000).notices
    assert clipped.startswith("flat at its highest value 50.4 for ") and clipped.endswith(
        "clipped by the amplifier?"
    )
    assert f"{100 * np.mean(x == 50.4):.0f}" in clipped
    assert Recording(noisy(rate=1000), 1000).notices == ()
    assert Recording(noisy(rate=50), 50).notices == (
        "recorded at 50 Hz: holds nothing above 25 Hz",
    )


GOOD = noisy(rate=100)
REFUSED = {
    "rate zero": (lambda: Recording(GOOD, 0), "rate=0: give samples per second"),
    "rate nan": (lambda: Recording(GOOD, float("nan")), "rate=nan: give samples per second"),
    "rate low": (
        lambda: Recording(GOOD, LOWEST_RATE - 1),
        "rate=9.0: too slow: half of it lies below",
    ),
    "constant": (
        lambda: Recording(np.full(500, 2.0), 100),
        "constant at 2; is this the right column",
    ),
    "nan": (
        lambda: Recording([1.0, 2.0, np.nan], 100),
        "1 are no finite numbers, the first at 0.020 s",
    ),
    "huge": (lambda: Recording([1.0, 1e300], 100), "1 are no finite numbers"),
    "text": (lambda: Recording(["a"], 100), "samples: give real numbers"),
    "two signals": (
        lambda: Recording(np.ones((2, 5)), 100),
        "samples shape=(2, 5): give one signal",
    ),
    "one sample": (lambda: Recording([1.0], 100), "samples shape=(1,): give one signal of 2"),
    "unit": (lambda: Recording(GOOD, 100, unit="kPa"), "unit='kPa': did you mean"),
    "window outside": (
        lambda: Recording(GOOD, 100).steady((5, 25)),
        "give times with 0 <= start < stop <= 20 s",
    ),
    "window reversed": (lambda: Recording(GOOD, 100).steady((9, 5)), "window=(9, 5): give times"),
    "window no pair": (lambda: Recording(GOOD, 100, window=(3,)), "window=(3,): give two times"),
    "window short": (
        lambda: Recording(GOOD, 100).steady((5, 8.8)),
        "recording: window=(5.0, 8.8) holds 1 of the 2 Welch segments needed; give at least 3.84 s",
    ),
    "signal short": (lambda: Recording(GOOD[:200], 100).spectrum(), "one segment needs 256"),
    "fft short": (lambda: Recording(GOOD[:7], 100).fft_spectrum(), "is too short for a spectrum"),
    "fft without bins": (
        # 0.39 Hz: less than once in 1 s
        lambda: Recording(GOOD[:100], 100).fft_spectrum(SpectrumSettings(last_bin=1)),
        "is too short for a spectrum",
    ),
    "flat window": (
        lambda: Recording(np.append(np.zeros(900), GOOD), 100).steady((0, 8)).spectrum(),
        "is constant in the window (0.0, 8.0)",
    ),
    "volt": (
        lambda: Recording(GOOD, 100, unit="V").target(),
        "the unit V does not say what was measured. If it is a force",
    ),
    "mvc": (lambda: Recording(GOOD, 100).target(mvc=20), "mvc=20: give a force above the mean, 50"),
    "bins": (
        lambda: Recording(noisy(rate=30), 30).spectrum(SpectrumSettings(last_bin=60)),
        "choose a lower last_bin",
    ),
    "ratio": (lambda: Recording(GOOD, 1e8).resampled(), "too far from the 1e+08 Hz recorded"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    call, message = REFUSED[case]
    with refused(message):
        call()


def test_figure():
    x, _ = ramp_and_hold()
    figure = Recording(x, 500, name="trial", source="$a_b$").steady().plot()
    assert isinstance(figure, Figure) and len(figure.axes) == 3 and figure.get_suptitle() == "trial"
    figure.canvas.draw()
    welch = figure.axes[2].lines[-1]
    assert welch.get_label().startswith("Welch, ") and len(welch.get_xdata()) == 30
    plt.close(figure)
    figure = Recording(noisy(rate=60), 60, unit="V").plot()
    figure.canvas.draw()
    plt.close(figure)


def test_text_of_a_recording():
    text = str(Recording(noisy(), 2048, name="trial", unit="Nm").steady((2, 18)))
    assert (
        text.startswith("trial: torque [N m], 40960 samples at 2048 Hz")
        and "window 2 s to 18 s" in text
    )
