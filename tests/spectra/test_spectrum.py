"""The spectral estimate against scipy, analytic values, its own spread and its derivatives."""

import functools
import itertools
import json
from typing import Any

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
import scipy.signal
import scipy.stats
from compiled import at_once, kept_jit
from hypothesis import given, settings

from jaxmuscle.spectra._settings import NAMED, SpectrumSettings, taper_of
from jaxmuscle.spectra._welch import Spectrum, lowpass, periodogram, spectrum_of, welch

ROUNDING = 1e-10  # float64: what the design promises; the transforms themselves are within 1e-13
SINGLE = 1e-4  # float32, relative to the range of the fluctuations
# a mean, a drift, 15 s
FORCE = 10.0 + 0.01 * np.random.default_rng(0).standard_normal((2, 1500)).cumsum(-1)

GRID = [
    SpectrumSettings(window=window, overlap=overlap, detrend=detrend, length=length, last_bin=30)
    for window, overlap, detrend, length in itertools.product(
        ("hann", "hamming", "boxcar"), (0.0, 0.5, 0.75), ("constant", "linear", "none"), (255, 256)
    )
]
FILTERS = [
    SpectrumSettings(
        rate=rate, filter_order=order, filter_cutoff=cutoff, filter_direction=direction
    )
    for (rate, order, cutoff), direction in itertools.product(
        ((100.0, 9, 30.0), (100.0, 1, 5.0), (120.0, 4, 10.0), (100.0, 2, 0.5)), ("forward", "both")
    )
]


def scipy_lowpass(signal, settings):
    apply = {"forward": scipy.signal.sosfilt, "both": scipy.signal.sosfiltfilt}[
        settings.filter_direction
    ]
    order, cutoff = settings.filter_order, settings.filter_cutoff
    return apply(scipy.signal.butter(order, cutoff, fs=settings.rate, output="sos"), signal)


def scipy_welch(signal, settings):
    detrend: Any = False if settings.detrend == "none" else settings.detrend
    frequency, power = scipy.signal.welch(
        signal,
        fs=settings.rate,
        window=settings.window,
        nperseg=settings.length,
        noverlap=int(settings.overlap * settings.length),
        detrend=detrend,
    )
    bins = slice(settings.first_bin, settings.last_bin + 1)
    return frequency[bins], power[..., bins]


@pytest.fixture
def user_view():
    """As a user runs it: without the run-time type check, which would see a wrong argument
    first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.parametrize(
    "settings", GRID, ids=lambda s: f"{s.window}-{s.overlap}-{s.detrend}-{s.length}"
)
def test_welch_is_scipy(x64, settings):
    frequency, power = scipy_welch(FORCE, settings)
    np.testing.assert_allclose(settings.frequency, frequency, rtol=1e-14)
    # Where the mean stays in, its rounding is what the smaller bins are made of.
    floor = ROUNDING * np.max(power) if settings.detrend == "none" else 0.0
    np.testing.assert_allclose(
        at_once(lambda force: welch(force, settings), FORCE), power, rtol=ROUNDING, atol=floor
    )


@pytest.mark.parametrize(
    "settings", FILTERS, ids=lambda s: f"{s.filter_order}-{s.filter_direction}"
)
def test_lowpass_is_scipy(x64, settings):
    filtered = lowpass(FORCE, settings)
    np.testing.assert_allclose(filtered, scipy_lowpass(FORCE, settings), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize(
    "settings", FILTERS, ids=lambda s: f"{s.filter_order}-{s.filter_direction}"
)
@pytest.mark.parametrize("size", [1.0, 0.01])
def test_lowpass_keeps_small_fluctuations_in_single_precision(settings, size):
    signal = (10.0 + size * (FORCE - 10.0)).astype(np.float32)
    filtered = lowpass(signal, settings)
    assert filtered.dtype == jnp.float32
    # The result is a float32 near 10 N: no filter can be closer than a few spacings of such
    # numbers.
    bound = max(SINGLE * np.ptp(signal - 10), 3 * float(np.spacing(np.float32(10))))
    expected = scipy_lowpass(signal.astype(float), settings)
    np.testing.assert_allclose(np.asarray(filtered, float), expected, rtol=0, atol=bound)


def test_single_precision_spectrum():
    chosen = SpectrumSettings()
    signal = FORCE.astype(np.float32)
    spectrum = spectrum_of(signal, chosen, (5.0, 15.0))
    assert spectrum.power.dtype == spectrum.frequency.dtype == jnp.float32
    expected = scipy_welch(scipy_lowpass(signal.astype(float), chosen)[..., 500:], chosen)[1]
    error = np.abs(np.asarray(spectrum.power, float) - expected)
    assert np.all(error < SINGLE * np.max(expected, -1, keepdims=True))


def test_the_window_is_cut_after_the_filter(x64):
    chosen = SpectrumSettings()
    expected = scipy_welch(scipy_lowpass(FORCE, chosen)[..., 500:1200], chosen)[1]
    spectrum = spectrum_of(FORCE, chosen, (5.0, 12.0), unit="mm")
    np.testing.assert_allclose(spectrum.power, expected, rtol=ROUNDING)
    assert (spectrum.unit, spectrum.settings) == ("mm", chosen)


def test_without_cutoff_nothing_is_filtered(x64):
    chosen = SpectrumSettings(filter_cutoff=None)
    # One is compiled as a whole, the other step by step: the same up to rounding.
    np.testing.assert_allclose(spectrum_of(FORCE, chosen).power, welch(FORCE, chosen), rtol=1e-14)


@pytest.mark.parametrize("window", ["hann", "boxcar"])
@pytest.mark.parametrize("samples", [999, 1000])
def test_periodogram_is_scipy(x64, window, samples):
    chosen = SpectrumSettings(window=window, detrend="linear")
    frequency, power = map(
        np.asarray, at_once(lambda force: periodogram(force, chosen), FORCE[:, :samples])
    )
    expected = scipy.signal.periodogram(FORCE[:, :samples], 100.0, window=window, detrend="linear")
    np.testing.assert_allclose(frequency, expected[0], rtol=1e-14)
    # Bin 0 is zero but for rounding.
    np.testing.assert_allclose(power[:, 1:], expected[1][:, 1:], rtol=1e-8, atol=1e-14)


lengths = st.sampled_from((33, 48, 80))  # few shapes, few compilations
records = hnp.arrays(np.float64, lengths, elements=st.floats(-100, 100, width=32))
PLAIN = [
    SpectrumSettings(
        length=length, first_bin=0, last_bin=8, window="boxcar", overlap=0.0, filter_cutoff=None
    )
    for length in (16, 17)
]


@functools.cache
def plain_spectra():
    return kept_jit(
        lambda record: ([welch(record, chosen) for chosen in PLAIN], periodogram(record, PLAIN[0]))
    )


@settings(max_examples=40)
@given(records)
def test_power_adds_up_to_the_variance(record):
    with jax.enable_x64(True):
        powers, (frequency, power) = jax.tree.map(np.asarray, plain_spectra()(record))
    for chosen, found in zip(PLAIN, powers, strict=True):
        whole = record[: record.size // chosen.length * chosen.length].reshape(-1, chosen.length)
        total = np.sum(found) * chosen.resolution
        np.testing.assert_allclose(total, np.mean(np.var(whole, axis=1)), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(np.sum(power) * frequency[1], np.var(record), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("direction", ["forward", "both"])
def test_derivatives_agree(x64, direction):
    chosen = SpectrumSettings(length=64, last_bin=20, filter_direction=direction)
    signal, along = (
        jnp.asarray(FORCE[0, :300]),
        jnp.asarray(np.random.default_rng(1).standard_normal(300)),
    )

    def path(size):
        return jnp.log(spectrum_of(signal + size * along, chosen).proportional)

    h = 1e-6
    three = at_once(
        lambda size: (
            jax.jacfwd(path)(size),
            jax.jacrev(path)(size),
            path(size + h) - path(size - h),
        ),
        0.01,
    )
    forward, reverse, rise = map(np.asarray, three)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9)
    differences = rise / (2 * h)
    # Central differences: truncation h² f'''/6 below 1e-5 (f varies over 0.01), rounding 1e-13 / h.
    np.testing.assert_allclose(forward, differences, rtol=1e-5, atol=1e-5 * np.max(np.abs(forward)))


def test_jit_and_vmap_change_nothing(x64):
    chosen = SpectrumSettings()
    power = spectrum_of(FORCE, chosen).power

    def one(x):
        return spectrum_of(x, chosen).power

    # Another order of summation: rounding of the largest bin.
    for other in (jax.jit(one)(FORCE), jax.vmap(one)(FORCE), jnp.stack([one(x) for x in FORCE])):
        np.testing.assert_allclose(other, power, rtol=ROUNDING)
    jitted = jax.jit(welch)(FORCE, chosen)  # settings are static by themselves
    np.testing.assert_allclose(jitted, welch(FORCE, chosen), rtol=ROUNDING)


def test_whole_numbers_are_samples_too(x64):
    counts = np.arange(300) % 7
    np.testing.assert_array_equal(
        welch(counts, SpectrumSettings()), welch(counts.astype(float), SpectrumSettings())
    )


@pytest.mark.parametrize("window", ["hann", "hamming", "boxcar"])
@pytest.mark.parametrize("samples", [8, 255, 1000])
def test_the_taper_is_scipys_to_the_last_bit(window, samples):
    np.testing.assert_array_equal(
        taper_of(window, samples), scipy.signal.get_window(window, samples)
    )


def test_degrees_of_freedom_of_the_design():
    for k in (1, 2, 6, 40):
        expected = 2 * k / (1 + 2 * (1 - 1 / k) / 36)
        assert SpectrumSettings().degrees_of_freedom(k) == pytest.approx(expected, rel=1e-12)
    assert SpectrumSettings(overlap=0.0).degrees_of_freedom(7) == pytest.approx(14, rel=1e-12)


@pytest.mark.parametrize(
    "window, overlap", [("hann", 0.5), ("hann", 0.75), ("hamming", 0.5), ("boxcar", 0.5)]
)
def test_degrees_of_freedom_are_the_spread_of_white_noise(x64, window, overlap):
    chosen = SpectrumSettings(
        length=32, first_bin=3, last_bin=12, window=window, overlap=overlap, detrend="none"
    )
    samples = 112
    noise = np.random.default_rng(2).standard_normal((20_000, samples))
    # bins three apart are independent
    power = np.asarray(at_once(lambda noise: welch(noise, chosen), noise))[:, ::3]
    assert np.mean(power) == pytest.approx(2 / chosen.rate, rel=4 / np.sqrt(power.size))
    nu = chosen.degrees_of_freedom(chosen.segments(samples))
    relative_variance = np.mean(np.var(power, axis=0) / np.mean(power, axis=0) ** 2)
    # A variance estimated from n values of kurtosis 3 + 12/ν has the relative standard error √((2 +
    # 12/ν)/n).
    standard_error = np.sqrt((2 + 12 / nu) / power.size)
    assert relative_variance == pytest.approx(2 / nu, rel=4 * standard_error)
    assert standard_error < 0.01  # fine enough to miss ν = 2K, which ignores the overlap


@pytest.mark.parametrize(
    "samples, overlap", [(255, 0.5), (256, 0.5), (1000, 0.5), (1000, 0.29), (1000, 0.0)]
)
def test_segments_are_counted_as_scipy_counts(samples, overlap):
    chosen = SpectrumSettings(length=256, overlap=overlap)
    expected = 0
    if samples >= 256:
        transform = scipy.signal.spectrogram(
            np.zeros(samples), nperseg=256, noverlap=int(overlap * 256)
        )
        expected = transform[2].shape[-1]
    assert chosen.segments(samples) == expected


def test_overlap_is_not_lost_to_rounding():
    assert SpectrumSettings(length=100, overlap=0.29).step == 71
    assert SpectrumSettings(length=255, overlap=0.5).step == 128  # scipy: nperseg // 2 shared


def test_pwelch_puts_the_mean_into_the_first_bin(x64):
    noise = 0.1 * np.random.default_rng(3).standard_normal(1000)
    matlab = Spectrum(
        SpectrumSettings().frequency,
        welch(10 + noise, SpectrumSettings.named("pwelch")),
        SpectrumSettings(),
    )
    assert matlab.proportional[0] > 0.999
    # w = 0.54 - 0.46 cos has |W_1| = 0.23 n and Σ w² = 0.3974 n: P_1 = 2 (10 N · 0.23 n)² / (rate ·
    # 0.3974 n).
    leaked = 2 * (10 * 0.23 * 256) ** 2 / (100 * 0.3974 * 256)
    # The noise interferes with the leak: its amplitude is √(2 · 0.1² / (100 Hz · leaked)) of the
    # leak.
    assert matlab.power[0] == pytest.approx(leaked, rel=6 * np.sqrt(2 * 0.1**2 / (100 * leaked)))
    detrended = spectrum_of(10 + noise, SpectrumSettings(filter_cutoff=None))
    assert detrended.proportional[0] < 0.2


def test_average_before_normalising(x64):
    power = np.array([[1.0, 3.0], [30.0, 10.0]])
    spectrum = Spectrum(np.array([1.0, 2.0]), power, SpectrumSettings())
    np.testing.assert_allclose(spectrum.proportional, [[0.25, 0.75], [0.75, 0.25]])
    np.testing.assert_allclose(spectrum.mean().power, [15.5, 6.5])
    np.testing.assert_allclose(spectrum.mean().mean().proportional, [15.5 / 22, 6.5 / 22])


WRONG = {
    "rate": [0.0, -1.0, float("nan"), float("inf"), "100"],
    "length": [7, 256.0, np.float64(256)],
    "first_bin": [-1, 31],
    "last_bin": [0, 129, 30.5],
    "overlap": [1.0, -0.1, float("nan")],
    "window": ["hanning"],
    "detrend": ["mean", False],
    "filter_order": [0, 2.5],
    "filter_cutoff": [0.0, 50.0, float("nan"), "30"],
    "filter_direction": ["backward"],
    "sampling": ["mean"],
    "tapers": [0, 3, 2.0],
}


@pytest.mark.parametrize(
    "name, value", [(name, value) for name, values in WRONG.items() for value in values]
)
def test_wrong_settings_are_named(user_view, name, value):
    with pytest.raises(ValueError, match=f"^{name} ?=.*(give|choose)") as error:
        SpectrumSettings(**{name: value})
    assert str(value) in str(error.value)


def test_tapers_that_do_not_fit():
    for count in (1, 9):
        with pytest.raises(ValueError, match=f"^tapers = {count}: give a whole number from 2 to 8"):
            SpectrumSettings(length=64, window="dpss", tapers=count)


def test_a_whole_table_lacks_no_setting():
    table = SpectrumSettings(detrend="linear").to_dict()
    for name in table:
        less = {key: value for key, value in table.items() if key != name}
        assert SpectrumSettings.from_dict(less).replace(detrend="linear").to_dict() == table
        with pytest.raises(ValueError, match=f"has no key '{name}'"):
            SpectrumSettings.from_dict(less, whole=True)


def test_names():
    for name in NAMED:
        chosen = SpectrumSettings.named(name)
        assert chosen.name == name
        assert (
            chosen.replace(filter_direction="both", filter_cutoff=None, sampling="average").name
            == name
        )
        assert chosen.replace(length=512, last_bin=20).name is None
    assert SpectrumSettings.named("standard") == SpectrumSettings()
    with pytest.raises(ValueError, match=r"settings='slwo'.*'slow'"):
        SpectrumSettings.named("slwo")


@pytest.mark.parametrize(
    "name, window", [("slow", ["hann"]), ("multitaper", scipy.signal.windows.dpss(1000, 2, 3))]
)
def test_spectra_of_long_segments_are_scipys(x64, name, window):
    """Segments of 10 s, their straight line removed; NW = 2 and K = 3 for Slepian tapers, each as a
    window of its own."""
    signal = np.cumsum(np.random.default_rng(4).standard_normal((2, 3700)), axis=1)
    each = [
        scipy.signal.welch(signal, 100, taper, 1000, 500, detrend="linear")[1] for taper in window
    ]
    chosen = SpectrumSettings.named(name)
    expected = np.mean(each, axis=0)[:, chosen.first_bin : chosen.last_bin + 1]
    np.testing.assert_allclose(
        at_once(lambda signal: welch(signal, chosen), signal), expected, rtol=1e-10
    )
    np.testing.assert_allclose(chosen.frequency, np.arange(chosen.first_bin, 118) / 10)


def test_a_drift_leaves_slow_spectra_alone(x64):
    """A straight line of any steepness: nothing of it is in a bin, where removing the mean alone
    leaves a lot."""
    noise = np.random.default_rng(5).standard_normal(3000)
    for name in ("slow", "multitaper"):
        chosen = SpectrumSettings.named(name)
        level, rows = (
            chosen.replace(detrend="constant"),
            noise + np.outer([0.0, 0.01], np.arange(3000)),
        )
        straight, mean = at_once(
            lambda rows, both=(chosen, level): [welch(rows, each) for each in both], rows
        )
        still, drifting = np.asarray(straight)
        np.testing.assert_allclose(drifting, still, rtol=1e-9)
        still, drifting = np.asarray(mean)[:, 0]
        assert drifting > 20 * still


@pytest.mark.parametrize(
    "chosen",
    [
        SpectrumSettings(),
        SpectrumSettings.named("multitaper"),
        SpectrumSettings.named("pwelch"),
        SpectrumSettings(
            rate=np.float32(120), length=np.int64(128), first_bin=0, filter_cutoff=None
        ),
    ],
)
def test_settings_survive_a_file(chosen):
    table = json.loads(json.dumps(chosen.to_dict()))
    assert None not in table.values()  # TOML could not hold it
    assert SpectrumSettings.from_dict(table, whole=True) == chosen
    assert hash(SpectrumSettings.from_dict(table)) == hash(chosen)


def test_replace():
    assert SpectrumSettings(filter_cutoff=None).replace(length=128) == SpectrumSettings(
        length=128, filter_cutoff=None
    )
    with pytest.raises(ValueError, match=r"lenght=64.*'length'"):
        SpectrumSettings().replace(lenght=64)
    with pytest.raises(ValueError, match=r"last_bin = 30.*8"):
        SpectrumSettings().replace(length=16)


@pytest.mark.parametrize("window", [(5.0, 16.0), (-1.0, 5.0), (6.0, 6.0), (0.0, 2.0)])
def test_a_window_that_does_not_fit(window):
    name = "signal length=200" if window == (0.0, 2.0) else "window="
    with pytest.raises(ValueError, match=name):
        spectrum_of(FORCE, SpectrumSettings(), window)


def test_signals_that_are_too_short(user_view):
    with pytest.raises(ValueError, match=r"signal length=255: one segment needs 256"):
        welch(np.zeros(255), SpectrumSettings())
    with pytest.raises(ValueError, match=r"signal length=30: .*'both' needs more than 30"):
        lowpass(np.zeros(30), SpectrumSettings(filter_direction="both"))
    with pytest.raises(ValueError, match="padlen"):  # the same limit as scipy's
        scipy_lowpass(np.zeros(30), SpectrumSettings(filter_direction="both"))
    assert lowpass(np.zeros(31), SpectrumSettings(filter_direction="both")).shape == (31,)
    for signal in (np.zeros(0), np.array(1.0), np.ones(300, complex)):
        with pytest.raises(ValueError, match=r"signal=.*real samples"):
            lowpass(signal, SpectrumSettings())
    with pytest.raises(ValueError, match="segments=0"):
        SpectrumSettings().degrees_of_freedom(0)


def test_spectra_that_vmap_made_are_averaged_drawn_and_printed_as_any():
    """`jax.vmap` gives their frequencies a leading axis, too."""
    frequency, power = (
        np.array([1.0, 2.0, 3.0], np.float32),
        np.array([[1.0, 2.0, 3.0], [3.0, 4.0, 5.0]], np.float32),
    )
    mapped = jax.vmap(lambda power: Spectrum(frequency, power, SpectrumSettings()))(power)
    assert mapped.frequency.shape == (2, 3)
    usual = Spectrum(frequency, power, SpectrumSettings())
    assert str(mapped) == str(usual) and "spectra   2" in str(mapped)
    for found in (mapped.mean(), usual.mean()):
        np.testing.assert_array_equal(found.frequency, frequency)
        np.testing.assert_allclose(found.power, [2.0, 3.0, 4.0])
    lines = [ax.lines[0].get_xydata() for ax in (mapped.plot(), usual.plot())]
    np.testing.assert_array_equal(*lines)
